"""How far segments are from one another and from boxes, exactly, as kernels.

Points are triples of floats here, which a compiled kernel keeps in registers.

Source:
    Ericson, *Real-Time Collision Detection*, 2005, section 5.1.9 (two segments). The distance of
    a segment to a box is our own: along the segment its square is convex and its slope piecewise
    linear, so the zero of the slope is bracketed by the planes of the faces and then solved for.
"""

from __future__ import annotations

import math

from numba import njit

from scm_world._types import Floats

Point = tuple[float, float, float]
"""Coordinates [m]."""

ROUNDING = 1e-12
"""A point no farther outside a box than this [m] may be one that should be inside."""


@njit(cache=True)
def into_frame(point: Floats, center: Floats, rotation: Floats) -> Point:
    """Give the coordinates of a point of the world in a frame.

    Args:
        point: Shape (3,) [m].
        center: Origin of the frame, shape (3,) [m].
        rotation: Its axes as columns, shape (3, 3).
    """
    x, y, z = point[0] - center[0], point[1] - center[1], point[2] - center[2]
    return (
        rotation[0, 0] * x + rotation[1, 0] * y + rotation[2, 0] * z,
        rotation[0, 1] * x + rotation[1, 1] * y + rotation[2, 1] * z,
        rotation[0, 2] * x + rotation[1, 2] * y + rotation[2, 2] * z,
    )


@njit(cache=True)
def between(start: Point, end: Point, along: float) -> Point:
    """Give the point a fraction ``along`` of the way from start to end."""
    return (
        start[0] + along * (end[0] - start[0]),
        start[1] + along * (end[1] - start[1]),
        start[2] + along * (end[2] - start[2]),
    )


@njit(cache=True)
def point_segment_distance(point: Floats, start: Floats, end: Floats) -> float:
    """Measure the distance of a point to a segment; all of shape (3,) [m]."""
    length, along = 0.0, 0.0
    for k in range(3):
        length += (end[k] - start[k]) ** 2
        along += (point[k] - start[k]) * (end[k] - start[k])
    along = min(max(along / length, 0.0), 1.0) if length > 0.0 else 0.0
    squared = 0.0
    for k in range(3):
        squared += (start[k] + along * (end[k] - start[k]) - point[k]) ** 2
    return math.sqrt(squared)


@njit(cache=True, error_model="numpy")
def segment_segment_distance(
    start_a: Floats, end_a: Floats, start_b: Floats, end_b: Floats
) -> float:
    """Measure the distance of two segments, which may be parallel or points.

    The nearest points are ends of a segment, or both are inside; all five cases are measured.

    Args:
        start_a: Shape (3,) [m].
        end_a: Shape (3,) [m].
        start_b: Shape (3,) [m].
        end_b: Shape (3,) [m].
    """
    nearest = min(
        point_segment_distance(start_a, start_b, end_b),
        point_segment_distance(end_a, start_b, end_b),
        point_segment_distance(start_b, start_a, end_a),
        point_segment_distance(end_b, start_a, end_a),
    )
    aa, ab, bb, ao, bo = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        a, b, o = end_a[k] - start_a[k], end_b[k] - start_b[k], start_b[k] - start_a[k]
        aa, ab, bb = aa + a * a, ab + a * b, bb + b * b
        ao, bo = ao + a * o, bo + b * o
    squared_sine = aa * bb - ab * ab
    if squared_sine <= 1e-14 * aa * bb:  # parallel: one of the ends is as near as any point
        return nearest
    along_a, along_b = (ao * bb - bo * ab) / squared_sine, (ao * ab - bo * aa) / squared_sine
    if not (0.0 < along_a < 1.0 and 0.0 < along_b < 1.0):
        return nearest
    squared = 0.0
    for k in range(3):
        on_a = start_a[k] + along_a * (end_a[k] - start_a[k])
        squared += (start_b[k] + along_b * (end_b[k] - start_b[k]) - on_a) ** 2
    return min(nearest, math.sqrt(squared))


@njit(cache=True)
def _slope(start: Point, end: Point, half: Floats, along: float) -> float:
    """Differentiate half the squared distance to the box with respect to ``along``."""
    point, slope = between(start, end, along), 0.0
    for k in range(3):
        if point[k] > half[k]:
            slope += (point[k] - half[k]) * (end[k] - start[k])
        elif point[k] < -half[k]:
            slope += (point[k] + half[k]) * (end[k] - start[k])
    return slope


@njit(cache=True, error_model="numpy")
def _nearest_to_box(start: Point, end: Point, half: Floats) -> float:
    """Find where along a segment it is nearest to a box around the origin, in [0, 1]."""
    low, high = 0.0, 1.0
    slope_low, slope_high = _slope(start, end, half, low), _slope(start, end, half, high)
    if slope_low >= 0.0:
        return low
    if slope_high <= 0.0:
        return high
    for face in range(6):
        k, sign = face // 2, 1.0 - 2.0 * (face % 2)
        crossing = (sign * half[k] - start[k]) / (end[k] - start[k])  # infinite where parallel
        if low < crossing < high:
            slope = _slope(start, end, half, crossing)
            if slope < 0.0:
                low, slope_low = crossing, slope
            else:
                high, slope_high = crossing, slope
    return low - slope_low * (high - low) / (slope_high - slope_low)


@njit(cache=True)
def _inward(point: Point, half: Floats) -> float:
    """Measure how deep a point lies in a box; negative outside [m]."""
    x, y, z = point
    return float(min(half[0] - abs(x), half[1] - abs(y), half[2] - abs(z)))


@njit(cache=True, error_model="numpy")
def _deepest_in_box(start: Point, end: Point, half: Floats) -> float:
    """Measure how deep the deepest point of a segment lies below the nearest face [m].

    The depths below the six faces are linear along the segment, so the greatest least depth is
    at an end or where two of them are equal.
    """
    deepest = max(_inward(start, half), _inward(end, half))
    for f in range(6):
        i, sign_f = f // 2, 1.0 - 2.0 * (f % 2)
        for g in range(f):
            j, sign_g = g // 2, 1.0 - 2.0 * (g % 2)
            rise = sign_g * (end[j] - start[j]) - sign_f * (end[i] - start[i])
            equal = (half[j] - half[i] + sign_f * start[i] - sign_g * start[j]) / rise
            if 0.0 < equal < 1.0:
                deepest = max(deepest, _inward(between(start, end, equal), half))
    return deepest


@njit(cache=True)
def segment_box_distance(start: Point, end: Point, half: Floats) -> float:
    """Measure the signed distance of a segment to a box around the origin.

    Args:
        start: In the frame of the box [m].
        end: In the frame of the box [m].
        half: Half edge lengths of the box, shape (3,) [m].

    Returns:
        The distance [m]; where the segment enters the box, minus the depth of its deepest point
        below the nearest face.
    """
    point, squared = between(start, end, _nearest_to_box(start, end, half)), 0.0
    for k in range(3):
        squared += max(abs(point[k]) - half[k], 0.0) ** 2
    if squared > ROUNDING**2:
        return math.sqrt(squared)
    return -max(_deepest_in_box(start, end, half), 0.0)
