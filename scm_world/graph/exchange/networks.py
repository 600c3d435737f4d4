"""networkx, its file formats GML, GraphML and node-link JSON, and what takes its graphs."""

from __future__ import annotations

import json
from typing import Any

import networkx as nx

from scm_world.graph.exchange.model import CausalGraph, edge_attributes, from_parts


def to_digraph(graph: CausalGraph) -> nx.DiGraph:
    """Write a graph as a networkx graph whose nodes and edges carry their attributes.

    Returns:
        A ``DiGraph``; a ``MultiDiGraph`` with the lag as key if a pair has edges of several lags.

    Example:
        >>> from scm_world.graph.exchange import Node
        >>> to_digraph(CausalGraph((Node("x", unit="kg"),), ())).nodes["x"]
        {'unit': 'kg'}
    """
    pairs = {(edge.cause, edge.effect) for edge in graph.edges}
    several = len(pairs) < len(graph.edges)
    made = nx.MultiDiGraph() if several else nx.DiGraph()
    made.add_nodes_from((node.name, node.attributes) for node in graph.nodes)
    for edge in graph.edges:
        key = {"key": edge.lag} if several else {}
        made.add_edge(edge.cause, edge.effect, **key, **edge_attributes(edge))
    return made


def from_digraph(graph: nx.DiGraph) -> CausalGraph:
    """Read any directed networkx graph; edges without a lag have lag 0.

    Raises:
        ValueError: It is not directed, or see ``CausalGraph``.
    """
    if not graph.is_directed():
        raise ValueError("its edges are not directed")
    return from_parts(graph.nodes(data=True), graph.edges(data=True))


def to_gml(graph: CausalGraph) -> str:
    """Write a graph in the Graph Modelling Language."""
    return "\n".join(nx.generate_gml(to_digraph(graph)))


def from_gml(text: str) -> CausalGraph:
    """Read a directed graph in the Graph Modelling Language; labels are names."""
    return from_digraph(nx.parse_gml(text))


def to_graphml(graph: CausalGraph) -> str:
    """Write a graph as GraphML, which is XML."""
    return "\n".join(nx.generate_graphml(to_digraph(graph)))


def from_graphml(text: str) -> CausalGraph:
    """Read a directed graph as GraphML; identifiers are names."""
    return from_digraph(nx.parse_graphml(text))


def to_node_link(graph: CausalGraph) -> str:
    """Write a graph as the JSON that ``networkx.node_link_graph(…, edges="edges")`` reads.

    The text is the same for all versions of networkx, which differ in their defaults.
    """
    made = to_digraph(graph)
    nodes = [{"id": node.name, **node.attributes} for node in graph.nodes]
    edges = [
        {
            "source": edge.cause,
            "target": edge.effect,
            **edge_attributes(edge),
            **({"key": edge.lag} if made.is_multigraph() else {}),
        }
        for edge in graph.edges
    ]
    data = {
        "directed": True,
        "multigraph": made.is_multigraph(),
        "graph": {},
        "nodes": nodes,
        "edges": edges,
    }
    return json.dumps(data, indent=1, ensure_ascii=False)


def from_node_link(text: str) -> CausalGraph:
    """Read node-link JSON of any version of networkx, with ``edges`` or ``links``."""
    data: Any = json.loads(text)
    if not isinstance(data, dict) or not data.get("directed", False):
        raise ValueError("expected an object with 'directed': true")
    edges = data["links"] if "links" in data else data["edges"]
    return from_parts(
        ((node["id"], node) for node in data["nodes"]),
        ((edge["source"], edge["target"], edge) for edge in edges),
    )


def bare(graph: CausalGraph) -> nx.DiGraph:
    """Write names and edges only, for libraries that take attributes for something else."""
    made = nx.DiGraph()
    made.add_nodes_from(graph.names)
    made.add_edges_from((edge.cause, edge.effect) for edge in graph.edges)
    return made
