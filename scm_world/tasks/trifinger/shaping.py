"""Reward terms that are there for the asking: what helps a learner on its way to the goal.

``task_options={"terms": ["reward.goal_kernel"], "weights": {"reward.goal_kernel": 1.0}}`` adds one
to the terms of a task. Names are plain data, so the specification of the environment stays JSON.
Which ones a task has is in its ``ready_terms``.

Source:
    The kernel on corners is that of Allshire et al., *Transferring Dexterous Manipulation from GPU
    Simulation to a Remote Real-World TriFinger*, IROS 2022, here times 4, so that it ends at 1.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from scm_world._types import Floats, Value
from scm_world.geometry.rotations import rotation_kernel
from scm_world.geometry.scalars import scalar
from scm_world.tasks.rewards import term
from scm_world.tasks.trifinger.kernels import distance
from scm_world.variables import Function, Measured, Parent

COARSE = 30.0  # [1/m] the kernel falls to a half at 6 cm
FINE = 150.0  # [1/m] and here at 12 mm
BEHIND = 0.05  # [m] from the center of a block to where a fingertip pushes it
NEAR = 0.01  # [m] nearer to the goal, where to push from moves towards the center of the block

_TOOL, _GOAL = "tool_block", "goal_block"
_MOVES = ("cartesian_position", "orientation")
_POSE = ("size", *_MOVES)


@njit(cache=True)
def logistic(length: float, sharpness: float) -> float:
    """Compute the kernel 4 / (exp(s d) + 2 + exp(-s d)), which is 1 at d = 0 and falls to 0.

    Args:
        length: The distance d [m].
        sharpness: s [1/m].
    """
    half = math.exp(-min(sharpness * length, 700.0))
    return 4.0 * half / ((1.0 + half) * (1.0 + half))


@njit(cache=True)
def corner_distance(
    size: Floats,
    position: Floats,
    orientation: Floats,
    goal_size: Floats,
    goal_position: Floats,
    goal_orientation: Floats,
) -> float:
    """Compute the mean distance of the eight corners of two boxes, corner by corner [m]."""
    turn, goal_turn = np.empty((3, 3)), np.empty((3, 3))
    rotation_kernel(orientation, turn)
    rotation_kernel(goal_orientation, goal_turn)
    total = 0.0
    for corner in range(8):
        squared = 0.0
        for row in range(3):
            gap = position[row] - goal_position[row]
            for axis in range(3):
                side = 0.5 if (corner >> axis) & 1 else -0.5
                gap += side * (
                    turn[row, axis] * size[axis] - goal_turn[row, axis] * goal_size[axis]
                )
            squared += gap * gap
        total += math.sqrt(squared)
    return total / 8.0


@njit(cache=True)
def goal_kernel(
    size: Floats,
    position: Floats,
    orientation: Floats,
    goal_size: Floats,
    goal_position: Floats,
    goal_orientation: Floats,
    sharpness: Value,
) -> float:
    """Compute the kernel of the mean distance of the corners, in [0, 1]."""
    far = corner_distance(size, position, orientation, goal_size, goal_position, goal_orientation)
    return logistic(far, scalar(sharpness))


@njit(cache=True)
def corners_progress(
    size: Floats,
    position: Floats,
    orientation: Floats,
    position_before: Floats,
    orientation_before: Floats,
    goal_size: Floats,
    goal_position: Floats,
    goal_orientation: Floats,
) -> float:
    """Compute how much nearer the corners of the block came to those of the goal [m]."""
    goal = goal_size, goal_position, goal_orientation
    before = corner_distance(size, position_before, orientation_before, *goal)
    return before - corner_distance(size, position, orientation, *goal)


@njit(cache=True)
def pushing_distance(tips: Floats, block: Floats, goal: Floats) -> float:
    """Compute how far the nearest fingertip is from behind the block, seen from its goal [m]."""
    x, y = goal[0] - block[0], goal[1] - block[1]
    scale = BEHIND / max(math.sqrt(x * x + y * y), NEAR)
    nearest = math.inf
    for finger in range(3):
        dx = tips[3 * finger] - block[0] + scale * x
        dy = tips[3 * finger + 1] - block[1] + scale * y
        dz = tips[3 * finger + 2] - block[2]
        nearest = min(nearest, dx * dx + dy * dy + dz * dz)
    return math.sqrt(nearest)


@njit(cache=True)
def pushing_progress(
    tips: Floats, tips_before: Floats, block: Floats, block_before: Floats, goal: Floats
) -> float:
    """Compute how much nearer a fingertip came to where it can push the block to its goal [m]."""
    before = pushing_distance(tips_before, block_before, goal)
    return before - pushing_distance(tips, block, goal)


@njit(cache=True)
def reach_kernel(
    tips: Floats, goal_60: Floats, goal_120: Floats, goal_300: Floats, sharpness: Value
) -> float:
    """Compute the mean kernel of the three fingertips, shape (9,), and their goals, in [0, 1]."""
    steep = scalar(sharpness)
    total = logistic(distance(tips[:3], goal_60), steep)
    total += logistic(distance(tips[3:6], goal_120), steep)
    total += logistic(distance(tips[6:], goal_300), steep)
    return total / 3.0


@njit(cache=True)
def minus_length(vector: Floats) -> float:
    """Compute minus the Euclidean norm of a vector."""
    return -distance(vector, np.zeros(vector.size))


@njit(cache=True)
def minus_change(now: Floats, before: Floats) -> float:
    """Compute minus the change of the joint velocities [rad/s]."""
    return -distance(now, before)


_BLOCK = tuple(f"{_TOOL}.{part}" for part in _POSE)
_WANTED = tuple(f"{_GOAL}.{part}" for part in _POSE)
TIPS = "end_effector_positions"
WAS = Parent(TIPS, 1)
_REACH = (TIPS, *(f"goal_{f}.cartesian_position" for f in ("60", "120", "300")))

ROBOT: tuple[Measured, ...] = (
    term(
        "reward.speed",
        minus_length,
        ("joint_velocities",),
        "Minus the norm of the joint velocities [rad/s].",
    ),
    term(
        "reward.effort",
        minus_length,
        ("joint_torques",),
        "Minus the norm of the joint torques [N m].",
    ),
)
"""Terms of every task. The second one keeps fingers from pressing a block from all sides."""

SMOOTHNESS = "smoothness", minus_change, ("joint_velocities", Parent("joint_velocities", 1))
"""A term that most tasks have by themselves."""

ONE_BLOCK: tuple[Measured, ...] = (
    *ROBOT,
    term(
        "reward.goal_kernel",
        Function(goal_kernel, constants={"sharpness": COARSE}),
        (*_BLOCK, *_WANTED),
        "How near the corners of the block are to those of the goal, in [0, 1].",
    ),
    term(
        "reward.goal_kernel_fine",
        Function(goal_kernel, constants={"sharpness": FINE}),
        (*_BLOCK, *_WANTED),
        "How near the corners are, in [0, 1]; it is felt within about 2 cm.",
    ),
    term(
        "reward.corners_to_goal",
        corners_progress,
        (*_BLOCK, *(Parent(f"{_TOOL}.{part}", 1) for part in _MOVES), *_WANTED),
    ),
    term(
        "reward.tip_behind_block",
        pushing_progress,
        (
            *(TIPS, WAS),
            *(f"{_TOOL}.cartesian_position", Parent(f"{_TOOL}.cartesian_position", 1)),
            f"{_GOAL}.cartesian_position",
        ),
    ),
)
"""Terms of tasks with one block and one goal."""

REACHING: tuple[Measured, ...] = (
    *ROBOT,
    term(
        "reward.reach_kernel",
        Function(reach_kernel, constants={"sharpness": COARSE}),
        _REACH,
        "How near the fingertips are to their goals, in [0, 1].",
    ),
    term(
        "reward.reach_kernel_fine",
        Function(reach_kernel, constants={"sharpness": FINE}),
        _REACH,
        "How near the fingertips are, in [0, 1]; it is felt within about 2 cm.",
    ),
)
"""Terms of reaching."""
