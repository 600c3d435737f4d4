"""Plans with blocks instead of fingers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from envs import REACHING, make

from scm_world.env import ObjectSelector
from scm_world.errors import ActionError, UnknownOption
from scm_world.tasks.trifinger.hardware import RAISED

POSITION, TURN = "tool_block.cartesian_position", "tool_block.euler_orientation"


def planner(**options: Any) -> ObjectSelector:
    """Make an environment to plan in; nothing falls in it."""
    env = ObjectSelector(make(frame_skip=1, **options))
    env.reset(seed=0)
    return env


@pytest.mark.parametrize(
    ("move", "turn", "place", "angles"),
    [
        (0, 0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        (1, 0, (0.0, 0.0, 0.002), (0.0, 0.0, 0.0)),
        (3, 0, (0.002, 0.0, 0.0), (0.0, 0.0, 0.0)),
        (6, 0, (0.0, -0.002, 0.0), (0.0, 0.0, 0.0)),
        (0, 2, (0.0, 0.0, 0.0), (0.0, 0.0, -0.1)),
        (5, 1, (0.0, 0.002, 0.0), (0.0, 0.0, 0.1)),
    ],
)
def test_an_action_moves_the_block(
    move: int, turn: int, place: tuple[float, ...], angles: tuple[float, ...]
) -> None:
    """Each number is a step along one axis, or about it, to one side."""
    env = planner()
    world = env.unwrapped.world
    before, turned = world[POSITION], world[TURN]
    info = env.step(np.array([0, move, turn]))[4]
    assert info["refused"] == ""
    np.testing.assert_allclose(world[POSITION] - before, place, atol=1e-9)
    np.testing.assert_allclose(world[TURN] - turned, angles, atol=1e-9)


def test_a_move_into_the_floor_is_refused_and_reported() -> None:
    """A block is not pressed into the floor: info says so and the block stays."""
    env = planner()
    world = env.unwrapped.world
    before = world[POSITION]
    info = env.step(np.array([0, 2, 0]))[4]
    assert "floor" in info["refused"]
    np.testing.assert_array_equal(world[POSITION], before)


def test_observations_have_one_shape() -> None:
    """A reset and a step give the same vector: that of the environment without the robot."""
    env = planner()
    first, info = env.reset(seed=0)
    then, *_, info_then = env.step(np.array([0, 3, 0]))
    assert first.shape == then.shape == env.observation_space.shape == (28,)
    assert env.observation_space.contains(then)
    assert np.flatnonzero(first != then).tolist() == [4]  # x of the block
    assert set(info) == set(info_then)


def test_the_robot_is_raised_and_held() -> None:
    """The fingers keep out of the way, and what is done at the reset is done too."""
    env = ObjectSelector(make(frame_skip=1, backend="mujoco"))
    env.reset(seed=0, options={"do": {"tool_block": {"mass": 0.05}}})
    world = env.unwrapped.world
    for _ in range(20):
        env.step(env.action_space.sample())
    np.testing.assert_allclose(world["joint_positions"], RAISED, atol=0.02)
    assert world["tool_block.mass"] == 0.05


def test_every_block_can_be_moved() -> None:
    """There are as many choices as blocks, also when their number changes."""
    env = ObjectSelector(make("scm_world/Towers-v0", frame_skip=1))
    env.reset(seed=0)
    world = env.unwrapped.world
    assert env.action_space.nvec.tolist() == [5, 7, 7]
    env.unwrapped.do({"number_of_blocks_in_tower": [1, 1, 2]})
    assert env.action_space.nvec.tolist() == [2, 7, 7]
    name = f"{world.composition.blocks[1]}.cartesian_position"
    before = world[name]
    observation, *_, info = env.step(np.array([1, 1, 0]))
    assert info["refused"] == ""
    np.testing.assert_allclose(world[name] - before, [0.0, 0.0, 0.002], atol=1e-9)
    assert observation.shape == env.observation_space.shape == (2 * 28,)


def test_random_plans_stay_in_the_space() -> None:
    """Whatever is tried, observations lie in their space and refusals are told."""
    env = ObjectSelector(make(frame_skip=1, backend="mujoco"))
    env.reset(seed=0)
    env.action_space.seed(0)
    refused = 0
    for _ in range(150):
        observation, *_, info = env.step(env.action_space.sample())
        assert env.observation_space.contains(observation)
        refused += bool(info["refused"])
    assert 0 < refused < 150


def test_only_sensible_environments_are_planned_in() -> None:
    """Without blocks, with other actions or observations there is nothing to plan."""
    for env in (
        make(REACHING),
        make(action_mode="joint_torques"),
        make(action_mode="delta_joint_positions"),
        make(observation_mode="pixel"),
        make(goal_env=True),
    ):
        with pytest.raises(UnknownOption):
            ObjectSelector(env)
    with pytest.raises(ActionError):
        planner().step(np.array([1, 0, 0]))
