"""Cameras: where pictures are taken from."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np
from numpy.typing import ArrayLike

from scm_world._types import Floats

if TYPE_CHECKING:
    from scm_world.models.scene import Scene

Vector = tuple[float, float, float]


@final
@dataclass(frozen=True)
class Camera:
    """A pinhole camera with square pixels.

    Attributes:
        name: What the camera is called.
        eye: Where it stands [m], z from the table top.
        target: A point on its optical axis [m].
        up: A direction that points up in the picture.
        field_of_view: Vertical opening angle [deg].
        width: Width of the picture [pixels].
        height: Height of the picture [pixels].
        near: Nothing nearer than this is seen [m], along the optical axis.
        far: Nothing farther than this is seen [m], along the optical axis.
    """

    name: str
    eye: Vector
    target: Vector
    up: Vector = (0.0, 0.0, 1.0)
    field_of_view: float = 52.0
    width: int = 128
    height: int = 128
    near: float = 0.001
    far: float = 100.0

    def axes(self) -> Floats:
        """Compute the directions right, up and back of the camera in the world, one in each row."""
        back = np.subtract(self.eye, self.target)
        right = np.cross(self.up, back)
        axes = np.stack([right, np.cross(back, right), back])  # (3, 3)
        lengths = np.linalg.norm(axes, axis=1, keepdims=True)
        if not (lengths > 0.0).all():
            raise ValueError(
                f"camera {self.name!r}: up {self.up} must not be parallel to the optical axis "
                f"from {self.eye} to {self.target}"
            )
        unit: Floats = axes / lengths
        return unit

    def project(self, points: ArrayLike) -> Floats:
        """Find where points appear in the picture.

        Returns:
            Column, row and depth, shape (..., 3) [pixels, pixels, m]. The pixel is
            ``(floor(row), floor(column))``, row 0 at the top. A point without positive depth lies
            behind the camera and is not seen.
        """
        seen = (np.asarray(points, dtype=np.float64) - self.eye) @ self.axes().T  # (..., 3)
        focal = self.height / (2.0 * math.tan(math.radians(self.field_of_view) / 2.0))
        depth = -seen[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            column = self.width / 2.0 + focal * seen[..., 0] / depth
            row = self.height / 2.0 - focal * seen[..., 1] / depth
        return np.stack([column, row, depth], axis=-1)


@final
@dataclass(frozen=True)
class Views:
    """From where scenes of a structure are seen, if it says so.

    Attributes:
        overview: The camera of pictures for people.
        cameras: Those of policies, by default.
        original_cameras: The same as the published code realises them.
        background: Takes a scene, and whether obstacles are wanted; returns the scene that
            pictures of its goals show, and the names of the bodies that they leave out.
    """

    overview: Camera
    cameras: tuple[Camera, ...]
    original_cameras: tuple[Camera, ...]
    background: Callable[[Scene, bool], tuple[Scene, frozenset[str]]]


def camera_from(
    name: str,
    position: ArrayLike,
    orientation: ArrayLike,
    field_of_view: float = 52.0,
    width: int = 128,
    height: int = 128,
) -> Camera:
    """Make a camera from plain numbers, with a quaternion (x, y, z, w) of any length.

    The first axis of the camera points to the right of the picture, the second one down and the
    third one forward.

    Raises:
        ValueError: The quaternion is zero or not finite, or a shape is wrong.
    """
    x, y, z = np.asarray(position, dtype=np.float64).tolist()
    down, forward = down_and_forward(orientation)
    target = (x + forward[0], y + forward[1], z + forward[2])
    up = (-down[0], -down[1], -down[2])
    return Camera(name, (x, y, z), target, up, float(field_of_view), int(width), int(height))


def down_and_forward(orientation: ArrayLike) -> tuple[Vector, Vector]:
    """Read the second and the third axis of a camera from its quaternion."""
    length = float(np.linalg.norm(orientation))
    if not (length > 0.0 and math.isfinite(length)):
        raise ValueError(f"orientation: expected a quaternion of some length, got {orientation!r}")
    x, y, z, w = np.divide(orientation, length).tolist()
    down = (2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w))
    forward = (2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y))
    return down, forward
