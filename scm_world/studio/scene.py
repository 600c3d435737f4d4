"""What a world shows, as the page reads it: shapes once, poses at every instant."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterable
from contextlib import suppress
from typing import Any, final

import numpy as np
from scipy.spatial.transform import Rotation

from scm_world._types import Floats
from scm_world.backends.base import ContactPoint
from scm_world.backends.renderer import shapes_of
from scm_world.errors import ModelError
from scm_world.models.scene import Scene
from scm_world.models.shapes import KINDS, Mesh, Shapes
from scm_world.studio.spec import FRAME, PACKED

MOST_TRIANGLES, FEW_TRIANGLES = 400_000, 30_000  # of all meshes; few without a graphics card
MOST_SCENES = 64  # lists of shapes that are remembered, so that the page need not get them again


@final
class SentShapes:
    """Numbers for lists of shapes and for meshes, so that each is sent once."""

    def __init__(self, triangles: int = MOST_TRIANGLES) -> None:
        self._triangles = triangles
        self._known: dict[Any, tuple[int, Shapes]] = {}
        self._meshes: dict[int, tuple[int, Mesh]] = {}
        self._count = 0

    def place(self, scene: Scene | None) -> tuple[int, Floats, Floats, dict[str, Any] | None]:
        """Return the shapes of a scene by number, and where they are.

        Returns:
            The number; for each shape position and orientation (x, y, z, w), shape (n, 7); the
            vertices of all skins and other soft bodies, shape (k, 3), whose triangles stay; and the
            message that describes the shapes, if there was none of this number before.
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

    def _described(self, number: int, shapes: Shapes, scene: Any) -> dict[str, Any]:
        table, n = shapes.table, len(shapes.table.kinds)
        names = scene.structure.body_names if n else ()
        goals = n - (len(scene.goals) if n else 0)
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
                    "halves": _short(table.halves[i]),
                    "color": _short(table.colors[i]),
                    "mesh": mesh,
                    "soft": mesh is not None and bool(body < 0),
                    "body": names[body] if 0 <= body < len(names) else "",
                    "goal": scene.goals[i - goals].name if i >= goals else "",
                    "moves": bool(table.moves[i]),
                    "tiles": [tiles[:2], tiles[2:]] if math.isfinite(tiles[0]) else None,
                }
            )
        return {"type": "scene", "scene": number, "shapes": listed, "meshes": sent}


def _short(numbers: Floats) -> list[float]:
    return [round(float(x), 7) for x in numbers]


def _mesh(number: int, mesh: Mesh, most: int, *, soft: bool) -> dict[str, Any]:
    """Write a mesh of at most about so many triangles: vertices, normals and three corners each.

    A soft one keeps its vertices, which come with each frame; the page computes its normals.
    """
    vertices, faces, normals = mesh.vertices, mesh.faces, mesh.normals
    if soft:
        parts = {"vertices": vertices.astype("<f4"), "corners": faces.astype("<u4")}
        return {"mesh": number, **parts}
    cells = math.sqrt(most)
    while len(faces) > most:
        vertices, faces, normals = _coarse(mesh, cells)
        cells *= min(0.9, 0.95 * math.sqrt(most / max(len(faces), 1)))
    whole = np.zeros((faces.size, 4), dtype="<i1")
    whole[:, :3] = np.round(127.0 * np.clip(normals.reshape(-1, 3), -1.0, 1.0))
    look = whole.view("<u4").ravel()
    if faces is not mesh.faces:  # one normal for each side of a box, so that edges stay sharp
        side = np.abs(whole.astype(np.int64)).argmax(axis=1)
        look = 2 * side + (np.take_along_axis(whole, side[:, None], axis=1).ravel() > 0)
    both = faces.ravel().astype(np.int64) << 32 | look
    _, first, corners = np.unique(both, return_index=True, return_inverse=True)
    means = np.stack([np.bincount(corners, axis) for axis in whole.T], axis=1)
    means *= 127.0 / np.maximum(np.linalg.norm(means, axis=1, keepdims=True), 1e-9)
    return {
        "mesh": number,
        "vertices": vertices[faces.ravel()[first]].astype("<f4"),
        "normals": means.round().astype("<i1"),
        "corners": corners.astype("<u4"),
    }


def _coarse(mesh: Mesh, cells: float) -> tuple[Floats, Any, Floats]:
    """Join the vertices in each cell of a grid; triangles whose corners fall together go.

    Source: Rossignac and Borrel, "Multi-resolution 3D approximations", 1993.
    """
    size = max(float((mesh.high - mesh.low).max()), 1e-12) / cells
    at = np.floor((mesh.vertices - mesh.low) / size).astype(np.int64)
    _, cell, count = np.unique(at @ (1, 1 << 20, 1 << 40), return_inverse=True, return_counts=True)
    sums = [np.bincount(cell, mesh.vertices[:, axis]) for axis in range(3)]
    faces = cell.ravel()[mesh.faces]
    kept = np.flatnonzero((faces != np.roll(faces, 1, axis=1)).all(axis=1))
    _, first = np.unique(np.sort(faces[kept], axis=1) @ (1, 1 << 20, 1 << 40), return_index=True)
    first = kept[first]
    return np.stack(sums, axis=1) / count[:, None], faces[first], mesh.normals[first]


def packed(message: dict[str, Any]) -> bytes:
    """Return a binary message: two 32-bit integers, JSON, and the arrays that it refers to."""
    parts: list[bytes] = []

    def put(array: Any) -> dict[str, Any]:
        at = sum(map(len, parts))
        parts.append(array.tobytes() + b"\0" * (-array.nbytes % 4))
        return {"array": array.dtype.str, "at": at, "n": array.size}

    text = json.dumps(message, default=put, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<2I", PACKED, len(text)) + text + b"".join(parts)


def touching(contacts: Iterable[ContactPoint]) -> tuple[Floats, frozenset[tuple[str, str]]]:
    """Return the contacts that press, position, normal and force, (k, 7), and who touches whom."""
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
