"""Distances between causal graphs, as boolean matrices: see ``scm_world.graph.equivalence``."""

from __future__ import annotations

import numpy as np

from scm_world._arguments import load
from scm_world.graph.equivalence import (
    Bools,
    essential_graph,
    extension,
    is_acyclic,
    meek,
    reaches,
)

KINDS = ("sid", "parent_aid", "ancestor_aid", "oset_aid")
"""Names of intervention distances, as ``gadjid`` has them."""

ROWS = "from row to column"  # how gadjid reads a matrix


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
    return None if member is None else shd(essential_graph(member), essential_graph(true))


def aid(found: Bools, true: Bools, kind: str) -> int | None:
    """Count the effects that come out wrong under an adjustment strategy, by ``gadjid``.

    Args:
        found: Edges with and without direction, shape (p, p).
        true: Acyclic, shape (p, p).
        kind: One of ``KINDS``. The structural intervention distance, ``"sid"``, adjusts for the
            parents that a cause has in the found graph.

    Returns:
        None if the found graph has a cycle, is not an essential graph, or of ``"sid"`` has an edge
        without direction.

    Raises:
        MissingExtra: ``gadjid`` is not installed.

    Source:
        Peters and Bühlmann, *Structural intervention distance for evaluating causal graphs*, Neural
        Computation 2015; Henckel, Würtzen and Weichwald, *Adjustment identification distance: a
        gadjid for causal structure learning*, UAI 2024.
    """
    distance = getattr(load("gadjid", "gadjid", "learn"), kind)
    member = extension(found)
    if member is None or not is_acyclic(true) or (kind == "sid" and (found & found.T).any()):
        return None
    closed = meek(found)
    together = reaches(closed & closed.T)
    if (closed & ~closed.T & together).any():  # an essential graph is a chain graph
        return None
    # 1 for an edge with a direction, 2 for one without
    coded = [graph.astype(np.int8) + (graph & graph.T).astype(np.int8) for graph in (true, closed)]
    _, wrong = distance(*coded, edge_direction=ROWS)
    return int(wrong)
