"""How much of one oriented box lies in another, exactly.

Both boxes are seen from the second one, B, whose half edges are (X, Y, Z). A line parallel to x
through the rectangle ``|y| <= Y, |z| <= Z`` enters the first box, A, at one of its faces and
leaves it at another, and of the piece between them ``clamp(leave) - clamp(enter)`` lies in B,
where clamp confines x to [-X, X]. So the volume is the sum over the faces of A of the signed
integral

    ∫∫ clamp(x) dy dz = ∫∫_{x >= -X} (x + X) dy dz - ∫∫_{x >= X} (x - X) dy dz   (+ const.)

over the part of the face above the rectangle, and the constants cancel between the faces. This
is the divergence theorem for (clamp(x), 0, 0). No face of B is needed, and every integrand is
continuous where a face of A meets one of B: coplanar faces are no special case.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from scm_world._types import ArrayLike, Floats
from scm_world.geometry.arrays import compact, rows
from scm_world.geometry.rotations import rotation_kernel, rotation_matrix

WORKSPACE = (5, 48, 3)
"""Shape of the scratch array: two polygons, two rotations, and the relative pose."""


@njit(cache=True, error_model="numpy")
def _clip(polygon: Floats, count: int, axis: int, sign: float, bound: float, out: Floats) -> int:
    """Keep the part of a convex polygon where ``sign * coordinate <= bound``.

    Args:
        polygon: Corners in order, shape (>= count, 3).
        count: How many corners there are.
        axis: Which coordinate.
        sign: 1.0 or -1.0.
        bound: Of the signed coordinate.
        out: Where to write the corners of the result.

    Returns:
        How many corners the result has.
    """
    kept = 0
    before = count - 1
    depth_before = bound - sign * polygon[before, axis]
    for now in range(count):
        depth = bound - sign * polygon[now, axis]
        if (depth >= 0.0) != (depth_before >= 0.0):
            along = depth_before / (depth_before - depth)
            for k in range(3):
                step = polygon[now, k] - polygon[before, k]
                out[kept, k] = polygon[before, k] + along * step
            out[kept, axis] = sign * bound
            kept += 1
        if depth >= 0.0:
            out[kept, 0], out[kept, 1], out[kept, 2] = (
                polygon[now, 0],
                polygon[now, 1],
                polygon[now, 2],
            )
            kept += 1
        before = now
        depth_before = depth
    return kept


@njit(cache=True, error_model="numpy")
def _integral(polygon: Floats, count: int, shift: float) -> float:
    """Integrate ``x + shift`` over a polygon's projection onto the y-z plane.

    Positive where the corners run counterclockwise as seen from positive x.
    """
    total = 0.0
    for k in range(1, count - 1):
        y, z = polygon[k, 1] - polygon[0, 1], polygon[k, 2] - polygon[0, 2]
        v, w = polygon[k + 1, 1] - polygon[0, 1], polygon[k + 1, 2] - polygon[0, 2]
        mean = (polygon[0, 0] + polygon[k, 0] + polygon[k + 1, 0]) / 3.0
        total += 0.5 * (y * w - v * z) * (mean + shift)
    return total


@njit(cache=True)
def _relative_pose(
    position_a: Floats,
    orientation_a: Floats,
    position_b: Floats,
    orientation_b: Floats,
    work: Floats,
) -> None:
    """Write the axes of A in B's frame to ``work[4, :3]`` and its center to ``work[4, 3]``."""
    rotation_a, rotation_b, pose = work[2], work[3], work[4]
    rotation_kernel(orientation_a, rotation_a)
    rotation_kernel(orientation_b, rotation_b)
    for i in range(3):
        pose[3, i] = 0.0
        for k in range(3):
            pose[3, i] += rotation_b[k, i] * (position_a[k] - position_b[k])
        for j in range(3):  # row j is axis j of A
            pose[j, i] = 0.0
            for k in range(3):
                pose[j, i] += rotation_b[k, i] * rotation_a[k, j]


@njit(cache=True)
def _apart(size_a: Floats, size_b: Floats, pose: Floats) -> bool:
    """Tell whether the normal of a face separates the two boxes."""
    for i in range(3):
        reach_a, reach_b, along_a = size_a[i], size_b[i], 0.0
        for j in range(3):
            reach_a += abs(pose[i, j]) * size_b[j]
            reach_b += abs(pose[j, i]) * size_a[j]
            along_a += pose[i, j] * pose[3, j]
        if 2.0 * abs(along_a) >= reach_a or 2.0 * abs(pose[3, i]) >= reach_b:
            return True
    return False


@njit(cache=True, error_model="numpy")
def _face(size_a: Floats, axis: int, sign: float, size_b: Floats, work: Floats) -> float:
    """Integrate the confined x over one face of A, above the rectangle of B."""
    pose, i, j = work[4], (axis + 1) % 3, (axis + 2) % 3
    for k in range(3):
        center = pose[3, k] + 0.5 * sign * size_a[axis] * pose[axis, k]
        along, across = 0.5 * size_a[i] * pose[i, k], 0.5 * size_a[j] * pose[j, k]
        work[0, 0, k] = center - along - across
        work[0, 1, k] = center + along - across
        work[0, 2, k] = center + along + across
        work[0, 3, k] = center - along + across
    count = 4
    for k in range(1, 3):
        count = _clip(work[0], count, k, 1.0, 0.5 * size_b[k], work[1])
        count = _clip(work[1], count, k, -1.0, 0.5 * size_b[k], work[0])
    half = 0.5 * size_b[0]
    count = _clip(work[0], count, 0, -1.0, half, work[1])
    inside = _integral(work[1], count, half)
    count = _clip(work[1], count, 0, -1.0, -half, work[0])
    return sign * (inside - _integral(work[0], count, -half))


@njit(cache=True)
def overlap_kernel(
    size_a: Floats,
    position_a: Floats,
    orientation_a: Floats,
    size_b: Floats,
    position_b: Floats,
    orientation_b: Floats,
    work: Floats,
) -> float:
    """Compute the volume that two boxes share; see ``overlap_volume``.

    Args:
        size_a: Full edge lengths of the first box, shape (3,) [m].
        position_a: Its center, shape (3,) [m].
        orientation_a: Its quaternion (x, y, z, w).
        size_b: As ``size_a``, of the second box.
        position_b: As ``position_a``.
        orientation_b: As ``orientation_a``.
        work: Scratch of shape ``WORKSPACE``, overwritten.

    Returns:
        The volume [m³].
    """
    distance, diagonal_a, diagonal_b = 0.0, 0.0, 0.0
    for k in range(3):
        distance += (position_a[k] - position_b[k]) ** 2
        diagonal_a += size_a[k] ** 2
        diagonal_b += size_b[k] ** 2
    if 2.0 * math.sqrt(distance) >= math.sqrt(diagonal_a) + math.sqrt(diagonal_b):
        return 0.0
    _relative_pose(position_a, orientation_a, position_b, orientation_b, work)
    if _apart(size_a, size_b, work[4]):
        return 0.0
    volume = 0.0
    for axis in range(3):
        if work[4, axis, 0] != 0.0:  # else the face is seen edge on
            volume += _face(size_a, axis, 1.0, size_b, work)
            volume += _face(size_a, axis, -1.0, size_b, work)
    most = min(size_a[0] * size_a[1] * size_a[2], size_b[0] * size_b[1] * size_b[2])
    return float(min(max(volume, 0.0), most))


def overlap_volume(
    size_a: ArrayLike,
    position_a: ArrayLike,
    orientation_a: ArrayLike,
    size_b: ArrayLike,
    position_b: ArrayLike,
    orientation_b: ArrayLike,
) -> float:
    """Compute the volume that two oriented boxes share.

    Exact to about 1e-15 of the smaller box, for every pose. Boxes that touch share nothing.

    Args:
        size_a: Full edge lengths of the first box, shape (3,) [m].
        position_a: Its center, shape (3,) [m].
        orientation_a: Its quaternion (x, y, z, w), of any length.
        size_b: As ``size_a``, of the second box.
        position_b: As ``position_a``.
        orientation_b: As ``orientation_a``.

    Returns:
        The volume [m³], at least zero and at most that of the smaller box.

    Example:
        A cube that is turned by 45 degrees in its own place fills 2 (√2 - 1) of it.

        >>> cube, here = [1.0, 1.0, 1.0], [0.0, 0.0, 0.0]
        >>> turned = [0.0, 0.0, np.sin(np.pi / 8), np.cos(np.pi / 8)]
        >>> round(overlap_volume(cube, here, turned, cube, here, [0.0, 0.0, 0.0, 1.0]), 12)
        0.828427124746
    """
    return float(
        overlap_kernel(
            compact(size_a),
            compact(position_a),
            compact(orientation_a),
            compact(size_b),
            compact(position_b),
            compact(orientation_b),
            np.empty(WORKSPACE),
        )
    )


def _corners(sizes: ArrayLike, positions: ArrayLike, orientations: ArrayLike) -> Floats:
    """Give the lower and the upper corner of the axis-aligned hulls, shape (2, n, 3) [m]."""
    half, center = 0.5 * rows(sizes, 3), rows(positions, 3)
    spread = np.einsum("nij,nj->ni", np.abs(rotation_matrix(rows(orientations, 4))), half)
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

    Args:
        sizes: Full edge lengths of the blocks, shape (n, 3) [m].
        positions: Centers of the blocks, shape (n, 3) [m].
        orientations: Quaternions (x, y, z, w) of the blocks, shape (n, 4).
        goal_sizes: As ``sizes``, of the goals, shape (m, 3) [m].
        goal_positions: Shape (m, 3) [m].
        goal_orientations: Shape (m, 4).

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
