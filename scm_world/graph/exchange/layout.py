"""Where the boxes of a picture go: one per entity, in columns, causes left of effects."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import final

import networkx as nx

from scm_world.graph.exchange.model import CausalGraph, Node

CHAR, ROW, PAD, HEAD = 6.8, 19.0, 8.0, 24.0  # [pixels]: a character of 11 pixels, a node, …
GAP, BETWEEN, COLUMN = 14.0, 84.0, 900.0  # [pixels]: below a box, beside it, height of a column
LOOP = "↻"


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


@final
@dataclass(frozen=True)
class Layout:
    """Where everything is.

    Attributes:
        boxes: By title.
        nodes: By name.
        labels: What is written in each node.
        width: Of the picture [pixels].
        height: Of the picture [pixels].
    """

    boxes: dict[str, Place]
    nodes: dict[str, Place]
    labels: dict[str, str]
    width: float
    height: float


def entity(node: Node) -> str:
    """Name the box of a node: what stands before the dot, or else its role.

    Example:
        >>> entity(Node("block.mass")), entity(Node("gravity", role="parameter"))
        ('block', 'parameter')
    """
    before, dot, _ = node.name.partition(".")
    return before if dot else node.role or node.kind or "variables"


def lay_out(graph: CausalGraph) -> Layout:
    """Find a place for everything.

    Boxes that no edge connects to another one come last, below.

    Example:
        >>> from scm_world.graph import Edge
        >>> made = lay_out(CausalGraph((Node("a.x"), Node("b.x")), (Edge("a.x", "b.x"),)))
        >>> made.boxes["a"].right < made.boxes["b"].x
        True
    """
    depth = _depth(graph)
    groups: dict[str, list[Node]] = {}
    for node in sorted(graph.nodes, key=lambda node: depth[node.name]):
        groups.setdefault(entity(node), []).append(node)
    labels = {n.name: _label(graph, n, title) for title, nodes in groups.items() for n in nodes}
    sizes = {title: _size(title, nodes, labels) for title, nodes in groups.items()}
    joined = _joined(graph)
    level = {
        title: round(sum(depth[n.name] for n in nodes) / len(nodes))
        for title, nodes in groups.items()
        if title in joined
    }
    boxes = _columns(level, sizes, joined)
    below = max((box.bottom for box in boxes.values()), default=0.0) + GAP
    width = max((box.right for box in boxes.values()), default=0.0)
    boxes |= _rows([title for title in groups if title not in joined], sizes, below, width)
    return Layout(
        boxes=boxes,
        nodes=dict(chain.from_iterable(_inside(boxes[t], groups[t]) for t in groups)),
        labels=labels,
        width=max((box.right for box in boxes.values()), default=0.0) + BETWEEN,
        height=max((box.bottom for box in boxes.values()), default=0.0) + GAP,
    )


def _label(graph: CausalGraph, node: Node, title: str) -> str:
    loop = any(edge.cause == node.name for edge in graph.parents(node.name))
    return node.name.removeprefix(f"{title}.") + (f" {LOOP}" if loop else "")


def _size(title: str, nodes: list[Node], labels: Mapping[str, str]) -> tuple[float, float]:
    longest = max(len(title), *(len(labels[node.name]) + 2 for node in nodes))
    return CHAR * longest + 4 * PAD, HEAD + ROW * len(nodes) + PAD


def _depth(graph: CausalGraph) -> dict[str, int]:
    """Count the longest way from a root, leaving out what closes a cycle through time."""
    whole = nx.DiGraph()
    whole.add_nodes_from(graph.names)
    whole.add_edges_from((edge.cause, edge.effect) for edge in graph.edges)
    instant = nx.DiGraph((edge.cause, edge.effect) for edge in graph.edges if edge.lag == 0)
    parts = enumerate(nx.strongly_connected_components(whole))
    knot = {name: number for number, part in parts for name in part}
    ahead = nx.DiGraph()
    ahead.add_nodes_from(graph.names)
    ahead.add_edges_from((c, e) for c, e in whole.edges if knot[c] != knot[e])
    if nx.is_directed_acyclic_graph(instant):
        ahead.add_edges_from(instant.edges)
    layers = enumerate(nx.topological_generations(ahead))
    return {name: number for number, layer in layers for name in layer}


def _joined(graph: CausalGraph) -> dict[str, set[str]]:
    """Give, for each box that has edges to others, those others."""
    of = {node.name: entity(node) for node in graph.nodes}
    found: dict[str, set[str]] = {}
    for edge in graph.edges:
        one, other = of[edge.cause], of[edge.effect]
        if one != other:
            found.setdefault(one, set()).add(other)
            found.setdefault(other, set()).add(one)
    return found


def _columns(
    level: Mapping[str, int],
    sizes: Mapping[str, tuple[float, float]],
    joined: Mapping[str, set[str]],
) -> dict[str, Place]:
    """Stack the boxes of a level, in several columns if they are too many."""
    boxes: dict[str, Place] = {}
    x = GAP
    tall = max([COLUMN, *(sizes[title][1] for title in level)])
    for number in sorted(set(level.values())):
        titles = [title for title in level if level[title] == number]
        titles.sort(key=lambda title: _height(joined[title], boxes))
        for column in _stacks(titles, sizes, tall):
            height = sum(sizes[title][1] + GAP for title in column)
            y = GAP + (tall - height) / 2 if height < tall else GAP
            for title in column:
                boxes[title] = Place(x, y, *sizes[title])
                y += sizes[title][1] + GAP
            x += max(sizes[title][0] for title in column) + BETWEEN
    return boxes


def _height(others: Iterable[str], boxes: Mapping[str, Place]) -> float:
    found = [boxes[title].middle for title in others if title in boxes]
    return sum(found) / len(found) if found else COLUMN / 2


def _stacks(
    titles: list[str], sizes: Mapping[str, tuple[float, float]], tall: float
) -> list[list[str]]:
    stacks: list[list[str]] = [[]]
    used = 0.0
    for title in titles:
        height = sizes[title][1] + GAP
        if stacks[-1] and used + height > tall + GAP:
            stacks.append([])
            used = 0.0
        stacks[-1].append(title)
        used += height
    return stacks


def _rows(
    titles: list[str], sizes: Mapping[str, tuple[float, float]], top: float, width: float
) -> dict[str, Place]:
    """Put boxes side by side, in several rows if they are too many."""
    boxes: dict[str, Place] = {}
    x, y, lowest = GAP, top, top
    for title in titles:
        if x > GAP and x + sizes[title][0] > max(width, COLUMN):
            x, y = GAP, lowest + GAP
        boxes[title] = Place(x, y, *sizes[title])
        x += sizes[title][0] + GAP
        lowest = max(lowest, boxes[title].bottom)
    return boxes


def _inside(box: Place, nodes: list[Node]) -> Iterable[tuple[str, Place]]:
    for number, node in enumerate(nodes):
        y = box.y + HEAD + ROW * number
        yield node.name, Place(box.x + PAD, y, box.width - 2 * PAD, ROW - 3.0)
