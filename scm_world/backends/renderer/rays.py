"""Rays against solids, one at a time.

A ray is ``origin + t * direction``. Directions are not normalized: t is the depth along the
optical axis. Solids are convex, so a ray enters and leaves at most once. A ray that starts within
a solid meets it from inside.

No kernel reorders floating-point arithmetic, so pictures are equal bit for bit between processes.
"""

from __future__ import annotations

import math

from numba import njit

Triple = tuple[float, float, float]
Hit = tuple[float, float, float, float]
"""The depth at which a ray is seen to meet a surface, and the normal towards the ray."""


@njit(cache=True, error_model="numpy")
def hit_box(o: Triple, d: Triple, near: float) -> Hit:
    """Meet the cube from -1 to 1."""
    (ox, oy, oz), (dx, dy, dz) = o, d
    enter, leave, enter_axis, leave_axis = -math.inf, math.inf, 0, 0
    for axis in range(3):
        a, b = (ox, dx) if axis == 0 else ((oy, dy) if axis == 1 else (oz, dz))
        if b == 0.0:
            if abs(a) > 1.0:
                return math.inf, 0.0, 0.0, 0.0
            continue
        inverse = 1.0 / b
        middle, half = -a * inverse, abs(inverse)
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
def hit_ball(o: Triple, d: Triple, near: float) -> Hit:
    """Meet the unit ball."""
    (ox, oy, oz), (dx, dy, dz) = o, d
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
def _capsule_side(o: Triple, d: Triple, half: float, side: float) -> float:
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
def hit_capsule(o: Triple, d: Triple, half: float, near: float) -> Hit:
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
def hit_cylinder(o: Triple, d: Triple, half: float, near: float) -> Hit:
    """Meet the cylinder of radius 1 from -half to half along z."""
    a = d[0] * d[0] + d[1] * d[1]
    b = o[0] * d[0] + o[1] * d[1]
    c = o[0] * o[0] + o[1] * o[1] - 1.0
    discriminant = b * b - a * c
    if discriminant < 0.0 or (a == 0.0 and c > 0.0) or (d[2] == 0.0 and abs(o[2]) > half):
        return math.inf, 0.0, 0.0, 0.0
    root = math.sqrt(discriminant)
    enter = (-b - root) / a if a > 0.0 else -math.inf
    leave = (-b + root) / a if a > 0.0 else math.inf
    middle = -o[2] / d[2] if d[2] != 0.0 else 0.0
    reach = half / abs(d[2]) if d[2] != 0.0 else math.inf
    first, last = max(enter, middle - reach), min(leave, middle + reach)
    if first > last or last < near:
        return math.inf, 0.0, 0.0, 0.0
    t, side = (first, 1.0) if first >= near else (last, -1.0)
    if t == (enter if side > 0.0 else leave):
        return t, side * (o[0] + t * d[0]), side * (o[1] + t * d[1]), 0.0
    return t, 0.0, 0.0, -math.copysign(1.0, d[2])
