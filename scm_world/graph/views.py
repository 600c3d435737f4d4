"""Graphs of a model: what causes what, with and without time."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import networkx as nx

from scm_world.errors import UnknownVariable
from scm_world.graph.scm import SCM

Node = str | tuple[str, int]
"""A variable now, or a variable at an earlier slice: ``("tool_block.mass", -1)``."""


def summary(model: SCM) -> nx.DiGraph:
    """Draw one node per variable and one arrow per pair, with the lags it has.

    Returns:
        A directed graph, which may have loops and cycles through time. Nodes carry ``kind``,
        ``unit`` and ``role``, edges ``lags`` and ``when``:
        the condition, both as ``"contact or set"``, None if it always holds.
    """
    graph = nx.DiGraph()
    for name in model:
        variable: Any = model[name]
        graph.add_node(name, kind=variable.kind, unit=variable.unit, role=variable.role)
    for edge in model.edges:
        old = graph.get_edge_data(edge.cause, edge.effect, {"lags": (), "when": edge.when})
        lags = tuple(sorted({*old["lags"], edge.lag}))
        when = edge.when
        if old["when"] != when:
            when = " or ".join(sorted((old["when"], when))) if old["when"] and when else None
        graph.add_edge(edge.cause, edge.effect, lags=lags, when=when)
    return graph


def contemporaneous(model: SCM) -> nx.DiGraph:
    """Draw the directed acyclic graph of the edges that act within an instant."""
    graph = nx.DiGraph()
    graph.add_nodes_from(model)
    graph.add_edges_from((e.cause, e.effect) for e in model.edges if e.lag == 0)
    return graph


def unrolled(model: SCM, steps: int) -> nx.DiGraph:
    """Draw some control steps, with nodes ``(name, -steps + 1)`` to ``(name, 0)``.

    A parameter keeps its value from one step to the next; this is an edge with
    ``persists=True``.

    Returns:
        A directed acyclic graph.
    """
    graph = nx.DiGraph()
    persistent = [n for n in model if model[n].role == "parameter" and not model.parents(n)]
    for slice_ in range(1 - steps, 1):
        graph.add_nodes_from(
            ((name, slice_), {"variable": name, "slice": slice_}) for name in model
        )
        for edge in model.edges:
            if edge.lag == 0 or slice_ > 1 - steps:
                cause = (edge.cause, slice_ - edge.lag)
                graph.add_edge(cause, (edge.effect, slice_), lag=edge.lag)
        if slice_ > 1 - steps:
            for name in persistent:
                graph.add_edge((name, slice_ - 1), (name, slice_), lag=1, persists=True)
    return graph


def two_slice(model: SCM) -> nx.DiGraph:
    """Draw two control steps, with nodes ``(name, -1)`` and ``(name, 0)``; see ``unrolled``."""
    return unrolled(model, 2)


def episode_outcome(
    model: SCM, outcomes: Iterable[str], *, starts: Iterable[str] = ()
) -> nx.DiGraph:
    """Give the static graph of one episode: parameters, starting states, and what it ends with.

    Time is folded up: a parameter is a cause of an outcome where a path leads from one to the
    other that passes no further parameter.

    Args:
        model: With or without interventions.
        outcomes: States or readouts, at the end.
        starts: States that vary at the beginning.

    Returns:
        A directed acyclic graph. A starting state has the name of the variable with ``@0``.

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
    follow = summary(model)
    graph = nx.DiGraph()
    graph.add_nodes_from(parameters)
    graph.add_edges_from(
        (edge.cause, edge.effect)
        for edge in model.edges
        if edge.cause in graph and edge.effect in graph and edge.when != "set"
    )
    still = set(parameters)
    moving = follow.subgraph([name for name in follow if name not in still])
    for outcome in outcomes:
        causes = {model.declared(outcome).name, *nx.ancestors(moving, outcome)}
        direct = {p for name in causes for p in follow.predecessors(name) if p in still}
        graph.add_edges_from((parameter, outcome) for parameter in sorted(direct))
        graph.add_edges_from((f"{name}@0", outcome) for name in starts if name in causes)
    return graph


def d_separated(
    model: SCM, x: Iterable[Node], y: Iterable[Node], given: Iterable[Node] = ()
) -> bool:
    """Tell whether ``given`` blocks every path between ``x`` and ``y``.

    In a model with lagged edges a plain name means the present slice and ``(name, -1)`` the one
    before. As many earlier slices as the model has variables are
    looked at too, so that what a common past connects is seen to be connected.

    Raises:
        UnknownVariable: A node is not in the model.

    Source:
        Pearl, *Causality*, 2nd ed., section 1.2.3; computed by networkx.

    Example:
        >>> from scm_world.variables import Derived, Exogenous, Linear
        >>> chain = SCM([
        ...     Exogenous(name="a"),
        ...     Derived(name="b", parents=("a",), mechanism=Linear(weights=(1.0,))),
        ...     Derived(name="c", parents=("b",), mechanism=Linear(weights=(1.0,))),
        ... ])
        >>> d_separated(chain, ["a"], ["c"]), d_separated(chain, ["a"], ["c"], given=["b"])
        (False, True)
    """
    temporal = any(edge.lag for edge in model.edges)
    graph = unrolled(model, len(model) + 2) if temporal else contemporaneous(model)

    def nodes(chosen: Iterable[Node]) -> set[Any]:
        found: set[Any] = set()
        for node in (chosen,) if isinstance(chosen, str) else chosen:
            full = (node, 0) if temporal and isinstance(node, str) else node
            slice_ = 0 if isinstance(full, str) else full[1]
            if full not in graph or slice_ < -1:
                raise UnknownVariable(str(node), list(model))
            found.add(full)
        return found

    return bool(nx.is_d_separator(graph, nodes(x), nodes(y), nodes(given)))
