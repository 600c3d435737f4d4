"""Distances between causal graphs, as boolean matrices: see ``scm_world.graph.equivalence``."""

from __future__ import annotations

import importlib.util
from importlib import import_module
from itertools import islice
from typing import Literal

import numpy as np

from scm_world._types import Integers
from scm_world.errors import MissingExtra
from scm_world.graph.equivalence import (
    Bools,
    as_graph,
    chain_components,
    cpdag,
    extension,
    extensions,
    is_acyclic,
    meek,
    meets,
    reaches,
    topological_order,
)

Adjustment = Literal["parent", "ancestor", "oset"]

MEMBERS = 1_000
"""Most members of a chain component that ``sid_bounds`` goes through."""


def shd(found: Bools, true: Bools) -> int:
    """Count the pairs of nodes that are joined differently: the structural Hamming distance.

    A missing, an additional and a turned edge count 1 each, and so does an edge without direction
    where the true one has a direction or does not exist. Shapes are (p, p).

    Source:
        Tsamardinos, Brown and Aliferis, *The max-min hill-climbing Bayesian network structure
        learning algorithm*, Machine Learning 2006.

    Example:
        >>> shd(np.array([[0, 1], [1, 0]], bool), np.array([[0, 1], [0, 0]], bool))
        1
    """
    differ = found != true
    return int(np.triu(differ | differ.T, 1).sum())


def shd_of_classes(found: Bools, true: Bools) -> int | None:
    """Compute the distance between the essential graphs; None if the found graph has none.

    A graph without direction somewhere stands for the class of the acyclic graphs that it can
    become without another v-structure.
    """
    member = extension(found)
    return None if member is None else shd(cpdag(member), cpdag(true))


def sid(found: Bools, true: Bools) -> int:
    """Count the pairs (i, j) whose effect p(j | do(i)) comes out wrong: the intervention distance.

    Adjusting for the parents that i has in the found graph must give the effect in the true one.
    Both are acyclic, shape (p, p).

    Raises:
        ModelError: One of them has a cycle or an edge without direction.

    Source:
        Peters and Bühlmann, *Structural intervention distance for evaluating causal graphs*,
        Neural Computation 2015.

    Example:
        >>> true = np.array([[0, 1, 1], [0, 0, 1], [0, 0, 0]], bool)
        >>> sid(np.zeros((3, 3), bool), true)
        4
    """
    found, true = as_graph(found), as_graph(true)
    for graph in (found, true):
        topological_order(graph)
    return int(wrong_effects(true, np.arange(len(true)), found.T).sum())


def sid_bounds(found: Bools, true: Bools) -> tuple[int, int] | None:
    """Return the least and the greatest SID of the acyclic graphs that the found one can become.

    Args:
        found: Edges with and without direction, shape (p, p).
        true: Acyclic, shape (p, p).

    Returns:
        Both are exact. None if it can become none, or if there are more than ``MEMBERS`` ways to
        direct a chain component.

    Raises:
        ModelError: The true graph has a cycle.

    Source:
        Peters and Bühlmann 2015, section 2.4.3: chain components can be directed independently.
    """
    topological_order(true)
    if extension(found) is None:
        return None
    closed = meek(found)
    parts = chain_components(closed) if is_chain_graph(closed) else (tuple(range(len(true))),)
    least = most = 0
    for part in parts:
        members = _parents_of(closed, np.array(part))
        if members is None:
            return None
        sums = _sums(true, np.array(part), members)
        least, most = least + int(sums.min()), most + int(sums.max())
    return least, most


def is_chain_graph(graph: Bools) -> bool:
    """Return whether no directed edge joins nodes that undirected edges connect."""
    together = reaches(graph & graph.T)
    return not (graph & ~graph.T & together).any()


def _parents_of(graph: Bools, part: Integers) -> Bools | None:
    """List the parents of each node of a part in each member, shape (members, nodes, p)."""
    inner = graph[np.ix_(part, part)]
    members = list(islice(extensions(inner), MEMBERS + 1))
    if len(members) > MEMBERS:
        return None
    outer = graph & ~graph.T
    outer[np.ix_(part, part)] = False
    parents = np.repeat(outer.T[part][None], len(members), axis=0)
    parents[:, :, part] = np.array(members).transpose(0, 2, 1)
    return parents


def _sums(true: Bools, part: Integers, members: Bools) -> Integers:
    """Count the wrong effects of the nodes of a part, for each member."""
    total = np.zeros(len(members), dtype=np.int64)
    for place, node in enumerate(part):
        kinds, at = np.unique(members[:, place], axis=0, return_inverse=True)
        wrong = wrong_effects(true, np.full(len(kinds), node), kinds).sum(axis=1)
        total += wrong[at.reshape(-1)]
    return total


def wrong_effects(true: Bools, causes: Integers, adjusted: Bools) -> Bools:
    """Return which effects come out wrong if one adjusts for these nodes, shape (r, p).

    What is adjusted for is taken for a parent of the cause, so no effect on it is expected.

    Args:
        true: Acyclic, shape (p, p).
        causes: Of r questions, shape (r,).
        adjusted: The nodes adjusted for, shape (r, p); not the cause.

    Source:
        Shpitser, VanderWeele and Robins, *On the validity of covariate adjustment for estimating
        causal effects*, UAI 2010, for what is right; Henckel, Würtzen and Weichwald, *Adjustment
        identification distance*, UAI 2024, for checking all effects of a cause in one sweep.
    """
    below = reaches(true)
    affected = below[causes]
    affected[np.arange(len(causes)), causes] = False
    opens = meets(adjusted, below.T)  # nodes adjusted for, and their ancestors
    forbidden = meets(affected & opens, below)  # effects by way of something that is adjusted for
    wrong = forbidden | _reached_otherwise(true, causes, adjusted, opens)
    wrong = np.where(adjusted, affected, wrong)
    wrong[np.arange(len(causes)), causes] = False
    return wrong


def _reached_otherwise(true: Bools, causes: Integers, adjusted: Bools, opens: Bools) -> Bools:
    """Return what is reached by an open path that does not go along all arrows.

    The walks that go along all arrows so far, those that do not and last went along one, and those
    that last went against one grow by one edge at a time.
    """
    rows = np.arange(len(causes))
    straight, along, against = true[causes], np.zeros_like(adjusted), true.T[causes]
    while True:
        straight[rows, causes] = along[rows, causes] = against[rows, causes] = False
        passed = ~adjusted
        up = against | meets(((straight | along) & opens) | (against & passed), true.T)
        down = along | meets((along | against) & passed, true)
        ahead = straight | meets(straight & passed, true)
        grown = np.array([ahead, down, up])
        grown[:, rows, causes] = False
        if np.array_equal(grown, np.array([straight, along, against])):
            return along | against
        straight, along, against = grown


def aid(found: Bools, true: Bools, kind: Adjustment) -> int | None:
    """Count the effects that come out wrong under an adjustment strategy, by ``gadjid``.

    Args:
        found: Edges with and without direction, shape (p, p).
        true: Acyclic, shape (p, p).
        kind: What is adjusted for.

    Returns:
        None if the found graph has a cycle, or is no essential graph.

    Raises:
        MissingExtra: ``gadjid`` is not installed.

    Source:
        Henckel, Würtzen and Weichwald, *Adjustment identification distance: a gadjid for causal
        structure learning*, UAI 2024.
    """
    if not has_gadjid():
        raise MissingExtra("gadjid", "discovery")
    member = extension(found)
    if member is None or not is_acyclic(true):
        return None
    closed = meek(found)
    if not is_chain_graph(closed):
        return None
    distance = getattr(import_module("gadjid"), f"{kind}_aid")
    # 1 for an edge with a direction, 2 for one without
    coded = [graph.astype(np.int8) + (graph & graph.T).astype(np.int8) for graph in (true, closed)]
    _, wrong = distance(*coded, edge_direction="from row to column")
    return int(wrong)


def has_gadjid() -> bool:
    """Return whether the package that computes adjustment identification distances is there."""
    return importlib.util.find_spec("gadjid") is not None
