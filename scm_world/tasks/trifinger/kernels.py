"""The numbers behind rewards and success.

Those of boxes and points are compiled, because every control step needs them.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numba import njit

from scm_world._types import ArrayLike, Floats
from scm_world.geometry import aabb_overlap_fraction, rotation_matrix
from scm_world.geometry.filling import overlap_fraction
from scm_world.geometry.hulls import Hull, hull_of, hull_overlap
from scm_world.geometry.rotations import angle_between
from scm_world.variables.mechanisms import Stacked

BOX = 10  # numbers of a box in a vector: size (3), position (3), quaternion (4)
CARRIED = 0.15  # [m] how high a block should be lifted over a wall
PLACED = 0.02  # [m] how near the first block of a tower must be to its goal
ABOVE = 0.005  # [m] how near, seen from above, two blocks of a tower must be

AXIS = np.zeros(2)  # [m] of the arena, seen from above


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
    """Compute how much nearer the block came to the goal [m]."""
    return distance(block_before, goal) - distance(block, goal)


@njit(cache=True)
def turn_progress(orientation: Floats, orientation_before: Floats, goal: Floats) -> float:
    """Compute by how much the angle between block and goal shrank [rad]."""
    return angle_between(orientation_before, goal) - angle_between(orientation, goal)


@njit(cache=True)
def horizontal_progress(block: Floats, block_before: Floats, goal: Floats) -> float:
    """Compute how much nearer the block came to the goal, seen from above [m]."""
    return block_progress(block[:2], block_before[:2], goal[:2])


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
    return -distance(block[:2], AXIS)


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
    if distance(first, goal) >= PLACED or distance(first[:2], second[:2]) < ABOVE:
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
    before = distance(first_before[:2], second_before[:2])
    return before - distance(first[:2], second[:2])


@njit(cache=True)
def reach_distance(tips: Floats, goals: Floats) -> float:
    """Compute the Euclidean distance of the nine tip coordinates from their goals [m]."""
    total = 0.0
    for axis in range(3):
        for i in range(axis, 9, 3):
            total += (tips[i] - goals[i]) ** 2
    return math.sqrt(total)


@Stacked
@njit(cache=True)
def reach_error(points: Floats) -> float:
    """Compute the mean absolute error of the nine tip coordinates [m]; three tips, three goals."""
    total = 0.0
    for axis in range(3):
        for i in range(axis, 9, 3):
            total += abs(points[i] - points[9 + i])
    return total / 9.0


@Stacked
@njit(cache=True)
def reach_progress(points: Floats) -> float:
    """Compute how much nearer the tips came to their goals [m].

    ``points`` has the three tips, where they were, and the three goals.
    """
    tips, before, goals = points[:9], points[9:18], points[18:]
    return reach_distance(before, goals) - reach_distance(tips, goals)


@Stacked
@njit(cache=True)
def minus_reach_distance(points: Floats) -> float:
    """Compute minus the distance of the tips from their goals [m]."""
    return -reach_distance(points[:9], points[9:])


# --- how full goals are ---------------------------------------------------------------------------


@Stacked
@njit(cache=True)
def filled(numbers: Floats, tools: float) -> float:
    """Compute the fraction of the volume of all goals that the blocks fill, in [0, 1].

    Args:
        numbers: Size, position and quaternion of each block, then of each goal, shape (10 n,).
        tools: How many blocks there are.
    """
    rows, of = numbers.reshape(-1, BOX), int(tools)
    size, position, turn = rows[:, :3].copy(), rows[:, 3:6].copy(), rows[:, 6:].copy()
    return overlap_fraction(
        size[:of], position[:of], turn[:of], size[of:], position[of:], turn[of:]
    )


@Stacked
def aligned(numbers: Floats, tools: float) -> float:
    """Compute the predecessor's overlap: of the axis-aligned hulls, not capped; see ``filled``."""
    parts = np.split(numbers.reshape(-1, BOX), [3, 6], axis=1)
    of = int(tools)
    return aabb_overlap_fraction(*(part[:of] for part in parts), *(part[of:] for part in parts))


@lru_cache(maxsize=32)
def _hull(corners: bytes) -> Hull:
    return hull_of(np.frombuffer(corners).reshape(-1, 3))


def hull_filled(*poses: Floats) -> float:
    """Compute the fraction of a goal that a block fills, in [0, 1].

    Both are hulls: corners, shape (n, 3) [m], center of mass [m] and quaternion; the block's first.
    """
    corners, position, orientation, goal_corners, goal_position, goal_orientation = poses
    block, goal = _hull(corners.tobytes()), _hull(goal_corners.tobytes())
    shared = hull_overlap(block, position, orientation, goal, goal_position, goal_orientation)
    return min(1.0, shared / goal.volume)


def hull_aligned(*poses: Floats) -> float:
    """Compute the predecessor's overlap of two hulls: that of the axis-aligned boxes around them.

    The poses are those of ``hull_filled``.
    """
    boxes: list[Floats] = []
    for corners, position, orientation in (poses[:3], poses[3:]):
        turned = corners @ rotation_matrix(orientation).T
        low, high = turned.min(axis=0), turned.max(axis=0)
        boxes += [high - low, position + (low + high) / 2.0, np.array([0.0, 0.0, 0.0, 1.0])]
    return aabb_overlap_fraction(*(box[None] for box in boxes))


def fraction_of(
    shape: Hull | None, published: bool, achieved: ArrayLike, desired: ArrayLike
) -> Floats:
    """Compute how much of the desired boxes, or of the desired hull, is filled, shape (...)."""
    vertices = None if shape is None else np.array(shape.vertices)

    def one(mine: Floats, its: Floats) -> float:
        if vertices is None:
            boxes = aligned if published else filled
            return float(boxes(mine, its, tools=len(mine) / BOX))
        overlap = hull_aligned if published else hull_filled
        return overlap(vertices, mine[3:6], mine[6:], vertices, its[3:6], its[6:])

    vectorized = np.vectorize(one, signature="(n),(n)->()", otypes=[float])
    return np.asarray(vectorized(np.asarray(achieved, float), np.asarray(desired, float)))
