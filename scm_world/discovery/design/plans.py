"""Experiments that separate variables, check a graph, or find it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, count
from typing import Literal, TypeVar, final

import networkx as nx
import numpy as np

from scm_world._types import Floats
from scm_world.discovery.design import bounds
from scm_world.errors import ModelError, UnknownOption
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


@final
@dataclass(frozen=True)
class ExperimentPlan:
    """Experiments on n variables, by number.

    Attributes:
        kind: What it is for, for example ``"ordered"``.
        n: Number of variables.
        targets: For each experiment the variables that it sets, sorted.
        bound: Fewest experiments that can do in theory; see ``bounds``.
    """

    kind: str
    n: int
    targets: tuple[tuple[int, ...], ...]
    bound: int

    @property
    def used(self) -> int:
        """How many experiments there are."""
        return len(self.targets)

    def __str__(self) -> str:
        what = "experiment" if self.used == 1 else "experiments"
        least = f"at least {self.bound} {'is' if self.bound == 1 else 'are'} needed"
        return f"{self.kind}: {self.used} {what} on {self.n} variables, {least}"

    def named(self, names: Sequence[str]) -> tuple[tuple[str, ...], ...]:
        """Return the targets by name.

        Raises:
            ModelError: There are not n names.
        """
        if len(names) != self.n:
            raise ModelError([f"a design of {self.n} variables was given {len(names)} names"])
        return tuple(tuple(names[i] for i in target) for target in self.targets)


Kind = Literal["ordered", "unordered"]


def separating_system(
    n: int, kind: Kind = "ordered", max_size: int | None = None
) -> ExperimentPlan:
    """Plan experiments that separate every pair of variables.

    Args:
        n: Number of variables.
        kind: ``"ordered"``: for any x and y, some experiment sets x and not y. It finds any graph,
            with unobserved causes and cycles too. ``"unordered"``: some experiment sets one of the
            two; enough where the essential graph is known.
        max_size: Most variables that one experiment sets; any number if None.

    Returns:
        A plan with the fewest experiments there can be; only with ``"ordered"`` and ``max_size`` it
        can be more than the bound.

    Raises:
        UnknownOption: There is no such kind.
        ModelError: n or ``max_size`` is too small.

    Source:
        As in ``bounds.ordered_separating`` and ``bounds.unordered_separating``. That the places
        can be shared out evenly follows from exchanging one experiment of a label at a time.

    Example:
        >>> print(separating_system(20))
        ordered: 6 experiments on 20 variables, at least 6 are needed
        >>> separating_system(4, "unordered").targets
        ((1, 3), (2, 3))
    """
    if kind not in ("ordered", "unordered"):
        raise UnknownOption("kind of separating system", kind, ("ordered", "unordered"))
    if kind == "unordered":
        least = bounds.unordered_separating(n, max_size)
        subsets = (part for size in range(least + 1) for part in combinations(range(least), size))
        labels = _labels(subsets, n, least)
    else:
        least = bounds.ordered_separating(n, max_size)
        labels = _labels_of_one_size(n, least, max_size)
    rows = _shared_out(labels).T
    targets = tuple(tuple(np.flatnonzero(row).tolist()) for row in rows)
    return ExperimentPlan(kind, n, targets, least)


def separates(design: ExperimentPlan, kind: Kind = "ordered") -> bool:
    """Return whether every pair of variables is separated."""
    label = np.zeros((design.n, design.used))
    for number, target in enumerate(design.targets):
        label[list(target), number] = 1.0
    first_only = label @ (1.0 - label.T) > 0
    done = first_only if kind == "ordered" else first_only | first_only.T
    return bool((done | np.eye(design.n, dtype=bool)).all())


def _labels(subsets: Iterable[tuple[int, ...]], n: int, m: int) -> Bools:
    """Write the first n subsets of m experiments as a matrix, shape (n, m)."""
    labels = np.zeros((n, m), dtype=bool)
    for label, chosen in zip(labels, subsets, strict=False):
        label[list(chosen)] = True
    return labels


def _labels_of_one_size(n: int, least: int, max_size: int | None) -> Bools:
    """Take n subsets of one size, of as few experiments as have room for them, shape (n, m)."""
    if n < 2:
        return np.zeros((n, 0), dtype=bool)
    size = n if max_size is None else max_size
    sizes = ((m, min(m // 2, m * size // n)) for m in count(least))
    # It ends: in n experiments there is room for one variable each.
    m, weight = next((m, weight) for m, weight in sizes if math.comb(m, weight) >= n)
    return _labels(combinations(range(m), weight), n, m)


def _shared_out(labels: Bools) -> Bools:
    """Make all experiments equally large, plus or minus one, with labels of the same sizes.

    While one experiment sets two variables more than another, some label has the large one and not
    the small one, and exchanging them gives a label that nobody has.
    """
    labels = labels.copy()
    taken = {label.tobytes() for label in labels}
    while labels.shape[1]:
        sizes = labels.sum(axis=0)
        large, small = int(sizes.argmax()), int(sizes.argmin())
        if sizes[large] - sizes[small] < 2:
            break
        for label in labels[labels[:, large] & ~labels[:, small]]:
            changed = label.copy()
            changed[large], changed[small] = False, True
            if changed.tobytes() not in taken:
                taken = (taken - {label.tobytes()}) | {changed.tobytes()}
                labels[(labels == label).all(axis=1)] = changed
                break
    return labels


Cause = TypeVar("Cause")

STRATEGIES = ("largest_first", "smallest_last", "saturation_largest_first", "independent_set")
"""Greedy colorings of networkx that are tried; the best one is kept."""


# --- pooled -----------------------------------------------------------------------------------


def pooled_experiments(n: int, degree: int) -> int:
    """Return how many random ±1 experiments find up to ``degree`` causes among n.

    Source:
        Tropp and Gilbert, *Signal recovery from random measurements via orthogonal matching
        pursuit*, IEEE Transactions on Information Theory 2007: 2 d ln n in practice.
    """
    return max(math.ceil(2 * degree * math.log(max(n, 2))), 1)


def pooled(n: int, experiments: int, rng: np.random.Generator) -> Floats:
    """Draw a random design in which every experiment moves all variables, up or down.

    Args:
        n: Number of variables.
        experiments: How many; see ``pooled_experiments``.
        rng: Draws the signs.

    Returns:
        Shape (experiments, n), each -1 or 1. No two variables always move together or always
        against each other, for no answer could tell them apart.

    Raises:
        ModelError: So few experiments cannot tell so many variables apart.
    """
    if experiments < 1 or 2 ** (experiments - 1) < n:
        least = max((n - 1).bit_length() + 1, 1)
        raise ModelError([f"{n} variables need {least} or more experiments; got {experiments}"])
    signs = np.empty((experiments, 0))
    while signs.shape[1] < n:
        drawn = rng.choice([-1.0, 1.0], size=(experiments, n - signs.shape[1]))
        signs = np.hstack([signs, drawn])
        _, first = np.unique(signs * signs[0], axis=1, return_index=True)
        signs = signs[:, np.sort(first)]
    return signs


# --- colors -----------------------------------------------------------------------------------


def coloring(parents: Bools) -> ExperimentPlan:
    """Plan experiments in which no effect has two of its declared causes moved at once.

    All causes of one color are moved together. An effect that answers to a color without one of
    its causes has a cause that is not declared; ``culprit`` finds it.

    Args:
        parents: Declared causes by effects, shape (p, q).

    Source:
        Curtis, Powell and Reid 1974; Coleman and Moré, *Estimation of sparse Jacobian matrices and
        graph coloring problems*, SIAM Journal on Numerical Analysis 1983: columns that share a row
        must differ in color.

    Example:
        >>> print(coloring(np.array([[1, 0], [1, 1], [0, 1]], bool)))
        coloring: 2 experiments on 3 variables, at least 2 are needed
    """
    count = parents.astype(np.int64)
    network = nx.from_numpy_array(np.where(np.eye(len(count), dtype=bool), 0, count @ count.T))
    colorings = (nx.greedy_color(network, strategy) for strategy in STRATEGIES)
    best = min(colorings, key=lambda colors: len(set(colors.values())))
    classes: dict[int, list[int]] = {}
    for cause in range(len(parents)):
        classes.setdefault(best[cause], []).append(cause)
    targets = tuple(sorted(tuple(members) for members in classes.values()))
    return ExperimentPlan("coloring", len(parents), targets, bounds.coloring(parents))


# --- finding who did it -----------------------------------------------------------------------


def culprit(candidates: Sequence[Cause], moves: Callable[[tuple[Cause, ...]], bool]) -> Cause:
    """Find a candidate that moves an effect, by halves; at least one has to.

    Args:
        candidates: One or more.
        moves: Moves some of them together, and tells whether the effect moved. It is asked at
            most ``ceil(log2(len(candidates)))`` times.

    Raises:
        ModelError: There is no candidate.

    Example:
        >>> culprit(["a", "b", "c"], lambda asked: "b" in asked)
        'b'
    """
    if not candidates:
        raise ModelError(["there is no candidate to choose from"])
    left = tuple(candidates)
    while len(left) > 1:
        half = left[: len(left) // 2]
        left = half if moves(half) else left[len(half) :]
    return left[0]


def culprits(
    candidates: Iterable[Cause], moves: Callable[[tuple[Cause, ...]], bool]
) -> tuple[Cause, ...]:
    """Find all candidates that move the effect: for each one more question than ``culprit``.

    Source:
        Hwang, *A method for detecting all defective members in a population by group testing*,
        JASA 1972, without the split into groups.
    """
    left, found = list(candidates), []
    while left and moves(tuple(left)):
        found.append(culprit(left, moves))
        left.remove(found[-1])
    return tuple(found)


Answer = Callable[[int], Iterable[tuple[int, int]]]
"""What an experiment on a variable tells: edges at it, as (cause, effect)."""


def verifying_set(dag: Bools) -> ExperimentPlan:
    """Plan the fewest experiments on one variable each that confirm a claimed graph.

    If the claim, shape (p, p), has the right essential graph, the answers leave no other graph.

    Raises:
        ModelError: The claim has a cycle.

    Source:
        Choo, Shiragur and Bhattacharyya, *Verification and search algorithms for causal DAGs*,
        NeurIPS 2022, arXiv 2206.15374: the covered edges form a forest, and its least vertex cover
        is what must be set.
    """
    topological_order(dag)
    cover = bounds.forest_cover(covered_edges(dag))
    return ExperimentPlan("verifying", len(dag), tuple((node,) for node in cover), len(cover))


@final
@dataclass(frozen=True, eq=False)
class AdaptiveSearch:
    """The result of an adaptive search.

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


def adaptive_search(graph: Bools, answer: Answer) -> AdaptiveSearch:
    """Direct an essential graph by experiments on one variable each, chosen one after the other.

    In every component that has no directions yet, set the nodes of a clique that leaves parts of
    at most half the size. What the answers imply is not asked again.

    Args:
        graph: Essential graph, shape (p, p).
        answer: Does the experiment on a variable, and returns directions of edges at it. It may
            leave some out; a variable is asked once.

    Raises:
        ModelError: The undirected edges have a ring without a chord: this is no essential graph.

    Source:
        Choo, Shiragur and Bhattacharyya 2022, algorithm 1: at most O(log n) nu(G) experiments. Of
        the separators: Gilbert, Rose and Edenbrandt, *A separator theorem for chordal graphs*,
        SIAM Journal on Algebraic Discrete Methods 1984.
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
            answered = [(int(cause), int(effect)) for cause, effect in answer(node)]
            known, refused = _learned(known, answered)
            contradictions += refused
    return AdaptiveSearch(known, tuple(targets), largest, tuple(contradictions))


def answer_from_dag(dag: Bools) -> Answer:
    """Answer as a true graph would: the directions of all edges at the target."""

    def answer(target: int) -> Iterator[tuple[int, int]]:
        yield from ((target, int(effect)) for effect in np.flatnonzero(dag[target]))
        yield from ((int(cause), target) for cause in np.flatnonzero(dag[:, target]))

    return answer


def clique_separator(free: Bools) -> tuple[int, ...]:
    """Return a small clique of a connected chordal graph that leaves parts of at most half.

    Every maximal clique of the undirected edges ``free``, shape (p, p), is tried.

    Raises:
        ModelError: The graph is not chordal.
    """
    network = nx.from_numpy_array(free.astype(int))
    if not nx.is_chordal(network):
        raise ModelError(["the undirected edges have a ring without a chord: no essential graph"])
    cliques = [sorted(clique) for clique in nx.chordal_graph_cliques(network)]
    good = []
    for clique in cliques:
        if _halves(free, clique):
            for node in tuple(clique):
                fewer = [other for other in clique if other != node]
                clique = fewer if fewer and _halves(free, fewer) else clique  # noqa: PLW2901
            good.append((len(clique), clique))
    return tuple(min(good)[1])


def _halves(free: Bools, clique: list[int]) -> bool:
    rest = np.delete(np.arange(len(free)), clique)
    parts = chain_components(free[np.ix_(rest, rest)])
    return all(2 * len(part) <= len(free) for part in parts)


def _worth_asking(known: Bools, asked: list[int]) -> Iterator[tuple[int, ...]]:
    """Return a clique separator of each component, without what was asked; largest first."""
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


def _learned(known: Bools, answered: list[tuple[int, int]]) -> tuple[Bools, list[tuple[int, int]]]:
    """Add directions and what follows; return those that contradict what is known."""
    together = _directed(known, answered)
    if together is not None:
        return together, []
    refused = []
    for edge in answered:
        more = _directed(known, [edge])
        if more is None:
            refused.append(edge)
        else:
            known = more
    return known, refused


def _directed(known: Bools, answered: list[tuple[int, int]]) -> Bools | None:
    """Add directions and what follows; None if no member of the class has them."""
    directed = known.copy()
    for cause, effect in answered:
        if not directed[cause, effect]:
            return None
        directed[effect, cause] = False
    try:
        closed = meek(directed)
    except ModelError:
        return None
    same = v_structures(closed) == v_structures(known) and extension(closed) is not None
    return closed if same else None


def is_verified_by(dag: Bools, design: ExperimentPlan) -> bool:
    """Return whether a plan directs all edges of a graph, given its essential graph."""
    return bool(np.array_equal(essential_graph(dag, design.targets), dag))
