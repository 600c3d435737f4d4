"""The numbers behind rewards and success, compiled because every control step needs them."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.geometry.overlap import WORKSPACE, overlap_kernel
from scm_world.geometry.rotations import angle_between_kernel


@njit(cache=True)
def distance(a: Floats, b: Floats) -> float:
    """Compute the Euclidean distance of two points of any dimension."""
    total = 0.0
    for i in range(a.size):
        total += (a[i] - b[i]) ** 2
    return math.sqrt(total)


@njit(cache=True)
def tips_distance(tips: Floats, position: Floats) -> float:
    """Compute the Frobenius norm of the three tips, shape (9,), minus a position, shape (3,)."""
    total = 0.0
    for i in range(9):
        total += (tips[i] - position[i % 3]) ** 2
    return math.sqrt(total)


@njit(cache=True)
def tips_progress(tips: Floats, tips_before: Floats, block: Floats, block_before: Floats) -> float:
    """Compute how much nearer the fingertips came to the block [m]."""
    return tips_distance(tips_before, block_before) - tips_distance(tips, block)


@njit(cache=True)
def block_progress(block: Floats, block_before: Floats, goal: Floats) -> float:
    """Compute how much nearer the block came to its goal [m]."""
    return distance(block_before, goal) - distance(block, goal)


@njit(cache=True)
def turn_progress(orientation: Floats, orientation_before: Floats, goal: Floats) -> float:
    """Compute by how much the angle between block and goal shrank [rad]."""
    return angle_between_kernel(orientation_before, goal) - angle_between_kernel(orientation, goal)


@njit(cache=True)
def filled(
    size: Floats,
    position: Floats,
    orientation: Floats,
    goal_size: Floats,
    goal_position: Floats,
    goal_orientation: Floats,
) -> float:
    """Compute the fraction of one goal that one block fills, in [0, 1]."""
    work = np.empty(WORKSPACE)
    shared = overlap_kernel(
        size, position, orientation, goal_size, goal_position, goal_orientation, work
    )
    fraction: float = shared / (goal_size[0] * goal_size[1] * goal_size[2])
    return min(1.0, fraction)


@njit(cache=True)
def reach_distance(tips: Floats, goal_60: Floats, goal_120: Floats, goal_300: Floats) -> float:
    """Compute the Euclidean distance of the nine tip coordinates from their goals [m]."""
    total = 0.0
    for i in range(3):
        total += (tips[i] - goal_60[i]) ** 2
        total += (tips[3 + i] - goal_120[i]) ** 2
        total += (tips[6 + i] - goal_300[i]) ** 2
    return math.sqrt(total)


@njit(cache=True)
def reach_error(tips: Floats, goal_60: Floats, goal_120: Floats, goal_300: Floats) -> float:
    """Compute the mean absolute error of the nine tip coordinates [m]."""
    total = 0.0
    for i in range(3):
        total += abs(tips[i] - goal_60[i])
        total += abs(tips[3 + i] - goal_120[i])
        total += abs(tips[6 + i] - goal_300[i])
    return total / 9.0


@njit(cache=True)
def reach_progress(
    tips: Floats, tips_before: Floats, goal_60: Floats, goal_120: Floats, goal_300: Floats
) -> float:
    """Compute how much nearer the tips came to their goals [m]."""
    return reach_distance(tips_before, goal_60, goal_120, goal_300) - reach_distance(
        tips, goal_60, goal_120, goal_300
    )


@njit(cache=True)
def scale_into(
    raw: Floats,
    low: Floats,
    high: Floats,
    gain: Floats,
    offset: Floats,
    out: NDArray[np.float32],
) -> None:
    """Saturate numbers at their bounds, then scale them: ``out = gain * clip(raw) + offset``."""
    for i in range(raw.size):
        held = min(max(raw[i], low[i]), high[i])
        out[i] = gain[i] * held + offset[i]


@njit(cache=True)
def affine_into(values: Floats, offset: Floats, gain: Floats, out: Floats) -> None:
    """Scale numbers: ``out = offset + gain * values``."""
    for i in range(values.size):
        out[i] = offset[i] + gain[i] * values[i]
