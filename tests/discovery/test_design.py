"""Designs do what they are for, with as few experiments as there can be."""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import combinations, permutations

import numpy as np
import pytest

from scm_world.discovery.design import (
    ExperimentPlan,
    adaptive_search,
    answer_from_dag,
    bounds,
    coloring,
    culprit,
    culprits,
    is_verified_by,
    pooled,
    pooled_experiments,
    separates,
    separating_system,
    verifying_set,
)
from scm_world.discovery.design.plans import Kind, clique_separator
from scm_world.errors import ModelError, UnknownOption
from scm_world.graph.equivalence import chain_components, cpdag, essential_graph, random_dag

# --- separating -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("n", "experiments"),
    [(14, 6), (20, 6), (38, 8), (50, 8), (64, 8), (100, 9), (128, 10), (200, 10)],
)
def test_ordered_pairs_are_separated(n: int, experiments: int) -> None:
    """Every x is set without y in some experiment, by as few as Spencer's bound says."""
    design = separating_system(n)
    targets = [set(target) for target in design.targets]
    for x, y in permutations(range(n), 2):
        assert any(x in target and y not in target for target in targets)
    assert design.used == design.bound == experiments


@pytest.mark.parametrize("n", [0, 1, 2, 3, 16, 17, 100])
def test_unordered_pairs_are_separated(n: int) -> None:
    """Of every two variables one is set alone in some experiment, by ceil(log2 n) experiments."""
    design = separating_system(n, "unordered")
    for x, y in combinations(range(n), 2):
        assert any((x in target) != (y in target) for target in design.targets)
    assert design.used == design.bound == (math.ceil(math.log2(n)) if n else 0)


@pytest.mark.parametrize("kind", ["ordered", "unordered"])
@pytest.mark.parametrize("n", [2, 3, 5, 8, 13, 30, 64])
@pytest.mark.parametrize("size", [1, 2, 3, 7, 20])
def test_small_experiments_separate_too(kind: Kind, n: int, size: int) -> None:
    """No experiment is too large, sizes differ by one at most, and the bound is near or met."""
    design = separating_system(n, kind, max_size=size)
    sizes = [len(target) for target in design.targets]
    assert separates(design, kind)
    assert max(sizes) <= size
    assert max(sizes) - min(sizes) <= 1
    assert design.used >= design.bound
    if kind == "unordered":
        assert design.used == design.bound
    assert design.used <= 1.5 * design.bound + 1


@pytest.mark.parametrize("kind", ["ordered", "unordered"])
@pytest.mark.parametrize("n", [2, 3, 4, 5, 6])
@pytest.mark.parametrize("size", [1, 2, 3, None])
def test_no_fewer_experiments_separate(kind: Kind, n: int, size: int | None) -> None:
    """One experiment less than the bound is never enough: all labels were tried."""
    bound = separating_system(n, kind, max_size=size).bound
    if bound > 5:
        return  # too many labels to try
    labels = [np.array(list(np.binary_repr(i, bound)), int) for i in range(2 ** (bound - 1))]
    short = [label[1:].astype(bool) for label in labels]
    for chosen in combinations(short, n):
        rows = np.array(chosen).T
        if size is not None and (rows.sum(axis=1) > size).any():
            continue
        targets = tuple(tuple(np.flatnonzero(row).tolist()) for row in rows)
        assert not separates(ExperimentPlan(kind, n, targets, 0), kind)


def test_plans_name_their_targets() -> None:
    """A plan names its targets, and refuses what it cannot be."""
    design = separating_system(5, max_size=2)
    assert design.named("abcde")[0] == tuple("abcde"[i] for i in design.targets[0])
    assert "on 5 variables, at least" in str(design)
    with pytest.raises(ModelError, match="5 variables was given 2 names"):
        design.named(["x", "y"])
    with pytest.raises(UnknownOption, match="unordered"):
        separating_system(5, "unorderd")  # type: ignore[arg-type] # the point
    with pytest.raises(ModelError, match="max_size"):
        separating_system(5, max_size=0)


# --- verifying --------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(30))
def test_verifying_sets_are_the_smallest(seed: int) -> None:
    """A verifying set directs every edge, and no smaller set of variables does."""
    rng = np.random.default_rng(seed)
    dag = random_dag(int(rng.integers(2, 7)), rng.uniform(0.2, 1.0), rng)
    design = verifying_set(dag)
    np.testing.assert_array_equal(essential_graph(dag, design.targets), dag)
    assert design.used == design.bound == bounds.verification(dag)
    for fewer in combinations(range(len(dag)), design.used - 1) if design.used else ():
        assert (essential_graph(dag, [(node,) for node in fewer]) != dag).any()


def test_verifying_known_families() -> None:
    """A clique takes half its nodes, a chain one, a collider none."""
    for n in (2, 3, 8, 9):
        assert verifying_set(np.triu(np.ones((n, n), bool), 1)).used == n // 2
    assert verifying_set(np.eye(9, k=1, dtype=bool)).used == 1
    collider = np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]], bool)
    assert verifying_set(collider).targets == ()
    assert not is_verified_by(np.eye(2, k=1, dtype=bool), ExperimentPlan("none", 2, (), 0))
    with pytest.raises(ModelError, match="ring"):
        bounds.forest_cover(np.roll(np.eye(3, dtype=bool), 1, axis=1))


# --- searching --------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(20))
def test_search_finds_the_graph(seed: int) -> None:
    """The graph is found, with at least nu and at most 3 nu log2(n) experiments, none twice."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 30))
    dag = random_dag(n, rng.choice([2.0 / n, 0.3, 0.9]), rng)
    search = adaptive_search(cpdag(dag), answer_from_dag(dag))
    np.testing.assert_array_equal(search.graph, dag)
    assert search.bound is not None
    assert search.guarantee is not None
    assert search.bound <= search.used <= search.guarantee
    assert len(set(search.targets)) == search.used
    assert not search.contradictions


def test_search_halves_a_path() -> None:
    """A path of 127 nodes away from its end is found by binary search: 6 or 7 experiments."""
    path = np.eye(127, k=1, dtype=bool)
    search = adaptive_search(cpdag(path), answer_from_dag(path))
    assert search.bound == 1
    assert search.used <= 7


def test_search_lives_with_bad_answers() -> None:
    """Missing answers leave edges without direction; wrong ones are told and not used."""
    path = np.eye(5, k=1, dtype=bool)
    silent = adaptive_search(cpdag(path), lambda _: ())
    np.testing.assert_array_equal(silent.graph, cpdag(path))
    assert sorted(silent.targets) == list(range(5))
    assert (silent.bound, silent.guarantee) == (None, None)

    def collider(target: int) -> Iterable[tuple[int, int]]:
        return [(target - 1, target), (target + 1, target), (target, target)]

    wrong = adaptive_search(cpdag(path), collider)
    assert wrong.contradictions
    assert not (wrong.graph & ~cpdag(path)).any()


@pytest.mark.parametrize("seed", range(10))
def test_separators_are_cliques_that_halve(seed: int) -> None:
    """What a separator leaves has at most half the nodes, and the separator is a clique."""
    rng = np.random.default_rng(seed)
    free = np.zeros((20, 20), bool)
    for node in range(1, 20):  # each new node is joined to a clique: the graph is chordal
        first = int(rng.integers(node))
        clique = [first]
        for other in rng.permutation(np.flatnonzero(free[first, :node]))[:2]:
            if free[other, clique].all():
                clique.append(int(other))
        free[node, clique] = free[clique, node] = True
    chosen = list(clique_separator(free))
    assert all(free[a, b] for a, b in combinations(chosen, 2))
    rest = np.delete(np.arange(20), chosen)
    assert max(len(part) for part in chain_components(free[np.ix_(rest, rest)])) <= 10
    ring = np.roll(np.eye(5, dtype=bool), 1, axis=1)
    with pytest.raises(ModelError, match="ring without a chord"):
        clique_separator(ring | ring.T)


# --- moving several at once -------------------------------------------------------------------


def test_pooled_designs_tell_variables_apart() -> None:
    """No two variables always move together or against each other; the seed decides the signs."""
    for n, experiments in [(1, 1), (8, 4), (100, 37), (64, 7)]:
        signs = pooled(n, experiments, np.random.default_rng(1))
        assert signs.shape == (experiments, n)
        assert set(np.unique(signs)) <= {-1.0, 1.0}
        overlap = np.abs(signs.T @ signs) - experiments * np.eye(n)
        assert overlap.max() < experiments
        np.testing.assert_array_equal(signs, pooled(n, experiments, np.random.default_rng(1)))
    with pytest.raises(ModelError, match="9 variables need 5 or more experiments; got 4"):
        pooled(9, 4, np.random.default_rng(0))
    assert pooled_experiments(100, 4) == 37


@pytest.mark.parametrize("seed", range(10))
def test_colors_keep_the_causes_of_an_effect_apart(seed: int) -> None:
    """Each cause has one color, no effect has two causes of one color, and few colors are used."""
    rng = np.random.default_rng(seed)
    parents = rng.random((40, 30)) < rng.uniform(0.02, 0.2)
    design = coloring(parents)
    assert sorted(cause for target in design.targets for cause in target) == list(range(40))
    for target in design.targets:
        assert parents[list(target)].sum(axis=0).max() <= 1
    assert design.used >= design.bound == parents.sum(axis=0).max()


@pytest.mark.parametrize("n", [1, 2, 3, 7, 64, 100])
def test_bisection_takes_log2_steps(n: int) -> None:
    """Every culprit is found by at most ceil(log2 n) questions."""
    for guilty in range(n):
        questions = []

        def moves(asked: tuple[int, ...], guilty: int = guilty) -> bool:
            questions.append(asked)  # noqa: B023 # used before the next turn
            return guilty in asked

        assert culprit(range(n), moves) == guilty
        assert len(questions) <= math.ceil(math.log2(n))


def test_several_culprits() -> None:
    """All of them are found, and none where there is none."""
    guilty = {3, 17, 18, 63}
    assert set(culprits(range(64), lambda asked: bool(guilty & set(asked)))) == guilty
    assert culprits(range(64), lambda _: False) == ()
    with pytest.raises(ModelError, match="no candidate"):
        culprit((), lambda _: False)


# --- bounds -----------------------------------------------------------------------------------


def test_bounds() -> None:
    """The bounds take the values of the literature."""
    assert [bounds.pooled(*case) for case in [(20, 4), (50, 4), (100, 2), (100, 4), (200, 4)]] == [
        13,
        18,
        13,
        22,
        26,
    ]
    assert bounds.verification(np.triu(np.ones((9, 9), bool), 1), max_size=3) == 2
    with pytest.raises(ModelError, match="degree"):
        bounds.pooled(3, 4)
