"""Cartesian and cylindrical coordinates, on any leading axes."""

from __future__ import annotations

import numpy as np

from scm_world._types import ArrayLike, Floats


def to_cylindrical(position: ArrayLike) -> Floats:
    """Return radius [m], azimuth [rad] in (-pi, pi], zero on the axis, and height [m] of points."""
    point = np.asarray(position, dtype=np.float64)
    x, y = point[..., 0], point[..., 1]
    cylindrical = point.copy()
    radius = cylindrical[..., 0] = np.hypot(x, y)
    azimuth = np.arctan2(y, x)
    turned = np.where(azimuth == -np.pi, np.pi, azimuth)
    cylindrical[..., 1] = np.where(radius == 0.0, 0.0, turned)
    return cylindrical


def from_cylindrical(cylindrical: ArrayLike) -> Floats:
    """Return the cartesian coordinates [m] of radius [m], azimuth [rad] and height [m]."""
    given = np.asarray(cylindrical, dtype=np.float64)
    radius, azimuth = given[..., 0], given[..., 1]
    position = given.copy()
    position[..., 0] = radius * np.cos(azimuth)
    position[..., 1] = radius * np.sin(azimuth)
    return position
