"""Many episodes: together where the engine can; else in processes, threads, or one by one.

What comes out depends on nothing of that.
"""

from __future__ import annotations

import math
import multiprocessing
from collections.abc import Callable, Generator, Sequence
from contextlib import closing, suppress
from typing import TypeVar

import numpy as np

from scm_world._types import Floats
from scm_world.errors import EngineFailure
from scm_world.queries.courses import Course, Courses
from scm_world.queries.crews import crew, sent
from scm_world.queries.equations import Equations
from scm_world.queries.lockstep import advanced, is_known
from scm_world.queries.stages import AnyStage, EquationStage, Stage, threaded
from scm_world.queries.timed import On
from scm_world.queries.traces import Trace, begin, run
from scm_world.queries.units import Unit
from scm_world.tasks.policies import Blind
from scm_world.work.threads import cores
from scm_world.world.start import whole_number

R = TypeVar("R")

Ending = Trace | Exception
"""What a unit leaves behind, or what stopped it."""

MOST = 64
"""Worlds that are stepped together, at most."""

LEAST = 4
"""Fewer are not worth it."""

PRICE = 32
"""Control steps of one thread that it costs to make a world."""


def lived(
    stage: AnyStage,
    units: Sequence[Unit],
    finish: Callable[[int, Ending], R],
    workers: int | None = None,
) -> list[R]:
    """Let units happen, and do something with what each leaves behind.

    Args:
        stage: Of the world.
        units: All of the same steps, with the same names and kind of policy.
        finish: Told the place of a unit, and how it ended; what it raises is raised. It may be
            called by several threads, in any order.
        workers: Threads, see ``Setting``.

    Returns:
        What ``finish`` gave, in the order of the units.
    """
    if isinstance(stage, EquationStage):
        return [finish(place, ending) for place, ending in enumerate(_solved(stage, units))]
    given = None if workers is None else whole_number("workers", workers, least=1)
    endings = _elsewhere(stage, units, given)
    if endings is None:
        return _apart(stage, units, finish, given or 1)
    with closing(endings):
        return [finish(place, ending) for place, ending in enumerate(endings)]


Endings = Generator[Ending, None, None]


def _elsewhere(stage: Stage, units: Sequence[Unit], workers: int | None) -> Endings | None:
    """Let units happen together, or in processes; None where neither pays."""
    is_child = multiprocessing.parent_process() is not None  # one of many that share the cores
    threads = workers or (1 if is_child else cores())
    n = _together(stage, units, threads)
    if n:
        return _stepped(stage, units, n, threads)
    executor = None if stage.batches else crew(stage, units, workers or 1)
    return None if executor is None else sent(executor, stage, units)


def _together(stage: Stage, units: Sequence[Unit], threads: int) -> int:
    """Say how many units to step together; none if that does not pay.

    Each further world makes a step cheaper by less, and costs the same.
    """
    if not stage.batches or len(units) < LEAST or not is_known(units[0]):
        return 0
    steps = len(units) * (units[0].steps - units[0].first)
    worth = math.isqrt(steps * threads // PRICE)
    if worth < LEAST:
        return 0
    most = min(max(worth, stage.at_hand), MOST)
    return math.ceil(len(units) / math.ceil(len(units) / most))


def _stepped(stage: Stage, units: Sequence[Unit], n: int, threads: int) -> Endings:
    """Let units happen together, some at a time."""
    with stage.together(n, units[0].names, threads) as batch:
        for first in range(0, len(units), n):
            some = units[first : first + n]
            try:
                yield from advanced(batch, some)
            except EngineFailure:  # alone, it ends nothing but the unit in which it happens
                yield from _apart(stage, some, lambda _, ending: ending, 1)


def _apart(
    stage: Stage, units: Sequence[Unit], finish: Callable[[int, Ending], R], workers: int
) -> list[R]:
    def one(place: int) -> R:
        with stage.twin() as world:
            ending = units[place].ended(world)
        return finish(place, ending)

    return threaded(one, range(len(units)), workers)


def _solved(stage: EquationStage, units: Sequence[Unit]) -> list[Trace | Exception]:
    """Run units: together where they can be, else one by one.

    Returns:
        What each leaves behind, or what stopped it.
    """
    try:
        together = _solved_together(stage, units)
    except Exception:  # alone, it ends nothing but the unit in which it happens
        together = None
    if together is None:
        return [unit.ended(Equations(stage.layout)) for unit in units]
    return [
        Trace(
            vectors=list(vectors),
            statics=[(0, {})],
            declarations=[(0, stage.layout)],
            actions=list(actions),
        )
        for vectors, actions in zip(*together, strict=True)
    ]


def paths(stage: EquationStage, units: Sequence[Unit]) -> Floats:
    """Run units, and give all values at all instants, shape (n, steps + 1, size).

    Raises:
        Exception: What stopped a unit.
    """
    with suppress(Exception):  # the unit raises it again
        together = _solved_together(stage, units)
        if together is not None:
            return together[0]
    return np.array([unit.lived(Equations(stage.layout)).vectors for unit in units])


def _solved_together(stage: EquationStage, units: Sequence[Unit]) -> tuple[Floats, Floats] | None:
    """Run units as one, if nothing in them depends on the course of one of them."""
    first, one = units[0], Equations(stage.layout)
    policies = [unit.acts(one) for unit in units] if stage.layout.n_actions else []
    numbers = range(first.number, first.number + len(units))
    if (
        not stage.layout.is_vectorised
        or any(unit.first or unit.number != i for unit, i in zip(units, numbers, strict=True))
        or any((unit.seed, unit.steps) != (first.seed, first.steps) for unit in units)
        or not all(isinstance(policy, Blind) for policy in policies)
    ):
        return None
    keys = [tuple((at, id(plan)) for at, plan in unit.layers) for unit in units]
    kinds = {key: unit.layers for key, unit in zip(keys, units, strict=True)}
    plans = (plan for layers in kinds.values() for _, plan in layers)
    if any(isinstance(part, On) for plan in plans for _, part in plan.timed()):
        return None
    places = {kind: group for group, kind in enumerate(kinds)}
    groups = [places[key] for key in keys]
    actions = np.empty((len(units), first.steps, stage.layout.n_actions))
    for row, policy in enumerate(policies):
        one.reset(seed=first.seed, episode=numbers[row])
        actions[row] = policy.ahead(one, 0, first.steps)  # type: ignore[attr-defined]
    courses, trace = Courses(map(Course, kinds.values())), Trace()
    together = Equations(stage.layout, groups)
    begin(together, first.seed, first.number, courses, trace)

    def acts(system: Equations) -> Floats:
        found: Floats = actions[:, system.index]
        return found

    run(together, trace, courses, acts, first=0, steps=first.steps, begun=True)
    return np.stack(trace.vectors, axis=1), actions
