"""Triangles and planes onto pixels; see ``kernels`` for solids."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from scm_world._types import Floats, Integers
from scm_world.backends.renderer.kernels import (
    SHADOW,
    Canvas,
    View,
    blend,
    brightness,
    shade_at,
)


class Triangles(NamedTuple):
    """A mesh in the world.

    Attributes:
        vertices: In the frame of the mesh, shape (n, 3) [m].
        faces: Shape (m, 3).
        normals: Unit outward normals at the corners, shape (m, 3, 3).
        position: Origin of the frame of the mesh, shape (3,) [m].
        rotation: From that frame to the world, shape (3, 3).
        color: Red, green, blue in [0, 1], shape (3,).
        owner: What the mesh belongs to.
    """

    vertices: Floats
    faces: Integers
    normals: Floats
    position: Floats
    rotation: Floats
    color: Floats
    owner: int


class Ground(NamedTuple):
    """A plane in the world, seen from the side of its third axis.

    Attributes:
        position: Its origin, shape (3,) [m].
        rotation: From its frame to the world, shape (3, 3).
        halves: Half its edges, infinite where it does not end, shape (2,) [m].
        tiles: Edges of its tiles, shape (2,) [m].
        colors: Red, green, blue in [0, 1] of the two kinds of tiles, shape (2, 3).
        shadow: How dark it is, shape (n, n) in [0, 1]; of shape (0, 0) without shadows.
        square: First and second coordinate of the middle of the shadow, and half the edge of its
            square, shape (3,) [m].
        owner: What the plane belongs to.
    """

    position: Floats
    rotation: Floats
    halves: Floats
    tiles: Floats
    colors: Floats
    shadow: Floats
    square: Floats
    owner: int


@njit(cache=True, error_model="numpy")
def _projected(mesh: Triangles, view: View) -> Floats:
    """Give the homogeneous pixels of the vertices, shape (n, 3)."""
    p, r, o = view.projection, mesh.rotation, mesh.position
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
def _between(a: float, b: float, c: float, size: int) -> tuple[int, int]:
    """Give the first whole number from the least of three on, and the last plus one, in range."""
    first, last = max(min(a, b, c), 0.0), min(max(a, b, c), size - 1.0)
    if first > last:
        return 0, 0
    return math.ceil(first), int(last) + 1


@njit(cache=True, error_model="numpy")
def draw_mesh(mesh: Triangles, view: View, light: Floats, alpha: float, canvas: Canvas) -> None:
    """Draw triangles over what is there, where they are nearer. Both of their sides are seen.

    The triangle with the homogeneous pixels a, b, c covers the pixel q where the products of q
    with b × c, c × a and a × b have the sign of a · (b × c); it is seen from outside if that is
    negative.

    Args:
        mesh: What to draw.
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
    height, width = depth.shape
    colored, owned = rgb.shape[1] > 0, alpha == 1.0 and owners.shape[0] > 0
    color = (255.0 * mesh.color[0], 255.0 * mesh.color[1], 255.0 * mesh.color[2])
    rotation = mesh.rotation
    lx = rotation[0, 0] * light[0] + rotation[1, 0] * light[1] + rotation[2, 0] * light[2]
    ly = rotation[0, 1] * light[0] + rotation[1, 1] * light[1] + rotation[2, 1] * light[2]
    lz = rotation[0, 2] * light[0] + rotation[1, 2] * light[1] + rotation[2, 2] * light[2]
    pixels, near = _projected(mesh, view), view.near
    for f in range(len(mesh.faces)):
        a0, a1, a2 = pixels[mesh.faces[f, 0]]
        b0, b1, b2 = pixels[mesh.faces[f, 1]]
        c0, c1, c2 = pixels[mesh.faces[f, 2]]
        if a2 > near and b2 > near and c2 > near:
            left, right = _between(a0 / a2, b0 / b2, c0 / c2, width)
            top, bottom = _between(a1 / a2, b1 / b2, c1 / c2, height)
            if left >= right or top >= bottom:
                continue
        elif a2 > near or b2 > near or c2 > near:
            left, right, top, bottom = 0, width, 0, height
        else:
            continue
        u0, u1, u2 = b1 * c2 - b2 * c1, b2 * c0 - b0 * c2, b0 * c1 - b1 * c0
        v0, v1, v2 = c1 * a2 - c2 * a1, c2 * a0 - c0 * a2, c0 * a1 - c1 * a0
        w0, w1, w2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
        volume = a0 * u0 + a1 * u1 + a2 * u2
        if volume == 0.0:
            continue
        side = 1.0 if volume > 0.0 else -1.0
        for v in range(top, bottom):
            for u in range(left, right):
                first = side * (u * u0 + v * u1 + u2)
                second = side * (u * v0 + v * v1 + v2)
                third = side * (u * w0 + v * w1 + w2)
                if first < 0.0 or second < 0.0 or third < 0.0:
                    continue
                t = np.float32(side * volume / (first + second + third))
                if not t >= near:
                    continue
                if alpha < 1.0:
                    if t != depth[v, u]:
                        continue
                    depth[v, u] = -math.inf
                else:
                    if not t < depth[v, u]:
                        continue
                    depth[v, u] = t
                if colored:
                    n = mesh.normals[f]
                    x = first * n[0, 0] + second * n[1, 0] + third * n[2, 0]
                    y = first * n[0, 1] + second * n[1, 1] + third * n[2, 1]
                    z = first * n[0, 2] + second * n[1, 2] + third * n[2, 2]
                    length = math.sqrt(x * x + y * y + z * z)
                    cosine = -side * (x * lx + y * ly + z * lz) / max(length, 1e-300)
                    blend(rgb, v, u, color, brightness(cosine, light[3]), alpha)
                if owned:
                    owners[v, u] = mesh.owner


@njit(cache=True, error_model="numpy")
def draw_ground(
    ground: Ground, view: View, light: Floats, alpha: float, canvas: Canvas
) -> None:
    """Draw a plane over what is there, where it is nearer.

    Tiles fade into one color where they are smaller than a pixel.

    Args:
        ground: What to draw.
        view: The rays of the pixels.
        light: Unit vector towards the light, and the ambient brightness, shape (4,).
        alpha: Opacity. Below 1 colors are blended, and depth and owners stay as they are.
        canvas: What to draw on.
    """
    depth, owners, rgb = canvas
    colored, solid = rgb.shape[1] > 0, alpha == 1.0
    owned = solid and owners.shape[0] > 0
    local, turn = np.zeros((6, 3)), ground.rotation
    for row in range(6):
        for i in range(3):
            x = view.rays[row, i] - (ground.position[i] if row == 0 else 0.0)
            for j in range(3):
                local[row, j] += turn[i, j] * x
    top = brightness(turn[0, 2] * light[0] + turn[1, 2] * light[1] + turn[2, 2] * light[2], light[3])
    dark = SHADOW * (1.0 - light[3])
    ox, oy, oz = local[0]
    pixel = math.sqrt(local[4, 0] ** 2 + local[4, 1] ** 2 + local[4, 2] ** 2)
    halves, tiles, square = ground.halves, ground.tiles, ground.square
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            dz = local[3, 2] + u * local[4, 2] + v * local[5, 2]
            if not oz > 0.0 > dz:
                continue
            t = -oz / dz
            if not view.near <= t < depth[v, u]:
                continue
            dx = local[3, 0] + u * local[4, 0] + v * local[5, 0]
            dy = local[3, 1] + u * local[4, 1] + v * local[5, 1]
            x, y = ox + t * dx, oy + t * dy
            if abs(x) > halves[0] or abs(y) > halves[1]:
                continue
            if colored:
                spread = t * pixel * math.sqrt(dx * dx + dy * dy + dz * dz) / -dz
                odd = (math.floor(x / tiles[0]) + math.floor(y / tiles[1])) % 2.0
                clear = max(1.0 - spread / min(tiles[0], tiles[1]), 0.0)
                other = 0.5 + clear * (odd - 0.5)
                a, b = ground.colors[0], ground.colors[1]
                color = (
                    255.0 * (a[0] + other * (b[0] - a[0])),
                    255.0 * (a[1] + other * (b[1] - a[1])),
                    255.0 * (a[2] + other * (b[2] - a[2])),
                )
                shade = top
                x, y = x - square[0], y - square[1]
                if abs(x) < square[2] and abs(y) < square[2]:
                    shade *= 1.0 - dark * shade_at(ground.shadow, square[2], x, y)
                blend(rgb, v, u, color, shade, alpha)
            if solid:
                depth[v, u] = t
            if owned:
                owners[v, u] = ground.owner
