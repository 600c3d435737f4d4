"""Graphs in and out, by networkx; ``docs/graphs.md`` says how other libraries take them.

Mechanisms stay here; ``scm_world.graph.to_json`` writes a whole model.
"""

from __future__ import annotations

from typing import Any

import networkx as nx

from scm_world.errors import ModelError, UnknownOption
from scm_world.graph.scm import SCM


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
            **{key: "" if s is None else s.describe() for key, s in spaces.items()},
            "doc": " ".join(variable.doc.split()),
        }
        graph.add_node(variable.name, **{key: text for key, text in about.items() if text})
    for edge in sorted(source.edges, key=lambda edge: edge.key):
        when = {} if edge.when is None else {"when": edge.when}
        graph.add_edge(edge.cause, edge.effect, edge.lag, lag=edge.lag, **when)
    return graph
