"""Vectors as three plain numbers, for kernels that must not allocate."""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from scm_world._types import Floats

Vector = tuple[float, float, float]


@njit(cache=True)
def vector(array: Floats) -> Vector:
    """Take three numbers out of an array."""
    return array[0], array[1], array[2]


@njit(cache=True)
def plus(a: Vector, b: Vector) -> Vector:
    """Add two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@njit(cache=True)
def minus(a: Vector, b: Vector) -> Vector:
    """Subtract the second vector from the first."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(cache=True)
def scaled(factor: float, a: Vector) -> Vector:
    """Multiply a vector by a number."""
    return factor * a[0], factor * a[1], factor * a[2]


@njit(cache=True)
def dot(a: Any, b: Any) -> float:
    """Compute the inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]  # type: ignore[no-any-return] # of floats


@njit(cache=True)
def cross(a: Vector, b: Vector) -> Vector:
    """Compute the outer product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True)
def applied(matrix: Floats, v: Vector) -> Vector:
    """Multiply a matrix, shape (3, 3), by a vector."""
    return dot(matrix[0], v), dot(matrix[1], v), dot(matrix[2], v)


@njit(cache=True)
def turned(axis: Vector, angle: float, v: Vector) -> Vector:
    """Turn a vector about a unit axis, by Rodrigues' formula."""
    cos, sin = math.cos(angle), math.sin(angle)
    along = scaled((1.0 - cos) * dot(axis, v), axis)
    return plus(plus(scaled(cos, v), scaled(sin, cross(axis, v))), along)
