"""Many episodes: in a batch where the backend has one; else in processes, threads, or one by one.

Results do not depend on which.
"""

from __future__ import annotations

import math
import multiprocessing
from collections.abc import Callable, Generator, Sequence
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from scm_world._arguments import whole_number
from scm_world._types import Floats
from scm_world.errors import EngineFailure, UnknownOption
from scm_world.policies.scripted import OpenLoopPolicy, as_policy
from scm_world.queries.equations import Equations
from scm_world.queries.plans import GroupedSchedules, Schedule
from scm_world.queries.rollouts import (
    ALL,
    Running,
    RunningTogether,
    Trace,
    Unit,
    run,
)
from scm_world.queries.twins import AnyTwins, EquationTwins, Twins, threaded
from scm_world.work.executors import Executor
from scm_world.work.processes import cores
from scm_world.world import Simulation
from scm_world.world.batch import Batch

R = TypeVar("R")

Result = Trace | Exception
"""What a unit leaves behind, or the exception that stopped it."""

MOST = 64
"""Worlds that are stepped together, at most."""

LEAST = 4
"""Fewer are not worth it."""

PRICE = 32
"""Control steps of one thread that it costs to make a world."""


def run_units(
    twins: AnyTwins,
    units: Sequence[Unit],
    finish: Callable[[int, Result], R],
    workers: int | None = None,
) -> list[R]:
    """Run units, and reduce what each leaves behind.

    Args:
        twins: Of the world.
        units: All of the same steps, with the same names and kind of policy.
        finish: Called with the place of a unit and its result; what it raises is raised. It may
            be called by several threads, in any order.
        workers: Threads, see ``Setting``.

    Returns:
        What ``finish`` returned, in the order of the units.
    """
    if isinstance(twins, EquationTwins):
        return [finish(place, result) for place, result in enumerate(_solved(twins, units))]
    given = None if workers is None else whole_number("workers", workers, least=1)
    is_child = multiprocessing.parent_process() is not None  # one of many that share the cores
    threads = given or (1 if is_child else cores())
    n = _batch_size(twins, units, threads)
    executor = None if n or twins.batches else executor_for(twins, units, given or 1)
    if n:
        results = _in_batches(twins, units, n, threads)
    elif executor is not None:
        results = run_in_processes(executor, twins, units)
    else:
        return _separately(twins, units, finish, given or 1)
    with closing(results):
        return [finish(place, result) for place, result in enumerate(results)]


Results = Generator[Result, None, None]


def _batch_size(twins: Twins, units: Sequence[Unit], threads: int) -> int:
    """Return how many units to step together; 0 if that does not pay.

    Each further world makes a step cheaper by less, and costs the same.
    """
    if not twins.batches or len(units) < LEAST or not is_known(units[0]) or units[0].listens:
        return 0
    steps = len(units) * (units[0].steps - units[0].first)
    worth = math.isqrt(steps * threads // PRICE)
    if worth < LEAST:
        return 0
    most = min(max(worth, twins.batched), MOST)
    return math.ceil(len(units) / math.ceil(len(units) / most))


def _in_batches(twins: Twins, units: Sequence[Unit], n: int, threads: int) -> Results:
    """Run units together, n at a time."""
    with twins.together(n, units[0].names, threads) as batch:
        for first in range(0, len(units), n):
            some = units[first : first + n]
            try:
                yield from run_together(batch, some)
            except EngineFailure:  # run separately, it ends its own unit only
                yield from _separately(twins, some, lambda _, result: result, 1)


def _separately(
    twins: Twins, units: Sequence[Unit], finish: Callable[[int, Result], R], workers: int
) -> list[R]:
    def one(place: int) -> R:
        with twins.twin() as world:
            result = units[place].result(world)
        return finish(place, result)

    return threaded(one, range(len(units)), workers)


def _solved(twins: EquationTwins, units: Sequence[Unit]) -> list[Result]:
    """Run units: together where they can be, else one by one."""
    try:
        together = _solved_together(twins, units)
    except Exception:  # run separately, it ends its own unit only
        together = None
    if together is None:
        return [unit.result(Equations(twins.layout)) for unit in units]
    return [
        Trace(
            vectors=list(vectors),
            statics=[(0, {})],
            declarations=[(0, twins.layout)],
            actions=list(actions),
        )
        for vectors, actions in zip(*together, strict=True)
    ]


def paths(twins: EquationTwins, units: Sequence[Unit]) -> Floats:
    """Run units, and give all values at all instants, shape (n, steps + 1, size).

    Raises:
        Exception: What stopped a unit.
    """
    with suppress(Exception):  # the unit raises it again
        together = _solved_together(twins, units)
        if together is not None:
            return together[0]
    return np.array([unit.run(Equations(twins.layout)).vectors for unit in units])


def _solved_together(twins: EquationTwins, units: Sequence[Unit]) -> tuple[Floats, Floats] | None:
    """Run units as one, if nothing in them depends on the schedule of one of them."""
    first, one = units[0], Equations(twins.layout)
    policies = [as_policy(unit.policy, one) for unit in units] if twins.layout.n_actions else []
    numbers = range(first.number, first.number + len(units))
    if (
        not twins.layout.is_vectorised
        or any(unit.first or unit.number != i for unit, i in zip(units, numbers, strict=True))
        or any((unit.seed, unit.steps) != (first.seed, first.steps) for unit in units)
        or not all(isinstance(policy, OpenLoopPolicy) for policy in policies)
    ):
        return None
    keys = [tuple((at, id(plan)) for at, plan in unit.layers) for unit in units]
    kinds = {key: unit.layers for key, unit in zip(keys, units, strict=True)}
    plans = (plan for layers in kinds.values() for _, plan in layers)
    if any(act.time.when is not None for plan in plans for _, act in plan.timed()):
        return None
    places = {kind: group for group, kind in enumerate(kinds)}
    groups = [places[key] for key in keys]
    actions = np.empty((len(units), first.steps, twins.layout.n_actions))
    for row, policy in enumerate(policies):
        one.reset(seed=first.seed, episode=numbers[row])
        actions[row] = policy.ahead(one, 0, first.steps)  # type: ignore[attr-defined] # OpenLoopPolicy
    together = Equations(twins.layout, groups)
    unit = replace(first, policy=lambda system: actions[:, system.index], names=())
    running = Running(unit, together)
    running.schedule = GroupedSchedules(map(Schedule, kinds.values()))
    running.begin()
    run(running, 0, first.steps)
    return np.stack(running.trace.vectors, axis=1), actions


def is_known(unit: Unit) -> bool:
    """Tell whether all actions of a unit are known beforehand, so that it can be in a batch."""
    return isinstance(as_policy(unit.policy), OpenLoopPolicy) and ALL not in unit.names


def run_together(batch: Batch, units: Sequence[Unit]) -> list[Result]:
    """Run units in the rows of a batch.

    Args:
        batch: Of as many worlds or more; see ``RunningTogether``.
        units: See there.

    Returns:
        What each leaves behind, or the exception that stopped it.

    Raises:
        EngineFailure: The backend lost one of the states; that stops all of them.
    """
    running = RunningTogether(batch, units)
    running.begin()
    run(running, units[0].first, units[0].steps)
    return running.results()


PAYS = 10_000
"""Control steps that pay for the start of processes."""

GOES_ON = 200
"""Control steps that are worth sending to processes that are there."""

SHARE = 4
"""Jobs for each process, so that none waits long for the last one."""


def executor_for(twins: Twins, units: Sequence[Unit], workers: int) -> Executor | None:
    """Return processes for some units; None where they do not pay, or cannot be.

    Args:
        twins: Of the world.
        units: What is to be run.
        workers: How many processes there may be.
    """
    steps = sum(unit.steps - unit.first for unit in units)
    is_child = multiprocessing.parent_process() is not None
    worth = GOES_ON if twins.has_executor(workers) else PAYS
    if workers < 2 or len(units) < 2 or is_child or steps < worth:
        return None
    executor = twins.executor(workers)
    try:
        executor.check("twins", twins)
        executor.check("units", [_sent(unit) for unit in units])
    except UnknownOption:  # such as a policy that is a lambda: it acts in this process
        return None
    return executor


def run_in_processes(executor: Executor, twins: Twins, units: Sequence[Unit]) -> Results:
    """Run units in other processes.

    Args:
        executor: As ``executor_for`` gave it.
        twins: Of the world.
        units: To run.

    Returns:
        The result of each, in the order of the units.

    Raises:
        EngineFailure: Processes ended again and again.
    """
    size = math.ceil(len(units) / (SHARE * executor.workers))
    jobs = [tuple(map(_sent, units[i : i + size])) for i in range(0, len(units), size)]
    early: dict[int, list[Any]] = {}
    done = 0
    with twins.twin() as world:
        for job, results in executor.run(partial(partial, _run_there, twins), jobs):
            early[job] = results
            while done in early:
                yield from (_unpacked(result, world) for result in early.pop(done))
                done += 1


def _run_there(twins: Twins, units: Sequence[Unit]) -> list[Any]:
    """Run units in this process for another one, and pack what each leaves behind."""
    with twins.twin() as world:
        here = (replace(unit, past=_unpacked(unit.past, world)) for unit in units)
        return [_packed(unit.result(world)) for unit in here]


def _sent(unit: Unit) -> Unit:
    return replace(unit, past=_packed(unit.past))


def _packed(result: Any) -> Any:
    """Write down a trace for another process: of a structure, what decides it."""
    if not isinstance(result, Trace):
        return result
    return replace(result, declarations=[(step, d.plan) for step, d in result.declarations])


def _unpacked(result: Any, world: Simulation) -> Any:
    if not isinstance(result, Trace):
        return result
    found = [(step, world.structures.compiled(plan)) for step, plan in result.declarations]
    return replace(result, declarations=found)
