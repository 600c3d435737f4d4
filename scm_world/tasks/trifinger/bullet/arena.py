"""What stands in every scene, and who may touch whom.

The engine lets two bodies collide if each one's mask has the other's group. Blocks keep the
engine's default (group 1, all in the mask), so that nothing has to be said when one is made.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scm_world.geometry.hulls import Hull
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.bullet.description import JOINTS, PARTS, link_index, robot_urdf
from scm_world.tasks.trifinger.structure import (
    WALL_HEIGHT,
    WALL_RADIUS,
    WALL_SEGMENTS,
    WALL_THICKNESS,
)

Shape = list[float] | Hull
"""Full edge lengths of a box [m], or a polyhedron."""

BLOCK, FLOOR, WALL, UPPER = 1, 2, 4, 8
MIDDLE, LOWER = (16, 32, 64), (128, 256, 512)  # one for each finger; the tip counts as lower
OBSTACLE = 1024

FLOOR_MASK = BLOCK | sum(MIDDLE) | sum(LOWER)
WALL_MASK = BLOCK | sum(LOWER)
OBSTACLE_MASK = BLOCK | sum(MIDDLE) | sum(LOWER)

FASTEST_JOINT = 1000.0  # [rad/s] the engine would cut at 100

BLOCK_SPINNING, OTHER_SPINNING = 0.5, 0.75
"""What a body gets of the spinning friction of the scene. The engine combines two bodies to
``s1 f2 + s2 f1`` with the frictions f; with these two shares a contact between a block and
anything else has the spinning friction of the scene at the default frictions."""

HULL_MARGIN = 1e-5  # [m] a mesh is inflated by so much; the solver lets bodies sink in as much

COLLIDING_LINKS = tuple(link_index(finger, part + 1) for finger in range(3) for part in range(4))


def groups(finger: int, part: str) -> tuple[int, int]:
    """Give the group and the mask of a link of the robot.

    A link never meets its own finger. Upper links meet blocks only; the middle ones also the
    floor, obstacles and the other fingers; the tips, which are the outermost points, also the wall.
    """
    others = sum(MIDDLE[k] | LOWER[k] for k in range(3) if k != finger)
    if part == "upper":
        return UPPER, BLOCK
    if part == "middle":
        return MIDDLE[finger], BLOCK | FLOOR | OBSTACLE | others
    wall = WALL if part == "tip" else 0
    return LOWER[finger], BLOCK | FLOOR | OBSTACLE | wall | others


LINK_GROUPS = tuple(
    (link_index(finger, index + 1), *groups(finger, part))
    for finger in range(3)
    for index, part in enumerate(PARTS)
)
"""Index, group and mask of the twelve colliding links."""


def add_floor(engine: Any, client: int) -> int:
    """Add the table top: the plane z = 0, without the margin that a mesh would have."""
    shape = engine.createCollisionShape(
        engine.GEOM_PLANE, planeNormal=[0, 0, 1], physicsClientId=client
    )
    return _add_static(engine, client, shape, group=FLOOR, mask=FLOOR_MASK)


def add_stage(engine: Any, client: int) -> tuple[int, ...]:
    """Add the ring wall: boxes around a regular polygon whose sides touch the inner circle."""
    half_turn = math.pi / WALL_SEGMENTS
    half_width = (WALL_RADIUS + WALL_THICKNESS) * math.tan(half_turn)
    shape = engine.createCollisionShape(
        engine.GEOM_BOX,
        halfExtents=[WALL_THICKNESS / 2, half_width, WALL_HEIGHT / 2],
        physicsClientId=client,
    )
    radius = WALL_RADIUS + WALL_THICKNESS / 2
    walls = []
    for segment in range(WALL_SEGMENTS):
        angle = 2 * half_turn * segment
        pose = {
            "basePosition": [radius * math.cos(angle), radius * math.sin(angle), WALL_HEIGHT / 2],
            "baseOrientation": [0, 0, math.sin(angle / 2), math.cos(angle / 2)],
        }
        wall = _add_static(engine, client, shape, group=WALL, mask=WALL_MASK, **pose)
        walls.append(wall)
    return tuple(walls)


def _add_static(
    engine: Any, client: int, shape: int, *, group: int, mask: int, **pose: list[float]
) -> int:
    """Add a body that never moves, as a rigid body: the engine then has nothing to do for it."""
    body: int = engine.createMultiBody(
        0, shape, useMaximalCoordinates=True, physicsClientId=client, **pose
    )
    engine.setCollisionFilterGroupMask(body, -1, group, mask, physicsClientId=client)
    return body


def add_obstacle(engine: Any, client: int, shape: Shape) -> int:
    """Add a body that never moves; its pose, friction and so on are set afterwards."""
    form = _form(engine, client, shape)
    return _add_static(engine, client, form, group=OBSTACLE, mask=OBSTACLE_MASK)


def _form(engine: Any, client: int, shape: Shape) -> int:
    """Make a collision shape."""
    form: int
    if isinstance(shape, Hull):
        form = engine.createCollisionShape(  # it never lets go of a list
            engine.GEOM_MESH, vertices=shape.vertices, physicsClientId=client
        )
    else:
        form = engine.createCollisionShape(
            engine.GEOM_BOX, halfExtents=[edge / 2 for edge in shape], physicsClientId=client
        )
    return form


def add_block(engine: Any, client: int, shape: Shape, *, damping: float = 0.0) -> int:
    """Add a block; its mass, friction and so on are set afterwards.

    Blocks are multibodies, not the engine's rigid bodies: those are faster in piles, but their
    friction is 12 % off, and they do not become canonical without being made anew.
    """
    form = _form(engine, client, shape)
    block: int = engine.createMultiBody(1.0, form, physicsClientId=client)
    if isinstance(shape, Hull):
        engine.changeDynamics(block, -1, collisionMargin=HULL_MARGIN, physicsClientId=client)
    _dampen(engine, client, block, damping)
    engine.changeDynamics(
        block, -1, activationState=engine.ACTIVATION_STATE_DISABLE_SLEEPING, physicsClientId=client
    )
    return block


def _dampen(engine: Any, client: int, body: int, damping: float) -> None:
    """Set how fast a body loses speed. Beside it, any other change would land on the base."""
    engine.changeDynamics(body, -1, linearDamping=damping, physicsClientId=client)
    engine.changeDynamics(body, -1, angularDamping=damping, physicsClientId=client)


def add_robot(
    engine: Any, client: int, *, meshes: Mapping[str, str] | None = None, damping: float = 0.0
) -> int:
    """Add the robot without motors; ``meshes`` are those of ``robot_urdf``."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "trifinger.urdf"
        file.write_text(robot_urdf(meshes))
        robot: int = engine.loadURDF(
            str(file),
            useFixedBase=True,
            flags=engine.URDF_USE_INERTIA_FROM_FILE | engine.URDF_USE_SELF_COLLISION,
            physicsClientId=client,
        )
    _dampen(engine, client, robot, damping)
    engine.changeDynamics(robot, -1, maxJointVelocity=FASTEST_JOINT, physicsClientId=client)
    for link in range(link_index(3, 0)):
        engine.changeDynamics(robot, link, jointDamping=0, physicsClientId=client)
    engine.setJointMotorControlArray(
        robot, JOINTS, engine.VELOCITY_CONTROL, forces=[0.0] * len(JOINTS), physicsClientId=client
    )
    return robot


def robot_pose(height: float) -> tuple[list[float], list[float]]:
    """Give position [m] and orientation (x, y, z, w) of the robot's base."""
    yaw = hardware.WORLD_YAW
    z = height - hardware.TABLE_OFFSET
    return [0.0, 0.0, z], [0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)]
