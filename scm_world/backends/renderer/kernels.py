"""Solids, planes and triangles onto pixels.

Every pixel (column u, row v) has a ray ``origin + t * direction``. Both are affine in u and v,
which covers a pinhole camera (one origin) as well as parallel light (one direction). Directions are
not normalized: t is the depth along the optical axis. Solids are convex, so a ray enters and leaves
at most once. A ray that starts within a solid meets it from inside.

No kernel reorders floating-point arithmetic, so pictures are equal bit for bit between processes.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats, Integers
from scm_world.geometry.numbers import njit
from scm_world.models.camera import Camera
from scm_world.models.shapes import BOX, CAPSULE, CYLINDER, ELLIPSOID, PLANE, Mesh, ShapeTable

Depths = NDArray[np.float32]
Owners = NDArray[np.int32]
Colors = NDArray[np.uint8]
Triple = tuple[float, float, float]
Hit = tuple[float, float, float, float]
"""The depth at which a ray is seen to meet a surface, and the normal towards the ray; for a plane,
two coordinates of the point where it is met."""

INNER = 1.0 - 0.06  # where the edge of a silhouette begins, in halves of its size
SHADOW = 0.45 / 0.7  # how much of the light that is not ambient a full shadow takes away
TIE = 1e-5  # [m] what lies this close to a silhouette is drawn over it


class View(NamedTuple):
    """Rays of the pixels of one picture.

    Attributes:
        rays: Origin and its growth per column and row, direction and its growth per column and
            row, shape (6, 3). The origin or the direction does not grow.
        projection: From homogeneous world points to homogeneous pixels (u, v), shape (3, 4).
        near: Smallest depth that is seen.
    """

    rays: Floats
    projection: Floats
    near: float


class Canvas(NamedTuple):
    """The image so far.

    Attributes:
        depth: Shape (h, w).
        owners: Bodies, shape (h, w).
        rgb: Shape (3, h, w), or (3, 0, 0) if they are not needed.
    """

    depth: Depths
    owners: Owners
    rgb: Colors


class Shadow(NamedTuple):
    """The shadow on a plane.

    Attributes:
        dark: How dark it is, shape (n, n) in [0, 1]; of shape (0, 0) without a shadow.
        square: First and second coordinate of its middle, and half the edge of its square,
            shape (3,) [m].
    """

    dark: Floats
    square: Floats


NO_SHADOW = Shadow(np.zeros((0, 0)), np.zeros(3))
NO_COLORS = np.zeros((3, 0, 0), dtype=np.uint8)


@njit(cache=True, error_model="numpy")
def _projected(vertices: Floats, position: Floats, rotation: Floats, view: View) -> Floats:
    """Compute the homogeneous pixels of points, shape (n, 3)."""
    p, r, o = view.projection, rotation, position
    matrix = np.empty((3, 4))
    for i in range(3):
        matrix[i, 3] = p[i, 0] * o[0] + p[i, 1] * o[1] + p[i, 2] * o[2] + p[i, 3]
        for j in range(3):
            matrix[i, j] = p[i, 0] * r[0, j] + p[i, 1] * r[1, j] + p[i, 2] * r[2, j]
    pixels = np.empty((len(vertices), 3))
    for n in range(len(pixels)):
        x, y, z = vertices[n]
        for i in range(3):
            pixels[n, i] = matrix[i, 0] * x + matrix[i, 1] * y + matrix[i, 2] * z + matrix[i, 3]
    return pixels


@njit(cache=True, error_model="numpy")
def _bounds(corners: Floats, near: float, shape: tuple[int, int]) -> tuple[int, int, int, int]:
    """Bound the pixels between corners, homogeneous pixels of shape (k, 3).

    First and last column plus one, the same for rows; a shape that is partly too near can
    cover any pixel.
    """
    height, width = shape
    left, right, top, bottom, ahead = math.inf, -math.inf, math.inf, -math.inf, 0
    for i in range(len(corners)):
        if corners[i, 2] > near:
            u, v = corners[i, 0] / corners[i, 2], corners[i, 1] / corners[i, 2]
            left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
            ahead += 1
    if ahead == 0:
        return 0, 0, 0, 0
    if ahead < len(corners):
        return 0, width, 0, height
    return (
        math.ceil(max(left, 0.0)), int(min(right, width - 1.0)) + 1,
        math.ceil(max(top, 0.0)), int(min(bottom, height - 1.0)) + 1,
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def _rectangle(
    shapes: ShapeTable, n: int, view: View, shape: tuple[int, int]
) -> tuple[int, int, int, int]:
    """Bound the pixels a shape can cover by the box around it; see ``_bounds``."""
    halves = shapes.halves[n]
    if shapes.kinds[n] == PLANE and min(halves[0], halves[1]) <= 0.0:
        return 0, shape[1], 0, shape[0]
    corners = np.empty((8, 3))
    for corner in range(8):
        for k in range(3):
            corners[corner, k] = halves[k] if (corner >> k) & 1 else -halves[k]
    pixels = _projected(corners, shapes.positions[n], shapes.rotations[n], view)
    return _bounds(pixels, view.near, shape)


@njit(cache=True, error_model="numpy")
def _to_frame(center: Floats, rotation: Floats, rays: Floats, scale: Floats) -> Floats:
    """Express rays in a frame of the world, in units of ``scale``, shape (6, 3)."""
    local = np.zeros((6, 3))
    for i in range(3):
        for j in range(3):
            for row in range(6):
                x = rays[row, i] - (center[i] if row == 0 else 0.0)
                local[row, j] += rotation[i, j] * x / scale[j]
    return local


@njit(cache=True, error_model="numpy")
def _ray(rays: Floats, row: int, u: float, v: float) -> Triple:
    """Compute the origin (row 0) or the direction (row 3) of the ray of a pixel."""
    return (
        rays[row, 0] + v * rays[row + 2, 0] + u * rays[row + 1, 0],
        rays[row, 1] + v * rays[row + 2, 1] + u * rays[row + 1, 1],
        rays[row, 2] + v * rays[row + 2, 2] + u * rays[row + 1, 2],
    )


@njit(cache=True, error_model="numpy")
def _dot(a: Triple, b: Triple, third: float) -> float:
    """Multiply vectors; the third components count only as much as ``third``, 0 or 1."""
    return a[0] * b[0] + a[1] * b[1] + third * a[2] * b[2]


@njit(cache=True, error_model="numpy")
def _round_span(rays: Floats, v: int, third: float, left: int, right: int) -> tuple[int, int]:
    """Bound the columns of a row whose rays can meet a ball (third 1) or an endless cylinder (0).

    Both have radius 1, the cylinder lies along z. The discriminant of the intersection is a
    quadratic in the column; one more column on either side makes up for rounding.
    """
    o, d = _ray(rays, 0, 0.0, v), _ray(rays, 3, 0.0, v)
    step_o, step_d = (rays[1, 0], rays[1, 1], rays[1, 2]), (rays[4, 0], rays[4, 1], rays[4, 2])
    a0, a1, a2 = _dot(d, d, third), 2.0 * _dot(d, step_d, third), _dot(step_d, step_d, third)
    b0, b1 = _dot(o, d, third), _dot(o, step_d, third) + _dot(step_o, d, third)
    c0, c1 = _dot(o, o, third) - 1.0, 2.0 * _dot(o, step_o, third)
    c2 = _dot(step_o, step_o, third)
    q0, q1 = b0 * b0 - a0 * c0, 2.0 * b0 * b1 - a0 * c1 - a1 * c0
    q2 = b1 * b1 - a0 * c2 - a1 * c1 - a2 * c0
    if q2 >= 0.0:
        return left, right
    squared = q1 * q1 - 4.0 * q2 * q0
    if squared < 0.0:
        return left, left
    middle, half = -0.5 * q1 / q2, -0.5 * math.sqrt(squared) / q2
    first, last = max(middle - half - 1.0, left), min(middle + half + 2.0, right)
    return (int(first), int(last)) if first < last else (left, left)


@njit(cache=True, error_model="numpy")
def _byte(color: float) -> int:
    """Round a color to what a pixel can hold."""
    return int(min(max(color, 0.0), 255.0) + 0.5)


@njit(cache=True, error_model="numpy")
def _brightness(cosine: float, ambient: float) -> float:
    """Shade a surface by the cosine to the light; softer than Lambert on the far side."""
    return ambient + (1.0 - ambient) * (0.5 + 0.5 * cosine)


@njit(cache=True, error_model="numpy")
def _shadow_at(shadow: Shadow, hit: Hit) -> float:
    """Read the shadow on a plane between its texels; beside its square there is none."""
    dark, square, size = shadow.dark, shadow.square, shadow.dark.shape[0]
    x, y, half = hit[1] - square[0], hit[2] - square[1], square[2]
    if size == 0 or not (abs(x) < half and abs(y) < half):
        return 0.0
    scale = 0.5 / half * (size - 1.001)  # the last texel has none beyond
    u, v = max(x + half, 0.0) * scale, max(y + half, 0.0) * scale
    i, j = min(int(v), size - 2), min(int(u), size - 2)
    u, v = u - j, v - i
    upper = dark[i, j] * (1.0 - u) + dark[i, j + 1] * u
    lower = dark[i + 1, j] * (1.0 - u) + dark[i + 1, j + 1] * u
    shade: float = upper * (1.0 - v) + lower * v
    return shade


@njit(cache=True, error_model="numpy")
def _scale(shapes: ShapeTable, n: int) -> tuple[Floats, float]:
    """Compute the unit of length in the frame of a shape, and half the length of round shapes."""
    if shapes.kinds[n] == PLANE:
        return np.ones(3), 0.0
    scale = shapes.halves[n].copy()
    if shapes.kinds[n] not in (CAPSULE, CYLINDER):
        return scale, 0.0
    segment = scale[2] / scale[0]
    if shapes.kinds[n] == CAPSULE:
        segment -= 1.0
    scale[2] = scale[0]
    return scale, segment


@njit(cache=True, error_model="numpy")
def _turned(rotation: Floats, vector: Floats) -> Triple:
    """Express a direction of the world in the frame of a shape."""
    x = rotation[0, 0] * vector[0] + rotation[1, 0] * vector[1] + rotation[2, 0] * vector[2]
    y = rotation[0, 1] * vector[0] + rotation[1, 1] * vector[1] + rotation[2, 1] * vector[2]
    z = rotation[0, 2] * vector[0] + rotation[1, 2] * vector[1] + rotation[2, 2] * vector[2]
    return x, y, z


@njit(cache=True, error_model="numpy")
def _cosine(x: float, y: float, z: float, lamp: Triple) -> float:
    """Compute the cosine between a normal of any length and the light."""
    length = max(math.sqrt(x * x + y * y + z * z), 1e-300)
    cosine: float = (x * lamp[0] + y * lamp[1] + z * lamp[2]) / length
    return cosine


@njit(cache=True, error_model="numpy")
def _round_side(o: Triple, d: Triple, half: float, side: float) -> float:
    """Find where a ray enters (side -1) or leaves (side 1) a capsule of radius 1 along z.

    Where the ray meets the endless cylinder beyond the end of the segment, from -half to half, it
    is the ball at that end which it meets, if any.
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
def _hit_round(o: Triple, d: Triple, half: float, near: float) -> Hit:
    """Meet the capsule of radius 1 around the segment from -half to half along z."""
    t, side = _round_side(o, d, half, -1.0), 1.0
    if t < near:
        t, side = _round_side(o, d, half, 1.0), -1.0
    if t < near or t == math.inf:
        return math.inf, 0.0, 0.0, 0.0
    z = o[2] + t * d[2]
    z -= min(max(z, -half), half)
    return t, side * (o[0] + t * d[0]), side * (o[1] + t * d[1]), side * z


@njit(cache=True, error_model="numpy")
def _hit_flat(o: Triple, d: Triple, first: int, half: float, near: float) -> Hit:
    """Meet the cube from -1 to 1 (first 0), or the cylinder of radius 1 along z (first 2).

    The coordinates from the first one on are between -half and half.
    """
    enter, leave, enter_axis, leave_axis = -math.inf, math.inf, 3, 3
    if first == 2:
        enter, leave = _round_side(o, d, math.inf, -1.0), _round_side(o, d, math.inf, 1.0)
    for axis in range(first, 3):
        if d[axis] == 0.0:
            if abs(o[axis]) > half:
                return math.inf, 0.0, 0.0, 0.0
            continue
        inverse = 1.0 / d[axis]
        middle, reach = -o[axis] * inverse, half * abs(inverse)
        if middle - reach > enter:
            enter, enter_axis = middle - reach, axis
        if middle + reach < leave:
            leave, leave_axis = middle + reach, axis
    if enter > leave or leave < near or enter == math.inf:
        return math.inf, 0.0, 0.0, 0.0
    t, axis, side = (enter, enter_axis, 1.0) if enter >= near else (leave, leave_axis, -1.0)
    if axis == 3:
        return t, side * (o[0] + t * d[0]), side * (o[1] + t * d[1]), 0.0
    return (
        t,
        -math.copysign(1.0, d[0]) if axis == 0 else 0.0,
        -math.copysign(1.0, d[1]) if axis == 1 else 0.0,
        -math.copysign(1.0, d[2]) if axis == 2 else 0.0,
    )


@njit(cache=True, error_model="numpy")
def _hit_plane(o: Triple, d: Triple, halves: Floats, near: float) -> Hit:
    """Meet the plane z = 0 from above, between its ends where it has any."""
    if not o[2] > 0.0 > d[2]:
        return math.inf, 0.0, 0.0, 0.0
    t = -o[2] / d[2]
    x, y = o[0] + t * d[0], o[1] + t * d[1]
    beyond = (halves[0] > 0.0 and abs(x) > halves[0]) or (halves[1] > 0.0 and abs(y) > halves[1])
    return (math.inf if beyond or t < near else t), x, y, 0.0


@njit(cache=True, error_model="numpy")
def _hit(shapes: ShapeTable, n: int, o: Triple, d: Triple, measures: tuple[float, float]) -> Hit:
    """Meet a solid or a plane, given the least depth and half the length of round shapes."""
    kind, (near, half) = shapes.kinds[n], measures
    if kind == BOX:
        return _hit_flat(o, d, 0, 1.0, near)
    if kind == CYLINDER:
        return _hit_flat(o, d, 2, half, near)
    if kind == PLANE:
        return _hit_plane(o, d, shapes.halves[n], near)
    return _hit_round(o, d, half, near)


@njit(cache=True, error_model="numpy")
def _tint(color: Floats, tiles: Floats, halves: Floats, hit: Hit, spread: float) -> Triple:
    """Compute the color, 255 where it is full, of a point of a plane that a pixel spreads over.

    Tiles fade into one color where they are smaller than a pixel.
    """
    left, back = -halves[0], halves[1]
    odd = (math.floor((hit[1] - left) / tiles[0]) + math.floor((back - hit[2]) / tiles[1])) % 2.0
    clear = max(1.0 - spread / min(tiles[0], tiles[1]), 0.0)
    share = 0.5 + clear * (odd - 0.5)
    return (
        255.0 * (color[0] + share * (tiles[2] - color[0])),
        255.0 * (color[1] + share * (tiles[3] - color[1])),
        255.0 * (color[2] + share * (tiles[4] - color[2])),
    )


@njit(cache=True, error_model="numpy")
def _blend(rgb: Colors, v: int, u: int, color: Triple, light: float, paint: float) -> None:
    """Blend a color, 255 where it is full, with what a pixel shows."""
    if paint == 1.0:
        rgb[0, v, u] = _byte(light * color[0])
        rgb[1, v, u] = _byte(light * color[1])
        rgb[2, v, u] = _byte(light * color[2])
        return
    rest, light = 1.0 - paint, light * paint
    rgb[0, v, u] = _byte(rest * rgb[0, v, u] + light * color[0])
    rgb[1, v, u] = _byte(rest * rgb[1, v, u] + light * color[1])
    rgb[2, v, u] = _byte(rest * rgb[2, v, u] + light * color[2])


@njit(cache=True, error_model="numpy")
def draw(
    shapes: ShapeTable,
    which: Integers,
    shadow: Shadow,
    view: View,
    light: Floats,
    alpha: float,
    canvas: Canvas,
) -> None:
    """Draw solids and planes, ``which`` of the shapes, over the image where they are nearer.

    ``light`` is the unit vector towards the light, and the ambient brightness, shape (4,). With an
    opacity ``alpha`` below 1 colors are blended, and depth and owners stay as they are.
    """
    depth, owners, rgb = canvas
    colored, solid, dark = rgb.shape[1] > 0, alpha == 1.0, SHADOW * (1.0 - light[3])
    behind = 0.0 if solid else TIE
    for n in which:
        left, right, top, bottom = _rectangle(shapes, n, view, depth.shape)
        kind, halves, (scale, half) = shapes.kinds[n], shapes.halves[n], _scale(shapes, n)
        tint, tiles, lamp = shapes.colors[n], shapes.tiles[n], _turned(shapes.rotations[n], light)
        color = (255.0 * tint[0], 255.0 * tint[1], 255.0 * tint[2])
        rays = _to_frame(shapes.positions[n], shapes.rotations[n], view.rays, scale)
        pixel = math.sqrt(rays[4, 0] ** 2 + rays[4, 1] ** 2 + rays[4, 2] ** 2)
        for v in range(top, bottom):
            start, stop = left, right
            if kind in (CAPSULE, CYLINDER, ELLIPSOID):
                third = 1.0 if kind == ELLIPSOID else 0.0
                start, stop = _round_span(rays, v, third, left, right)
            for u in range(start, stop):
                o, d = _ray(rays, 0, u, v), _ray(rays, 3, u, v)
                hit = _hit(shapes, n, o, d, (view.near, half))
                t = hit[0]
                if t + behind >= depth[v, u]:
                    continue
                if colored and kind == PLANE:
                    spread = t * pixel * math.sqrt(_dot(d, d, 1.0)) / -d[2]
                    shade = 1.0 - dark * _shadow_at(shadow, hit)
                    shade = _brightness(lamp[2], light[3]) * shade
                    _blend(rgb, v, u, _tint(tint, tiles, halves, hit, spread), shade, alpha)
                elif colored:
                    normal, paint = hit[1:], alpha
                    cosine = _dot(normal, lamp, 1.0)
                    if kind == ELLIPSOID:  # the normal of the scaled ball, divided by the scale
                        x, y, z = normal[0] / scale[0], normal[1] / scale[1], normal[2] / scale[2]
                        cosine = _cosine(x, y, z, lamp)
                    if kind == BOX and not solid:  # twice as opaque where sides meet
                        sides = 0
                        for axis in range(3):
                            sides += abs(o[axis] + t * d[axis]) > INNER
                        paint = min(alpha * (1.0 if sides < 2 else 2.0), 1.0)
                    _blend(rgb, v, u, color, _brightness(cosine, light[3]), paint)
                if solid:
                    depth[v, u], owners[v, u] = t, shapes.bodies[n]


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
    """Draw triangles over the image, where they are nearer. Both of their sides are seen.

    The triangle with the homogeneous pixels a, b, c covers the pixel q where the products of q
    with b × c, c × a and a × b have the sign of a · (b × c); it is seen from outside if that is
    negative. With an opacity below 1, ``canvas.depth`` has to hold the depth of the nearest shape,
    this mesh included; only where the mesh is nearest are colors blended, and the depth there is
    minus infinity afterwards. Owners stay as they are.

    Source:
        Olano and Greer, *Triangle scan conversion using 2D homogeneous coordinates*, 1997.
    """
    depth, owners, rgb = canvas
    colored, solid, tint = rgb.shape[1] > 0, alpha == 1.0, shapes.colors[n]
    color = (255.0 * tint[0], 255.0 * tint[1], 255.0 * tint[2])
    lamp = _turned(shapes.rotations[n], light)
    pixels = _projected(mesh.vertices, shapes.positions[n], shapes.rotations[n], view)
    corners, edges = np.empty((3, 3)), np.empty((3, 3))
    for f in range(len(mesh.faces)):
        for i in range(3):
            for k in range(3):
                corners[i, k] = pixels[mesh.faces[f, i], k]
        left, right, top, bottom = _bounds(corners, view.near, depth.shape)
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
                if not (t >= view.near and (t < depth[v, u] if solid else t == depth[v, u])):
                    continue
                depth[v, u] = t if solid else -math.inf
                if colored:
                    normals = mesh.normals[f]
                    x = a * normals[0, 0] + b * normals[1, 0] + c * normals[2, 0]
                    y = a * normals[0, 1] + b * normals[1, 1] + c * normals[2, 1]
                    z = a * normals[0, 2] + b * normals[1, 2] + c * normals[2, 2]
                    cosine = -side * _cosine(x, y, z, lamp)
                    _blend(rgb, v, u, color, _brightness(cosine, light[3]), alpha)
                if solid:
                    owners[v, u] = shapes.bodies[n]


@lru_cache(maxsize=64)
def camera_view(camera: Camera, samples: int) -> View:
    """Compute the rays of the samples of a pinhole camera. The arrays are shared."""
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
    """Compute a ray towards the light, at height one, for each of n by n points of a floor.

    ``half`` is half the edge of their square [m].
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
