"""Equations are worlds without a backend: spaces, snapshots and refusals are those of a world."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

from scm_world import SCM, Draw, World
from scm_world.errors import InterventionError, NotReset, OutOfBounds, SnapshotMismatch
from scm_world.variables import Action, Box, Derived, Exogenous, Linear, Normal, Parent

STATIC = [
    Exogenous(name="x", distribution=Normal(), a=Box(0.0, 1.0), b=Box(1.0, 2.0)),
    Derived(name="y", parents=("x",), mechanism=Linear(weights=(2.0,))),
]
TEMPORAL = [
    *STATIC,
    Action(name="push", bounds=Box(-1.0, 1.0), a=Box(-0.5, 0.5)),
    Derived(
        name="z",
        parents=(Parent("z", 1), Parent("push", 1), "y"),
        mechanism=Linear(weights=(0.5, 1.0, 1.0)),
    ),
]


@pytest.mark.parametrize("variables", [STATIC, TEMPORAL])
def test_the_space_of_a_request_counts_in_equations_too(variables: list[Any]) -> None:
    """What lies outside is refused, with the nearest value, and nothing has changed."""
    world: Any = World(SCM(variables))
    world.reset(seed=0, do={"x": 0.25}, space="A")
    assert world["y"] == 0.5
    before = world.values()
    with pytest.raises(OutOfBounds, match="outside space A") as caught:
        world.do({"x": 1.5}, space="A")
    assert caught.value.nearest == 1.0
    assert all(np.array_equal(value, before[name]) for name, value in world.values().items())
    world.do({"x": 1.5}, space="B")
    world.do({"x": Draw("A")}, space="A")
    with pytest.raises(OutOfBounds, match="outside space A"):
        world.reset(seed=0, do={"x": 7.0}, space="A")
    assert world.index == 0  # the episode has begun without it


def test_an_action_is_compared_with_a_space_if_it_is_known() -> None:
    """One that is drawn at every step cannot be."""
    world: Any = World(SCM(TEMPORAL))
    world.reset(seed=0)
    world.do({"push": 0.25}, space="A")
    with pytest.raises(OutOfBounds, match="push"):
        world.do({"push": 0.75}, space="A")
    with pytest.raises(InterventionError, match="varies from step to step"):
        world.do({"push": Draw("A")}, space="A")


def test_snapshots_of_equations_are_pickled_and_belong_to_one_model() -> None:
    """The future after going back is the same, bit for bit."""
    world: Any = World(SCM(TEMPORAL))
    with pytest.raises(NotReset):
        world.snapshot()
    world.reset(seed=3)
    world.do({"x": 0.5})
    world.step([0.5])
    saved = pickle.loads(pickle.dumps(world.snapshot()))  # noqa: S301 # our own
    ends = []
    for _ in range(2):
        world.step([1.0])
        ends.append(world.vector.tobytes())
        world.restore(saved)
    assert ends[0] == ends[1]
    assert world.index == 1
    with world.unchanged():
        world.reset(seed=9)
    assert (world.noise.seed, world.index) == (3, 1)
    with pytest.raises(SnapshotMismatch, match="not a snapshot of these equations"):
        World(SCM(STATIC)).restore(saved)  # type: ignore[arg-type] # equations


def test_an_empty_request_says_that_nothing_has_changed() -> None:
    """On a world with a backend and on equations alike."""
    for world in (World("pushing", backend="fake"), World(SCM(STATIC))):  # type: ignore[arg-type]
        world.reset(seed=0)
        assert str(world.do({})) == "no intervention was requested, and nothing has changed"
