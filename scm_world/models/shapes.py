"""What a picture shows: shapes in the world. Engine-free."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scm_world._types import ArrayLike, Floats, Integers

Kind = Literal["box", "ellipsoid", "capsule", "cylinder", "plane", "mesh"]

KINDS: tuple[Kind, ...] = ("box", "ellipsoid", "capsule", "cylinder", "plane", "mesh")
BOX, ELLIPSOID, CAPSULE, CYLINDER, PLANE, MESH = range(len(KINDS))

GOAL_OPACITY = 0.3  # Source: CausalWorld 1.2, silhouettes

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


class Tiles(NamedTuple):
    """The checkerboard on a plane; the shape has the color of the first tile.

    The first tile is the one with the least x and the greatest y. Along an axis along which the
    plane does not end, it is the one whose edge with the least x, or the greatest y, is at 0.

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
            0 along an axis along which it does not end; of a mesh, without meaning.
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


class ShapeTable(NamedTuple):
    """The numbers of shapes, one row each; see ``Shape``.

    Attributes:
        kinds: Indices into ``KINDS``, shape (n,).
        halves: Shape (n, 3) [m].
        positions: Shape (n, 3) [m].
        rotations: Shape (n, 3, 3).
        colors: Shape (n, 4).
        bodies: Shape (n,).
    """

    kinds: Integers
    halves: Floats
    positions: Floats
    rotations: Floats
    colors: Floats
    bodies: Integers


class Shapes(NamedTuple):
    """Things to draw.

    Attributes:
        table: Their numbers.
        moves: Whether the body of each can move, shape (n,).
        meshes: Triangles, by row.
        tiles: Checkerboards on planes, by row.
    """

    table: ShapeTable
    moves: NDArray[np.bool_]
    meshes: Mapping[int, Mesh]
    tiles: Mapping[int, Tiles]

    @classmethod
    def of(cls, shapes: Sequence[Shape]) -> Shapes:
        """Collect shapes."""
        n = len(shapes)
        table = ShapeTable(
            np.array([KINDS.index(shape.kind) for shape in shapes], dtype=np.int64),
            np.array([shape.halves for shape in shapes], dtype=np.float64).reshape(n, 3),
            np.array([shape.position for shape in shapes], dtype=np.float64).reshape(n, 3),
            np.array([shape.rotation for shape in shapes], dtype=np.float64).reshape(n, 3, 3),
            np.array([shape.color for shape in shapes], dtype=np.float64).reshape(n, 4),
            np.array([shape.body for shape in shapes], dtype=np.int64),
        )
        meshes = {i: shape.mesh for i, shape in enumerate(shapes) if shape.mesh is not None}
        tiles = {i: shape.tiles for i, shape in enumerate(shapes) if shape.tiles is not None}
        return cls(table, np.array([shape.moves for shape in shapes], dtype=bool), meshes, tiles)

    def listed(self) -> list[Shape]:
        """List the shapes."""
        table = self.table
        return [
            Shape(
                KINDS[table.kinds[i]],
                table.halves[i],
                table.positions[i],
                table.rotations[i],
                table.colors[i],
                int(table.bodies[i]),
                bool(self.moves[i]),
                self.meshes.get(i),
                self.tiles.get(i),
            )
            for i in range(len(self.moves))
        ]

    def joined(self, others: Shapes) -> Shapes:
        """Return these shapes, then others."""
        n = len(self.moves)
        columns = zip(self.table, others.table, strict=True)
        return Shapes(
            ShapeTable(*(np.concatenate(pair) for pair in columns)),
            np.concatenate([self.moves, others.moves]),
            {**self.meshes, **{n + i: mesh for i, mesh in others.meshes.items()}},
            {**self.tiles, **{n + i: tiles for i, tiles in others.tiles.items()}},
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
        found: Floats = table.positions[rows][:, None] + turned
        return found


def mesh_of(vertices: ArrayLike, faces: ArrayLike, normals: ArrayLike | None = None) -> Mesh:
    """Make a mesh.

    Args:
        vertices: Shape (n, 3) [m].
        faces: Counterclockwise seen from outside, shape (m, 3).
        normals: See ``Mesh``; those of the triangles if not given.

    Example:
        >>> mesh_of(np.eye(3), [[0, 1, 2]]).normals[0, 0].round(3).tolist()
        [0.577, 0.577, 0.577]
    """
    vertices = np.array(vertices, dtype=np.float64)
    faces = np.array(faces, dtype=np.int64)
    if normals is None:
        first, second, third = (vertices[faces[:, i]] for i in range(3))
        flat = np.cross(second - first, third - first)
        flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-300)
        normals = np.repeat(flat[:, None], 3, axis=1)
    normals = np.array(normals, dtype=np.float64)
    return Mesh(vertices, faces, normals, vertices.min(axis=0), vertices.max(axis=0))
