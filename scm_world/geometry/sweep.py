"""Which of many boxes and capsules intersect, in one compiled pass.

Bodies are numbered: first the boxes that can move, then the bodies made of capsules, then the
boxes that cannot, then the floor (the plane z = 0) and the wall (see ``penetration``). Several
capsules may belong to one body; the deepest counts. Every box that can move is compared with
everything; further comparisons of a capsule are up to its flags. What cannot move is
not compared with one another.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scm_world._types import Floats, Integers
from scm_world.geometry.penetration import (
    box_box_kernel,
    box_capsule_kernel,
    box_floor_kernel,
    box_wall_kernel,
    capsule_capsule_kernel,
    capsule_floor_kernel,
    capsule_wall_kernel,
)
from scm_world.geometry.rotations import rotation_kernel

OTHERS, FLOOR, WALL = 1, 2, 4
"""Flags: compare a capsule with those of other groups that have this flag, and with the boxes that
cannot move; with the floor; with the wall."""


class Found(NamedTuple):
    """Pairs of bodies that intersect.

    Attributes:
        pairs: Numbers of the bodies, the lower one first, in ascending order, shape (n, 2).
        depths: Shape (n,) [m].
    """

    pairs: Integers
    depths: Floats


@njit(cache=True)
def _deepen(table: Floats, allowed: Floats, first: int, second: int, depth: float) -> bool:
    """Note a depth for two bodies, unless a greater one is known; tell whether it is too deep."""
    low, high = min(first, second), max(first, second)
    table[low, high] = max(table[low, high], depth)
    return bool(depth > allowed[low, high])


@njit(cache=True)
def _far(one: Floats, its_end: Floats, other: Floats, other_end: Floats, reach: float) -> bool:
    """Tell whether the middles of two segments are farther apart than a distance [m]."""
    total = 0.0
    for k in range(3):
        total += (one[k] + its_end[k] - other[k] - other_end[k]) ** 2
    return total > 4.0 * reach * reach


@njit(cache=True)
def _half_length(start: Floats, end: Floats) -> float:
    """Compute half the length of a segment [m]."""
    total = 0.0
    for k in range(3):
        total += (end[k] - start[k]) ** 2
    return 0.5 * math.sqrt(total)


@njit(cache=True)
def _place_capsules(
    capsules: Floats, members: Integers, origins: Floats, orientations: Floats, ends: Floats
) -> None:
    """Write both ends of every capsule in the world, shape (m, 2, 3) [m]."""
    rotation = np.empty((3, 3))
    for c in range(len(capsules)):
        frame = members[c, 0]
        rotation_kernel(orientations[frame], rotation)
        for end in range(2):
            for k in range(3):
                ends[c, end, k] = origins[frame, k]
                for axis in range(3):
                    ends[c, end, k] += rotation[k, axis] * capsules[c, 3 * end + axis]


@njit(cache=True)
def _sweep_boxes(
    halves: Floats,
    centers: Floats,
    rotations: Floats,
    n_fixed: int,
    inner: float,
    height: float,
    table: Floats,
    allowed: Floats,
) -> bool:
    """Compare the boxes that can move with all boxes, the floor and the wall.

    The wall has no upper end for a box whose center is beyond it: that one has left the arena.
    """
    floor = len(table) - 2
    n_movable = len(halves) - n_fixed
    for i in range(n_movable):
        half, center, rotation = halves[i], centers[i], rotations[i]
        for j in range(i):
            depth = box_box_kernel(half, center, rotation, halves[j], centers[j], rotations[j])
            if _deepen(table, allowed, i, j, depth):
                return False
        for j in range(n_movable, len(halves)):
            depth = box_box_kernel(half, center, rotation, halves[j], centers[j], rotations[j])
            if _deepen(table, allowed, i, floor - len(halves) + j, depth):
                return False
        if _deepen(table, allowed, i, floor, box_floor_kernel(half, center, rotation)):
            return False
        top = math.inf if math.hypot(center[0], center[1]) > inner else height
        depth = box_wall_kernel(half, center, rotation, inner, top)
        if _deepen(table, allowed, i, floor + 1, depth):
            return False
    return True


@njit(cache=True)
def _sweep_capsules(
    capsules: Floats,
    members: Integers,
    ends: Floats,
    first_body: int,
    inner: float,
    height: float,
    table: Floats,
    allowed: Floats,
) -> bool:
    """Compare the capsules with one another, the floor and the wall, as far as flags say."""
    floor = len(table) - 2
    lengths = np.empty(len(capsules))
    for c in range(len(capsules)):
        lengths[c] = _half_length(ends[c, 0], ends[c, 1])
    for c in range(len(capsules)):
        body, group, flags = first_body + members[c, 1], members[c, 2], members[c, 3]
        start, end, radius = ends[c, 0], ends[c, 1], capsules[c, 6]
        if flags & FLOOR:
            depth = capsule_floor_kernel(start, end, radius)
            if _deepen(table, allowed, body, floor, depth):
                return False
        if flags & WALL:
            depth = capsule_wall_kernel(start, end, radius, inner, height)
            if _deepen(table, allowed, body, floor + 1, depth):
                return False
        for d in range(c):
            if flags & members[d, 3] & OTHERS and members[d, 2] != group:
                reach = lengths[c] + lengths[d] + radius + capsules[d, 6]
                if _far(start, end, ends[d, 0], ends[d, 1], reach):
                    continue
                depth = capsule_capsule_kernel(
                    start, end, radius, ends[d, 0], ends[d, 1], capsules[d, 6]
                )
                if _deepen(table, allowed, body, first_body + members[d, 1], depth):
                    return False
    return True


@njit(cache=True)
def _depths(
    sizes: Floats,
    positions: Floats,
    orientations: Floats,
    capsules: Floats,
    members: Integers,
    frame_origins: Floats,
    frame_orientations: Floats,
    n_fixed: int,
    wall: tuple[float, float],
    allowed: Floats,
) -> tuple[Floats, bool]:
    """Compute how deep bodies lie in one another, shape (bodies, bodies); see ``sweep``.

    Of bodies that are far apart nothing is computed. It ends, and says False, with the first two
    that lie deeper in one another than is allowed, shape (bodies, bodies).
    """
    n_boxes, n_bodies = len(sizes), 0
    n_movable = n_boxes - n_fixed
    for c in range(len(members)):
        n_bodies = max(n_bodies, members[c, 1] + 1)
    table = np.full((n_boxes + n_bodies + 2, n_boxes + n_bodies + 2), -np.inf)
    halves, rotations = 0.5 * sizes, np.empty((n_boxes, 3, 3))
    for i in range(n_boxes):
        rotation_kernel(orientations[i], rotations[i])
    ends = np.empty((len(capsules), 2, 3))
    _place_capsules(capsules, members, frame_origins, frame_orientations, ends)
    inner, height = wall
    if not _sweep_capsules(
        capsules, members, ends, n_movable, inner, height, table, allowed
    ) or not _sweep_boxes(halves, positions, rotations, n_fixed, inner, height, table, allowed):
        return table, False
    for i in range(n_boxes):
        number = i if i < n_movable else n_bodies + i
        radius = math.sqrt(halves[i, 0] ** 2 + halves[i, 1] ** 2 + halves[i, 2] ** 2)
        for c in range(len(capsules)):
            if i >= n_movable and not members[c, 3] & OTHERS:
                continue
            reach = radius + _half_length(ends[c, 0], ends[c, 1]) + capsules[c, 6]
            if _far(positions[i], positions[i], ends[c, 0], ends[c, 1], reach):
                continue
            depth = box_capsule_kernel(
                halves[i], positions[i], rotations[i], ends[c, 0], ends[c, 1], capsules[c, 6]
            )
            if _deepen(table, allowed, number, n_movable + members[c, 1], depth):
                return table, False
    return table, True


@njit(cache=True)
def apart_in_rows(
    sizes: Floats,
    positions: Floats,
    orientations: Floats,
    capsules: Floats,
    members: Integers,
    frame_origins: Floats,
    frame_orientations: Floats,
    n_fixed: int,
    wall: tuple[float, float],
    allowed: Floats,
) -> NDArray[np.bool_]:
    """Tell of many scenes whether no two bodies lie too deep in one another; see ``sweep``.

    Args:
        sizes: Shape (n or 1, boxes, 3) [m], where 1 is for boxes that are alike in all scenes.
        positions: Shape (n or 1, boxes, 3) [m].
        orientations: Shape (n or 1, boxes, 4).
        capsules: See ``sweep``.
        members: See ``sweep``.
        frame_origins: Shape (n, k, 3) [m].
        frame_orientations: Shape (n, k, 4).
        n_fixed: How many boxes cannot move.
        wall: Inner radius and height [m].
        allowed: How deep each two may lie in one another, shape (bodies, bodies) [m].

    Returns:
        Shape (n,).
    """
    found = np.ones(len(frame_origins), dtype=np.bool_)
    for row in range(len(found)):
        _, found[row] = _depths(
            sizes[min(row, len(sizes) - 1)],
            positions[min(row, len(positions) - 1)],
            orientations[min(row, len(orientations) - 1)],
            capsules,
            members,
            frame_origins[row],
            frame_orientations[row],
            n_fixed,
            wall,
            allowed,
        )
    return found


def sweep(
    sizes: Floats,
    positions: Floats,
    orientations: Floats,
    capsules: Floats,
    members: Integers,
    frame_origins: Floats,
    frame_orientations: Floats,
    *,
    n_fixed: int,
    wall: tuple[float, float],
    tolerance: float,
) -> Found:
    """Find all bodies that intersect.

    The arrays must be writable and contiguous: the kernel is compiled for nothing else.

    Args:
        sizes: Full edge lengths of the boxes, those last that cannot move, shape (n, 3) [m].
        positions: Their centers, shape (n, 3) [m].
        orientations: Their quaternions (x, y, z, w), shape (n, 4).
        capsules: Start, end and radius in a frame, shape (m, 7) [m].
        members: For each capsule the number of its frame, of its body (from zero), of its group,
            and its flags, shape (m, 4).
        frame_origins: Shape (k, 3) [m].
        frame_orientations: Quaternions (x, y, z, w), shape (k, 4).
        n_fixed: How many boxes cannot move.
        wall: Inner radius and height [m].
        tolerance: Only deeper intersections are found [m]; not negative.

    Returns:
        The pairs and their depths.
    """
    bodies = sizes, positions, orientations, capsules, members, frame_origins, frame_orientations
    count = len(sizes) + int(members[:, 1].max(initial=-1)) + 3
    table, _ = _depths(*bodies, n_fixed, wall, np.full((count, count), np.inf))
    deep = table > tolerance  # above the diagonal only
    return Found(np.argwhere(deep), table[deep])
