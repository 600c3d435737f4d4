"""The bodies of a compiled model in a physics client.

What can move is one multibody for each free body with what hangs on it, and one for all that hangs
on the world. A body is one link for each of its joints, all but the last without mass. Its first
shape is that of the last link; each further one is a link without mass that is fixed there, so that
shapes of one body can differ in what they touch. A shape that cannot move is a body by itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
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

FREE, BALL, SLIDE, HINGE = range(4)
"""Kinds of joints, as MuJoCo numbers them (``mjtJoint``)."""

SHAPES = {
    int(mujoco.mjtGeom.mjGEOM_PLANE): "GEOM_PLANE",
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "GEOM_SPHERE",
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "GEOM_CAPSULE",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "GEOM_CYLINDER",
    int(mujoco.mjtGeom.mjGEOM_BOX): "GEOM_BOX",
    int(mujoco.mjtGeom.mjGEOM_MESH): "GEOM_MESH",
}
"""The shapes that the engine has, by the kinds of MuJoCo's."""

ORIGIN, UNTURNED = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])

LINK = (
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
@dataclass
class Unit:
    """A multibody, or a body that cannot move.

    Attributes:
        bodies: The numbers of its bodies in the compiled model.
        joints: The numbers of its joints.
        geoms: The numbers of those of its shapes that can touch something.
        multibody: Its number in the engine.
        links: The links of each body, of each joint and of each shape, in the order above; that of
            a body carries its mass, and that of a free joint is -1.
        made_of: Everything that cannot be changed while it is there.
    """

    bodies: list[int]
    joints: list[int]
    geoms: list[int]
    multibody: int = -1
    links: tuple[list[int], list[int], list[int]] = field(default_factory=lambda: ([], [], []))
    made_of: tuple[Any, ...] = ()


@final
class Built:
    """Everything that a compiled model has in the engine.

    Args:
        engine: The functions of a physics client.

    Attributes:
        bodies: The link that carries the mass of each body that can move, by its number.
        joints: The link of each joint, by its number; the base of a free body.
        geoms: The link of each shape that can touch something, by its number.
    """

    def __init__(self, engine: Any) -> None:
        self._engine = engine
        self._units: list[Unit] = []
        self.bodies: dict[int, Handle] = {}
        self.joints: dict[int, Handle] = {}
        self.geoms: dict[int, Handle] = {}

    def make(self, mj: mujoco.MjModel, touching: list[int]) -> set[int]:
        """Make what is missing. Everything stays in one order: what comes later is new, too.

        Args:
            mj: With the parameters in force.
            touching: The shapes that can touch something.

        Returns:
            The multibodies that are gone.
        """
        self._mj, self._data = mj, mujoco.MjData(mj)
        mujoco.mj_kinematics(mj, self._data)
        units = list(_units(mj, touching))
        for unit in units:
            unit.made_of = self._made_of(unit)
        kept = 0
        for old, new in zip(self._units, units, strict=False):
            if old.made_of != new.made_of:
                break
            new.multibody, new.links = old.multibody, old.links
            kept += 1
        gone = [unit.multibody for unit in self._units[kept:]]
        for multibody in reversed(gone):
            self._engine.removeBody(multibody)
        self._units = units[:kept]
        for unit in units[kept:]:
            (self._make_tree if unit.bodies else self._make_fixed)(unit)
            self._units.append(unit)
        self.bodies, self.joints, self.geoms = {}, {}, {}
        for unit in units:
            numbers = unit.bodies, unit.joints, unit.geoms
            for table, own, links in zip(
                (self.bodies, self.joints, self.geoms), numbers, unit.links, strict=True
            ):
                table |= {n: (unit.multibody, link) for n, link in zip(own, links, strict=True)}
        return set(gone)

    def _made_of(self, unit: Unit) -> tuple[Any, ...]:
        """List everything in a unit that cannot be changed while it is there."""
        mj, data = self._mj, self._data
        bodies, joints, geoms = unit.bodies, unit.joints, unit.geoms
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

    def _make_fixed(self, unit: Unit) -> None:
        """Make a shape that cannot move."""
        mj, data, (geom,) = self._mj, self._data, unit.geoms
        place, turn = data.geom_xpos[geom], np.empty(4)
        mujoco.mju_mat2Quat(turn, data.geom_xmat[geom])
        origin = None
        if SHAPES[int(mj.geom_type[geom])] == "GEOM_MESH":  # in the frame of the body, as drawn
            body = int(mj.geom_bodyid[geom])
            place, turn, origin = data.xpos[body], data.xquat[body], ORIGIN
        unit.multibody = self._engine.createMultiBody(
            0,
            self._shape(geom, origin),
            basePosition=place.tolist(),
            baseOrientation=plain(turn),
            useMaximalCoordinates=True,
        )
        unit.links = [], [], [-1]
        self._set_margins(unit)

    def _make_tree(self, unit: Unit) -> None:
        """Make a multibody of bodies that can move, without motors, damping and sleep."""
        mj, data, engine = self._mj, self._data, self._engine
        kinds = {
            HINGE: engine.JOINT_REVOLUTE,
            SLIDE: engine.JOINT_PRISMATIC,
            BALL: engine.JOINT_SPHERICAL,
        }
        rows: list[list[Any]] = []  # the arguments of each link; see LINK
        base: dict[str, Any] = {"baseMass": 0.0}
        carrier: dict[int, int] = {}  # the link whose frame moves with a body
        origin: dict[int, Floats] = {}  # of that frame, in the frame of the body
        hinges: dict[int, int] = {}
        shapes: dict[int, int] = {}

        def add(
            parent: int,
            position: Floats,
            turn: Floats,
            shape: int = -1,
            kind: int = engine.JOINT_FIXED,
            axis: Sequence[float] = (0.0, 0.0, 1.0),
        ) -> int:
            """Add a link without mass whose frame is given in that of its parent."""
            frame = [position.tolist(), plain(turn), [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
            # The engine counts parents from the base.
            rows.append([0.0, shape, -1, *frame, parent + 1, kind, list(axis)])
            return len(rows) - 1

        for body in unit.bodies:
            joints, parent = joints_of(mj, body), int(mj.body_parentid[body])
            mass, center, axes = float(mj.body_mass[body]), mj.body_ipos[body], solid(mj, body)[1]
            if joints and mj.jnt_type[joints[0]] == FREE:
                base = {
                    "baseMass": mass,
                    "baseInertialFramePosition": center.tolist(),
                    "baseInertialFrameOrientation": plain(axes),
                }
                carrier[body], origin[body], hinges[joints[0]] = -1, ORIGIN, -1
            else:
                start, turn = mj.body_pos[body], mj.body_quat[body]
                if parent in carrier:
                    link, start = carrier[parent], start - origin[parent]
                else:  # the parent cannot move
                    link, start = -1, data.xpos[parent] + rotated(data.xquat[parent], start)
                    turn = composed(data.xquat[parent], turn)
                at = ORIGIN
                for joint in joints:
                    kind, axis = kinds[int(mj.jnt_type[joint])], mj.jnt_axis[joint].tolist()
                    anchor = mj.jnt_pos[joint]
                    position = start + rotated(turn, anchor - at)
                    hinges[joint] = link = add(link, position, turn, kind=kind, axis=axis)
                    start, turn, at = ORIGIN, UNTURNED, anchor
                if not joints:
                    link = add(link, start, turn)
                rows[link][0] = mass
                rows[link][5:7] = (center - at).tolist(), plain(axes)
                carrier[body], origin[body] = link, at
            own = [geom for geom in unit.geoms if mj.geom_bodyid[geom] == body]
            for geom in own[:1]:
                shape = self._shape(geom, origin[body])
                shapes[geom] = link = carrier[body]
                if link < 0:
                    base["baseCollisionShapeIndex"] = shape
                else:
                    rows[link][1] = shape
            for geom in own[1:]:
                shape = self._shape(geom, origin[body])
                shapes[geom] = add(carrier[body], ORIGIN, UNTURNED, shape)
        # What touches what is said by pairs alone, also within the multibody.
        flags = engine.URDF_USE_SELF_COLLISION | engine.URDF_USE_SELF_COLLISION_INCLUDE_PARENT
        columns = dict(zip(LINK, map(list, zip(*rows, strict=True)), strict=bool(rows)))
        unit.multibody = engine.createMultiBody(flags=flags, **base, **columns)
        unit.links = (
            [carrier[body] for body in unit.bodies],
            [hinges[joint] for joint in unit.joints],
            [shapes[geom] for geom in unit.geoms],
        )
        self._calm(unit.multibody, hinges)
        for equality in couplings(mj, unit.joints):
            self._couple(unit.multibody, equality, hinges)
        self._set_margins(unit)

    def _set_margins(self, unit: Unit) -> None:
        """Set by how much meshes are inflated."""
        for geom, link in zip(unit.geoms, unit.links[2], strict=True):
            if SHAPES[int(self._mj.geom_type[geom])] == "GEOM_MESH":
                margin = max(HULL_MARGIN, float(self._mj.geom_margin[geom]))
                self._engine.changeDynamics(unit.multibody, link, collisionMargin=margin)

    def _shape(self, geom: int, origin: Floats | None) -> int:
        """Make a collision shape.

        Args:
            geom: The shape.
            origin: Of the frame that it is made in, which is turned like the body, in the frame of
                the body [m]; in its own frame if None.
        """
        mj, options = self._mj, dict[str, Any]()
        radius, half, _ = size = mj.geom_size[geom].tolist()
        kind = SHAPES[int(mj.geom_type[geom])]
        match kind:
            case "GEOM_PLANE":
                options = {"planeNormal": [0.0, 0.0, 1.0]}
            case "GEOM_SPHERE":
                options = {"radius": radius}
            case "GEOM_CAPSULE" | "GEOM_CYLINDER":
                options = {"radius": radius, "height": 2.0 * half}
            case "GEOM_BOX":
                options = {"halfExtents": size}
            case _:
                options = {"vertices": _kept(_corners(mj, geom, origin))}
        if origin is not None and kind != "GEOM_MESH":
            place, turn = mj.geom_pos[geom] - origin, mj.geom_quat[geom]
            if place.any() or turn[0] != 1.0:  # a frame of its own, which has a price
                options |= {"collisionFramePosition": place.tolist()}
                options |= {"collisionFrameOrientation": plain(turn)}
        shape: int = self._engine.createCollisionShape(getattr(self._engine, kind), **options)
        return shape

    def _calm(self, made: int, joints: dict[int, int]) -> None:
        """Switch off what the engine does by itself: damping, motors, sleep, a highest speed."""
        engine, damping = self._engine, custom(self._mj, "bullet_damping", -1 in joints.values())
        # One property a call: beside damping or maxJointVelocity, others would land on the base.
        engine.changeDynamics(made, -1, linearDamping=damping)
        engine.changeDynamics(made, -1, angularDamping=damping)
        engine.changeDynamics(made, -1, maxJointVelocity=FASTEST)
        awake = engine.ACTIVATION_STATE_DISABLE_SLEEPING
        engine.changeDynamics(made, -1, activationState=awake)
        for joint, link in joints.items():
            if self._mj.jnt_type[joint] == BALL:
                engine.setJointMotorControlMultiDof(
                    made,
                    link,
                    engine.POSITION_CONTROL,
                    targetPosition=[0.0, 0.0, 0.0, 1.0],
                    positionGain=0.0,
                    velocityGain=0.0,
                    force=[0.0, 0.0, 0.0],
                )
            elif link >= 0:
                engine.setJointMotorControl2(made, link, engine.VELOCITY_CONTROL, force=0.0)

    def _couple(self, made: int, equality: int, links: dict[int, int]) -> None:
        """Let a joint follow another one in proportion."""
        mj, engine, zero = self._mj, self._engine, [0.0, 0.0, 0.0]
        offset, ratio = mj.eq_data[equality, :2].tolist()
        first = made, links[int(mj.eq_obj1id[equality])]
        other = made, links[int(mj.eq_obj2id[equality])]
        gear = engine.createConstraint(
            *first, *other, engine.JOINT_GEAR, [1.0, 0.0, 0.0], zero, zero
        )
        engine.changeConstraint(
            gear,
            gearRatio=-ratio,
            relativePositionTarget=offset,
            erp=GEAR_ERP,
            maxForce=STRONGEST,
        )


def _units(mj: mujoco.MjModel, touching: list[int]) -> Iterator[Unit]:
    """List what becomes a unit: what hangs on the world; shapes that cannot move; free bodies.

    They meet in this order. Kinematic trees that hang on the world share a multibody, as far as
    there is room: the engine is asked and told of all of them at once, and solves each by itself.
    """
    free, hanging, room = list[Unit](), Unit([], [], []), MOST_LINKS
    for tree in range(mj.ntree):
        unit = unit_of(mj, tree, touching)
        if mj.jnt_type[unit.joints[0]] == FREE:
            free.append(unit)
            continue
        if links(mj, unit) > room:
            yield hanging
            hanging, room = Unit([], [], []), MOST_LINKS
        room -= links(mj, unit)
        hanging.bodies += unit.bodies
        hanging.joints += unit.joints
        hanging.geoms += unit.geoms
    yield from ([hanging] if hanging.bodies else [])
    still = mj.body_treeid[mj.geom_bodyid] < 0
    yield from (Unit([], [], [geom]) for geom in touching if still[geom])
    yield from free


def unit_of(mj: mujoco.MjModel, tree: int, touching: list[int]) -> Unit:
    """List what a kinematic tree consists of."""
    bodies = np.flatnonzero(mj.body_treeid == tree).tolist()
    joints = [joint for body in bodies for joint in joints_of(mj, body)]
    own = mj.body_treeid[mj.geom_bodyid] == tree
    return Unit(bodies, joints, [geom for geom in touching if own[geom]])


def links(mj: mujoco.MjModel, unit: Unit) -> int:
    """Count the links that a tree needs."""
    free = mj.jnt_type[unit.joints[0]] == FREE
    jointless = sum(not joints_of(mj, body) for body in unit.bodies)
    return len(unit.geoms) + len(unit.joints) + jointless - int(free)


def plain(turn: Floats) -> list[float]:
    """Turn a quaternion of MuJoCo (w, x, y, z) into one of the engine (x, y, z, w)."""
    w, x, y, z = turn.tolist()
    return [x, y, z, w]


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


def _corners(mj: mujoco.MjModel, geom: int, origin: Floats | None = None) -> bytes:
    """Return the corners of the convex hull of a mesh [m], see ``_shape``; else nothing."""
    if SHAPES[int(mj.geom_type[geom])] != "GEOM_MESH":
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


def custom(mj: mujoco.MjModel, name: str, index: int = 0) -> float:
    """Return a custom number that a model has for this engine; 0 if it has none.

    ``bullet_damping`` is what multibodies lose of their speed in a second, roughly: what hangs on
    the world, and free bodies. ``bullet_early_end`` is the residual at which the solver ends.
    ``bullet_explicit_servos`` says that actuators act with the speed before a step: one that brakes
    with the speed after it, as if nothing were touched, presses too little on what it touches.
    """
    number = mujoco.mj_name2id(mj, mujoco.mjtObj.mjOBJ_NUMERIC, name)
    return 0.0 if number < 0 else float(mj.numeric_data[mj.numeric_adr[number] + index])


def solid(mj: mujoco.MjModel, body: int) -> tuple[Floats, Floats]:
    """Return the principal moments [kg m²] and axes of a body, with the armature of its hinge.

    The motor of the only hinge of a body that hangs on the world turns as fast as the body: it is
    as if the body had more inertia about the axis.
    """
    moments, axes = mj.body_inertia[body], mj.body_iquat[body]
    joint = int(mj.body_jntadr[body])
    armature = mj.dof_armature[mj.jnt_dofadr[joint]] if takes_armature(mj, body) else 0.0
    if not armature:
        return moments, axes
    turn, axis = np.empty(9), mj.jnt_axis[joint]
    mujoco.mju_quat2Mat(turn, axes)
    frame = turn.reshape(3, 3)
    tensor = (frame * moments) @ frame.T + armature * np.outer(axis, axis)
    moments, frame = np.linalg.eigh(tensor)
    frame[:, 2] *= np.sign(np.linalg.det(frame))
    axes = np.empty(4)
    mujoco.mju_mat2Quat(axes, frame.ravel())
    return moments, axes


def takes_armature(mj: mujoco.MjModel, body: int) -> bool:
    """Return whether the armature of the joint of a body is as if the body had more inertia."""
    joints = joints_of(mj, body)
    fixed = mj.body_treeid[mj.body_parentid[body]] < 0
    return bool(fixed and len(joints) == 1 and mj.jnt_type[joints[0]] == HINGE)
