"""Convex polyhedra."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise, permutations, product
from os import PathLike
from pathlib import Path
from typing import Any, final

import numpy as np

from scm_world._arguments import load, one_of, real_number, typed
from scm_world._types import ArrayLike, Floats, Integers
from scm_world.errors import ModelError
from scm_world.geometry.filling import remainder_kernel
from scm_world.geometry.rotations import rotation_matrix

Vector = tuple[float, float, float]

MOST_VERTICES = 256
FORMATS = ("obj", "stl")
THINNEST = 1e-6  # of the greatest extent: a thinner solid has no volume
ROUGHNESS = 3e-7  # of the greatest extent: what sticks out less is the rounding of a file
SAME_MOMENT = 1e-6  # of the greatest second moment: axes of equal ones can be chosen freely


@final
@dataclass(frozen=True)
class Hull:
    """A solid convex polyhedron, in the frame of its center of mass and its principal axes.

    Attributes:
        vertices: Corners [m].
        faces: Triangles, as indices of corners, counterclockwise seen from outside.
        planes: One per flat side: unit outward normal and offset; inside is
            ``normal · x <= offset`` [m].
        volume: [m³].
        moments: Principal moments of inertia divided by the mass, about the three axes [m²].
        axes: How the principal axes lay in the frame of the points that were given: quaternion
            (x, y, z, w). A body of this orientation lies as they did.
    """

    vertices: tuple[Vector, ...]
    faces: tuple[tuple[int, int, int], ...]
    planes: tuple[tuple[float, float, float, float], ...]
    volume: float
    moments: Vector
    axes: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)


def hull_of(points: ArrayLike) -> Hull:
    """Wrap points in a convex polyhedron of uniform density.

    The result is expressed in the frame of its center of mass and its principal axes, and
    keeps how these lay. Order and signs of the axes are those that turn the points least;
    where moments are equal, and axes can be chosen, too. A shape whose axes are principal axes is
    not turned at all.

    Args:
        points: Corners, and any number of points among them, shape (n, 3) [m].

    Raises:
        ModelError: The points are not finite, lie in one plane, or have too many corners.

    Example:
        >>> from itertools import product
        >>> plate = hull_of([(x, y, z) for x in (0, 2) for y in (0, 4) for z in (0, 1)])
        >>> round(plate.volume, 9), len(plate.vertices), len(plate.planes)
        (8.0, 8, 6)
        >>> np.ptp(plate.vertices, axis=0).round(9).tolist()
        [2.0, 4.0, 1.0]
    """
    cloud = np.asarray(points, dtype=np.float64)
    if cloud.ndim != 2 or cloud.shape[1] != 3 or not np.isfinite(cloud).all():
        raise ModelError(
            [f"the points of a hull must be finite numbers of shape (n, 3), got {cloud.shape}"]
        )
    from scipy.spatial.transform import Rotation  # takes a fifth of a second

    vertices, faces, planes = _polyhedron(cloud)
    center, spread, volume = _second_moments(vertices, faces)
    axes = _principal_axes(spread)
    local = (vertices - center) @ axes
    offsets = planes[:, 3] - planes[:, :3] @ center
    along = np.einsum("ki,kl,li->i", axes, spread, axes)
    return Hull(
        tuple(map(tuple, local.tolist())),
        tuple(map(tuple, faces.tolist())),
        tuple(map(tuple, np.column_stack([planes[:, :3] @ axes, offsets]).tolist())),
        volume,
        tuple((along.sum() - along).tolist()),
        tuple(Rotation.from_matrix(axes).as_quat(canonical=True).tolist()),
    )


@typed
def load_hull(path: str | PathLike[str], *, scale: float = 1.0) -> Hull:
    """Read a mesh and wrap it in a convex polyhedron; see ``hull_of``.

    Args:
        path: An ``.obj`` or ``.stl`` file.
        scale: The length of its unit [m].

    Raises:
        ModelError: The file has no volume, too many corners, or cannot be read.
        UnknownOption: The file has another format.
        MissingExtra: trimesh is not installed; the extra ``meshes`` brings it.
    """
    file = Path(path)
    kind = file.suffix.lower().removeprefix(".")
    one_of("mesh format", kind, FORMATS)
    if real_number("scale", scale) <= 0.0:
        raise ModelError([f"the scale of {file} must be positive and finite, got {scale}"])
    trimesh = load("trimesh", "trimesh", "meshes")
    try:
        if not file.is_file():
            raise FileNotFoundError("it is not a regular file, or not there")
        with file.open("rb") as stream:
            mesh: Any = trimesh.load(stream, file_type=kind, force="mesh", process=False)
        return hull_of(scale * np.asarray(mesh.vertices, dtype=np.float64).reshape(-1, 3))
    except (OSError, ValueError, IndexError, KeyError, MemoryError, ModelError) as error:
        raise ModelError([f"{file} cannot be read as a mesh: {error}"]) from error


def hull_overlap(
    hull_a: Hull,
    position_a: ArrayLike,
    orientation_a: ArrayLike,
    hull_b: Hull,
    position_b: ArrayLike,
    orientation_b: ArrayLike,
) -> float:
    """Compute the volume that two convex polyhedra share [m³], exact to rounding.

    Positions are centers of mass, shape (3,) [m], and orientations quaternions (x, y, z, w) of any
    length.
    """
    world = np.array(hull_a.vertices) @ rotation_matrix(orientation_a).T + np.asarray(position_a)
    corners = (world - np.asarray(position_b)) @ rotation_matrix(orientation_b)
    faces = np.array(hull_a.faces)
    edges = np.empty((len(faces), 3, 7))
    edges[:, :, 0] = np.arange(len(faces))[:, None]
    edges[:, :, 1:4], edges[:, :, 4:] = corners[faces], corners[np.roll(faces, -1, axis=1)]
    shared = remainder_kernel(edges.reshape(-1, 7), np.array(hull_b.planes), np.empty((0, 0, 4)))
    return float(min(shared, hull_a.volume, hull_b.volume))


def _polyhedron(cloud: Floats) -> tuple[Floats, Integers, Floats]:
    """Find corners (v, 3), triangles (f, 3) and planes (p, 4) of the hull of points."""
    extent = float(np.ptp(cloud, axis=0).max()) if len(cloud) else 0.0
    middle = cloud.mean(axis=0) if len(cloud) else np.zeros(3)
    if len(cloud) < 4 or extent == 0.0:
        raise ModelError([f"{len(cloud)} points have no volume; give four or more"])
    thickness = np.linalg.svd((cloud - middle) / extent, compute_uv=False)
    if thickness[2] <= THINNEST * thickness[0]:
        raise ModelError(["the points lie in one plane and have no volume"])
    from scipy.spatial import ConvexHull, QhullError

    try:
        wrapped = ConvexHull((cloud - middle) / extent, qhull_options=f"Qt C-{ROUGHNESS}")
    except QhullError as error:
        raise ModelError([f"the points have no convex hull: {error}"]) from error
    if len(wrapped.vertices) > MOST_VERTICES:
        raise ModelError(
            [
                f"the convex hull has {len(wrapped.vertices)} corners, more than {MOST_VERTICES}; "
                "simplify the mesh, for example with trimesh's simplify_quadric_decimation"
            ]
        )
    sides = _sides(wrapped.points, wrapped.simplices, wrapped.equations)
    used = sorted({corner for _, corners in sides for corner in corners})
    number = {corner: n for n, corner in enumerate(used)}
    vertices = middle + extent * wrapped.points[used]
    faces, planes = [], []
    for normal, corners in sides:
        first, *fan = (number[corner] for corner in corners)
        faces += [(first, q, r) for q, r in pairwise(fan)]
        planes.append([*normal, float(np.max(vertices @ normal))])
    edges = {(f[k], f[(k + 1) % 3]) for f in faces for k in range(3)}
    if len(edges) != 3 * len(faces) or any((q, p) not in edges for p, q in edges):
        raise ModelError(  # some sides are thinner than the resolution
            ["corners of the mesh nearly coincide, so that it has no clean surface; merge them"]
        )
    return vertices, np.array(faces, dtype=np.int64), np.array(planes)


def _sides(points: Floats, triangles: Integers, planes: Floats) -> list[tuple[Floats, list[int]]]:
    """Join triangles in one plane: normal and corners of each flat side, counterclockwise.

    The triangles of a side of Qhull's all have its plane, to the last bit.
    """
    _, first, group = np.unique(planes, axis=0, return_index=True, return_inverse=True)
    first = np.sort(first)
    members = [np.unique(triangles[group == group[t]]) for t in first]
    count = np.bincount(np.concatenate(members), minlength=len(points))
    sides = []
    for t, corners in zip(first, members, strict=True):
        normal = planes[t, :3]
        kept = corners[count[corners] >= 3]  # others lie inside an edge or a side
        spokes = points[kept] - points[kept].mean(axis=0)
        right = spokes[np.argmax(np.linalg.norm(spokes, axis=1))]
        angles = np.arctan2(spokes @ np.cross(normal, right), spokes @ right)
        order: list[int] = kept[np.argsort(angles, kind="stable")].tolist()
        start = order.index(min(order))
        sides.append((normal, order[start:] + order[:start]))
    return sides


def _second_moments(vertices: Floats, faces: Integers) -> tuple[Floats, Floats, float]:
    """Integrate over a solid: center (3,) [m], covariance (3, 3) [m²], and volume [m³].

    Source:
        Blow and Binstock, "How to find the inertia tensor of a 3D solid body", 2004.
    """
    origin = vertices.mean(axis=0)
    corners = (vertices - origin)[faces]  # (f, 3 corners, 3)
    sixfold = np.linalg.det(corners)  # of the volume of each pyramid
    total = corners.sum(axis=1)
    volume = float(sixfold.sum()) / 6.0
    center = np.einsum("f,fi->i", sixfold, total) / (24.0 * volume)
    square = np.einsum("f,fi,fj->ij", sixfold, total, total)
    square += np.einsum("f,fki,fkj->ij", sixfold, corners, corners)
    return origin + center, square / (120.0 * volume) - np.outer(center, center), volume


def _principal_axes(spread: Floats) -> Floats:
    """Choose the principal axes that are nearest to the axes given, right-handed, as columns."""
    values, vectors = np.linalg.eigh(spread)
    best, found = -np.inf, np.eye(3)
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            axes = vectors[:, order] * signs
            if np.linalg.det(axes) < 0.0:
                continue
            axes = _relax(axes, values[list(order)])
            if np.trace(axes) > best + 1e-9:  # ties are decided by the order, not by rounding
                best, found = float(np.trace(axes)), axes
    return np.eye(3) if np.allclose(found, np.eye(3), rtol=0.0, atol=1e-9) else found


def _relax(axes: Floats, values: Floats) -> Floats:
    """Turn axes of equal moments among themselves until they are nearest to the axes given."""
    same = [abs(values[i] - values[(i + 1) % 3]) <= SAME_MOMENT * values.max() for i in range(3)]
    if all(same):
        return np.eye(3)
    relaxed = axes.copy()
    for i in np.flatnonzero(same):
        j = (i + 1) % 3
        angle = np.arctan2(axes[i, j] - axes[j, i], axes[i, i] + axes[j, j])
        relaxed[:, i] = np.cos(angle) * axes[:, i] + np.sin(angle) * axes[:, j]
        relaxed[:, j] = np.cos(angle) * axes[:, j] - np.sin(angle) * axes[:, i]
    return relaxed
