"""Names of the predecessor that mean the same here."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from given import begin

from scm_world.env import IDS
from scm_world.tasks import TASKS, make_task

IDENTITY = [0, 0, 0, 1]
BLOCK: dict[str, Any] = {
    "activate_sparse_reward": False,
    "joint_positions": None,
    "tool_block_mass": 0.02,
    "tool_block_orientation": IDENTITY,
}
GOAL: dict[str, Any] = {"goal_block_orientation": IDENTITY, "fractional_reward_weight": 1}
ARGUMENTS: dict[str, dict[str, Any]] = {
    "reaching": {
        "fractional_reward_weight": 1,
        "dense_reward_weights": np.array([100_000, 0, 0, 0]),
        "default_goal_60": np.array([0, 0, 0.10]),
        "default_goal_120": np.array([0, 0, 0.13]),
        "default_goal_300": np.array([0, 0, 0.16]),
        "joint_positions": None,
        "activate_sparse_reward": False,
    },
    "pushing": {
        **BLOCK,
        **GOAL,
        "dense_reward_weights": np.array([750, 250, 100]),
        "tool_block_position": np.array([0, -0.08, 0.0325]),
        "goal_block_position": np.array([0, 0.08, 0.0325]),
    },
    "picking": {
        **BLOCK,
        "fractional_reward_weight": 1,
        "dense_reward_weights": np.array([250, 0, 125, 0, 750, 0, 0, 0.005]),
        "tool_block_position": np.array([0, 0, 0.0325]),
        "goal_height": 0.15,
    },
    "pick_and_place": {
        **BLOCK,
        **GOAL,
        "fractional_reward_weight": 0,
        "dense_reward_weights": np.array([750, 50, 250, 0, 0.005]),
        "tool_block_position": np.array([0, -0.09, 0.0325]),
        "goal_block_position": np.array([0, 0.09, 0.0325]),
    },
    "stacking2": {
        "activate_sparse_reward": False,
        "fractional_reward_weight": 1,
        "dense_reward_weights": np.array([750, 250, 250, 125, 0.005]),
        "tool_block_mass": 0.02,
        "tool_block_size": 0.065,
        "joint_positions": None,
        "tool_block_1_position": np.array([0, 0, 0.0325]),
        "tool_block_1_orientation": np.array(IDENTITY),
        "tool_block_2_position": np.array([0.01, 0.08, 0.0325]),
        "tool_block_2_orientation": np.array(IDENTITY),
        "goal_position": np.array([-0.06, -0.06, 0.0325]),
        "goal_orientation": np.array(IDENTITY),
    },
    "towers": {
        "dense_reward_weights": np.array([]),
        "tool_block_mass": 0.08,
        "number_of_blocks_in_tower": np.array([1, 1, 5]),
        "tower_dims": np.array([0.035, 0.035, 0.175]),
        "tower_center": np.array([0, 0]),
    },
    "stacked_blocks": {
        "dense_reward_weights": np.array([]),
        "tool_block_mass": 0.08,
        "joint_positions": None,
        "blocks_min_size": 0.035,
        "num_of_levels": 5,
        "max_level_width": 0.25,
    },
    "creative_stacked_blocks": {
        "dense_reward_weights": np.array([]),
        "tool_block_mass": 0.08,
        "joint_positions": None,
        "blocks_min_size": 0.035,
        "num_of_levels": 8,
        "max_level_width": 0.12,
    },
    "general": {
        "dense_reward_weights": np.array([]),
        "tool_block_mass": 0.08,
        "joint_positions": None,
        "tool_block_size": 0.05,
        "nums_objects": 5,
    },
}
"""Published arguments of the task generators, with their defaults, but for ``variables_space``."""


def test_the_generators_have_their_published_ids() -> None:
    """Nine families, each with a task and an environment."""
    assert sorted(ARGUMENTS) == sorted(TASKS) == sorted(IDS.values())


@pytest.mark.parametrize("task", ARGUMENTS)
def test_published_arguments_are_taken(task: str) -> None:
    """With the published defaults, arrays included, a task is the one without arguments."""
    given, plain = begin(make_task(task, **ARGUMENTS[task])), begin(task)
    assert given.task.weights == plain.task.weights
    now, then = given.values(), plain.values()
    assert now.keys() == then.keys()
    for name, value in now.items():
        np.testing.assert_allclose(value, then[name], atol=1e-15, err_msg=name)


MOVABLE = (
    *("type", "cartesian_position", "cylindrical_position", "orientation", "size", "color"),
    *("friction", "linear_velocity", "angular_velocity", "mass"),
)
STATIC, SEEN = MOVABLE[:7], MOVABLE[:6]
COMMON = {
    *("gravity", "floor_friction", "stage_friction", "floor_color", "stage_color"),
    *("joint_positions", "joint_velocities", "robot_height", "control_index"),
    *(
        f"robot_finger_{f}_link_{i}.{w}"
        for f in (60, 120, 300)
        for i in range(4)
        for w in ("color", "mass")
    ),
}
BODIES: dict[str, dict[str, tuple[str, ...]]] = {
    "reaching": dict.fromkeys(("goal_60", "goal_120", "goal_300"), SEEN),
    "pushing": {"tool_block": MOVABLE, "goal_block": SEEN},
    "picking": {"tool_block": MOVABLE, "goal_block": SEEN},
    "pick_and_place": {"tool_block": MOVABLE, "goal_block": SEEN, "obstacle": STATIC},
    "stacking2": {
        **{f"tool_block_{i}": MOVABLE for i in (1, 2)},
        **{f"goal_block_{i}": SEEN for i in (1, 2)},
        "goal_tower": ("cylindrical_position", "euler_orientation"),
    },
    "towers": {"tool_level_4_col_0_row_0": MOVABLE, "goal_level_4_col_0_row_0": SEEN},
    "stacked_blocks": {"tool_level_4_num_6": MOVABLE, "goal_level_4_num_6": SEEN},
    "creative_stacked_blocks": {"tool_level_3_num_2": MOVABLE, "goal_level_7_num_2": SEEN},
    "general": {"tool_4": MOVABLE, "goal_4": SEEN},
}
GENERATED = {
    "reaching": ("number_of_obstacles",),
    "towers": ("tower_dims", "number_of_blocks_in_tower", "tower_center", "blocks_mass"),
    "stacked_blocks": ("stack_levels", "blocks_min_size", "max_level_width", "blocks_mass"),
    "creative_stacked_blocks": (
        *("stack_levels", "blocks_min_size", "max_level_width", "blocks_mass"),
        "number_of_obstacles",
    ),
    "general": ("nums_objects", "tool_block_size", "blocks_mass"),
}


@pytest.mark.parametrize("task", BODIES)
def test_published_variables_exist(task: str) -> None:
    """All that the predecessor reports has the same name here, with a dot for the second key."""
    bodies = {f"{body}.{what}" for body, kinds in BODIES[task].items() for what in kinds}
    assert COMMON | bodies | set(GENERATED.get(task, ())) <= set(begin(task).values())
