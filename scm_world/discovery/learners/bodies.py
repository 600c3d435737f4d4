"""A learner of which body acts on which, from what touches in each control step.

It sums up the local graphs of episodes; its counterpart ``nulls`` takes bodies away.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import networkx as nx
import numpy as np

from scm_world._arguments import whole_number
from scm_world._types import Floats
from scm_world.discovery.learners.found import Found
from scm_world.errors import ModelError
from scm_world.queries import Episode, World
from scm_world.queries.local_graphs import LocalEpisode, LocalGraph, local_graph
from scm_world.queries.local_truth import Pair, movers, paired_truth
from scm_world.queries.rollouts import Running, Unit
from scm_world.world import World as Simulated

STEPS = 60  # control steps of an episode, if nothing else is said
BUDGET = 1000  # control steps

Given = World | Episode | Sequence[Episode]
"""Episodes, or a world to live them in."""


def lived(given: Given, **setting: Any) -> tuple[Episode, ...]:
    """Give the episodes, or let them happen on twins of a world.

    Args:
        given: A world, an episode or several.
        setting: Of a world only: ``policy`` (``"random"``) and ``do`` as in ``World.rollout``,
            ``steps`` of each episode (``STEPS``), ``episodes`` (1) and ``seed`` (0). Without
            anything drawn in ``do``, a world begins every episode alike.

    Raises:
        ModelError: It is none of these, or there is a setting for episodes that have happened.
    """
    if isinstance(given, World):
        return _happening(given, **setting)
    found = (given,) if isinstance(given, Episode) else given
    is_list = isinstance(found, Sequence) and len(found) > 0
    if not is_list or not all(isinstance(one, Episode) for one in found):
        raise ModelError([f"bodies are those of a scm_world.World or of episodes, got {given!r}"])
    if setting:
        raise ModelError([f"{', '.join(setting)}: for a World; these episodes have happened"])
    return tuple(found)


def _happening(
    world: World,
    *,
    policy: Any = "random",
    steps: int = STEPS,
    seed: int = 0,
    episodes: int = 1,
    do: Mapping[str, Any] | None = None,
) -> tuple[Episode, ...]:
    return tuple(
        world.rollout(policy, seed=seed, episode=number, steps=steps, do=do)
        for number in range(whole_number("episodes", episodes, least=1))
    )


def bodies_of(*episodes: Episode) -> tuple[str, ...]:
    """Name what cannot be taken away, then all blocks and obstacles that there ever are."""
    there = [d.composition for one in episodes for _, d in one.trace.declarations]
    fixed = (mover.name for made in there for mover in made.movers() if not mover.removable)
    blocks = (name for made in there for name in made.blocks)
    obstacles = (name for made in there for name in made.obstacles)
    return tuple(dict.fromkeys((*fixed, *blocks, *obstacles)))


def fixtures(*episodes: Episode) -> set[str]:
    """Name the bodies that move and cannot be taken away: the fingers of the robot."""
    there = (d.composition for one in episodes for _, d in one.trace.declarations)
    return {mover.name for made in there for mover in made.movers() if not mover.removable}


# --- local graphs, summed up --------------------------------------------------------------------


def local_steps(episode: Episode, *, rule: str = "pressing", truth: bool = False) -> LocalEpisode:
    """Give the local causal graph of every control step of an episode.

    Args:
        episode: It is gone through again, exactly.
        rule: Which contacts count, one of ``queries.local.RULES``.
        truth: Whether to find the graphs by paired experiments instead. They have the rule
            ``"paired"``, and nothing in ``context``: what stands still has no state to vary.

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
            graphs.append(
                _paired(world, action) if truth else local_graph(world, action, rule=rule)
            )
            world.step(action)
    return LocalEpisode(tuple(graphs))


def _paired(world: Simulated, action: Floats) -> LocalGraph:
    edges = paired_truth(world, action).edges
    return LocalGraph(world.index, movers(world), edges, rule="paired")


def reached_over(*worlds: LocalEpisode) -> dict[Pair, int]:
    """Say which body has reached which other one, and at which instant first.

    What has reached a body goes wherever the body acts later. Within a control step the edges of
    all worlds count as if at once: their order in it is not known. So this is an upper limit.

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
) -> Found:
    """Sum up the local graphs of episodes: which body acted on which in any control step.

    Args:
        given: A world, an episode or several.
        rule: See ``local_steps``, which gives the graphs one by one.
        truth: Likewise.
        chained: Whether an edge says that its cause has reached its effect by then, also through
            others in the order of time; see ``reached_over``.
        setting: Of the episodes of a world; see ``lived``.

    Returns:
        A graph over fingers, blocks and obstacles. All edges have lag 1, from one instant to the
        next: two that press on each other act on each other. ``sureness`` is the share of
        control steps at which an edge held.

    Raises:
        ModelError: What is given has no bodies; see ``lived``.
        UnknownOption: There is no such rule.
    """
    episodes = lived(given, **setting)
    names = bodies_of(*episodes)
    held: Counter[Pair] = Counter()
    steps = 0
    for episode in episodes:
        local = local_steps(episode, rule=rule, truth=truth)
        steps += episode.steps
        counts = _chained(local) if chained else _plain(local)
        for pair, count in counts:
            held[pair] += count  # of floor and stage too, which are left out below
    matrix = matrix_of(names, held) / steps
    return Found.of(
        names,
        matrix[None],
        lags=(1,),
        experiments=steps,
        settings={"rule": "paired" if truth else rule, "chained": chained},
    )


def _plain(local: LocalEpisode) -> Iterable[tuple[Pair, int]]:
    return ((pair, 1) for graph in local.graphs for pair in (*graph.edges, *graph.context))


def _chained(local: LocalEpisode) -> Iterable[tuple[Pair, int]]:
    steps = len(local.graphs)
    return ((pair, steps + 1 - first) for pair, first in reached_over(local).items())


def matrix_of(names: Sequence[str], values: Mapping[Pair, float]) -> Floats:
    """Write numbers of pairs as a matrix, shape (p, p); 0 for pairs that have none."""
    return np.array([[float(values.get((c, e), 0.0)) for e in names] for c in names])


def learn_local(
    given: Given, *, seed: int = 0, budget: int = BUDGET, steps: int = STEPS, **settings: Any
) -> Found:
    """Find which body acts on which from what touches, as a learner of the registry.

    Args:
        given: A world, an episode or several.
        seed: Of the episodes of a world.
        budget: How many control steps are watched at most, but one episode at least.
        steps: Of each episode of a world.
        settings: See ``local_edges``.
    """
    if isinstance(given, World):
        settings |= {"seed": seed, "steps": steps, "episodes": affordable(budget, steps)}
    return local_edges(given, **settings)


def affordable(budget: int, steps: int, worlds: int = 1) -> int:
    """Say how many episodes there can be: at least one.

    Args:
        budget: Control steps.
        steps: Of an episode.
        worlds: How often each is lived.
    """
    each = whole_number("steps", steps, least=1) * worlds
    return max(1, whole_number("budget", budget, least=1) // each)
