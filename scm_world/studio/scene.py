"""What a world shows, as the page reads it: shapes once, poses at every instant."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterable
from contextlib import suppress
from typing import Any, final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from scm_world._types import Floats
from scm_world.backends.base import ContactPoint
from scm_world.backends.renderer import shapes_of
from scm_world.errors import ModelError
from scm_world.models.scene import Scene
from scm_world.models.shapes import KINDS, Mesh, Shapes
from scm_world.studio.spec import FRAME, PACKED

MOST_TRIANGLES, FEW_TRIANGLES = 400_000, 20_000  # of all meshes; few without a graphics card
MOST_SCENES = 64  # lists of shapes that are remembered, so that the page need not get them again


@final
class SentShapes:
    """Numbers for lists of shapes and for meshes, so that each is sent once."""

    def __init__(self, *, coarse: bool = False) -> None:
        self._triangles = FEW_TRIANGLES if coarse else MOST_TRIANGLES
        self._known: dict[Any, tuple[int, Shapes]] = {}
        self._meshes: dict[int, tuple[int, Mesh]] = {}
        self._count = 0

    def place(self, scene: Scene | None) -> tuple[int, Floats, Floats, dict[str, Any] | None]:
        """Return the number of the shapes of a scene, and where they are.

        That is position and orientation (x, y, z, w) of each, shape (n, 7), then the vertices of
        all soft bodies, (k, 3); and the message that describes the shapes, if they are new.
        """
        shapes = Shapes.of([], [], [], [], [])
        if scene is not None:  # equations have none
            with suppress(ModelError):  # a step function has no shapes
                shapes = shapes_of(scene)
        table, n = shapes.table, len(shapes.table.kinds)
        look = table.kinds, table.halves, table.colors, table.bodies, table.tiles
        soft = {row: mesh for row, mesh in shapes.meshes.items() if table.bodies[row] < 0}
        meshes = tuple(
            (row, len(mesh.vertices) if row in soft else id(mesh))
            for row, mesh in shapes.meshes.items()
        )
        key = (*(column.tobytes() for column in look), meshes)
        message = None
        if key not in self._known:
            if len(self._known) >= MOST_SCENES:
                del self._known[next(iter(self._known))]
            self._known[key] = self._count, shapes  # keeps meshes alive, and so their ids
            self._count += 1
            message = self._described(self._known[key][0], shapes, scene)
        poses = np.zeros((n, 7), dtype=np.float64)
        if n:
            poses[:, :3] = table.positions
            poses[:, 3:] = Rotation.from_matrix(table.rotations).as_quat()
        vertices = np.concatenate([np.zeros((0, 3)), *(mesh.vertices for mesh in soft.values())])
        return self._known[key][0], poses, vertices, message

    def _described(self, number: int, shapes: Shapes, scene: Scene | None) -> dict[str, Any]:
        table, n = shapes.table, len(shapes.table.kinds)
        names = scene.structure.body_names if scene is not None and n else ()
        goals = scene.goals if scene is not None and n else ()
        sent, listed = [], []
        seen = {id(mesh): mesh for i, mesh in shapes.meshes.items() if table.colors[i, 3] > 0.0}
        triangles = max(1, sum(len(mesh.faces) for mesh in seen.values()))
        for i in range(n):
            mesh, body, tiles = None, table.bodies[i], table.tiles[i].tolist()
            if i in shapes.meshes:
                shown = shapes.meshes[i]
                known = self._meshes.get(id(shown))
                if known is None or known[1] is not shown:
                    known = self._meshes[id(shown)] = len(self._meshes) + 1000 * number, shown
                    most = max(self._triangles * len(shown.faces) // triangles, 200)
                    sent.append(_mesh(known[0], shown, most, soft=bool(body < 0)))
                mesh = known[0]
            listed.append(
                {
                    "kind": KINDS[table.kinds[i]],
                    "halves": table.halves[i].round(7).tolist(),
                    "color": table.colors[i].round(7).tolist(),
                    "mesh": mesh,
                    "soft": mesh is not None and bool(body < 0),
                    "body": names[body] if 0 <= body < len(names) else "",
                    "goal": goals[i - n].name if i >= n - len(goals) else "",
                    "moves": bool(table.moves[i]),
                    "tiles": [tiles[:2], tiles[2:]] if math.isfinite(tiles[0]) else None,
                }
            )
        return {"type": "scene", "scene": number, "shapes": listed, "meshes": sent}


def _mesh(number: int, mesh: Mesh, most: int, *, soft: bool) -> dict[str, Any]:
    """Write a mesh of at most so many triangles: vertices, normals and three corners of each.

    Of larger ones the vertices in each cell of a grid are joined (Rossignac and Borrel,
    "Multi-resolution 3D approximations", 1993). Corners of about one normal share it. A soft mesh
    stays as it is: its vertices come with each frame, and the page computes its normals.
    """
    vertices, faces, normals = mesh.vertices, mesh.faces, mesh.normals
    if soft:
        arrays = {"vertices": vertices.astype("<f4"), "corners": faces.astype("<u4")}
        return {"mesh": number, **arrays}
    cells = math.sqrt(most)
    while len(faces) > most:
        at = (mesh.vertices - mesh.low) * (cells / max(float((mesh.high - mesh.low).max()), 1e-12))
        code = at.astype(np.int64) @ (1, 1 << 20, 1 << 40)
        _, cell, count = np.unique(code, return_inverse=True, return_counts=True)
        faces = cell[mesh.faces]
        kept = (faces != np.roll(faces, 1, axis=1)).all(
            axis=1
        )  # corners that did not fall together
        faces, normals = faces[kept], mesh.normals[kept]
        sums = [np.bincount(cell, column) for column in mesh.vertices.T]
        vertices = np.stack(sums, axis=1) / count[:, None]
        cells *= min(0.9, 0.95 * math.sqrt(most / max(len(faces), 1)))
    corners, normals = faces.ravel(), normals.reshape(-1, 3)
    code = corners * 1000 + (np.round(2.0 * normals).astype(np.int64) + 2) @ (1, 10, 100)
    _, first, shared = np.unique(code, return_index=True, return_inverse=True)
    means = np.zeros((len(first), 4))
    means[:, :3] = np.stack([np.bincount(shared, column) for column in normals.T], axis=1)
    means *= 127.0 / np.maximum(np.linalg.norm(means, axis=1, keepdims=True), 1e-9)
    return {
        "mesh": number,
        "vertices": vertices[corners[first]].astype("<f4"),
        "normals": means.round().astype("<i1"),
        "corners": shared.astype("<u4"),
    }


def packed(message: dict[str, Any]) -> bytes:
    """Return a binary message: two 32-bit integers, JSON, and the arrays that it refers to."""
    parts: list[bytes] = []

    def put(array: NDArray[Any]) -> dict[str, Any]:
        at = sum(map(len, parts))
        parts.append(array.tobytes() + b"\0" * (-array.nbytes % 4))
        return {"array": array.dtype.str, "at": at, "n": array.size}

    text = json.dumps(message, default=put, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<2I", PACKED, len(text)) + text + b"".join(parts)


def touching(contacts: Iterable[ContactPoint]) -> tuple[Floats, frozenset[tuple[str, str]]]:
    """Return pressing contacts (position, normal, force), shape (k, 7), and the touching pairs."""
    found = [c for c in contacts if c.force > 0.0]
    rows = [[*c.position, *c.normal, c.force] for c in found]
    pairs = frozenset((min(c.bodies), max(c.bodies)) for c in found)
    return np.array(rows, dtype=np.float64).reshape(-1, 7), pairs


def frame(
    lane: int, scene: int, step: int, poses: Floats, contacts: Floats, vertices: Floats
) -> bytes:
    """Return a binary message: six 32-bit integers, then poses, contacts and vertices as floats."""
    head = struct.pack("<6I", FRAME, lane, scene, step, len(poses), len(contacts))
    return head + b"".join(part.astype("<f4").tobytes() for part in (poses, contacts, vertices))
