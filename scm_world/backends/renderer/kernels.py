"""Rays against solids, pixel by pixel.

Every pixel (column u, row v) has a ray ``origin + t * direction``. Both are affine in u and v,
which covers a pinhole camera (one origin) as well as parallel light (one direction). Solids are
convex, so a ray enters and leaves at most once. Directions are not normalized: t is the depth
along the optical axis.

No kernel reorders floating-point arithmetic, so pictures are equal bit for bit between processes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.backends.renderer.bodies import BOX, ELLIPSOID, FLOOR, NOTHING, STAGE, Bodies
from scm_world.scene.scene import WALL_HEIGHT, WALL_RADIUS

Depths = NDArray[np.float32]
Owners = NDArray[np.int32]
Colors = NDArray[np.uint8]
Hit = tuple[float, float, float, float]
"""The depth at which a ray is seen to meet a surface, and the normal towards the ray."""

AMBIENT = 0.3  # what a surface shows that is turned away from the light
EDGE = 0.94  # where the edge of a silhouette begins, in halves of its size
TIE = 1e-5  # [m] what lies this close to a silhouette is drawn over it
SHADOW = 0.45  # how much of a color a full shadow takes away


class View(NamedTuple):
    """Rays of the pixels of one picture.

    Attributes:
        rays: Origin and its growth per column and row, direction and its growth per column and
            row, shape (6, 3).
        projection: From homogeneous world points to homogeneous pixels (u, v), shape (3, 4).
        light: Unit vector towards the light, shape (3,).
        near: Smallest depth that is seen.
    """

    rays: Floats
    projection: Floats
    light: Floats
    near: float


@njit(cache=True, error_model="numpy")
def _hit_box(ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, near: float) -> Hit:
    """Meet the cube from -1 to 1."""
    enter, leave, enter_axis, leave_axis = -math.inf, math.inf, 0, 0
    for axis in range(3):
        o, d = (ox, dx) if axis == 0 else ((oy, dy) if axis == 1 else (oz, dz))
        if d == 0.0:
            if abs(o) > 1.0:
                return math.inf, 0.0, 0.0, 0.0
            continue
        middle, half = -o / d, abs(1.0 / d)
        if middle - half > enter:
            enter, enter_axis = middle - half, axis
        if middle + half < leave:
            leave, leave_axis = middle + half, axis
    if enter > leave or leave < near:
        return math.inf, 0.0, 0.0, 0.0
    t, axis = (enter, enter_axis) if enter >= near else (leave, leave_axis)
    return (
        t,
        -math.copysign(1.0, dx) if axis == 0 else 0.0,
        -math.copysign(1.0, dy) if axis == 1 else 0.0,
        -math.copysign(1.0, dz) if axis == 2 else 0.0,
    )


@njit(cache=True, error_model="numpy")
def _hit_ball(ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, near: float) -> Hit:
    """Meet the unit ball."""
    a = dx * dx + dy * dy + dz * dz
    b = ox * dx + oy * dy + oz * dz
    discriminant = b * b - a * (ox * ox + oy * oy + oz * oz - 1.0)
    if discriminant < 0.0:
        return math.inf, 0.0, 0.0, 0.0
    root = math.sqrt(discriminant)
    t, side = (-b - root) / a, 1.0
    if t < near:
        t, side = (-b + root) / a, -1.0
    if t < near:
        return math.inf, 0.0, 0.0, 0.0
    return t, side * (ox + t * dx), side * (oy + t * dy), side * (oz + t * dz)


@njit(cache=True, error_model="numpy")
def _capsule_side(
    o: tuple[float, float, float], d: tuple[float, float, float], half: float, side: float
) -> float:
    """Find where a ray enters (side -1) or leaves (side 1) a capsule of radius 1 along z.

    Where the ray meets the endless cylinder beyond the end of the segment, it is the ball at that
    end which it meets, if any.
    """
    a = max(d[0] * d[0] + d[1] * d[1], 1e-300)  # a ray along the axis meets it far, far away
    b = o[0] * d[0] + o[1] * d[1]
    discriminant = b * b - a * (o[0] * o[0] + o[1] * o[1] - 1.0)
    if discriminant < 0.0:
        return math.inf
    t = (-b + side * math.sqrt(discriminant)) / a
    z = o[2] + t * d[2]
    if abs(z) <= half:
        return t
    height = o[2] - math.copysign(half, z)
    a += d[2] * d[2]
    b += height * d[2]
    discriminant = b * b - a * (o[0] * o[0] + o[1] * o[1] + height * height - 1.0)
    if discriminant < 0.0:
        return math.inf
    return (-b + side * math.sqrt(discriminant)) / a


@njit(cache=True, error_model="numpy")
def _hit_capsule(
    o: tuple[float, float, float], d: tuple[float, float, float], half: float, near: float
) -> Hit:
    """Meet the capsule of radius 1 around the segment from -half to half along z."""
    t, side = _capsule_side(o, d, half, -1.0), 1.0
    if t < near:
        t, side = _capsule_side(o, d, half, 1.0), -1.0
    if t < near or t == math.inf:
        return math.inf, 0.0, 0.0, 0.0
    z = o[2] + t * d[2]
    z -= min(max(z, -half), half)
    return t, side * (o[0] + t * d[0]), side * (o[1] + t * d[1]), side * z


@njit(cache=True, error_model="numpy")
def _rectangle(
    bodies: Bodies, n: int, view: View, width: int, height: int
) -> tuple[int, int, int, int]:
    """Bound the pixels a body can cover: first and last column plus one, the same for rows."""
    left, right, top, bottom = math.inf, -math.inf, math.inf, -math.inf
    ahead = 0
    for corner in range(8):
        u, v, w = view.projection[0, 3], view.projection[1, 3], view.projection[2, 3]
        for i in range(3):
            x = bodies.centers[n, i]
            for j in range(3):
                sign = 1.0 if (corner >> j) & 1 else -1.0
                x += sign * bodies.rotations[n, i, j] * bodies.halves[n, j]
            u += view.projection[0, i] * x
            v += view.projection[1, i] * x
            w += view.projection[2, i] * x
        if w > view.near:
            ahead += 1
            left, right = min(left, u / w), max(right, u / w)
            top, bottom = min(top, v / w), max(bottom, v / w)
    if ahead == 0:
        return 0, 0, 0, 0
    if ahead < 8:
        return 0, width, 0, height
    first, last = max(left, 0.0), min(right, width - 1.0)
    upper, lower = max(top, 0.0), min(bottom, height - 1.0)
    if first > last or upper > lower:
        return 0, 0, 0, 0
    return int(first), math.ceil(last) + 1, int(upper), math.ceil(lower) + 1


@njit(cache=True, error_model="numpy")
def _to_body(bodies: Bodies, n: int, rays: Floats, scale: Floats) -> Floats:
    """Express the rays in the frame of a body, in units of ``scale``, shape (6, 3)."""
    local = np.zeros((6, 3))
    for i in range(3):
        for j in range(3):
            for row in range(6):
                x = rays[row, i] - (bodies.centers[n, i] if row == 0 else 0.0)
                local[row, j] += bodies.rotations[n, i, j] * x / scale[j]
    return local


@njit(cache=True, error_model="numpy")
def _brightness(cosine: float) -> float:
    """Shade a surface by the cosine to the light; softer than Lambert on the far side."""
    return AMBIENT + (1.0 - AMBIENT) * (0.5 + 0.5 * cosine)


@njit(cache=True, error_model="numpy")
def _byte(color: float) -> int:
    """Round a color to what a pixel can hold."""
    return int(min(max(color, 0.0), 255.0) + 0.5)


@njit(cache=True, error_model="numpy")
def _opacity(shape: int, x: float, y: float, z: float, alpha: float) -> float:
    """Give silhouettes of boxes visible edges; the point is on the cube from -1 to 1."""
    if alpha == 1.0 or shape != BOX:
        return alpha
    near_faces = (abs(x) > EDGE) + (abs(y) > EDGE) + (abs(z) > EDGE)
    return alpha if near_faces < 2 else 2.0 * alpha


@njit(cache=True, error_model="numpy")
def _scale(bodies: Bodies, n: int) -> tuple[Floats, float]:
    """Give the unit of length in the frame of a body, and half the segment of a capsule in it."""
    scale = bodies.halves[n].copy()
    if bodies.shapes[n] == BOX or bodies.shapes[n] == ELLIPSOID:
        return scale, 0.0
    segment = scale[2] / scale[0] - 1.0
    scale[2] = scale[0]
    return scale, segment


@njit(cache=True, error_model="numpy")
def _turned(rotation: Floats, vector: Floats) -> tuple[float, float, float]:
    """Express a direction of the world in the frame of a body."""
    x = rotation[0, 0] * vector[0] + rotation[1, 0] * vector[1] + rotation[2, 0] * vector[2]
    y = rotation[0, 1] * vector[0] + rotation[1, 1] * vector[1] + rotation[2, 1] * vector[2]
    z = rotation[0, 2] * vector[0] + rotation[1, 2] * vector[1] + rotation[2, 2] * vector[2]
    return x, y, z


@njit(cache=True, error_model="numpy")
def _draw_body(
    bodies: Bodies, n: int, view: View, alpha: float, depth: Depths, owners: Owners, rgb: Colors
) -> None:
    """Draw one body where it is nearer than what is there; see ``draw``."""
    left, right, top, bottom = _rectangle(bodies, n, view, depth.shape[1], depth.shape[0])
    shape, (scale, segment) = bodies.shapes[n], _scale(bodies, n)
    behind = 0.0 if alpha == 1.0 else TIE
    lamp = _turned(bodies.rotations[n], view.light)
    r = _to_body(bodies, n, view.rays, scale)
    for v in range(top, bottom):
        met = False
        for u in range(left, right):
            ox = r[0, 0] + u * r[1, 0] + v * r[2, 0]
            oy = r[0, 1] + u * r[1, 1] + v * r[2, 1]
            oz = r[0, 2] + u * r[1, 2] + v * r[2, 2]
            dx = r[3, 0] + u * r[4, 0] + v * r[5, 0]
            dy = r[3, 1] + u * r[4, 1] + v * r[5, 1]
            dz = r[3, 2] + u * r[4, 2] + v * r[5, 2]
            if shape == BOX:
                t, nx, ny, nz = _hit_box(ox, oy, oz, dx, dy, dz, view.near)
            elif shape == ELLIPSOID:
                t, nx, ny, nz = _hit_ball(ox, oy, oz, dx, dy, dz, view.near)
            else:
                t, nx, ny, nz = _hit_capsule((ox, oy, oz), (dx, dy, dz), segment, view.near)
            if t == math.inf:
                if met:
                    break  # solids are convex: the row will not meet it again
                continue
            met = True
            if t + behind < depth[v, u]:
                # The normal of the scaled body, divided by the scale, is normal to the body.
                nx, ny, nz = nx / scale[0], ny / scale[1], nz / scale[2]
                length = math.sqrt(nx * nx + ny * ny + nz * nz)
                light = _brightness((nx * lamp[0] + ny * lamp[1] + nz * lamp[2]) / length)
                paint = _opacity(shape, ox + t * dx, oy + t * dy, oz + t * dz, alpha)
                for i in range(3):
                    color = 255.0 * light * bodies.colors[n, i]
                    rgb[v, u, i] = _byte(rgb[v, u, i] * (1.0 - paint) + color * paint)
                if alpha == 1.0:
                    depth[v, u], owners[v, u] = t, bodies.owners[n]


@njit(cache=True, error_model="numpy")
def draw(
    bodies: Bodies, view: View, alpha: float, depth: Depths, owners: Owners, rgb: Colors
) -> None:
    """Draw solids over what is there, where they are nearer.

    Args:
        bodies: What to draw, in this order.
        view: The rays of the pixels.
        alpha: Opacity. Below 1 colors are blended, and depth and owners stay as they are.
        depth: Shape (h, w), what has been seen so far.
        owners: Shape (h, w), of what has been seen so far.
        rgb: Shape (h, w, 3).
    """
    for n in range(len(bodies.shapes)):
        _draw_body(bodies, n, view, alpha, depth, owners, rgb)


@njit(cache=True, error_model="numpy")
def _shade_at(shadow: Floats, x: float, y: float) -> float:
    """Read the shadow map between its texels."""
    size = shadow.shape[0]
    u = (x + WALL_RADIUS) * (0.5 / WALL_RADIUS * (size - 1.001))  # the last texel has none beyond
    v = (y + WALL_RADIUS) * (0.5 / WALL_RADIUS * (size - 1.001))
    i, j = int(v), int(u)
    u, v = u - j, v - i
    upper = shadow[i, j] * (1.0 - u) + shadow[i, j + 1] * u
    lower = shadow[i + 1, j] * (1.0 - u) + shadow[i + 1, j + 1] * u
    shade: float = upper * (1.0 - v) + lower * v
    return shade


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
def draw_arena(
    view: View, colors: Floats, shadow: Floats, depth: Depths, owners: Owners, rgb: Colors
) -> None:
    """Fill the pixels that show no body: with floor, wall or background.

    Args:
        view: The rays of the pixels; all from one origin.
        colors: Of the floor, of the wall and of the background, shape (3, 3).
        shadow: How dark the floor is, shape (m, m) in [0, 1], over the square around the ring.
        depth: Shape (h, w).
        owners: Shape (h, w).
        rgb: Shape (h, w, 3).
    """
    sun_x, sun_y = -view.light[0] / WALL_RADIUS, -view.light[1] / WALL_RADIUS
    top = _brightness(view.light[2])
    (ox, oy, oz), (ax, ay, az), (bx, by, bz) = view.rays[0], view.rays[4], view.rays[5]
    for v in range(depth.shape[0]):
        cx, cy, cz = view.rays[3, 0] + v * bx, view.rays[3, 1] + v * by, view.rays[3, 2] + v * bz
        for u in range(depth.shape[1]):
            if owners[v, u] != NOTHING:
                continue
            dx, dy, dz = cx + u * ax, cy + u * ay, cz + u * az
            t, owner = _hit_arena(ox, oy, oz, dx, dy, dz, view.near)
            light, row = 1.0, 2
            if t < depth[v, u]:
                depth[v, u], owners[v, u], row = t, owner, owner
                x, y = ox + t * dx, oy + t * dy
                if owner == FLOOR:
                    light = top * (1.0 - SHADOW * _shade_at(shadow, x, y))
                else:
                    light = _brightness(x * sun_x + y * sun_y)
            for i in range(3):
                rgb[v, u, i] = _byte(255.0 * light * colors[row, i])
