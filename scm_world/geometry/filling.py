"""How much of the goals the blocks fill, exactly, also where goals or blocks intersect.

A filled part counts once, for the goal and the block that come first:

    V(∪G ∩ ∪B) = Σ_g Σ_b V(G_g ∩ B_b − (G_1 ∪ … ∪ G_{g-1} ∪ B_1 ∪ … ∪ B_{b-1})).

A convex solid is given by its edges, each twice: once along each of the two faces that it bounds,
counterclockwise seen from outside. A row has the number of the face, and both ends: shape (n, 7)
[m]. Their order does not matter. To cut a solid with a plane, each edge is cut by itself, and where
a face was cut, one more edge closes it; the same edge, backwards, belongs to the new face. A point
in which an edge meets the plane is computed in the same way for both faces, so that each face stays
closed to the last bit, and coplanar faces are no special case.
"""

from __future__ import annotations

import numpy as np

from scm_world._types import ArrayLike, Floats
from scm_world.geometry.numbers import njit
from scm_world.geometry.rotations import rotation_kernel, rotation_matrix

NOTHING = 1e-15  # of the volume of a solid: a piece of it that can be left out
_SQUARE = ((0, 0), (1, 0), (1, 1), (0, 1))
_ENDS = np.array(
    [
        (np.roll((side > 0, *start), axis) @ (1, 2, 4), np.roll((side > 0, *end), axis) @ (1, 2, 4))
        for axis in range(3)
        for side in (1, -1)
        for start, end in zip(_SQUARE, _SQUARE[side:] + _SQUARE[:side], strict=True)
    ]
)
"""Both corners of each edge of a cube, four for each side; corner n is at 1 along an axis where bit
``axis`` of n is set, shape (24, 2)."""


@njit(cache=True)
def _box(
    size: Floats, position: Floats, orientation: Floats, edges: Floats, planes: Floats
) -> None:
    """Write the edges of a box, shape (24, 7), and its planes, shape (6, 4).

    Planes are unit outward normals and offsets; inside is ``normal · x <= offset``.
    """
    rotation, corner = np.empty((3, 3)), np.empty((8, 3))
    rotation_kernel(orientation, rotation)
    for n in range(8):
        for k in range(3):
            corner[n, k] = position[k]
            for axis in range(3):
                side = 0.5 - (n >> axis & 1)
                corner[n, k] -= side * size[axis] * rotation[k, axis]
    for n in range(24):
        edges[n, 0] = n // 4
        for k in range(3):
            edges[n, 1 + k] = corner[_ENDS[n, 0], k]
            edges[n, 4 + k] = corner[_ENDS[n, 1], k]
    for n in range(6):
        axis, sign = n // 2, 1.0 - 2.0 * (n % 2)
        planes[n, 3] = 0.5 * size[axis]
        for k in range(3):
            planes[n, k] = sign * rotation[k, axis]
            planes[n, 3] += planes[n, k] * position[k]


@njit(cache=True)
def _height(point: Floats, plane: Floats) -> float:
    """Compute how far within a plane a point is [m]."""
    height: float = plane[3] - plane[0] * point[0] - plane[1] * point[1] - plane[2] * point[2]
    return height


@njit(cache=True)
def _cut(edges: Floats, plane: Floats, sign: float) -> Floats:
    """Keep the part of a solid that is within a plane (sign 1), or beyond it (sign -1)."""
    n, faces = len(edges), 0
    for e in range(n):
        faces = max(faces, int(edges[e, 0]) + 1)
    crossed, hubs = np.zeros(faces, dtype=np.bool_), np.empty((faces, 3))
    kept, count = np.empty((3 * n, 7)), 0
    for e in range(n):
        start, end = sign * _height(edges[e, 1:4], plane), sign * _height(edges[e, 4:], plane)
        if start < 0.0 and end < 0.0:
            continue
        here, count = count, count + 1
        for k in range(7):
            kept[here, k] = edges[e, k]
        if start >= 0.0 and end >= 0.0:
            continue
        face, inner, outer = int(edges[e, 0]), 1, 4
        if start < 0.0:
            inner, outer = 4, 1
        along = max(start, end) / (max(start, end) - min(start, end))
        for k in range(3):
            step = edges[e, outer + k] - edges[e, inner + k]
            kept[here, outer + k] = edges[e, inner + k] + along * step
        if crossed[face]:
            for k in range(3):  # from or to the point where the face was crossed first
                kept[count, inner + k] = kept[count + 1, outer + k] = kept[here, outer + k]
                kept[count, outer + k] = kept[count + 1, inner + k] = hubs[face, k]
            kept[count, 0], kept[count + 1, 0] = face, faces
            count += 2
        else:
            crossed[face] = True
            for k in range(3):
                hubs[face, k] = kept[here, outer + k]
    return kept[:count]


@njit(cache=True)
def _volume(edges: Floats) -> float:
    """Add up the pyramids over all faces, seen from one corner [m³]."""
    faces = 0
    for e in range(len(edges)):
        faces = max(faces, int(edges[e, 0]) + 1)
    first, total, a, b, c = np.full(faces, -1), 0.0, np.empty(3), np.empty(3), np.empty(3)
    for e in range(len(edges)):
        face = int(edges[e, 0])
        if first[face] < 0:
            first[face] = e
        for k in range(3):
            origin = edges[0, 1 + k]
            a[k] = edges[first[face], 1 + k] - origin
            b[k], c[k] = edges[e, 1 + k] - origin, edges[e, 4 + k] - origin
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            total += a[i] * (b[j] * c[k] - b[k] * c[j])
    return total / 6.0


@njit(cache=True)
def _apart(edges: Floats, planes: Floats) -> bool:
    """Return whether a plane of one solid has the whole of another one beyond it."""
    for plane in planes:
        for edge in edges:
            if _height(edge[1:4], plane) > 0.0:  # each corner begins an edge
                break
        else:
            return True
    return False


@njit(cache=True)
def remainder_kernel(edges: Floats, within: Floats, others: Floats) -> float:
    """Compute how much of a solid lies within some planes and in none of some other solids.

    Args:
        edges: Edges of the solid, shape (n, 7) [m].
        within: Planes, shape (m, 4).
        others: Planes of each of the others, shape (k, p, 4).

    Returns:
        The volume [m³].
    """
    if _apart(edges, within):
        return 0.0
    for n in range(len(within)):
        edges = _cut(edges, within[n], 1.0)
    total = _volume(edges)
    if total <= 0.0:
        return 0.0
    least, pieces = NOTHING * total, [edges]
    for other in range(len(others)):
        planes, left = others[other], pieces[:0]
        for piece in pieces:
            if _apart(piece, planes):
                left.append(piece)
                continue
            inner = piece
            for n in range(len(planes)):
                outer = _cut(inner, planes[n], -1.0)
                if _volume(outer) > least:
                    left.append(outer)
                inner = _cut(inner, planes[n], 1.0)
        pieces = left
    total = 0.0
    for piece in pieces:
        total += _volume(piece)
    return total


@njit(cache=True)
def overlap_fraction(
    sizes: Floats,
    positions: Floats,
    orientations: Floats,
    goal_sizes: Floats,
    goal_positions: Floats,
    goal_orientations: Floats,
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
        The fraction, in [0, 1]. A world without goals, or whose goals have no
        volume, is fulfilled: 1.0.

    Example:
        Two goals share a third of their volume, and the block lies just there.

        >>> upright = np.array([[0.0, 0.0, 0.0, 1.0]])
        >>> goals = np.full((2, 3), 2.0), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
        >>> block = np.array([[1.0, 2.0, 2.0]]), np.array([[0.5, 0.0, 0.0]])
        >>> round(overlap_fraction(*block, upright, *goals, np.repeat(upright, 2, axis=0)), 12)
        0.333333333333

    Source:
        Ahmed et al., *CausalWorld*, ICLR 2021, "fractional success".
    """
    n, m = len(sizes), len(goal_sizes)
    edges, planes = np.empty((n + m, 24, 7)), np.empty((n + m, 6, 4))
    for b in range(n):  # the last one first: what comes before block and goal lies side by side
        at = n - 1 - b
        _box(sizes[b], positions[b], orientations[b], edges[at], planes[at])
    for g in range(m):
        at = n + g
        _box(goal_sizes[g], goal_positions[g], goal_orientations[g], edges[at], planes[at])
    wanted, filled = 0.0, 0.0
    for g in range(m):
        wanted += remainder_kernel(edges[n + g], planes[n + g][:0], planes[n : n + g])
        for b in range(n):
            before = planes[n - b : n + g]
            filled += remainder_kernel(edges[n - 1 - b], planes[n + g], before)
    return min(filled / wanted, 1.0) if wanted > 0.0 else 1.0


def _corners(sizes: ArrayLike, positions: ArrayLike, orientations: ArrayLike) -> Floats:
    """Compute the lower and the upper corner of the axis-aligned hulls, shape (2, n, 3) [m]."""
    size, center = (np.reshape(rows, (-1, 3)).astype(float) for rows in (sizes, positions))
    turns = np.abs(rotation_matrix(np.reshape(orientations, (-1, 4))))
    spread = np.einsum("nij,nj->ni", turns, 0.5 * size)
    return np.stack((center - spread, center + spread))


def aabb_overlap_fraction(
    sizes: ArrayLike,
    positions: ArrayLike,
    orientations: ArrayLike,
    goal_sizes: ArrayLike,
    goal_positions: ArrayLike,
    goal_orientations: ArrayLike,
) -> float:
    """Compute the predecessor's fraction: axis-aligned hulls instead of boxes, and no cap.

    A block that is turned covers more than it fills, and a goal that is turned is larger than
    it is. Use it only to compare with published numbers.

    The arguments are those of ``overlap_fraction``.

    Returns:
        The fraction, at least zero; above one where blocks share a goal. Without goals, 1.0.

    Example:
        >>> cube, here, upright = [[1.0, 1.0, 1.0]], [[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0, 1.0]]
        >>> turned = [[0.0, 0.0, np.sin(np.pi / 8), np.cos(np.pi / 8)]]
        >>> aabb_overlap_fraction(cube, here, turned, cube, here, upright)
        1.0

    Source:
        CausalWorld 1.2, ``task_generators/base_task.py``.
    """
    low, high = _corners(sizes, positions, orientations)
    goal_low, goal_high = _corners(goal_sizes, goal_positions, goal_orientations)
    wanted = float(np.sum(np.prod(goal_high - goal_low, axis=-1)))
    if wanted == 0.0:
        return 1.0
    edges = np.minimum(high[:, None], goal_high) - np.maximum(low[:, None], goal_low)
    shared = np.prod(np.maximum(edges, 0.0), axis=-1)  # (n, m)
    return float(np.sum(shared)) / wanted
