"""The numbers behind rewards and success, compiled because every control step needs them."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from scm_world._types import Floats
from scm_world.geometry.filling import overlap_fraction
from scm_world.geometry.rotations import angle_between

CARRIED = 0.15  # [m] how high a block should be lifted over a wall
PLACED = 0.02  # [m] how near the first block of a tower must be to its goal
ABOVE = 0.005  # [m] how near, seen from above, two blocks of a tower must be

AXIS = np.zeros(2)  # [m] of the arena, seen from above


@njit(cache=True)
def distance(a: Floats, b: Floats) -> float:
    """Compute the Euclidean distance of two points of any dimension."""
    return math.sqrt(((a - b) ** 2).sum())


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
    """Compute how much nearer the block came to the goal [m]."""
    return distance(block_before, goal) - distance(block, goal)


@njit(cache=True)
def turn_progress(orientation: Floats, orientation_before: Floats, goal: Floats) -> float:
    """Compute by how much the angle between block and goal shrank [rad]."""
    return angle_between(orientation_before, goal) - angle_between(orientation, goal)


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
    fraction: float = overlap_fraction(
        size.reshape(1, 3),
        position.reshape(1, 3),
        orientation.reshape(1, 4),
        goal_size.reshape(1, 3),
        goal_position.reshape(1, 3),
        goal_orientation.reshape(1, 4),
    )
    return fraction


@njit(cache=True)
def horizontal_distance(a: Floats, b: Floats) -> float:
    """Compute the distance of two points seen from above [m]."""
    return math.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2)


@njit(cache=True)
def horizontal_progress(block: Floats, block_before: Floats, goal: Floats) -> float:
    """Compute how much nearer the block came to the goal, seen from above [m]."""
    return horizontal_distance(block_before, goal) - horizontal_distance(block, goal)


@njit(cache=True)
def height_error(position: Floats, height: float) -> float:
    """Compute how far a position is from a height [m]."""
    error: float = abs(position[2] - height)
    return error


@njit(cache=True)
def minus_height_error(block: Floats, goal: Floats) -> float:
    """Compute minus the difference of the heights of block and goal [m]."""
    return -height_error(block, goal[2])


@njit(cache=True)
def height_progress(block: Floats, block_before: Floats, goal: Floats) -> float:
    """Compute how much nearer the block came to the height of the goal [m]."""
    return height_error(block_before, goal[2]) - height_error(block, goal[2])


@njit(cache=True)
def minus_eccentricity(block: Floats) -> float:
    """Compute minus the distance of the block from the axis of the arena [m]."""
    return -horizontal_distance(block, AXIS)


@njit(cache=True)
def centering_progress(block: Floats, block_before: Floats) -> float:
    """Compute how much nearer the block came to the axis of the arena [m]."""
    return horizontal_progress(block, block_before, AXIS)


@njit(cache=True)
def minus_tips_distance(tips: Floats, block: Floats) -> float:
    """Compute minus the distance of the fingertips from the block [m]."""
    return -tips_distance(tips, block)


@njit(cache=True)
def minus_grasp_distance(tips: Floats, block: Floats, size: Floats) -> float:
    """Compute minus how far the two nearest fingertips are from the block [m].

    The distance of a tip is the mean absolute difference of its coordinates; one that is smaller
    than the edge of the block along it counts as zero.
    """
    total, farthest = 0.0, 0.0
    for finger in range(3):
        mean = 0.0
        for axis in range(3):
            gap = abs(tips[3 * finger + axis] - block[axis])
            if gap >= size[axis]:
                mean += gap / 3.0
        total += mean
        farthest = max(farthest, mean)
    return farthest - total


@njit(cache=True)
def crossing_progress(
    block: Floats, block_before: Floats, goal: Floats, goal_size: Floats
) -> float:
    """Compute how much nearer the block came to 0.15 m, or to the floor on the goal's side [m].

    Its height should be ``CARRIED`` while block and goal are on different sides of the wall, and
    half the height of the goal on the same side.
    """
    same_side = np.sign(block[1]) == np.sign(goal[1])
    height = 0.5 * goal_size[2] if same_side else CARRIED
    return height_error(block_before, height) - height_error(block, height)


@njit(cache=True)
def stacking_tips_progress(
    tips: Floats,
    tips_before: Floats,
    first: Floats,
    first_before: Floats,
    second: Floats,
    second_before: Floats,
    goal: Floats,
) -> float:
    """Compute how much nearer the fingertips came to the block whose turn it is [m].

    It is the first block's turn until it is at its goal.
    """
    if distance(first, goal) >= PLACED:
        return tips_progress(tips, tips_before, first, first_before)
    return tips_progress(tips, tips_before, second, second_before)


@njit(cache=True)
def placing_progress(first: Floats, first_before: Floats, goal: Floats) -> float:
    """Compute how much nearer the first block came to its goal [m].

    It is 0 once the block is there.
    """
    if distance(first, goal) < PLACED:
        return 0.0
    return block_progress(first, first_before, goal)


@njit(cache=True)
def lifting_progress(
    first: Floats, goal: Floats, second: Floats, second_before: Floats, second_goal: Floats
) -> float:
    """Compute how much nearer the second block came to the height of its goal [m].

    It is 0 until the first block is placed, and while the second one is right above it.
    """
    if distance(first, goal) >= PLACED or horizontal_distance(first, second) < ABOVE:
        return 0.0
    return height_progress(second, second_before, second_goal)


@njit(cache=True)
def stacking_progress(
    first: Floats,
    first_before: Floats,
    goal: Floats,
    second: Floats,
    second_before: Floats,
    second_goal: Floats,
) -> float:
    """Compute how much nearer the second block came to the first one, seen from above [m].

    It is 0 until the first block is placed, and until the second one is higher than its goal.
    """
    if distance(first, goal) >= PLACED or second[2] <= second_goal[2]:
        return 0.0
    before = horizontal_distance(first_before, second_before)
    return before - horizontal_distance(first, second)


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
