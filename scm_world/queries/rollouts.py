"""Many episodes: together where the engine can, in threads, or one after another.

What comes out depends on nothing of that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

from scm_world.errors import EngineFailure
from scm_world.queries.lockstep import advanced, is_known
from scm_world.queries.stages import Stage, threaded
from scm_world.queries.traces import Trace
from scm_world.queries.units import Unit
from scm_world.work.executors import cores
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
    stage: Stage,
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
        workers: Threads. Where the engine steps many worlds in one call and actions are known
            beforehand these are its own, as many as there are cores if None; else None is one.

    Returns:
        What ``finish`` gave, in the order of the units.
    """
    given = None if workers is None else whole_number("workers", workers, least=1)
    n = _together(stage, units, given or cores())
    if n < LEAST:
        return _apart(stage, units, finish, given or 1)
    found: list[R] = []
    for first in range(0, len(units), n):
        endings = _advanced(stage, units[first : first + n], n, given or cores())
        found += [finish(place, ending) for place, ending in enumerate(endings, first)]
    return found


def _together(stage: Stage, units: Sequence[Unit], threads: int) -> int:
    """Say how many units are worth stepping together.

    Each further world makes a step cheaper by less, and costs the same.
    """
    if not stage.batches or len(units) < LEAST or not is_known(units[0]):
        return 0
    steps = len(units) * (units[0].steps - units[0].first)
    worth = max(math.isqrt(steps * threads // PRICE), stage.at_hand)
    rounds = math.ceil(len(units) / min(worth, MOST)) if worth else 0
    return math.ceil(len(units) / rounds) if rounds else 0


def _advanced(stage: Stage, units: Sequence[Unit], n: int, threads: int) -> list[Ending]:
    try:
        with stage.together(n, units[0].names, threads) as batch:
            return advanced(batch, units)
    except EngineFailure:  # alone, it ends nothing but the unit in which it happens
        return _apart(stage, units, lambda _, ending: ending, 1)


def _apart(
    stage: Stage, units: Sequence[Unit], finish: Callable[[int, Ending], R], workers: int
) -> list[R]:
    def one(place: int) -> R:
        with stage.twin() as world:
            try:
                ending: Ending = units[place].lived(world)
            except Exception as error:
                ending = error
        return finish(place, ending)

    return threaded(one, range(len(units)), workers)
