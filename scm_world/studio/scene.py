"""What a world shows, as the page reads it: shapes once, poses at every instant."""

from __future__ import annotations

import struct
from base64 import b64encode
from collections.abc import Iterable
from contextlib import suppress
from math import isfinite
from typing import Any, final

import numpy as np
from scipy.spatial.transform import Rotation

from scm_world._types import Floats
from scm_world.backends.base import ContactPoint
from scm_world.backends.renderer import shapes_of
from scm_world.errors import ModelError
from scm_world.models.scene import Scene
from scm_world.models.shapes import KINDS, Mesh, Shapes

FRAME = 1
"""The first number of a binary message that is a frame."""

MOST_SCENES = 64  # lists of shapes that are remembered, so that the page need not get them again


@final
class SentShapes:
    """Numbers for lists of shapes and for meshes, so that each is sent once."""

    def __init__(self) -> None:
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
        for i in range(n):
            mesh, body, tiles = None, table.bodies[i], table.tiles[i].tolist()
            if i in shapes.meshes:
                shown = shapes.meshes[i]
                known = self._meshes.get(id(shown))
                if known is None or known[1] is not shown:
                    known = self._meshes[id(shown)] = len(self._meshes) + 1000 * number, shown
                    sent.append(_mesh(known[0], shown))
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
                    "tiles": [tiles[:2], tiles[2:]] if isfinite(tiles[0]) else None,
                }
            )
        return {"type": "scene", "scene": number, "shapes": listed, "meshes": sent}


def _short(numbers: Floats) -> list[float]:
    return [round(float(x), 7) for x in numbers]


def _mesh(number: int, mesh: Mesh) -> dict[str, Any]:
    """Write a mesh: vertices as 32-bit floats, faces as 32-bit and normals as 8-bit integers."""
    parts = {
        "vertices": mesh.vertices.astype("<f4"),
        "faces": mesh.faces.astype("<u4"),
        "normals": np.round(127.0 * np.clip(mesh.normals, -1.0, 1.0)).astype("<i1"),
    }
    coded = {name: b64encode(part.tobytes()).decode() for name, part in parts.items()}
    return {"mesh": number, **coded}


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
