"""Which body acts on which in one control step: the causal graph that holds here and now.

The graph of a world says what *can* act on what: everything that can touch. In one control step
only what does touch acts, directly or through others. Bodies that touch one another in a physics
step are an *island*; what stands still for good (floor, stage, obstacles) passes nothing on. A
control step is several physics steps, so that X acts on Y if a chain of islands leads from X to Y
in the order of time: what reaches a body only after it has let go of Y does not reach Y.

``local_graph`` predicts it from what touches, ``paired_truth`` finds it by experiment, and
``local_report`` compares the two.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from time import perf_counter
from typing import Any, final

import networkx as nx
from pydantic import TypeAdapter

from scm_world._types import ArrayLike
from scm_world.backends.base import Contact
from scm_world.errors import UnknownOption
from scm_world.output.durable import write_whole
from scm_world.queries.local_truth import (
    LocalTruth,
    Pair,
    listening,
    movers,
    paired_truth,
    rehearse,
)
from scm_world.world import World

__all__ = [
    "RULES",
    "LocalEpisode",
    "LocalGraph",
    "LocalReport",
    "LocalTruth",
    "RuleScore",
    "local_episode",
    "local_graph",
    "local_report",
    "paired_truth",
]

GRAPH_FORMAT = "scm_world/local_graphs/1"
REPORT_FORMAT = "scm_world/local_report/1"

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
        return TypeAdapter(cls).validate_python(data)


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
        return TypeAdapter(cls).validate_python(data)

    def save(self, path: Path) -> None:
        """Write the graphs as JSON, whole or not at all."""
        write_whole(json.dumps(self.as_dict(), indent=1) + "\n", path)


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


# --- how sure it is ------------------------------------------------------------------------------


@final
@dataclass(frozen=True)
class RuleScore:
    """How often a rule is right, counted over all ordered pairs of bodies and all steps.

    Attributes:
        right: Predicted and true.
        extra: Predicted but not true.
        missed: True but not predicted.
    """

    right: int = 0
    extra: int = 0
    missed: int = 0

    @property
    def precision(self) -> float:
        """Predicted edges that are true, as a fraction; 1 if none was predicted."""
        return self.right / (self.right + self.extra) if self.right + self.extra else 1.0

    @property
    def recall(self) -> float:
        """True edges that were predicted, as a fraction; 1 if there is none."""
        return self.right / (self.right + self.missed) if self.right + self.missed else 1.0

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall; 1 if nothing was predicted and nothing is true."""
        wrong = self.extra + self.missed
        return 2 * self.right / (2 * self.right + wrong) if self.right + wrong else 1.0

    def __add__(self, other: RuleScore) -> RuleScore:
        return RuleScore(
            self.right + other.right, self.extra + other.extra, self.missed + other.missed
        )


@final
@dataclass(frozen=True)
class LocalReport:
    """What contacts predict, held against paired experiments, over an episode.

    Attributes:
        task: Name of the task.
        backend: Name and version of the engine.
        steps: Control steps that were compared.
        pairs: Ordered pairs of bodies that were compared.
        scores: By the name of the rule, with the contacts of the very step that the experiments
            vary: the one from the scene built anew.
        own_scores: The same with the contacts of the world itself, as ``local_graph`` sees them.
            They differ where an engine remembers more than the scene.
        floor: Largest change where nothing was changed; 0.0.
        rollouts: Control steps simulated in an experiment of their own.
        seconds: Wall time.
        errors: Where rule ``pressing`` or ``listed`` is wrong in ``scores``: rule, control step,
            cause, effect and size of the effect.
    """

    task: str
    backend: str
    steps: int
    pairs: int
    scores: dict[str, RuleScore]
    own_scores: dict[str, RuleScore]
    floor: float
    rollouts: int
    seconds: float
    errors: tuple[tuple[str, int, str, str, float], ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Write the report as plain data."""
        rates = ("precision", "recall", "f1")
        scores = {
            kind: {
                rule: {**asdict(score), **{rate: getattr(score, rate) for rate in rates}}
                for rule, score in getattr(self, kind).items()
            }
            for kind in ("scores", "own_scores")
        }
        return {"format": REPORT_FORMAT, **asdict(self), **scores}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> LocalReport:
        """Read what ``as_dict`` wrote, also after it has been JSON."""
        return TypeAdapter(cls).validate_python(data)

    def save(self, path: Path) -> None:
        """Write the report as JSON, whole or not at all."""
        write_whole(json.dumps(self.as_dict(), indent=1) + "\n", path)

    def __str__(self) -> str:
        found = ", ".join(f"{name} {score.f1:.3f}" for name, score in self.scores.items())
        return f"{self.task} on {self.backend}, {self.steps} steps, F1: {found}"


def local_report(world: World, policy: Policy, steps: int, *, every: int = 1) -> LocalReport:
    """Compare local graphs with paired experiments over an episode, and go back.

    Args:
        world: It is left as it is, bit for bit.
        policy: A function of the world, or at least ``steps`` actions.
        steps: How many control steps are played.
        every: One of how many is compared.
    """
    began, before, bodies = perf_counter(), world.snapshot(), movers(world)
    truths: list[LocalTruth] = []
    scores, own_scores = (dict.fromkeys(RULES, RuleScore()) for _ in range(2))
    errors: list[tuple[str, int, str, str, float]] = []
    try:
        for step in range(steps):
            action, index = action_of(policy, world, step), world.index
            truth = paired_truth(world, action) if step % every == 0 else None
            with listening(world) as heard:
                world.step(action)
            if truth is None:
                continue
            truths.append(truth)
            true = set(truth.edges)
            both = ((scores, truth.contacts), (own_scores, heard.contacts))
            for (of, seen), rule in product(both, RULES):
                said = set(predicted(bodies, RULES[rule](seen)))
                of[rule] += RuleScore(len(said & true), len(said - true), len(true - said))
                if of is scores and rule in ("pressing", "listed"):
                    errors += [(rule, index, *p, truth.effects[p]) for p in sorted(said ^ true)]
    finally:
        world.restore(before)
    return LocalReport(
        task=world.task.name,
        backend=f"{world.backend.name} {world.backend.version}",
        steps=len(truths),
        pairs=len(truths) * len(bodies) * (len(bodies) - 1),
        scores=scores,
        own_scores=own_scores,
        floor=max((truth.floor for truth in truths), default=0.0),
        rollouts=sum(truth.rollouts for truth in truths),
        seconds=perf_counter() - began,
        errors=tuple(errors),
    )
