"""What a picture shows: shapes in the world. Engine-free."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from scm_world._types import Floats, Integers

Kind = Literal["box", "sphere", "capsule", "cylinder", "ellipsoid", "plane", "mesh"]


class Mesh(NamedTuple):
    """Triangles.

    Attributes:
        vertices: Shape (n, 3) [m].
        faces: Three vertices each, counterclockwise seen from outside, shape (m, 3).
        normals: Unit outward normals at the three corners of each triangle, shape (m, 3, 3).
    """

    vertices: Floats
    faces: Integers
    normals: Floats


class Tiles(NamedTuple):
    """The checkerboard on a plane.

    Attributes:
        size: Edges of a tile along the first and the second axis, shape (2,) [m].
        color: Red, green, blue in [0, 1] of every other tile, shape (3,).
    """

    size: tuple[float, float]
    color: tuple[float, float, float]


class Shape(NamedTuple):
    """One thing to draw.

    Capsules and cylinders lie along the third axis of their frame. A plane is seen from the side
    of its third axis only.

    Attributes:
        kind: What it is.
        halves: Half the edges of the box around it in its own frame, shape (3,) [m]; of a plane,
            0 along an axis along which it does not end.
        position: Origin of its frame in the world, shape (3,) [m].
        rotation: From its frame to the world, shape (3, 3).
        color: Red, green, blue and opacity in [0, 1], shape (4,).
        body: Number of the body that it belongs to, -1 if it belongs to none.
        moves: Whether that body can move.
        mesh: The triangles of a mesh, in its frame.
        tiles: The checkerboard on a plane, if there is one.
    """

    kind: Kind
    halves: Floats
    position: Floats
    rotation: Floats
    color: Floats
    body: int = -1
    moves: bool = False
    mesh: Mesh | None = None
    tiles: Tiles | None = None


def mesh_of(vertices: Floats, faces: Integers) -> Mesh:
    """Make a mesh with flat sides, whose normals are those of its triangles.

    Args:
        vertices: Shape (n, 3) [m].
        faces: Counterclockwise seen from outside, shape (m, 3).

    Example:
        >>> mesh_of(np.eye(3), np.array([[0, 1, 2]])).normals[0, 0].round(3).tolist()
        [0.577, 0.577, 0.577]
    """
    first, second, third = (vertices[faces[:, i]] for i in range(3))
    normals = np.cross(second - first, third - first)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return Mesh(vertices, faces, np.repeat(normals[:, None], 3, axis=1))


def corners(shape: Shape) -> Floats:
    """Give the corners in the world of the box around a shape, shape (8, 3) [m]."""
    signs = np.array(np.meshgrid((-1.0, 1.0), (-1.0, 1.0), (-1.0, 1.0))).reshape(3, 8).T
    points: Floats = shape.position + (signs * shape.halves) @ shape.rotation.T
    return points
