"""The numbers behind rewards and success, and reward terms that are there for the asking.

Numbers of boxes and points are compiled, because every control step needs them.

``task_options={"terms": ["reward.goal_kernel"], "weights": {"reward.goal_kernel": 1.0}}`` adds a
term to those of a task. Names are plain data, so the specification of the environment stays JSON.
Which ones a task has is in its ``ready_terms``.

Source:
    The kernel on corners is that of Allshire et al., *Transferring Dexterous Manipulation from GPU
    Simulation to a Remote Real-World TriFinger*, IROS 2022, here times 4, so that it ends at 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Any

import numpy as np

from scm_world._types import ArrayLike, Floats, Value
from scm_world.geometry.filling import aabb_overlap_fraction, overlap_fraction
from scm_world.geometry.hulls import Hull, hull_of, hull_overlap
from scm_world.geometry.numbers import njit, scalar
from scm_world.geometry.rotations import angle_between, rotation_kernel, rotation_matrix
from scm_world.tasks.rewards import term
from scm_world.tasks.trifinger import hardware
from scm_world.variables import Function, Measured, Parent
from scm_world.variables.mechanisms import Stacked

BOX = 10  # numbers of a box in a vector: size (3), position (3), quaternion (4)
CARRIED = 0.15  # [m] how high a block should be lifted over a wall
PLACED = 0.02  # [m] how near the first block of a tower must be to its goal
ABOVE = 0.005  # [m] how near, seen from above, two blocks of a tower must be
COARSE = 30.0  # [1/m] the kernel falls to a half at 6 cm
FINE = 150.0  # [1/m] and here at 12 mm
BEHIND = 0.05  # [m] from the center of a block to where a fingertip pushes it
NEAR = 0.01  # [m] nearer to the goal, where to push from moves towards the center of the block

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
            mean += gap / 3.0 * (gap >= size[axis])
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


@Stacked
@njit(cache=True)
def reach_error(points: Floats) -> float:
    """Compute the mean absolute error of the nine tip coordinates [m]; three tips, three goals."""
    return float(np.abs(points[:9] - points[9:]).mean())


@Stacked
@njit(cache=True)
def reach_progress(points: Floats) -> float:
    """Compute how much nearer the tips came to their goals [m].

    ``points`` has the three tips, where they were, and the three goals.
    """
    tips, before, goals = points[:9], points[9:18], points[18:]
    return distance(before, goals) - distance(tips, goals)


@Stacked
@njit(cache=True)
def minus_reach_distance(points: Floats) -> float:
    """Compute minus the distance of the tips from their goals [m]."""
    return -distance(points[:9], points[9:])


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


# --- terms for the asking -------------------------------------------------------------------------


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
TIPS_TO_BLOCK = "tips_to_block", tips_progress, (TIPS, TIPS_WAS, BLOCK, WAS)
TURNED = (
    "orientation",
    turn_progress,
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


def _near(
    name: str, kernel: Callable[..., Any], parents: tuple[str, ...], doc: str
) -> Iterator[tuple[Any, ...]]:
    """Describe a kernel that reaches far, and one that is felt within about 2 cm."""
    for kind, sharpness, felt in (("", COARSE, ""), ("_fine", FINE, "; felt within about 2 cm")):
        function = Function(kernel, constants={"sharpness": sharpness})
        yield f"{name}{kind}", function, parents, f"{doc}, in [0, 1]{felt}."


_TURN = f"{TOOL}.orientation"
_CORNERS = "How near the corners of the block are to those of the goal"

ONE_BLOCK = ROBOT + _terms(
    *_near("goal_kernel", goal_kernel, _BOXES, _CORNERS),
    ("corners_to_goal", corners_progress, (*_BOXES[:3], WAS, Parent(_TURN, 1), *_BOXES[3:])),
    ("tip_behind_block", pushing_progress, (TIPS, TIPS_WAS, BLOCK, WAS, TARGET)),
)
"""Terms of tasks with one block and one goal."""

REACHING = ROBOT + _terms(
    *_near("reach_kernel", reach_kernel, (TIPS, *PLACES), "How near the tips are to their goals"),
)
"""Terms of reaching."""
