"""Triangles and planes onto pixels; see ``kernels`` for solids."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit

from scm_world._types import Floats, Integers
from scm_world.backends.renderer.kernels import (
    SHADOW,
    Canvas,
    Depths,
    View,
    blend,
    brightness,
    draw,
    parallel_view,
    ray,
    rectangle,
    shade_at,
    to_frame,
    turned,
)
from scm_world.backends.renderer.rays import Triple
from scm_world.models.scene import Light
from scm_world.models.shapes import MESH, Mesh, Table


class Ground(NamedTuple):
    """What lies on a plane.

    Attributes:
        tiles: Edges of its tiles, shape (2,) [m].
        other: Red, green, blue in [0, 1] of every other tile, shape (3,).
        shadow: How dark it is, shape (n, n) in [0, 1]; of shape (0, 0) without shadows.
        square: First and second coordinate of the middle of the shadow, and half the edge of its
            square, shape (3,) [m].
    """

    tiles: Floats
    other: Floats
    shadow: Floats
    square: Floats


@njit(cache=True, error_model="numpy")
def _projected(mesh: Mesh, position: Floats, rotation: Floats, view: View) -> Floats:
    """Give the homogeneous pixels of the vertices, shape (n, 3)."""
    p, r, o = view.projection, rotation, position
    matrix = np.empty((3, 4))
    for i in range(3):
        matrix[i, 3] = p[i, 0] * o[0] + p[i, 1] * o[1] + p[i, 2] * o[2] + p[i, 3]
        for j in range(3):
            matrix[i, j] = p[i, 0] * r[0, j] + p[i, 1] * r[1, j] + p[i, 2] * r[2, j]
    pixels = np.empty((len(mesh.vertices), 3))
    for n in range(len(pixels)):
        x, y, z = mesh.vertices[n]
        for i in range(3):
            pixels[n, i] = matrix[i, 0] * x + matrix[i, 1] * y + matrix[i, 2] * z + matrix[i, 3]
    return pixels


@njit(cache=True, error_model="numpy")
def _include(box: Floats, u: float, v: float) -> None:
    """Extend a box (least and greatest column, least and greatest row) by a pixel."""
    box[0], box[1] = min(box[0], u), max(box[1], u)
    box[2], box[3] = min(box[2], v), max(box[3], v)


@njit(cache=True, error_model="numpy")
def _rectangle(corners: Floats, near: float, box: Floats) -> None:
    """Bound the pixels that a triangle can cover, of what is beyond ``near``.

    Args:
        corners: Homogeneous pixels, shape (3, 3).
        near: Smallest depth that is seen.
        box: Written, shape (4,): least and greatest column, least and greatest row.
    """
    box[0] = box[2] = math.inf
    box[1] = box[3] = -math.inf
    for i in range(3):
        u, v, w = corners[i]
        if w > near:
            _include(box, u / w, v / w)
        p, q, r = corners[(i + 1) % 3]
        if (w > near) != (r > near):
            share, w = (near - w) / (r - w), max(near, 1e-300)
            _include(box, (u + share * (p - u)) / w, (v + share * (q - v)) / w)


@njit(cache=True, error_model="numpy")
def _nearest(t: np.float32, alpha: float, depth: Depths, v: int, u: int) -> bool:
    """Tell whether something at a depth is to be seen, and note that; see ``draw_mesh``."""
    if alpha == 1.0:
        if not t < depth[v, u]:
            return False
        depth[v, u] = t
        return True
    if t != depth[v, u]:
        return False
    depth[v, u] = -math.inf
    return True


@njit(cache=True, error_model="numpy")
def _edges(corners: Floats, edges: Floats) -> float:
    """Write b × c, c × a and a × b of the corners a, b and c, shape (3, 3); give a · (b × c)."""
    for i in range(3):
        a0, a1, a2 = corners[(i + 1) % 3]
        b0, b1, b2 = corners[(i + 2) % 3]
        edges[i, 0] = a1 * b2 - a2 * b1
        edges[i, 1] = a2 * b0 - a0 * b2
        edges[i, 2] = a0 * b1 - a1 * b0
    x, y, z = corners[0]
    volume: float = x * edges[0, 0] + y * edges[0, 1] + z * edges[0, 2]
    return volume


@njit(cache=True, error_model="numpy")
def draw_mesh(
    mesh: Mesh, shapes: Table, n: int, view: View, light: Floats, alpha: float, canvas: Canvas
) -> None:
    """Draw triangles over what is there, where they are nearer. Both of their sides are seen.

    The triangle with the homogeneous pixels a, b, c covers the pixel q where the products of q
    with b × c, c × a and a × b have the sign of a · (b × c); it is seen from outside if that is
    negative.

    Args:
        mesh: What to draw, in the frame of its shape.
        shapes: With the shape.
        n: Its row.
        view: The rays of the pixels.
        light: Unit vector towards the light, and the ambient brightness, shape (4,).
        alpha: Opacity. Below 1, ``canvas.depth`` has to hold the depth of what is nearest, this
            mesh included; only where the mesh is nearest are colors blended, and the depth there
            is minus infinity afterwards. Owners stay as they are.
        canvas: What to draw on.

    Source:
        Olano and Greer, *Triangle scan conversion using 2D homogeneous coordinates*, 1997.
    """
    depth, owners, rgb = canvas
    colored, owned = rgb.shape[1] > 0, alpha == 1.0 and owners.shape[0] > 0
    tint, rotation = shapes.colors[n], shapes.rotations[n]
    color = (255.0 * tint[0], 255.0 * tint[1], 255.0 * tint[2])
    lamp = turned(rotation, light)
    pixels, near = _projected(mesh, shapes.positions[n], rotation, view), view.near
    corners, edges, box = np.empty((3, 3)), np.empty((3, 3)), np.empty(4)
    for f in range(len(mesh.faces)):
        for i in range(3):
            for k in range(3):
                corners[i, k] = pixels[mesh.faces[f, i], k]
        _rectangle(corners, near, box)
        left, right = math.ceil(max(box[0], 0.0)), int(min(box[1], depth.shape[1] - 1.0)) + 1
        top, bottom = math.ceil(max(box[2], 0.0)), int(min(box[3], depth.shape[0] - 1.0)) + 1
        if left >= right or top >= bottom:
            continue
        volume = _edges(corners, edges)
        side = 1.0 if volume > 0.0 else -1.0
        for v in range(top, bottom):
            for u in range(left, right):
                a = side * (u * edges[0, 0] + v * edges[0, 1] + edges[0, 2])
                b = side * (u * edges[1, 0] + v * edges[1, 1] + edges[1, 2])
                c = side * (u * edges[2, 0] + v * edges[2, 1] + edges[2, 2])
                if not min(a, b, c) >= 0.0:
                    continue
                t = np.float32(side * volume / (a + b + c))
                if not (t >= near and _nearest(t, alpha, depth, v, u)):
                    continue
                if colored:
                    cosine = -side * _cosine(mesh.normals[f], (a, b, c), lamp)
                    blend(rgb, v, u, color, brightness(cosine, light[3]), alpha)
                if owned:
                    owners[v, u] = shapes.bodies[n]


@njit(cache=True, error_model="numpy")
def _cosine(normals: Floats, weights: Triple, lamp: Triple) -> float:
    """Give the cosine between the light and the weighted mean of the normals at three corners."""
    a, b, c = weights
    x = a * normals[0, 0] + b * normals[1, 0] + c * normals[2, 0]
    y = a * normals[0, 1] + b * normals[1, 1] + c * normals[2, 1]
    z = a * normals[0, 2] + b * normals[1, 2] + c * normals[2, 2]
    length = max(math.sqrt(x * x + y * y + z * z), 1e-300)
    cosine: float = (x * lamp[0] + y * lamp[1] + z * lamp[2]) / length
    return cosine


@njit(cache=True, error_model="numpy")
def _tint(
    ground: Ground, color: Floats, halves: Floats, x: float, y: float, spread: float
) -> Triple:
    """Give the color, 255 where it is full, of a point of a plane that a pixel spreads over."""
    left, back, tiles, other = -halves[0], halves[1], ground.tiles, ground.other
    odd = (math.floor((x - left) / tiles[0]) + math.floor((back - y) / tiles[1])) % 2.0
    clear = max(1.0 - spread / min(tiles[0], tiles[1]), 0.0)
    share = 0.5 + clear * (odd - 0.5)
    return (
        255.0 * (color[0] + share * (other[0] - color[0])),
        255.0 * (color[1] + share * (other[1] - color[1])),
        255.0 * (color[2] + share * (other[2] - color[2])),
    )


@njit(cache=True, error_model="numpy")
def _shadow_at(ground: Ground, x: float, y: float) -> float:
    """Read the shadow map of a plane; there are no shadows beside its square."""
    x, y, half = x - ground.square[0], y - ground.square[1], ground.square[2]
    if abs(x) < half and abs(y) < half:
        shade: float = shade_at(ground.shadow, half, x, y)
        return shade
    return 0.0


@njit(cache=True, error_model="numpy")
def draw_ground(
    ground: Ground, shapes: Table, n: int, view: View, light: Floats, alpha: float, canvas: Canvas
) -> None:
    """Draw a plane over what is there, where it is nearer.

    Tiles fade into one color where they are smaller than a pixel.

    Args:
        ground: What lies on it.
        shapes: With the plane.
        n: Its row.
        view: The rays of the pixels.
        light: Unit vector towards the light, and the ambient brightness, shape (4,).
        alpha: Opacity. Below 1 colors are blended, and depth and owners stay as they are.
        canvas: What to draw on.
    """
    depth, owners, rgb = canvas
    colored, solid = rgb.shape[1] > 0, alpha == 1.0
    owned = solid and owners.shape[0] > 0
    halves, rotation, color = shapes.halves[n], shapes.rotations[n], shapes.colors[n]
    wide = halves[0] if halves[0] > 0.0 else math.inf
    long = halves[1] if halves[1] > 0.0 else math.inf
    left, right, upper, lower = 0, depth.shape[1], 0, depth.shape[0]
    if wide + long < math.inf:
        left, right, upper, lower = rectangle(shapes, n, view, right, lower)
    rays = to_frame(shapes.positions[n], rotation, view.rays, np.ones(3))
    top = brightness(turned(rotation, light)[2], light[3])
    dark = SHADOW * (1.0 - light[3])
    pixel = math.sqrt(rays[4, 0] ** 2 + rays[4, 1] ** 2 + rays[4, 2] ** 2)
    for v in range(upper, lower):
        for u in range(left, right):
            dx, dy, dz = ray(rays, 3, u, v)
            if not rays[0, 2] > 0.0 > dz:
                continue
            t = -rays[0, 2] / dz
            x, y = rays[0, 0] + t * dx, rays[0, 1] + t * dy
            if not (abs(x) <= wide and abs(y) <= long and view.near <= t < depth[v, u]):
                continue
            if colored:
                spread = t * pixel * math.sqrt(dx * dx + dy * dy + dz * dz) / -dz
                shade = top * (1.0 - dark * _shadow_at(ground, x, y))
                blend(rgb, v, u, _tint(ground, color, halves, x, y, spread), shade, alpha)
            if solid:
                depth[v, u] = t
            if owned:
                owners[v, u] = shapes.bodies[n]


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
    table: Table, meshes: Mapping[int, Mesh], which: Integers, light: Light, *, half: float, n: int
) -> Floats:
    """Look from the floor towards the light, and soften what stands in the way.

    Args:
        table: Of shapes, z from the floor.
        meshes: Triangles, by row.
        which: Rows of what throws shadows.
        light: That they stand in the way of.
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
    canvas = Canvas(np.full((n, n), np.inf, dtype=np.float32), NO_OWNERS, NO_COLORS)
    draw(table, which[table.kinds[which] != MESH], view, towards, 1.0, canvas)
    for row in which.tolist():
        if row in meshes:
            draw_mesh(meshes[row], table, row, view, towards, 1.0, canvas)
    shadow = np.where(np.isfinite(canvas.depth), 1.0, 0.0)
    for _ in range(SHADOW_BLUR):
        _soften(shadow)
    return shadow


@njit(cache=True, error_model="numpy")
def _soften(shadow: Floats) -> None:
    """Average each texel with its two neighbors, along the first axis and then the second."""
    n, m = shadow.shape
    last = shadow[0].copy()
    for i in range(1, n - 1):
        for j in range(m):
            here = shadow[i, j]
            shadow[i, j] = (last[j] + here + shadow[i + 1, j]) / 3.0
            last[j] = here
    for i in range(n):
        left = shadow[i, 0]
        for j in range(1, m - 1):
            here = shadow[i, j]
            shadow[i, j] = (left + here + shadow[i, j + 1]) / 3.0
            left = here
