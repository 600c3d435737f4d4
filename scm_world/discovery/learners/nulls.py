"""A learner of which body acts on which, from worlds in which one is not there.

One body after another is taken away, and the same noise and actions happen again: on whatever then
moves otherwise, the body had an effect. This is exact, and it looks at whole episodes: an effect
may go through others, and may be that something was *not* met.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, final

import numpy as np

from scm_world._types import Floats
from scm_world.discovery.learners.bodies import (
    BUDGET,
    STEPS,
    Given,
    affordable,
    bodies_of,
    fixtures,
    lived,
    matrix_of,
)
from scm_world.discovery.learners.found import Found
from scm_world.errors import ModelError
from scm_world.queries import Episode, Plan, World
from scm_world.queries.local_truth import Pair
from scm_world.variables import Draw, Hard, Null
from scm_world.world.compiled_task import CompiledTask

THRESHOLD = 1e-9  # [m], [rad], [m/s] or [rad/s]; over many steps contacts amplify rounding


@final
@dataclass(frozen=True)
class NullEffect:
    """What a body did to another one, by being there.

    Attributes:
        cause: The body that is taken away.
        effect: The body that moves otherwise.
        first: The first instant at which its state differs by more than the threshold; 0 is the
            beginning.
        size: How far it is elsewhere at most [m]: its center, or the tip of the finger.
    """

    cause: str
    effect: str
    first: int
    size: float


@final
@dataclass(frozen=True)
class NullReport:
    """What became of an episode without one body after another.

    Attributes:
        bodies: Fingers, blocks and obstacles.
        causes: Those that were taken away: all but the fingers, which cannot go.
        effects: In the order of ``causes``.
        changes: The largest difference of any number of the state of each other body, by pair
            [m], [rad], [m/s] or [rad/s]; also of those that are no effects.
        floor: The largest difference where nothing was taken away; 0.0.
        threshold: That a difference of an effect exceeds.
        steps: Control steps that were lived, all worlds together.
    """

    bodies: tuple[str, ...]
    causes: tuple[str, ...]
    effects: tuple[NullEffect, ...]
    changes: Mapping[Pair, float]
    floor: float
    threshold: float
    steps: int


def without(episode: Episode, body: str) -> Episode:
    """Let an episode happen again without a body, with the same noise and actions.

    What the plan did to the body is left out. What it drew for others keeps its value: a draw is
    repeated until it is feasible, and without the body it might be so sooner.

    It is gone from the beginning. Later on, Bullet would have to forget what it keeps of contacts
    that go on, which is a difference of its own.

    Raises:
        InterventionError: The body cannot be taken away.
        UnknownVariable: There is none of this name, or the plan makes others follow it.
    """
    layers = [(start, _plan_without(episode, start, plan, body)) for start, plan in episode.layers]
    stripped = Episode(
        episode.twins,
        seed=episode.seed,
        number=episode.number,
        layers=layers,
        steps=episode.steps,
        trace=episode.trace,
    )
    return stripped.counterfactual({body: Null()})


def _plan_without(episode: Episode, start: int, plan: Plan, body: str) -> Plan:
    kept: dict[str, Any] = {}
    for name in plan:
        if name == body or name.startswith(f"{body}."):
            continue
        target = _drawn(episode, start, plan, name)
        if target is None:
            kept[name] = plan[name]
        else:
            kept[target] = Hard(episode[target][start])
    return Plan(kept)


def _drawn(episode: Episode, start: int, plan: Plan, name: str) -> str | None:
    """Name the quantity that was drawn; in other coordinates it would be rounded once more."""
    audit = episode.audits.get(start)
    applied = {one.variable: one.applied for one in audit.targets.values()} if audit else {}
    if applied.get(name) is None or not isinstance(plan[name][0], Draw) or len(plan[name]) > 1:
        return None  # actions are drawn at every step, with noise of their own
    return _declaration_at(episode, start).model.target(name)


def null_effects(episode: Episode, *, threshold: float = THRESHOLD) -> NullReport:
    """Take one body after another away, and see which others move otherwise.

    Args:
        episode: It is left as it is.
        threshold: That the difference of an effect exceeds, in any number of the state; ten times
            the floor if that is more. The default is measured: see ``docs/body_graphs.md``.

    Raises:
        ModelError: There is no block and no obstacle.
    """
    bodies = bodies_of(episode)
    causes = tuple(body for body in bodies if body not in fixtures(episode))
    if not causes:
        task = episode.twins.task.name
        raise ModelError(
            [f"{task} has no block and no obstacle: there is nothing to take away; fingers stay"]
        )
    same = _differences(episode, episode.counterfactual({}))
    floor = max(float(apart.numbers.max()) for apart in same.values())
    limit = max(threshold, 10.0 * floor)
    changes: dict[Pair, float] = {}
    effects: list[NullEffect] = []
    for cause in causes:
        for effect, apart in _differences(episode, without(episode, cause)).items():
            changes[cause, effect] = float(apart.numbers.max())
            if changes[cause, effect] > limit:
                first = int(np.argmax(apart.numbers > limit))
                effects.append(NullEffect(cause, effect, first, float(apart.places.max())))
    steps = (2 + len(causes)) * episode.steps
    return NullReport(bodies, causes, tuple(effects), changes, floor, limit, steps)


@final
@dataclass(frozen=True)
class _Apart:
    """How far a body is from itself in another world: at each instant, shape (steps + 1,)."""

    numbers: Floats
    places: Floats


def _differences(one: Episode, other: Episode) -> dict[str, _Apart]:
    """Compare each body that both have, while both have it."""
    rows: dict[str, list[tuple[int, float, float]]] = {}
    for at in range(one.steps + 1):
        mine, its = _bodies_at(one, at), _bodies_at(other, at)
        for body in (name for name in mine if name in its):
            rows.setdefault(body, []).append((at, *_apart(mine[body], its[body])))
    found: dict[str, _Apart] = {}
    for body, entries in rows.items():
        table = np.zeros((2, one.steps + 1))
        for at, numbers, place in entries:
            table[:, at] = numbers, place
        found[body] = _Apart(*table)
    return found


def _declaration_at(episode: Episode, step: int) -> CompiledTask:
    declared = reversed(episode.trace.declarations)
    found: CompiledTask = next(one for start, one in declared if start <= step)
    return found


def _apart(mine: _Body, its: _Body) -> tuple[float, float]:
    """Say how far two states of a body are apart: the largest of all numbers, and the place."""
    gap = np.abs(mine.numbers - its.numbers)
    if mine.turn is not None and gap[mine.turn].max() > 1.0:  # q and -q are one orientation
        gap[mine.turn] = np.abs(mine.numbers[mine.turn] + its.numbers[mine.turn])
    place = float(np.linalg.norm(mine.place - its.place))
    return max(float(gap.max()), float(np.abs(mine.place - its.place).max())), place


class _Body(NamedTuple):
    """The state of a body at an instant: all numbers, where its quaternion is, and its place."""

    numbers: Floats
    turn: slice | None
    place: Floats


def _bodies_at(episode: Episode, step: int) -> dict[str, _Body]:
    """Give the state of each body at an instant."""
    vector = episode.trace.vectors[step]
    found = {}
    for mover in _declaration_at(episode, step).composition.movers():
        numbers = np.concatenate([vector[mover.positions], vector[mover.velocities]])
        turn, start = mover.rotation, mover.positions.start
        within = None if turn is None else slice(turn.start - start, turn.stop - start)
        found[mover.name] = _Body(numbers, within, mover.place(vector))
    return found


def null_edges(given: Given, *, threshold: float = THRESHOLD, **setting: Any) -> Found:
    """Find which body has an effect on which in episodes, by taking bodies away.

    Args:
        given: A world, an episode or several.
        threshold: See ``null_effects``, which tells of one episode in meters and instants.
        setting: Of the episodes of a world; see ``lived``.

    Returns:
        A graph over fingers, blocks and obstacles. All edges have lag 1, since effects take time:
        at least one control step, and often many. ``sureness`` is the largest difference over the
        threshold, in powers of ten. Fingers are effects only.

    Raises:
        ModelError: There is nothing to take away.
    """
    episodes = lived(given, **setting)
    return _found(episodes, [null_effects(one, threshold=threshold) for one in episodes])


def _found(episodes: tuple[Episode, ...], reports: list[NullReport]) -> Found:
    names = bodies_of(*episodes)
    shape = (len(names), len(names))
    edges, sureness = np.zeros(shape), np.zeros(shape)
    for report in reports:
        sizes = matrix_of(names, report.changes) / report.threshold
        effects = {(one.cause, one.effect): 1.0 for one in report.effects}
        edges = np.maximum(edges, matrix_of(names, effects))
        sureness = np.maximum(sureness, np.log10(1.0 + sizes))
    floor = max(report.floor for report in reports)
    threshold = max(report.threshold for report in reports)
    return Found.of(
        names,
        edges[None],
        sureness=sureness[None],
        lags=(1,),
        experiments=sum(report.steps for report in reports),
        settings={"threshold": threshold},
        notes=(
            f"floor {floor:g}, threshold {threshold:g}",
            "fingers cannot be taken away: they are effects only",
        ),
    )


def learn_null(
    given: Given, *, seed: int = 0, budget: int = BUDGET, steps: int = STEPS, **settings: Any
) -> Found:
    """Find which body has an effect on which by taking bodies away, as a learner of the registry.

    Args:
        given: A world, an episode or several.
        seed: Of the episodes of a world.
        budget: How many control steps are lived at most, those of all worlds together, but one
            episode at least. An episode with n bodies that can go is lived n + 2 times: as it is,
            again without a change, and without each of them.
        steps: Of each episode of a world.
        settings: See ``null_edges``.
    """
    if isinstance(given, World):
        first = lived(given, policy=None, do=settings.get("do"), seed=seed, steps=1)
        worlds = 2 + len(set(bodies_of(*first)) - fixtures(*first))
        count = affordable(budget, steps, worlds)
        settings |= {"seed": seed, "steps": steps, "episodes": count}
    return null_edges(given, **settings)
