"""The learner that does paired experiments, on models."""

from __future__ import annotations

from typing import Any

import pytest

from scm_world.discovery.learners import learn
from scm_world.discovery.learners.paired import SystemSimulator
from scm_world.errors import ModelError, UnknownOption
from scm_world.graph import SCM
from scm_world.tasks.families import random_model
from scm_world.variables import Box, Derived, Exogenous, Function, Measured


def first_of(first: Any, vector: Any) -> Any:
    """Pass the first cause on."""
    return first + 0.0 * vector.sum(axis=-1)


@pytest.mark.parametrize("family", ["er2:12", "sf2:12", "tanh4:12"])
@pytest.mark.parametrize("seed", [0, 1])
def test_one_variable_at_a_time_finds_the_graph(family: str, seed: int) -> None:
    """Four units are enough; experiments are counted, and twice the budget changes nothing."""
    scm = random_model(family, seed)
    true = {edge.key for edge in scm.edges}
    found = learn("paired", SystemSimulator(scm, seed), budget=56)
    assert set(found.directed) == true
    assert 42 <= found.experiments <= 56
    assert found.notes == ("floor 0",)
    assert found.bound is not None
    assert found.bound <= found.experiments
    assert set(learn("paired", SystemSimulator(scm, seed), budget=112).directed) == true


@pytest.mark.parametrize("budget", [0, -3])
def test_a_budget_of_nothing_is_refused(budget: int) -> None:
    """The message has the budget."""
    with pytest.raises(UnknownOption, match="budget"):
        learn("paired", SystemSimulator(random_model("er2:5")), budget=budget)


def test_a_model_without_edges_has_none() -> None:
    """Nothing answers."""
    scm = SCM([Exogenous(name=name) for name in "xyz"])
    assert learn("paired", SystemSimulator(scm)).directed == ()


def test_what_cannot_be_set_is_named() -> None:
    """A measured variable has no mechanism that could be asked alone."""
    scm = SCM([Exogenous(name="a"), Measured(name="b", parents=("a",))])
    with pytest.raises(ModelError, match="'b' cannot be set"):
        SystemSimulator(scm)


def test_vectors_and_whole_numbers_are_moved_too() -> None:
    """Each variable is moved as a whole."""
    wide = Box((0.0, 0.0), (1.0, 1.0))
    scm = SCM(
        [
            Exogenous(name="v", shape=(2,), default=(0.0, 0.0), a=wide),
            Exogenous(name="k", dtype="integer", default=1),
            Derived(name="y", parents=("k", "v"), mechanism=Function(first_of)),
        ]
    )
    assert learn("paired", SystemSimulator(scm), budget=20).directed == (("k", "y", 0),)
