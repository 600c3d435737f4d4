"""The bodies of a compiled model in a physics client.

What can move is one multibody for each free body with what hangs on it, and one for all that hangs
on the world. A body is one link for each of its joints, all but the last without mass. Its first
shape is that of the last link; each further one is a link without mass that is fixed there, so that
shapes of one body can differ in what they touch. A shape that cannot move is a body by itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, final

import mujoco
import numpy as np

from scm_world._types import Floats

Handle = tuple[int, int]
"""A multibody and a link of it; -1 is its base."""

MOST_LINKS = 127  # the engine has room for no more of them in a multibody
FASTEST = 1e4  # [rad/s] or [m/s]; the engine would cut at 100
HULL_MARGIN = 1e-5  # [m] a mesh is inflated by so much, or by the margin of its shape
GEAR_ERP = 0.2  # share of the error of a coupling that a step takes away
STRONGEST = 1e9  # [N m] or [N] of a coupling

FREE, BALL, SLIDE, HINGE = (
    int(mujoco.mjtJoint.mjJNT_FREE),
    int(mujoco.mjtJoint.mjJNT_BALL),
    int(mujoco.mjtJoint.mjJNT_SLIDE),
    int(mujoco.mjtJoint.mjJNT_HINGE),
)
PLANE, SPHERE, CAPSULE, CYLINDER, BOX, MESH = (
    int(mujoco.mjtGeom.mjGEOM_PLANE),
    int(mujoco.mjtGeom.mjGEOM_SPHERE),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE),
    int(mujoco.mjtGeom.mjGEOM_CYLINDER),
    int(mujoco.mjtGeom.mjGEOM_BOX),
    int(mujoco.mjtGeom.mjGEOM_MESH),
)
SHAPES = (PLANE, SPHERE, CAPSULE, CYLINDER, BOX, MESH)
"""The shapes that the engine has."""

UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])


@final
@dataclass
class Unit:
    """A multibody, or a body that cannot move.

    Attributes:
        made_of: Everything that cannot be changed while it is there.
        multibody: Its number in the engine.
        bodies: The links that carry the masses of its bodies.
        joints: The links of its joints; -1 for that of a free body.
        geoms: The links that are its shapes.
    """

    made_of: tuple[Any, ...]
    multibody: int
    bodies: list[int]
    joints: list[int]
    geoms: list[int]


@final
@dataclass(frozen=True)
class Plan:
    """What becomes a unit, by the numbers in the compiled model."""

    bodies: list[int]
    joints: list[int]
    geoms: list[int]


@final
class Built:
    """Everything that a compiled model has in the engine.

    Attributes:
        bodies: The link that carries the mass of each body that can move, by its number.
        joints: The link of each joint, by its number; the base of a free body.
        geoms: The link of each shape that can touch something, by its number.
    """

    def __init__(self, engine: Any, client: int) -> None:
        self._engine, self._client = engine, client
        self._units: list[Unit] = []
        self.bodies: dict[int, Handle] = {}
        self.joints: dict[int, Handle] = {}
        self.geoms: dict[int, Handle] = {}

    def make(self, mj: mujoco.MjModel, touching: list[int]) -> set[int]:
        """Make what there is not yet. Everything stays in one order: what comes later is new, too.

        Args:
            mj: With the parameters in force.
            touching: The shapes that can touch something.

        Returns:
            The multibodies that are gone.
        """
        data = mujoco.MjData(mj)
        mujoco.mj_kinematics(mj, data)
        plans = list(_plans(mj, touching))
        wanted = [_made_of(mj, data, plan) for plan in plans]
        kept = 0
        while kept < min(len(self._units), len(wanted)):
            if self._units[kept].made_of != wanted[kept]:
                break
            kept += 1
        gone = [unit.multibody for unit in self._units[kept:]]
        for multibody in reversed(gone):
            self._engine.removeBody(multibody, physicsClientId=self._client)
        del self._units[kept:]
        for plan, made_of in zip(plans[kept:], wanted[kept:], strict=True):
            self._units.append(_made(self._engine, self._client, mj, data, plan, made_of))
        self.bodies, self.joints, self.geoms = {}, {}, {}
        for plan, unit in zip(plans, self._units, strict=True):
            for table, numbers, links in (
                (self.bodies, plan.bodies, unit.bodies),
                (self.joints, plan.joints, unit.joints),
                (self.geoms, plan.geoms, unit.geoms),
            ):
                table |= {n: (unit.multibody, link) for n, link in zip(numbers, links, strict=True)}
        return set(gone)


def _plans(mj: mujoco.MjModel, touching: list[int]) -> Iterator[Plan]:
    """List what becomes a unit: what hangs on the world; shapes that cannot move; free bodies.

    They meet in this order. Kinematic trees that hang on the world share a multibody, as far as
    there is room: the engine is asked and told of all of them at once, and solves each by itself.
    """
    free, hanging, room = list[Plan](), Plan([], [], []), MOST_LINKS
    for tree in range(mj.ntree):
        plan = plan_of(mj, tree, touching)
        if mj.jnt_type[plan.joints[0]] == FREE:
            free.append(plan)
            continue
        if links(mj, plan) > room:
            yield hanging
            hanging, room = Plan([], [], []), MOST_LINKS
        room -= links(mj, plan)
        hanging.bodies.extend(plan.bodies)
        hanging.joints.extend(plan.joints)
        hanging.geoms.extend(plan.geoms)
    yield from ([hanging] if hanging.bodies else [])
    still = mj.body_treeid[mj.geom_bodyid] < 0
    yield from (Plan([], [], [geom]) for geom in touching if still[geom])
    yield from free


def plan_of(mj: mujoco.MjModel, tree: int, touching: list[int]) -> Plan:
    """List what a kinematic tree consists of."""
    bodies = np.flatnonzero(mj.body_treeid == tree).tolist()
    joints = [joint for body in bodies for joint in joints_of(mj, body)]
    own = mj.body_treeid[mj.geom_bodyid] == tree
    return Plan(bodies, joints, [geom for geom in touching if own[geom]])


def links(mj: mujoco.MjModel, plan: Plan) -> int:
    """Count the links that a tree needs."""
    free = mj.jnt_type[plan.joints[0]] == FREE
    jointless = sum(not joints_of(mj, body) for body in plan.bodies)
    return len(plan.geoms) + len(plan.joints) + jointless - int(free)


def _made_of(mj: mujoco.MjModel, data: mujoco.MjData, plan: Plan) -> tuple[Any, ...]:
    """List everything in a unit that cannot be changed while it is there."""
    bodies, joints, geoms = plan.bodies, plan.joints, plan.geoms
    place = {body: index for index, body in enumerate(bodies)}
    found: list[Any] = [
        *(len(bodies), len(joints), mj.opt.disableflags, mj.jnt_limited[joints]),
        *(mj.numeric_data, mj.geom_margin[geoms]),
        np.isin(geoms, [mj.pair_geom1, mj.pair_geom2]),
        *(mj.geom_type[geoms], mj.geom_size[geoms]),
        *(_corners(mj, geom) for geom in geoms),
    ]
    if not bodies:
        found += [data.geom_xpos[geoms], data.geom_xmat[geoms]]
    else:
        free = int(mj.jnt_type[joints[0]] == FREE)
        parents = mj.body_parentid[bodies].tolist()
        fixed = [parent for parent in parents if parent not in place]
        found += [
            tuple(place.get(parent, -1) for parent in parents),
            tuple(place[body] for body in mj.geom_bodyid[geoms].tolist()),
            *(mj.body_ipos[bodies], mj.body_jntnum[bodies]),
            *(solid(mj, body)[1] for body in bodies),
            *(mj.body_pos[bodies[free:]], mj.body_quat[bodies[free:]]),
            *(data.xpos[fixed], data.xquat[fixed]),
            *(mj.jnt_type[joints], mj.jnt_pos[joints], mj.jnt_axis[joints]),
            *(mj.geom_pos[geoms], mj.geom_quat[geoms]),
            *(mj.eq_data[equality, :2] for equality in couplings(mj, joints)),
        ]
    return tuple(part.tobytes() if isinstance(part, np.ndarray) else part for part in found)


def _made(
    engine: Any,
    client: int,
    mj: mujoco.MjModel,
    data: mujoco.MjData,
    plan: Plan,
    made_of: tuple[Any, ...],
) -> Unit:
    """Make a unit, without motors, damping and sleep."""
    if plan.bodies:
        unit = _tree(engine, client, mj, data, plan, made_of)
    else:
        (geom,), body = plan.geoms, int(mj.geom_bodyid[plan.geoms[0]])
        place, turn = data.geom_xpos[geom], np.empty(4)
        mujoco.mju_mat2Quat(turn, data.geom_xmat[geom])
        hull = bool(mj.geom_type[geom] == MESH)  # in the frame of the body, as it was drawn
        if hull:
            place, turn = data.xpos[body], data.xquat[body]
        multibody = engine.createMultiBody(
            0,
            _shape(engine, client, mj, geom, np.zeros(3) if hull else None),
            basePosition=place.tolist(),
            baseOrientation=plain(turn),
            useMaximalCoordinates=True,
            physicsClientId=client,
        )
        unit = Unit(made_of, multibody, [], [], [-1])
    for geom, link in zip(plan.geoms, unit.geoms, strict=True):
        place = unit.multibody, link
        if mj.geom_type[geom] == MESH:
            margin = max(HULL_MARGIN, float(mj.geom_margin[geom]))
            engine.changeDynamics(*place, collisionMargin=margin, physicsClientId=client)
    return unit


def plain(turn: Floats) -> list[float]:
    """Turn a quaternion of MuJoCo (w, x, y, z) into one of the engine (x, y, z, w)."""
    w, x, y, z = turn.tolist()
    return [x, y, z, w]


def joints_of(mj: mujoco.MjModel, body: int) -> range:
    """List the joints between a body and its parent."""
    first = int(mj.body_jntadr[body])
    return range(first, first + int(mj.body_jntnum[body]))


def couplings(mj: mujoco.MjModel, joints: Sequence[int]) -> Iterator[int]:
    """List the equality constraints in force that begin at some joints."""
    off = mujoco.mjtDisableBit.mjDSBL_EQUALITY | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    for equality in np.flatnonzero(mj.eq_active0).tolist():
        if not mj.opt.disableflags & int(off) and int(mj.eq_obj1id[equality]) in joints:
            yield equality


def _shape(
    engine: Any, client: int, mj: mujoco.MjModel, geom: int, origin: Floats | None = None
) -> int:
    """Make a collision shape.

    Args:
        engine: The module ``pybullet``.
        client: Its client.
        mj: The model.
        geom: The shape.
        origin: Of the frame that it is made in, which is turned like the body, in the frame of the
            body [m]; in its own frame if None.
    """
    radius, half, _ = size = mj.geom_size[geom].tolist()
    kind, options = {
        PLANE: (engine.GEOM_PLANE, {"planeNormal": [0.0, 0.0, 1.0]}),
        SPHERE: (engine.GEOM_SPHERE, {"radius": radius}),
        CAPSULE: (engine.GEOM_CAPSULE, {"radius": radius, "height": 2.0 * half}),
        CYLINDER: (engine.GEOM_CYLINDER, {"radius": radius, "height": 2.0 * half}),
        BOX: (engine.GEOM_BOX, {"halfExtents": size}),
        MESH: (engine.GEOM_MESH, {}),
    }[int(mj.geom_type[geom])]
    if kind == engine.GEOM_MESH:
        options["vertices"] = _kept(_corners(mj, geom, origin))
    elif origin is not None:
        place, turn = mj.geom_pos[geom] - origin, mj.geom_quat[geom]
        if place.any() or turn[0] != 1.0:  # a frame of its own, which has a price
            options |= {"collisionFramePosition": place.tolist()}
            options |= {"collisionFrameOrientation": plain(turn)}
    shape: int = engine.createCollisionShape(kind, physicsClientId=client, **options)
    return shape


def _corners(mj: mujoco.MjModel, geom: int, origin: Floats | None = None) -> bytes:
    """Return the corners of the convex hull of a mesh [m], see ``_shape``; else nothing."""
    if mj.geom_type[geom] != MESH:
        return b""
    mesh = int(mj.geom_dataid[geom])
    first, count = int(mj.mesh_vertadr[mesh]), int(mj.mesh_vertnum[mesh])
    vertices = mj.mesh_vert[first : first + count]
    graph = int(mj.mesh_graphadr[mesh])
    if graph >= 0:  # number of corners and faces, where their edges begin, which vertices
        n = int(mj.mesh_graph[graph])
        vertices = vertices[mj.mesh_graph[graph + 2 + n : graph + 2 + 2 * n]]
    if origin is not None:
        turn = np.empty(9)
        mujoco.mju_quat2Mat(turn, mj.geom_quat[geom])
        vertices = vertices @ turn.reshape(3, 3).T + mj.geom_pos[geom] - origin
    found: bytes = vertices.astype(np.float64).tobytes()
    return found


@lru_cache(maxsize=1024)
def _kept(vertices: bytes) -> list[list[float]]:
    """Make a list, always the same one: the engine never lets go of what it is given."""
    found: list[list[float]] = np.frombuffer(vertices).reshape(-1, 3).tolist()
    return found


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
        turn: Floats,
        *,
        shape: int = -1,
        kind: int | None = None,
        axis: Sequence[float] = (0.0, 0.0, 1.0),
    ) -> int:
        """Add a link without mass whose frame is given in that of its parent."""
        frame = [position.tolist(), plain(turn), [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
        joint = [self._fixed if kind is None else kind, list(axis)]
        # The engine counts parents from the base.
        self.rows.append([0.0, shape, -1, *frame, parent + 1, *joint])
        return len(self.rows) - 1

    def load(self, link: int, mass: float, center: Floats, axes: Floats) -> None:
        """Give a link a mass, whose center and principal axes are in the frame of the link."""
        row = self.rows[link]
        row[0], row[5], row[6] = mass, center.tolist(), plain(axes)


def rotated(turn: Floats, vector: Floats) -> Floats:
    """Rotate a vector by a quaternion of MuJoCo."""
    found = np.empty(3)
    mujoco.mju_rotVecQuat(found, vector, turn)
    return found


def composed(first: Floats, then: Floats) -> Floats:
    """Compose two quaternions of MuJoCo: the second turns within the frame of the first."""
    found = np.empty(4)
    mujoco.mju_mulQuat(found, first, then)
    return found


def _tree(
    engine: Any,
    client: int,
    mj: mujoco.MjModel,
    data: mujoco.MjData,
    plan: Plan,
    made_of: tuple[Any, ...],
) -> Unit:
    """Make a multibody of a body that hangs on the world, and of all that hangs on it."""
    links, base = _Links(engine), dict[str, Any](baseMass=0.0)
    kinds = {
        HINGE: engine.JOINT_REVOLUTE,
        SLIDE: engine.JOINT_PRISMATIC,
        BALL: engine.JOINT_SPHERICAL,
    }
    carrier: dict[int, int] = {}  # the link whose frame moves with a body
    origin: dict[int, Floats] = {}  # of that frame, in the frame of the body
    joint_links: dict[int, int] = {}
    geom_links: dict[int, int] = {}
    for body in plan.bodies:
        joints, parent = joints_of(mj, body), int(mj.body_parentid[body])
        mass, center = float(mj.body_mass[body]), mj.body_ipos[body]
        _, axes = solid(mj, body)
        if joints and mj.jnt_type[joints[0]] == FREE:
            base = {
                "baseMass": mass,
                "baseInertialFramePosition": center.tolist(),
                "baseInertialFrameOrientation": plain(axes),
            }
            carrier[body], origin[body], joint_links[joints[0]] = -1, np.zeros(3), -1
        else:
            start, turn = mj.body_pos[body], mj.body_quat[body]
            if parent in carrier:
                link, start = carrier[parent], start - origin[parent]
            else:  # the parent cannot move
                link, start = -1, data.xpos[parent] + rotated(data.xquat[parent], start)
                turn = composed(data.xquat[parent], turn)
            at = np.zeros(3)
            for joint in joints:
                kind, axis = kinds[int(mj.jnt_type[joint])], mj.jnt_axis[joint].tolist()
                anchor = mj.jnt_pos[joint]
                position = start + rotated(turn, anchor - at)
                joint_links[joint] = link = links.add(link, position, turn, kind=kind, axis=axis)
                start, turn, at = np.zeros(3), UNTURNED, anchor
            if not joints:
                link = links.add(link, start, turn)
            links.load(link, mass, center - at, axes)
            carrier[body], origin[body] = link, at
        own = [geom for geom in plan.geoms if mj.geom_bodyid[geom] == body]
        for geom in own[:1]:
            shape, link = _shape(engine, client, mj, geom, origin[body]), carrier[body]
            geom_links[geom] = link
            if link < 0:
                base["baseCollisionShapeIndex"] = shape
            else:
                links.rows[link][1] = shape
        for geom in own[1:]:
            shape = _shape(engine, client, mj, geom, origin[body])
            geom_links[geom] = links.add(carrier[body], np.zeros(3), UNTURNED, shape=shape)
    # What touches what is said by pairs alone, also within the multibody.
    flags = engine.URDF_USE_SELF_COLLISION | engine.URDF_USE_SELF_COLLISION_INCLUDE_PARENT
    made = engine.createMultiBody(
        flags=flags,
        physicsClientId=client,
        **base,
        **dict(zip(COLUMNS, map(list, zip(*links.rows, strict=True)), strict=bool(links.rows))),
    )
    _settle(engine, client, mj, made, joint_links)
    for equality in couplings(mj, plan.joints):
        _couple(engine, client, mj, equality, made, joint_links)
    carriers = [carrier[body] for body in plan.bodies]
    hinges = [joint_links[joint] for joint in plan.joints]
    shapes = [geom_links[geom] for geom in plan.geoms]
    return Unit(made_of, made, carriers, hinges, shapes)


def _settle(
    engine: Any, client: int, mj: mujoco.MjModel, made: int, joints: dict[int, int]
) -> None:
    """Take away what the engine does by itself: damping, motors, sleep, a highest speed."""
    # One property a call: beside damping or maxJointVelocity, all others would land on the base.
    damping = custom(mj, "bullet_damping", int(-1 in joints.values()))
    engine.changeDynamics(made, -1, linearDamping=damping, physicsClientId=client)
    engine.changeDynamics(made, -1, angularDamping=damping, physicsClientId=client)
    engine.changeDynamics(made, -1, maxJointVelocity=FASTEST, physicsClientId=client)
    engine.changeDynamics(
        made, -1, activationState=engine.ACTIVATION_STATE_DISABLE_SLEEPING, physicsClientId=client
    )
    for joint, link in joints.items():
        if mj.jnt_type[joint] == BALL:
            engine.setJointMotorControlMultiDof(
                made,
                link,
                engine.POSITION_CONTROL,
                targetPosition=[0.0, 0.0, 0.0, 1.0],
                positionGain=0.0,
                velocityGain=0.0,
                force=[0.0, 0.0, 0.0],
                physicsClientId=client,
            )
        elif link >= 0:
            engine.setJointMotorControl2(
                made, link, engine.VELOCITY_CONTROL, force=0.0, physicsClientId=client
            )


def custom(mj: mujoco.MjModel, name: str, index: int = 0) -> float:
    """Return a custom number that a model has for this engine; 0 if it has none.

    ``bullet_damping`` is what multibodies lose of their speed in a second, roughly: what hangs on
    the world, and free bodies. ``bullet_early_end`` is the residual at which the solver ends.
    ``bullet_explicit_servos`` says that actuators act with the speed before a step: one that brakes
    with the speed after it, as if nothing were touched, presses too little on what it touches.
    """
    number = mujoco.mj_name2id(mj, mujoco.mjtObj.mjOBJ_NUMERIC, name)
    return 0.0 if number < 0 else float(mj.numeric_data[mj.numeric_adr[number] + index])


def _couple(
    engine: Any,
    client: int,
    mj: mujoco.MjModel,
    equality: int,
    multibody: int,
    links: dict[int, int],
) -> None:
    """Let a joint follow another one in proportion."""
    offset, ratio = mj.eq_data[equality, :2].tolist()
    gear = engine.createConstraint(
        *(multibody, links[int(mj.eq_obj1id[equality])]),
        *(multibody, links[int(mj.eq_obj2id[equality])]),
        engine.JOINT_GEAR,
        [1.0, 0.0, 0.0],
        [0.0, 0.0, 0.0],
        [0.0, 0.0, 0.0],
        physicsClientId=client,
    )
    engine.changeConstraint(
        gear,
        gearRatio=-ratio,
        relativePositionTarget=offset,
        erp=GEAR_ERP,
        maxForce=STRONGEST,
        physicsClientId=client,
    )


def solid(mj: mujoco.MjModel, body: int) -> tuple[Floats, Floats]:
    """Give the principal moments [kg m²] and axes of a body, with the armature of its hinge.

    The motor of the only hinge of a body that hangs on the world turns as fast as the body: it is
    as if the body had more inertia about the axis.
    """
    moments, axes = mj.body_inertia[body], mj.body_iquat[body]
    if not takes_armature(mj, body):
        return moments, axes
    joint = int(mj.body_jntadr[body])
    armature, axis = mj.dof_armature[mj.jnt_dofadr[joint]], mj.jnt_axis[joint]
    if not armature:
        return moments, axes
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, axes)
    frame = turn.reshape(3, 3)
    tensor = (frame * moments) @ frame.T + armature * np.outer(axis, axis)
    moments, frame = np.linalg.eigh(tensor)
    frame[:, 2] *= np.sign(np.linalg.det(frame))
    axes = np.empty(4)
    mujoco.mju_mat2Quat(axes, frame.ravel())
    return moments, axes


def takes_armature(mj: mujoco.MjModel, body: int) -> bool:
    """Tell whether the armature of the joint of a body is as if the body had more inertia."""
    joints = joints_of(mj, body)
    fixed = mj.body_treeid[mj.body_parentid[body]] < 0
    return bool(fixed and len(joints) == 1 and mj.jnt_type[joints[0]] == HINGE)
