"""Graphs of a model: what causes what, with and without time."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import networkx as nx

from scm_world._arguments import whole_number
from scm_world.errors import UnknownOption, UnknownVariable
from scm_world.graph.exchange import slices_of, to_digraph, window_of
from scm_world.graph.scm import SCM

Node = str | tuple[str, int]
"""A variable now, or a variable at an earlier slice: ``("tool_block.mass", -1)``."""


def unrolled(model: SCM, steps: int) -> nx.DiGraph:
    """Return the graph of some control steps, with nodes ``(name, -steps + 1)`` to ``(name, 0)``.

    A parameter keeps its value from one step to the next: an edge with ``persists=True``.
    """
    return slices_of(to_digraph(model), whole_number("steps", steps, least=1))


def episode_outcome(
    model: SCM, outcomes: Iterable[str], *, starts: Iterable[str] = (), contact: bool = True
) -> nx.DiGraph:
    """Return the static graph of one episode: parameters, starting states, and what it ends with.

    Time is folded up: a parameter is a cause of an outcome where a path leads from one to the
    other that passes no further parameter.

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
    _check_model(model)
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


def _check_model(model: Any) -> None:
    if not isinstance(model, SCM):
        raise UnknownOption("model", model, ("an SCM, such as world.model",))


def d_separated(
    model: SCM, x: Iterable[Node], y: Iterable[Node], given: Iterable[Node] = ()
) -> bool:
    """Return whether ``given`` blocks every path between ``x`` and ``y``.

    In a model with lagged edges a plain name means the present slice and ``(name, -1)`` the one
    before. What a common past connects, however long ago, is connected.

    Raises:
        UnknownVariable: A node is not in the model.
        UnknownOption: A node is in two of the sets.

    Source:
        Pearl, *Causality*, 2nd ed., section 1.2.3; computed by networkx.
    """
    _check_model(model)
    graph = window_of(to_digraph(model))

    def nodes(chosen: Iterable[Node]) -> set[Any]:
        found: set[Any] = set()
        if not isinstance(chosen, Iterable):
            raise UnknownOption("nodes", chosen, ("names of variables",))
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
