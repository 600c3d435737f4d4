"""Edge marks: how they are scored, reported and written; problems with hidden variables."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from scm_world.cli.app import app
from scm_world.discovery.benchmarks import benchmark
from scm_world.discovery.data import Column, Dataset, GroundTruth
from scm_world.discovery.learners import EstimatedGraph, Learner, learn
from scm_world.discovery.metrics import evaluate
from scm_world.discovery.problems import problem
from scm_world.errors import ModelError, UnknownOption
from scm_world.graph.ancestral import CIRCLE, HEAD, TAIL, edge_words

NAMES = ("x", "a", "b", "y")
TRUTH = GroundTruth(
    name="two instruments",
    names=NAMES,
    edges=(("x", "a", 0), ("y", "b", 0)),
    confounded=(("a", "b", 0),),
)


def graph(*edges: str, names: tuple[str, ...] = NAMES) -> EstimatedGraph:
    """Make a graph of words such as ``"x o-> a"``."""
    sign = {"<": HEAD, ">": HEAD, "-": TAIL, "o": CIRCLE}
    marks = np.zeros((len(names),) * 2, np.int8)
    for one, between, other in map(str.split, edges):
        i, j = names.index(one), names.index(other)
        marks[i, j], marks[j, i] = sign[between[0]], sign[between[2]]
    return EstimatedGraph.of_marks(names, marks)


def test_what_can_be_learned_is_found_and_true() -> None:
    """The partial ancestral graph has distance 0, recall 1 and precision 1."""
    scores = evaluate(graph("x o-> a", "a <-> b", "b <-o y"), TRUTH, marks=True)
    assert (scores.pag_distance, scores.adjacency_f1, scores.head_f1) == (0, 1.0, 1.0)
    assert (scores.tail_precision, scores.tail_recall, scores.tail_f1) == (1.0, None, None)


def test_marks_are_counted_one_by_one() -> None:
    """By hand: three pairs found of which two are true, three heads of which one is, one tail."""
    scores = evaluate(graph("x --> a", "a --> b", "x o-> y"), TRUTH, marks=True)
    assert scores.adjacency_precision == pytest.approx(2 / 3)
    assert scores.adjacency_recall == pytest.approx(2 / 3)
    assert scores.head_precision == pytest.approx(2 / 3)  # at a of x, at b of a; not at y
    assert scores.head_recall == pytest.approx(2 / 4)
    assert scores.tail_precision == pytest.approx(1 / 2)  # at x; a is no cause of b
    assert scores.pag_distance == 4


def test_more_than_watching_tells_is_no_error_in_precision() -> None:
    """A directed graph says true marks that no observation tells; the distance counts them."""
    scores = evaluate(EstimatedGraph.of_edges(NAMES, TRUTH.edges), TRUTH, marks=True)
    assert (scores.head_precision, scores.tail_precision) == (1.0, 1.0)
    assert scores.pag_distance == 3
    empty = evaluate(learn("empty", Dataset.of(np.zeros((1, 4)), NAMES)), TRUTH, marks=True)
    assert (empty.adjacency_f1, empty.head_f1, empty.pag_distance) == (0.0, 0.0, 3)
    circles = evaluate(learn("complete", Dataset.of(np.zeros((1, 4)), NAMES)), TRUTH, marks=True)
    assert (circles.adjacency_recall, circles.adjacency_precision) == (1.0, 0.5)
    assert (circles.head_precision, circles.head_recall) == (1.0, 0.0)


def test_unscored_pairs_do_not_count() -> None:
    """Neither in the estimate nor in the truth."""
    plain = {k: v for k, v in asdict(TRUTH).items() if k != "unscored"}
    truth = GroundTruth(**plain, unscored=(("a", "b"), ("x", "y")))
    assert evaluate(graph("x o-> a", "b <-o y", "x --> y"), truth, marks=True).pag_distance == 0


def test_edges_through_time_count_at_their_earlier_end() -> None:
    """The later end is a head by the order of time. The window is that of the estimate."""
    truth = GroundTruth(name="t", names=("x", "y"), edges=(("x", "x", 1), ("x", "y", 1)))
    assert edge_words(truth.names, truth.pag()) == ("x@-1 o-> x", "x@-1 o-> y")
    marks = np.zeros((2, 2, 2), np.int8)
    marks[1, 0] = TAIL, HEAD
    scores = evaluate(EstimatedGraph.of_marks(("x", "y"), marks), truth, marks=True)
    assert (scores.adjacency_f1, scores.tail_precision, scores.head_precision) == (1.0, 1.0, 0.0)
    longer = EstimatedGraph.of_marks(("x", "y"), np.concatenate([marks, marks[:1]]))
    wider = evaluate(longer, truth, marks=True)
    assert (scores.tail_recall, wider.tail_recall) == (None, 0.5)  # two steps before tell the tails


def test_marks_that_are_none_are_refused() -> None:
    """Other numbers, an edge with one end, a loop, another shape."""
    for marks in ([[0, 3], [1, 0]], [[0, 2], [0, 0]], [[2, 0], [0, 0]]):
        with pytest.raises(ModelError, match="mark"):
            EstimatedGraph.of_marks(["x", "y"], marks)
    found = graph("x o-> a")
    with pytest.raises(ModelError, match="edges and marks have shapes"):
        EstimatedGraph(NAMES, found.edges, found.edge_scores, marks=np.zeros((2, 4, 4), np.int8))


def test_marks_go_with_their_variables() -> None:
    """Through files, to some of the variables, and to others besides."""
    found = graph("x o-> a", "a <-> b")
    assert EstimatedGraph.from_dict(found.as_dict()).words == found.words
    assert found.restricted(("b", "a", "z")).words == ("b <-> a",)
    plain = EstimatedGraph.of_edges(NAMES, [("x", "a", 0), ("b", "a", 1)])
    assert plain.words == ("x --> a", "b@-1 --> a")
    assert plain.as_dict()["marks"] is None


def test_columns_of_a_vector_agree_on_a_mark_or_have_a_circle() -> None:
    """And an edge from an earlier control step keeps the mark at its earlier end."""
    columns = (Column("v[0]", "v", 0), Column("v[1]", "v", 1), Column("x", "x"))
    table = Dataset.of(np.zeros((2, 3)), ["v[0]", "v[1]", "x"], episode=[0, 0], step=[0, 1])
    table = replace(table, columns=columns)
    names = (*table.names, "x@-1")
    found = graph("v[0] o-> x", "v[1] <-> x", "x@-1 <-> x", "v[0] <-- x@-1", names=names)
    learned = learn(Learner("given", lambda data, *, seed=0: found, marked=True), table)
    assert learned.words == ("v o-> x", "x@-1 --> v", "x@-1 <-> x")
    assert learned.directed == (("v", "x", 0), ("x", "v", 1))


def test_families_hide_what_acts_on_most() -> None:
    """Of er2:8:2 ten variables are drawn; two of them are in no table and never set."""
    made = problem("er2:8:2", seed=3)
    assert len(made.truth.names) == 8
    assert made.truth.confounded
    for kind in ("observational", "interventional"):
        table = made.data(kind, 60, 0)
        assert table.names == made.truth.names
        assert {name for names in table.targets for name in names} <= set(made.truth.names)
        assert table.truth is not None
        assert (table.truth.edges, table.truth.confounded) == (
            made.truth.edges, made.truth.confounded
        )  # fmt: skip
    assert problem("er2:8:2", seed=4).truth.confounded != made.truth.confounded
    with pytest.raises(ModelError, match="hides variables"):
        made.simulator(0)
    for name in ("er2:8:9", "er2:8:x", "er2::2", "er2:8:2:1"):
        with pytest.raises(UnknownOption, match="er2:N with N from"):
            problem(name)


@pytest.mark.usefixtures("in_this_process")
def test_benchmarks_score_marks_beside_baselines(tmp_path: Path) -> None:
    """Every learner has scores of marks; a graph with marks has no distance to a directed one."""
    asked = {"budgets": [60, 80], "seeds": 2, "standardised": False}
    names = ["do_order", "empty", "complete"]
    result = benchmark(names, ["er2:5:2"], out=tmp_path / "out", **asked)  # type: ignore[arg-type]
    for run in result.runs:
        assert run.status == "done", run.message
        assert {"pag_distance", "adjacency_f1", "head_f1", "tail_f1"} <= set(run.scores)
        assert ("shd" in run.scores) is (run.learner != "complete")
        assert 0.0 <= run.scores["variance_sortability"] <= 1.0  # type: ignore[operator]
        truth = problem("er2:5:2", seed=run.seed).truth
        assert run.scores["confounded"] == len(truth.confounded)


@pytest.mark.usefixtures("in_this_process")
def test_the_terminal_shows_scores_of_marks(tmp_path: Path) -> None:
    """Columns of marks where variables are hidden, the pairs and the sortability in the title."""
    words = ["discover", "er2:5:2", "--learner", "do_order", "--budget", "60,80", "--seeds", "1"]
    result = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    said = " ".join(result.output.split())
    assert "PAG distance" in said
    assert "pairs with hidden causes" in said
    assert "varsortability" in said
    assert "complete" not in said  # o-o everywhere belongs beside learners that give marks
