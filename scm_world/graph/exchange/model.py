"""A causal graph as plain text: what every format writes, and what every reader gives back."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, final

import networkx as nx

from scm_world.errors import ModelError
from scm_world.graph.exchange.spaces import space_lines
from scm_world.graph.scm import SCM
from scm_world.graph.structure import Edge
from scm_world.variables import Variable

DIGITS = 6  # of a number in the text of a space


@final
@dataclass(frozen=True)
class Node:
    """A variable in words; what is not known is empty.

    Attributes:
        name: ``"<entity>.<quantity>"``.
        kind: ``"exogenous"``, ``"derived"``, ``"measured"``, ``"action"`` or ``"fixed"``.
        role: ``"parameter"``, ``"state"``, ``"readout"`` or ``"action"``.
        unit: SI unit; ``"1"`` for a pure number.
        value_shape: Of one value, ``"3"`` or ``"2x3"``.
        bounds: What is physically possible, with six digits.
        a: The training space.
        b: The held-out space.
        doc: One sentence.
    """

    name: str
    kind: str = ""
    role: str = ""
    unit: str = ""
    value_shape: str = ""
    bounds: str = ""
    a: str = ""
    b: str = ""
    doc: str = ""

    @property
    def attributes(self) -> dict[str, str]:
        """What is known besides the name."""
        return {name: text for name in ATTRIBUTES if (text := getattr(self, name))}


ATTRIBUTES = tuple(field.name for field in fields(Node) if field.name != "name")


@final
@dataclass(frozen=True)
class CausalGraph:
    """Nodes and lagged edges, without mechanisms. Equal if nodes and edges are.

    Args:
        nodes: In any order, which is kept.
        edges: In any order; they are sorted.

    Raises:
        ModelError: With every problem: names twice, edges to nowhere or twice, text that is
            not printable.

    Example:
        >>> CausalGraph((Node("x"), Node("y")), (Edge("x", "y", 1),)).parents("y")
        (Edge(cause='x', effect='y', lag=1, when=None),)
    """

    nodes: tuple[Node, ...]
    edges: tuple[Edge, ...]

    def __post_init__(self) -> None:
        if problems := [*_node_problems(self.nodes), *_edge_problems(self.nodes, self.edges)]:
            raise ModelError(problems)
        object.__setattr__(self, "edges", tuple(sorted(self.edges, key=lambda edge: edge.key)))

    @property
    def names(self) -> tuple[str, ...]:
        """All names, in order."""
        return tuple(node.name for node in self.nodes)

    @property
    def max_lag(self) -> int:
        """The longest lag [control steps]."""
        return max((edge.lag for edge in self.edges), default=0)

    @cached_property
    def _into(self) -> dict[str, list[Edge]]:
        into: dict[str, list[Edge]] = {}
        for edge in self.edges:
            into.setdefault(edge.effect, []).append(edge)
        return into

    def parents(self, name: str) -> tuple[Edge, ...]:
        """Give the edges into a node."""
        return tuple(self._into.get(name, ()))

    @property
    def held(self) -> frozenset[str]:
        """Parameters without causes: they keep their value from one step to the next."""
        return frozenset(
            node.name
            for node in self.nodes
            if node.role == "parameter" and not self.parents(node.name)
        )

    def check_acyclic(self, format_: str, *, lag: int | None = None) -> None:
        """Refuse a graph that some format cannot hold, looking at edges of one lag or of all.

        Raises:
            ModelError: Its edges form a cycle.
        """
        graph = nx.DiGraph((e.cause, e.effect) for e in self.edges if lag in (None, e.lag))
        if not nx.is_directed_acyclic_graph(graph):
            cycle = [cause for cause, _ in nx.find_cycle(graph)]
            path = " → ".join([*cycle, cycle[0]])
            raise ModelError(
                [f"{format_} holds acyclic graphs only, and there is {path}; try view='two_slice'"]
            )


def _node_problems(nodes: Iterable[Node]) -> Iterable[str]:
    seen: set[str] = set()
    for node in nodes:
        if node.name in seen:
            yield f"{node.name!r} is there twice"
        seen.add(node.name)
        if not node.name:
            yield "a node has no name"
        for field, text in (("name", node.name), *node.attributes.items()):
            if not text.isprintable():
                yield f"the {field} of {node.name!r} is not printable: {text!r}"


def _edge_problems(nodes: Iterable[Node], edges: Iterable[Edge]) -> Iterable[str]:
    known = {node.name for node in nodes}
    seen: set[tuple[str, str, int]] = set()
    for edge in edges:
        for name in (edge.cause, edge.effect):
            if name not in known:
                yield f"the edge {edge.cause!r} → {edge.effect!r} has the unknown node {name!r}"
        if edge.key in seen:
            yield f"the edge {edge.cause!r} → {edge.effect!r}, lag {edge.lag}, is there twice"
        seen.add(edge.key)
        if edge.lag < 0:
            yield f"the edge {edge.cause!r} → {edge.effect!r} has the lag {edge.lag}"
        if edge.when is not None and not (edge.when and edge.when.isprintable()):
            yield f"the condition {edge.when!r} of {edge.cause!r} → {edge.effect!r} is no text"


def causal_graph(source: SCM | CausalGraph) -> CausalGraph:
    """Write a model as a plain graph; interventions on it are seen as cut edges.

    Example:
        >>> from scm_world.variables import Derived, Exogenous, Linear
        >>> model = SCM([
        ...     Exogenous(name="mass", unit="kg"),
        ...     Derived(name="weight", unit="N", parents=("mass",),
        ...             mechanism=Linear(weights=(9.81,))),
        ... ])
        >>> causal_graph(model).names, len(causal_graph(model.do({"weight": 1.0})).edges)
        (('mass', 'weight'), 0)
    """
    if isinstance(source, CausalGraph):
        return source
    return CausalGraph(tuple(_node(source[name]) for name in source), source.edges)


def _node(variable: Variable) -> Node:
    given: Any = variable
    bounds, a, b = (
        ", ".join(space_lines(space, digits=DIGITS))
        for space in (variable.bounds, variable.a, variable.b)
    )
    return Node(
        name=variable.name,
        kind=given.kind,
        role=variable.role,
        unit=variable.unit,
        value_shape="x".join(map(str, variable.shape)),
        bounds=bounds,
        a=a,
        b=b,
        doc=" ".join(variable.doc.split()),
    )


def edge_attributes(edge: Edge) -> dict[str, Any]:
    """Give the lag, and the condition if there is one."""
    return {"lag": edge.lag} | ({} if edge.when is None else {"when": edge.when})


def from_parts(
    nodes: Iterable[tuple[Any, Mapping[str, Any]]],
    edges: Iterable[tuple[Any, Any, Mapping[str, Any]]],
) -> CausalGraph:
    """Make a graph of names and attributes; those that mean nothing here are left out.

    Raises:
        ValueError: A lag is no whole number, or see ``CausalGraph``.
    """
    return CausalGraph(
        tuple(
            Node(str(name), **{key: str(data[key]) for key in ATTRIBUTES if key in data})
            for name, data in nodes
        ),
        tuple(_edge(str(cause), str(effect), data) for cause, effect, data in edges),
    )


def _edge(cause: str, effect: str, data: Mapping[str, Any]) -> Edge:
    lag, when = data.get("lag", 0), data.get("when")
    try:
        number = float(str(lag))
    except ValueError:
        number = 0.5
    if not number.is_integer():
        raise ValueError(f"the lag {lag!r} of {cause!r} → {effect!r} is no whole number")
    return Edge(cause, effect, int(number), str(when) if when else None)
