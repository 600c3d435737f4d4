"""Equivalence classes of acyclic graphs: those with the same conditional independences.

A graph is a boolean matrix of shape (p, p): ``graph[i, j]`` says that i acts on j. Where both
``graph[i, j]`` and ``graph[j, i]`` hold, the edge has no direction. Nothing is on the diagonal.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from scm_world.errors import ModelError

Bools = NDArray[np.bool_]


def as_graph(matrix: NDArray[np.generic]) -> Bools:
    """Return a new graph with an edge wherever a square matrix, without a diagonal, is not zero."""
    graph: Bools = np.asarray(matrix) != 0
    if graph.ndim != 2 or graph.shape[0] != graph.shape[1]:
        raise ModelError([f"a graph is a square matrix; this one has shape {graph.shape}"])
    loops = np.flatnonzero(graph.diagonal())
    if len(loops):
        raise ModelError([f"node {loops[0]} acts on itself; clear the diagonal"])
    return graph


def is_acyclic(graph: Bools) -> bool:
    """Return whether no node acts on itself, even through others; no undirected edge either."""
    return not meets(reaches(graph), graph).diagonal().any()


def reaches(graph: Bools) -> Bools:
    """Return the reflexive, transitive closure: [i, j] if i is j or one of its ancestors.

    A few products of matrices are some ten times faster than ``nx.transitive_closure``.
    """
    closure: Bools = graph | np.eye(len(graph), dtype=bool)
    for _ in range(max(len(graph) - 1, 1).bit_length()):
        closure = meets(closure, closure)
    return closure


def meets(left: Bools, right: Bools) -> Bools:
    """Multiply boolean matrices: [i, j] if left[i, k] and right[k, j] for some k."""
    result: Bools = (left.astype(np.float32) @ right.astype(np.float32)) > 0
    return result


def essential_graph(dag: Bools, targets: Iterable[Iterable[int]] = ()) -> Bools:
    """Return the essential graph (CPDAG), or the interventional one (I-MEC) of some interventions.

    Edges keep a direction on which all equivalent graphs agree.

    Args:
        dag: The true graph, shape (p, p).
        targets: For each intervention the nodes that it sets, one or several.

    Raises:
        ModelError: The graph has a cycle.

    Source:
        Hauser and Bühlmann, *Characterization and greedy learning of interventional Markov
        equivalence classes of directed acyclic graphs*, JMLR 2012: an edge with exactly one end
        in a target shows its direction; the rest follows by the rules of Meek.

    Example:
        >>> chain = np.array([[0, 1, 0], [0, 0, 1], [0, 0, 0]], bool)
        >>> essential_graph(chain, [(1,)]).astype(int).tolist()
        [[0, 1, 0], [0, 0, 1], [0, 0, 0]]
    """
    dag, listed = as_graph(dag), [list(target) for target in targets]
    if not is_acyclic(dag):
        raise ModelError(["the graph has a cycle"])
    inside = np.zeros((len(listed), len(dag)), dtype=bool)
    for row, target in zip(inside, listed, strict=True):
        row[target] = True
    cut = meets(inside.T, ~inside)
    known = dag & (cut | cut.T | meets(_apart(dag), dag))  # the last: part of a v-structure
    return meek((dag | dag.T) & ~known.T)


def meek(graph: Bools) -> Bools:
    """Direct every edge that can have one direction only.

    Args:
        graph: Edges with and without direction; its v-structures are all there are.

    Raises:
        ModelError: No acyclic graph has these directions and v-structures.

    Source:
        Meek, *Causal inference and causal explanation with background knowledge*, UAI 1995,
        rules 1 to 4.
    """
    graph = as_graph(graph)
    while True:
        directed, free, apart = graph & ~graph.T, graph & graph.T, _apart(graph)
        # Rule 1: a -> b - c gives b -> c. Rule 2: a -> b -> c and a - c give a -> c.
        forced = free & (meets(directed.T, apart) | meets(directed, directed))
        a, b = np.nonzero(free)
        if not forced.any() and len(a):
            # Rule 3: a - c -> b, a - d -> b. Rule 4: a - d -> c -> b. Both give a -> b.
            between = free[a] & directed.T[b]  # (edges, p): all c with a - c -> b
            third = (meets(between, apart) & between).any(axis=1)
            last = directed.T[b] & (graph | graph.T)[a]  # all c with c -> b, and an edge to a
            fourth = (meets(free[a] & apart[b], directed) & last).any(axis=1)
            forced[a, b] = third | fourth
        if not forced.any():
            return graph
        both = np.argwhere(forced & forced.T)
        if len(both):
            i, j = both[0]
            raise ModelError([f"the edge between {i} and {j} would need both directions"])
        graph &= ~forced.T


def _apart(graph: Bools) -> Bools:
    return ~(graph | graph.T | np.eye(len(graph), dtype=bool))


def extension(graph: Bools) -> Bools | None:
    """Direct all edges, without a cycle or another v-structure; None if that is impossible.

    Source:
        Dor and Tarsi, *A simple algorithm to construct a consistent extension of a partially
        oriented graph*, UCLA technical report R-185, 1992.

    Example:
        >>> extension(np.array([[0, 1], [1, 0]], bool)).astype(int).tolist()
        [[0, 0], [1, 0]]
    """
    dag, left = as_graph(graph), as_graph(graph)
    here = np.ones(len(graph), dtype=bool)
    while here.any():
        free = left & left.T
        # A sink has no edge out, and its undirected neighbors are adjacent to all its neighbors.
        adjacent = (meets(free, _apart(left)) & (left | left.T)).any(axis=1)
        sinks = np.flatnonzero(here & ~(left & ~left.T).any(axis=1) & ~adjacent)
        if not len(sinks):
            return None
        sink = sinks[0]
        dag[sink, free[sink]] = False
        left[sink], left[:, sink], here[sink] = False, False, False
    return dag
