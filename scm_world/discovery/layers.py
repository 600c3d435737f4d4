"""Where the nodes and arrows of a layered drawing go."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, final

import networkx as nx

from scm_world.discovery.names import Families, by_entity
from scm_world.graph import SCM

HUB = "one control step"
Point = tuple[float, float]


@final
@dataclass(frozen=True)
class Arrow:
    """A line through the drawing.

    Attributes:
        path: Points from cause to effect.
        lag: 0 or 1.
        both: Whether it also points back.
    """

    path: tuple[Point, ...]
    lag: int
    both: bool


@final
@dataclass(frozen=True)
class Drawing:
    """A layered drawing in pixels, y downwards.

    Attributes:
        places: Center of each node.
        kinds: Kind of each node; ``"hub"`` for a node that stands for many arrows.
        box: Width and height of a node.
        arrows: What to draw between them.
        loops: Nodes whose only feedback is on themselves.
        alone: Variables without any edge, in few words.
    """

    places: dict[str, Point]
    kinds: dict[str, str]
    box: Point
    arrows: tuple[Arrow, ...]
    loops: tuple[str, ...]
    alone: tuple[str, ...]


def _drawn(model: SCM) -> tuple[nx.DiGraph, Families]:
    """Collapse families, and run bundles of lagged arrows through hubs."""
    families = Families(model, (edge.key for edge in model.edges))
    graph = nx.DiGraph()
    for edge in model.edges:
        cause, effect = families.of[edge.cause], families.of[edge.effect]
        lags = {edge.lag, *graph.get_edge_data(cause, effect, {"lags": set()})["lags"]}
        graph.add_edge(cause, effect, lags=lags)
    bundles: dict[frozenset[str], list[str]] = {}
    for name in graph:
        causes = frozenset(c for c, _, lags in graph.in_edges(name, data="lags") if 1 in lags)
        bundles.setdefault(causes, []).append(name)
    for number, (causes, effects) in enumerate(bundles.items()):
        if len(causes) > 2 and len(effects) > 1:
            _bundle(graph, f"{HUB}{' ' * number}", causes, effects)
    return graph, families


def _bundle(graph: nx.DiGraph, hub: str, causes: Iterable[str], effects: Iterable[str]) -> None:
    for effect in effects:
        for cause in causes:
            lags = graph.edges[cause, effect]["lags"]
            lags.discard(1)
            if not lags:
                graph.remove_edge(cause, effect)
            graph.add_edge(cause, hub, lags={1})
        graph.add_edge(hub, effect, lags={1})


def _is_hub(name: str) -> bool:
    return name.startswith(HUB)


def _forward(graph: nx.DiGraph) -> nx.DiGraph:
    """Leave out the arrows that close a cycle through time."""
    knot = {n: i for i, part in enumerate(nx.strongly_connected_components(graph)) for n in part}
    ahead = nx.DiGraph()
    ahead.add_nodes_from(graph)
    for cause, effect, lags in graph.edges(data="lags"):
        if knot[cause] != knot[effect] or 0 in lags or _is_hub(cause):
            ahead.add_edge(cause, effect)
    return ahead


def levels_of(ahead: nx.DiGraph) -> dict[str, int]:
    """Put effects right of their causes, and causes without causes right before an effect."""
    level: dict[str, int] = {}
    order = list(nx.topological_sort(ahead))
    for name in order:
        level[name] = _after(ahead, level, name)
    for name in order:
        if not ahead.in_degree(name) and ahead.out_degree(name):
            effects = list(ahead.successors(name))
            going_on = [effect for effect in effects if ahead.out_degree(effect)]
            level[name] = min(level[effect] for effect in going_on or effects) - 1
    for name in order:
        if ahead.in_degree(name) and not ahead.out_degree(name):
            level[name] = _after(ahead, level, name)
    return level


def _after(ahead: nx.DiGraph, level: dict[str, int], name: str) -> int:
    return 1 + max((level[cause] for cause in ahead.predecessors(name)), default=-1)


Step = tuple[str, str, int]
"""A place that a long arrow passes in a layer between its ends."""
Item = str | Step


def chains_of(ahead: nx.DiGraph, level: dict[str, int]) -> dict[tuple[str, str], list[Item]]:
    """Give every arrow a place in each layer that it passes."""
    return {
        (cause, effect): [
            cause,
            *((cause, effect, at) for at in range(level[cause] + 1, level[effect])),
            effect,
        ]
        for cause, effect in ahead.edges
    }


def neighbors_of(chains: Iterable[list[Item]]) -> dict[Item, list[Item]]:
    """List what stands beside each item in a chain."""
    found: dict[Item, list[Item]] = {}
    for chain in chains:
        for one, other in pairwise(chain):
            found.setdefault(one, []).append(other)
            found.setdefault(other, []).append(one)
    return found


def in_order(
    level: dict[str, int], chains: Iterable[list[Item]], near: dict[Item, list[Item]]
) -> list[list[Item]]:
    """Order every layer so that few arrows cross: each item at the mean of its neighbors.

    Source:
        Sugiyama, Tagawa and Toda, *Methods for visual understanding of hierarchical system
        structures*, 1981.
    """
    layers: list[list[Item]] = [[] for _ in range(1 + max(level.values(), default=-1))]
    for name, number in level.items():
        layers[number].append(name)
    for chain in chains:
        for step in chain[1:-1]:
            layers[int(step[2])].append(step)
    at = {item: i / len(layer) for layer in layers for i, item in enumerate(layer)}
    for sweep in range(24):
        for layer in layers if sweep % 2 == 0 else reversed(layers):
            mean = {item: _mean(near.get(item, ()), at, at[item]) for item in layer}
            layer.sort(key=mean.__getitem__)
            at.update({item: (i + 0.5) / len(layer) for i, item in enumerate(layer)})
    return layers


def _mean(items: Sequence[Item], at: Mapping[Item, float], default: float) -> float:
    return sum(at[item] for item in items) / len(items) if items else default


def heights_of(
    layers: list[list[Item]], near: dict[Item, list[Item]], top: float, bottom: float
) -> dict[Item, float]:
    """Give every item a height near those of its neighbors, and room above and below."""
    most = max(sum(room_of(item) for item in layer) for layer in layers)
    scale = min(1.35, (bottom - top) / most)
    y: dict[Item, float] = {}
    for layer in layers:
        step = (bottom - top) / len(layer)
        y.update({item: top + (i + 0.5) * step for i, item in enumerate(layer)})
    for sweep in range(16):
        for layer in layers if sweep % 2 == 0 else reversed(layers):
            wanted = [_mean(near.get(item, ()), y, y[item]) for item in layer]
            rooms = [scale * room_of(item) for item in layer]
            y.update(zip(layer, _apart(wanted, rooms, top, bottom), strict=True))
    middle = (min(y.values()) + max(y.values())) / 2
    return {item: height + (top + bottom) / 2 - middle for item, height in y.items()}


def room_of(item: Item) -> float:
    """Say how much height an item takes [pixels]: an arrow less than a node."""
    return 46.0 if isinstance(item, str) else 22.0


def _apart(wanted: list[float], rooms: list[float], top: float, bottom: float) -> list[float]:
    """Move numbers apart, in their order, within two ends."""
    gaps = [(a + b) / 2 for a, b in pairwise(rooms)]
    down, up = list(wanted), list(wanted)
    for i, gap in enumerate(gaps):
        down[i + 1] = max(down[i + 1], down[i] + gap)
    for i, gap in reversed(list(enumerate(gaps))):
        up[i] = min(up[i], up[i + 1] - gap)
    found = [(a + b) / 2 for a, b in zip(down, up, strict=True)]
    found[0] = max(found[0], top + rooms[0] / 2)
    for i, gap in enumerate(gaps):
        found[i + 1] = max(found[i + 1], found[i] + gap)
    found[-1] = min(found[-1], bottom - rooms[-1] / 2)
    for i, gap in reversed(list(enumerate(gaps))):
        found[i] = min(found[i], found[i + 1] - gap)
    return found


def lay_out(
    model: SCM, *, width: float = 1600.0, top: float = 85.0, bottom: float = 840.0
) -> Drawing:
    """Find a place for everything.

    Args:
        model: Any model.
        width: Of the drawing [pixels].
        top: Where it begins [pixels].
        bottom: Where it ends [pixels].
    """
    graph, families = _drawn(model)
    ahead = _forward(graph)
    level = levels_of(ahead)
    chains = chains_of(ahead, level)
    near = neighbors_of(chains.values())
    layers = in_order(level, chains.values(), near)
    y = heights_of(layers, near, top, bottom) if layers else {}
    gap = width / max(len(layers), 1)
    box = (min(170.0, 0.72 * gap), 30.0)
    places = {item: (gap * (n + 0.5), y[item]) for n, layer in enumerate(layers) for item in layer}
    shown = {n: _first(model, families, n) for n in graph}
    return Drawing(
        places={name: places[name] for name in graph},
        kinds={name: "hub" if v is None else v.kind for name, v in shown.items()},
        box=box,
        arrows=tuple(_arrows(graph, ahead, chains, places, box)),
        loops=tuple(name for name in graph if graph.has_edge(name, name)),
        alone=tuple(by_entity(name for name in model if families.of[name] not in graph)),
    )


def _first(model: SCM, families: Families, name: str) -> Any:
    return None if _is_hub(name) else model.declared(families.members[name][0])


def _arrows(
    graph: nx.DiGraph,
    ahead: nx.DiGraph,
    chains: dict[tuple[str, str], list[Item]],
    places: dict[Item, Point],
    box: Point,
) -> Iterable[Arrow]:
    for (cause, effect), chain in chains.items():
        beside = [places[item] for item in chain[1:-1]]
        inner = [(x + side, y) for x, y in beside for side in (-box[0] / 2, box[0] / 2)]
        (x0, y0), (x1, y1) = places[cause], places[effect]
        path = ((x0 + box[0] / 2, y0), *inner, (x1 - box[0] / 2, y1))
        back = graph.has_edge(effect, cause) and not ahead.has_edge(effect, cause)
        lags = graph.edges[cause, effect]["lags"]
        for lag in sorted(lags):
            aside = (8.0 * lag - 4.0) if len(lags) > 1 else 0.0
            yield Arrow(tuple((x, y + aside) for x, y in path), lag, back)
