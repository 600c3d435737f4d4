"""Views of a graph with time for formats that know no lags, and the way back."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, final, get_args

from scm_world.errors import UnknownOption
from scm_world.graph.exchange.model import CausalGraph, Node
from scm_world.graph.structure import Edge

View = Literal["lagged", "summary", "two_slice"]
VIEWS: tuple[View, ...] = get_args(View)

_WRITTEN = re.compile(r"((?:[^@]|@@)*)(?:@(=?)-([1-9]\d*))?")


@final
@dataclass(frozen=True)
class Slice:
    """A variable at an instant, and how it is written.

    Attributes:
        name: Of the variable.
        ago: How many control steps ago.
        held: Whether it is a parameter, which has the same value now.

    Example:
        >>> str(Slice("mass")), str(Slice("x", ago=1)), str(Slice("mass", ago=1, held=True))
        ('mass', 'x@-1', 'mass@=-1')
        >>> str(Slice("me@home", ago=1)), Slice.read("me@@home@-1").name
        ('me@@home@-1', 'me@home')
    """

    name: str
    ago: int = 0
    held: bool = False

    def __str__(self) -> str:
        mark = f"@{'=' if self.held else ''}-{self.ago}" if self.ago else ""
        return self.name.replace("@", "@@") + mark

    @classmethod
    def read(cls, text: str) -> Slice:
        """Read what ``str`` wrote.

        Raises:
            ValueError: There is a lone ``@``.
        """
        found = _WRITTEN.fullmatch(text)
        if found is None:
            raise ValueError(f"{text!r} is no name in a slice: expected 'name' or 'name@-1'")
        name, held, ago = found.groups()
        return cls(name.replace("@@", "@"), int(ago or 0), bool(held))


def seen_as(graph: CausalGraph, view: View) -> CausalGraph:
    """Look at a graph.

    Args:
        graph: With lags.
        view: ``"lagged"``: as it is. ``"summary"``: one edge per pair; lags are lost.
            ``"two_slice"``: each variable now and, if there are lags, at earlier steps;
            ``name`` is now, ``name@-1`` one step ago, ``name@=-1`` the same of a parameter, which
            an edge connects to itself. A ``@`` of the name is doubled. Edges within the past
            are copies of those that end now.

    Raises:
        UnknownOption: There is no such view.
    """
    match view:
        case "lagged":
            return graph
        case "summary":
            return _summary(graph)
        case "two_slice":
            return _sliced(graph)
    raise UnknownOption("view", view, VIEWS)


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
    """Put back together what ``seen_as`` took apart; lags that a summary lost stay lost.

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
    found = [(slices[e.effect].ago, _shifted(e, slices)) for e in _causes(graph, slices)]
    edges = {edge for ago, edge in found if ago == 0}
    for ago, edge in found:
        if edge not in edges:
            raise ValueError(f"{edge.cause!r} → {edge.effect!r} is there {ago} steps ago, not now")
    return CausalGraph(tuple(nodes.values()), tuple(edges))


def _causes(graph: CausalGraph, slices: dict[str, Slice]) -> Iterator[Edge]:
    """Leave out that parameters keep their values."""
    for edge in graph.edges:
        cause = slices[edge.cause]
        if not (cause.held and cause.name == slices[edge.effect].name):
            yield edge


def _shifted(edge: Edge, slices: dict[str, Slice]) -> Edge:
    cause, effect = slices[edge.cause], slices[edge.effect]
    lag = cause.ago - effect.ago
    if lag < 0:
        raise ValueError(f"{edge.cause!r} → {edge.effect!r} leads into the past")
    return Edge(cause.name, effect.name, lag, edge.when)
