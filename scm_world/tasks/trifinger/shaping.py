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
from typing import Any

import numpy as np
from numba import njit

from scm_world._types import Floats, Value
from scm_world.geometry.rotations import rotation_kernel
from scm_world.geometry.scalars import scalar
from scm_world.tasks.rewards import term
from scm_world.tasks.trifinger import hardware, kernels
from scm_world.tasks.trifinger.kernels import BOX, distance
from scm_world.variables import Function, Measured, Parent
from scm_world.variables.mechanisms import Stacked

COARSE = 30.0  # [1/m] the kernel falls to a half at 6 cm
FINE = 150.0  # [1/m] and here at 12 mm
BEHIND = 0.05  # [m] from the center of a block to where a fingertip pushes it
NEAR = 0.01  # [m] nearer to the goal, where to push from moves towards the center of the block


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
def corner_distance(box: Floats, goal: Floats) -> float:
    """Compute the mean distance of the eight corners of two boxes, corner by corner [m].

    Each is its size [m], its position [m] and its quaternion, shape (10,).
    """
    turn, goal_turn = np.empty((3, 3)), np.empty((3, 3))
    rotation_kernel(box[6:], turn)
    rotation_kernel(goal[6:], goal_turn)
    total = 0.0
    for corner in range(8):
        squared = 0.0
        for row in range(3):
            gap = box[3 + row] - goal[3 + row]
            for axis in range(3):
                side = 0.5 if (corner >> axis) & 1 else -0.5
                gap += side * (turn[row, axis] * box[axis] - goal_turn[row, axis] * goal[axis])
            squared += gap * gap
        total += math.sqrt(squared)
    return total / 8.0


@Stacked
@njit(cache=True)
def goal_kernel(boxes: Floats, sharpness: Value) -> float:
    """Compute the kernel of the mean distance of the corners of block and goal, in [0, 1]."""
    return logistic(corner_distance(boxes[:BOX], boxes[BOX:]), scalar(sharpness))


@Stacked
@njit(cache=True)
def corners_progress(boxes: Floats) -> float:
    """Compute how much nearer the corners of the block came to those of the goal [m].

    ``boxes`` has size and pose of the block, its pose before, and size and pose of the goal.
    """
    block, goal = boxes[:BOX], boxes[-BOX:]
    before = np.concatenate((block[:3], boxes[BOX:-BOX]))
    return corner_distance(before, goal) - corner_distance(block, goal)


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


@Stacked
@njit(cache=True)
def reach_kernel(points: Floats, sharpness: Value) -> float:
    """Compute the mean kernel of the three fingertips and their goals, in [0, 1]."""
    total = 0.0
    for i in range(0, 9, 3):
        total += logistic(distance(points[i : i + 3], points[9 + i : 12 + i]), scalar(sharpness))
    return total / 3.0


@njit(cache=True)
def minus_length(vector: Floats) -> float:
    """Compute minus the Euclidean norm of a vector."""
    return -distance(vector, np.zeros(vector.size))


@njit(cache=True)
def minus_change(now: Floats, before: Floats) -> float:
    """Compute minus the change of the joint velocities [rad/s]."""
    return -distance(now, before)


TIPS = "end_effector_positions"
TIPS_WAS = Parent(TIPS, 1)
POSE = ("size", "cartesian_position", "orientation")
TOOL, GOAL = "tool_block", "goal_block"
_BOXES = tuple(f"{name}.{part}" for name in (TOOL, GOAL) for part in POSE)
BLOCK, TARGET = f"{TOOL}.cartesian_position", f"{GOAL}.cartesian_position"
WAS = Parent(BLOCK, 1)
PLACES = tuple(f"goal_{finger}.cartesian_position" for finger in hardware.FINGERS)

SMOOTHNESS = "smoothness", minus_change, ("joint_velocities", Parent("joint_velocities", 1))
TIPS_TO_BLOCK = "tips_to_block", kernels.tips_progress, (TIPS, TIPS_WAS, BLOCK, WAS)
TURNED = (
    "orientation",
    kernels.turn_progress,
    (f"{TOOL}.orientation", Parent(f"{TOOL}.orientation", 1), f"{GOAL}.orientation"),
)
"""Terms that several tasks have by themselves."""


def _terms(*rows: tuple[Any, ...]) -> tuple[Measured, ...]:
    return tuple(term(f"reward.{name}", *row) for name, *row in rows)


_SPEED = "Minus the norm of the joint velocities [rad/s]."
_EFFORT = "Minus the norm of the joint torques [N m]."
ROBOT = _terms(
    ("speed", minus_length, ("joint_velocities",), _SPEED),
    ("effort", minus_length, ("joint_torques",), _EFFORT),
)
"""Terms of every task. The second one keeps fingers from pressing a block from all sides."""

_COARSE, _FINE = ({"sharpness": sharpness} for sharpness in (COARSE, FINE))
_TURN = f"{TOOL}.orientation"

ONE_BLOCK = ROBOT + _terms(
    (
        "goal_kernel",
        Function(goal_kernel, constants=_COARSE),
        _BOXES,
        "How near the corners of the block are to those of the goal, in [0, 1].",
    ),
    (
        "goal_kernel_fine",
        Function(goal_kernel, constants=_FINE),
        _BOXES,
        "How near the corners are, in [0, 1]; it is felt within about 2 cm.",
    ),
    ("corners_to_goal", corners_progress, (*_BOXES[:3], WAS, Parent(_TURN, 1), *_BOXES[3:])),
    ("tip_behind_block", pushing_progress, (TIPS, TIPS_WAS, BLOCK, WAS, TARGET)),
)
"""Terms of tasks with one block and one goal."""

REACHING = ROBOT + _terms(
    (
        "reach_kernel",
        Function(reach_kernel, constants=_COARSE),
        (TIPS, *PLACES),
        "How near the fingertips are to their goals, in [0, 1].",
    ),
    (
        "reach_kernel_fine",
        Function(reach_kernel, constants=_FINE),
        (TIPS, *PLACES),
        "How near the fingertips are, in [0, 1]; it is felt within about 2 cm.",
    ),
)
"""Terms of reaching."""
