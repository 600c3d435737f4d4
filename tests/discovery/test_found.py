"""What learners found as a value, the book of learners, and the statistics behind ours."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import networkx as nx
import numpy as np
import pandas as pd
import pytest

from scm_world.discovery import evaluate
from scm_world.discovery.data import Column, Dataset
from scm_world.discovery.learners import EstimatedGraph, Learner, learn, learner, learners, register
from scm_world.discovery.learners.do_order import regression_tail
from scm_world.errors import MissingExtra, ModelError, UnknownOption
from scm_world.variables import Parent

NAMES = ("x", "y", "z")
TABLE = Dataset.of(np.arange(12.0).reshape(4, 3), NAMES)


def chain() -> EstimatedGraph:
    """Make a graph with an edge of each kind."""
    edges = [("x", "y", 0), ("y", "z", 0), ("z", "y", 0), ("x", "x", 1)]
    return EstimatedGraph.of_edges(
        NAMES, edges, learner="mine", notes=("a note",), experiments=7, bound=3
    )


# --- graphs ---------------------------------------------------------------------------------------


def test_directions_are_told_apart() -> None:
    """Both ways within an instant is no direction; a loop through time is an edge."""
    assert set(chain().directed) == {("x", "y", 0), ("x", "x", 1)}
    assert chain().undirected == (("y", "z"),)


def test_a_graph_comes_back_from_json() -> None:
    """Everything that is said about it is written."""
    there = json.loads(json.dumps(chain().as_dict()))
    again = EstimatedGraph.from_dict(there)
    assert again.as_dict() == chain().as_dict()
    assert (again.directed, again.notes, again.bound) == (chain().directed, ("a note",), 3)


@pytest.mark.parametrize(
    "change",
    [
        {"format": "other"},
        {"edges": [[0, 0, 9]]},
        {"edges": [[0, 1]]},
        {"lags": "many"},
        {"names": ["x"]},
        {"edge_scores": [[3, 0, 1, 0.5]]},
    ],
)
def test_what_is_no_graph_is_not_read(change: dict[str, Any]) -> None:
    """Another format, or an edge that leads nowhere, is refused."""
    with pytest.raises(ModelError, match="not a graph that a learner found"):
        EstimatedGraph.from_dict({**chain().as_dict(), **change})
    with pytest.raises(ModelError, match="not a graph"):
        EstimatedGraph.from_dict({})


@pytest.mark.parametrize(
    "change", [{"edges": [[-1, 0, 1]]}, {"edges": [[0, -2, 1]]}, {"edge_scores": [[0, 0, -1, 0.5]]}]
)
def test_negative_places_are_not_read(change: dict[str, Any]) -> None:
    """An index from the end would be another edge than the one written."""
    with pytest.raises(ModelError, match="not a graph"):
        EstimatedGraph.from_dict({**chain().as_dict(), **change})


def test_the_part_on_some_variables_keeps_its_edges() -> None:
    """In the order asked for; a variable it lacks has no edges."""
    part = chain().restricted(["z", "q", "x", "y"])
    assert part.names == ("z", "q", "x", "y")
    assert set(part.directed) == set(chain().directed)
    assert set(map(frozenset, part.undirected)) == {frozenset("yz")}
    assert set(chain().restricted(["x"]).directed) == {("x", "x", 1)}


def test_matrices_of_another_shape_are_refused() -> None:
    """The message has both shapes."""
    with pytest.raises(ModelError, match=r"shape \(1, 2, 2\), .*\(3, 3\)"):
        EstimatedGraph.of(NAMES, np.zeros((2, 2)))
    with pytest.raises(ModelError, match="of 3 variables"):
        EstimatedGraph(NAMES, np.zeros((1, 2, 2), bool), np.zeros((1, 2, 2)))


# --- the book -------------------------------------------------------------------------------------


def test_ours_are_there() -> None:
    """Every learner of ours is known by its name, and says what it does in one line."""
    known = learners()
    assert {"paired", "do_order", "do_gp"} <= set(known)
    assert all(one.doc and one.takes for one in known.values())


@pytest.mark.parametrize(
    "name", ["nobody", "no_module_here:f", "json:nothing", "json:__doc__", ":f"]
)
def test_unknown_learners_are_named(name: str) -> None:
    """Not registered, no such module, no such attribute, no function."""
    with pytest.raises(UnknownOption, match=r"no (learner|function)|learner cannot"):
        learner(name)


def test_a_name_is_taken_once() -> None:
    """The same learner may be registered again, another one may not."""
    ours = learner("do_order")
    assert register(ours) is ours
    with pytest.raises(UnknownOption, match="a name that is not taken"):
        register(replace(ours, learn=lambda data: data))


def test_what_a_learner_needs_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without its package it is not run."""
    missing = Learner("far", lambda data, seed: None, package="no-such-package", extra="far")
    with pytest.raises(MissingExtra, match=r"scm-world\[far\]"):
        learn(missing, TABLE)


def test_a_plain_matrix_is_a_graph() -> None:
    """A function that gives a matrix is a learner; settings and time are noted."""
    mine = Learner("mine", lambda data, seed, by: by * np.eye(3, k=1))
    found = learn(mine, TABLE, seed=3, by=2)
    assert found.directed == (("x", "y", 0), ("y", "z", 0))
    assert (found.learner, found.settings, found.experiments) == ("mine", {"by": 2}, 4)
    assert found.edge_scores[0, 0, 1] == 2.0
    with pytest.raises(ModelError, match="has shape"):
        learn(Learner("bad", lambda data, seed: np.zeros((2, 2))), TABLE)
    with pytest.raises(ModelError, match="learns from a Dataset, not from object"):
        learn(Learner("bad", lambda data, seed: np.zeros((3, 3))), object())
    with pytest.raises(ModelError, match="has to give an EstimatedGraph"):
        learn(Learner("bad", lambda data, seed: np.zeros((2, 2)), ("paired",)), object())


def test_an_edge_into_the_past_is_turned() -> None:
    """Earlier columns are causes: an edge from now to then is one from then to now."""
    table = Dataset.of(
        np.arange(8.0)[:, None], ["x"], episode=[0] * 4 + [1] * 4, step=[*range(4)] * 2
    )
    back = Learner("back", lambda data, seed: np.array([[0, 1], [0, 0]]))
    assert learn(back, table).directed == (("x", "x", 1),)


# --- statistics -----------------------------------------------------------------------------------


@pytest.mark.parametrize("m", [1, 2, 3, 6])
@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.0, 4.0])
def test_the_tail_of_a_regression_is_nearly_that_of_f(m: int, ratio: float) -> None:
    """With 100 rows it is within 3 % of the F test."""
    stats = pytest.importorskip("scipy.stats")
    free = 100.0
    p = regression_tail(ratio * m, free, m, free)
    assert p == pytest.approx(stats.f.sf(ratio, m, free), rel=0.03)


def test_a_regression_without_rows_tells_nothing() -> None:
    """No degrees of freedom, or nothing explained: no evidence. All explained: no doubt."""
    assert regression_tail(1.0, 0.0, 1, 0.0) == 1.0
    assert regression_tail(0.0, 1.0, 1, 10.0) == 1.0
    assert regression_tail(1.0, 0.0, 1, 10.0) < 1e-100


@pytest.mark.parametrize(
    ("matrix", "reason"),
    [
        (np.array([[0.0, np.nan], [0.0, 0.0]]), "not finite"),
        (EstimatedGraph.of_edges(["a", "b"], [("a", "b", 0)]), "which is not in the data"),
    ],
    ids=["nan", "names"],
)
def test_what_is_no_graph_of_the_data_is_refused(matrix: Any, reason: str) -> None:
    """NaN is no edge, and other names are not those of the data."""
    with pytest.raises(ModelError, match=reason):
        learn(Learner("mine", lambda data, seed: matrix), TABLE.select(["x", "y"]))


def test_sureness_is_not_turned_around() -> None:
    """Log-probabilities are refused: their absolute value would rank them backwards."""
    with pytest.raises(ModelError, match="negative"):
        EstimatedGraph.of(["x", "y"], [[0, 1], [0, 0]], edge_scores=[[0.0, -0.1], [0.0, 0.0]])


@pytest.mark.parametrize("seed", range(3))
def test_a_labelled_frame_is_read_by_its_labels(seed: int) -> None:
    """An edge at (x, z) of a frame in another order is x → z for any order of the columns."""
    frame = pd.DataFrame(0.0, index=["z", "x", "y"], columns=["y", "z", "x"])
    frame.loc["x", "z"] = 2.0
    for given in (frame, [frame * 0.0, frame]):
        found = learn(Learner("mine", lambda data, seed, given=given: given), TABLE, seed=seed)
        assert found.directed == (("x", "z", int(isinstance(given, list))),)
    assert EstimatedGraph.of(NAMES, frame.abs(), edge_scores=frame).edge_scores[0, 0, 2] == 2.0


def test_an_axis_without_labels_has_the_order_of_the_other() -> None:
    """Labels 0, 1, … are positions: those of the other axis, or else of the names."""
    edge = np.array([[0, 1, 0], [0, 0, 0], [0, 0, 0]])
    rows, columns = pd.DataFrame(edge, index=["z", "x", "y"]), pd.DataFrame(edge, None, [*"zxy"])
    assert EstimatedGraph.of(NAMES, rows).directed == (("z", "x", 0),)
    assert EstimatedGraph.of(NAMES, columns).directed == (("z", "x", 0),)
    assert EstimatedGraph.of(NAMES, pd.DataFrame(edge)).directed == (("x", "y", 0),)
    with pytest.raises(ModelError, match="labels x, y, w; give x, y, z"):
        EstimatedGraph.of(NAMES, pd.DataFrame(edge, [*"xyw"], [*"xyw"]))


def test_lags_are_whole_numbers_from_0() -> None:
    """A lag of −1 or True is refused, and a whole number of numpy is one."""
    for wrong in (-1, np.int64(-1), True, np.True_):
        with pytest.raises(UnknownOption, match="lag"):
            Parent("a", lag=wrong)
        with pytest.raises(UnknownOption):
            EstimatedGraph.of_edges(["a", "b"], [("a", "b", wrong)])
        with pytest.raises(UnknownOption):
            evaluate([("a", "b", wrong)], [("a", "b", 0)])
    assert EstimatedGraph.of_edges(["a", "b"], [("a", "b", np.int64(2))]).edges.shape == (3, 2, 2)


@pytest.mark.parametrize("lag", [2, np.int64(2), "2", '"2"'], ids=["int", "numpy", "text", "dot"])
def test_graphs_of_networkx_say_the_lag_of_an_edge(lag: Any) -> None:
    """A lag is a number, or text as in DOT; an edge without one has lag 0."""
    graph = nx.DiGraph([("a", "c")])
    graph.add_edge("a", "b", lag=lag)
    assert evaluate(graph, [("a", "b", 2), ("a", "c", 0)]).shd == 0
    assert evaluate(graph, [("a", "b", 0), ("a", "c", 0)]).shd == 2


@pytest.mark.parametrize("lag", [-1, "-1", "soon", 1.5, True])
def test_other_lags_of_networkx_are_refused(lag: Any) -> None:
    """A lag below 0, a fraction and a word are refused."""
    with pytest.raises(ModelError, match="whole number from 0"):
        evaluate(nx.DiGraph([("a", "b", {"lag": lag})]), [("a", "b", 0)])


@pytest.mark.parametrize("seed", range(3))
def test_a_graph_of_networkx_is_read_by_its_labels(seed: int) -> None:
    """For any order of the columns: names and lags of edges, and weights as scores."""
    graph = nx.DiGraph(
        [("z", "x", {"weight": -2.0}), ("x", "y", {"lag": 1}), ("y", "z"), ("z", "y")]
    )
    found = learn(Learner("mine", lambda data, seed: graph), TABLE, seed=seed)
    assert found.names == TABLE.names
    assert found.directed == (("z", "x", 0), ("x", "y", 1))
    assert found.undirected == (("y", "z"),)
    assert found.edge_scores[0, 2, 0] == 2.0
    skeleton = learn(Learner("mine", lambda data, seed: nx.Graph([("z", "x")])), TABLE, seed=seed)
    assert (skeleton.directed, skeleton.undirected) == ((), (("x", "z"),))


def test_nodes_of_networkx_may_be_numbers_columns_and_variables() -> None:
    """Numbers are columns in the given order; a vector is a node, or each of its numbers is."""

    def second_to_first(data: Dataset, seed: int) -> nx.DiGraph:
        matrix = np.zeros((len(data.names),) * 2)
        matrix[data.names.index("y"), data.names.index("x")] = 1.0
        return nx.from_numpy_array(matrix, create_using=nx.DiGraph)

    assert learn(Learner("mine", second_to_first), TABLE).directed == (("y", "x", 0),)
    many = np.zeros((12, 12))
    many[2, 10] = 1.0
    graph = nx.from_numpy_array(many, create_using=nx.DiGraph)
    assert evaluate(graph, [("2", "10", 0)]).shd == 0
    assert evaluate(graph, [("c", "k", 0)], names=[*"abcdefghijkl"]).shd == 0
    columns = (Column("v[0]", "v", 0), Column("v[1]", "v", 1), Column("w", "w"))
    table = replace(Dataset.of(np.ones((2, 3)), ["v[0]", "v[1]", "w"]), columns=columns)
    for edge in (("v", "w"), ("v[1]", "w")):
        made = nx.DiGraph([edge])
        found = learn(Learner("mine", lambda data, seed, made=made: made), table)
        assert found.directed == (("v", "w", 0),)
    for wrong, says in (
        (nx.DiGraph([("v", "u")]), r"returned no graph: the graph has the nodes .*u; the var"),
        (nx.DiGraph([("v", "w", {"weight": "much"})]), "weight 'much' of 'v' → 'w'"),
        (nx.DiGraph([("v", "w", {"lag": True})]), "whole number from 0"),
    ):
        with pytest.raises(ModelError, match=says):
            learn(Learner("mine", lambda data, seed, wrong=wrong: wrong), table)


def test_nodes_without_edges_count_as_variables() -> None:
    """A graph of x → y and z has six ordered pairs, as the graph of a learner has."""
    graph = nx.DiGraph([("x", "y")])
    graph.add_node("z")
    assert evaluate(graph, [("x", "y", 0)]).pairs == 6


@pytest.mark.parametrize(
    "wrong",
    [
        {"edges": [[True, 0, 1]]},
        {"edges": [[1, 0, -1]]},
        {"lags": True},
        {"lags": 1.7},
        {"names": ["x", "x", "y"]},
        {"edge_scores": [[1, 0, 1, float("nan")]]},
        {"marks": [[[7, 0, 0]] * 3] * 2},
    ],
    ids=str,
)
def test_a_damaged_graph_is_refused(wrong: dict[str, Any]) -> None:
    """Switches as numbers, two variables of one name, NaN and unknown marks."""
    plain = EstimatedGraph.of_edges(NAMES, [("x", "y", 1)]).as_dict()
    assert EstimatedGraph.from_dict(plain).directed == (("x", "y", 1),)
    with pytest.raises(ModelError, match="not a graph that a learner found"):
        EstimatedGraph.from_dict({**plain, **wrong})


@pytest.mark.parametrize("name", ["gies", "do_gp", "do_order", "correlation", "pc", "empty"])
def test_an_empty_table_is_refused_with_its_size(name: str) -> None:
    """No rows, or no columns; whatever the learner."""
    for table in (TABLE.rows([]), Dataset.of(np.zeros((5, 0)), [])):
        with pytest.raises(ModelError, match=r"nothing to learn from: the table has \d rows"):
            learn(name, table)
