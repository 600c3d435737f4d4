"""Tables know the true graph over exactly their columns."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
import pytest

from scm_world import SCM, World
from scm_world.discovery.data import (
    Dataset,
    Design,
    as_dcdi,
    as_frame,
    as_numpy,
    collect,
    from_frame,
    load,
    save,
)
from scm_world.discovery.problems import random_model
from scm_world.errors import ModelError, UnknownVariable
from scm_world.graph import d_separated
from scm_world.graph.ancestral import edge_words
from scm_world.variables import Derived, Exogenous, Linear, Normal, Parent, Scale

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
                assert said == d_separated(model, one, other, given)


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
    assert steps.lagged().truth == steps.truth


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
    hard = as_numpy(collect(line(), Design("single", ("a",), 2.0, 0.0), 3))
    assert (hard.targeted[:, 1].all(), hard.soft.any()) == (True, False)
    soft = as_numpy(collect(line(), Design("single", ("a",), {"a": Scale(3.0)}, 0.0), 3))
    assert soft.soft[:, 1].all()
    assert soft.adjacency is not None
    assert soft.adjacency.sum() == 5
    alone = Dataset.of([[1.0]], ["x"])
    assert alone.truth is None
    with pytest.raises(ModelError, match="does not know its graph"):
        alone.adjacency()


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
