"""Relative and averaged actions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from envs import ABSOLUTE, make, roll

from scm_world.errors import UnknownOption


def commands(env: Any) -> Any:
    """Give the last command of the world [SI units]."""
    return env.unwrapped.world["action"]


def test_joint_targets_add_up() -> None:
    """A relative target starts from the present joints, then from the last target."""
    env = make(action_mode="delta_joint_positions", normalize_actions=False, backend="mujoco")
    env.reset(seed=0)
    joints = env.unwrapped.world["joint_positions"]
    step = np.full(9, 0.05)
    for times in (1, 2, 3):
        env.step(step)
        np.testing.assert_allclose(commands(env), joints + times * step)
    assert not np.allclose(env.unwrapped.world["joint_positions"], commands(env), atol=1e-3)


def test_a_normalized_step_is_a_part_of_half_the_range() -> None:
    """In normalized units 0.1 is a tenth of half the range of an action."""
    env = make(action_mode="delta_joint_positions")
    env.reset(seed=0)
    world = env.unwrapped.world
    joints, half = world["joint_positions"], (world.action_high - world.action_low) / 2
    env.step(np.full(9, 0.1, np.float32))
    np.testing.assert_allclose(commands(env), joints + 0.1 * half, rtol=1e-6)


def test_targets_start_anew_where_joints_are_put() -> None:
    """After an intervention on the joints the offset is their present position."""
    env = make(action_mode="delta_joint_positions", backend="mujoco")
    roll(env, 3)
    before = commands(env)
    env.unwrapped.do({"floor_color": [0.1, 0.1, 0.1]})
    env.step(np.zeros(9))
    np.testing.assert_allclose(commands(env), before)
    put = np.array([0.0, 0.7, -0.7] * 3)
    env.unwrapped.do({"joint_positions": put})
    env.step(np.zeros(9))
    np.testing.assert_allclose(commands(env), put)
    env.step(np.zeros(9))
    np.testing.assert_allclose(commands(env), put)


def test_relative_actions_go_on_after_a_snapshot() -> None:
    """What they are relative to is part of the world: a restored one goes on bit for bit."""
    env = make(action_mode="delta_joint_positions", backend="mujoco")
    roll(env, 5)
    saved = env.unwrapped.world.snapshot()
    action = np.full(9, 0.02, np.float32)
    first = [env.step(action)[0] for _ in range(3)]
    roll(env, 2, seed=9)
    env.unwrapped.world.restore(saved)
    again = [env.step(action)[0] for _ in range(3)]
    np.testing.assert_array_equal(first, again)


def test_torques_add_up() -> None:
    """Relative torques start from zero and add up until the limit."""
    env = make(action_mode="delta_joint_torques", normalize_actions=False)
    env.reset(seed=0)
    for expected in (0.1, 0.2, 0.3, 0.36):
        env.step(np.full(9, 0.1))
        np.testing.assert_allclose(commands(env), expected)
    env.reset()
    env.step(np.full(9, -0.1))
    np.testing.assert_allclose(commands(env), -0.1)


def test_tips_are_relative_to_where_they_are() -> None:
    """A relative target of the fingertips starts from the present ones at every step."""
    env = make(
        action_mode="delta_end_effector_positions", normalize_actions=False, backend="mujoco"
    )
    env.reset(seed=0)
    for _ in range(4):
        tips = env.unwrapped.world["end_effector_positions"]
        env.step(np.full(9, 0.01))
        np.testing.assert_allclose(commands(env), tips + 0.01)


@pytest.mark.parametrize("mode", ABSOLUTE)
def test_spaces_of_relative_actions_are_symmetric(mode: str) -> None:
    """A relative action goes half of the range to either side, whatever the unit."""
    raw = make(action_mode=f"delta_{mode}", normalize_actions=False)
    world = raw.unwrapped.world
    half = (world.action_high - world.action_low) / 2
    np.testing.assert_allclose(raw.action_space.high, half, rtol=1e-6)
    np.testing.assert_array_equal(raw.action_space.low, -raw.action_space.high)
    scaled = make(action_mode=f"delta_{mode}").action_space
    np.testing.assert_allclose(scaled.high, np.ones(9))


def test_as_action_is_the_inverse_of_a_command() -> None:
    """An action that stands for a command brings that command about."""
    env = make()
    env.reset(seed=0)
    wanted = np.array([0.1, 0.6, -0.7] * 3)
    env.step(env.unwrapped.as_action(wanted))
    np.testing.assert_allclose(commands(env), wanted)


@pytest.mark.parametrize("origin", ["command", "measured"])
def test_relative_actions_can_be_small_and_start_from_where_the_joints_are(origin: str) -> None:
    """An action of 1 adds the share of half of the range to the origin that was asked for."""
    options = {"action_mode": "delta_joint_positions", "backend": "mujoco"}
    env = make(**options, delta_scale=0.1, delta_origin=origin)
    env.reset(seed=0)
    assert np.array_equal(env.action_space.high, np.ones(9, np.float32))
    world = env.unwrapped.world
    half = (world.action_high - world.action_low) / 2.0
    env.step(np.full(9, 0.5, np.float32))
    before = {"command": world["action"], "measured": world["joint_positions"]}[origin]
    env.step(np.full(9, 7.0, np.float32))  # what lies outside is clipped
    expected = np.clip(before + 0.1 * half, world.action_low, world.action_high)
    assert np.allclose(world["action"], expected, atol=1e-12)


@pytest.mark.parametrize(
    "wrong",
    [
        {"delta_scale": 0.1},
        {"delta_origin": "measured"},
        {"action_mode": "delta_joint_positions", "delta_scale": 0.0},
        {"action_mode": "delta_joint_positions", "delta_scale": "much"},
        {"action_mode": "delta_joint_positions", "delta_origin": "here"},
        {"action_mode": "delta_joint_torques", "delta_origin": "measured"},
    ],
)
def test_what_relative_actions_cannot_be_is_refused(wrong: dict[str, Any]) -> None:
    """Scales, origins, and both where actions are absolute."""
    with pytest.raises(UnknownOption, match="delta_"):
        make(**wrong)
