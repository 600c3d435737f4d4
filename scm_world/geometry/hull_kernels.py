"""How much of one convex polyhedron lies in another, exactly, as a kernel.

Both are seen from the second one, B, from a point O inside it. A ray from O leaves B at a distance
R and crosses the surface of the first one, A, at distances r, outwards or inwards; the part of
the ray that is in both counts

    Σ ± min(r, R)³ / 3

per solid angle, which is the divergence theorem for a field that ends at the surface of B. So the
volume is the sum over the faces of A and of B of a signed pyramid with its tip in O: the face of A
is cut to the cone of the face of B, and what of it lies beyond B is pulled back onto the face.
The integrand is continuous where the two surfaces meet: coplanar faces are no special case.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from scm_world._types import Floats, Integers
from scm_world.geometry.rotations import rotation_kernel


class Solid(NamedTuple):
    """A convex polyhedron around the origin as arrays; see ``Hull``.

    Attributes:
        vertices: Shape (v, 3) [m].
        faces: Triangles, counterclockwise seen from outside, shape (f, 3).
        planes: Unit outward normals and offsets, shape (p, 4).
        volume: [m³].
    """

    vertices: Floats
    faces: Integers
    planes: Floats
    volume: float


@njit(cache=True)
def _into(solid: Solid, pose: Floats, vertices: Floats) -> None:
    """Write the corners of a solid whose axes are ``pose[:3]`` and whose origin ``pose[3]``."""
    for n in range(len(solid.vertices)):
        for i in range(3):
            vertices[n, i] = pose[3, i]
            for j in range(3):
                vertices[n, i] += pose[j, i] * solid.vertices[n, j]


@njit(cache=True)
def _beyond(planes: Floats, vertices: Floats) -> bool:
    """Tell whether one of the planes has all the points on its outer side."""
    for p in range(len(planes)):
        outside = True
        for n in range(len(vertices)):
            height = 0.0
            for i in range(3):
                height += planes[p, i] * vertices[n, i]
            if height < planes[p, 3]:
                outside = False
                break
        if outside:
            return True
    return False


@njit(cache=True)
def _relative(rotation_a: Floats, rotation_b: Floats, shift: Floats, pose: Floats) -> None:
    """Write the axes of A in B's frame to the rows of ``pose`` and its center to the last one."""
    for i in range(3):
        pose[3, i] = 0.0
        for k in range(3):
            pose[3, i] += rotation_b[k, i] * shift[k]
        for j in range(3):
            pose[j, i] = 0.0
            for k in range(3):
                pose[j, i] += rotation_b[k, i] * rotation_a[k, j]


@njit(cache=True)
def _determinant(a: Floats, b: Floats, c: Floats) -> float:
    """Give six times the signed volume of the pyramid over a triangle, seen from the origin."""
    return float(
        a[0] * (b[1] * c[2] - b[2] * c[1])
        + a[1] * (b[2] * c[0] - b[0] * c[2])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )


@njit(cache=True)
def _six_volumes(polygon: Floats, count: int) -> float:
    """Give six times the signed volume of the pyramid over a polygon."""
    total = 0.0
    for k in range(1, count - 1):
        total += _determinant(polygon[0], polygon[k], polygon[k + 1])
    return total


@njit(cache=True)
def _height(point: Floats, plane: Floats) -> float:
    """Measure how far a point lies on the inner side of a plane, in units of its normal."""
    return float(plane[0] * point[0] + plane[1] * point[1] + plane[2] * point[2] - plane[3])


@njit(cache=True, error_model="numpy")
def _cut(polygon: Floats, count: int, plane: Floats, sign: float, out: Floats) -> int:
    """Keep the part of a polygon where ``sign`` times the height above a plane is not negative."""
    kept = 0
    before = count - 1
    height_before = sign * _height(polygon[before], plane)
    for now in range(count):
        height = sign * _height(polygon[now], plane)
        if (height >= 0.0) != (height_before >= 0.0):
            along = height_before / (height_before - height)
            for k in range(3):
                out[kept, k] = polygon[before, k] + along * (polygon[now, k] - polygon[before, k])
            kept += 1
        if height >= 0.0:
            for k in range(3):
                out[kept, k] = polygon[now, k]
            kept += 1
        before, height_before = now, height
    return kept


@njit(cache=True)
def _cone(solid: Solid, face: int, cone: Floats) -> None:
    """Write the three sides of the cone over a face, and the plane of the face, as planes.

    A side is computed from its two corners only, so that neighbors agree on it to the last bit.
    """
    corners = solid.faces[face]
    for side in range(3):
        p, q = solid.vertices[corners[side]], solid.vertices[corners[(side + 1) % 3]]
        cone[side, 0] = p[1] * q[2] - p[2] * q[1]
        cone[side, 1] = p[2] * q[0] - p[0] * q[2]
        cone[side, 2] = p[0] * q[1] - p[1] * q[0]
        cone[side, 3] = 0.0
    p = solid.vertices[corners[0]]
    for k in range(3):  # (q - p) x (r - p) = p x q + q x r + r x p
        cone[3, k] = cone[0, k] + cone[1, k] + cone[2, k]
    cone[3, 3] = 0.0
    cone[3, 3] = _height(p, cone[3])


@njit(cache=True)
def _outside(vertices: Floats, corners: Integers, cone: Floats) -> bool:
    """Tell whether one side of a cone has a whole triangle on its outer side."""
    for side in range(3):
        if (
            _height(vertices[corners[0]], cone[side]) < 0.0
            and _height(vertices[corners[1]], cone[side]) < 0.0
            and _height(vertices[corners[2]], cone[side]) < 0.0
        ):
            return True
    return False


@njit(cache=True, error_model="numpy")
def _pyramid(vertices: Floats, corners: Integers, cone: Floats, work: Floats) -> float:
    """Give six times the volume that a triangle of A encloses with the tip of a cone of B."""
    for n in range(3):
        for k in range(3):
            work[0, n, k] = vertices[corners[n], k]
    count = 3
    count = _cut(work[0], count, cone[0], 1.0, work[1])
    count = _cut(work[1], count, cone[1], 1.0, work[0])
    count = _cut(work[0], count, cone[2], 1.0, work[1])
    farthest = -np.inf
    for n in range(count):
        farthest = max(farthest, _height(work[1, n], cone[3]))
    total = _six_volumes(work[0], _cut(work[1], count, cone[3], -1.0, work[0]))
    if farthest <= 0.0:  # also where it lies in the plane, so that it does not count twice
        return total
    count = _cut(work[1], count, cone[3], 1.0, work[0])
    for n in range(count):
        pull = cone[3, 3] / (_height(work[0, n], cone[3]) + cone[3, 3])
        for k in range(3):
            work[0, n, k] *= pull
    return total + _six_volumes(work[0], count)


@njit(cache=True)
def hull_overlap_kernel(
    a: Solid,
    position_a: Floats,
    orientation_a: Floats,
    b: Solid,
    position_b: Floats,
    orientation_b: Floats,
) -> float:
    """Compute the volume that two convex polyhedra share.

    Args:
        a: The first one.
        position_a: Its origin, shape (3,) [m].
        orientation_a: Its quaternion (x, y, z, w).
        b: As ``a``, of the second one; the origin must lie inside.
        position_b: As ``position_a``.
        orientation_b: As ``orientation_a``.

    Returns:
        The volume [m³], exact to rounding.
    """
    rotation_a, rotation_b = np.empty((3, 3)), np.empty((3, 3))
    rotation_kernel(orientation_a, rotation_a)
    rotation_kernel(orientation_b, rotation_b)
    pose, vertices = np.empty((4, 3)), np.empty((max(len(a.vertices), len(b.vertices)), 3))
    _relative(rotation_b, rotation_a, position_b - position_a, pose)
    _into(b, pose, vertices)
    if _beyond(a.planes, vertices[: len(b.vertices)]):
        return 0.0
    _relative(rotation_a, rotation_b, position_a - position_b, pose)
    _into(a, pose, vertices)
    if _beyond(b.planes, vertices[: len(a.vertices)]):
        return 0.0
    cone, work, total = np.empty((4, 4)), np.empty((2, 12, 3)), 0.0
    for g in range(len(b.faces)):
        _cone(b, g, cone)
        for f in range(len(a.faces)):
            if not _outside(vertices, a.faces[f], cone):
                total += _pyramid(vertices, a.faces[f], cone, work)
    return min(max(total / 6.0, 0.0), a.volume, b.volume)
