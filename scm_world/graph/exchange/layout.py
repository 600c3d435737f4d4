"""Where the nodes of a graph go in every picture: in columns, causes left of their effects."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from itertools import pairwise
from typing import Any

import networkx as nx
import numpy as np

Item = Any
"""A node, or ``(cause, effect, column)``: where a long edge passes a column between its ends."""


def forward(graph: nx.DiGraph) -> nx.DiGraph:
    """Return a graph without the edges that close a cycle through time.

    Args:
        graph: The attribute ``lags`` of each edge is the set of its lags. Of the edges within a
            strongly connected component only contemporaneous ones are kept, if they are acyclic.
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
    """Return the column of each node of an acyclic graph.

    It is the longest way from a root; but roots stand right before an effect, and nodes without
    effects right after their causes.
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
    """Return what stands beside each item on a route."""
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

    Items are ordered by the mean of their neighbors, and then moved as near to it as the heights of
    the others allow (isotonic regression).

    Args:
        column: Of each item.
        near: Neighbors of items in other columns.
        height: Of an item, with the room around it.

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
