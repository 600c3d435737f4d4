"""Cameras: where pictures are taken from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import ArrayLike

from scm_world._types import Floats
from scm_world.scene.trifinger import TABLE_OFFSET

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
        width: Of the picture [pixels].
        height: Of the picture [pixels].
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
        """Compute the directions right, up and back of the camera in the world.

        Returns:
            A rotation from the world to the camera, shape (3, 3): one direction per row.

        Raises:
            ValueError: The camera has no optical axis, or ``up`` is parallel to it.
        """
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

    def view_matrix(self) -> Floats:
        """Map homogeneous world points to the camera (x right, y up, z back), shape (4, 4)."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.axes()
        matrix[:3, 3] = -matrix[:3, :3] @ np.asarray(self.eye)
        return matrix

    def projection_matrix(self) -> Floats:
        """Map the camera's homogeneous points to clip space as OpenGL defines it, shape (4, 4)."""
        focal = 1.0 / math.tan(math.radians(self.field_of_view) / 2.0)
        depth = self.near - self.far
        matrix = np.zeros((4, 4))
        matrix[0, 0] = focal * self.height / self.width
        matrix[1, 1] = focal
        matrix[2, 2] = (self.far + self.near) / depth
        matrix[2, 3] = 2.0 * self.far * self.near / depth
        matrix[3, 2] = -1.0
        return matrix

    def project(self, points: ArrayLike) -> Floats:
        """Find where points appear in the picture.

        Args:
            points: In the world, shape (..., 3) [m].

        Returns:
            Column, row and depth, shape (..., 3) [pixels, pixels, m]. The pixel is
            ``(floor(row), floor(column))``, row 0 at the top. What has no positive depth lies
            behind the camera and is not seen.

        Example:
            >>> camera = Camera("top", (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))
            >>> camera.project([0.0, 0.0, 0.25]).tolist()
            [64.0, 64.0, 0.75]
        """
        seen = (np.asarray(points, dtype=np.float64) - self.eye) @ self.axes().T  # (..., 3)
        focal = self.height / (2.0 * math.tan(math.radians(self.field_of_view) / 2.0))
        depth = -seen[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            column = self.width / 2.0 + focal * seen[..., 0] / depth
            row = self.height / 2.0 - focal * seen[..., 1] / depth
        return np.stack([column, row, depth], axis=-1)


def camera_from(
    name: str,
    position: ArrayLike,
    orientation: ArrayLike,
    field_of_view: float = 52.0,
    width: int = 128,
    height: int = 128,
) -> Camera:
    """Make a camera from plain numbers, in the convention of the published cameras.

    The first axis of the camera points to the right of the picture, the second one down and the
    third one forward. With the poses of ``published_poses`` it makes the cameras of ``CAMERAS``.

    Args:
        name: What the camera is called.
        position: Where it stands, z from the table top, shape (3,) [m].
        orientation: Quaternion (x, y, z, w) of any length, shape (4,).
        field_of_view: Vertical opening angle [deg].
        width: Of the picture [pixels].
        height: Of the picture [pixels].

    Raises:
        ValueError: The quaternion is zero or not finite, or a shape is wrong.

    Example:
        >>> down = camera_from("top", [0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0])
        >>> down.target, down.up
        ((0.0, 0.0, 0.0), (-0.0, 1.0, -0.0))
    """
    x, y, z = np.asarray(position, dtype=np.float64).tolist()
    down, forward = _down_and_forward(orientation)
    target = (x + forward[0], y + forward[1], z + forward[2])
    up = (-down[0], -down[1], -down[2])
    return Camera(name, (x, y, z), target, up, float(field_of_view), int(width), int(height))


def _down_and_forward(orientation: ArrayLike) -> tuple[Vector, Vector]:
    """Read the second and the third axis of a camera from its quaternion."""
    length = float(np.linalg.norm(orientation))
    if not (length > 0.0 and math.isfinite(length)):
        raise ValueError(f"orientation: expected a quaternion of some length, got {orientation!r}")
    x, y, z, w = np.divide(orientation, length).tolist()
    down = (2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w))
    forward = (2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y))
    return down, forward


def _above_table(eye: Vector) -> Vector:
    return eye[0], eye[1], eye[2] - TABLE_OFFSET


def _original(name: str, eye: Vector, orientation: tuple[float, float, float, float]) -> Camera:
    """Make a camera as CausalWorld does, whose mistakes are those of ``ORIGINAL_CAMERAS``."""
    down, forward = _down_and_forward(orientation)
    return Camera(name, _above_table(eye), _above_table(forward), down)


_PUBLISHED: tuple[tuple[str, Vector, tuple[float, float, float, float]], ...] = (
    ("60", (0.2496, 0.2458, 0.58), (0.3760, 0.8690, -0.2918, -0.1354)),
    ("120", (0.0047, -0.2834, 0.58), (0.9655, -0.0098, -0.0065, -0.2603)),
    ("300", (-0.2470, 0.2513, 0.50), (-0.3633, 0.8686, -0.3141, 0.1220)),
)


def published_poses() -> dict[str, tuple[Floats, Floats]]:
    """Give the poses of ``CAMERAS`` as ``camera_from`` takes them.

    Returns:
        By name: the position, z from the table top, shape (3,) [m], and the unit quaternion
        (x, y, z, w), shape (4,).

    Example:
        >>> position, orientation = published_poses()["60"]
        >>> camera_from("60", position, orientation) == CAMERAS[0]
        True
    """
    return {
        name: (np.array(_above_table(eye)), np.divide(turn, np.linalg.norm(turn)))
        for name, eye, turn in _PUBLISHED
    }


CAMERAS = tuple(camera_from(name, *pose) for name, pose in published_poses().items())
"""The three cameras of the real robot, upright and looking along their optical axes.

Source:
    CausalWorld 1.2, ``envs/robot/camera.py``: positions, orientations, 52°, 128 x 128.
"""

ORIGINAL_CAMERAS = tuple(_original(*row) for row in _PUBLISHED)
"""The same cameras as CausalWorld 1.2 realises them.

It takes the direction of the optical axis for a point to look at, so that its views are off by
1.6° to 2.7°, and holds the camera upside down. It then flips the rows of the picture, which
makes it upright and mirrored: ``picture[::-1]``.
"""

OVERVIEW = Camera(
    name="overview",
    eye=(0.3, -0.68, 0.72),
    target=(0.0, 0.0, 0.1),
    field_of_view=39.0,
    width=640,
    height=480,
    near=0.01,
    far=10.0,
)
"""For people: the whole arena from the front and above, between fingers 120 and 300."""
