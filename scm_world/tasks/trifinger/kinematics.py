"""Where the fingertips are, and which joints put them there: in closed form.

A finger is an abduction hinge about -x, and below it a planar leg of two equal links of length L
whose two hinges are parallel. The plane of the leg stands beside the first axis by a constant
offset d. With the joints q0, q1, q2 of a finger, in the frame of its base::

    x' = -L (sin q1 + sin(q1 + q2))      x =  x'
    y' = -d                              y =  y' cos q0 + z' sin q0
    z' = -L (cos q1 + cos(q1 + q2))      z = -y' sin q0 + z' cos q0

The functions called ``…_kernel`` are compiled, for speed and for other compiled code to call: they
do not check their arguments.

Source:
    Derived from the joint origins in ``scm_world.tasks.trifinger.hardware``, which are those of
    ``trifinger_edu.urdf`` (CausalWorld 1.2); agrees with the chain to 3e-12 m.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scm_world._types import Floats
from scm_world.geometry.numbers import njit
from scm_world.tasks.trifinger import hardware

N_FINGERS = len(hardware.FINGERS)
REACHED_TOLERANCE = 1e-8
"""How near the tip must be to count as there [m]: an angle at a singularity is no more exact."""

_LEG = hardware.LEG_LENGTH
_LATERAL = hardware.LATERAL_OFFSET
_OFFSET = hardware.TABLE_OFFSET
_LOW = hardware.JOINT_LOW[:3]
_HIGH = hardware.JOINT_HIGH[:3]

_YAW = tuple(hardware.WORLD_YAW + yaw for yaw in hardware.FINGER_YAW)
_COS = tuple(math.cos(yaw) for yaw in _YAW)
_SIN = tuple(math.sin(yaw) for yaw in _YAW)
_COS_WORLD, _SIN_WORLD = math.cos(hardware.WORLD_YAW), math.sin(hardware.WORLD_YAW)
_BASE_X = tuple(_COS_WORLD * x - _SIN_WORLD * y for x, y, _ in hardware.FINGER_OFFSET)  # [m]
_BASE_Y = tuple(_SIN_WORLD * x + _COS_WORLD * y for x, y, _ in hardware.FINGER_OFFSET)  # [m]


class InverseSolution(NamedTuple):
    """Joint positions for three targets of the fingertips.

    Attributes:
        joint_positions: Shape (9,) [rad], always within the software bounds.
        reached: Whether each finger reaches its target, shape (3,).
    """

    joint_positions: Floats
    reached: NDArray[np.bool_]


Point = tuple[float, float, float]


@njit(cache=True)
def _place(q0: float, q1: float, q2: float, aside: float, middle: float, lower: float) -> Point:
    """Compute a point of a finger in the frame of its base [m]; see ``point_kernel``."""
    x = -_LEG * (middle * math.sin(q1) + lower * math.sin(q1 + q2))
    z = -_LEG * (middle * math.cos(q1) + lower * math.cos(q1 + q2))
    sine, cosine = math.sin(q0), math.cos(q0)
    return x, z * sine + aside * cosine, z * cosine - aside * sine


@njit(cache=True)
def point_kernel(
    finger: int, angles: Floats, height: float, aside: float, middle: float, lower: float
) -> Point:
    """Compute a point of a finger [m].

    Args:
        finger: Its number.
        angles: Of its three joints, shape (3,) [rad].
        height: Height of the robot [m].
        aside: How far the point lies along the axis of the second joint [m].
        middle: How far along the middle link, as a share of its length.
        lower: How far along the lower link, as a share of its length.
    """
    x, y, z = _place(angles[0], angles[1], angles[2], aside, middle, lower)
    right = _COS[finger] * x - _SIN[finger] * y + _BASE_X[finger]
    return right, _SIN[finger] * x + _COS[finger] * y + _BASE_Y[finger], z + height - _OFFSET


@njit(cache=True)
def tip_kernel(finger: int, angles: Floats, height: float) -> Point:
    """Compute the tip of one finger [m]; see ``point_kernel``."""
    return point_kernel(finger, angles, height, -_LATERAL, 1.0, 1.0)


@njit(cache=True)
def forward_kernel(joint_positions: Floats, height: float) -> Floats:
    """Compute what ``forward`` returns."""
    tips = np.empty(3 * N_FINGERS)
    for finger in range(N_FINGERS):
        i = 3 * finger
        tips[i], tips[i + 1], tips[i + 2] = tip_kernel(finger, joint_positions[i : i + 3], height)
    return tips


@njit(cache=True)
def _wrap(angle: float) -> float:
    """Bring an angle into [-pi, pi] by at most one turn."""
    if angle > math.pi:
        return angle - 2.0 * math.pi
    if angle < -math.pi:
        return angle + 2.0 * math.pi
    return angle


@njit(cache=True)
def _clip(value: float, joint: int) -> float:
    """Bring a joint position into the software bounds."""
    return min(max(value, _LOW[joint]), _HIGH[joint])


@njit(cache=True)
def _solve(x: float, y: float, z: float, near: Floats, found: Floats) -> bool:
    """Solve one finger for a target in the frame of its base [m]; see ``inverse``."""
    across, best = math.hypot(y, z), (1.0, math.inf)
    for branch in range(4):
        # The leg points down or up in its plane; the last joint is bent one way or the other.
        side, bend = -1.0 if branch < 2 else 1.0, -1.0 if branch % 2 else 1.0
        down = side * math.sqrt(max(across - _LATERAL, 0.0)) * math.sqrt(across + _LATERAL)
        q0 = _wrap(math.atan2(down, -_LATERAL) - math.atan2(z, y))
        reach = math.hypot(x, down)
        missing = math.sqrt(max(2.0 * _LEG - reach, 0.0)) * math.sqrt(2.0 * _LEG + reach)
        q2 = bend * 2.0 * math.atan2(missing, reach)
        q1 = _wrap(math.atan2(-x, -down) - q2 / 2.0)
        q0, q1, q2 = _clip(q0, 0), _clip(q1, 1), _clip(q2, 2)
        tip_x, tip_y, tip_z = _place(q0, q1, q2, -_LATERAL, 1.0, 1.0)
        gap = math.hypot(math.hypot(tip_x - x, tip_y - y), tip_z - z)
        turn = (q0 - near[0]) ** 2 + (q1 - near[1]) ** 2 + (q2 - near[2]) ** 2
        rank = (0.0, turn) if gap <= REACHED_TOLERANCE else (1.0, gap)
        if rank < best:
            best = rank
            found[0], found[1], found[2] = q0, q1, q2
    return best[0] == 0.0


@njit(cache=True)
def inverse_kernel(
    targets: Floats, height: float, near: Floats
) -> tuple[Floats, NDArray[np.bool_]]:
    """Compute the joint positions (9,) and whether fingers reach (3,) that ``inverse`` returns."""
    joint_positions, reached = np.empty(3 * N_FINGERS), np.empty(N_FINGERS, dtype=np.bool_)
    for finger in range(N_FINGERS):
        i = 3 * finger
        for joint in range(3):
            joint_positions[i + joint] = _clip(near[i + joint], joint)
        right, forth = targets[i] - _BASE_X[finger], targets[i + 1] - _BASE_Y[finger]
        x = _COS[finger] * right + _SIN[finger] * forth
        y = _COS[finger] * forth - _SIN[finger] * right
        z = targets[i + 2] - height + _OFFSET
        finite = math.isfinite(x) and math.isfinite(y) and math.isfinite(z)
        mine = slice(i, i + 3)
        reached[finger] = finite and _solve(x, y, z, near[mine], joint_positions[mine])
    return joint_positions, reached


def forward(joint_positions: ArrayLike, height: float) -> Floats:
    """Compute where the fingertips are.

    Args:
        joint_positions: Shape (9,) [rad].
        height: Height of the robot, measured from the plane below the table top [m].

    Returns:
        The origins of the three tip frames, shape (9,) [m], z from the table top.

    Example:
        >>> forward(hardware.REST, hardware.NOMINAL_HEIGHT)[:3].round(4).tolist()
        [-0.0595, 0.1586, 0.0559]
    """
    return forward_kernel(_nine(joint_positions), float(height))


def inverse(targets: ArrayLike, height: float, near: ArrayLike) -> InverseSolution:
    """Find joint positions that bring the fingertips to their targets.

    A finger has up to four solutions: the leg points down or up in its plane, and its knee bends
    one way or the other. Of those within the software bounds, the one nearest to ``near`` is
    taken (Euclidean, in joint space).

    Without a solution, every branch is still solved as well as it can be: a target beyond reach
    is aimed at with the leg stretched out, one too near to the first axis with the leg horizontal.
    Each is then clipped to the bounds, and the branch whose tip ends nearest to the target is
    taken. This is not the nearest point the finger could reach. A target that is not finite leaves
    the finger at ``near``.

    Args:
        targets: Places of the three tips, shape (9,) [m], z from the table top.
        height: Height of the robot, measured from the plane below the table top [m].
        near: The joint positions to stay close to, shape (9,) [rad].

    Returns:
        Joint positions within the bounds, and which fingers reach their targets.

    Example:
        >>> tips = forward(hardware.REST, hardware.NOMINAL_HEIGHT)
        >>> solution = inverse(tips, hardware.NOMINAL_HEIGHT, near=hardware.REST)
        >>> bool(np.allclose(solution.joint_positions, hardware.REST)), solution.reached.tolist()
        (True, [True, True, True])
        >>> inverse(np.full(9, 2.0), hardware.NOMINAL_HEIGHT, hardware.REST).reached.tolist()
        [False, False, False]
    """
    return InverseSolution(*inverse_kernel(_nine(targets), float(height), _nine(near)))


def _nine(values: ArrayLike) -> Floats:
    """Copy nine numbers, so that the kernels are compiled for one kind of array only."""
    return np.array(values, dtype=np.float64).reshape(3 * N_FINGERS)
