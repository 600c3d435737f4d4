"""Causal graphs as plain text: what every format writes, and what every reader returns."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Literal, final, get_args

import networkx as nx

from scm_world.errors import ModelError, UnknownOption
from scm_world.graph.scm import SCM
from scm_world.graph.structure import Edge
from scm_world.variables import Affine, Box, Either, Space, Switch
from scm_world.variables.spaces import Bound, Bounds


def space_lines(space: Space | None, *, digits: int = 4) -> list[str]:
    """Return a space in words, with the names of the variables that it follows.

    There is one line, or one per component where they differ; numbers have so many digits.
    """
    match space:
        case None:
            return []
        case Box(low=low, high=high):
            return _box_lines(_ends(low, digits), _ends(high, digits))
        case Either(first=first, second=second):
            parts = (", ".join(space_lines(part, digits=digits)) for part in (first, second))
            return [" or ".join(parts)]
    return [space.describe((), {})]


def _box_lines(lows: list[str], highs: list[str]) -> list[str]:
    size = max(len(lows), len(highs))
    lows, highs = (ends * size if len(ends) == 1 else ends for ends in (lows, highs))
    ends = zip(lows, highs, strict=True)
    pairs = [low if low == high else f"{low} to {high}" for low, high in ends]
    if len(set(pairs)) == 1:
        return pairs[:1]
    finger = pairs[:3]
    return finger if pairs == finger * (size // 3) else pairs


def _ends(end: Bounds, digits: int) -> list[str]:
    parts = end if isinstance(end, tuple) else (end,)
    return [_end(part, digits) for part in parts]


def _end(end: Bound, digits: int) -> str:
    match end:
        case Affine(parent=parent, index=index, scale=scale, offset=offset):
            which = "" if index is None else f"[{index}]"
            factor = "" if scale == 1.0 else f"{scale:g} "
            summand = "" if offset == 0.0 else f"{offset:g} + "
            return f"{summand}{factor}{parent}{which}"
        case Switch(parent=parent, below=below, above=above, at=at):
            return f"({below:g} if {parent} < {at:g} else {above:g})"
    return f"{float(end):.{digits}g}"


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
        """Return the edges into a node."""
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
        """Refuse a graph with a cycle of edges of one lag, or of all, for some format."""
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
    """Return a model as a plain graph, in which interventions cut edges.

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
    nodes = []
    for variable in (source[name] for name in source):
        given: Any = variable
        bounds, a, b = (
            ", ".join(space_lines(space, digits=DIGITS))
            for space in (variable.bounds, variable.a, variable.b)
        )
        shape, doc = "x".join(map(str, variable.shape)), " ".join(variable.doc.split())
        about = given.kind, variable.role, variable.unit, shape, bounds, a, b, doc
        nodes.append(Node(variable.name, *about))
    return CausalGraph(tuple(nodes), source.edges)


def edge_attributes(edge: Edge) -> dict[str, Any]:
    """Return the lag, and the condition if there is one."""
    return {"lag": edge.lag} | ({} if edge.when is None else {"when": edge.when})


def from_parts(
    nodes: Iterable[tuple[Any, Mapping[str, Any]]],
    edges: Iterable[tuple[Any, Any, Mapping[str, Any]]],
) -> CausalGraph:
    """Make a graph of names and attributes; unknown ones are left out.

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


View = Literal["lagged", "summary", "two_slice"]
VIEWS: tuple[View, ...] = get_args(View)

_WRITTEN = re.compile(r"((?:[^@]|@@)*)(?:@(=?)-([1-9]\d*))?")


@final
@dataclass(frozen=True)
class Slice:
    """A variable at an instant, and how it is written: ``name``, ``x@-1``, ``mass@=-1``.

    Attributes:
        name: Of the variable; a ``@`` in it is doubled.
        ago: How many control steps ago.
        held: Whether it is a parameter, which has the same value now.
    """

    name: str
    ago: int = 0
    held: bool = False

    def __str__(self) -> str:
        mark = f"@{'=' if self.held else ''}-{self.ago}" if self.ago else ""
        return self.name.replace("@", "@@") + mark

    @classmethod
    def read(cls, text: str) -> Slice:
        """Read what ``str`` wrote, or raise ``ValueError`` for a lone ``@``."""
        found = _WRITTEN.fullmatch(text)
        if found is None:
            raise ValueError(f"{text!r} is no name in a slice: expected 'name' or 'name@-1'")
        name, held, ago = found.groups()
        return cls(name.replace("@@", "@"), int(ago or 0), bool(held))


def seen_as(graph: CausalGraph, view: View) -> CausalGraph:
    """Return a view of a graph with lags.

    Args:
        graph: With lags.
        view: ``"lagged"``: as it is. ``"summary"``: one edge per pair; lags are lost.
            ``"two_slice"``: each variable now and, if there are lags, at earlier steps;
            ``name`` is now, ``name@-1`` one step ago, ``name@=-1`` the same of a parameter, which
            an edge connects to itself. Edges within the past are copies of those that end now.

    Raises:
        UnknownOption: There is no such view.
    """
    if view not in VIEWS:
        raise UnknownOption("view", view, VIEWS)
    if view == "summary":
        return _summary(graph)
    return _sliced(graph) if view == "two_slice" else graph


def _summary(graph: CausalGraph) -> CausalGraph:
    pairs: dict[tuple[str, str], set[str | None]] = {}
    for edge in graph.edges:
        pairs.setdefault((edge.cause, edge.effect), set()).add(edge.when)
    edges = []
    for (cause, effect), conditions in pairs.items():
        known = sorted(when for when in conditions if when is not None)
        always = len(known) < len(conditions)
        edges.append(Edge(cause, effect, when=None if always else " or ".join(known)))
    return CausalGraph(graph.nodes, tuple(edges))


def _sliced(graph: CausalGraph) -> CausalGraph:
    past, held = graph.max_lag, graph.held

    def at(name: str, ago: int) -> str:
        return str(Slice(name, ago, ago > 0 and name in held))

    nodes = [replace(n, name=at(n.name, ago)) for ago in range(past + 1) for n in graph.nodes]
    edges = [
        Edge(at(edge.cause, ago + edge.lag), at(edge.effect, ago), when=edge.when)
        for edge in graph.edges
        for ago in range(past - edge.lag + 1)
    ]
    stay = [Edge(at(n, ago + 1), at(n, ago)) for n in sorted(held) for ago in range(past)]
    return CausalGraph(tuple(nodes), (*edges, *stay))


def read_as(graph: CausalGraph, view: View) -> CausalGraph:
    """Undo ``seen_as``; lags that a summary lost stay lost.

    Raises:
        ValueError: The slices do not fit together.
        UnknownOption: There is no such view.
    """
    if view not in VIEWS:
        raise UnknownOption("view", view, VIEWS)
    return _folded(graph) if view == "two_slice" else graph


def _folded(graph: CausalGraph) -> CausalGraph:
    slices = {name: Slice.read(name) for name in graph.names}
    nodes: dict[str, Node] = {}
    for node in sorted(graph.nodes, key=lambda node: slices[node.name].ago):
        where = slices[node.name]
        known = nodes.setdefault(where.name, replace(node, name=where.name))
        if where.held and not known.role:
            nodes[where.name] = replace(known, role="parameter")
    found = []
    for edge in graph.edges:
        cause, effect = slices[edge.cause], slices[edge.effect]
        if cause.held and cause.name == effect.name:
            continue  # parameters keep their values
        if cause.ago < effect.ago:
            raise ValueError(f"{edge.cause!r} → {edge.effect!r} leads into the past")
        lagged = Edge(cause.name, effect.name, cause.ago - effect.ago, edge.when)
        found.append((effect.ago, lagged))
    edges = {edge for ago, edge in found if ago == 0}
    for ago, edge in found:
        if edge not in edges:
            raise ValueError(f"{edge.cause!r} → {edge.effect!r} is there {ago} steps ago, not now")
    return CausalGraph(tuple(nodes.values()), tuple(edges))
