"""Learners of which body acts on which: from contacts, and from worlds in which one is missing.

``local_edges`` sums up the local graphs of episodes. ``null_edges`` removes one body after another
and runs the episode again with the same noise and actions: the body had an effect on whatever then
moves otherwise. That is exact and about whole episodes: an effect may go through others, and may be
that something was *not* met.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import networkx as nx
import numpy as np

from scm_world._arguments import whole_number
from scm_world._types import Floats
from scm_world.discovery.learners.found import EstimatedGraph
from scm_world.errors import ModelError
from scm_world.queries import Episode, Plan, World
from scm_world.queries.local import LocalEpisode, LocalGraph, local_graph
from scm_world.queries.local_truth import Pair, movers, paired_truth
from scm_world.queries.rollouts import Running, Unit
from scm_world.variables import Draw, Hard, Null
from scm_world.world.compiled_task import CompiledTask

STEPS = 60  # control steps of an episode, if nothing else is said
BUDGET = 1000  # control steps
THRESHOLD = 1e-9  # [m], [rad], [m/s] or [rad/s]; over many steps contacts amplify rounding

Given = World | Episode | Sequence[Episode]
"""Episodes, or a world to run them in."""


def episodes_of(
    given: Given,
    *,
    policy: Any = "random",
    steps: int = STEPS,
    seed: int = 0,
    episodes: int = 1,
    do: Mapping[str, Any] | None = None,
) -> tuple[Episode, ...]:
    """Return the episodes, or run them on twins of a world.

    Args:
        given: A world, an episode or several; the rest is of a world only.
        policy: As in ``World.rollout``.
        steps: Of each episode [control steps].
        seed: Of the noise.
        episodes: How many; without anything drawn in ``do`` they begin alike.
        do: As in ``World.rollout``.

    Raises:
        ModelError: It is none of these.
    """
    if isinstance(given, World):
        return tuple(
            given.rollout(policy, seed=seed, episode=number, steps=steps, do=do)
            for number in range(whole_number("episodes", episodes, least=1))
        )
    found = (given,) if isinstance(given, Episode) else given
    is_list = isinstance(found, Sequence) and len(found) > 0
    if not is_list or not all(isinstance(one, Episode) for one in found):
        raise ModelError([f"bodies are those of a scm_world.World or of episodes, got {given!r}"])
    return tuple(found)


def _episodes(given: Given, setting: Mapping[str, Any]) -> tuple[Episode, ...]:
    found = episodes_of(given, **setting)
    if setting and not isinstance(given, World):
        raise ModelError([f"{', '.join(setting)}: for a World; these are finished episodes"])
    return found


def bodies_of(*episodes: Episode) -> tuple[str, ...]:
    """Return the bodies that cannot be removed, then all blocks and obstacles."""
    there = [d.composition for one in episodes for _, d in one.trace.declarations]
    blocks = (name for made in there for name in made.blocks)
    obstacles = (name for made in there for name in made.obstacles)
    return tuple(dict.fromkeys((*_fixed(*episodes), *blocks, *obstacles)))


def _fixed(*episodes: Episode) -> list[str]:
    """Return the bodies that move and cannot be removed: the fingers of the robot."""
    there = (d.composition for one in episodes for _, d in one.trace.declarations)
    return [mover.name for made in there for mover in made.movers() if not mover.removable]


def _matrix(names: Sequence[str], values: Mapping[Pair, float]) -> Floats:
    """Write numbers of pairs as a matrix, shape (p, p); 0 for pairs that have none."""
    return np.array([[float(values.get((c, e), 0.0)) for e in names] for c in names])


def _affordable(budget: int, steps: int, worlds: int = 1) -> int:
    """Return how many episodes a budget of control steps allows: at least one."""
    each = whole_number("steps", steps, least=1) * worlds
    return max(1, whole_number("budget", budget, least=1) // each)


# --- local graphs, summed up --------------------------------------------------------------------


def local_steps(episode: Episode, *, rule: str = "pressing", truth: bool = False) -> LocalEpisode:
    """Return the local causal graph of every control step of an episode.

    Args:
        episode: It is run again, exactly.
        rule: Which contacts count, one of ``queries.local.RULES``.
        truth: Whether to find the graphs by paired experiments instead. They have the rule
            ``"paired"``, and nothing in ``context``: fixed bodies have no state to vary.

    Raises:
        UnknownOption: There is no such rule.
    """
    graphs: list[LocalGraph] = []
    unit = Unit(episode.seed, episode.number, episode.layers, None, episode.steps)
    with episode.twins.twin() as world:
        running = Running(unit, world)
        running.begin()
        for step, action in enumerate(episode.actions):
            if step:
                running.intervene(step)
            if truth:
                edges = paired_truth(world, action).edges
                graphs.append(LocalGraph(world.index, movers(world), edges, rule="paired"))
            else:
                graphs.append(local_graph(world, action, rule=rule))
            world.step(action)
    return LocalEpisode(tuple(graphs))


def reached_over(*worlds: LocalEpisode) -> dict[Pair, int]:
    """Return which body has reached which other one, and at which instant first.

    What has reached a body goes wherever the body acts later. Within a control step the edges of
    all worlds count as if contemporaneous: their order in it is not known. So this is an upper
    limit.

    Args:
        worlds: One, or parallel ones of as many control steps: together they say where a
            difference between them can have got to.
    """
    causes: dict[str, set[str]] = {}
    first: dict[Pair, int] = {}
    for at, graphs in enumerate(zip(*(one.graphs for one in worlds), strict=True), start=1):
        edges = nx.DiGraph([pair for one in graphs for pair in (*one.edges, *one.context)])
        before = {body: causes.get(body, {body}) for body in edges}
        for effect in edges:
            found = before[effect].union(*(before[c] for c in nx.ancestors(edges, effect)))
            for cause in found - before[effect]:
                first[cause, effect] = at
            causes[effect] = found
    return {pair: at for pair, at in first.items() if pair[0] != pair[1]}


def local_edges(
    given: Given,
    *,
    rule: str = "pressing",
    truth: bool = False,
    chained: bool = False,
    **setting: Any,
) -> EstimatedGraph:
    """Sum up the local graphs of episodes: which body acted on which in any control step.

    Args:
        given: A world, an episode or several.
        rule: See ``local_steps``.
        truth: See ``local_steps``.
        chained: Whether an edge says that its cause has reached its effect by then, also through
            others in the order of time; see ``reached_over``.
        setting: Of the episodes of a world; see ``episodes_of``.

    Returns:
        A graph over fingers, blocks and obstacles. All edges have lag 1: two that press on each
        other act on each other. ``edge_scores`` are shares of control steps at which an edge held.

    Raises:
        ModelError: What is given has no bodies, or there is a setting for finished episodes.
        UnknownOption: There is no such rule.
    """
    episodes = _episodes(given, setting)
    names = bodies_of(*episodes)
    held: Counter[Pair] = Counter()  # of floor and stage too, which have no place in the matrix
    steps = 0
    for episode in episodes:
        local = local_steps(episode, rule=rule, truth=truth)
        steps += episode.steps
        if chained:
            held.update({p: episode.steps + 1 - at for p, at in reached_over(local).items()})
        else:
            held.update(pair for one in local.graphs for pair in (*one.edges, *one.context))
    return EstimatedGraph.of(
        names,
        _matrix(names, held)[None] / steps,
        lags=(1,),
        experiments=steps,
        settings={"rule": "paired" if truth else rule, "chained": chained},
    )


def learn_local(
    given: Given, *, seed: int = 0, budget: int = BUDGET, steps: int = STEPS, **settings: Any
) -> EstimatedGraph:
    """Run ``local_edges`` as a learner of the registry.

    Args:
        given: A world, an episode or several.
        seed: Of the episodes of a world.
        budget: How many control steps are watched at most, but one episode at least.
        steps: Of each episode of a world.
        settings: See ``local_edges``.
    """
    if isinstance(given, World):
        settings |= {"seed": seed, "steps": steps, "episodes": _affordable(budget, steps)}
    return local_edges(given, **settings)


# --- removals -----------------------------------------------------------------------------------


@final
@dataclass(frozen=True)
class NullEffect:
    """What a body did to another one, by being there.

    Attributes:
        cause: The body that is removed.
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
    """The differences between an episode and itself without one body after another.

    Attributes:
        bodies: Fingers, blocks and obstacles.
        causes: Those that were removed: all but the fingers, which cannot be.
        effects: In the order of ``causes``.
        changes: The largest difference of any number of the state of each other body, by pair
            [m], [rad], [m/s] or [rad/s]; also of those that are no effects.
        floor: The largest difference where nothing was removed; 0.0.
        threshold: That a difference of an effect exceeds.
        steps: Control steps of all runs together.
    """

    bodies: tuple[str, ...]
    causes: tuple[str, ...]
    effects: tuple[NullEffect, ...]
    changes: Mapping[Pair, float]
    floor: float
    threshold: float
    steps: int


def without(episode: Episode, body: str) -> Episode:
    """Run an episode again without a body, with the same noise and actions.

    What the plan did to the body is left out. What it drew for others keeps its value: a draw is
    repeated until it is feasible, and without the body it might be so sooner.

    The body is gone from the beginning. Later on, Bullet would have to forget what it keeps of
    contacts that go on, which is a difference of its own.

    Raises:
        InterventionError: The body cannot be removed.
        UnknownVariable: There is none of this name, or the plan makes others follow it.
    """
    layers = []
    for start, plan in episode.layers:
        audit = episode.audits.get(start)
        applied = {one.variable: one.applied for one in audit.targets.values()} if audit else {}
        kept: dict[str, Any] = {}
        for name in plan:
            if name == body or name.startswith(f"{body}."):
                continue
            drawn = isinstance(plan[name][0], Draw) and len(plan[name]) == 1
            if drawn and applied.get(name) is not None:
                # The quantity itself: in other coordinates it would be rounded once more.
                target = _declaration_at(episode, start).model.target(name)
                kept[target] = Hard(episode[target][start])
            else:  # actions are drawn at every step, with noise of their own
                kept[name] = plan[name]
        layers.append((start, Plan(kept)))
    unit = Unit(episode.seed, episode.number, tuple(layers), None, episode.steps)
    return Episode(episode.twins, unit, episode.trace).counterfactual({body: Null()})


def null_effects(episode: Episode, *, threshold: float = THRESHOLD) -> NullReport:
    """Remove one body after another, and find which others move otherwise.

    Args:
        episode: It is left as it is.
        threshold: That the difference of an effect exceeds, in any number of the state; ten times
            the floor if that is more. The default is measured: see ``docs/body_graphs.md``.

    Raises:
        ModelError: There is no block and no obstacle.
    """
    bodies, fixed = bodies_of(episode), _fixed(episode)
    causes = tuple(body for body in bodies if body not in fixed)
    if not causes:
        task = episode.twins.task.name
        raise ModelError(
            [f"{task} has no block and no obstacle: there is nothing to take away; fingers stay"]
        )
    same = _differences(episode, episode.counterfactual({}))
    floor = max(float(numbers.max()) for numbers, _ in same.values())
    limit = max(threshold, 10.0 * floor)
    changes: dict[Pair, float] = {}
    effects: list[NullEffect] = []
    for cause in causes:
        for effect, (numbers, places) in _differences(episode, without(episode, cause)).items():
            changes[cause, effect] = float(numbers.max())
            if changes[cause, effect] > limit:
                first = int(np.argmax(numbers > limit))
                effects.append(NullEffect(cause, effect, first, float(places.max())))
    steps = (2 + len(causes)) * episode.steps
    return NullReport(bodies, causes, tuple(effects), changes, floor, limit, steps)


def _differences(one: Episode, other: Episode) -> dict[str, Floats]:
    """Compare each body that both have: of all numbers and of the place, shape (2, steps + 1)."""
    found: dict[str, Floats] = {}
    for at in range(one.steps + 1):
        mine, its = one.trace.vectors[at], other.trace.vectors[at]
        there = {m.name: m for m in _declaration_at(other, at).composition.movers()}
        for mover in _declaration_at(one, at).composition.movers():
            if mover.name not in there:
                continue
            twin = there[mover.name]
            gaps = [np.abs(mine[mover.positions] - its[twin.positions])]
            if mover.rotation is not None and twin.rotation is not None:
                turn, start = mover.rotation, mover.positions.start
                part = slice(turn.start - start, turn.stop - start)
                if gaps[0][part].max() > 1.0:  # q and -q are one orientation
                    gaps[0][part] = np.abs(mine[turn] + its[twin.rotation])
            gaps.append(np.abs(mine[mover.velocities] - its[twin.velocities]))
            away = mover.place(mine) - twin.place(its)
            gaps.append(np.abs(away))
            table = found.setdefault(mover.name, np.zeros((2, one.steps + 1)))
            table[:, at] = np.concatenate(gaps).max(), np.linalg.norm(away)
    return found


def _declaration_at(episode: Episode, step: int) -> CompiledTask:
    declared = reversed(episode.trace.declarations)
    found: CompiledTask = next(one for start, one in declared if start <= step)
    return found


def null_edges(given: Given, *, threshold: float = THRESHOLD, **setting: Any) -> EstimatedGraph:
    """Find which body has an effect on which in episodes, by removing bodies.

    Args:
        given: A world, an episode or several.
        threshold: See ``null_effects``, which reports one episode in meters and instants.
        setting: Of the episodes of a world; see ``episodes_of``.

    Returns:
        A graph over fingers, blocks and obstacles. All edges have lag 1, since effects take time:
        at least one control step, and often many. ``edge_scores`` are the largest differences over
        the threshold, in powers of ten. Fingers are effects only.

    Raises:
        ModelError: There is nothing to remove, or a setting for finished episodes.
    """
    episodes = _episodes(given, setting)
    reports = [null_effects(one, threshold=threshold) for one in episodes]
    names = bodies_of(*episodes)
    edges = np.zeros((len(names), len(names)))
    edge_scores = edges.copy()
    for report in reports:
        effects = {(one.cause, one.effect): 1.0 for one in report.effects}
        edges = np.maximum(edges, _matrix(names, effects))
        sizes = _matrix(names, report.changes) / report.threshold
        edge_scores = np.maximum(edge_scores, np.log10(1.0 + sizes))
    floor = max(report.floor for report in reports)
    limit = max(report.threshold for report in reports)
    return EstimatedGraph.of(
        names,
        edges[None],
        edge_scores=edge_scores[None],
        lags=(1,),
        experiments=sum(report.steps for report in reports),
        settings={"threshold": limit},
        notes=(
            f"floor {floor:g}, threshold {limit:g}",
            "fingers cannot be taken away: they are effects only",
        ),
    )


def learn_null(
    given: Given, *, seed: int = 0, budget: int = BUDGET, steps: int = STEPS, **settings: Any
) -> EstimatedGraph:
    """Run ``null_edges`` as a learner of the registry.

    Args:
        given: A world, an episode or several.
        seed: Of the episodes of a world.
        budget: How many control steps are run at most, all worlds together, but one episode at
            least. An episode with n removable bodies is run n + 2 times: as it is, again without a
            change, and without each of them.
        steps: Of each episode of a world.
        settings: See ``null_edges``.
    """
    if isinstance(given, World):
        first = episodes_of(given, policy=None, do=settings.get("do"), seed=seed, steps=1)
        worlds = 2 + len(set(bodies_of(*first)) - set(_fixed(*first)))
        count = _affordable(budget, steps, worlds)
        settings |= {"seed": seed, "steps": steps, "episodes": count}
    return null_edges(given, **settings)
