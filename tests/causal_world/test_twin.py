"""Under the switch, an episode begins and goes on as in the predecessor.

The numbers were recorded in CausalWorld 1.2, after a second reset, on the release of Bullet on
which these tests ran.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from given import begin, make

import scm_world as sw

THEIRS = {"conventions": "causal_world"}

PUSH = (
    (1.0, -1.0, -1.0, -1.0, -1.0, -1.0, 1.0, -1.0, -1.0),
    (
        0.54730945,
        -0.18437185,
        -2.18298463,
        -0.8036958,
        -0.04552064,
        -2.45570996,
        0.50964648,
        0.1840447,
        -1.7520931,
    ),
    (0.04669691, -0.06091027, 0.04882242, -0.11105604, 0.31362507, 0.13161977, 0.93379982),
)
"""An action; the angles, and the pose of the block, after 20 control steps: pushed and lifted."""

REACH = (
    (-1.0, -1.0, -0.8, -0.4, -1.0, -1.0, -1.0, -1.0, 1.0),
    (
        -0.90238708,
        0.15122045,
        -1.74357937,
        -0.34391875,
        0.13251089,
        -1.65845909,
        -0.7225955,
        0.08648031,
        1.10459272,
    ),
    (0.0, -0.08, 0.03249, 0.0, 0.0, 0.0, 1.0),
)
"""The same of fingers that meet one another and the wall; 1e-15 rad at the start are 1e-3 then."""


@pytest.mark.parametrize(("recorded", "tolerance"), [(PUSH, 1e-6), (REACH, 2e-3)])
def test_bodies_move_as_in_the_predecessor(recorded: Any, tolerance: float) -> None:
    """Hulls, table, wall, damping, spinning friction and the order of contacts are its own."""
    pytest.importorskip("pybullet")
    action, joints, pose = recorded
    env = make(backend="bullet", frame_skip=3, **THEIRS)
    env.reset(seed=0)
    for _ in range(20):
        env.step(np.array(action, dtype=np.float32))
    world = env.unwrapped.world
    assert world["joint_positions"] == pytest.approx(joints, abs=tolerance)
    found = [*world["tool_block.cartesian_position"], *world["tool_block.orientation"]]
    assert found == pytest.approx(pose, abs=1e-4 if tolerance > 1e-5 else tolerance)


def test_a_contact_with_what_lies_under_the_table_is_one_with_the_floor() -> None:
    """A block that begins deep in the table plate touches the ground below, too."""
    pytest.importorskip("pybullet")
    world = begin("picking", "bullet", **THEIRS)
    world.reset(seed=0, do={"block.size": [0.08, 0.08, 0.09]})
    world.step(world["joint_positions"])
    touched = {name for contact in world.backend.contacts() for name in contact.bodies}
    assert touched <= {"floor", "tool_block"}


def test_large_blocks_reach_into_the_floor_in_picking_only() -> None:
    """There the start of the block does not follow its size."""
    size = {"block.size": [0.07, 0.07, 0.075]}
    heights = {}
    for task in ("picking", "pushing"):
        world = begin(task, **THEIRS)
        world.reset(seed=0, do=size)
        heights[task] = float(world["tool_block.cartesian_position"][2])
    assert heights == {"picking": pytest.approx(0.0325), "pushing": pytest.approx(0.0375)}


def test_the_wall_keeps_its_center() -> None:
    """There a wall of another height floats, or reaches into the floor."""
    world = begin("pick_and_place", **THEIRS)
    world.reset(seed=0, do={"obstacle.size": [0.5, 0.015, 0.03]})
    assert world["obstacle.cartesian_position"] == pytest.approx([0.0, 0.0, 0.0325])
    assert float(world["obstacle.friction"]) == 1.0


@pytest.mark.parametrize(
    ("angle", "observed"),
    [(2.0, (0.0, 0.0, 0.08415, 0.05403)), (-2.6953, (0.0, 0.0, 0.09752, -0.02213))],
)
def test_quaternions_are_those_of_rotation_matrices(
    angle: float, observed: tuple[float, ...]
) -> None:
    """Beyond 120 degrees the greatest part is positive, and not w."""
    env = make(frame_skip=3, **THEIRS)
    turn = {"goal_block.euler_orientation": [0.0, 0.0, angle]}
    observation, _ = env.reset(seed=0, options={"do": turn})
    place = env.unwrapped.layout["goal_block.orientation"]
    assert observation[place] == pytest.approx(observed, abs=1e-5)
    assert env.unwrapped.world["goal_block.orientation"][3] >= 0.0


def test_nothing_is_checked_where_the_tower_is_moved() -> None:
    """There what sets a variable of the generator is accepted, whatever lies in one another."""
    world = begin("stacking2", **THEIRS)
    same = {f"tool_block_{i}.cylindrical_position": [0.1, 2.0, 0.05] for i in (1, 2)}
    with pytest.raises(sw.ScmWorldError, match="deep in"):
        world.do(same)
    world.do({**same, "goal_tower.cylindrical_position": [0.1, 0.0, 0.065]})
    assert world["tool_block_1.cartesian_position"] == pytest.approx(
        world["tool_block_2.cartesian_position"]
    )
