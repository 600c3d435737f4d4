"""How deep two bodies lie in one another.

Every depth is positive where the bodies intersect. Where they do not it is zero or negative, and
minus it is a lower bound of their distance. Capsules are all points within a radius of a segment.

A body stands in the *wall*, a ring that begins at an inner radius and ends at a height, by the
smaller of two lengths: how far it reaches beyond the radius below the height, and how far it
would have to be lifted to clear the height. Outward the wall has no end.

Source:
    Gottschalk, Lin, Manocha, "OBBTree", SIGGRAPH 1996 (15 axes for two boxes).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from scm_world._types import ArrayLike, Floats
from scm_world.geometry.arrays import compact
from scm_world.geometry.rotations import rotation_kernel
from scm_world.geometry.segments import into_frame, segment_box_distance, segment_segment_distance

PARALLEL = 1e-12
"""Squared sine below which two edges count as parallel; the faces then decide."""

GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
SAMPLES = 12
REFINEMENTS = 24  # golden sections: 0.618^24 of two samples is below 2e-6 of the segment


@njit(cache=True)
def _faces_depth(half_a: Floats, half_b: Floats, cosines: Floats, offset: Floats) -> float:
    """Give the least depth along the six face normals; see ``_edges_depth``."""
    depth = math.inf
    for i in range(3):
        reach_a, reach_b, along_b = half_a[i], half_b[i], 0.0
        for j in range(3):
            reach_a += abs(cosines[i, j]) * half_b[j]
            reach_b += abs(cosines[j, i]) * half_a[j]
            along_b += cosines[j, i] * offset[j]
        depth = min(depth, reach_a - abs(offset[i]), reach_b - abs(along_b))
    return depth


@njit(cache=True)
def _edges_depth(half_a: Floats, half_b: Floats, cosines: Floats, offset: Floats) -> float:
    """Give the least depth along the nine products of two edges.

    Args:
        half_a: Half edge lengths of the first box, shape (3,) [m].
        half_b: Half edge lengths of the second box, shape (3,) [m].
        cosines: Axes of the second box in the frame of the first, as columns, shape (3, 3).
        offset: Center of the second box in the frame of the first, shape (3,) [m].
    """
    depth = math.inf
    for i in range(3):
        p, q = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            r, s = (j + 1) % 3, (j + 2) % 3
            squared_sine = cosines[p, j] ** 2 + cosines[q, j] ** 2
            if squared_sine < PARALLEL:
                continue
            reach = half_a[p] * abs(cosines[q, j]) + half_a[q] * abs(cosines[p, j])
            reach += half_b[r] * abs(cosines[i, s]) + half_b[s] * abs(cosines[i, r])
            gap = abs(offset[q] * cosines[p, j] - offset[p] * cosines[q, j])
            depth = min(depth, (reach - gap) / math.sqrt(squared_sine))
    return depth


@njit(cache=True)
def box_box_kernel(
    half_a: Floats,
    center_a: Floats,
    rotation_a: Floats,
    half_b: Floats,
    center_b: Floats,
    rotation_b: Floats,
) -> float:
    """Measure how far two boxes must be moved to come apart [m].

    Args:
        half_a: Half edge lengths, shape (3,) [m].
        center_a: Shape (3,) [m].
        rotation_a: Its axes as columns, shape (3, 3).
        half_b: As ``half_a``, of the second box.
        center_b: As ``center_a``.
        rotation_b: As ``rotation_a``.
    """
    cosines, offset = np.empty((3, 3)), np.empty(3)
    offset[0], offset[1], offset[2] = into_frame(center_b, center_a, rotation_a)
    for i in range(3):
        for j in range(3):
            cosines[i, j] = 0.0
            for k in range(3):
                cosines[i, j] += rotation_a[k, i] * rotation_b[k, j]
    depth = _faces_depth(half_a, half_b, cosines, offset)
    if depth <= 0.0:
        return depth
    return min(depth, _edges_depth(half_a, half_b, cosines, offset))


@njit(cache=True)
def box_capsule_kernel(
    half: Floats, center: Floats, rotation: Floats, start: Floats, end: Floats, radius: float
) -> float:
    """Measure how deep a capsule lies in a box [m].

    Args:
        half: Half edge lengths of the box, shape (3,) [m].
        center: Of the box, shape (3,) [m].
        rotation: Axes of the box as columns, shape (3, 3).
        start: Of the segment, shape (3,) [m].
        end: Of the segment, shape (3,) [m].
        radius: Of the capsule [m].
    """
    between, length, diagonal = 0.0, 0.0, 0.0
    for k in range(3):
        between += (0.5 * (start[k] + end[k]) - center[k]) ** 2
        length += (end[k] - start[k]) ** 2
        diagonal += half[k] ** 2
    apart = math.sqrt(between) - 0.5 * math.sqrt(length) - math.sqrt(diagonal) - radius
    if apart > 0.0:
        return -apart
    inner = into_frame(start, center, rotation), into_frame(end, center, rotation)
    return radius - segment_box_distance(inner[0], inner[1], half)


@njit(cache=True)
def capsule_capsule_kernel(
    start_a: Floats,
    end_a: Floats,
    radius_a: float,
    start_b: Floats,
    end_b: Floats,
    radius_b: float,
) -> float:
    """Measure how deep two capsules lie in one another [m]: always exact."""
    return radius_a + radius_b - segment_segment_distance(start_a, end_a, start_b, end_b)


@njit(cache=True)
def box_floor_kernel(half: Floats, center: Floats, rotation: Floats) -> float:
    """Measure how deep the lowest corner of a box lies below z = 0 [m]."""
    depth = -center[2]
    for k in range(3):
        depth += abs(rotation[2, k]) * half[k]
    return float(depth)


@njit(cache=True)
def capsule_floor_kernel(start: Floats, end: Floats, radius: float) -> float:
    """Measure how deep the lowest point of a capsule lies below z = 0 [m]."""
    return float(radius - min(start[2], end[2]))


@njit(cache=True)
def _write_corners(half: Floats, center: Floats, rotation: Floats, corners: Floats) -> None:
    """Write the corners of a box, shape (8, 3) [m]; bit k of the index is the sign of axis k."""
    for c in range(8):
        for k in range(3):
            corners[c, k] = center[k]
            for axis in range(3):
                sign = 1.0 if c & (1 << axis) else -1.0
                corners[c, k] += sign * half[axis] * rotation[k, axis]


@njit(cache=True)
def box_wall_kernel(
    half: Floats, center: Floats, rotation: Floats, inner: float, height: float
) -> float:
    """Measure how deep a box stands in the wall [m].

    The distance from the axis is convex, so it is greatest at a corner of the part below the
    height: a corner of the box, or where an edge passes the height.
    """
    diagonal = math.sqrt(half[0] ** 2 + half[1] ** 2 + half[2] ** 2)
    from_axis = math.hypot(center[0], center[1])
    if from_axis + diagonal < inner:
        return from_axis + diagonal - inner
    corners, reach, lowest = np.empty((8, 3)), 0.0, math.inf
    _write_corners(half, center, rotation, corners)
    for c in range(8):
        lowest = min(lowest, corners[c, 2])
        if corners[c, 2] <= height:
            reach = max(reach, math.hypot(corners[c, 0], corners[c, 1]))
        for axis in range(3):
            d = c ^ (1 << axis)
            if corners[c, 2] <= height < corners[d, 2]:
                along = (height - corners[c, 2]) / (corners[d, 2] - corners[c, 2])
                x = corners[c, 0] + along * (corners[d, 0] - corners[c, 0])
                y = corners[c, 1] + along * (corners[d, 1] - corners[c, 1])
                reach = max(reach, math.hypot(x, y))
    if lowest > height:
        return height - lowest
    return min(reach - inner, height - lowest)


@njit(cache=True)
def _into_wall(start: Floats, end: Floats, along: float, inner: float, height: float) -> float:
    """Measure how deep one point of a segment lies in the wall; minus its distance outside."""
    x = start[0] + along * (end[0] - start[0])
    y = start[1] + along * (end[1] - start[1])
    beyond = math.hypot(x, y) - inner
    below = height - start[2] - along * (end[2] - start[2])
    if beyond > 0.0 and below > 0.0:
        return float(min(beyond, below))
    return -math.hypot(min(beyond, 0.0), min(below, 0.0))


@njit(cache=True)
def capsule_wall_kernel(
    start: Floats, end: Floats, radius: float, inner: float, height: float
) -> float:
    """Measure how deep a capsule lies in the wall [m].

    It is exact to 1e-6 m for a segment of the robot's size; where the capsule is wholly within the
    radius or above the height it is minus a lower bound of the distance.
    """
    outermost = max(math.hypot(start[0], start[1]), math.hypot(end[0], end[1])) + radius
    lowest = min(start[2], end[2]) - radius
    if outermost <= inner or lowest >= height:
        return float(min(outermost - inner, height - lowest))
    best, deepest = 0.0, -math.inf
    for sample in range(SAMPLES + 1):
        depth = _into_wall(start, end, sample / SAMPLES, inner, height)
        if depth > deepest:
            best, deepest = sample / SAMPLES, depth
    low, high = max(best - 1.0 / SAMPLES, 0.0), min(best + 1.0 / SAMPLES, 1.0)
    for _ in range(REFINEMENTS):
        left, right = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
        depth_left = _into_wall(start, end, left, inner, height)
        depth_right = _into_wall(start, end, right, inner, height)
        if depth_left > depth_right:
            high = right
        else:
            low = left
        deepest = max(deepest, depth_left, depth_right)
    return radius + deepest


def box_capsule(
    size: ArrayLike,
    position: ArrayLike,
    orientation: ArrayLike,
    start: ArrayLike,
    end: ArrayLike,
    radius: float,
) -> float:
    """Measure how deep a capsule lies in a box.

    Args:
        size: Full edge lengths of the box, shape (3,) [m].
        position: Its center, shape (3,) [m].
        orientation: Its quaternion (x, y, z, w).
        start: Of the segment of the capsule, shape (3,) [m].
        end: Of the segment, shape (3,) [m].
        radius: Of the capsule [m].

    Returns:
        The depth [m]: the radius less the distance of the segment, or the radius plus the depth
        of the segment's deepest point below the nearest face. Exact to rounding wherever the
        spheres around both bodies meet, else minus a lower bound of the distance.
    """
    rotation = np.empty((3, 3))
    rotation_kernel(compact(orientation), rotation)
    box = 0.5 * compact(size), compact(position), rotation
    return float(box_capsule_kernel(*box, compact(start), compact(end), float(radius)))
