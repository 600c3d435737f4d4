"""Light and shadows of pictures."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import lru_cache

import numpy as np

from scm_world._types import Floats
from scm_world.backends.renderer.bodies import NOTHING, Bodies
from scm_world.backends.renderer.kernels import Canvas, draw
from scm_world.backends.renderer.meshes import Triangles, draw_mesh
from scm_world.backends.renderer.views import parallel_view
from scm_world.models.scene import Light

SHADOW_BLUR = 2  # passes of a box filter three texels wide
LOWEST = 1e-3  # [1] the height of a light below which nothing throws a shadow on the floor

NO_SHADOW = np.zeros((0, 0))
NO_OWNERS = np.zeros((0, 0), dtype=np.int32)
NO_COLORS = np.zeros((3, 0, 0), dtype=np.uint8)


@lru_cache(maxsize=32)
def lamp(light: Light) -> Floats:
    """Give the unit vector towards the light, and the ambient brightness, shape (4,).

    Raises:
        ValueError: The light comes from nowhere.
    """
    length = math.hypot(*light.direction)
    if not (length > 0.0 and math.isfinite(length)):
        raise ValueError(f"light: the direction must have a length, got {light.direction}")
    return np.array([*(x / length for x in light.direction), light.ambient])


def shadow_map(
    bodies: Bodies,
    light: Light,
    meshes: Iterable[Triangles] = (),
    *,
    half: float,
    n: int,
) -> Floats:
    """Look from the floor towards the light, and soften what stands in the way.

    Args:
        bodies: What throws shadows, z from the floor.
        light: That they stand in the way of.
        meshes: What else throws shadows.
        half: Half the edge of the square around the origin that is looked at [m].
        n: Texels along an edge.

    Returns:
        How dark the floor is in the square, shape (n, n) in [0, 1]; of shape (0, 0) where the
        light comes from the side or from below.
    """
    towards = lamp(light)
    if towards[2] < LOWEST:
        return NO_SHADOW
    view = parallel_view(towards[:3] / towards[2], half, n)
    depth, owners = np.full((n, n), np.inf, dtype=np.float32), np.full((n, n), NOTHING, np.int32)
    canvas = Canvas(depth, owners, NO_COLORS)
    draw(bodies, view, towards, 1.0, canvas)
    for mesh in meshes:
        draw_mesh(mesh, view, towards, 1.0, canvas)
    shadow = np.where(np.isfinite(depth), 1.0, 0.0)
    for _ in range(SHADOW_BLUR):
        shadow[1:-1] = (shadow[:-2] + shadow[1:-1] + shadow[2:]) / 3.0
        shadow[:, 1:-1] = (shadow[:, :-2] + shadow[:, 1:-1] + shadow[:, 2:]) / 3.0
    return shadow
