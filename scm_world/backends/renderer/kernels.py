"""Solids and planes onto pixels.

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
from numba import njit
from numpy.typing import NDArray

from scm_world._types import Floats, Integers
from scm_world.models.camera import Camera
from scm_world.models.shapes import BOX, CAPSULE, CYLINDER, ELLIPSOID, PLANE, ShapeTable

Depths = NDArray[np.float32]
Owners = NDArray[np.int32]
Colors = NDArray[np.uint8]
Triple = tuple[float, float, float]
Hit = tuple[float, float, float, float]
"""The depth at which a ray is seen to meet a surface, and the normal towards the ray; for a plane,
two coordinates of the point where it is met."""

EDGE = 0.06  # how wide the edge of a silhouette is, in halves of its size
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
    """What has been seen so far, and how large the picture is.

    Attributes:
        depth: Shape (h, w).
        owners: Shape (h, w), or (0, 0) if they are not needed.
        rgb: Shape (3, h, w), or (3, 0, 0) if they are not needed.
    """

    depth: Depths
    owners: Owners
    rgb: Colors


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


NO_SHADOW = np.zeros((0, 0)), np.zeros(3)
NO_GROUND = Ground(np.ones(2), np.zeros(3), *NO_SHADOW)
NO_OWNERS = np.zeros((0, 0), dtype=np.int32)
NO_COLORS = np.zeros((3, 0, 0), dtype=np.uint8)


@njit(cache=True, error_model="numpy")
def projected(vertices: Floats, position: Floats, rotation: Floats, view: View) -> Floats:
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
def bounds(corners: Floats, near: float, shape: tuple[int, int]) -> tuple[int, int, int, int]:
    """Bound the pixels between corners: first and last column plus one, the same for rows.

    Args:
        corners: Homogeneous pixels, shape (k, 3).
        near: Smallest depth that is seen. What is partly nearer can cover any pixel.
        shape: Height and width of the picture.
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
    """Bound the pixels a shape can cover by the box around it; see ``bounds``."""
    halves = shapes.halves[n]
    if shapes.kinds[n] == PLANE and min(halves[0], halves[1]) <= 0.0:
        return 0, shape[1], 0, shape[0]
    corners = np.empty((8, 3))
    for corner in range(8):
        for k in range(3):
            corners[corner, k] = halves[k] if (corner >> k) & 1 else -halves[k]
    return bounds(
        projected(corners, shapes.positions[n], shapes.rotations[n], view), view.near, shape
    )


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
        rays[row, 0] + u * rays[row + 1, 0] + v * rays[row + 2, 0],
        rays[row, 1] + u * rays[row + 1, 1] + v * rays[row + 2, 1],
        rays[row, 2] + u * rays[row + 1, 2] + v * rays[row + 2, 2],
    )


@njit(cache=True, error_model="numpy")
def _along_row(rays: Floats, v: int) -> tuple[Triple, Triple, Triple, Triple]:
    """Compute origin and direction of the first ray of a row, and how they grow per column."""
    o, d = _ray(rays, 0, 0.0, v), _ray(rays, 3, 0.0, v)
    return o, d, (rays[1, 0], rays[1, 1], rays[1, 2]), (rays[4, 0], rays[4, 1], rays[4, 2])


@njit(cache=True, error_model="numpy")
def _at(first: Triple, step: Triple, u: float) -> Triple:
    """Step along a row."""
    return first[0] + u * step[0], first[1] + u * step[1], first[2] + u * step[2]


@njit(cache=True, error_model="numpy")
def _dot(a: Triple, b: Triple, third: float) -> float:
    """Multiply vectors; the third components count only as much as ``third``, 0 or 1."""
    return a[0] * b[0] + a[1] * b[1] + third * a[2] * b[2]


@njit(cache=True, error_model="numpy")
def _round_span(rays: Floats, v: int, third: float, left: int, right: int) -> tuple[int, int]:
    """Bound the columns of a row whose rays can meet a ball or an endless cylinder of radius 1.

    The discriminant of the intersection is a quadratic in the column. One more column on either
    side makes up for rounding.

    Args:
        rays: In the frame of the shape, shape (6, 3).
        v: The row.
        third: 1 for a ball, 0 for a cylinder along z.
        left: First column of the rectangle.
        right: Last column of the rectangle plus one.
    """
    o, d, step_o, step_d = _along_row(rays, v)
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
def byte(color: float) -> int:
    """Round a color to what a pixel can hold."""
    return int(min(max(color, 0.0), 255.0) + 0.5)


@njit(cache=True, error_model="numpy")
def brightness(cosine: float, ambient: float) -> float:
    """Shade a surface by the cosine to the light; softer than Lambert on the far side."""
    return ambient + (1.0 - ambient) * (0.5 + 0.5 * cosine)


@njit(cache=True, error_model="numpy")
def _shadow_at(ground: Ground, hit: Floats) -> float:
    """Read the shadow map of a plane between its texels; beside its square there is no shadow."""
    x, y, half = hit[1] - ground.square[0], hit[2] - ground.square[1], ground.square[2]
    size, shadow = ground.shadow.shape[0], ground.shadow
    if size == 0 or not (abs(x) < half and abs(y) < half):
        return 0.0
    scale = 0.5 / half * (size - 1.001)  # the last texel has none beyond
    u, v = max(x + half, 0.0) * scale, max(y + half, 0.0) * scale
    i, j = min(int(v), size - 2), min(int(u), size - 2)
    u, v = u - j, v - i
    upper = shadow[i, j] * (1.0 - u) + shadow[i, j + 1] * u
    lower = shadow[i + 1, j] * (1.0 - u) + shadow[i + 1, j + 1] * u
    shade: float = upper * (1.0 - v) + lower * v
    return shade


@njit(cache=True, error_model="numpy")
def _opacity(kind: int, point: Triple) -> float:
    """Make edges of boxes visible in silhouettes: twice as opaque where sides meet.

    The point is on the cube from -1 to 1.
    """
    if kind != BOX:
        return 1.0
    x, y, z = point
    edge = 1.0 - EDGE
    return 1.0 if (abs(x) > edge) + (abs(y) > edge) + (abs(z) > edge) < 2 else 2.0


@njit(cache=True, error_model="numpy")
def _scale(shapes: ShapeTable, n: int) -> tuple[Floats, float]:
    """Compute the unit of length in the frame of a shape, and half the length of what is round."""
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
def turned(rotation: Floats, vector: Floats) -> Triple:
    """Express a direction of the world in the frame of a shape."""
    x = rotation[0, 0] * vector[0] + rotation[1, 0] * vector[1] + rotation[2, 0] * vector[2]
    y = rotation[0, 1] * vector[0] + rotation[1, 1] * vector[1] + rotation[2, 1] * vector[2]
    z = rotation[0, 2] * vector[0] + rotation[1, 2] * vector[1] + rotation[2, 2] * vector[2]
    return x, y, z


@njit(cache=True, error_model="numpy")
def _cosine(kind: int, n: Triple, scale: Floats, lamp: Triple) -> float:
    """Compute the cosine between a normal and the light, both in the frame of the shape.

    The normal of a scaled ball, divided by the scale, is normal to the ellipsoid; those of
    other shapes have unit length as they are.
    """
    if kind != ELLIPSOID:
        return n[0] * lamp[0] + n[1] * lamp[1] + n[2] * lamp[2]
    x, y, z = n[0] / scale[0], n[1] / scale[1], n[2] / scale[2]
    product: float = x * lamp[0] + y * lamp[1] + z * lamp[2]
    return product / math.sqrt(x * x + y * y + z * z)


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

    Args:
        o: Origin of the ray.
        d: Its direction.
        first: The coordinates from this one on are between -half and half.
        half: See ``first``.
        near: Smallest depth that is seen.
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
def _meet_row(
    shapes: ShapeTable, n: int, measures: tuple[float, float], rays: Floats, v: int,
    span: tuple[int, int], hits: Floats,
) -> None:  # fmt: skip
    """Write where the rays of a row meet a shape, shape (w, 4); one loop per kind is faster."""
    kind, (near, half) = shapes.kinds[n], measures
    o, d, step_o, step_d = _along_row(rays, v)
    if kind in (ELLIPSOID, CAPSULE):
        for u in range(span[0], span[1]):
            _write(hits, u, _hit_round(_at(o, step_o, u), _at(d, step_d, u), half, near))
    elif kind == BOX:
        for u in range(span[0], span[1]):
            _write(hits, u, _hit_flat(_at(o, step_o, u), _at(d, step_d, u), 0, 1.0, near))
    elif kind == CYLINDER:
        for u in range(span[0], span[1]):
            _write(hits, u, _hit_flat(_at(o, step_o, u), _at(d, step_d, u), 2, half, near))
    else:
        for u in range(span[0], span[1]):
            hit = _hit_plane(_at(o, step_o, u), _at(d, step_d, u), shapes.halves[n], near)
            _write(hits, u, hit)


@njit(cache=True, error_model="numpy")
def _write(hits: Floats, u: int, hit: Hit) -> None:
    """Note one hit."""
    hits[u, 0], hits[u, 1], hits[u, 2], hits[u, 3] = hit


@njit(cache=True, error_model="numpy")
def _tint(ground: Ground, color: Floats, halves: Floats, hit: Floats, spread: float) -> Triple:
    """Compute the color, 255 where it is full, of a point of a plane that a pixel spreads over.

    Tiles fade into one color where they are smaller than a pixel.
    """
    left, back, tiles, other = -halves[0], halves[1], ground.tiles, ground.other
    odd = (math.floor((hit[1] - left) / tiles[0]) + math.floor((back - hit[2]) / tiles[1])) % 2.0
    clear = max(1.0 - spread / min(tiles[0], tiles[1]), 0.0)
    share = 0.5 + clear * (odd - 0.5)
    return (
        255.0 * (color[0] + share * (other[0] - color[0])),
        255.0 * (color[1] + share * (other[1] - color[1])),
        255.0 * (color[2] + share * (other[2] - color[2])),
    )


@njit(cache=True, error_model="numpy")
def blend(rgb: Colors, v: int, u: int, color: Triple, light: float, paint: float) -> None:
    """Blend a color, 255 where it is full, with what a pixel shows."""
    if paint == 1.0:
        rgb[0, v, u] = byte(light * color[0])
        rgb[1, v, u] = byte(light * color[1])
        rgb[2, v, u] = byte(light * color[2])
        return
    rest, light = 1.0 - paint, light * paint
    rgb[0, v, u] = byte(rest * rgb[0, v, u] + light * color[0])
    rgb[1, v, u] = byte(rest * rgb[1, v, u] + light * color[1])
    rgb[2, v, u] = byte(rest * rgb[2, v, u] + light * color[2])


@njit(cache=True, error_model="numpy")
def _draw_one(
    shapes: ShapeTable,
    n: int,
    ground: Ground,
    view: View,
    light: Floats,
    alpha: float,
    canvas: Canvas,
) -> None:
    """Draw one shape where it is nearer than what is there; see ``draw``."""
    depth, owners, rgb = canvas
    left, right, top, bottom = _rectangle(shapes, n, view, depth.shape)
    kind, halves, (scale, half) = shapes.kinds[n], shapes.halves[n], _scale(shapes, n)
    tint = shapes.colors[n]
    color = (255.0 * tint[0], 255.0 * tint[1], 255.0 * tint[2])
    solid, behind = alpha == 1.0, 0.0 if alpha == 1.0 else TIE
    colored, owned = rgb.shape[1] > 0, solid and owners.shape[0] > 0
    lamp, dark = turned(shapes.rotations[n], light), SHADOW * (1.0 - light[3])
    rays = _to_frame(shapes.positions[n], shapes.rotations[n], view.rays, scale)
    pixel = math.sqrt(rays[4, 0] ** 2 + rays[4, 1] ** 2 + rays[4, 2] ** 2)
    hits = np.empty((depth.shape[1], 4))
    for v in range(top, bottom):
        start, stop = left, right
        if kind in (CAPSULE, CYLINDER, ELLIPSOID):
            start, stop = _round_span(rays, v, 1.0 if kind == ELLIPSOID else 0.0, left, right)
        _meet_row(shapes, n, (view.near, half), rays, v, (start, stop), hits)
        for u in range(start, stop):
            t = hits[u, 0]
            if t + behind >= depth[v, u]:
                continue
            if colored and kind == PLANE:
                x, y, z = _ray(rays, 3, u, v)
                spread = t * pixel * math.sqrt(x * x + y * y + z * z) / -z
                shade = brightness(lamp[2], light[3]) * (1.0 - dark * _shadow_at(ground, hits[u]))
                blend(rgb, v, u, _tint(ground, tint, halves, hits[u], spread), shade, alpha)
            elif colored:
                normal = (hits[u, 1], hits[u, 2], hits[u, 3])
                cosine = _cosine(kind, normal, scale, lamp)
                paint = alpha
                if not solid:
                    point = _at(_ray(rays, 0, u, v), _ray(rays, 3, u, v), t)
                    paint = min(paint * _opacity(kind, point), 1.0)
                blend(rgb, v, u, color, brightness(cosine, light[3]), paint)
            if solid:
                depth[v, u] = t
            if owned:
                owners[v, u] = shapes.bodies[n]


@njit(cache=True, error_model="numpy")
def draw(
    shapes: ShapeTable,
    which: Integers,
    ground: Ground,
    view: View,
    light: Floats,
    alpha: float,
    canvas: Canvas,
) -> None:
    """Draw solids and planes over what is there, where they are nearer.

    Args:
        shapes: What there is.
        which: Rows of what to draw, in this order; no meshes.
        ground: What lies on the planes among them.
        view: The rays of the pixels.
        light: Unit vector towards the light, and the ambient brightness, shape (4,).
        alpha: Opacity. Below 1 colors are blended, and depth and owners stay as they are.
        canvas: What to draw on.
    """
    for n in which:
        _draw_one(shapes, n, ground, view, light, alpha, canvas)


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
    """Compute a ray towards the light for each point of a grid on the floor.

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
