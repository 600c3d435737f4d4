"""Tables know the true graph over exactly their columns."""

from __future__ import annotations

import csv
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
import pytest

from scm_world import SCM, World
from scm_world.discovery.benchmarks import rows_in
from scm_world.discovery.data import (
    Dataset,
    Design,
    Regime,
    as_dcdi,
    as_frame,
    as_gies,
    collect,
    from_frame,
    load,
    save,
)
from scm_world.discovery.learners import EstimatedGraph, learn
from scm_world.discovery.metrics import evaluate
from scm_world.errors import ModelError, UnknownOption, UnknownVariable
from scm_world.graph import to_dag
from scm_world.graph.ancestral import edge_words
from scm_world.queries import verify
from scm_world.tasks.families import random_model
from scm_world.variables import (
    Derived,
    Draw,
    Exogenous,
    Linear,
    Mechanism,
    Normal,
    Parent,
    Scale,
    Shift,
)

ONE = Linear(weights=(1.0,))


def line() -> SCM:
    """Make u → a → m → b ← u, where m has no noise; and c beside them."""
    return SCM(
        [
            Exogenous(name="u", distribution=Normal()),
            Derived(name="a", parents=("u",), mechanism=ONE, noise=Normal()),
            Derived(name="m", parents=("a",), mechanism=Linear(weights=(2.0,))),
            Derived(
                name="b", parents=("m", "u"), mechanism=Linear(weights=(1.0, -1.0)), noise=Normal()
            ),
            Derived(name="c", parents=("b",), mechanism=np.tanh, noise=None),
        ]
    )


def test_the_graph_of_a_table_is_that_of_its_model() -> None:
    """Edges, adjacency and weights; NaN where a mechanism is not linear."""
    table = collect(line(), Design("single", ("a",), 2.0, 0.5), 40)
    truth = table.truth
    assert truth is not None
    assert {edge[:2] for edge in truth.edges} == {
        ("u", "a"), ("a", "m"), ("m", "b"), ("u", "b"), ("b", "c")
    }  # fmt: skip
    at = {name: i for i, name in enumerate(table.names)}
    weights = table.weights()
    assert weights[at["a"], at["m"]] == 2.0
    assert np.isnan(weights[at["b"], at["c"]])
    assert (table.adjacency() == (np.isnan(weights) | (weights != 0.0))).all()
    assert set(table.targets) == {(), ("a",)}


def test_hidden_variables_confound_and_pass_on() -> None:
    """Without u the ends are confounded; without m its cause acts directly."""
    hidden = collect(line(), Design(), 5).hide(["u", "m"])
    truth = hidden.truth
    assert truth is not None
    assert truth.names == ("a", "b", "c")
    assert truth.edges == (("a", "b", 0), ("b", "c", 0))
    assert truth.confounded == (("a", "b", 0),)
    assert hidden.hide(["a"]).truth.confounded == ()  # type: ignore[union-attr] # it is known
    with pytest.raises(UnknownVariable):
        hidden.hide(["u"])


@pytest.mark.parametrize("seed", range(6))
def test_the_projection_has_the_independences_of_the_model(seed: int) -> None:
    """Every pair and conditioning set of what is left: m-separation there is d-separation here."""
    model = random_model("er2:6", seed)
    kept = tuple(model)[:4]
    truth = collect(model, Design(), 2).select(kept).truth
    assert truth is not None
    graph = nx.DiGraph([(a, b) for a, b, _ in truth.edges])
    graph.add_nodes_from(kept)
    for number, (one, other, _) in enumerate(truth.confounded):
        graph.add_edges_from([(f"h{number}", one), (f"h{number}", other)])
    for i, one in enumerate(kept):
        for other in kept[i + 1 :]:
            rest = [name for name in kept if name not in (one, other)]
            for mask in range(4):
                given = {name for bit, name in enumerate(rest) if mask >> bit & 1}
                said = nx.is_d_separator(graph, {one}, {other}, given)
                assert said == nx.is_d_separator(to_dag(model), {one}, {other}, given)


def test_the_graph_survives_files_and_frames(tmp_path: Path) -> None:
    """Also with columns left out, and in time."""
    table = collect(line(), Design(), 6).hide(["u"])
    save(table, tmp_path / "table")
    assert load(tmp_path / "table").truth == table.truth
    assert from_frame(as_frame(table)).truth == table.truth
    level = Derived(name="s", parents=(Parent("s", 1), Parent("k", 1)),
                    mechanism=Linear(weights=(0.5, 1.0)), noise=Normal())  # fmt: skip
    model = SCM([Exogenous(name="k", distribution=Normal(), per="step"), level])
    steps = collect(model, Design(), 3, steps=4)
    assert steps.weights(1)[0, 1] == 1.0
    assert not steps.adjacency(0).any()
    hidden = steps.hide(["k"]).truth
    assert hidden is not None
    assert (hidden.edges, hidden.confounded) == ((("s", "s", 1),), ())


def test_worlds_have_the_graph_of_their_rows() -> None:
    """Of control steps; and of episodes, from what they begin with to what they end with."""
    world = World("pushing", backend="fake")
    nature = {"tool_block.mass": "A", "floor_friction": "A"}
    how: dict[str, Any] = {"causes": list(nature), "steps": 2, "nature": nature}
    whole = collect(world, Design(), 2, outcomes=["tool_block.cartesian_position"], **how)
    assert whole.truth is not None
    assert {edge[:2] for edge in whole.truth.edges} == {
        (cause, "tool_block.cartesian_position") for cause in nature
    }
    assert whole.adjacency().shape == (5, 5)
    assert whole.adjacency()[:2, 2:].all()
    steps = collect(world, Design(), 1, every_step=True, **how)
    assert steps.truth is not None
    assert ("action", "joint_velocities", 1) in steps.truth.edges


def test_arrays_tell_hard_from_soft() -> None:
    """A scaled variable still follows its causes."""
    hard = collect(line(), Design("single", ("a",), 2.0, 0.0), 3)
    assert (hard.targeted[:, 1].all(), hard.soft.any()) == (True, False)
    soft = collect(line(), Design("single", ("a",), {"a": Scale(3.0)}, 0.0), 3)
    assert soft.soft[:, 1].all()
    assert soft.adjacency().sum() == 5
    alone = Dataset.of([[1.0]], ["x"])
    assert alone.truth is None
    for unknown in (alone, replace(alone, about={"truth": None})):
        for ask in (unknown.adjacency, unknown.acting):
            with pytest.raises(ModelError, match="does not know its graph"):
                ask()


def test_dcdi_reads_what_is_written(tmp_path: Path) -> None:
    """As its loader does: masks, regimes with the observational one first, data and graph."""
    table = collect(line(), Design("single", ("a", "b"), 2.0, 0.4), 60)
    folder = as_dcdi(table, tmp_path / "d", 3)
    graph = np.load(folder / "DAG3.npy")
    data = np.load(folder / "data_interv3.npy")
    with (folder / "intervention3.csv").open() as stream:
        masks = [[int(cell) for cell in row] for row in csv.reader(stream)]
    regimes = np.genfromtxt(folder / "regime3.csv", delimiter=",").astype(int)
    assert (graph == table.adjacency()).all()
    assert data.tobytes() == table.values.tobytes()
    assert [[*np.flatnonzero(row)] for row in table.targeted] == masks
    assert {regime for regime, mask in zip(regimes, masks, strict=True) if not mask} == {0}
    assert sorted(set(regimes.tolist())) == [0, 1, 2]
    assert len(np.load(folder / "data3.npy")) == (regimes == 0).sum()


def test_a_truth_has_the_name_of_its_system() -> None:
    """Also where a variable that keeps its value over an episode is hidden."""
    table = collect(memory("episode"), Design(), 2, seed=0, steps=3)
    for shown in (table, table.hide(["k"])):
        assert shown.truth is not None
        assert shown.truth.name == "model"


def test_dcdi_gets_hidden_targets_as_a_regime(tmp_path: Path) -> None:
    """Its observational file and regime 0 have no rows in which a hidden column was set."""
    whole = collect(line(), Design("single", ("a", "b"), 2.0, 0.4), 60)
    folder = as_dcdi(whole.hide(["a"]), tmp_path)
    regimes = np.genfromtxt(folder / "regime1.csv", delimiter=",").astype(int)
    assert [number == 0 for number in regimes] == [not targets for targets in whole.targets]
    assert len(np.load(folder / "data1.npy")) == len(whole.observational)
    assert sorted(set(regimes.tolist())) == [0, 1, 2]


def test_ancestral_graphs_of_a_table() -> None:
    """Of two instruments and a hidden common cause: what is true, and what can be learned."""
    two = Linear(weights=(1.0, 1.0))
    model = SCM(
        [
            *(Exogenous(name=name, distribution=Normal()) for name in ("x", "y", "h")),
            Derived(name="a", parents=("x", "h"), mechanism=two, noise=Normal()),
            Derived(name="b", parents=("y", "h"), mechanism=two, noise=Normal()),
        ]
    )
    truth = collect(model, Design(), 2).hide(["h"]).truth
    assert truth is not None
    assert truth.confounded == (("a", "b", 0),)
    assert edge_words(truth.names, truth.mag()) == ("x --> a", "y --> b", "a <-> b")
    assert edge_words(truth.names, truth.pag()) == ("x o-> a", "y o-> b", "a <-> b")


def memory(per: str) -> SCM:
    """Make series s and r, both moved by k: with noise in each step, or still for an episode."""
    k: Any = Exogenous(name="k", distribution=Normal(), per="episode")
    if per == "step":
        k = Derived(name="k", parents=(Parent("k", 1),), mechanism=Linear(weights=(0.7,)),
                    noise=Normal())  # fmt: skip
    moved = (
        Derived(name=name, parents=(Parent("k", 1),), mechanism=ONE, noise=Normal())
        for name in ("s", "r")
    )
    return SCM([k, *moved])


@pytest.mark.parametrize("per", ["step", "episode"])
def test_what_is_hidden_and_lasts_confounds_through_time(per: str) -> None:
    """Each series with itself and with the other one: at every lag, as the rows are correlated."""
    table = collect(memory(per), Design(), 400, seed=0, steps=8).hide(["k"])
    truth = table.truth
    assert truth is not None
    assert truth.edges == ()
    assert {("s", "s", 1), ("s", "r", 1), ("r", "s", 2)} <= set(truth.confounded)
    marks = truth.mag(1)
    assert edge_words(truth.names, marks) == (
        "s <-> r", "s@-1 <-> s", "s@-1 <-> r", "r@-1 <-> s", "r@-1 <-> r"
    )  # fmt: skip
    assert (truth.pag(1) != 0).tolist() == (marks != 0).tolist()
    lagged = table.lagged()
    assert abs(np.corrcoef(lagged["s"], lagged["s@-1"])[0, 1]) > 0.2
    assert abs(np.corrcoef(lagged["s"], lagged["r@-1"])[0, 1]) > 0.2


def test_the_past_before_a_window_is_hidden() -> None:
    """A cause with memory acts two steps later: through a window of one step it confounds."""
    x = Derived(name="x", parents=(Parent("x", 1),), mechanism=ONE, noise=Normal())
    y = Derived(name="y", parents=(Parent("x", 2),), mechanism=ONE, noise=Normal())
    truth = collect(SCM([x, y]), Design(), 2, steps=6).truth
    assert truth is not None
    assert edge_words(truth.names, truth.mag()) == ("x@-1 --> x", "x@-2 --> y")
    through = ("x@-1 --> x", "x@-1 <-> y", "y@-1 <-> y")
    assert edge_words(truth.names, truth.mag(1)) == through


# --- weights --------------------------------------------------------------------------------------


@pytest.mark.parametrize("direct", [1.0, -6.0])
def test_the_weight_of_an_edge_counts_the_paths_through_hidden_variables(direct: float) -> None:
    """It is the slope of a regression, 0 where direct and hidden effects cancel; an edge stays."""
    both = Linear(weights=(direct, 3.0))
    model = SCM(
        [
            Exogenous(name="x", distribution=Normal()),
            Derived(name="m", parents=("x",), mechanism=Linear(weights=(2.0,)), noise=Normal()),
            Derived(name="y", parents=("x", "m"), mechanism=both, noise=Normal()),
        ]
    )
    table = collect(model, Design(), 4000).hide(["m"])
    assert table.weights()[0, 1] == direct + 6.0
    assert np.polyfit(table["x"], table["y"], 1)[0] == pytest.approx(direct + 6.0, abs=0.2)
    assert table.adjacency().tolist() == [[False, True], [False, False]]


def test_weights_of_paths_that_are_bent_or_confounded() -> None:
    """NaN where one mechanism on the way is not linear; of a confounded pair the causal weight."""
    table = collect(line(), Design(), 5)
    part = table.hide(["u", "m"])
    assert part.truth is not None
    assert part.weights()[0, 1] == 2.0  # a → m → b, beside u
    assert part.truth.confounded == (("a", "b", 0),)
    ends = table.select(["a", "c"])
    assert np.isnan(ends.weights()[0, 1])
    assert ends.truth is not None
    assert (ends.truth.edges, ends.truth.weights) == ((("a", "c", 0),), {})


def test_weights_of_hidden_paths_through_time() -> None:
    """A hidden series with memory passes on less and less, lag by lag."""
    half = Linear(weights=(1.0, 0.5))
    model = SCM(
        [
            Exogenous(name="x", distribution=Normal(), per="step"),
            Derived(name="h", parents=("x", Parent("h", 1)), mechanism=half),
            Derived(name="y", parents=(Parent("h", 1),), mechanism=Linear(weights=(2.0,))),
        ]
    )
    table = collect(model, Design(), 2, steps=5).hide(["h"])
    assert [table.weights(lag)[0, 1] for lag in (1, 2, 3)] == [2.0, 1.0, 0.5]


def test_an_edge_of_weight_zero_is_an_edge() -> None:
    """In edges, in adjacency, and in what other libraries get; its weight is 0."""
    model = SCM(
        [
            Exogenous(name="x", distribution=Normal()),
            Derived(name="y", parents=("x",), mechanism=Linear(weights=(0.0,)), noise=Normal()),
        ]
    )
    table = collect(model, Design(), 3)
    assert table.truth is not None
    assert (table.adjacency() == table.truth.adjacency()).all()
    assert table.adjacency().sum() == len(table.truth.edges) == 1
    assert table.weights().tolist() == [[0.0, 0.0], [0.0, 0.0]]


def test_vectors_of_one_size_act_number_by_number() -> None:
    """The edge is between the variables; the weights of other numbers are zero."""
    model = SCM(
        [
            Exogenous(name="v", shape=(2,), default=(0.0, 0.0), distribution=Normal()),
            Derived(name="w", shape=(2,), parents=("v",), mechanism=Linear(weights=(3.0,))),
        ]
    )
    table = collect(model, Design(), 4)
    assert table.adjacency()[:2, 2:].all()
    assert table.weights()[:2, 2:].tolist() == [[3.0, 0.0], [0.0, 3.0]]
    assert np.allclose(table.values[:, :2] @ table.weights()[:2, 2:], table.values[:, 2:])


# --- earlier control steps as columns -------------------------------------------------------------


def two() -> SCM:
    """Make a series a that moves itself by 0.5 and b by 1, one step later."""
    back = (Parent("a", 1),)
    return SCM(
        [
            Derived(name="a", parents=back, mechanism=Linear(weights=(0.5,)), noise=Normal()),
            Derived(name="b", parents=back, mechanism=ONE, noise=Normal()),
        ]
    )


def test_a_lagged_table_has_the_graph_among_its_columns() -> None:
    """Names, edges, matrices and views are about the same columns, all within the row."""
    table = collect(two(), Design(), 3, steps=8).lagged(2)
    truth = table.truth
    assert truth is not None
    assert truth.names == table.names == ("a", "b", "a@-1", "b@-1", "a@-2", "b@-2")
    assert set(truth.edges) == {
        ("a@-1", "a", 0), ("a@-1", "b", 0), ("a@-2", "a@-1", 0), ("a@-2", "b@-1", 0)
    }  # fmt: skip
    assert truth.confounded == (("a@-2", "b@-2", 0),)  # by a, three steps before
    assert table.adjacency().sum() == 4
    assert not table.adjacency(1).any()
    at = {name: i for i, name in enumerate(table.names)}
    weights = table.weights()
    assert (weights[at["a@-2"], at["b@-1"]], weights[at["a@-1"], at["a"]]) == (1.0, 0.5)
    assert (table.adjacency() == truth.adjacency()).all()
    ends = table.select(["b", "a@-2"])
    assert ends.truth is not None
    assert ends.truth.edges == (("a@-2", "b", 0),)
    assert ends.weights().tolist() == [[0.0, 0.0], [0.5, 0.0]]
    with pytest.raises(ModelError, match=r"take lagged\(2\) at once"):
        table.lagged()


def test_the_past_columns_of_a_lagged_table_are_known_to_be_earlier() -> None:
    """The later ends of edges between control steps are heads, as in the graph through time."""
    table = collect(two(), Design(), 3, steps=8)
    assert table.truth is not None
    lagged = table.lagged().truth
    assert lagged is not None
    assert edge_words(table.truth.names, table.truth.pag()) == ("a@-1 o-> a", "a@-1 o-> b")
    words = ("a <-o a@-1", "b <-o a@-1", "a@-1 o-o b@-1")
    assert edge_words(lagged.names, lagged.pag()) == words


def test_what_was_set_before_is_a_target_of_the_earlier_column(tmp_path: Path) -> None:
    """A start that is set is a target at that step; rows with it are not observational."""
    table = collect(two(), Design("single", ("b",), 5.0, 0.5), 8, steps=3)
    first = tuple(
        Regime(regime.plan, regime.targets if step == 0 else ())
        for regime, step in zip((table.regimes[i] for i in table.regime), table.step, strict=True)
    )
    table = replace(table, regimes=first, regime=np.arange(len(table)))
    assert (table.targeted[:, 1] == (table["b"] == 5.0) & (table.step == 0)).all()
    lagged = table.lagged()
    done = lagged["b@-1"] == 5.0
    assert set(lagged.targets) == {(), ("b@-1",)}
    assert (lagged.targeted[:, lagged.names.index("b@-1")] == done & (lagged.step == 1)).all()
    assert not lagged.targeted[:, :3].any()
    assert len(lagged.observational) == (~lagged.targeted.any(axis=1)).sum() == 12
    save(lagged, tmp_path / "lagged")
    for again in (load(tmp_path / "lagged"), from_frame(as_frame(lagged))):
        assert (again.targets, again.truth) == (lagged.targets, lagged.truth)
    assert as_gies(lagged)[1] == [[], [3]] or as_gies(lagged)[1] == [[3], []]


def test_a_learner_of_a_lagged_table_speaks_of_its_columns() -> None:
    """So that it can be compared with the truth of the table; given the series, of lags."""
    table = collect(two(), Design(), 60, steps=40)
    lagged = table.lagged()
    assert lagged.truth is not None
    found = learn("do_order", lagged)
    assert found.names == lagged.names
    assert evaluate(found, lagged.truth.edges).declared == 2
    assert learn("correlation", table).names == ("a", "b")
    assert learn("complete", lagged).edges.shape == (1, 4, 4)


# --- conditions of edges --------------------------------------------------------------------------

ENGINES = [
    "mujoco",
    pytest.param("bullet", marks=pytest.mark.skipif(find_spec("pybullet") is None, reason="none")),
]


def boxes(engine: str, place: str = "1 0 .05") -> World:
    """Make a box on the floor, and another one elsewhere."""
    shape = 'type="box" size=".05 .05 .05" mass="1"'
    return World(
        '<mujoco><option timestep="0.005"/><worldbody>'
        '<geom name="floor" type="plane" size="5 5 1"/>'
        f'<body name="a" pos="0 0 .05"><freejoint/><geom name="a_shape" {shape}/></body>'
        f'<body name="b" pos="{place}"><freejoint/><geom name="b_shape" {shape}/></body>'
        "</worldbody></mujoco>",
        backend=engine,
    )


def between(truth: Any, one: str = "a", other: str = "b") -> list[Any]:
    """List the edges from one body to the other."""
    return [e for e in truth.edges if (e[0].split(".")[0], e[1].split(".")[0]) == (one, other)]


@pytest.mark.parametrize("engine", ENGINES)
def test_what_never_touched_has_no_edges_in_its_rows(engine: str) -> None:
    """Two boxes that stay one metre apart: what is left is each for itself, on the floor."""
    with boxes(engine) as world:
        table = collect(world, Design(), 2, steps=6, every_step=True, contacts=True)
    truth = table.truth
    assert truth is not None
    assert len(between(truth)) * 2 == 32
    free = ("cartesian_position", "linear_velocity"), ("orientation", "angular_velocity")
    own = [
        (c, e, 1)
        for place, speed in free
        for c, e in ((place, place), (speed, place), (speed, speed))
    ]
    in_flight = {(f"{b}.{c}", f"{b}.{e}", lag) for b in "ab" for c, e, lag in own}
    assert set(truth.during().edges) == in_flight  # of a cube, which has no gyroscopic moments
    assert set(truth.when["contact"]) == set(truth.edges) - in_flight
    acting = table.acting()
    assert acting.truth is not None
    assert not between(acting.truth)
    assert len(acting.truth.edges) == len(truth.edges) - 32 == 32
    assert table.contacts == {("a", "world"): 1.0, ("b", "world"): 1.0}
    edges, blocks = acting.lagged().adjacency(), acting.lagged().blocks
    assert edges[blocks["a.linear_velocity@-1"][0], blocks["a.linear_velocity"][0]]
    assert not edges[blocks["a.linear_velocity@-1"][0], blocks["b.linear_velocity"]].any()


@pytest.mark.parametrize("engine", ENGINES)
def test_rows_before_and_after_a_box_falls_on_the_other(engine: str, tmp_path: Path) -> None:
    """Edges hold from the contact on: in memory, files, frames, parts, and lagged tables."""
    with boxes(engine, "0.02 0 .3") as world:
        how: dict[str, Any] = {"steps": 20, "every_step": True, "causes": ["*.mass", "*friction"]}
        table = collect(world, Design(), 2, contacts=True, **how)
        plain = collect(world, Design(), 2, **how)
        folder = collect(world, Design(), 2, contacts=True, shard=1, out=tmp_path / "c", **how)
    assert table.values.tobytes() == plain.values.tobytes()
    with pytest.raises(ModelError, match="contacts=True"):
        plain.acting()
    save(table, tmp_path / "saved")
    read = load(tmp_path / "c"), load(tmp_path / "saved"), from_frame(as_frame(table)), folder
    assert all(each.about["touching"] == table.about["touching"] for each in read)
    assert 0.3 < table.contacts["a", "b"] < 0.7
    falls = table.rows(table.step < 5)
    for each in (falls, *(t.rows(t.step < 5) for t in read), falls.lagged()):
        truth = each.acting().truth
        assert truth is not None
        names = {(c.split("@")[0], e) for c, e, _ in truth.edges}
        assert ("floor.friction", "a.linear_velocity") in names
        assert ("b_shape.friction", "b.linear_velocity") not in names
        assert not between(truth)
        assert not between(truth, "b", "a")
    whole = table.acting().truth
    assert whole is not None
    assert between(whole)
    assert ("floor.friction", "b.linear_velocity", 1) in whole.edges  # through a
    after = table.rows(table.step == 19).hide(["a.mass", "a.orientation"]).acting().truth
    assert after is not None
    assert ("a.linear_velocity", "b.linear_velocity", 1) in after.edges
    graph, together = table.truth, table.touching("a", "b")
    assert graph is not None
    assert 0.3 < together.mean() < 0.7
    assert (table.touching("b") <= table.touching("a")).all()  # it falls on a, which lies
    for rows, touch in ((together, True), (~together, False)):
        true = graph.for_rows(table.rows(rows))
        assert bool(between(true)) is bool(between(true, "b", "a")) is touch
        assert {*graph.during().edges} <= {*true.edges} <= {*graph.during("contact").edges}
        acting = table.rows(rows).acting().truth
        assert acting is not None
        assert true.edges == acting.edges
    assert {*graph.edges} - {*graph.during("set").edges} == {*graph.when["contact"]}
    with pytest.raises(ModelError, match="other variables"):
        graph.for_rows(table.hide(["a.mass"]))
    with pytest.raises(UnknownOption, match="contact"):
        graph.during("contacts")
    with pytest.raises(UnknownOption, match="two bodies"):
        table.touching("a", "b", "world")


def test_rows_of_a_context_come_with_the_rows_before() -> None:
    """Pairs of control steps with one condition of contacts, and the graph that acts in them."""
    with boxes("mujoco", "0.02 0 .3") as world:
        how: dict[str, Any] = {"steps": 20, "every_step": True, "causes": ["*.mass"]}
        table = collect(world, Design(), 2, contacts=True, **how)
    truth, touch = table.truth, table.touching("a", "b")
    assert truth is not None
    np.testing.assert_array_equal(table.touching(), touch)
    after = {"free": ~touch & (table.step > 0), "touching": touch}
    for context, rows in after.items():
        found, acting = rows_in(table, truth, context)
        np.testing.assert_array_equal(found.values[1::2], table.values[rows])
        np.testing.assert_array_equal(found.values[::2], table.values[np.flatnonzero(rows) - 1])
        assert found.lagged().values.shape[0] == rows.sum()
        assert bool(between(acting)) is (context == "touching")
        assert {*truth.during().edges} <= {*acting.edges}
    with pytest.raises(ModelError, match=r"no row of 4 is touching: raise the budget"):
        rows_in(table.rows(slice(4)), truth, "touching")


@pytest.mark.parametrize("engine", ENGINES)
def test_episodes_have_the_edges_of_their_contacts(engine: str) -> None:
    """A row that is an episode: what touched in any of its control steps."""
    for place, expected in (("1 0 .05", False), ("0.02 0 .3", True)):
        with boxes(engine, place) as world:
            table = collect(world, Design(), 2, steps=20, causes=["*.mass"], contacts=True)
        truth = table.acting().truth
        assert truth is not None
        assert bool(between(truth)) is expected
        assert ("b.mass", "b.linear_velocity", 0) in truth.edges
        assert (("a", "b") in table.contacts) is expected


def test_hidden_variables_confound_only_what_they_touched() -> None:
    """A hidden box is a common cause of two others where it touched them."""
    with boxes("mujoco") as world:
        table = collect(world, Design(), 2, steps=4, every_step=True, contacts=True)
    names = ("a.orientation", "b.orientation")
    part = table.select(names)
    assert part.truth is not None
    acting = part.acting().truth
    assert acting is not None
    assert any(one[0] != other[0] for one, other, _ in part.truth.confounded)
    assert not any(one[0] != other[0] for one, other, _ in acting.confounded)


def test_what_a_verification_never_saw_can_be_left_out_of_a_score() -> None:
    """Marked, it is an edge still, and counts neither as missed nor as found."""
    with boxes("mujoco") as world:
        checked = verify(world, probes=2)
        table = collect(world, Design(), 1, steps=4, every_step=True)
    assert table.truth is not None
    truth = table.truth.marked(checked)
    assert 0 < len(truth.unseen) == len(set(truth.edges) & set(checked.never_fired))
    assert truth.edges == table.truth.edges
    rest = [edge for edge in truth.edges if edge not in truth.unseen]
    found = EstimatedGraph.of_edges(truth.names, rest)
    assert evaluate(found, truth.edges).recall < 1.0
    scores = evaluate(found, truth.edges, pairs=truth.pairs)
    assert (scores.recall, scores.declared) == (1.0, len(rest))
    assert evaluate(found, truth, marks=True).adjacency_recall == 1.0


# --- models under interventions -------------------------------------------------------------------


def three() -> SCM:
    """Make a → x → y, with weights 1."""
    return SCM(
        [
            Exogenous(name="a", distribution=Normal()),
            Derived(name="x", parents=("a",), mechanism=ONE, noise=Normal()),
            Derived(name="y", parents=("x",), mechanism=ONE, noise=Normal()),
        ]
    )


@pytest.mark.parametrize(
    ("acts", "edges"),
    [
        ({"x": Draw(Normal())}, {("x", "y"): 1.0}),
        ({"x": 2.0}, {("x", "y"): 1.0}),
        ({"y": Scale(3.0)}, {("a", "x"): 1.0, ("x", "y"): 3.0}),
        ({"y": Shift(Draw(Normal()))}, {("a", "x"): 1.0, ("x", "y"): 1.0}),
        (
            {"y": Mechanism(Linear(weights=(-1.0, 5.0)), ["x", "a"], noise=Normal())},
            {("a", "x"): 1.0, ("x", "y"): -1.0, ("a", "y"): 5.0},
        ),
    ],
)
def test_the_graph_of_a_model_under_an_intervention_is_the_mutilated_one(
    acts: dict[str, Any], edges: dict[tuple[str, str], float]
) -> None:
    """Its edges and weights, and the slopes of regressions on the causes in its rows."""
    table = collect(three().do(acts), Design("single", ("a",), 1.0, 0.9), 3000)
    assert table.truth is not None
    assert {edge[:2]: table.truth.weights[edge] for edge in table.truth.edges} == edges
    assert {*table.targets} == {(), ("a",)}
    rows = table.observational
    for effect in {effect for _, effect in edges}:
        causes = [cause for cause, end in edges if end == effect]
        seen = np.column_stack([*(rows[cause] for cause in causes), np.ones(len(rows.values))])
        slopes = np.linalg.lstsq(seen, rows[effect])[0]
        wanted = [edges[cause, effect] for cause in causes]
        if all(rows[cause].std() for cause in causes):
            assert slopes[:-1] == pytest.approx(wanted, abs=0.15)


def test_a_mechanism_without_weights_has_edges_without_weights() -> None:
    """The function of an intervention is not the declared one, whose weight is gone."""
    cut = three().do({"y": Mechanism(lambda x, a: 5 * a - x, ["x", "a"])})
    truth = collect(cut, Design(), 5).truth
    assert truth is not None
    assert {*truth.edges} == {edge.key for edge in cut.edges}
    assert truth.weights == {("a", "x", 0): 1.0}


def test_layers_below_count_in_the_graph() -> None:
    """Factors multiply, and a draw that variables share in the context confounds them."""
    model = three().given({"y": Scale(3.0), "a": Shift(Draw(Normal()), shared="both")})
    done = model.do({"y": Scale(2.0), "a": Shift(1.0)})
    truth = collect(done, Design(), 5).truth
    assert truth is not None
    assert truth.weights == {("a", "x", 0): 1.0, ("x", "y", 0): 6.0}
    drawn = done.draw(3000, seed=0)
    assert np.polyfit(drawn["x"], drawn["y"], 1)[0] == pytest.approx(6.0, abs=0.3)
    shared = Shift(Draw(Normal(0.0, 2.0)), shared="both")
    model = three().given({"a": shared, "y": shared}).do({"a": Shift(1.0)})
    truth = collect(model, Design(), 5).truth
    assert truth is not None
    assert truth.confounded == (("a", "y", 0),)


def test_draws_that_variables_share_confound_them() -> None:
    """One number moves both, as their correlation says; draws of their own do not."""
    for shared in (True, False):
        act = Shift(Draw(Normal(0.0, 2.0)), shared=shared)
        table = collect(three().do({"x": 0.0}).do({"[ay]": act}), Design(), 2000)
        assert table.truth is not None
        assert table.truth.confounded == ((("a", "y", 0),) if shared else ())
        assert bool(abs(np.corrcoef(table["a"], table["y"])[0, 1]) > 0.5) is shared


TIED = {
    "tool_block.mass": "A",
    "floor_friction": Mechanism(ONE, ["tool_block.mass"]),
}


@pytest.mark.parametrize("every_step", [False, True])
@pytest.mark.parametrize("given", [False, True])
def test_a_mechanism_of_the_context_is_in_the_graph(every_step: bool, given: bool) -> None:
    """In rows of episodes and of control steps, drawn by nature or given to the world."""
    world, edge = World("pushing", backend="fake"), ("tool_block.mass", "floor_friction", 0)
    how: dict[str, Any] = {"steps": 3, "causes": [*TIED], "every_step": every_step}
    plain = collect(world, Design(), 4, nature={"tool_block.mass": "A"}, **how)
    if given:
        world = world.given(TIED)
    table = collect(world, Design(), 4, nature=None if given else TIED, **how)
    assert plain.truth is not None
    assert table.truth is not None
    assert {*table.truth.edges} - {*plain.truth.edges} == {edge}
    assert (table["floor_friction"] == table["tool_block.mass"]).all()


def still(positions: Any) -> Any:
    """Return an action of zero."""
    return 0.0 * positions


def ahead(mass: float) -> list[float]:
    """Return a place that is as far ahead as a mass is large."""
    return [mass, 0.0, 0.0325]


def test_a_mechanism_of_a_part_of_the_episode_adds_edges_and_cuts_none() -> None:
    """A policy in a window; a state that is set at an instant has edges that say so."""
    world = World("pushing", backend="fake")
    mass, place = "tool_block.mass", "tool_block.cartesian_position"
    follow = Mechanism(still, ["joint_positions"], during=(0, 2))
    start = Mechanism(ahead, mass)
    nature = {mass: "A", "action": follow, place: start}
    how: dict[str, Any] = {"steps": 3, "causes": [mass], "every_step": True}
    plain = collect(world, Design(), 2, nature={mass: "A"}, **how).truth
    truth = collect(world, Design(), 2, nature=nature, **how).truth
    assert plain is not None
    assert truth is not None
    assert {*truth.edges} - {*plain.edges} == {("joint_positions", "action", 0), (mass, place, 0)}
    assert {*plain.edges} <= {*truth.edges}
    assert (mass, place, 0) in truth.when["set"]
    whole = {"action": follow.model_copy(update={"time": None})}
    held = collect(world, Design(), 2, nature=whole, **how).truth
    assert held is not None
    assert {*held.edges} - {*plain.edges} == {("joint_positions", "action", 0)}
