"""The corners of blocks and goals: poses without the jumps of angles and quaternions."""

from __future__ import annotations

import itertools
from typing import final

import numpy as np

from scm_world._types import Floats, Values
from scm_world.geometry import rotation_matrix

KEYPOINTS = "keypoints"
"""What the corners are called among the parts of an observation."""

CORNERS = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
"""The corners of a box with edges of length 1, shape (8, 3)."""

_POSE = ("size", "cartesian_position", "orientation")


def corners(size: Floats, position: Floats, orientation: Floats) -> Floats:
    """Compute the corners of boxes.

    Args:
        size: Edge lengths, shape (..., 3) [m].
        position: Centers, shape (..., 3) [m].
        orientation: Quaternions (x, y, z, w), shape (..., 4).

    Returns:
        Shape (..., 8, 3) [m]; the last axis of the box changes fastest, from low to high.

    Example:
        >>> corners(np.array([2.0, 2.0, 2.0]), np.ones(3), np.array([0.0, 0.0, 0.0, 1.0]))[:2]
        array([[0., 0., 0.], [0., 0., 2.]])
    """
    local = CORNERS * np.asarray(size)[..., None, :]  # (..., 8, 3)
    turned = local @ np.swapaxes(rotation_matrix(np.asarray(orientation)), -1, -2)
    found: Floats = turned + np.asarray(position)[..., None, :]
    return found


@final
class Keypoints:
    """The corners of some bodies of a world.

    Args:
        bodies: Names of blocks and goals.

    Attributes:
        names: The variables that they are computed from.
        size: How many numbers they are: 24 for each body.
    """

    def __init__(self, bodies: tuple[str, ...]) -> None:
        self._bodies = bodies
        self.names = tuple(f"{body}.{part}" for body in bodies for part in _POSE)
        self.size = CORNERS.size * len(bodies)

    def observe(self, now: Values) -> Floats:
        """Give the corners body by body, shape (24 n,) [m]."""
        parts = [np.array([now[f"{body}.{part}"] for body in self._bodies]) for part in _POSE]
        return corners(*parts).ravel()
