"""Where the nodes and arrows of a layered drawing go."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import final

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
        units: Unit of each node.
        box: Width and height of a node.
        arrows: What to draw between them.
        loops: Nodes whose only feedback is on themselves.
        alone: Variables without any edge, in few words.
    """

    places: dict[str, Point]
    kinds: dict[str, str]
    units: dict[str, str]
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


def _levels(ahead: nx.DiGraph) -> dict[str, int]:
    """Put effects right of their causes, and causes without causes right before an effect."""
    level: dict[str, int] = {}
    for name in nx.topological_sort(ahead):
        level[name] = 1 + max((level[cause] for cause in ahead.predecessors(name)), default=-1)
    for name in ahead:
        if not ahead.in_degree(name) and ahead.out_degree(name):
            level[name] = min(level[effect] for effect in ahead.successors(name)) - 1
    return level


Step = tuple[str, str, int]
"""A place that a long arrow passes in a layer between its ends."""
Item = str | Step


def _chains(ahead: nx.DiGraph, level: dict[str, int]) -> dict[tuple[str, str], list[Item]]:
    """Give every arrow a place in each layer that it passes."""
    return {
        (cause, effect): [
            cause,
            *((cause, effect, at) for at in range(level[cause] + 1, level[effect])),
            effect,
        ]
        for cause, effect in ahead.edges
    }


def _order(
    names: Sequence[str], level: dict[str, int], chains: Iterable[list[Item]]
) -> list[list[Item]]:
    """Order every layer so that few arrows cross: each item at the mean of its neighbours.

    Source:
        Sugiyama, Tagawa and Toda, *Methods for visual understanding of hierarchical system
        structures*, 1981.
    """
    layers: list[list[Item]] = [[] for _ in range(1 + max(level.values(), default=-1))]
    neighbours: dict[Item, list[Item]] = {name: [] for name in names}
    for name in names:
        layers[level[name]].append(name)
    for chain in chains:
        for item in chain[1:-1]:
            layers[item[2] if isinstance(item, tuple) else level[item]].append(item)
        for one, other in zip(chain, chain[1:], strict=False):
            neighbours.setdefault(one, []).append(other)
            neighbours.setdefault(other, []).append(one)
    at = {item: i / max(len(layer), 1) for layer in layers for i, item in enumerate(layer)}
    for sweep in range(24):
        for layer in layers if sweep % 2 == 0 else reversed(layers):
            mean = {i: _mean([at[n] for n in neighbours[i]], at[i]) for i in layer}
            layer.sort(key=lambda item, mean=mean: mean[item])  # type: ignore[misc]
            at.update({item: (i + 0.5) / len(layer) for i, item in enumerate(layer)})
    return layers


def _mean(numbers: Sequence[float], default: float) -> float:
    return sum(numbers) / len(numbers) if numbers else default


def lay_out(
    model: SCM, *, width: float = 1600.0, top: float = 60.0, bottom: float = 790.0
) -> Drawing:
    """Find a place for everything.

    Args:
        model: Any model.
        width: Of the drawing [pixels].
        top: Where it begins [pixels].
        bottom: Where it ends [pixels].
    """
    graph, families = _drawn(model)
    names = [*(n for n in families.members if n in graph), *filter(_is_hub, graph)]
    ahead = _forward(graph)
    level = _levels(ahead)
    chains = _chains(ahead, level)
    layers = _order(names, level, chains.values())
    gap = width / max(len(layers), 1)
    box = (min(170.0, 0.72 * gap), 32.0)
    places: dict[Item, Point] = {}
    for number, layer in enumerate(layers):
        weights = [1.0 if isinstance(item, str) else 0.45 for item in layer]
        pitch = (bottom - top) / max(sum(weights), 1.0)
        pitch = min(pitch, 90.0)
        y = (top + bottom - pitch * sum(weights)) / 2
        for item, weight in zip(layer, weights, strict=True):
            places[item] = (gap * (number + 0.5), y + pitch * weight / 2)
            y += pitch * weight
    first = {label: model.declared(found[0]) for label, found in families.members.items()}
    return Drawing(
        places={name: places[name] for name in names},
        kinds={n: "hub" if _is_hub(n) else str(first[n].kind) for n in names},  # type: ignore[attr-defined]
        units={n: "" if _is_hub(n) else first[n].unit for n in names},
        box=box,
        arrows=tuple(_arrows(graph, ahead, chains, places, box)),
        loops=tuple(n for n in names if graph.has_edge(n, n)),
        alone=tuple(by_entity(n for n in model if families.of[n] not in graph)),
    )


def _arrows(
    graph: nx.DiGraph,
    ahead: nx.DiGraph,
    chains: dict[tuple[str, str], list[Item]],
    places: dict[Item, Point],
    box: Point,
) -> Iterable[Arrow]:
    for (cause, effect), chain in chains.items():
        inner = [places[item] for item in chain[1:-1]]
        (x0, y0), (x1, y1) = places[cause], places[effect]
        path = ((x0 + box[0] / 2, y0), *inner, (x1 - box[0] / 2, y1))
        back = graph.has_edge(effect, cause) and not ahead.has_edge(effect, cause)
        for lag in sorted(graph.edges[cause, effect]["lags"]):
            yield Arrow(path, lag, back)
