"""Triangles onto pixels; see ``kernels`` for solids and planes."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from scm_world._types import Floats
from scm_world.backends.renderer.kernels import (
    Canvas,
    Depths,
    Triple,
    View,
    blend,
    bounds,
    brightness,
    projected,
    turned,
)
from scm_world.models.shapes import Mesh, ShapeTable


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
    """Write b × c, c × a and a × b of the corners a, b and c, shape (3, 3); return a · (b × c)."""
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
    mesh: Mesh, shapes: ShapeTable, n: int, view: View, light: Floats, alpha: float, canvas: Canvas
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
    pixels, near = projected(mesh.vertices, shapes.positions[n], rotation, view), view.near
    corners, edges = np.empty((3, 3)), np.empty((3, 3))
    for f in range(len(mesh.faces)):
        for i in range(3):
            for k in range(3):
                corners[i, k] = pixels[mesh.faces[f, i], k]
        left, right, top, bottom = bounds(corners, near, depth.shape)
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
    """Compute the cosine between the light and the weighted mean of three normals."""
    a, b, c = weights
    x = a * normals[0, 0] + b * normals[1, 0] + c * normals[2, 0]
    y = a * normals[0, 1] + b * normals[1, 1] + c * normals[2, 1]
    z = a * normals[0, 2] + b * normals[1, 2] + c * normals[2, 2]
    length = max(math.sqrt(x * x + y * y + z * z), 1e-300)
    cosine: float = (x * lamp[0] + y * lamp[1] + z * lamp[2]) / length
    return cosine
