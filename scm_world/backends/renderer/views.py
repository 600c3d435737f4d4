"""The rays of pictures."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from scm_world._types import Floats
from scm_world.backends.renderer.kernels import View
from scm_world.models.camera import Camera


@lru_cache(maxsize=64)
def camera_view(camera: Camera, samples: int) -> View:
    """Give every sample of a pinhole camera its ray. The arrays are shared."""
    width, height = camera.width * samples, camera.height * samples
    step = 2.0 * math.tan(math.radians(camera.field_of_view) / 2.0) / height  # per pixel
    right, up, back = camera.axes()
    middle_u, middle_v = (width - 1) / 2.0, (height - 1) / 2.0
    corner = -back - right * (step * middle_u) + up * (step * middle_v)
    eye, zero = np.array(camera.eye, dtype=np.float64), np.zeros(3)
    rays = np.stack([eye, zero, zero, corner, right * step, -up * step])
    linear = np.stack([right / step - middle_u * back, -up / step - middle_v * back, -back])
    return View(rays, np.column_stack([linear, -linear @ eye]), float(camera.near))


def parallel_view(slope: Floats, half: float, n: int) -> View:
    """Give every point of a grid on the floor a ray towards the light.

    Args:
        slope: Towards the light, at height one, shape (3,).
        half: Half the edge of the grid [m].
        n: Points along an edge.
    """
    step = 2.0 * half / (n - 1)
    zero = np.zeros(3)
    rays = np.array([[-half, -half, 0.0], [step, 0.0, 0.0], [0.0, step, 0.0], slope, zero, zero])
    projection = np.array(
        [
            [1.0 / step, 0.0, -slope[0] / step, half / step],
            [0.0, 1.0 / step, -slope[1] / step, half / step],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    return View(rays, projection, 0.0)
