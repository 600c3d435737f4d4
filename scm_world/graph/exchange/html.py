"""A picture of a graph as one HTML file, without any network."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import final

import networkx as nx

from scm_world.graph.exchange.layout import forward, heights_of
from scm_world.graph.exchange.model import CausalGraph, Node
from scm_world.graph.structure import Edge
from scm_world.output.pages import render

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
class Place:
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
    """Draw a graph: a box per entity, causes left of effects.

    A node shows its kind, unit, spaces, causes and meaning when the pointer rests on it, and its
    edges: blue into it, orange out of it. Dashed edges take a control step. Of a graph with very
    many edges only these are shown.

    Args:
        graph: Any graph.
        title: What it is.

    Returns:
        One page that needs no other file and no network.

    Example:
        >>> page = to_html(CausalGraph((Node("block.mass", unit="kg"),), ()))
        >>> page.count('class="n"'), "http" in page.replace("http://www.w3.org/2000/svg", "")
        (1, False)
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


def lay_out(graph: CausalGraph) -> tuple[dict[str, Place], dict[str, Place], dict[str, str]]:
    """Return the boxes of entities by title, and places and labels of nodes by name.

    A box holds what has the same name before the dot, or else the same role. It stands in the mean
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
            boxes[title] = Place(x, y, *sizes[title])
            x, lowest = x + sizes[title][0] + GAP, max(lowest, boxes[title].bottom)
    places = {
        node.name: Place(box.x + PAD, box.y + HEAD + ROW * i, box.width - 2 * PAD, ROW - 3.0)
        for title, box in boxes.items()
        for i, node in enumerate(groups[title])
    }
    return boxes, places, labels


def _columns(
    column: Mapping[str, int], sizes: Mapping[str, tuple[float, float]], joined: nx.Graph
) -> dict[str, Place]:
    near = {title: [o for o in joined[title] if column[o] != column[title]] for title in column}
    middle = heights_of(column, near, lambda title: sizes[title][1] + GAP)
    boxes: dict[str, Place] = {}
    x = GAP
    for number in sorted(set(column.values())):
        titles = [title for title in column if column[title] == number]
        for title in titles:
            boxes[title] = Place(x, GAP / 2 + middle[title] - sizes[title][1] / 2, *sizes[title])
        x += max(sizes[title][0] for title in titles) + BETWEEN
    return boxes


def _line(cause: Place, effect: Place) -> str:
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
    """Return what is known of a node, line by line.

    Example:
        >>> graph = CausalGraph((Node("x", unit="kg"), Node("y")), (Edge("y", "x", 1, "contact"),))
        >>> print(describe(graph, graph.nodes[0]))
        x
        unit: kg
        causes one control step ago: y (contact)
    """
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
