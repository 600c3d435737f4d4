"""Facts about tasks whose block and goal are convex shapes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from robot_scenes import box_hull

from scm_world.errors import NotIntervenable
from scm_world.geometry.hulls import Hull, hull_of
from scm_world.geometry.rotations import from_rotation_vector, quaternion_product, rotation_matrix
from scm_world.tasks import PickAndPlace, Picking, Pushing
from scm_world.tasks.trifinger import hardware
from scm_world.variables import Draw
from scm_world.world import Simulation

TASKS = (Pushing, Picking, PickAndPlace)
BLOCK, GOAL = "tool_block.cartesian_position", "goal_block.cartesian_position"


def wedge() -> Hull:
    """Give half a cuboid of 7 x 6 x 6 cm, cut along a diagonal."""
    return hull_of([(x, y, z) for y in (0.0, 0.06) for x, z in ((0, 0), (0.07, 0), (0, 0.06))])


def world_of(task: Any, backend: str = "fake", **options: Any) -> Simulation:
    """Give a world at the start of an episode."""
    world = Simulation(task(**options), backend=backend)
    world.reset(seed=0)
    return world


def lowest(world: Simulation, name: str) -> float:
    """Find the height of the lowest corner of block or goal."""
    turned = world[f"{name}.vertices"] @ rotation_matrix(world[f"{name}.orientation"]).T
    return float((turned + world[f"{name}.cartesian_position"])[:, 2].min())


@pytest.mark.parametrize("task", TASKS)
def test_a_box_can_be_given_as_a_shape(task: Any) -> None:
    """In any pose a cuboid of eight corners fills as much of its goal as a box does."""
    box, hull = world_of(task), world_of(task, shape=box_hull([0.065, 0.065, 0.065]))
    random = np.random.default_rng(0)
    for _ in range(20):
        pose = {
            BLOCK: box[GOAL] + random.uniform(-0.03, 0.03, 3) * [1.0, 1.0, 0.0] + [0, 0, 0.03],
            "tool_block.orientation": from_rotation_vector(random.uniform(-1.0, 1.0, 3)),
        }
        for world in (box, hull):
            world.do(pose)
        wanted = float(box["fractional_success"])
        assert float(hull["fractional_success"]) == pytest.approx(wanted, abs=1e-9)
        assert float(
            hull.task.goal.measures["fractional_success"](*hull.task.goal.vectors(hull.values()))
        ) == pytest.approx(wanted)
        assert hull["reward.tips_to_block"] == pytest.approx(box["reward.tips_to_block"])


@pytest.mark.parametrize("task", TASKS)
def test_a_shape_stands_on_its_lowest_corner(task: Any) -> None:
    """At the start, and after it was turned, the lowest corner is where it was."""
    world = world_of(task, shape=wedge(), tool_block_orientation=(0.0, 0.5, 0.0, 0.9))
    assert lowest(world, "tool_block") == pytest.approx(0.0, abs=1e-12)
    world.step(world["joint_positions"])
    world.do({"tool_block.euler_orientation": [0.4, -0.2, 0.1]})
    assert lowest(world, "tool_block") == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("task", [Pushing, PickAndPlace])
def test_the_goal_rests_on_the_side_that_was_chosen(task: Any) -> None:
    """New goals turn about the vertical, and stay on the floor in every pose."""
    tilt = tuple(from_rotation_vector([0.0, 0.7, 0.0]).tolist())
    world, yaws = world_of(task, shape=wedge(), goal_block_orientation=tilt), set()
    upwards = rotation_matrix(quaternion_product(tilt, wedge().axes))[2]
    for space in ("A", "B", "A", "B"):
        world.reset(do=world.task.sample_goal(space))
        turn = rotation_matrix(world["goal_block.orientation"])
        np.testing.assert_allclose(turn[2], upwards, atol=1e-12)
        assert lowest(world, "goal_block") == pytest.approx(0.0, abs=1e-12)
        yaws.add(float(world["goal_block.yaw"]))
        place = world.model["goal_block.cylindrical_position"]
        world.do({place.name: Draw(space)})
        assert lowest(world, "goal_block") == pytest.approx(0.0, abs=1e-9)
    assert len(yaws) == 4


def test_the_predecessor_measures_the_boxes_around() -> None:
    """By axis-aligned boxes a wedge upside down fills all of its goal; in truth it does not."""
    shape, fractions = wedge(), {}
    flat = tuple((shape.axes * np.array([-1.0, -1.0, -1.0, 1.0])).tolist())
    turned = np.array(shape.vertices) @ rotation_matrix([1.0, 0.0, 0.0, 0.0]).T
    middle = (np.array(shape.vertices).max(0) + np.array(shape.vertices).min(0)) / 2.0
    offset = middle - (turned.max(0) + turned.min(0)) / 2.0
    for name in ("scm_world", "causal_world"):
        task = Picking(shape=shape, goal_block_orientation=flat)
        world = Simulation(task, backend="fake", conventions=name)
        world.reset(seed=0)
        world.do({BLOCK: world[GOAL] + offset, "tool_block.orientation": [1.0, 0.0, 0.0, 0.0]})
        fractions[name] = float(world["fractional_success"])
        achieved, desired = world.task.goal.vectors(world.values())
        both = world.task.goal.measures["fractional_success"](
            np.stack([achieved, desired]), desired
        )
        np.testing.assert_allclose(both, [fractions[name], 1.0])
    assert fractions["causal_world"] == pytest.approx(1.0)
    assert 0.3 < fractions["scm_world"] < 0.9


def test_a_shape_has_no_size_to_set() -> None:
    """Its corners and its size are facts; there is no shared size."""
    world = world_of(Pushing, shape=wedge())
    assert "block.size" not in world.model
    for name in ("tool_block.size", "goal_block.vertices"):
        with pytest.raises(NotIntervenable):
            world.do({name: world[name]})


@pytest.mark.parametrize("backend", ["mujoco", "bullet"])
def test_a_wedge_that_was_drawn_on_its_side_stays_there(backend: str) -> None:
    """It begins the way its points were given, rests, and can be where the goal is."""
    world = world_of(Pushing, backend, shape=wedge(), joint_positions=hardware.RAISED)
    start = world["tool_block.orientation"]
    for _ in range(25):
        world.step(hardware.RAISED)
    np.testing.assert_allclose(world["tool_block.orientation"], start, atol=5e-3)
    world.do(world.task.solution(world.values()))
    for _ in range(25):
        world.step(hardware.RAISED)
    assert float(world["fractional_success"]) > 0.95
    world.close()
