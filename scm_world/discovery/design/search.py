"""Experiments on one variable at a time that confirm a graph, or find it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, final

import networkx as nx
import numpy as np

from scm_world.discovery.design import bounds
from scm_world.discovery.design.plan import Design
from scm_world.errors import ModelError
from scm_world.graph import SCM, Moment
from scm_world.graph.equivalence import (
    Bools,
    chain_components,
    covered_edges,
    essential_graph,
    extension,
    is_acyclic,
    meek,
    topological_order,
    v_structures,
)
from scm_world.variables import Noise

Answer = Callable[[int], Iterable[tuple[int, int]]]
"""What an experiment on a variable tells: edges at it, as (cause, effect)."""


def verifying_set(dag: Bools) -> Design:
    """Plan the fewest experiments on one variable each that confirm a claimed graph.

    If the claim has the right essential graph, the answers to these leave no other graph.

    Args:
        dag: The claim, acyclic, shape (p, p).

    Returns:
        A design with as many experiments as its bound: it is exact.

    Raises:
        ModelError: The claim has a cycle.

    Source:
        Choo, Shiragur and Bhattacharyya, *Verification and search algorithms for causal DAGs*,
        NeurIPS 2022, arXiv 2206.15374: the covered edges form a forest, and its least vertex cover
        is what must be set.

    Example:
        >>> verifying_set(np.array([[0, 1, 1], [0, 0, 1], [0, 0, 0]], bool)).targets
        ((1,),)
    """
    topological_order(dag)
    cover = bounds.forest_cover(covered_edges(dag))
    return Design("verifying", len(dag), tuple((node,) for node in cover), len(cover))


@final
@dataclass(frozen=True, eq=False)
class Search:
    """What an adaptive search found.

    Attributes:
        graph: Shape (p, p); every edge has a direction unless answers were missing.
        targets: What was set, in order, one variable per experiment.
        largest: Most nodes that edges without direction connected at the beginning.
        contradictions: Answers that did not fit what was known before; they were not used.
    """

    graph: Bools
    targets: tuple[int, ...]
    largest: int
    contradictions: tuple[tuple[int, int], ...] = ()

    @property
    def used(self) -> int:
        """How many experiments were done."""
        return len(self.targets)

    @property
    def bound(self) -> int | None:
        """Fewest experiments that confirm what was found; None if a direction is missing."""
        return bounds.verification(self.graph) if is_acyclic(self.graph) else None

    @property
    def guarantee(self) -> int | None:
        """Most experiments that the search can take to find this graph, if all answers come.

        Each round sets a clique of each component, which has at most three times as many nodes as
        are needed there, and leaves components of half the size.
        """
        rounds = self.largest.bit_length() - 1  # a component of one node is done
        return None if self.bound is None else 3 * self.bound * rounds

    def as_dict(self) -> dict[str, Any]:
        """Write it as plain data."""
        return {
            "edges": np.argwhere(self.graph).tolist(),
            "targets": list(self.targets),
            "contradictions": [list(edge) for edge in self.contradictions],
            "bound": self.bound,
            "guarantee": self.guarantee,
        }


def adaptive_search(graph: Bools, answer: Answer) -> Search:
    """Direct an essential graph by experiments on one variable each, chosen one after the other.

    In every component that has no directions yet, set the nodes of a clique that leaves parts of
    at most half the size. What the answers imply is not asked again.

    Args:
        graph: Essential graph, shape (p, p).
        answer: Does the experiment on a variable, and tells directions of edges at it. It may
            leave some out; a variable is asked once.

    Raises:
        ModelError: The undirected edges have a ring without a chord: this is no essential graph.

    Source:
        Choo, Shiragur and Bhattacharyya 2022, algorithm 1: at most O(log n) nu(G) experiments. Of
        the separators: Gilbert, Rose and Edenbrandt, *A separator theorem for chordal graphs*,
        SIAM Journal on Algebraic Discrete Methods 1984.

    Example:
        >>> chain = np.array([[0, 1, 0], [0, 0, 1], [0, 0, 0]], bool)
        >>> search = adaptive_search(chain | chain.T, answer_from_dag(chain))
        >>> np.array_equal(search.graph, chain), search.targets, search.bound
        (True, (1,), 1)
    """
    known = meek(graph)
    largest = max(map(len, chain_components(known)), default=1)
    targets: list[int] = []
    contradictions: list[tuple[int, int]] = []
    while (target := next(_worth_asking(known, targets), None)) is not None:
        for node in target:
            if not (known[node] & known[:, node]).any():
                continue  # all its edges follow from earlier answers
            targets.append(node)
            told = [(int(cause), int(effect)) for cause, effect in answer(node)]
            known, refused = _learned(known, told)
            contradictions += refused
    return Search(known, tuple(targets), largest, tuple(contradictions))


def answer_from_dag(dag: Bools) -> Answer:
    """Answer as a true graph would: the directions of all edges at the target.

    Example:
        >>> list(answer_from_dag(np.array([[0, 1], [0, 0]], bool))(1))
        [(0, 1)]
    """

    def answer(target: int) -> Iterator[tuple[int, int]]:
        yield from ((target, int(effect)) for effect in np.flatnonzero(dag[target]))
        yield from ((int(cause), target) for cause in np.flatnonzero(dag[:, target]))

    return answer


def answer_from_model(model: SCM, graph: Bools, *, seed: int = 0, step: float = 1.0) -> Answer:
    """Answer by one paired experiment on a target: which of its neighbors follow it.

    A unit lives twice with the same noise, once with the target moved. A neighbor that differs is
    an effect, for it comes later; one that does not is a cause.

    Args:
        model: Static; its variables are numbers that can be set.
        graph: Essential graph over its variables, in their order, shape (p, p).
        seed: Of the unit.
        step: By how much the target is moved.

    Example:
        >>> from scm_world.variables import Derived, Exogenous, Linear
        >>> chain = SCM([
        ...     Exogenous(name="a"),
        ...     Derived(name="b", parents=("a",), mechanism=Linear(weights=(2.0,))),
        ... ])
        >>> list(answer_from_model(chain, np.ones((2, 2), bool))(0))
        [(0, 1)]
    """
    names = list(model)
    moment = Moment(Noise(seed))
    unit = model.solve(moment=moment)

    def answer(target: int) -> Iterator[tuple[int, int]]:
        value = float(unit[names[target]]) + step
        moved = model.do({names[target]: value}).solve(moment=moment)
        for other in np.flatnonzero(graph[target] | graph[:, target]).tolist():
            if other != target:
                follows = bool(np.any(moved[names[other]] != unit[names[other]]))
                yield (target, other) if follows else (other, target)

    return answer


def clique_separator(free: Bools) -> tuple[int, ...]:
    """Find a small clique of a connected chordal graph that leaves parts of at most half its size.

    Args:
        free: Undirected edges, shape (p, p).

    Raises:
        ModelError: The graph is not chordal.

    Source:
        Gilbert, Rose and Edenbrandt 1984: some clique does it. Here every maximal one is tried,
        and nodes that are not needed are dropped.

    Example:
        >>> path = np.eye(5, k=1, dtype=bool)
        >>> clique_separator(path | path.T)
        (2,)
    """
    network = nx.from_numpy_array(free.astype(int))
    if not nx.is_chordal(network):
        raise ModelError(["the undirected edges have a ring without a chord: no essential graph"])
    cliques = [sorted(clique) for clique in nx.chordal_graph_cliques(network)]
    good = [_dropped(free, clique) for clique in cliques if _halves(free, clique)]
    _, smallest = min((len(clique), clique) for clique in good)
    return tuple(smallest)


def _dropped(free: Bools, clique: list[int]) -> list[int]:
    for node in list(clique):
        fewer = [other for other in clique if other != node]
        if fewer and _halves(free, fewer):
            clique = fewer
    return clique


def _halves(free: Bools, clique: list[int]) -> bool:
    rest = np.delete(np.arange(len(free)), clique)
    parts = chain_components(free[np.ix_(rest, rest)])
    return all(2 * len(part) <= len(free) for part in parts)


def _worth_asking(known: Bools, asked: list[int]) -> Iterator[tuple[int, ...]]:
    """Give a clique separator of each component, without what was asked; largest first."""
    for part in sorted(chain_components(known), key=len, reverse=True):
        if len(part) < 2:
            return
        nodes = np.array(part)
        free = (known & known.T)[np.ix_(nodes, nodes)]
        new = [node for node in part if node not in asked]
        clique = [int(nodes[i]) for i in clique_separator(free)]
        chosen = tuple(node for node in clique if node not in asked)
        if chosen or new:
            yield chosen or tuple(new[:1])


def _learned(known: Bools, told: list[tuple[int, int]]) -> tuple[Bools, list[tuple[int, int]]]:
    """Take in directions and what follows; give back those that contradict what is known."""
    together = _directed(known, told)
    if together is not None:
        return together, []
    refused = []
    for edge in told:
        more = _directed(known, [edge])
        if more is None:
            refused.append(edge)
        else:
            known = more
    return known, refused


def _directed(known: Bools, told: list[tuple[int, int]]) -> Bools | None:
    """Take in directions and what follows; None if no member of the class has them."""
    directed = known.copy()
    for cause, effect in told:
        if not directed[cause, effect]:
            return None
        directed[effect, cause] = False
    try:
        closed = meek(directed)
    except ModelError:
        return None
    same = v_structures(closed) == v_structures(known) and extension(closed) is not None
    return closed if same else None


def is_verified_by(dag: Bools, design: Design) -> bool:
    """Check that a design directs all edges of a graph, given its essential graph.

    Example:
        >>> dag = np.array([[0, 1], [0, 0]], bool)
        >>> is_verified_by(dag, verifying_set(dag))
        True
    """
    return bool(np.array_equal(essential_graph(dag, design.targets), dag))


__all__ = [
    "Answer",
    "Search",
    "adaptive_search",
    "answer_from_dag",
    "answer_from_model",
    "clique_separator",
    "is_verified_by",
    "verifying_set",
]
