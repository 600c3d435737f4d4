"""Graphs of a model, with and without time, in and out by networkx.

``docs/graphs.md`` says how other libraries take them. Mechanisms stay here;
``scm_world.graph.to_json`` writes a whole model.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping
from typing import Any

import networkx as nx
import numpy as np

from scm_world._arguments import real_number, typed, whole_number
from scm_world.errors import ModelError, UnknownOption
from scm_world.graph.ancestral import window
from scm_world.graph.scm import SCM


def to_digraph(
    source: SCM | nx.DiGraph,
    *,
    strength: Mapping[tuple[str, str, int], float] | None = None,
    at_least: float = 0.0,
) -> nx.MultiDiGraph:
    """Return a causal graph as a networkx graph in which the key of an edge is its lag.

    Nodes carry ``kind``, ``role``, ``unit``, ``value_shape``, ``bounds``, ``a``, ``b`` and ``doc``
    as text, as far as they have them; edges carry ``lag`` and the condition ``when``. Interventions
    on a model cut edges.

    Args:
        source: A model, or any directed networkx graph; its edges without a lag have lag 0.
        strength: Strength of edges (cause, effect, lag), such as ``verify(world).strength``: an
            attribute of the edge.
        at_least: Edges that are weaker are left out; those without a strength stay.

    Raises:
        UnknownOption: The source is not a graph, or ``at_least`` is negative.
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
    real_number("at_least", at_least, least=0.0)
    graph = _of_model(source) if isinstance(source, SCM) else _of_networkx(source)
    for edge, size in (strength or {}).items():
        if graph.has_edge(*edge):
            graph.edges[edge]["strength"] = float(size)
    sizes = {edge: graph.edges[edge].get("strength", at_least) for edge in graph.edges}
    graph.remove_edges_from([edge for edge, size in sizes.items() if size < at_least])
    return graph


def _of_networkx(source: nx.DiGraph) -> nx.MultiDiGraph:
    if not isinstance(source, nx.Graph):
        raise UnknownOption("graph", source, ("a model (SCM)", "a directed graph of networkx"))
    if not source.is_directed():
        raise ModelError(["the edges of the graph have no direction"])
    graph = nx.MultiDiGraph()
    graph.add_nodes_from(source.nodes(data=True))
    for cause, effect, data in source.edges(data=True):
        lag = data.get("lag", 0)
        if not isinstance(lag, int) or lag < 0:
            said = f"the lag {lag!r} of {cause!r} → {effect!r} is not a whole number"
            raise ModelError([said])
        graph.add_edge(cause, effect, lag, **{**data, "lag": lag})
    return graph


def _of_model(source: SCM) -> nx.MultiDiGraph:
    graph = nx.MultiDiGraph()
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


def to_dag(source: SCM | nx.DiGraph) -> nx.DiGraph:
    """Return the acyclic graph of a model that ``identify``, networkx and DoWhy take.

    ``networkx.is_d_separator(to_dag(model), {"x"}, {"y"}, {"z"})`` asks for d-separation.

    Without lags it has the names of the variables. With lags there are as many slices as the
    longest lag reaches: ``name`` is now, ``name@-1`` one step ago. A parameter keeps its value, so
    its past is called ``name@=-1`` and has an edge to ``name``. Causes before the first slice that
    several nodes have in common are nodes ``past_1@-2``, … with ``observed="no"``, DoWhy's mark of
    unobserved nodes: two nodes are d-separated exactly where they are in a graph unrolled without
    end, of which this is the latent projection.

    Args:
        source: A model, or any directed networkx graph; the attribute ``lag`` of an edge counts.

    Raises:
        ModelError: Edges of lag 0 form a cycle.
        UnknownOption: The source is not a graph.

    Source:
        Verma and Pearl, *Equivalence and synthesis of causal models*, UAI 1990, for projections;
        a clique of bidirected edges separates as one common cause does.
    """
    graph, made = to_digraph(source), nx.DiGraph()
    past, held = max((lag for *_, lag in graph.edges(keys=True)), default=0), _held(graph)
    nodes = [(name, slice_) for slice_ in range(-past, 1) for name in graph]
    named = {
        (name, slice_): f"{name}@{'=' * (name in held)}{slice_}" if slice_ else name
        for name, slice_ in nodes
    }
    for name, slice_ in sorted(nodes, key=lambda node: -node[1]):  # the present first
        data = graph.nodes[name]
        made.add_node(named[name, slice_], **{k: v for k, v in data.items() if k == "observed"})
    made.add_edges_from((named[a], named[b]) for a, b in unrolled(graph, past + 1).edges)
    if not nx.is_directed_acyclic_graph(made):
        cycle = [cause for cause, _ in nx.find_cycle(made)]
        path = " → ".join([*cycle, cycle[0]])
        raise ModelError([f"edges of lag 0 form a cycle: {path}; give edges their lag"])
    place = {name: number for number, name in enumerate(graph)}
    edges = np.zeros((past + 1, len(place), len(place)), dtype=bool)  # lag, cause, effect
    for cause, effect, lag in graph.edges(keys=True):
        edges[lag, place[cause], place[effect]] = True
    for name in held if past else ():
        edges[1, place[name], place[name]] = True
    _, shared = window(edges, np.zeros_like(edges), past)
    pairs = nx.Graph((nodes[i], nodes[j]) for i, j in np.argwhere(np.triu(shared)).tolist())
    for number, effects in enumerate(sorted(map(sorted, nx.find_cliques(pairs))), start=1):
        made.add_node(hidden := f"past_{number}@-{past + 1}", observed="no")
        made.add_edges_from((hidden, named[effect]) for effect in effects)
    return made


@typed
def episode_outcome(
    model: SCM,
    outcomes: Iterable[str],
    *,
    starts: Iterable[str] = (),
    contact: bool = True,
    without: Container[tuple[str, str, int]] = (),
) -> nx.DiGraph:
    """Return the static graph of one episode: parameters, starting states and outcomes.

    A parameter is a cause of an outcome where a path through time leads from one to the other that
    passes no further parameter.

    Args:
        model: With or without interventions.
        outcomes: States or readouts, at the end.
        starts: States that vary at the beginning; their nodes are named ``"<name>@0"``.
        contact: Whether bodies may touch; edges by contact are left out if not.
        without: Edges (cause, effect, lag) that do not act, either.

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
    edges = [e for e in model.edges if (contact or e.when != "contact") and e.key not in without]
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
