"""The TriFinger as CausalWorld 1.2 has it in Bullet.

What differs from ``client`` was found by comparing states step by step: the links are the convex
hulls of their meshes, the table is a plate, the wall a mesh, everything that can touch does,
robot and blocks lose speed as they move, spinning friction belongs to blocks and obstacles alone,
the solver may end early, and bodies meet in another order.

``meshes.npz`` has meshes of CausalWorld 1.2 (MIT license): the corners of the convex hulls of three
links and of the table, and the triangles of the wall, in the frames of the bodies [m].
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, final

import numpy as np

from scm_world._types import Floats
from scm_world.models.scene import ParameterKey
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.bullet import arena
from scm_world.tasks.trifinger.bullet.arena import link_index
from scm_world.tasks.trifinger.bullet.client import Handles, TriFingerClient

ROBOT_DAMPING, BLOCK_DAMPING = 0.5, 0.04
TABLE_TOP = -0.001  # [m] above it is the collision margin
LINKS = ("upper", "middle", "lower")
GROUND_HALF = (15.0, 15.0, 5.0)  # [m] a box under the table
GROUND_FRICTION = 1.0
SPINNING = (0.0, 1.0, 1.0)

MOVING, STILL = (1, -1), (2, -3)
"""The engine's own groups and masks: still bodies do not meet one another."""


@final
class PublishedClient(TriFingerClient):
    """A physics client with the TriFinger of the predecessor in it."""

    block_damping: ClassVar[float] = BLOCK_DAMPING

    def furnish(self) -> None:
        """Add what stands in every scene, in the order of the predecessor."""
        engine, handle = self.engine, self.handle
        ground = engine.createCollisionShape(
            engine.GEOM_BOX, halfExtents=GROUND_HALF, physicsClientId=handle
        )
        under = self._still(ground, -hardware.TABLE_OFFSET - GROUND_HALF[2])
        engine.changeDynamics(under, -1, lateralFriction=GROUND_FRICTION, physicsClientId=handle)
        with tempfile.TemporaryDirectory() as folder:
            files = {name: Path(folder) / f"{name}.stl" for name in meshes()}
            for name, file in files.items():
                file.write_bytes(_stl(meshes()[name]))
            links = {
                part: f'<geometry><mesh filename="{files[part]}"/></geometry>' for part in LINKS
            }
            robot = arena.add_robot(engine, handle, meshes=links, damping=ROBOT_DAMPING)
            floor, stage = (
                self._still(
                    engine.createCollisionShape(
                        engine.GEOM_MESH,
                        fileName=str(files[name]),
                        flags=flags,
                        physicsClientId=handle,
                    ),
                    TABLE_TOP,
                )
                for name, flags in (("table", 0), ("wall", engine.GEOM_FORCE_CONCAVE_TRIMESH))
            )
        self.bodies = Handles(robot, floor, (stage,), spinning=SPINNING, ground=under)
        engine.setPhysicsEngineParameter(deterministicOverlappingPairs=1, physicsClientId=handle)

    def _still(self, shape: int, height: float) -> int:
        """Add a body that never moves, at a height [m]."""
        body: int = self.engine.createMultiBody(
            0, shape, basePosition=[0.0, 0.0, height], physicsClientId=self.handle
        )
        return body

    def entered(self) -> Iterator[tuple[int, int, int, int]]:
        """List bodies and links, each with group and mask, in the order in which they meet."""
        bodies = self.bodies
        yield bodies.ground, -1, *STILL
        for finger in range(3):
            for link in (1, 2, 3):
                yield bodies.robot, link_index(finger, link), *MOVING
        for body in (bodies.floor, *bodies.stage, *bodies.obstacles.values()):
            yield body, -1, *STILL
        for body in bodies.blocks.values():
            yield body, -1, *MOVING

    def parameter(self, key: ParameterKey) -> Floats:
        """Ask the engine for a parameter; no link has a share of the spinning friction."""
        if key == ("world", "spinning_friction"):
            return np.array(self.applied[key])
        return super().parameter(key)


@cache
def meshes() -> dict[str, Floats]:
    """Return corners, shape (n, 3), or triangles, shape (n, 3, 3), by name [m]."""
    with np.load(Path(__file__).with_name("meshes.npz")) as file:
        return {name: file[name] for name in file.files}


def _stl(mesh: Floats) -> bytes:
    """Write triangles. Corners become one each: the engine takes their hull all the same."""
    rows: Any = np.zeros(len(mesh), [("numbers", "<f4", (4, 3)), ("attribute", "<u2")])
    rows["numbers"][:, 1:] = mesh if mesh.ndim == 3 else mesh[:, None]
    return bytes(80) + len(rows).to_bytes(4, "little") + bytes(rows)
