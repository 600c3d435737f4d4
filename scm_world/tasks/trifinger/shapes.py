"""Boxes and convex hulls that stand on the floor, and how full a hull is."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from scm_world._types import Floats, Value
from scm_world.errors import UnknownOption
from scm_world.geometry import (
    aabb_overlap_fraction,
    canonical,
    from_rotation_vector,
    quaternion_product,
    rotation_matrix,
)
from scm_world.geometry.hulls import Hull, hull_of, hull_overlap
from scm_world.tasks.base import finite_numbers
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger.entities.goals import on_the_floor

Place = tuple[float, float] | tuple[float, float, float]
"""x and y of a center on the floor, or x, y and z [m]."""

Quaternion = tuple[float, float, float, float]


def hull_on_the_floor(polar: Floats, corners: Floats, orientation: Floats) -> Floats:
    """Put a hull on the floor at a radius [m] and an angle [rad]; see ``turned_on_the_floor``.

    ``corners`` are those of the hull, shape (..., n, 3) [m].
    """
    upwards = rotation_matrix(orientation)[..., 2, :]
    return on_the_floor(polar, -np.einsum("...ni,...i->...n", corners, upwards).min(axis=-1))


def about_z(yaw: Value, *, rest: Floats) -> Floats:
    """Turn a quaternion about the vertical by an angle [rad], shape (..., 4)."""
    angle = np.asarray(yaw, dtype=np.float64)[..., None] * [0.0, 0.0, 1.0]
    return canonical(quaternion_product(from_rotation_vector(angle), rest))


@lru_cache(maxsize=32)
def _hull(corners: bytes) -> Hull:
    return hull_of(np.frombuffer(corners).reshape(-1, 3))


def hull_filled(
    corners: Floats,
    position: Floats,
    orientation: Floats,
    goal_corners: Floats,
    goal_position: Floats,
    goal_orientation: Floats,
) -> float:
    """Compute the fraction of a goal that a block fills, in [0, 1].

    Both are hulls: corners, shape (n, 3) [m], center of mass [m] and quaternion.
    """
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
        boxes += [high - low, position + (low + high) / 2.0, np.array(numbers.IDENTITY)]
    return aabb_overlap_fraction(*(box[None] for box in boxes))


def start_place(option: str, place: Place, below: float) -> tuple[float, float, float]:
    """Read where a block begins: x and y of its center, and the height of its lowest point [m].

    Args:
        option: Its name, for the error.
        place: x and y, for a block on the floor, or x, y and z of the center [m].
        below: How far it reaches below its center [m].

    Raises:
        UnknownOption: These are not two or three numbers, or it would reach below the floor.
    """
    point = _checked(option, place)
    height = point[2] - below if len(point) == 3 else 0.0
    if height < -1e-6:
        raise UnknownOption(option, place, ("x, y", f"x, y and z >= {below:g} [m]"))
    return point[0], point[1], max(height, 0.0)


def floor_place(option: str, place: Place, height: float) -> tuple[float, float]:
    """Read the place of something on the floor: radius [m] and angle [rad].

    Args:
        option: Its name, for the error.
        place: x and y, or x, y and z of the center [m].
        height: The only z it can have [m].

    Raises:
        UnknownOption: These are not two or three numbers, or it would not stand on the floor.
    """
    point = _checked(option, place)
    if len(point) == 3 and abs(point[2] - height) > 1e-6:
        raise UnknownOption(option, place, ("x, y", f"x, y, {height:g} [m]: it is on the floor"))
    return math.hypot(point[0], point[1]), math.atan2(point[1], point[0])


def _checked(option: str, place: Place) -> tuple[float, ...]:
    point = finite_numbers(place)
    if point is None or point.shape not in ((2,), (3,)):
        raise UnknownOption(option, place, ("x, y", "x, y, z [m]"))
    return tuple(point.tolist())


def unit_quaternion(option: str, orientation: Quaternion) -> Quaternion:
    """Read an orientation as a unit quaternion (x, y, z, w) with w >= 0.

    Raises:
        UnknownOption: These are not four numbers, or they are all zero.
    """
    given = finite_numbers(orientation)
    if given is None or given.shape != (4,) or not given.any():
        raise UnknownOption(option, orientation, ("a quaternion x, y, z, w",))
    x, y, z, w = canonical(given).tolist()
    return x, y, z, w
