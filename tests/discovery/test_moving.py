"""Learners that do paired experiments on models: one at a time, pooled, by color."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from scm_world._types import Floats
from scm_world.discovery.learners import EstimatedGraph, learn
from scm_world.discovery.learners.moving import colored, culprits, sparse_pooled
from scm_world.discovery.learners.simulators import SCMSimulator
from scm_world.discovery.problems import random_model
from scm_world.errors import ModelError, UnknownOption
from scm_world.graph import SCM
from scm_world.variables import Box, Derived, Exogenous, Function, Linear, Measured, Parent
from scm_world.variables.distributions import Normal

FAMILIES = ("er2:12", "sf2:12", "tanh4:12")
Edges = set[tuple[str, str, int]]


def true_edges(scm: SCM) -> Edges:
    """List what the model declares."""
    return {edge.key for edge in scm.edges}


def wrong(found: EstimatedGraph, scm: SCM) -> int:
    """Count missing and false edges."""
    return len(set(found.directed) ^ true_edges(scm))


class Counted:
    """A simulator that counts the lives of units by itself."""

    def __init__(self, inner: SCMSimulator) -> None:
        self.inner, self.lives = inner, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    def prepare(self, unit: int) -> None:
        """Count one life."""
        self.lives += 1
        self.inner.prepare(unit)

    def answers(self, moves: Mapping[str, float]) -> Floats:
        """Count one life."""
        self.lives += 1
        return self.inner.answers(moves)


def lines(**parents: dict[str, float]) -> SCM:
    """Make a linear model of named variables with weights."""
    return SCM(
        Derived(
            name=name,
            parents=tuple(causes),
            mechanism=Linear(weights=tuple(causes.values())),
            noise=Normal(mean=0.0, std=1.0),
        )
        for name, causes in parents.items()
    )


def first_of(first: Any, vector: Any) -> Any:
    """Pass the first cause on."""
    return first + 0.0 * vector.sum(axis=-1)


# --- exact ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("seed", [0, 1])
def test_one_variable_at_a_time_finds_the_graph(family: str, seed: int) -> None:
    """Four units are enough; what is spent is counted, and twice the budget changes nothing."""
    scm = random_model(family, seed)
    found = learn("paired", SCMSimulator(scm, seed), budget=56)
    assert wrong(found, scm) == 0
    assert 42 <= found.experiments <= 56
    assert "floor 0," in found.notes[0]
    assert found.bound is not None
    assert found.bound <= found.experiments
    assert wrong(learn("paired", SCMSimulator(scm, seed), budget=112), scm) == 0


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("seed", [0, 1])
def test_moving_all_at_once_finds_the_graph(family: str, seed: int) -> None:
    """Few random experiments are enough, and the signs of the weights do not matter."""
    scm = random_model(family, seed)
    simulator = Counted(SCMSimulator(scm, seed))
    found = learn("pooled", simulator, seed=seed)
    assert wrong(found, scm) == 0
    assert found.experiments == simulator.lives <= 28
    assert found.notes == ()


@pytest.mark.parametrize("seed", [0, 1])
def test_a_hundred_variables_need_forty_experiments(seed: int) -> None:
    """Pooled, the graph of 100 variables is exact; by color six experiments confirm it."""
    scm = random_model("tanh4:100", seed)
    found = learn("pooled", SCMSimulator(scm, seed), seed=seed)
    assert wrong(found, scm) == 0
    assert found.experiments <= 40
    settings: dict[str, Any] = {"declared": true_edges(scm), "units": 1, "thorough": False}
    checked = learn("coloring", SCMSimulator(scm, seed), **settings)
    assert wrong(checked, scm) == 0
    assert checked.experiments <= 6
    assert checked.bound is not None
    assert checked.bound < checked.experiments


def test_the_weights_are_found() -> None:
    """The edge_scores of a pooled edge is its absolute weight."""
    scm = lines(x={}, y={"x": -2.0}, z={"x": 0.5, "y": 1.0})
    found = learn("pooled", SCMSimulator(scm), budget=20)
    expected = [[0.0, 2.0, 0.5], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]
    np.testing.assert_allclose(found.edge_scores[0], expected, rtol=1e-6)


@pytest.mark.parametrize("seed", range(10))
def test_colors_keep_the_causes_of_an_effect_apart(seed: int) -> None:
    """Each cause has one color, and no effect has two causes of one color."""
    rng = np.random.default_rng(seed)
    parents = rng.random((40, 30)) < rng.uniform(0.02, 0.2)
    classes = colored(parents)
    assert sorted(cause for members in classes for cause in members) == list(range(40))
    for members in classes:
        assert parents[list(members)].sum(axis=0).max() <= 1
    assert parents.sum(axis=0).max() <= len(classes) < 40


def test_culprits_are_found_by_halves() -> None:
    """All of them are found, by few questions, and none where there is none."""
    names, guilty = [str(i) for i in range(64)], {"3", "17", "18", "63"}
    questions = []

    def moves(asked: Sequence[str]) -> bool:
        questions.append(asked)
        return bool(guilty & set(asked))

    assert set(culprits(names, moves)) == guilty
    assert len(questions) <= 4 * 7 + 1
    assert culprits(names, lambda _: False) == []


# --- a declared graph -----------------------------------------------------------------------------


@pytest.mark.parametrize("family", FAMILIES)
def test_a_dropped_edge_is_found(family: str) -> None:
    """Whichever edge is left out of the declaration, it cannot hide behind declared ones."""
    scm = random_model(family, 1)
    for edge in sorted(true_edges(scm))[::4]:
        simulator = Counted(SCMSimulator(scm, 1))
        found = learn("coloring", simulator, declared=true_edges(scm) - {edge})
        assert wrong(found, scm) == 0
        assert "1 edges are not declared, 0 declared ones did not show" in found.notes
        assert found.experiments == simulator.lives <= 50


def test_what_hides_behind_declared_causes_is_told() -> None:
    """Colors alone leave pairs that nobody looked at; they are counted in a note."""
    scm = random_model("er2:20", 1)
    settings: dict[str, Any] = {"declared": true_edges(scm), "units": 1}
    quick = learn("coloring", SCMSimulator(scm), thorough=False, **settings)
    assert any(note.endswith("pairs hid behind declared causes") for note in quick.notes)
    whole = learn("coloring", SCMSimulator(scm), **settings)
    assert quick.experiments < whole.experiments < 25
    assert not any("hid behind" in note for note in whole.notes)


def test_culprits_are_counted_as_experiments() -> None:
    """To look for a cause costs more than to confirm one."""
    scm = random_model("er2:20", 2)
    edge = max(true_edges(scm))
    whole = learn("coloring", SCMSimulator(scm), declared=true_edges(scm), units=1)
    part = learn("coloring", SCMSimulator(scm), declared=set(), units=1)
    assert part.experiments > whole.experiments + len(true_edges(scm))
    assert set(part.directed) == true_edges(scm)
    assert edge in part.directed


def test_a_declared_edge_that_never_shows_is_told() -> None:
    """An edge without effect is left out, and counted in a note."""
    scm = lines(x={}, y={"x": 1.0}, z={"y": 1.0})
    declared = {*true_edges(scm), ("x", "z", 0)}
    found = learn("coloring", SCMSimulator(scm), declared=declared)
    assert set(found.directed) == true_edges(scm)
    assert "0 edges are not declared, 1 declared ones did not show" in found.notes


def test_edges_of_another_lag_are_not_checked() -> None:
    """A simulator moves causes at one lag; what is declared of another one is left aside."""
    scm = random_model("tanh4:20")
    within = {(c, e, 0) for c, e, _ in true_edges(scm) if c != e}
    found = learn("coloring", SCMSimulator(scm), declared=true_edges(scm) | within)
    assert wrong(found, scm) == 0


def test_colors_end_with_the_budget() -> None:
    """No unit is begun that the budget has no room for."""
    scm = random_model("er2:20")
    found = learn("coloring", SCMSimulator(scm), declared=true_edges(scm), budget=7)
    assert found.notes[0].startswith("2 units")


# --- limits ---------------------------------------------------------------------------------------


def test_what_the_budget_does_not_explain_is_told() -> None:
    """With too few experiments no edge is made up, and the variables are named."""
    found = learn("pooled", SCMSimulator(random_model("er2:20")), budget=5)
    assert found.directed == ()
    assert found.experiments == 5
    assert found.notes[0].startswith("not explained within the budget: x00, x01")


def test_what_depends_on_nearly_everything_is_not_explained_early() -> None:
    """An effect with many causes stays open while the others are found."""
    names = [f"x{i:02d}" for i in range(24)]
    many = lines(**{name: {} for name in names}, y=dict.fromkeys(names, 1.0), z={"x00": 1.0})
    found = learn("pooled", SCMSimulator(many), budget=25)
    assert set(found.directed) == {("x00", "z", 0)}
    assert found.notes == ("not explained within the budget: y",)
    assert wrong(learn("pooled", SCMSimulator(many), budget=200), many) == 0


@pytest.mark.parametrize("learner", ["paired", "pooled", "coloring"])
@pytest.mark.parametrize("budget", [0, -3])
def test_a_budget_of_nothing_is_refused(learner: str, budget: int) -> None:
    """The message has the budget."""
    settings: dict[str, Any] = {"declared": ()} if learner == "coloring" else {}
    with pytest.raises((ModelError, UnknownOption), match="budget"):
        learn(learner, SCMSimulator(random_model("er2:5")), budget=budget, **settings)


def test_a_model_without_edges_has_none() -> None:
    """Nothing answers, and no experiment is wasted on it."""
    scm = lines(x={}, y={}, z={})
    for name in ("paired", "pooled"):
        found = learn(name, SCMSimulator(scm))
        assert found.directed == ()
    assert (
        learn("coloring", SCMSimulator(scm), declared=()).experiments == 8
    )  # 4 units, one color each


def test_what_cannot_be_set_is_named() -> None:
    """A measured variable has no mechanism that could be asked alone."""
    scm = SCM([Exogenous(name="a"), Measured(name="b", parents=("a",))])
    with pytest.raises(ModelError, match="'b' cannot be set"):
        SCMSimulator(scm)


def test_vectors_and_whole_numbers_are_not_moved_a_little() -> None:
    """They are named where all are moved at once; one at a time they are no problem."""
    wide = Box((0.0, 0.0), (1.0, 1.0))
    scm = SCM(
        [
            Exogenous(name="v", shape=(2,), default=(0.0, 0.0), a=wide),
            Exogenous(name="k", dtype="integer", default=1),
            Derived(name="y", parents=("k", "v"), mechanism=Function(first_of)),
        ]
    )
    with pytest.raises(ModelError) as told:
        learn("pooled", SCMSimulator(scm))
    assert [problem.split()[0] for problem in told.value.problems] == ["'v'", "'k'"]
    with pytest.raises(ModelError, match="cannot be moved a little"):
        learn("coloring", SCMSimulator(scm), declared=())
    assert learn("paired", SCMSimulator(scm), budget=20).directed == (("k", "y", 0),)


def test_moves_are_in_the_size_of_a_variable() -> None:
    """A variable with bounds is moved by a part of them, whatever its unit."""
    scm = SCM(
        [
            Exogenous(name="x", bounds=Box(0.0, 1000.0), default=500.0),
            Derived(name="y", parents=("x",), mechanism=Linear(weights=(2.0,))),
        ]
    )
    simulator = SCMSimulator(scm)
    simulator.prepare(0)
    np.testing.assert_allclose(simulator.answers({"x": 0.1}), [0.0, 200.0])
    assert simulator.used == 2


def test_pooled_says_that_it_sees_one_lag() -> None:
    """A model with edges of both lags is not found whole, and a note says so."""
    model = SCM(
        [
            Derived(name="x", parents=(Parent("x", 1),), mechanism=Linear(weights=(0.5,))),
            Derived(name="y", parents=("x",), mechanism=Linear(weights=(2.0,))),
        ]
    )
    assert sparse_pooled(SCMSimulator(model)).notes == (
        "edges of lag 1 only, and there are others",
    )
