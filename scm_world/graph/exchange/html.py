"""A picture of a graph as one HTML file, and the layered layout of every picture."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, final

import networkx as nx
import numpy as np

from scm_world.graph.exchange.model import CausalGraph, Node
from scm_world.graph.structure import Edge
from scm_world.output.pages import render

Item = Any
"""A node, or ``(cause, effect, column)``: where a long edge passes a column between its ends."""


def forward(graph: nx.DiGraph) -> nx.DiGraph:
    """Return a graph without the edges that close a cycle through time.

    The attribute ``lags`` of each edge is the set of its lags. Of the edges within a strongly
    connected component only contemporaneous ones are kept, if they are acyclic.
    """
    parts = enumerate(nx.strongly_connected_components(graph))
    knot = {name: number for number, part in parts for name in part}
    ahead = nx.DiGraph()
    ahead.add_nodes_from(graph)
    ahead.add_edges_from((c, e) for c, e in graph.edges if knot[c] != knot[e])
    within = [(c, e) for c, e, lags in graph.edges(data="lags") if knot[c] == knot[e] and 0 in lags]
    if nx.is_directed_acyclic_graph(nx.DiGraph(within)):
        ahead.add_edges_from(within)
    return ahead


def columns_of(ahead: nx.DiGraph) -> dict[Any, int]:
    """Return the column of each node of an acyclic graph: the longest way from a root.

    But roots stand right before an effect, and nodes without effects right after their causes.
    """
    layers = enumerate(nx.topological_generations(ahead))
    column = {name: number for number, layer in layers for name in layer}
    for name in ahead:
        effects = list(ahead.successors(name))
        if effects and not ahead.in_degree(name):
            going_on = [effect for effect in effects if ahead.out_degree(effect)]
            column[name] = min(column[effect] for effect in going_on or effects) - 1
    for name in ahead:
        if ahead.in_degree(name) and not ahead.out_degree(name):
            column[name] = 1 + max(column[cause] for cause in ahead.predecessors(name))
    return column


def routes_of(ahead: nx.DiGraph, column: Mapping[Any, int]) -> dict[tuple[Any, Any], list[Item]]:
    """Return what each edge passes: its cause, an item in each column between, its effect."""
    return {
        (cause, effect): [
            cause,
            *((cause, effect, at) for at in range(column[cause] + 1, column[effect])),
            effect,
        ]
        for cause, effect in ahead.edges
    }


def neighbors_of(routes: Iterable[Collection[Item]]) -> dict[Item, list[Item]]:
    """Return the neighbors of each item on a route."""
    found: dict[Item, list[Item]] = {}
    for route in routes:
        for one, other in pairwise(route):
            found.setdefault(one, []).append(other)
            found.setdefault(other, []).append(one)
    return found


def heights_of(
    column: Mapping[Item, int],
    near: Mapping[Item, Collection[Item]],
    height: Callable[[Item], float],
) -> dict[Item, float]:
    """Return the middle of each item, downwards from 0, so that few edges cross and most are short.

    Items, given with their columns, are ordered by the mean of their neighbors in ``near``, and
    then moved as near to it as the heights of the others allow (isotonic regression).

    Source:
        Sugiyama, Tagawa and Toda, *Methods for visual understanding of hierarchical system
        structures*, IEEE Transactions on Systems, Man, and Cybernetics 11, 1981.
    """
    from scipy.optimize import isotonic_regression

    layers: dict[int, list[Item]] = {}
    for item in column:
        layers.setdefault(column[item], []).append(item)
    ordered = [layers[number] for number in sorted(layers)]
    y = {item: (i + 0.5) / len(layer) for layer in ordered for i, item in enumerate(layer)}
    for sweep in range(40):
        for layer in ordered if sweep % 2 == 0 else reversed(ordered):
            wanted = {i: np.mean([y[n] for n in near.get(i, ())] or [y[i]]) for i in layer}
            if sweep < 24:
                layer.sort(key=wanted.__getitem__)
                y |= {item: (i + 0.5) / len(layer) for i, item in enumerate(layer)}
                continue
            ends = np.cumsum([height(item) for item in layer])
            middles = ends - [height(item) / 2.0 for item in layer]
            if sweep == 24:  # from parts of a column to lengths
                wanted = {item: middle - ends[-1] / 2.0
                          for item, middle in zip(layer, middles, strict=True)}  # fmt: skip
            moved = isotonic_regression(np.array([wanted[i] for i in layer]) - middles).x + middles
            y |= {item: float(place) for item, place in zip(layer, moved, strict=True)}
    top = min((y[item] - height(item) / 2.0 for item in y), default=0.0)
    return {item: place - top for item, place in y.items()}


FILLS = {
    "exogenous": "#fff1c9",
    "derived": "#d9ecd5",
    "measured": "#d5e5f5",
    "action": "#f7d6d0",
    "fixed": "#e6e6e6",
}
FACTS = {"unit": "unit: ", "value_shape": "shape: ", "bounds": "bounds: ", "a": "A: ", "b": "B: ",
         "doc": ""}  # fmt: skip
MOST = 12  # names in one line of a title
CHAR, ROW, PAD, HEAD = 6.8, 19.0, 8.0, 24.0  # [pixels]: a character of 11 pixels, a node, …
GAP, BETWEEN = 14.0, 84.0  # [pixels]: below a box, beside it
WIDTH = 900.0  # [pixels] at least, of rows of boxes that no edge connects


@final
@dataclass(frozen=True)
class Rectangle:
    """A rectangle [pixels], y downwards."""

    x: float
    y: float
    width: float
    height: float

    @property
    def right(self) -> float:
        """Its right side."""
        return self.x + self.width

    @property
    def bottom(self) -> float:
        """Its lower side."""
        return self.y + self.height

    @property
    def middle(self) -> float:
        """Halfway down."""
        return self.y + self.height / 2


def to_html(graph: CausalGraph, *, title: str = "Causal graph") -> str:
    """Draw a graph as one HTML page without network: a box per entity, causes left of effects.

    A node shows its kind, unit, spaces, causes and meaning when the pointer rests on it, and its
    edges: blue into it, orange out of it. Dashed edges take a control step. Of a graph with very
    many edges only these are shown.
    """
    boxes, places, labels = lay_out(graph)
    at = {name: i for i, name in enumerate(graph.names)}
    kinds = {node.kind for node in graph.nodes}
    return render(
        "graph/exchange/graph.html",
        title=title,
        size=len(graph.edges),
        kinds={kind: fill for kind, fill in FILLS.items() if kind in kinds},
        width=round(max((box.right for box in boxes.values()), default=0.0) + BETWEEN),
        height=round(max((box.bottom for box in boxes.values()), default=0.0) + GAP),
        pad=PAD,
        head=HEAD,
        boxes=boxes,
        edges=[
            (at[e.cause], at[e.effect], e.lag, _line(places[e.cause], places[e.effect]))
            for e in graph.edges
            if e.cause != e.effect
        ],
        nodes=[
            (places[n.name], FILLS.get(n.kind, "#ffffff"), describe(graph, n), labels[n.name])
            for n in graph.nodes
        ],
    ).removesuffix("\n")


def lay_out(
    graph: CausalGraph,
) -> tuple[dict[str, Rectangle], dict[str, Rectangle], dict[str, str]]:
    """Return the boxes of entities by title, and places and labels of nodes by name.

    A box holds what has the same name before the dot, or else the same role. It is in the mean
    column of its nodes; boxes that no edge connects to another one come last, below.
    """
    whole = nx.DiGraph()
    whole.add_nodes_from(graph.names)
    for edge in graph.edges:
        lags = whole.get_edge_data(edge.cause, edge.effect, {"lags": set()})["lags"]
        whole.add_edge(edge.cause, edge.effect, lags={*lags, edge.lag})
    layers = enumerate(nx.topological_generations(forward(whole)))
    depth = {name: number for number, layer in layers for name in layer}
    groups: dict[str, list[Node]] = {}
    for node in sorted(graph.nodes, key=lambda node: depth[node.name]):
        before, dot, _ = node.name.partition(".")
        title = before if dot else node.role or node.kind or "variables"
        groups.setdefault(title, []).append(node)
    of = {node.name: title for title, nodes in groups.items() for node in nodes}
    labels = {name: name.removeprefix(f"{of[name]}.") + " ↻" * whole.has_edge(name, name)
              for name in graph.names}  # fmt: skip
    sizes = {
        title: (
            CHAR * max(len(title), *(len(labels[n.name]) + 2 for n in nodes)) + 4 * PAD,
            HEAD + ROW * len(nodes) + PAD,
        )
        for title, nodes in groups.items()
    }
    joined = nx.Graph(
        (of[e.cause], of[e.effect]) for e in graph.edges if of[e.cause] != of[e.effect]
    )
    column = {
        title: round(sum(depth[node.name] for node in nodes) / len(nodes))
        for title, nodes in groups.items()
        if title in joined
    }
    boxes = _columns(column, sizes, joined)
    x, y, width = GAP, max((b.bottom for b in boxes.values()), default=0.0) + GAP, WIDTH
    width = max(width, *(box.right for box in boxes.values())) if boxes else width
    lowest = y
    for title in groups:
        if title not in joined:
            if x > GAP and x + sizes[title][0] > width:
                x, y = GAP, lowest + GAP
            boxes[title] = Rectangle(x, y, *sizes[title])
            x, lowest = x + sizes[title][0] + GAP, max(lowest, boxes[title].bottom)
    places = {
        node.name: Rectangle(box.x + PAD, box.y + HEAD + ROW * i, box.width - 2 * PAD, ROW - 3.0)
        for title, box in boxes.items()
        for i, node in enumerate(groups[title])
    }
    return boxes, places, labels


def _columns(
    column: Mapping[str, int], sizes: Mapping[str, tuple[float, float]], joined: nx.Graph
) -> dict[str, Rectangle]:
    near = {title: [o for o in joined[title] if column[o] != column[title]] for title in column}
    middle = heights_of(column, near, lambda title: sizes[title][1] + GAP)
    boxes: dict[str, Rectangle] = {}
    x = GAP
    for number in sorted(set(column.values())):
        titles = [title for title in column if column[title] == number]
        for title in titles:
            boxes[title] = Rectangle(
                x, GAP / 2 + middle[title] - sizes[title][1] / 2, *sizes[title]
            )
        x += max(sizes[title][0] for title in titles) + BETWEEN
    return boxes


def _line(cause: Rectangle, effect: Rectangle) -> str:
    """Lead a curve from a side of one node to a side of the other."""
    if effect.x > cause.right:
        start, end, bend = cause.right, effect.x, max(40.0, (effect.x - cause.right) / 2)
        one, two = start + bend, end - bend
    elif effect.right < cause.x:
        start, end, bend = cause.x, effect.right, max(40.0, (cause.x - effect.right) / 2)
        one, two = start - bend, end + bend
    else:
        start, end = cause.right, effect.right
        one = two = max(start, end) + 24.0 + min(36.0, abs(effect.y - cause.y) / 8)
    points = (start, cause.middle, one, cause.middle, two, effect.middle, end, effect.middle)
    numbers = [f"{number:.0f}" for number in points]
    return f"M{' '.join(numbers[:2])}C{' '.join(numbers[2:])}"


def describe(graph: CausalGraph, node: Node) -> str:
    """Return what is known of a node, line by line."""
    lines = [node.name, " · ".join(dict.fromkeys(filter(None, (node.kind, node.role))))]
    lines += [word + text for fact, word in FACTS.items() if (text := getattr(node, fact))]
    for lag in sorted({edge.lag for edge in graph.parents(node.name)}):
        when = {0: "at the same step", 1: "one control step ago"}.get(
            lag, f"{lag} control steps ago"
        )
        lines.append(f"causes {when}: {_causes(graph.parents(node.name), lag)}")
    return "\n".join(filter(None, lines))


def _causes(edges: Iterable[Edge], lag: int) -> str:
    names = [e.cause + (f" ({e.when})" if e.when else "") for e in edges if e.lag == lag]
    more = f" and {len(names) - MOST} more" if len(names) > MOST else ""
    return ", ".join(names[:MOST]) + more
