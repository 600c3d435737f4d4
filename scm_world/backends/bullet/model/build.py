"""The bodies of a model in a physics client.

What can move is one multibody for each body that hangs on the world. A body is one link for each
of its joints, all but the last without mass, and each of its shapes is a further link without
mass that is fixed to the last. So shapes of one body can differ in what they touch, have frames
of their own, and no link has two of them. A shape that cannot move is a body by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, final

import numpy as np

from scm_world._types import Floats
from scm_world.geometry.rotations import (
    from_rotation_matrix,
    quaternion_product,
    rotation_matrix,
)
from scm_world.models.bodies import Geom, Joint, ModelBodies

Handle = tuple[int, int]
"""A multibody and a link of it; -1 is its base."""

MOVING, STATIC = 1, 2
"""Collision groups. What cannot move never touches what cannot move."""

FASTEST = 1e4  # [rad/s] or [m/s]; the engine would cut at 100
HULL_MARGIN = 1e-5  # [m] a mesh is inflated by so much
GEAR_ERP = 0.2  # share of the error of a coupling that a step takes away
STRONGEST = 1e9  # [N m] or [N] of a coupling

_UNTURNED = np.array([0.0, 0.0, 0.0, 1.0])


@final
@dataclass
class Built:
    """The engine's numbers of everything.

    Attributes:
        bodies: The link that carries the mass of each body that can move, by its number.
        joints: The link of each joint; the base of a free body.
        geoms: The link of each shape.
        groups: Link, group and mask of each shape that can move.
        owners: Name of the body of each link that is a shape.
    """

    bodies: dict[int, Handle] = field(default_factory=dict)
    joints: list[Handle] = field(default_factory=list)
    geoms: list[Handle] = field(default_factory=list)
    groups: list[tuple[int, int, int, int]] = field(default_factory=list)
    owners: dict[Handle, str] = field(default_factory=dict)


COLUMNS = (
    "linkMasses",
    "linkCollisionShapeIndices",
    "linkVisualShapeIndices",
    "linkPositions",
    "linkOrientations",
    "linkInertialFramePositions",
    "linkInertialFrameOrientations",
    "linkParentIndices",
    "linkJointTypes",
    "linkJointAxis",
)
"""Arguments of ``createMultiBody`` for every link."""


@final
class _Links:
    """The links of a multibody that is not made yet.

    Args:
        engine: The module ``pybullet``.

    Attributes:
        rows: Arguments for each: see ``COLUMNS``.
    """

    def __init__(self, engine: Any) -> None:
        self._fixed = engine.JOINT_FIXED
        self.rows: list[list[Any]] = []

    def add(
        self,
        parent: int,
        position: Floats,
        orientation: Floats,
        *,
        shape: int = -1,
        kind: int | None = None,
        axis: tuple[float, ...] = (0.0, 0.0, 1.0),
    ) -> int:
        """Add a link without mass whose frame is given in that of its parent."""
        frame = [position.tolist(), orientation.tolist(), [0.0, 0.0, 0.0], _UNTURNED.tolist()]
        joint = [self._fixed if kind is None else kind, list(axis)]
        # The engine counts parents from the base.
        self.rows.append([0.0, shape, -1, *frame, parent + 1, *joint])
        return len(self.rows) - 1

    def load(self, link: int, mass: float, center: Floats, axes: Floats) -> None:
        """Give a link a mass, whose center and principal axes are in the frame of the link."""
        row = self.rows[link]
        row[0], row[5], row[6] = mass, center.tolist(), axes.tolist()


def build(engine: Any, client: int, bodies: ModelBodies) -> Built:
    """Make everything, in an empty client; without motors, damping and sleep."""
    built = Built(joints=[(-1, -1)] * len(bodies.joints), geoms=[(-1, -1)] * len(bodies.geoms))
    roots = bodies.roots
    places = places_of_fixed(bodies)
    for number, geom in enumerate(bodies.geoms):
        if not roots[geom.body]:
            position, turn = _composed(*places[geom.body], geom.position, geom.orientation)
            fixed = engine.createMultiBody(
                0,
                _shape(engine, client, geom),
                basePosition=position.tolist(),
                baseOrientation=turn.tolist(),
                useMaximalCoordinates=True,
                physicsClientId=client,
            )
            built.geoms[number] = (fixed, -1)
    for root in sorted(set(roots) - {0}):
        members = [number for number, other in enumerate(roots) if other == root]
        _add_tree(engine, client, bodies, members, places, built)
    for number, handle in enumerate(built.geoms):
        built.owners[handle] = bodies.bodies[bodies.geoms[number].body].name
        if bodies.geoms[number].kind == "mesh":
            engine.changeDynamics(*handle, collisionMargin=HULL_MARGIN, physicsClientId=client)
    _couple(engine, client, bodies, built)
    _choose_pairs(engine, client, bodies, roots, built)
    return built


def matrix_of(turn: Sequence[float] | Floats) -> Floats:
    """Give the rotation matrix of a quaternion, which is cached: it must not be changed."""
    return _matrix_of(*map(float, turn))


@lru_cache(maxsize=4096)
def _matrix_of(x: float, y: float, z: float, w: float) -> Floats:
    return rotation_matrix((x, y, z, w))


def _composed(
    position: Floats, turn: Floats, offset: Any, orientation: Any
) -> tuple[Floats, Floats]:
    """Give in the outer frame what is given in the frame at a position, turned so."""
    moved: Floats = position + matrix_of(turn) @ np.array(offset)
    return moved, quaternion_product(turn, np.array(orientation))


def places_of_fixed(bodies: ModelBodies) -> dict[int, tuple[Floats, Floats]]:
    """Give position and orientation in the world of the bodies that cannot move."""
    places = {0: (np.zeros(3), _UNTURNED)}
    for number, body in enumerate(bodies.bodies):
        if number and not bodies.roots[number]:
            places[number] = _composed(*places[body.parent], body.position, body.orientation)
    return places


def _shape(engine: Any, client: int, geom: Geom) -> int:
    """Make a collision shape."""
    size: dict[str, Any]
    match geom.kind:
        case "plane":
            kind, size = engine.GEOM_PLANE, {"planeNormal": [0.0, 0.0, 1.0]}
        case "sphere":
            kind, size = engine.GEOM_SPHERE, {"radius": geom.size[0]}
        case "box":
            kind, size = engine.GEOM_BOX, {"halfExtents": list(geom.size)}
        case "mesh":  # the engine keeps what it is given for ever: always the same object
            kind, size = engine.GEOM_MESH, {"vertices": geom.vertices}
        case _:
            kind = engine.GEOM_CAPSULE if geom.kind == "capsule" else engine.GEOM_CYLINDER
            size = {"radius": geom.size[0], "height": 2.0 * geom.size[1]}
    shape: int = engine.createCollisionShape(kind, physicsClientId=client, **size)
    return shape


def _add_tree(
    engine: Any,
    client: int,
    bodies: ModelBodies,
    members: list[int],
    places: dict[int, tuple[Floats, Floats]],
    built: Built,
) -> None:
    """Make a multibody of a body that hangs on the world, and of all that hangs on it."""
    links = _Links(engine)
    base: dict[str, Any] = {"baseMass": 0.0}
    carrier: dict[int, int] = {}  # the link whose frame moves with a body
    origin: dict[int, Floats] = {}  # of that frame, in the frame of the body
    joint_links: dict[int, int] = {}
    geom_links: dict[int, int] = {}
    for number in members:
        body, joints = bodies.bodies[number], list(bodies.joints_of(number))
        _, axes = solid(bodies, number)
        if joints and bodies.joints[joints[0]].kind == "free":
            base = {
                "baseMass": body.mass,
                "baseInertialFramePosition": list(body.center),
                "baseInertialFrameOrientation": axes.tolist(),
            }
            carrier[number], origin[number] = -1, np.zeros(3)
            joint_links[joints[0]] = -1
        else:
            if body.parent in carrier:
                link, start = carrier[body.parent], np.array(body.position) - origin[body.parent]
                turn = np.array(body.orientation)
            else:
                link = -1
                start, turn = _composed(*places[body.parent], body.position, body.orientation)
            at = np.zeros(3)
            for joint in joints:
                row = bodies.joints[joint]
                anchor = np.array(row.position)
                position = start + matrix_of(turn) @ (anchor - at)
                link = links.add(link, position, turn, kind=_kind(engine, row), axis=row.axis)
                joint_links[joint] = link
                start, turn, at = np.zeros(3), _UNTURNED, anchor
            if not joints:
                link = links.add(link, start, turn)
            links.load(link, body.mass, np.array(body.center) - at, axes)
            carrier[number], origin[number] = link, at
        for geom, shape in enumerate(bodies.geoms):
            if shape.body == number:
                geom_links[geom] = links.add(
                    carrier[number],
                    np.array(shape.position) - origin[number],
                    np.array(shape.orientation),
                    shape=_shape(engine, client, shape),
                )
    # What touches what is said by pairs alone, also within the multibody.
    flags = engine.URDF_USE_SELF_COLLISION | engine.URDF_USE_SELF_COLLISION_INCLUDE_PARENT
    made = engine.createMultiBody(
        flags=flags,
        physicsClientId=client,
        **base,
        **dict(zip(COLUMNS, map(list, zip(*links.rows, strict=True)), strict=bool(links.rows))),
    )
    built.bodies.update((number, (made, link)) for number, link in carrier.items())
    for joint, link in joint_links.items():
        built.joints[joint] = (made, link)
    for geom, link in geom_links.items():
        built.geoms[geom] = (made, link)
    _settle(engine, client, made, [(bodies.joints[j], link) for j, link in joint_links.items()])


def _kind(engine: Any, joint: Joint) -> int:
    """Give the engine's kind of a joint."""
    kinds = {
        "hinge": engine.JOINT_REVOLUTE,
        "slide": engine.JOINT_PRISMATIC,
        "ball": engine.JOINT_SPHERICAL,
    }
    kind: int = kinds[joint.kind]
    return kind


def _settle(engine: Any, client: int, made: int, joints: list[tuple[Joint, int]]) -> None:
    """Take away what the engine does by itself: damping, motors, sleep, a highest speed."""
    # One property a call: beside damping or maxJointVelocity, all others would land on the base.
    engine.changeDynamics(made, -1, linearDamping=0, physicsClientId=client)
    engine.changeDynamics(made, -1, angularDamping=0, physicsClientId=client)
    engine.changeDynamics(made, -1, maxJointVelocity=FASTEST, physicsClientId=client)
    engine.changeDynamics(
        made, -1, activationState=engine.ACTIVATION_STATE_DISABLE_SLEEPING, physicsClientId=client
    )
    for joint, link in joints:
        if joint.kind == "ball":
            engine.setJointMotorControlMultiDof(
                made,
                link,
                engine.POSITION_CONTROL,
                targetPosition=_UNTURNED.tolist(),
                positionGain=0.0,
                velocityGain=0.0,
                force=[0.0, 0.0, 0.0],
                physicsClientId=client,
            )
        elif link >= 0:
            engine.setJointMotorControl2(
                made, link, engine.VELOCITY_CONTROL, force=0.0, physicsClientId=client
            )


def _couple(engine: Any, client: int, bodies: ModelBodies, built: Built) -> None:
    """Couple joints to others."""
    for coupling in bodies.couplings:
        multibody, link = built.joints[coupling.joint]
        gear = engine.createConstraint(
            multibody,
            link,
            *built.joints[coupling.leader],
            engine.JOINT_GEAR,
            [1.0, 0.0, 0.0],
            [0.0, 0.0, 0.0],
            [0.0, 0.0, 0.0],
            physicsClientId=client,
        )
        engine.changeConstraint(
            gear,
            gearRatio=-coupling.ratio,
            relativePositionTarget=coupling.offset,
            erp=GEAR_ERP,
            maxForce=STRONGEST,
            physicsClientId=client,
        )


def _choose_pairs(
    engine: Any, client: int, bodies: ModelBodies, roots: tuple[int, ...], built: Built
) -> None:
    """Say which shapes may touch: by groups what most pairs do, and one by one the others."""
    moving = [bool(roots[geom.body]) for geom in bodies.geoms]
    touching = set(bodies.touching)
    pairs = [
        (first, second)
        for first in range(len(moving))
        for second in range(first + 1, len(moving))
        if moving[first] or moving[second]
    ]
    most = 2 * len(touching) > len(pairs)
    for number, handle in enumerate(built.geoms):
        group, mask = (MOVING, MOVING | STATIC) if moving[number] else (STATIC, MOVING)
        if not most:
            group = mask = 0
        engine.setCollisionFilterGroupMask(*handle, group, mask, physicsClientId=client)
        if moving[number]:
            built.groups.append((*handle, group, mask))
    for first, second in pairs:
        if ((first, second) in touching) is not most:
            one, other = built.geoms[first], built.geoms[second]
            engine.setCollisionFilterPair(
                one[0], other[0], one[1], other[1], int(not most), physicsClientId=client
            )


def solid(bodies: ModelBodies, body: int) -> tuple[Floats, Floats]:
    """Give the principal moments [kg m²] and axes of a body, with the armature of its hinge.

    The motor of the only hinge of a body that hangs on the world turns as fast as the body: it is
    as if the body had more inertia about the axis.
    """
    row = bodies.bodies[body]
    moments, axes = np.array(row.inertia), np.array(row.axes)
    added = [bodies.joints[joint] for joint in bodies.joints_of(body)]
    if not (added and added[0].kind == "hinge" and added[0].armature):
        return moments, axes
    turn, axis = matrix_of(axes), np.array(added[0].axis)
    tensor = turn @ np.diag(moments) @ turn.T + added[0].armature * np.outer(axis, axis)
    moments, turn = np.linalg.eigh(tensor)
    turn[:, 2] *= np.sign(np.linalg.det(turn))
    return moments, from_rotation_matrix(turn)
