"""Three fingertips that press: which command makes them, and what they would run into."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scm_world._types import Floats, Value
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.kinematics import (
    FRAMES_PER_FINGER,
    N_FINGERS,
    forward_kernel,
    inverse_kernel,
    link_frames_kernel,
)

TIP_RADIUS = hardware.COLLISION["tip"].radius
STRENGTH = 0.97
"""Share of the largest torque that a finger may be asked for."""

LEAST_GAIN = 1e-3  # [N m/rad] of a controller that can be commanded
BALLS = 17
"""How many balls stand for a leg, 10 mm from one another."""

NUDGE = 1e-6  # [rad] by which joints are moved to find out how the fingertips move

Solids = tuple[Floats, Floats, Floats]
"""Half edges, centers and axes of boxes: shapes (n, 3), (n, 3) and (n, 3, 3)."""

_LOW, _HIGH = np.array(hardware.JOINT_LOW), np.array(hardware.JOINT_HIGH)
_LEG = hardware.LEG_LENGTH
_MIDDLE_CENTER, _LOWER_CENTER = (hardware.INERTIAL[link].center for link in (2, 3))
_RADII = (hardware.COLLISION["tip"].radius, hardware.COLLISION["middle"].radius)
_MIDDLE_Y = hardware.COLLISION["middle"].start[1]
_SHOULDER, _KNEE = (hardware.JOINT_ORIGINS[joint][1] for joint in (1, 2))
_MASSES = (
    (_SHOULDER + _MIDDLE_CENTER[1], -_MIDDLE_CENTER[2], 0.0),
    (_SHOULDER + _KNEE + _LOWER_CENTER[1], _LEG, -_LOWER_CENTER[2]),
    (-hardware.LATERAL_OFFSET, _LEG, _LEG),
)
"""Where middle link, lower link and tip are: beside the leg, along it, along its lower half [m]."""


@njit(cache=True)
def _legs_kernel(joints: Floats, height: float, balls: Floats) -> None:
    """Write the lower and the middle legs as rows of balls into ``balls`` (3, 2, BALLS, 3) [m]."""
    frames = N_FINGERS * FRAMES_PER_FINGER
    origins, turns = np.empty((frames, 3)), np.empty((frames, 4))
    link_frames_kernel(joints, height, origins, turns)
    for finger in range(N_FINGERS):
        for part in range(2):
            frame = FRAMES_PER_FINGER * finger + 4 - 2 * part
            x, y, z, w = turns[frame]
            aside = (2.0 * (x * y - z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + x * w))
            up = (2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y))
            for ball in range(BALLS):
                along = (1.0 - 2.0 * part) * _LEG * ball / (BALLS - 1)
                for k in range(3):
                    start = origins[frame, k] + part * _MIDDLE_Y * aside[k]
                    balls[finger, part, ball, k] = start + along * up[k]


@njit(cache=True)
def _between_kernel(balls: Floats, one: tuple[int, int], other: tuple[int, int]) -> float:
    """Compute the least distance of the centers of the balls of two legs [m]."""
    squared = math.inf
    for i in range(BALLS):
        for j in range(BALLS):
            x = balls[one[0], one[1], i, 0] - balls[other[0], other[1], j, 0]
            y = balls[one[0], one[1], i, 1] - balls[other[0], other[1], j, 1]
            z = balls[one[0], one[1], i, 2] - balls[other[0], other[1], j, 2]
            squared = min(squared, x * x + y * y + z * z)
    return math.sqrt(squared)


@njit(cache=True)
def deepest_kernel(
    joints: Floats, height: float, halves: Floats, centers: Floats, turns: Floats
) -> float:
    """Compute how deep any leg lies in a box or in a leg of another finger.

    A leg counts as a row of balls; what lies between two of them is up to 1.4 mm deeper.

    Args:
        joints: Shape (9,) [rad].
        height: Of the robot [m].
        halves: Half edges of the boxes, shape (n, 3) [m].
        centers: Shape (n, 3) [m].
        turns: Axes of the boxes as columns, shape (n, 3, 3).

    Returns:
        The depth [m]; negative where all are apart.
    """
    balls = np.empty((N_FINGERS, 2, BALLS, 3))
    _legs_kernel(joints, height, balls)
    deepest = -math.inf
    for finger in range(N_FINGERS):
        for part in range(2):
            for ball in balls[finger, part]:
                for box in range(len(halves)):
                    outside, inside = 0.0, -math.inf
                    for axis in range(3):
                        along = 0.0
                        for k in range(3):
                            along += (ball[k] - centers[box, k]) * turns[box, k, axis]
                        beyond = abs(along) - halves[box, axis]
                        outside, inside = outside + max(beyond, 0.0) ** 2, max(inside, beyond)
                    away = math.sqrt(outside) + min(inside, 0.0)
                    deepest = max(deepest, _RADII[part] - away)
            for other in range(finger):
                for piece in range(2):
                    away = _between_kernel(balls, (finger, part), (other, piece))
                    deepest = max(deepest, _RADII[part] + _RADII[piece] - away)
    return deepest


@njit(cache=True)
def carrying(joints: Floats, weights: Floats) -> Floats:
    """Compute the torques that carry the fingers themselves, shape (9,) [N m].

    Args:
        joints: Shape (9,) [rad].
        weights: Of the middle link, the lower link and the tip of each finger, shape (3, 3) [N].
    """
    out = np.empty(9)
    for finger in range(N_FINGERS):
        i = 3 * finger
        sine, cosine = math.sin(joints[i]), math.cos(joints[i])
        out[i] = out[i + 1] = out[i + 2] = 0.0
        for part in range(3):
            weight, (aside, above, below) = weights[finger, part], _MASSES[part]
            first, second = joints[i + 1], joints[i + 1] + joints[i + 2]
            down = -above * math.cos(first) - below * math.cos(second)
            out[i] += weight * (-aside * cosine - down * sine)
            out[i + 1] += weight * (above * math.sin(first) + below * math.sin(second)) * cosine
            out[i + 2] += weight * below * math.sin(second) * cosine
    return out


@njit(cache=True)
def pressing(joints: Floats, height: float, forces: Floats) -> Floats:
    """Compute the torques with which fingertips press, without what carries the fingers.

    Args:
        joints: Shape (9,) [rad].
        height: Of the robot [m].
        forces: Of the fingertips on what they touch, shape (3, 3) [N].

    Returns:
        Shape (9,) [N m].
    """
    out, here, there, moved = np.empty(9), np.empty(9), np.empty(9), joints.copy()
    forward_kernel(joints, height, here)
    for joint in range(3):
        for finger in range(N_FINGERS):
            moved[3 * finger + joint] += NUDGE
        forward_kernel(moved, height, there)
        for finger in range(N_FINGERS):
            moved[3 * finger + joint] = joints[3 * finger + joint]
        for finger in range(N_FINGERS):
            i, work = 3 * finger, 0.0
            for k in range(3):
                work += (there[i + k] - here[i + k]) * forces[finger, k]
            out[i + joint] = work / NUDGE
    return out


@njit(cache=True)
def _poses(
    tips: Floats, near: Floats, height: float, halves: Floats, centers: Floats, turns: Floats
) -> tuple[Floats, NDArray[np.bool_], Floats]:
    """Compute what ``Hand.poses`` returns."""
    joints, fingers = np.empty(tips.shape), np.empty(N_FINGERS, dtype=np.bool_)
    reached, depths = np.empty(len(tips), dtype=np.bool_), np.empty(len(tips))
    for row in range(len(tips)):
        inverse_kernel(tips[row], height, near[row], joints[row], fingers)
        reached[row] = fingers.all()
        depths[row] = deepest_kernel(joints[row], height, halves, centers, turns)
    return joints, reached, depths


@njit(cache=True)
def _strengths(
    joints: Floats, height: float, weights: Floats, limit: float, forces: Floats
) -> Floats:
    """Compute what ``Hand.strengths`` returns."""
    out = np.empty(len(joints))
    for row in range(len(joints)):
        own, unit = carrying(joints[row], weights), pressing(joints[row], height, forces[row])
        least = math.inf
        for joint in range(len(own)):
            if abs(unit[joint]) > 1e-9:
                room = limit - own[joint] * np.sign(unit[joint])
                least = min(least, room / abs(unit[joint]))
        out[row] = max(least, 0.0)
    return out


@final
class Hand:
    """The robot as it is at the moment: its height, its weight and its controller.

    Args:
        values: Of the variables of a world.

    Attributes:
        aside: Where unused fingertips are, shape (3, 3) [m].
    """

    def __init__(self, values: Mapping[str, Value]) -> None:
        self.height = float(values["robot_height"])
        self._gains = np.tile(np.maximum(values["position_gains"], LEAST_GAIN), N_FINGERS)
        self._limit = STRENGTH * float(values["torque_limit"])
        self.weights = -float(values["gravity"][2]) * np.array(
            [
                [float(values[f"{hardware.link_name(finger, link)}.mass"]) for link in (2, 3)]
                + [hardware.TIP_MASS]
                for finger in hardware.FINGERS
            ]
        )
        self.aside = self.tips(np.array(hardware.ASIDE)).reshape(3, 3)

    def solve(self, tips: Floats, near: Floats) -> Floats:
        """Compute the joints for fingertips, shape (9,) [m], as near as they are reached."""
        joints, reached = np.empty(9), np.empty(3, dtype=np.bool_)
        inverse_kernel(tips, self.height, near, joints, reached)
        return joints

    def tips(self, joints: Floats) -> Floats:
        """Place the fingertips, shape (9,) [m]."""
        tips = np.empty(9)
        forward_kernel(joints, self.height, tips)
        return tips

    def more(self, joints: Floats, forces: Floats) -> Floats:
        """Compute what joints need in addition to carry the fingers and press, shape (9,) [rad].

        The controller is a damped spring without gravity compensation.

        Args:
            joints: Shape (9,) [rad].
            forces: On what fingertips touch, shape (3, 3) [N].
        """
        torques = carrying(joints, self.weights) + pressing(joints, self.height, forces)
        added: Floats = np.minimum(np.maximum(torques, -self._limit), self._limit) / self._gains
        return added

    def bounded(self, joints: Floats) -> Floats:
        """Bring joint positions within the bounds of a command, shape (9,) [rad]."""
        clipped: Floats = np.minimum(np.maximum(joints, _LOW), _HIGH)
        return clipped

    def poses(
        self, tips: Floats, near: Floats, boxes: Solids
    ) -> tuple[Floats, NDArray[np.bool_], Floats]:
        """Find joints for fingertips, and how deep fingers then lie in one another and in boxes.

        Args:
            tips: Shape (n, 9) [m].
            near: Joint positions to stay close to, shape (n, 9) [rad].
            boxes: What they may run into.

        Returns:
            Joints, shape (n, 9) [rad]; whether all fingertips are reached, shape (n,); and the
            depths, shape (n,) [m].
        """
        found: tuple[Floats, NDArray[np.bool_], Floats] = _poses(tips, near, self.height, *boxes)
        return found

    def strengths(self, joints: Floats, forces: Floats) -> Floats:
        """Compute how many times some forces the fingers can exert, shape (n,).

        Args:
            joints: Shape (n, 9) [rad].
            forces: Shape (n, 3, 3).
        """
        found: Floats = _strengths(joints, self.height, self.weights, self._limit, forces)
        return found
