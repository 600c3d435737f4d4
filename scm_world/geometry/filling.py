"""How much of the goals the blocks fill, exactly, also where goals or blocks intersect.

What is filled counts once, for the goal and the block that come first:

    V(∪G ∩ ∪B) = Σ_g Σ_b V(G_g ∩ B_b − (G_1 ∪ … ∪ G_{g-1} ∪ B_1 ∪ … ∪ B_{b-1})).

Where nothing intersects, the terms are overlaps of two boxes. Elsewhere the block is cut as five
tetrahedra: a plane makes at most six of one, whose volumes stay right however thin they are, so
that coplanar faces are no special case.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numba import njit

from scm_world._types import ArrayLike, Floats, Integers
from scm_world.geometry.arrays import copy_rows, rows
from scm_world.geometry.overlap import WORKSPACE, overlap_kernel
from scm_world.geometry.rotations import rotation_kernel

Boxes: TypeAlias = tuple[Floats, Floats, Floats]
"""Full edge lengths, centers and quaternions (x, y, z, w), shapes (n, 3), (n, 3), (n, 4)."""

SIDES = 6
NOTHING = 1e-15  # of the volume of a box: a piece of it that can be left out
_FIVE = np.array([[0, 3, 5, 6], [1, 0, 3, 5], [2, 0, 3, 6], [4, 0, 5, 6], [7, 3, 5, 6]])
_NONE: Any = np.int64(0)
_ONE: Any = np.int64(1)
"""No literals: numba would compile a kernel once more for each of them."""


@njit(cache=True)
def _planes(size: Floats, position: Floats, orientation: Floats, out: Floats) -> None:
    """Write normal and offset of the six sides; inside is ``normal · x <= offset``."""
    rotation = np.empty((3, 3))
    rotation_kernel(orientation, rotation)
    for axis in range(3):
        middle = 0.0
        for k in range(3):
            out[2 * axis, k] = rotation[k, axis]
            out[2 * axis + 1, k] = -rotation[k, axis]
            middle += rotation[k, axis] * position[k]
        out[2 * axis, 3] = 0.5 * size[axis] + middle
        out[2 * axis + 1, 3] = 0.5 * size[axis] - middle


@njit(cache=True)
def _tetrahedra(size: Floats, position: Floats, orientation: Floats, out: Floats) -> None:
    """Write a box as five tetrahedra, shape (5, 4, 3)."""
    rotation = np.empty((3, 3))
    rotation_kernel(orientation, rotation)
    for t in range(5):
        for n in range(4):
            for k in range(3):
                out[t, n, k] = position[k]
                for axis in range(3):
                    sign = 1.0 if (_FIVE[t, n] >> axis) & 1 else -1.0
                    out[t, n, k] += 0.5 * sign * size[axis] * rotation[k, axis]


@njit(cache=True)
def _volume(corners: Floats) -> float:
    """Give the volume of a tetrahedron, shape (4, 3)."""
    total = 0.0
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        total += (corners[1, k] - corners[0, k]) * (
            (corners[2, i] - corners[0, i]) * (corners[3, j] - corners[0, j])
            - (corners[2, j] - corners[0, j]) * (corners[3, i] - corners[0, i])
        )
    return abs(total) / 6.0


@njit(cache=True)
def _wedge(wedge: Floats, out: Floats) -> None:
    """Write a wedge between two triangles, shape (6, 3), as three tetrahedra."""
    for t in range(3):
        copy_rows(wedge[: 3 - t], out[t])
        copy_rows(wedge[5 - t :], out[t, 3 - t :])


@njit(cache=True)
def _between(corners: Floats, heights: Floats, p: int, q: int, out: Floats) -> None:
    """Write the point where the edge from p to q crosses the plane."""
    along = heights[p] / (heights[p] - heights[q])
    for k in range(3):
        out[k] = corners[p, k] + along * (corners[q, k] - corners[p, k])


@njit(cache=True)
def _sort(corners: Floats, plane: Floats, heights: Floats, order: Integers) -> int:
    """Measure four heights within a plane, list those inside first, and count them."""
    inside, beyond = 0, 4
    for n in range(4):
        heights[n] = plane[3]
        for k in range(3):
            heights[n] -= plane[k] * corners[n, k]
        if heights[n] >= 0.0:
            order[inside] = n
            inside += 1
        else:
            beyond -= 1
            order[beyond] = n
    return inside


@njit(cache=True, error_model="numpy")
def _split(corners: Floats, plane: Floats, out: Floats) -> int:
    """Cut a tetrahedron into at most six.

    Args:
        corners: Shape (4, 3).
        plane: Normal and offset, shape (4,).
        out: Where to write those inside from 0 on, those outside from 3 on, shape (6, 4, 3).

    Returns:
        How many are inside and, times ten, how many are outside.
    """
    heights, order = np.empty(4), np.empty(4, dtype=np.int64)
    inside = _sort(corners, plane, heights, order)
    if inside == 4:
        copy_rows(corners, out[0])
        return 1
    if inside == 0:
        copy_rows(corners, out[3])
        return 10
    wedge = np.empty((6, 3))
    if inside == 2:
        for side in range(2):
            here, there = 2 * side, 2 - 2 * side
            for n in range(2):
                p = order[here + n]
                copy_rows(corners[p : p + 1], wedge[3 * n :])
                for m in range(2):
                    _between(corners, heights, p, order[there + m], wedge[3 * n + 1 + m])
            _wedge(wedge, out[3 * side : 3 * side + 3])
        return 33
    alone, first, tip, rest = (0, 1, 0, 3) if inside == 1 else (3, 0, 3, 0)
    p = order[alone]
    copy_rows(corners[p : p + 1], out[tip])
    for n in range(3):
        q = order[first + n]
        copy_rows(corners[q : q + 1], wedge[n:])
        _between(corners, heights, p, q, wedge[3 + n])
    copy_rows(wedge[3:], out[tip, 1:])
    _wedge(wedge, out[rest : rest + 3])
    return 31 if inside == 1 else 13


@njit(cache=True)
def remainder_kernel(box: Floats, planes: Floats, kept: int) -> float:
    """Compute how much of a box lies in some boxes and in none of some others.

    Args:
        box: As tetrahedra, shape (5, 4, 3) [m].
        planes: Six of each of the other boxes, shape (6 n, 4).
        kept: How many of them, from the first on, it must lie in.

    Returns:
        The volume [m³].
    """
    stack = np.empty((5 + 6 * len(planes), 4, 3))
    at = np.zeros(len(stack), dtype=np.int64)  # the plane that comes next
    pieces, total, least = np.empty((6, 4, 3)), 0.0, 0.0
    for t in range(5):
        copy_rows(box[t], stack[t])
        least += NOTHING * _volume(box[t])
    height = 5
    while height > 0:
        height -= 1
        plane = at[height]
        if plane == len(planes):
            total += _volume(stack[height])
            continue
        must = plane // SIDES < kept
        count = _split(stack[height], planes[plane], pieces)
        last = plane % SIDES == SIDES - 1
        if must or not last:  # inside all six of a box that takes away, nothing remains
            for n in range(count % 10):
                if _volume(pieces[n]) > least:
                    copy_rows(pieces[n], stack[height])
                    at[height] = plane + 1
                    height += 1
        if not must:
            for n in range(count // 10):
                if _volume(pieces[3 + n]) > least:
                    copy_rows(pieces[3 + n], stack[height])
                    at[height] = SIDES * (plane // SIDES + 1)
                    height += 1
    return total


@njit(cache=True)
def _before(
    boxes: Boxes, i: int, candidates: Floats, planes: Floats, used: int, work: Floats
) -> int:
    """Write the sides of those candidates that come before a box and cross it.

    Args:
        boxes: Sizes, positions and quaternions.
        i: The box.
        candidates: Positive for each that counts, shape (n,).
        planes: Where to write them.
        used: How many rows hold planes already.
        work: Scratch of shape ``WORKSPACE``, overwritten.

    Returns:
        How many rows hold planes now.
    """
    sizes, positions, orientations = boxes
    box = (sizes[i], positions[i], orientations[i])
    least = NOTHING * sizes[i, 0] * sizes[i, 1] * sizes[i, 2]
    for j in range(i):
        if candidates[j] > 0.0:
            other = (sizes[j], positions[j], orientations[j])
            if overlap_kernel(*box, *other, work) > least:
                _planes(*other, planes[used : used + SIDES])
                used += SIDES
    return used


@njit(cache=True)
def overlap_fraction_kernel(
    sizes: Floats,
    positions: Floats,
    orientations: Floats,
    goal_sizes: Floats,
    goal_positions: Floats,
    goal_orientations: Floats,
) -> float:
    """Compute the fraction of the goals that the blocks fill; see ``overlap_fraction``.

    Args:
        sizes: Of the blocks, shape (n, 3) [m].
        positions: Of the blocks, shape (n, 3) [m].
        orientations: Of the blocks, shape (n, 4).
        goal_sizes: Shape (m, 3) [m].
        goal_positions: Shape (m, 3) [m].
        goal_orientations: Shape (m, 4).

    Returns:
        The fraction, in [0, 1].
    """
    blocks = (sizes, positions, orientations)
    goals = (goal_sizes, goal_positions, goal_orientations)
    work, tetrahedra = np.empty(WORKSPACE), np.empty((5, 4, 3))
    planes = np.empty((SIDES * (len(sizes) + len(goal_sizes)), 4))
    shared, others = np.empty(len(sizes)), np.ones(len(goal_sizes))
    wanted, filled = 0.0, 0.0
    for g in range(len(goal_sizes)):
        goal = (goal_sizes[g], goal_positions[g], goal_orientations[g])
        _planes(*goal, planes[:SIDES])
        first = _before(goals, g, others, planes, SIDES, work)
        if first == SIDES:
            wanted += goal_sizes[g, 0] * goal_sizes[g, 1] * goal_sizes[g, 2]
        else:
            _tetrahedra(*goal, tetrahedra)
            wanted += remainder_kernel(tetrahedra, planes[SIDES:first], _NONE)
        for b in range(len(sizes)):
            block = (sizes[b], positions[b], orientations[b])
            shared[b] = overlap_kernel(*block, *goal, work)
            if shared[b] == 0.0:
                continue
            used = _before(blocks, b, shared, planes, first, work)
            if used == SIDES:
                filled += shared[b]
            else:
                _tetrahedra(*block, tetrahedra)
                filled += remainder_kernel(tetrahedra, planes[:used], _ONE)
    return min(filled / wanted, 1.0) if wanted > 0.0 else 1.0


def overlap_fraction(
    sizes: ArrayLike,
    positions: ArrayLike,
    orientations: ArrayLike,
    goal_sizes: ArrayLike,
    goal_positions: ArrayLike,
    goal_orientations: ArrayLike,
) -> float:
    """Compute how much of the volume that the goals cover the blocks cover, too.

    It is the volume of what lies in a goal and in a block, divided by the volume of what lies in
    a goal. Nothing counts twice where bodies intersect, and the result is exact to rounding.

    Args:
        sizes: Full edge lengths of the blocks, shape (n, 3) [m].
        positions: Centers of the blocks, shape (n, 3) [m].
        orientations: Quaternions (x, y, z, w) of the blocks, shape (n, 4).
        goal_sizes: As ``sizes``, of the goals, shape (m, 3) [m].
        goal_positions: Shape (m, 3) [m].
        goal_orientations: Shape (m, 4).

    Returns:
        The fraction, dimensionless, in [0, 1]. A world without goals, or whose goals have no
        volume, is fulfilled: 1.0.

    Example:
        Two goals share a third of what they cover, and the block lies just there.

        >>> upright = [[0.0, 0.0, 0.0, 1.0]]
        >>> goals = ([[2.0, 1.0, 1.0]] * 2, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], upright * 2)
        >>> round(overlap_fraction([[1.0, 1.0, 1.0]], [[0.5, 0.0, 0.0]], upright, *goals), 12)
        0.333333333333

    Source:
        Ahmed et al., *CausalWorld*, ICLR 2021, "fractional success".
    """
    blocks = (rows(sizes, 3), rows(positions, 3), rows(orientations, 4))
    goals = (rows(goal_sizes, 3), rows(goal_positions, 3), rows(goal_orientations, 4))
    return float(overlap_fraction_kernel(*blocks, *goals))
