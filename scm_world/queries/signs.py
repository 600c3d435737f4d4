"""The signs of effects on two engines, from probe states made of the same numbers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from scm_world.queries.agreement import Sign
from scm_world.queries.experiments.effects import RESOLUTION, EdgeKey, Response, gap
from scm_world.queries.experiments.paired import Paired
from scm_world.queries.experiments.probes import probes as probe_states
from scm_world.queries.experiments.series import Series
from scm_world.queries.progress import Progress, part
from scm_world.tasks import Task
from scm_world.variables import Measured
from scm_world.world import World

SAME_CHANGE = 1e-9
"""Two changes that differ by less are the same one, as far as ``do`` and reading back can tell."""

Responses = Mapping[tuple[EdgeKey, int], Response]


def compare_signs(
    task: Task | str,
    backends: tuple[str, str],
    probes: int,
    seed: int,
    progress: Progress | None,
    options: Mapping[str, Any],
) -> tuple[Sign, ...]:
    """Experiment on two engines from the same numbers, and compare how effects answer.

    Args:
        task: A task, or the name of one.
        backends: Names of the engines.
        probes: How many states to experiment in.
        seed: Of states and values.
        progress: Called with (finished, planned) after each probe state of each engine.
        options: Arguments of ``World``, without ``backend``.

    Raises:
        KeyboardInterrupt: It was interrupted.
    """
    found: list[Responses] = []
    moves: frozenset[str] = frozenset()
    for number, backend in enumerate(backends):
        told = part(progress, number * probes, len(backends) * probes)
        world = World(task, backend=backend, **options)
        try:
            moves = _moving(world)
            found.append(_responses(world, probes, seed, told))
        finally:
            world.close()
    return tuple(_signs(found[0], found[1], moves))


def _moving(world: World) -> frozenset[str]:
    """Name what the engine decides."""
    every = (v for v in world.model.variables if isinstance(v, Measured))
    return frozenset(v.name for v in every if v.mechanism is None)


def _responses(world: World, probes: int, seed: int, progress: Progress | None) -> Responses:
    series = Series(Paired(world, seed, responses=True), probes, progress)
    series.run(probe_states(world, probes, seed, settled=False))
    if series.done < probes:
        raise KeyboardInterrupt
    return series.effects.responses or {}


def _signs(one: Responses, other: Responses, moves: frozenset[str]) -> Iterator[Sign]:
    for key in sorted(one.keys() & other.keys()):
        (cause, effect, lag), probe = key
        first, second = one[key], other[key]
        if first.change.shape != second.change.shape:
            continue
        if np.abs(first.change - second.change).max() > SAME_CHANGE:
            continue
        component = int(np.argmax(np.abs(first.answer) + np.abs(second.answer)))
        answers = first.answer[component], second.answer[component]
        if not RESOLUTION < min(map(abs, answers)) < np.inf:
            continue
        most = first.change[np.argmax(np.abs(first.change))]
        yield Sign(
            cause=cause,
            effect=effect,
            lag=lag,
            probe=probe,
            component=component,
            moves=effect in moves and lag == 1,
            answers=(float(np.sign(most) * answers[0]), float(np.sign(most) * answers[1])),
            apart=gap(first.base, second.base),
        )
