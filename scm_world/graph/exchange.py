"""Graphs in and out, by networkx; ``docs/graphs.md`` says how other libraries take them.

Mechanisms stay here; ``scm_world.graph.to_json`` writes a whole model.
"""

from __future__ import annotations

from typing import Any

import networkx as nx

from scm_world.errors import ModelError, UnknownOption
from scm_world.graph.scm import SCM
from scm_world.variables import Affine, Box, Either, Space, Switch
from scm_world.variables.spaces import Bound, listed

DIGITS = 6  # of a number in the text of a space


def to_digraph(source: SCM | nx.DiGraph) -> nx.MultiDiGraph:
    """Return a causal graph as a networkx graph in which the key of an edge is its lag.

    Nodes carry ``kind``, ``role``, ``unit``, ``value_shape``, ``bounds``, ``a``, ``b`` and ``doc``
    as text, as far as they have them; edges carry ``lag`` and the condition ``when``. Interventions
    on a model cut edges.

    Args:
        source: A model, or any directed networkx graph; its edges without a lag have lag 0.

    Raises:
        UnknownOption: The source is not a graph.
        ModelError: The edges have no direction, or a lag is not a whole number from 0.

    Example:
        >>> from scm_world.variables import Derived, Exogenous, Linear
        >>> model = SCM([
        ...     Exogenous(name="mass", unit="kg"),
        ...     Derived(name="weight", unit="N", parents=("mass",),
        ...             mechanism=Linear(weights=(9.81,))),
        ... ])
        >>> to_digraph(model).edges(keys=True)
        OutMultiEdgeView([('mass', 'weight', 0)])
        >>> to_digraph(model.do({"weight": 1.0})).edges
        OutMultiEdgeView([])
    """
    graph = nx.MultiDiGraph()
    if not isinstance(source, SCM):
        if not isinstance(source, nx.Graph):
            raise UnknownOption("graph", source, ("a model (SCM)", "a directed graph of networkx"))
        if not source.is_directed():
            raise ModelError(["the edges of the graph have no direction"])
        graph.add_nodes_from(source.nodes(data=True))
        for cause, effect, data in source.edges(data=True):
            lag = data.get("lag", 0)
            if not isinstance(lag, int) or lag < 0:
                said = f"the lag {lag!r} of {cause!r} → {effect!r} is not a whole number"
                raise ModelError([said])
            graph.add_edge(cause, effect, lag, **{**data, "lag": lag})
        return graph
    for variable in (source[name] for name in source):
        given: Any = variable
        spaces = {"bounds": variable.bounds, "a": variable.a, "b": variable.b}
        about = {
            "kind": given.kind,
            "role": variable.role,
            "unit": variable.unit,
            "per": "step" if getattr(given, "per", "") == "step" else "",
            "value_shape": "x".join(map(str, variable.shape)),
            **{key: ", ".join(space_lines(s, digits=DIGITS)) for key, s in spaces.items()},
            "doc": " ".join(variable.doc.split()),
        }
        graph.add_node(variable.name, **{key: text for key, text in about.items() if text})
    for edge in sorted(source.edges, key=lambda edge: edge.key):
        when = {} if edge.when is None else {"when": edge.when}
        graph.add_edge(edge.cause, edge.effect, edge.lag, lag=edge.lag, **when)
    return graph


def space_lines(space: Space | None, *, digits: int = 4) -> list[str]:
    """Return a space in words, with the names of the variables that it follows.

    There is one line, or one per component where they differ; numbers have so many digits.
    """
    match space:
        case None:
            return []
        case Box(low=low, high=high):
            lines = ([_end(part, digits) for part in listed(end)] for end in (low, high))
            return _box_lines(*lines)
        case Either(first=first, second=second):
            parts = (", ".join(space_lines(part, digits=digits)) for part in (first, second))
            return [" or ".join(parts)]
    return [space.describe((), {})]


def _box_lines(lows: list[str], highs: list[str]) -> list[str]:
    size = max(len(lows), len(highs))
    ends = zip(*(end * size if len(end) == 1 else end for end in (lows, highs)), strict=True)
    pairs = [low if low == high else f"{low} to {high}" for low, high in ends]
    if len(set(pairs)) == 1:
        return pairs[:1]
    finger = pairs[:3]
    return finger if pairs == finger * (size // 3) else pairs


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
