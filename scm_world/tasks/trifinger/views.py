"""Blocks as a hand and as a planner see them.

The view of a hand is in a frame that is the same however the block's own axes are named. A box
looks the same after half a turn, and after a quarter with two edges exchanged. The observation of
its pose is not: a learner has to find out that four quaternions are one place. With the task option
``views=True`` each block that has a goal has a readout ``BLOCK.view`` without that ambiguity. Its
axes are those of the block's vertical sides, the first one within 45 degrees of x.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping

import numpy as np

from scm_world._types import Floats, Values
from scm_world.geometry.numbers import njit
from scm_world.geometry.rotations import rotation_kernel, rotation_matrix
from scm_world.tasks.trifinger.kernels import POSE, TIPS

QUARTER = 0.5 * math.pi
SIZE = 20
"""Of a view."""

NEAR = 0.1
"""What a meter between fingertips and block counts beside one between block and goal."""

CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
"""Of a cube with edges of length one, shape (8, 3)."""


@njit(cache=True)
def upright(orientation: Floats) -> tuple[int, float, float, float]:
    """Return which own axis is the vertical one, the yaw [rad] of the next one, and the lean."""
    turn = np.empty((3, 3))
    rotation_kernel(orientation, turn)
    up = 0
    for axis in range(3):
        if abs(turn[2, axis]) > abs(turn[2, up]):
            up = axis
    x, sign = (up + 1) % 3, (1.0 if turn[2, up] > 0.0 else -1.0)
    return up, math.atan2(turn[1, x], turn[0, x]), sign * turn[0, up], sign * turn[1, up]


@njit(cache=True)
def view(
    tips: Floats,
    size: Floats,
    position: Floats,
    orientation: Floats,
    goal_position: Floats,
    goal_orientation: Floats,
) -> Floats:
    """Compute what a hand sees of a block that has a goal.

    Args:
        tips: Shape (9,) [m].
        size: Edges of the block, shape (3,) [m].
        position: Of its center, shape (3,) [m].
        orientation: Quaternion (x, y, z, w), shape (4,).
        goal_position: Position of the goal; the same holds for the next arguments.
        goal_orientation: Shape (4,).

    Returns:
        Shape (20,): the three fingertips (9) [m] and the goal (3) [m] from the block's center along
        its axes; its edges along these and upwards (3) [m]; their yaw, in [-pi/4, pi/4] (1) [rad];
        how far the goal is turned, up to half turns and up to quarters (2) [rad]; and x and y of
        the unit vector that points upwards in the block, along its axes (2).
    """
    up, yaw, lean_x, lean_y = upright(orientation)
    _, goal_yaw, _, _ = upright(goal_orientation)
    quarters = round(yaw / QUARTER)
    own = yaw - quarters * QUARTER
    cos, sin = math.cos(own), math.sin(own)
    out, points = np.empty(SIZE), np.empty((4, 3))
    points[:3], points[3] = tips.reshape(3, 3), goal_position
    points -= position
    x, y = points[:, 0], points[:, 1]
    out[0:12:3], out[1:12:3], out[2:12:3] = cos * x + sin * y, cos * y - sin * x, points[:, 2]
    first, second = (up + 1) % 3, (up + 2) % 3
    if int(quarters) % 2 != 0:
        first, second = second, first
    out[12], out[13], out[14], out[15] = size[first], size[second], size[up], own
    turn = goal_yaw - yaw
    out[16] = turn - 2.0 * QUARTER * round(turn / (2.0 * QUARTER))
    out[17] = turn - QUARTER * round(turn / QUARTER)
    out[18], out[19] = cos * lean_x + sin * lean_y, cos * lean_y - sin * lean_x
    return out


def view_of(
    targets: Mapping[str, str],
) -> tuple[tuple[str, ...], int, Callable[[Values], Floats]]:
    """Describe the view of the boxes that have goals, in their own frames."""
    parts = [
        (TIPS, *(f"{tool}.{part}" for part in POSE), *(f"{goal}.{p}" for p in POSE[1:]))
        for goal, tool in targets.items()
    ]

    def seen(values: Values) -> Floats:
        return np.concatenate([view(*(values[name] for name in names)) for names in parts])

    return tuple(dict.fromkeys(itertools.chain(*parts))), SIZE * len(parts), seen


def boxes_apart(tips: Floats, *values: Floats) -> Floats:
    """Compute minus the distances of boxes, given as size, position and quaternion each."""
    half = len(values) // 2
    total = np.zeros(tips.shape[:-1])
    fingers = tips.reshape(*tips.shape[:-1], 3, 3)
    for first in range(0, half, 3):
        box, goal = (values[at : at + 3] for at in (first, half + first))
        gaps = np.linalg.norm(corners(*box) - corners(*goal), axis=-1)
        reach = np.linalg.norm(fingers - box[1][..., None, :], axis=-1)
        total += gaps.mean(axis=-1) + NEAR * reach.mean(axis=-1)
    return -total / (half // 3)


def corners(size: Floats, position: Floats, orientation: Floats) -> Floats:
    """Compute the corners of boxes, shape (..., 8, 3) [m]."""
    body = CORNERS * size[..., None, :]
    found: Floats = position[..., None, :] + body @ np.swapaxes(
        rotation_matrix(orientation), -1, -2
    )
    return found
