"""Many episodes: in a batch where the backend has one; else in processes, threads, or one by one.

Results do not depend on which.
"""

from __future__ import annotations

import math
import multiprocessing
import pickle
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, suppress
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from scm_world._arguments import whole_number
from scm_world._types import Floats
from scm_world.errors import EngineFailure
from scm_world.policies.scripted import OpenLoopPolicy, as_policy
from scm_world.queries.equations import Equations
from scm_world.queries.plans import GroupedSchedules
from scm_world.queries.rollouts import ALL, RunningTogether, Trace, Unit, run
from scm_world.queries.twins import AnyTwins, EquationTwins, Twins
from scm_world.work.processes import cores
from scm_world.world import Simulation
from scm_world.world.batch import Batch

R = TypeVar("R")

Result = Trace | Exception
"""What a unit leaves behind, or the exception that stopped it."""

Results = Generator[Result, None, None]

MOST = 64
"""Worlds that are stepped together, at most."""

LEAST = 4
"""Fewer are not worth it."""

PRICE = 32
"""Control steps of one thread that it costs to make a world."""

PAYS = 10_000
"""Control steps that pay for the start of processes."""

GOES_ON = 200
"""Control steps that are worth sending to processes that are there."""

SHARE = 4
"""Jobs for each process, so that none waits long for the last one."""


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
    if n := _batch_size(twins, units, threads):
        results = _in_batches(twins, units, n, threads)
    elif not twins.batches and not is_child and _pays(twins, units, given or 1):
        results = _in_processes(twins, units, given or 1)
    else:

        def one(place: int) -> R:
            return finish(place, _alone(twins, units[place]))

        if (given or 1) == 1:
            return [one(place) for place in range(len(units))]
        with ThreadPoolExecutor(given) as pool:  # backends compute without Python's lock
            return [*pool.map(one, range(len(units)))]
    with closing(results):
        return [finish(place, result) for place, result in enumerate(results)]


def _alone(twins: Twins, unit: Unit) -> Result:
    with twins.twin() as world:
        return unit.result(world)


# --- in a batch -----------------------------------------------------------------------------------


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


def is_known(unit: Unit) -> bool:
    """Tell whether all actions of a unit are known beforehand, so that it can be in a batch."""
    return isinstance(as_policy(unit.policy), OpenLoopPolicy) and ALL not in unit.names


def _in_batches(twins: Twins, units: Sequence[Unit], n: int, threads: int) -> Results:
    """Run units together, n at a time."""
    with twins.together(n, units[0].names, threads) as batch:
        for first in range(0, len(units), n):
            some = units[first : first + n]
            try:
                yield from run_together(batch, some)
            except EngineFailure:  # run separately, it ends its own unit only
                yield from (_alone(twins, unit) for unit in some)


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


# --- in processes ---------------------------------------------------------------------------------


def _pays(twins: Twins, units: Sequence[Unit], workers: int) -> bool:
    """Tell whether processes pay, and everything can be sent to them."""
    steps = sum(unit.steps - unit.first for unit in units)
    worth = GOES_ON if twins.has_pool(workers) else PAYS
    if workers < 2 or len(units) < 2 or steps < worth:
        return False
    try:
        pickle.dumps((twins, [_sent(unit) for unit in units]))
    except Exception:  # such as a policy that is a lambda: it acts in this process
        return False
    return True


def _in_processes(twins: Twins, units: Sequence[Unit], workers: int) -> Results:
    """Run units in other processes; yield the results in the order of the units.

    Raises:
        EngineFailure: A process ended.
    """
    size = math.ceil(len(units) / (SHARE * workers))
    jobs = [tuple(map(_sent, units[i : i + size])) for i in range(0, len(units), size)]
    futures = [twins.pool(workers).submit(_run_there, twins, job) for job in jobs]
    try:
        with twins.twin() as world:
            for future in futures:
                yield from (_unpacked(result, world) for result in future.result())
    except BrokenProcessPool:
        twins.close_pool()
        raise EngineFailure("a worker process ended", "the backend of a worker") from None
    finally:
        for future in futures:
            future.cancel()


_THERE: dict[bytes, Twins] = {}
"""In a worker process: the twins that it has, by what was sent."""


def _run_there(twins: Twins, units: Sequence[Unit]) -> list[Any]:
    """Run units in this process for another one, and pack what each leaves behind."""
    kept = _THERE.setdefault(pickle.dumps(twins), twins)
    with kept.twin() as world:
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


# --- equations ------------------------------------------------------------------------------------


def _solved(twins: EquationTwins, units: Sequence[Unit]) -> list[Result]:
    """Run units: together where they can be, else one by one."""
    together = None
    with suppress(Exception):  # run separately, it ends its own unit only
        together = _solved_together(twins, units)
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
    schedules: dict[int, Any] = {id(unit.schedule): unit.schedule for unit in units}
    if (
        not twins.layout.is_vectorised
        or any(unit.first or unit.number != i for unit, i in zip(units, numbers, strict=True))
        or any((unit.seed, unit.steps) != (first.seed, first.steps) for unit in units)
        or not all(isinstance(policy, OpenLoopPolicy) for policy in policies)
        or any(schedule.waits for schedule in schedules.values())
    ):
        return None
    places = {key: group for group, key in enumerate(schedules)}
    groups = [places[id(unit.schedule)] for unit in units]
    actions = np.empty((len(units), first.steps, twins.layout.n_actions))
    for row, policy in enumerate(policies):
        one.reset(seed=first.seed, episode=numbers[row])
        actions[row] = policy.ahead(one, 0, first.steps)  # type: ignore[attr-defined] # OpenLoopPolicy
    grouped = GroupedSchedules(schedules.values())
    unit = replace(
        first, policy=lambda system: actions[:, system.index], names=(), schedule=grouped
    )
    trace = unit.run(Equations(twins.layout, groups))
    return np.stack(trace.vectors, axis=1), actions
