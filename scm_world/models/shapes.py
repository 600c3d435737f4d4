"""Shapes in the world: the contents of a picture. Engine-free."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scm_world._types import ArrayLike, Floats, Integers

KINDS = ("box", "ellipsoid", "capsule", "cylinder", "plane", "mesh")
BOX, ELLIPSOID, CAPSULE, CYLINDER, PLANE, MESH = range(len(KINDS))

GOAL_OPACITY = 0.3  # Source: CausalWorld 1.2, silhouettes

PLAIN = np.array([np.inf, np.inf, 0.0, 0.0, 0.0])
"""The tiles of a plane without a checkerboard."""

_UNIT_CUBE = np.array(list(product((0.0, 1.0), repeat=3)))


class Mesh(NamedTuple):
    """Triangles.

    Attributes:
        vertices: Shape (n, 3) [m].
        faces: Three vertices each, counterclockwise seen from outside, shape (m, 3).
        normals: Unit outward normals at the three corners of each triangle, shape (m, 3, 3).
        low: Least coordinates, shape (3,) [m].
        high: Greatest coordinates, shape (3,) [m].
    """

    vertices: Floats
    faces: Integers
    normals: Floats
    low: Floats
    high: Floats


class ShapeTable(NamedTuple):
    """The numbers of shapes, one row each.

    Capsules and cylinders lie along the third axis of their frame. A plane is seen from the side
    of its third axis only. On a plane there may be a checkerboard; its first tile, of the color of
    the plane, is the one with the least x and the greatest y. Along an axis along which the plane
    does not end, it is the one whose edge with the least x, or the greatest y, is at 0.

    Attributes:
        kinds: Indices into ``KINDS``, shape (n,).
        halves: Half the edges of the box around each in its own frame, shape (n, 3) [m]; of a
            plane, 0 along an axis along which it does not end; of a mesh, without meaning.
        positions: Origins of their frames in the world, shape (n, 3) [m].
        rotations: From their frames to the world, shape (n, 3, 3).
        colors: Red, green, blue and opacity in [0, 1], shape (n, 4).
        bodies: Numbers of the bodies that they belong to, -1 for none, shape (n,).
        moves: Whether these bodies can move, shape (n,).
        tiles: Edges of a tile along the first and the second axis [m], and red, green, blue of
            every other tile, shape (n, 5); without a checkerboard the edges are infinite.
    """

    kinds: Integers
    halves: Floats
    positions: Floats
    rotations: Floats
    colors: Floats
    bodies: Integers
    moves: NDArray[np.bool_]
    tiles: Floats


class Shapes(NamedTuple):
    """Things to draw.

    Attributes:
        table: Their numbers.
        meshes: Triangles in the frame of the shape, by row.
    """

    table: ShapeTable
    meshes: Mapping[int, Mesh]

    @classmethod
    def of(
        cls,
        kinds: Sequence[int],
        halves: Sequence[ArrayLike],
        positions: Sequence[ArrayLike],
        rotations: Sequence[ArrayLike],
        colors: Sequence[ArrayLike],
        bodies: Sequence[int] | None = None,
        moves: Sequence[bool] | None = None,
    ) -> Shapes:
        """Collect shapes without checkerboards or meshes; by default none moves."""
        n = len(kinds)
        table = ShapeTable(
            np.array(kinds, dtype=np.int64),
            np.array(halves, dtype=np.float64).reshape(n, 3),
            np.array(positions, dtype=np.float64).reshape(n, 3),
            np.array(rotations, dtype=np.float64).reshape(n, 3, 3),
            np.array(colors, dtype=np.float64).reshape(n, 4),
            np.array([-1] * n if bodies is None else bodies, dtype=np.int64),
            np.array([False] * n if moves is None else moves, dtype=np.bool_),
            np.tile(PLAIN, (n, 1)),
        )
        return cls(table, {})

    def joined(self, others: Shapes) -> Shapes:
        """Return these shapes, then others."""
        n = len(self.table.kinds)
        pairs = zip(self.table, others.table, strict=True)
        columns: list[Any] = [np.concatenate(pair) for pair in pairs]
        return Shapes(
            ShapeTable(*columns), {**self.meshes, **{n + i: m for i, m in others.meshes.items()}}
        )

    def corners(self, rows: Integers) -> Floats:
        """Compute the corners in the world of the boxes around some shapes, (k, 8, 3) [m]."""
        table = self.table
        high = table.halves[rows]
        low = -high
        for k, row in enumerate(rows.tolist()):
            if row in self.meshes:
                low[k], high[k] = self.meshes[row].low, self.meshes[row].high
        local = low[:, None] + _UNIT_CUBE * (high - low)[:, None]  # (k, 8, 3)
        turned = local @ table.rotations[rows].transpose(0, 2, 1)
        return table.positions[rows][:, None] + turned


def mesh_of(vertices: ArrayLike, faces: ArrayLike, normals: ArrayLike | None = None) -> Mesh:
    """Make a mesh; its normals are those of the triangles if not given."""
    vertices = np.array(vertices, dtype=np.float64)
    faces = np.array(faces, dtype=np.int64)
    if normals is None:
        first, second, third = (vertices[faces[:, i]] for i in range(3))
        flat = np.cross(second - first, third - first)
        flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-300)
        normals = np.repeat(flat[:, None], 3, axis=1)
    normals = np.array(normals, dtype=np.float64)
    return Mesh(vertices, faces, normals, vertices.min(axis=0), vertices.max(axis=0))
