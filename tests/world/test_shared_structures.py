"""Worlds of an equal task and equal options share what the task is compiled to."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from scm_world.tasks.trifinger.single import Pushing
from scm_world.world import Simulation


def made(task: Any = "pushing", **options: Any) -> Simulation:
    """Make a world of the fake engine."""
    return Simulation(task, backend="fake", **options)


def test_equal_worlds_share() -> None:
    """Also where one is made by name and the other of a task; each has its own numbers."""
    one, other = made(), made(Pushing())
    assert one.structures is other.structures
    one.reset(seed=0)
    other.reset(seed=0)
    one.do({"tool_block.mass": 0.07})
    assert other["tool_block.mass"] != one["tool_block.mass"]


def heavier(task: Pushing) -> None:
    """Change an attribute."""
    task._mass = 0.5


def weighted(task: Pushing) -> None:
    """Change what an attribute holds."""
    task.weights = {**task.weights, "fractional_success": 7.0}


@pytest.mark.parametrize("change", [heavier, weighted])
def test_a_task_that_was_changed_has_its_own(change: Callable[[Pushing], None]) -> None:
    """Its arguments are the same: attributes count."""
    task, plain = Pushing(), made()
    change(task)
    changed = made(task)
    assert changed.structures is not plain.structures
    for world in (changed, plain):
        world.reset(seed=0)
    rewards: list[Any] = [world.model.declared("reward") for world in (changed, plain)]
    one, other = (reward.equation.weights for reward in rewards)
    assert changed["tool_block.mass"] != plain["tool_block.mass"] or one != other


def test_a_world_whose_task_was_changed_lends_nothing() -> None:
    """The next world is that of the name."""
    one = made()
    weights: Any = one.structures.task.weights
    weights["fractional_success"] = 7.0
    assert made().structures is not one.structures
    assert made().task.weights["fractional_success"] == 1.0


@pytest.mark.parametrize(
    ("task", "options"),
    [
        (Pushing(tool_block_mass=0.03), {}),
        ("picking", {}),
        ("pushing", {"frame_skip": 3}),
        ("pushing", {"conventions": "causal_world"}),
        ("pushing", {"max_episode_length": 7}),
    ],
)
def test_others_do_not(task: Any, options: dict[str, Any]) -> None:
    """Another argument, another task, other options."""
    assert made(task, **options).structures is not made().structures


def test_a_class_of_a_user_is_compiled_for_each_world() -> None:
    """What its methods read may change between two worlds."""

    class Mine(Pushing):
        """A task of a user."""

    assert made(Mine()).structures is not made(Mine()).structures


def test_arguments_that_are_arrays_are_not_compared() -> None:
    """Two arrays have no one truth value."""
    worlds = [made(Pushing(tool_block_position=np.array([0.0, y]))) for y in (0.02, 0.03, 0.03)]
    for world in worlds:
        world.reset(seed=0)
    found = [round(world["tool_block.cartesian_position"][1].item(), 6) for world in worlds]
    assert found == [0.02, 0.03, 0.03]
