"""Graphs of other causal libraries. They are loaded when they are needed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import load
from scm_world.errors import UnknownOption
from scm_world.graph.exchange.model import CausalGraph, View, causal_graph, seen_as
from scm_world.graph.scm import SCM

RIGHT, LEFT, NONE = "-->", "<--", ""


def _acyclic(source: CausalGraph | SCM, view: View, library: str) -> CausalGraph:
    if view == "lagged":
        raise UnknownOption("view", view, ("summary", "two_slice"))
    graph = seen_as(causal_graph(source), view)
    graph.check_acyclic(library)
    return graph


# --- tigramite -----------------------------------------------------------------------------------


@final
@dataclass(frozen=True)
class TigramiteGraph:
    """What tigramite's functions take as ``graph`` and ``var_names``.

    Attributes:
        graph: Shape (n, n, max lag + 1), dtype ``<U3``. ``graph[i, j, lag]`` is ``"-->"`` if i acts
            on j; ``graph[j, i, 0]`` is then ``"<--"`` for lag 0. Elsewhere it is empty.
        var_names: The names, in order.
    """

    graph: NDArray[np.str_]
    var_names: tuple[str, ...]


def to_tigramite(source: CausalGraph | SCM) -> TigramiteGraph:
    """Write a graph as tigramite does; nothing needs to be installed.

    Raises:
        ModelError: Edges of lag 0 form a cycle, as in a summary graph.

    Example:
        >>> from scm_world.graph import Edge
        >>> from scm_world.graph.exchange import Node
        >>> found = to_tigramite(CausalGraph((Node("x"), Node("y")), (Edge("x", "y", 1),)))
        >>> found.graph.shape, str(found.graph[0, 1, 1])
        ((2, 2, 2), '-->')
    """
    graph = causal_graph(source)
    graph.check_acyclic("tigramite", lag=0)
    at = {name: i for i, name in enumerate(graph.names)}
    array = np.full((len(at), len(at), graph.max_lag + 1), NONE, dtype="<U3")
    for edge in graph.edges:
        cause, effect = at[edge.cause], at[edge.effect]
        array[cause, effect, edge.lag] = RIGHT
        if edge.lag == 0:
            array[effect, cause, 0] = LEFT
    return TigramiteGraph(array, graph.names)


# --- causal-learn --------------------------------------------------------------------------------


def to_causal_learn(source: CausalGraph | SCM, *, view: View = "two_slice") -> Any:
    """Write a graph as a ``causallearn.graph.GeneralGraph``.

    Raises:
        MissingExtra: causal-learn is not installed.
        ModelError: The view has a cycle.
        UnknownOption: There is no such view.
    """
    graph = _acyclic(source, view, "causal-learn")
    general = load("causallearn.graph.GeneralGraph", "causal-learn").GeneralGraph
    node = load("causallearn.graph.GraphNode", "causal-learn").GraphNode
    nodes = {name: node(name) for name in graph.names}
    made = general(list(nodes.values()))
    for edge in graph.edges:
        made.add_directed_edge(nodes[edge.cause], nodes[edge.effect])
    return made


# --- pgmpy and DoWhy -----------------------------------------------------------------------------


def to_pgmpy(source: CausalGraph | SCM, *, view: View = "two_slice") -> Any:
    """Write a graph as a ``pgmpy.base.DAG``; its ``edges()`` make any Bayesian network of pgmpy.

    Raises:
        MissingExtra: pgmpy is not installed.
        ModelError: The view has a cycle.
        UnknownOption: There is no such view.
    """
    graph = _acyclic(source, view, "pgmpy")
    return _bare(graph, load("pgmpy.base", "pgmpy").DAG())


def _bare(graph: CausalGraph, made: nx.DiGraph) -> nx.DiGraph:
    made.add_nodes_from(graph.names)
    made.add_edges_from((edge.cause, edge.effect) for edge in graph.edges)
    return made


def to_dowhy(source: CausalGraph | SCM, *, view: View = "two_slice") -> nx.DiGraph:
    """Return the graph that ``dowhy.CausalModel(graph=…)`` and ``dowhy.gcm`` take.

    Raises:
        ModelError: The view has a cycle.
        UnknownOption: There is no such view.
    """
    return _bare(_acyclic(source, view, "DoWhy"), nx.DiGraph())
