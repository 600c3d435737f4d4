"""Graphs of a model: what causes what, with and without time."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import networkx as nx
import numpy as np

from scm_world._arguments import typed, whole_number
from scm_world.errors import ModelError, UnknownOption, UnknownVariable
from scm_world.graph.ancestral import window
from scm_world.graph.exchange import to_digraph
from scm_world.graph.scm import SCM

Node = str | tuple[str, int]
"""A variable now, or a variable at an earlier slice: ``("tool_block.mass", -1)``."""


def _longest_lag(graph: nx.MultiDiGraph) -> int:
    return max((lag for *_, lag in graph.edges(keys=True)), default=0)


def unrolled(source: SCM | nx.DiGraph, steps: int) -> nx.DiGraph:
    """Return the graph of some control steps, with nodes ``(name, -steps + 1)`` to ``(name, 0)``.

    A parameter keeps its value from one step to the next: an edge with ``persists=True``.

    Args:
        source: A model, or any directed networkx graph; the attribute ``lag`` of an edge counts.
        steps: The number of control steps, at least 1.
    """
    graph, made, steps = to_digraph(source), nx.DiGraph(), whole_number("steps", steps, least=1)
    for slice_ in range(1 - steps, 1):
        made.add_nodes_from(
            ((name, slice_), {**data, "variable": name, "slice": slice_})
            for name, data in graph.nodes(data=True)
        )
        for cause, effect, lag, data in graph.edges(keys=True, data=True):
            if slice_ - lag > -steps:
                made.add_edge((cause, slice_ - lag), (effect, slice_), **data)
        for name in _held(graph) if slice_ > 1 - steps else ():
            made.add_edge((name, slice_ - 1), (name, slice_), lag=1, persists=True)
    return made


def _held(graph: nx.MultiDiGraph) -> list[str]:
    """List the parameters without causes, which keep their value from one step to the next."""
    return [
        name
        for name, data in graph.nodes(data=True)
        if data.get("role") == "parameter"
        and data.get("per") != "step"
        and not graph.in_degree(name)
    ]


def window_of(graph: nx.MultiDiGraph) -> nx.DiGraph:
    """Return the present and as many slices before it as the longest lag, with their common past.

    Two nodes are d-separated exactly where they are in a graph unrolled without end: this is its
    latent projection. Nodes are those of ``unrolled``; ``("past", 1)``, … are unobserved.

    Source:
        Verma and Pearl, *Equivalence and synthesis of causal models*, UAI 1990, for projections;
        a clique of bidirected edges separates as one common cause does.
    """
    past, place = _longest_lag(graph), {name: number for number, name in enumerate(graph)}
    edges = np.zeros((past + 1, len(place), len(place)), dtype=bool)  # lag, cause, effect
    for cause, effect, lag in graph.edges(keys=True):
        edges[lag, place[cause], place[effect]] = True
    for name in _held(graph) if past else ():
        edges[1, place[name], place[name]] = True
    _, shared = window(edges, np.zeros_like(edges), past)
    nodes = [(name, slice_) for slice_ in range(-past, 1) for name in graph]
    pairs = nx.Graph((nodes[i], nodes[j]) for i, j in np.argwhere(np.triu(shared)).tolist())
    made = unrolled(graph, past + 1)
    for number, effects in enumerate(sorted(map(sorted, nx.find_cliques(pairs))), start=1):
        made.add_node(("past", number), observed="no")
        made.add_edges_from((("past", number), effect) for effect in effects)
    return made


def to_dag(source: SCM | nx.DiGraph) -> nx.DiGraph:
    """Return the acyclic graph of a model that ``identify`` and DoWhy take.

    Without lags it has the names of the variables. With lags there are as many slices as the
    longest lag reaches: ``name`` is now, ``name@-1`` one step ago. A parameter keeps its value, so
    its past is called ``name@=-1`` and has an edge to ``name``. Causes before the first slice that
    several nodes have in common are nodes ``past_1@-2``, … with ``observed="no"``, DoWhy's mark of
    unobserved nodes.

    Args:
        source: A model, or any directed networkx graph; the attribute ``lag`` of an edge counts.

    Raises:
        ModelError: Edges of lag 0 form a cycle.
        UnknownOption: The source is not a graph.
    """
    graph, made = to_digraph(source), nx.DiGraph()
    held, past, slices = _held(graph), _longest_lag(graph), window_of(graph)

    def named(node: tuple[str, int]) -> str:
        name, slice_ = node
        if slice_ > 0:
            return f"past_{slice_}@-{past + 1}"
        return f"{name}@{'=' if name in held else ''}{slice_}" if slice_ else name

    for node in sorted(slices, key=lambda node: (node[1] > 0, abs(node[1]))):  # the present first
        data = graph.nodes.get(node[0], {}) if node[1] <= 0 else slices.nodes[node]
        made.add_node(named(node), **{k: v for k, v in data.items() if k == "observed"})
    made.add_edges_from((named(cause), named(effect)) for cause, effect in slices.edges)
    if not nx.is_directed_acyclic_graph(made):
        cycle = [cause for cause, _ in nx.find_cycle(made)]
        path = " → ".join([*cycle, cycle[0]])
        raise ModelError([f"edges of lag 0 form a cycle: {path}; give edges their lag"])
    return made


@typed
def episode_outcome(
    model: SCM, outcomes: Iterable[str], *, starts: Iterable[str] = (), contact: bool = True
) -> nx.DiGraph:
    """Return the static graph of one episode: parameters, starting states and outcomes.

    A parameter is a cause of an outcome where a path through time leads from one to the other that
    passes no further parameter.

    Args:
        model: With or without interventions.
        outcomes: States or readouts, at the end.
        starts: States that vary at the beginning; their nodes are named ``"<name>@0"``.
        contact: Whether bodies may touch; edges by contact are left out if not.

    Example:
        >>> from scm_world.variables import Exogenous, Measured, Parent
        >>> model = SCM([
        ...     Exogenous(name="mass"), Exogenous(name="color"),
        ...     Measured(name="speed", parents=("mass", Parent("speed", 1))),
        ... ])
        >>> sorted(episode_outcome(model, ["speed"], starts=["speed"]).edges)
        [('mass', 'speed'), ('speed@0', 'speed')]
    """
    parameters = [name for name in model if model.declared(name).role == "parameter"]
    edges = [edge for edge in model.edges if contact or edge.when != "contact"]
    follow = nx.DiGraph((edge.cause, edge.effect) for edge in edges)
    follow.add_nodes_from(model)
    graph = nx.DiGraph()
    graph.add_nodes_from(parameters)
    graph.add_edges_from(
        (edge.cause, edge.effect)
        for edge in edges
        if edge.cause in graph and edge.effect in graph and edge.when != "set"
    )
    still = set(parameters)
    moving = follow.subgraph([name for name in follow if name not in still])
    for outcome in (outcomes,) if isinstance(outcomes, str) else outcomes:
        causes = {model.declared(outcome).name}
        causes |= nx.ancestors(moving, outcome) if outcome in moving else set()
        direct = {p for name in causes for p in follow.predecessors(name) if p in still}
        graph.add_edges_from((parameter, outcome) for parameter in sorted(direct))
        graph.add_edges_from((f"{name}@0", outcome) for name in starts if name in causes)
    return graph


@typed
def d_separated(
    model: SCM, x: Iterable[Node], y: Iterable[Node], given: Iterable[Node] = ()
) -> bool:
    """Return whether ``given`` blocks every path between ``x`` and ``y``.

    In a model with lagged edges a plain name means the present slice and ``(name, -1)`` the one
    before. A common past connects two nodes, however long ago it was.

    Raises:
        UnknownVariable: A node is not in the model.
        UnknownOption: A node is in two of the sets.

    Source:
        Pearl, *Causality*, 2nd ed., section 1.2.3; computed by networkx.
    """
    graph = window_of(to_digraph(model))

    def nodes(chosen: Iterable[Node]) -> set[Any]:
        found: set[Any] = set()
        for node in (chosen,) if isinstance(chosen, str) else chosen:
            full = (node, 0) if isinstance(node, str) else node
            if full not in graph or not -1 <= full[1] <= 0:
                raise UnknownVariable(str(node), list(model))
            found.add(full)
        return found

    first, second, blocked = nodes(x), nodes(y), nodes(given)
    if twice := (first & second) | (first & blocked) | (second & blocked):
        raise UnknownOption("nodes", sorted(twice), ("three sets without a node in common",))
    return bool(nx.is_d_separator(graph, first, second, blocked))
