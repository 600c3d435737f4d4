"""Which body acts on which in one control step: the causal graph that holds here and now.

The graph of a world says what *can* act on what: everything that can touch. In one control step
only what does touch acts, directly or through others. Bodies that touch one another in a physics
step are an *island*; what stands still for good (floor, stage, obstacles) passes nothing on. A
control step is several physics steps, so that X acts on Y if a chain of islands leads from X to Y
in the order of time: what reaches a body only after it has let go of Y does not reach Y.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, final

import networkx as nx

from scm_world._types import ArrayLike
from scm_world.backends.base import Contact
from scm_world.errors import UnknownOption
from scm_world.queries.local_truth import Pair, listening, movers, rehearse
from scm_world.world import World

GRAPH_FORMAT = "scm_world/local_graphs/1"

Touching = Sequence[Sequence[Contact]]
"""The contacts of each physics step of a control step."""

Policy = Callable[[World], ArrayLike] | Sequence[ArrayLike]
"""A function of the world that gives an action, or the actions themselves."""


# --- the rule -----------------------------------------------------------------------------------


def body_of(name: str, bodies: Iterable[str]) -> str:
    """Say to which body a link belongs: ``"x_link_1"`` is a part of ``"x"``."""
    return next((body for body in bodies if name.startswith(f"{body}_link_")), name)


def islands(bodies: Iterable[str], contacts: Iterable[Contact]) -> list[set[str]]:
    """Part movable bodies into those that touch, directly or through other movable bodies."""
    graph = nx.Graph()
    graph.add_nodes_from(bodies)
    for contact in contacts:
        first, second = (body_of(name, graph) for name in contact.bodies)
        if first in graph and second in graph:
            graph.add_edge(first, second)
    return list(nx.connected_components(graph))


def reached(bodies: Sequence[str], steps: Touching) -> dict[str, set[str]]:
    """Say from which bodies each body can have been reached at the end, itself included.

    In each physics step, what has reached one body of an island reaches all of it.
    """
    causes = {body: {body} for body in bodies}
    for contacts in steps:
        for island in islands(bodies, contacts):
            if len(island) > 1:
                together = set().union(*(causes[body] for body in island))
                causes.update((body, together) for body in island)
    return causes


def predicted(bodies: Sequence[str], steps: Touching) -> tuple[Pair, ...]:
    """List which body acts on which other body, sorted."""
    found = reached(bodies, steps)
    return tuple(sorted((c, e) for e, causes in found.items() for c in causes if c != e))


def _held(bodies: Sequence[str], steps: Touching) -> tuple[Pair, ...]:
    """List what stands still, with each body that it touches."""
    pairs = {
        tuple(body_of(name, bodies) for name in contact.bodies)
        for step in steps
        for contact in step
    }
    fixed = {(a, b) if b in bodies else (b, a) for a, b in pairs if (a in bodies) != (b in bodies)}
    return tuple(sorted(fixed))


def _pressing(steps: Touching) -> Touching:
    return [[contact for contact in step if contact.force > 0.0] for step in steps]


def _union(steps: Touching) -> Touching:
    return [[contact for step in steps for contact in step]]


RULES: Mapping[str, Callable[[Touching], Touching]] = {
    "pressing": _pressing,
    "listed": lambda steps: steps,
    "pressing, unordered": lambda steps: _union(_pressing(steps)),
    "listed, unordered": _union,
    "pressing, last": lambda steps: _pressing(steps)[-1:],
    "listed, last": lambda steps: steps[-1:],
}
"""Which contacts count, by the name of the rule.

``listed`` takes all contacts, ``pressing`` those with a normal force. Physics steps are taken in
their order, or all as if at once (``unordered``), or only the last one is (``last``).
"""


# --- graphs -------------------------------------------------------------------------------------


@final
@dataclass(frozen=True)
class LocalGraph:
    """Which body acts on which other body in one control step.

    Attributes:
        index: The control step at whose beginning the causes are; the effects are one later.
        bodies: Those that can move. Each acts on itself; this is not listed.
        edges: Pairs of bodies, sorted: the first acts on the second.
        context: What stands still (floor, stage, obstacles), with each body that it touches.
        rule: Which contacts count, one of ``RULES``.
    """

    index: int
    bodies: tuple[str, ...]
    edges: tuple[Pair, ...]
    context: tuple[Pair, ...] = ()
    rule: str = "pressing"

    def graph(self) -> nx.DiGraph:
        """Draw it. Nodes carry ``moves``; what stands still points at what it touches."""
        graph = nx.DiGraph(index=self.index, rule=self.rule)
        graph.add_nodes_from(self.bodies, moves=True)
        graph.add_nodes_from(sorted({fixed for fixed, _ in self.context}), moves=False)
        graph.add_edges_from((*self.edges, *self.context))
        return graph

    def parents(self, body: str) -> tuple[str, ...]:
        """Name the other bodies that act on a body."""
        return tuple(cause for cause, effect in self.edges if effect == body)

    def as_dict(self) -> dict[str, Any]:
        """Write the graph as plain data."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> LocalGraph:
        """Read what ``as_dict`` wrote, also after it has been JSON."""
        edges, context = (tuple((a, b) for a, b in data[name]) for name in ("edges", "context"))
        return cls(data["index"], tuple(data["bodies"]), edges, context, data["rule"])


def _graph(world: World, index: int, steps: Touching, rule: str) -> LocalGraph:
    if rule not in RULES:
        raise UnknownOption("rule", rule, RULES)
    bodies, chosen = movers(world), RULES[rule](steps)
    return LocalGraph(index, bodies, predicted(bodies, chosen), _held(bodies, chosen), rule)


def local_graph(
    world: World, action: ArrayLike | None = None, *, rule: str = "pressing"
) -> LocalGraph:
    """Predict from contacts which body acts on which other body.

    Args:
        world: It is left as it is, bit for bit.
        action: Of the coming control step, which is rehearsed to see what touches in each of its
            physics steps. If None, the graph is that of the last physics step: all that an
            engine remembers of the past.
        rule: Which contacts count, one of ``RULES``.

    Raises:
        ActionError: Wrong shape, or a number that is not finite.
        NotReset: There is no episode yet.
        UnknownOption: There is no such rule.

    Example:
        >>> world = World("pushing")
        >>> world.reset(seed=0)
        >>> world.step(world["joint_positions"])
        >>> found = local_graph(world, world["joint_positions"])
        >>> found.edges, found.context
        ((), (('floor', 'tool_block'),))
    """
    if action is None:
        world.snapshot()  # raises NotReset
        return _graph(world, world.index - 1, (world.backend.contacts(),), rule)
    return _graph(world, world.index, rehearse(world, action).contacts, rule)


@final
@dataclass(frozen=True)
class LocalEpisode:
    """The local graphs of some control steps in a row.

    Attributes:
        graphs: One for each control step.
    """

    graphs: tuple[LocalGraph, ...]

    def unrolled(self) -> nx.DiGraph:
        """Draw all steps, with an arrow from ``(cause, t)`` to ``(effect, t + 1)``.

        Returns:
            A directed acyclic graph. Every body points at itself one step later. What stands
            still has no state and is left out.
        """
        drawn = nx.DiGraph()
        for graph in self.graphs:
            t = graph.index
            for slice_ in (t, t + 1):
                drawn.add_nodes_from((body, slice_) for body in graph.bodies)
            drawn.add_edges_from(((body, t), (body, t + 1)) for body in graph.bodies)
            drawn.add_edges_from(((cause, t), (effect, t + 1)) for cause, effect in graph.edges)
        return drawn

    def as_dict(self) -> dict[str, Any]:
        """Write the graphs as plain data."""
        return {"format": GRAPH_FORMAT, "graphs": [graph.as_dict() for graph in self.graphs]}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> LocalEpisode:
        """Read what ``as_dict`` wrote, also after it has been JSON."""
        return cls(tuple(map(LocalGraph.from_dict, data["graphs"])))

    def save(self, path: Path) -> None:
        """Write the graphs as JSON, whole or not at all."""
        save_json(path, self.as_dict())


def save_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write plain data as JSON, whole or not at all."""
    part = path.with_suffix(".part")
    part.write_text(json.dumps(data, indent=1) + "\n")
    part.replace(path)


def action_of(policy: Policy, world: World, step: int) -> ArrayLike:
    """Ask a policy for the action of a step."""
    return policy(world) if callable(policy) else policy[step]


def local_episode(
    world: World, policy: Policy, steps: int, *, rule: str = "pressing"
) -> LocalEpisode:
    """Play some control steps, note the local graph of each, and go back.

    Args:
        world: It is left as it is, bit for bit.
        policy: A function of the world, or at least ``steps`` actions.
        steps: How many control steps.
        rule: Which contacts count, one of ``RULES``.
    """
    before, graphs = world.snapshot(), []
    try:
        for step in range(steps):
            index, action = world.index, action_of(policy, world, step)
            with listening(world) as heard:
                world.step(action)
            graphs.append(_graph(world, index, heard.contacts, rule))
    finally:
        world.restore(before)
    return LocalEpisode(tuple(graphs))
