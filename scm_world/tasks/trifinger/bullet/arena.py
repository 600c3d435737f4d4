"""What stands in every scene, and who may touch whom.

The engine lets two bodies collide if each one's mask has the other's group. Blocks keep the
engine's default (group 1, all in the mask), so that nothing has to be said when one is made.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from scm_world.geometry.hulls import Hull
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.hardware import (
    WALL_HEIGHT,
    WALL_RADIUS,
    WALL_SEGMENTS,
    WALL_THICKNESS,
    Capsule,
    Inertial,
)

LINKS_IN_ENGINE = 5  # of each finger, the tip included; link k of finger f has index 5 f + k

JOINTS = tuple(LINKS_IN_ENGINE * finger + link for finger in range(3) for link in (1, 2, 3))
"""Indices of the nine hinges."""

PARTS = ("upper", "middle", "lower", "tip")
"""The colliding links of a finger; part k has index 5 f + k + 1."""

_UNIT = Inertial((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), (1.0, 1.0, 1.0))


def link_index(finger: int, link: int) -> int:
    """Give the engine's index of a link; the tip is link 4."""
    return LINKS_IN_ENGINE * finger + link


def robot_urdf(meshes: Mapping[str, str] | None = None) -> str:
    """Describe the whole robot.

    Args:
        meshes: Files with the collision shapes of the parts that have one; capsules if None.
    """
    forms = meshes or {part: _capsule(shape) for part, shape in hardware.COLLISION.items()}
    lines = ['<robot name="trifinger">', _link("base", 1.0, _UNIT, None)]
    for finger in range(3):
        lines.extend(_finger(finger, forms))
    lines.append("</robot>")
    return "\n".join(lines)


def _finger(finger: int, forms: Mapping[str, str]) -> Iterator[str]:
    """Describe the five links of a finger and the joints above them."""
    names = [hardware.link_name(hardware.FINGERS[finger], link) for link in range(4)]
    names.append(f"{names[3]}_tip")
    x, y, z = (moment / hardware.TIP_MASS for moment in hardware.TIP_INERTIA)
    inertials = (*hardware.INERTIAL, Inertial(_UNIT.center, _UNIT.orientation, (x, y, z)))
    masses = (*hardware.LINK_MASS, hardware.TIP_MASS)
    for link, name in enumerate(names):
        form = forms.get(PARTS[link - 1]) if link else None
        yield _link(name, masses[link], inertials[link], form)
    offset, yaw = hardware.FINGER_OFFSET[finger], hardware.FINGER_YAW[finger]
    yield _joint("base", names[0], offset, yaw=yaw)
    for joint in range(3):
        yield _joint(names[joint], names[joint + 1], hardware.JOINT_ORIGINS[joint], hinge=joint)
    yield _joint(names[3], names[4], hardware.TIP_ORIGIN)


def _link(name: str, mass: float, inertial: Inertial, form: str | None) -> str:
    moments = zip(("ixx", "iyy", "izz"), inertial.per_mass, strict=True)
    inertia = " ".join(f'{axis}="{mass * moment!r}"' for axis, moment in moments)
    return (
        f'<link name="{name}"><inertial>{_origin(inertial.center, _rpy(inertial.orientation))}'
        f'<mass value="{mass!r}"/><inertia {inertia} ixy="0" ixz="0" iyz="0"/></inertial>'
        f"{_shapes(form)}</link>"
    )


def _shapes(form: str | None) -> str:
    """Describe a collision shape and its picture. A link without the former has a picture only."""
    if form is None:
        return '<visual><geometry><box size="0.02 0.02 0.02"/></geometry></visual>'
    return f"<visual>{form}</visual><collision>{form}</collision>"


def _capsule(shape: Capsule) -> str:
    x, y, z = (end - start for start, end in zip(shape.start, shape.end, strict=True))
    middle = tuple((start + end) / 2 for start, end in zip(shape.start, shape.end, strict=True))
    tilt = (0.0, math.atan2(math.hypot(x, y), abs(z)), math.atan2(y, x))  # from the z axis
    capsule = f'<capsule radius="{shape.radius!r}" length="{math.hypot(x, y, z)!r}"/>'
    return f"{_origin(middle, tilt)}<geometry>{capsule}</geometry>"


def _joint(
    parent: str,
    child: str,
    origin: tuple[float, ...],
    *,
    yaw: float = 0.0,
    hinge: int | None = None,
) -> str:
    kind, axis = "fixed", ""
    if hinge is not None:
        limit = hardware.ENGINE_LIMITS[hinge]
        kind = "revolute"
        axis = (
            f'<axis xyz="{_numbers(hardware.JOINT_AXES[hinge])}"/>'
            f'<limit lower="{-limit!r}" upper="{limit!r}" effort="1000" velocity="1000"/>'
        )
    return (
        f'<joint name="to_{child}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f"{_origin(origin, (0.0, 0.0, yaw))}{axis}</joint>"
    )


def _origin(xyz: tuple[float, ...], rpy: tuple[float, ...]) -> str:
    return f'<origin xyz="{_numbers(xyz)}" rpy="{_numbers(rpy)}"/>'


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(map(repr, values))


def _rpy(quaternion: tuple[float, float, float, float]) -> tuple[float, float, float]:
    """Turn (x, y, z, w) into roll, pitch and yaw about fixed axes [rad]."""
    x, y, z, w = quaternion
    return (
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x)))),
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
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
