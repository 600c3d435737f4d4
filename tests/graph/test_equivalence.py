"""Equivalence classes agree with their definitions."""

from __future__ import annotations

from functools import cache
from itertools import combinations, product

import numpy as np
import pytest

from scm_world.errors import ModelError
from scm_world.graph.equivalence import (
    Bools,
    as_graph,
    essential_graph,
    extension,
    is_acyclic,
    meek,
    reaches,
)


def random_dag(n: int, density: float, rng: np.random.Generator) -> Bools:
    """Draw an acyclic graph, its nodes in random order."""
    upper = np.triu(rng.random((n, n)) < density, 1)
    order = rng.permutation(n)
    dag: Bools = upper[np.ix_(order, order)]
    return dag


def v_structures(dag: Bools) -> frozenset[tuple[int, int, int]]:
    """List all i -> k <- j without an edge between i and j."""
    nodes = range(len(dag))
    return frozenset(
        (i, k, j)
        for i, k, j in product(nodes, nodes, nodes)
        if i < j and dag[i, k] and dag[j, k] and not dag[i, j] and not dag[j, i]
    )


@cache
def all_dags(n: int) -> list[Bools]:
    """List all acyclic graphs on n nodes."""
    pairs = list(combinations(range(n), 2))
    found = []
    for ways in product(range(3), repeat=len(pairs)):
        dag = np.zeros((n, n), bool)
        for (i, j), way in zip(pairs, ways, strict=True):
            dag[i, j], dag[j, i] = way == 1, way == 2
        if is_acyclic(dag):
            found.append(dag)
    return found


def looks(dag: Bools, targets: tuple[tuple[int, ...], ...]) -> tuple[object, ...]:
    """Give what data tell of a graph: skeleton and v-structures after each intervention."""
    found: list[object] = []
    for target in ((), *targets):
        cut = dag.copy()
        cut[:, list(target)] = False
        found += [(cut | cut.T).tobytes(), v_structures(cut)]
    return tuple(found)


@pytest.mark.parametrize("targets", [(), ((0,),), ((0, 1),), ((1,), (2, 3)), ((0,), (1,), (2,))])
def test_essential_graphs_are_the_union_of_their_class(
    targets: tuple[tuple[int, ...], ...],
) -> None:
    """On 4 nodes an edge has no direction exactly where graphs that look alike differ in it."""
    dags = all_dags(4)
    assert len(dags) == 543
    union: dict[tuple[object, ...], Bools] = {}
    for dag in dags:
        key = looks(dag, targets)
        union[key] = union.get(key, False) | dag
    for dag in dags:
        np.testing.assert_array_equal(essential_graph(dag, targets), union[looks(dag, targets)])


def test_classes_on_four_nodes() -> None:
    """The 543 acyclic graphs on 4 nodes fall into 185 classes; each has all its members.

    Source:
        Gillispie and Perlman, *Enumerating Markov equivalence classes of acyclic digraph models*,
        UAI 2001, table 1.
    """
    dags = all_dags(4)
    sizes: dict[bytes, int] = {}
    for dag in dags:
        key = essential_graph(dag).tobytes()
        sizes[key] = sizes.get(key, 0) + 1
    assert len(sizes) == 185
    for key, size in sizes.items():
        member = extension(np.frombuffer(key, bool).reshape(4, 4))
        assert member is not None
        assert size >= 1
        assert essential_graph(member).tobytes() == key


@pytest.mark.parametrize("seed", range(30))
def test_extensions_belong_to_the_class(seed: int) -> None:
    """An extension of an essential graph has that essential graph."""
    rng = np.random.default_rng(seed)
    dag = random_dag(int(rng.integers(2, 25)), rng.uniform(0.05, 0.8), rng)
    essential = essential_graph(dag)
    member = extension(essential)
    assert member is not None
    assert is_acyclic(member)
    np.testing.assert_array_equal(essential_graph(member), essential)
    np.testing.assert_array_equal(meek(essential), essential)


def test_a_square_without_chord_has_no_extension() -> None:
    """Four nodes in a ring cannot be directed without another v-structure."""
    ring = np.zeros((4, 4), bool)
    for i in range(4):
        ring[i, (i + 1) % 4] = ring[(i + 1) % 4, i] = True
    assert extension(ring) is None


def test_all_four_rules() -> None:
    """Each of the four rules directs the edge it is about."""
    patterns = {
        1: ([(0, 1)], [(1, 2)], (1, 2)),
        2: ([(0, 1), (1, 2)], [(0, 2)], (0, 2)),
        3: ([(2, 1), (3, 1)], [(0, 1), (0, 2), (0, 3)], (0, 1)),
        4: ([(3, 2), (2, 1)], [(0, 1), (0, 2), (0, 3)], (0, 1)),
    }
    for rule, (directed, free, (cause, effect)) in patterns.items():
        graph = np.zeros((4, 4), bool)
        for i, j in [*directed, *free, *[(j, i) for i, j in free]]:
            graph[i, j] = True
        closed = meek(graph)
        assert closed[cause, effect], rule
        assert not closed[effect, cause], rule


def test_reach() -> None:
    """Reach is the closure of the edges."""
    rng = np.random.default_rng(3)
    dag = random_dag(40, 0.1, rng)
    walks = np.linalg.matrix_power(np.eye(40, dtype=object) + dag.astype(object), 40)
    np.testing.assert_array_equal(reaches(dag), walks > 0)


def test_faults_are_told() -> None:
    """A cycle, a loop, a shape and contradictory directions are refused."""
    cycle = np.roll(np.eye(3, dtype=bool), 1, axis=1)
    with pytest.raises(ModelError, match="has a cycle"):
        essential_graph(cycle)
    with pytest.raises(ModelError, match="acts on itself"):
        as_graph(np.eye(2))
    with pytest.raises(ModelError, match="square matrix"):
        as_graph(np.zeros((2, 3)))
    torn = np.zeros((4, 4), bool)
    torn[0, 1] = torn[1, 2] = torn[2, 1] = torn[3, 2] = True
    with pytest.raises(ModelError, match="both directions"):
        meek(torn)
