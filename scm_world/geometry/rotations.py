"""Rotations as quaternions (x, y, z, w), in numpy on any leading axes and as scalar kernels.

Arrays of quaternions have shape (..., 4). A quaternion need not have unit length: only its
direction counts, and what needs one refuses zero (ValueError). The product is Hamilton's, so
``quaternion_product(p, q)`` rotates by q first and by p afterwards, as matrices do.

Source:
    Shuster, "A survey of attitude representations", *J. Astronautical Sciences* 41, 1993.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from scm_world._types import ArrayLike, Floats
from scm_world.geometry.numbers import njit

UNIT = 8.0 * np.finfo(np.float64).eps
"""How far a squared norm may be from one and still be left alone."""


def _components(values: ArrayLike) -> tuple[Floats, Floats, Floats, Floats]:
    """Split quaternions; a last axis that is not four long is a ValueError."""
    given = np.asarray(values, dtype=np.float64)
    x, y, z, w = (given[..., i] for i in range(given.shape[-1]))
    return x, y, z, w


def _squared_norm(quaternion: Floats) -> Floats:
    squared: Floats = (quaternion * quaternion).sum(axis=-1, keepdims=True)
    if (squared == 0.0).any():
        raise ValueError("a quaternion of length zero names no rotation")
    return squared


def canonical(quaternion: ArrayLike) -> Floats:
    """Return the one unit quaternion with w >= 0 that names the same rotation.

    Half turns have w = 0; of their two names the one is taken whose first component that is not
    zero is positive. Applying the function twice changes no bit.
    """
    given = np.asarray(quaternion, dtype=np.float64)
    x, y, z, w = _components(given)
    lead = np.where(w != 0.0, w, np.where(x != 0.0, x, np.where(y != 0.0, y, z)))
    squared = _squared_norm(given)
    norm = np.where(np.abs(squared - 1.0) <= UNIT, 1.0, np.sqrt(squared))
    return given / np.copysign(norm, lead[..., None]) + 0.0  # no negative zeros


def quaternion_product(p: ArrayLike, q: ArrayLike) -> Floats:
    """Compose two rotations, first q, then p: a quaternion of any sign and length."""
    a, b, c, d = _components(p)
    x, y, z, w = _components(q)
    return np.stack(
        (
            d * x + a * w + b * z - c * y,
            d * y + b * w + c * x - a * z,
            d * z + c * w + a * y - b * x,
            d * w - a * x - b * y - c * z,
        ),
        axis=-1,
    )


def rotation_matrix(quaternion: ArrayLike) -> Floats:
    """Compute the matrix (..., 3, 3) that turns coordinates of the body into those of the world."""
    given = np.array(quaternion, dtype=np.float64, order="C")
    _components(given)
    _squared_norm(given)
    matrices = np.empty((*given.shape[:-1], 3, 3))
    _rotations(given.reshape(-1, 4), matrices.reshape(-1, 3, 3))
    return matrices


def from_rotation_vector(vector: ArrayLike) -> Floats:
    """Return the unit quaternion with w >= 0 of axis times angle, shape (..., 3) [rad]."""
    given = np.asarray(vector, dtype=np.float64)
    angle = np.sqrt((given * given).sum(axis=-1, keepdims=True))
    imaginary = 0.5 * np.sinc(angle / (2.0 * np.pi)) * given
    return canonical(np.concatenate((imaginary, np.cos(0.5 * angle)), axis=-1))


def to_rotation_vector(quaternion: ArrayLike) -> Floats:
    """Return axis times angle, shape (..., 3) [rad], with an angle in [0, pi].

    It is accurate to rounding near both ends.
    """
    unit = canonical(quaternion)
    imaginary, real = unit[..., :3], unit[..., 3:]
    length = np.sqrt((imaginary * imaginary).sum(axis=-1, keepdims=True))
    stretch = np.full_like(length, 2.0)  # the limit of angle / sin(angle / 2) at zero
    np.divide(2.0 * np.arctan2(length, real), length, out=stretch, where=length > 0.0)
    vector: Floats = stretch * imaginary
    return vector


def aligned(values: Floats, others: Floats, rotations: Iterable[Any]) -> Floats:
    """Return values whose unit quaternions have the signs that are nearest to others.

    Unit quaternions q and -q are the same rotation. Arrays have shape (..., columns).
    """
    found = values.copy()
    for places in rotations:
        turned = (values[..., places] * others[..., places]).sum(axis=-1, keepdims=True) < 0.0
        found[..., places] *= np.where(turned, -1.0, 1.0)
    return found


@njit(cache=True)
def angle_between(p: Floats, q: Floats) -> float:
    """Measure the angle between two orientations of any length and sign, [rad] in [0, pi]."""
    x = p[3] * q[0] - p[0] * q[3] - p[1] * q[2] + p[2] * q[1]
    y = p[3] * q[1] - p[1] * q[3] - p[2] * q[0] + p[0] * q[2]
    z = p[3] * q[2] - p[2] * q[3] - p[0] * q[1] + p[1] * q[0]
    w = p[3] * q[3] + p[0] * q[0] + p[1] * q[1] + p[2] * q[2]
    return 2.0 * math.atan2(math.sqrt(x * x + y * y + z * z), abs(w))


@njit(cache=True)
def rotation_kernel(quaternion: Floats, matrix: Floats) -> None:
    """Write the rotation matrix of a quaternion; zero counts as no rotation and makes no NaN."""
    x, y, z, w = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    squared = x * x + y * y + z * z + w * w
    scale = 2.0 / squared if squared > 0.0 else 0.0
    matrix[0, 0] = 1.0 - scale * (y * y + z * z)
    matrix[0, 1] = scale * (x * y - z * w)
    matrix[0, 2] = scale * (x * z + y * w)
    matrix[1, 0] = scale * (x * y + z * w)
    matrix[1, 1] = 1.0 - scale * (x * x + z * z)
    matrix[1, 2] = scale * (y * z - x * w)
    matrix[2, 0] = scale * (x * z - y * w)
    matrix[2, 1] = scale * (y * z + x * w)
    matrix[2, 2] = 1.0 - scale * (x * x + y * y)


@njit(cache=True)
def _rotations(quaternions: Floats, matrices: Floats) -> None:
    for n in range(len(quaternions)):
        rotation_kernel(quaternions[n], matrices[n])
