"""What a picture shows where no body is: the floor, the wall and the background."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import lru_cache

import numpy as np
from numba import njit

from scm_world._types import Floats
from scm_world.backends.renderer.bodies import FLOOR, NOTHING, STAGE, Bodies
from scm_world.backends.renderer.kernels import (
    SHADOW,
    Canvas,
    Colors,
    Depths,
    Owners,
    View,
    brightness,
    byte,
    draw,
    shade_at,
)
from scm_world.backends.renderer.meshes import Triangles, draw_mesh
from scm_world.backends.renderer.views import camera_view, parallel_view
from scm_world.models.scene import Light, Scene
from scm_world.scene.camera import Camera
from scm_world.scene.scene import WALL_HEIGHT, WALL_RADIUS

BACKGROUND = (0.86, 0.89, 0.93)
SHADOW_TEXELS = 96
SHADOW_BLUR = 2  # passes of a box filter three texels wide
LOWEST = 1e-3  # [1] the height of a light below which nothing throws a shadow on the floor

NO_SHADOW = np.zeros((0, 0))
NO_OWNERS = np.zeros((0, 0), dtype=np.int32)
NO_COLORS = np.zeros((3, 0, 0), dtype=np.uint8)

Palette = tuple[tuple[float, ...], ...]
"""The colors of the floor, of the wall and of the background."""


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


def palette(scene: Scene) -> Palette:
    """Give the colors of the arena of a scene."""
    floor, wall = (scene.parameters[name, "color"].tolist() for name in ("floor", "stage"))
    return tuple(floor), tuple(wall), BACKGROUND


@njit(cache=True, error_model="numpy")
def _hit_arena(
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, near: float
) -> tuple[float, int]:
    """Meet the floor from above, or the wall of the ring from within."""
    if oz > 0.0 > dz:
        t = -oz / dz
        x, y = ox + t * dx, oy + t * dy
        if t >= near and x * x + y * y <= WALL_RADIUS * WALL_RADIUS:
            return t, FLOOR
    a, b = dx * dx + dy * dy, ox * dx + oy * dy
    discriminant = b * b - a * (ox * ox + oy * oy - WALL_RADIUS * WALL_RADIUS)
    if a > 0.0 and discriminant >= 0.0:
        t = (-b + math.sqrt(discriminant)) / a
        if t >= near and 0.0 <= oz + t * dz <= WALL_HEIGHT:
            return t, STAGE
    return math.inf, NOTHING


@njit(cache=True, error_model="numpy")
def _trace_arena(view: View, depth: Depths, owners: Owners) -> None:
    """Write depth and owner of every pixel that shows floor or wall nearer than what is there."""
    (ox, oy, oz), (ax, ay, az), (bx, by, bz) = view.rays[0], view.rays[4], view.rays[5]
    for v in range(depth.shape[0]):
        cx, cy, cz = view.rays[3, 0] + v * bx, view.rays[3, 1] + v * by, view.rays[3, 2] + v * bz
        for u in range(depth.shape[1]):
            dx, dy, dz = cx + u * ax, cy + u * ay, cz + u * az
            t, owner = _hit_arena(ox, oy, oz, dx, dy, dz, view.near)
            if t < depth[v, u]:
                depth[v, u], owners[v, u] = t, owner


@njit(cache=True, error_model="numpy")
def _paint_arena(view: View, light: Floats, colors: Floats, shadow: Floats, canvas: Canvas) -> None:
    """Color the pixels that show floor, wall or nothing.

    Args:
        view: The rays of the pixels; all from one origin.
        light: Unit vector towards the light, and the ambient brightness, shape (4,).
        colors: Of the floor, of the wall and of the background, shape (3, 3).
        shadow: How dark the floor is, shape (m, m) in [0, 1], over the square around the ring;
            of shape (0, 0) if there are no shadows.
        canvas: Depth and owners are read, colors are written.
    """
    depth, owners, rgb = canvas
    ambient, dark = light[3], SHADOW * (1.0 - light[3])
    top = brightness(light[2], ambient)
    (ox, oy, _), (ax, ay, _), (bx, by, _) = view.rays[0], view.rays[4], view.rays[5]
    for v in range(depth.shape[0]):
        cx, cy = view.rays[3, 0] + v * bx, view.rays[3, 1] + v * by
        for u in range(depth.shape[1]):
            x, y = ox + depth[v, u] * (cx + u * ax), oy + depth[v, u] * (cy + u * ay)
            shade, row = 1.0, 2
            if owners[v, u] == FLOOR:
                shade, row = top * (1.0 - dark * shade_at(shadow, WALL_RADIUS, x, y)), 0
            elif owners[v, u] == STAGE:
                cosine = -(x * light[0] + y * light[1]) / WALL_RADIUS
                shade, row = brightness(cosine, ambient), 1
            for i in range(3):
                rgb[i, v, u] = byte(255.0 * shade * colors[row, i])


def trace_arena(camera: Camera, samples: int) -> Canvas:
    """Show floor and wall to a camera, without colors."""
    shape = camera.height * samples, camera.width * samples
    depth = np.full(shape, camera.far, dtype=np.float32)
    owners = np.full(shape, NOTHING, dtype=np.int32)
    _trace_arena(camera_view(camera, samples), depth, owners)
    return Canvas(depth, owners, NO_COLORS)


@lru_cache(maxsize=32)
def empty_arena(camera: Camera) -> Canvas:
    """Keep what ``trace_arena`` returns for one sample. The arrays are shared: copy them."""
    return trace_arena(camera, 1)


def paint_arena(
    empty: Canvas, view: View, light: Light, colors: Palette, shadow: Floats = NO_SHADOW
) -> Colors:
    """Color an empty arena, shape (3, h, w)."""
    rgb = np.empty((3, *empty.depth.shape), dtype=np.uint8)
    _paint_arena(view, lamp(light), np.array(colors), shadow, empty._replace(rgb=rgb))
    return rgb


@lru_cache(maxsize=32)
def lit_arena(camera: Camera, light: Light, colors: Palette) -> Colors:
    """Show the arena without shadows, shape (3, h, w). The array is shared: copy it."""
    return paint_arena(empty_arena(camera), camera_view(camera, 1), light, colors)


def shadow_map(
    bodies: Bodies,
    light: Light,
    meshes: Iterable[Triangles] = (),
    half: float = WALL_RADIUS,
    n: int = SHADOW_TEXELS,
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
