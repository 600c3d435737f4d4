"""Three fingers: the torques with which they press, and their obstacles."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.geometry.numbers import njit
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.kinematics import N_FINGERS, inverse_kernel, point_kernel

TIP_RADIUS = hardware.COLLISION["tip"].radius
BALLS = 17  # that stand for a leg, 10 mm from one another
NUDGE = 1e-6  # [rad] by which joints are moved to find out how points of the fingers move

_LEG, _TIP = hardware.LEG_LENGTH, -hardware.LATERAL_OFFSET
_SHOULDER, _KNEE = (hardware.JOINT_ORIGINS[joint][1] for joint in (1, 2))
_RADII = (TIP_RADIUS, hardware.COLLISION["middle"].radius)
_BESIDE = (_TIP, _SHOULDER + hardware.COLLISION["middle"].start[1])
"""Of lower and middle legs: the radius, and how far they lie along the second axis [m]."""
_CENTERS = [hardware.INERTIAL[link].center for link in (2, 3)]
_MASSES = (
    (_SHOULDER + _CENTERS[0][1], -_CENTERS[0][2] / _LEG, 0.0),
    (_SHOULDER + _KNEE + _CENTERS[1][1], 1.0, -_CENTERS[1][2] / _LEG),
    (_TIP, 1.0, 1.0),
)
"""Where the masses of middle link, lower link and tip are, as ``point_kernel`` takes it."""


@njit(cache=True)
def deepest_kernel(joints: Floats, height: float, boxes: Floats) -> float:
    """Compute how deep any leg lies in a box or in a leg of another finger [m]; negative: apart.

    A leg, lower or middle, counts as a row of balls; what lies between two of them is up to 1.4 mm
    deeper.

    Args:
        joints: Shape (9,) [rad].
        height: Height of the robot [m].
        boxes: Half edges [m], center [m] and the three axes of each as columns, shape (n, 3, 5).
    """
    legs, deepest = np.empty((2 * N_FINGERS, BALLS, 3)), -math.inf
    for leg in range(2 * N_FINGERS):
        finger, part = leg // 2, leg % 2
        angles, radius = joints[3 * finger : 3 * finger + 3], _RADII[part]
        first = point_kernel(finger, angles, height, _BESIDE[part], 1.0 - part, 1.0 - part)
        knee = point_kernel(finger, angles, height, _BESIDE[part], 1.0, 0.0)
        for i, ball in enumerate(legs[leg]):
            for k in range(3):
                ball[k] = first[k] + (knee[k] - first[k]) * i / (BALLS - 1)
            for box in boxes:
                outside, inside = 0.0, -math.inf
                for axis in range(3):
                    along = 0.0
                    for k in range(3):
                        along += (ball[k] - box[k, 1]) * box[k, 2 + axis]
                    beyond = abs(along) - box[axis, 0]
                    outside, inside = outside + max(beyond, 0.0) ** 2, max(inside, beyond)
                deepest = max(deepest, radius - math.sqrt(outside) - min(inside, 0.0))
        for other in range(2 * finger):
            squared = math.inf
            for x, y, z in legs[leg]:
                for ball in legs[other]:
                    gap = (x - ball[0]) ** 2 + (y - ball[1]) ** 2 + (z - ball[2]) ** 2
                    squared = min(squared, gap)
            deepest = max(deepest, radius + _RADII[other % 2] - math.sqrt(squared))
    return deepest


@njit(cache=True)
def torques(joints: Floats, height: float, forces: Floats) -> Floats:
    """Compute the torques with which fingers exert forces at joints (n, 9) [rad], alike [N m].

    The forces are those of middle link, lower link and tip of each finger, shape (n, 3, 3, 3) [N].
    """
    out = np.empty(joints.shape)
    for row in range(len(joints)):
        for column in range(joints.shape[1]):
            finger, joint = column // 3, column % 3
            angles, work = joints[row, 3 * finger : 3 * finger + 3], 0.0
            moved = angles.copy()
            moved[joint] += NUDGE
            for part in range(3):
                aside, middle, lower = _MASSES[part]
                here = point_kernel(finger, angles, height, aside, middle, lower)
                there = point_kernel(finger, moved, height, aside, middle, lower)
                for k in range(3):
                    work += (there[k] - here[k]) * forces[row, finger, part, k]
            out[row, column] = work / NUDGE
    return out


@njit(cache=True)
def poses(
    tips: Floats, near: Floats, height: float, boxes: Floats
) -> tuple[Floats, NDArray[np.bool_], Floats]:
    """Find joints for fingertips [m], near others, all of shape (n, 9) [rad].

    Also return whether all fingertips are reached, and how deep legs lie in boxes or in one another
    [m], shape (n,); see ``deepest_kernel``.
    """
    joints, reached = np.empty(tips.shape), np.empty(len(tips), dtype=np.bool_)
    depths = np.empty(len(tips))
    for row in range(len(tips)):
        found, fingers = inverse_kernel(tips[row], height, near[row])
        joints[row], reached[row] = found, fingers.all()
        depths[row] = deepest_kernel(found, height, boxes)
    return joints, reached, depths
