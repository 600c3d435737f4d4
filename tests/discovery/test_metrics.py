"""Scores of graphs agree with their definitions, with other programs and with brute force."""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace

import networkx as nx
import numpy as np
import pytest

from scm_world.discovery.data import Dataset
from scm_world.discovery.learners.found import EstimatedGraph
from scm_world.discovery.metrics import (
    KINDS,
    aid,
    auprc,
    auroc,
    evaluate,
    shd,
    sortability,
)
from scm_world.errors import MissingExtra, ModelError, UnknownVariable
from scm_world.graph.equivalence import Bools, essential_graph, extension

NAMES = ("x1", "x2", "y1", "y2", "y3")
PAPER = [("x1", "x2", 0), *[(x, y, 0) for x in NAMES[:2] for y in NAMES[2:]]]

ROWS = "from row to column"


def random_dag(n: int, density: float, rng: np.random.Generator) -> Bools:
    """Draw an acyclic graph, its nodes in random order."""
    upper = np.triu(rng.random((n, n)) < density, 1)
    order = rng.permutation(n)
    dag: Bools = upper[np.ix_(order, order)]
    return dag


# --- distances --------------------------------------------------------------------------------


def test_the_example_of_the_paper() -> None:
    """One edge too many harms no effect; one edge turned around spoils eight.

    Source:
        Peters and Bühlmann 2015, figure 1.
    """
    more = evaluate(EstimatedGraph.of_edges(NAMES, [*PAPER, ("y1", "y2", 0)]), PAPER)
    turned = evaluate(EstimatedGraph.of_edges(NAMES, [("x2", "x1", 0), *PAPER[1:]]), PAPER)
    assert (more.shd, more.sid) == (1, 0)
    assert (turned.shd, turned.sid) == (1, 8)


def test_distances_agree_with_gadjid() -> None:
    """SHD and SID are those of gadjid on 300 random pairs of acyclic graphs."""
    gadjid = pytest.importorskip("gadjid")
    rng = np.random.default_rng(0)
    for _ in range(300):
        n = int(rng.integers(3, 16))
        true, found = (random_dag(n, rng.uniform(0.05, 0.9), rng) for _ in range(2))
        as_int = true.astype(np.int8), found.astype(np.int8)
        _, expected = gadjid.sid(*as_int, edge_direction=ROWS)
        assert aid(found, true, "sid") == expected
        assert shd(found, true) == gadjid.shd(*as_int)[1]


def test_sid_forgives_what_is_adjusted_for_in_vain() -> None:
    """A complete graph in the right order gets every effect right, and not the other way round."""
    pytest.importorskip("gadjid")
    true = random_dag(8, 0.2, np.random.default_rng(1))
    place = np.argsort(list(nx.topological_sort(nx.DiGraph(true))))
    complete = place[:, None] < place[None, :]
    assert aid(complete, true, "sid") == 0
    assert (aid(true, complete, "sid") or 0) > 0


def test_what_has_edges_without_direction_has_no_sid() -> None:
    """A clique of seven; a ring of four stands for no acyclic graph."""
    pytest.importorskip("gadjid")
    true = np.triu(np.ones((7, 7), bool), 1)
    assert aid(~np.eye(7, dtype=bool), true, "sid") is None
    ring = np.roll(np.eye(4, dtype=bool), 1, axis=1)
    assert aid(ring | ring.T, np.zeros((4, 4), bool), "parent_aid") is None


def test_classes_are_compared_as_classes() -> None:
    """A member, another member and their essential graph are at distance 0 from one another."""
    true = random_dag(12, 0.2, np.random.default_rng(4))
    essential = essential_graph(true)
    member = extension(essential)
    assert member is not None
    assert (member != true).any()
    names = [f"x{i}" for i in range(len(true))]
    declared = EstimatedGraph.of(names, true).directed
    found = [EstimatedGraph.of(names, graph) for graph in (true, member, essential)]
    assert [evaluate(graph, declared).shd_classes for graph in found] == [0, 0, 0]


def test_adjustment_distances_are_those_of_gadjid(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows are causes for gadjid too, and edges without direction are told; so is its absence."""
    gadjid = pytest.importorskip("gadjid")
    rng = np.random.default_rng(2)
    for _ in range(20):
        true, other = (random_dag(8, 0.3, rng) for _ in range(2))
        found = essential_graph(other)
        coded = np.where(found & found.T, 2, found).astype(np.int8)
        for kind in KINDS[1:]:
            distance = getattr(gadjid, kind)
            as_int = true.astype(np.int8), coded
            assert aid(found, true, kind) == distance(*as_int, edge_direction=ROWS)[1]
    two = np.array([[0, 1], [0, 0]], bool)
    assert [aid(two, two, "ancestor_aid"), aid(two.T, two, "ancestor_aid")] == [0, 2]
    ring = np.roll(np.eye(3, dtype=bool), 1, axis=1)
    assert aid(ring, np.zeros((3, 3), bool), "parent_aid") is None

    monkeypatch.setitem(sys.modules, "gadjid", None)
    with pytest.raises(MissingExtra, match=r"scm-world\[learn\]"):
        aid(two, two, "parent_aid")


# --- rankings ---------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(10))
def test_rankings_follow_their_definitions(seed: int) -> None:
    """With ties, AUROC counts pairs and AUPRC sums precision over the distinct thresholds."""
    rng = np.random.default_rng(seed)
    edge_scores = rng.integers(0, 6, 40).astype(float)
    present = rng.random(40) < 0.3
    pairs = edge_scores[present][:, None] - edge_scores[~present][None, :]
    assert auroc(edge_scores, present) == pytest.approx(((pairs > 0) + 0.5 * (pairs == 0)).mean())
    area, before = 0.0, 0.0
    for level in sorted(set(edge_scores), reverse=True):
        taken = edge_scores >= level
        recall = present[taken].sum() / present.sum()
        area, before = area + (recall - before) * present[taken].mean(), recall
    assert auprc(edge_scores, present) == pytest.approx(area)


def test_rankings_need_both_kinds() -> None:
    """Without anything absent, or anything present, there is no ranking."""
    for present in (np.ones(3, bool), np.zeros(3, bool)):
        assert auroc(np.arange(3.0), present) is None
        assert auprc(np.arange(3.0), present) is None
    assert auroc(np.zeros(4), np.array([True, False, False, False])) == 0.5


# --- all together -----------------------------------------------------------------------------


def test_a_perfect_graph_has_perfect_scores() -> None:
    """The declared graph itself scores best everywhere."""
    scores = evaluate(EstimatedGraph.of_edges(NAMES, PAPER), PAPER)
    best = [scores.precision, scores.recall, scores.f1, scores.auroc]
    assert [*best, scores.auprc] == [1.0] * 5
    assert [scores.shd, scores.shd_classes, scores.sid, scores.precision] == [0, 0, 0, 1]
    assert (scores.edges, scores.declared, scores.pairs) == (7, 7, 20)


def test_edges_without_direction() -> None:
    """They count 1 each for SHD, are missed for recall, and there is no SID."""
    found = EstimatedGraph.of(("x", "y", "z"), [[0, 1, 0], [1, 0, 0], [0, 0, 0]])
    scores = evaluate(found, [("x", "y", 0)])
    assert (scores.shd, scores.precision, scores.recall) == (1, 1.0, 0.0)
    assert scores.edges == 1
    assert scores.sid is None
    assert scores.shd_classes == 0
    assert evaluate(found, []).shd == 1


def test_graphs_through_time() -> None:
    """Edges are compared lag by lag, a node may act on itself later, and SID does not apply."""
    found = EstimatedGraph.of_edges(("x", "y"), [("x", "x", 1), ("x", "y", 1), ("y", "x", 0)])
    scores = evaluate(found, [("x", "x", 1), ("x", "y", 0), ("x", "y", 2)])
    assert (scores.shd, scores.shd_by_lag) == (3, (1, 1, 1))
    assert (scores.sid, scores.shd_classes, scores.parent_aid) == (None, None, None)
    assert scores.notes == ("no intervention distances: there are edges through time",)
    assert scores.pairs == 2 + 4 + 4
    assert scores.precision == scores.recall == pytest.approx(1 / 3)


def test_pairs_that_do_not_count() -> None:
    """What is left out neither helps nor harms; a pair within an instant is left out as a whole."""
    found = EstimatedGraph.of_edges(("x", "y", "z"), [("x", "y", 0), ("y", "z", 0)])
    counts = np.ones((3, 3), bool)
    counts[1, 0] = False
    scores = evaluate(found, [("y", "z", 0)], pairs=counts)
    assert (scores.shd, scores.precision, scores.auroc, scores.pairs) == (0, 1.0, 1.0, 4)
    assert scores.sid is None
    assert "some pairs" in scores.notes[0]
    with pytest.raises(ModelError, match="pairs has shape"):
        evaluate(found, [], pairs=np.ones((2, 2)))


def test_cycles_have_no_intervention_distance() -> None:
    """A found or declared cycle leaves the counts, and says why the rest is missing."""
    ring = [("x", "y", 0), ("y", "z", 0), ("z", "x", 0)]
    scores = evaluate(EstimatedGraph.of_edges(("x", "y", "z"), ring), ring[:2])
    assert (scores.shd, scores.sid, scores.shd_classes) == (1, None, None)
    assert "found graph has a cycle" in scores.notes[0]
    scores = evaluate(EstimatedGraph.of_edges(("x", "y", "z"), ring[:2]), ring)
    assert "declared graph has a cycle" in scores.notes[0]


def test_names_are_checked_and_can_be_given() -> None:
    """A variable that was not found has no edges; one that is not compared on is refused."""
    found = EstimatedGraph.of_edges(("x", "y"), [("x", "y", 0)])
    assert evaluate(found, [("x", "y", 0), ("y", "z", 0)], names=["x", "y", "z"]).recall == 0.5
    with pytest.raises(UnknownVariable, match="'zz'"):
        evaluate(found, [("zz", "y", 0)])


def test_without_gadjid_there_is_a_note(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where gadjid is not installed, its distances are None and the rest is there."""
    monkeypatch.setitem(sys.modules, "gadjid", None)
    scores = evaluate(EstimatedGraph.of_edges(NAMES, PAPER), PAPER)
    assert (scores.sid, scores.parent_aid) == (None, None)
    assert "pip install" in scores.notes[0]


def test_sortability_of_constants_and_of_one_row() -> None:
    """A constant has no R², so its paths do not count; two columns explain one another equally."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=500)
    values = np.c_[x, x + rng.normal(size=500), np.full(500, 2.0)]
    table = Dataset.of(values, ["x", "y", "c"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = sortability(table, [("x", "y", 0), ("c", "y", 0)])
        assert found == {"variance": 1.0, "r2": 0.5}
        assert np.isnan(sortability(table, [("c", "y", 0)])["r2"])
        for rows in (table.rows([0]), table.rows([])):
            assert all(np.isnan(value) for value in sortability(rows, [("x", "y", 0)]).values())
        alone = sortability(table.select(["x"]), [])
        assert all(np.isnan(value) for value in alone.values())
    with pytest.raises(UnknownVariable, match="'q'"):
        sortability(table, [("q", "y", 0)])


def test_sortability_by_r2_does_not_depend_on_units() -> None:
    """Columns in other units explain one another as well."""
    values = np.random.default_rng(0).normal(size=(2_000, 3)).cumsum(axis=1)
    data, edges = Dataset.of(values, ["x", "y", "z"]), [("x", "y", 0), ("y", "z", 0)]
    other = replace(data, values=data.values * [1e-6, 1.0, 1e7])
    assert sortability(other, edges)["r2"] == sortability(data, edges)["r2"]
