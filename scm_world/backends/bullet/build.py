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
from numpy.typing import NDArray

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
JOINTS = {HINGE: "JOINT_REVOLUTE", SLIDE: "JOINT_PRISMATIC", BALL: "JOINT_SPHERICAL"}
"""Their names in the engine."""

MESH = int(mujoco.mjtGeom.mjGEOM_MESH)
SHAPES = {
    int(mujoco.mjtGeom.mjGEOM_PLANE): "GEOM_PLANE",
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "GEOM_SPHERE",
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "GEOM_CAPSULE",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "GEOM_CYLINDER",
    int(mujoco.mjtGeom.mjGEOM_BOX): "GEOM_BOX",
    MESH: "GEOM_MESH",
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
class EngineBody:
    """A multibody, or a body that cannot move. Equal ones need not be made again.

    Attributes:
        bodies: The numbers of its bodies in the compiled model.
        joints: The numbers of its joints.
        geoms: The numbers of those of its shapes that can touch something.
        multibody: Its number in the engine.
        links: The links of each body, of each joint and of each shape, in the order above; that of
            a body carries its mass, and that of a free joint is -1.
        base: Arguments of ``createMultiBody`` for the base.
        rows: Those for each link, see ``LINK``. Masses are 1 or 0 until they are set.
        shapes: Of each shape, the arguments of ``createCollisionShape`` and its margin [m].
        gears: Of each coupling, two joints, an offset and a ratio.
        rest: What else cannot be changed while it is there.
    """

    bodies: list[int] = field(compare=False)
    joints: list[int] = field(compare=False)
    geoms: list[int] = field(compare=False)
    multibody: int = field(default=-1, compare=False)
    links: tuple[list[int], list[int], list[int]] = ([], [], [])
    base: dict[str, Any] = field(default_factory=dict)
    rows: list[list[Any]] = field(default_factory=list)
    shapes: list[tuple[dict[str, Any], float]] = field(default_factory=list)
    gears: list[tuple[int, int, float, float]] = field(default_factory=list)
    rest: tuple[Any, ...] = ()

    def add(
        self,
        parent: int,
        position: Floats,
        turn: Floats,
        kind: str = "JOINT_FIXED",
        axis: Sequence[float] = (0.0, 0.0, 1.0),
    ) -> int:
        """Add a link without mass whose frame is given in that of its parent."""
        frame = [position.tolist(), plain(turn), [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
        # The engine counts parents from the base.
        self.rows.append([0.0, -1, -1, *frame, parent + 1, kind, list(axis)])
        return len(self.rows) - 1


def renewed(
    engine: Any, before: list[EngineBody], mj: mujoco.MjModel, touching: list[int]
) -> list[EngineBody]:
    """Make what is missing, remove what is not needed, and return all units.

    Everything stays in one order: what comes after something new is new, too.

    Args:
        engine: The functions of a physics client.
        before: The units in it.
        mj: With the parameters in force.
        touching: The shapes that can touch something.
    """
    data, kept = mujoco.MjData(mj), 0
    mujoco.mj_kinematics(mj, data)
    units = list(_units(mj, touching))
    paired = {*mj.pair_geom1.tolist(), *mj.pair_geom2.tolist()}
    for unit in units:
        _describe(unit, mj, data, paired)
    for old, new in zip(before, units, strict=False):
        if old != new:
            break
        new.multibody, kept = old.multibody, kept + 1
    for unit in reversed(before[kept:]):
        engine.removeBody(unit.multibody)
    for unit in units[kept:]:
        _create(engine, unit, custom(mj, "bullet_damping", -1 in unit.links[1]))
    return units


def handles(units: list[EngineBody], kind: int) -> dict[int, Handle]:
    """Map bodies (kind 0), joints (1) or shapes (2) to their links."""
    return {
        number: (unit.multibody, link)
        for unit in units
        for number, link in zip(
            (unit.bodies, unit.joints, unit.geoms)[kind], unit.links[kind], strict=True
        )
    }


def _create(engine: Any, unit: EngineBody, damping: float) -> None:
    """Make a unit, without what the engine does by itself: motors, sleep, a highest speed."""
    base, rows = dict(unit.base), [list(row) for row in unit.rows]
    for (shape, _), link in zip(unit.shapes, unit.links[2], strict=True):
        kind = getattr(engine, shape["shapeType"])
        number = engine.createCollisionShape(**{**shape, "shapeType": kind})
        if link < 0:
            base["baseCollisionShapeIndex"] = number
        else:
            rows[link][1] = number
    for row in rows:
        row[8] = getattr(engine, row[8])
    # Pairs of shapes alone decide what touches, also within the multibody.
    flags = engine.URDF_USE_SELF_COLLISION | engine.URDF_USE_SELF_COLLISION_INCLUDE_PARENT
    columns = dict(zip(LINK, map(list, zip(*rows, strict=True)), strict=bool(rows)))
    made = engine.createMultiBody(flags=flags if unit.bodies else 0, **base, **columns)
    unit.multibody = made
    if unit.bodies:
        # One property a call: beside damping or maxJointVelocity, others land on the base.
        awake = engine.ACTIVATION_STATE_DISABLE_SLEEPING
        engine.changeDynamics(made, -1, linearDamping=damping)
        engine.changeDynamics(made, -1, angularDamping=damping)
        engine.changeDynamics(made, -1, maxJointVelocity=FASTEST)
        engine.changeDynamics(made, -1, activationState=awake)
    for link in unit.links[1]:
        if link < 0:
            continue
        if unit.rows[link][8] == "JOINT_SPHERICAL":
            engine.setJointMotorControlMultiDof(
                made,
                link,
                engine.POSITION_CONTROL,
                targetPosition=[0.0, 0.0, 0.0, 1.0],
                positionGain=0.0,
                velocityGain=0.0,
                force=[0.0, 0.0, 0.0],
            )
        else:
            engine.setJointMotorControl2(made, link, engine.VELOCITY_CONTROL, force=0.0)
    zero = [0.0, 0.0, 0.0]
    for first, other, offset, ratio in unit.gears:
        ends, axis = (made, first, made, other), [1.0, 0.0, 0.0]
        gear = engine.createConstraint(*ends, engine.JOINT_GEAR, axis, zero, zero)
        engine.changeConstraint(
            gear,
            gearRatio=-ratio,
            relativePositionTarget=offset,
            erp=GEAR_ERP,
            maxForce=STRONGEST,
        )
    for (shape, margin), link in zip(unit.shapes, unit.links[2], strict=True):
        if shape["shapeType"] == "GEOM_MESH":
            engine.changeDynamics(made, link, collisionMargin=max(HULL_MARGIN, margin))


def _describe(unit: EngineBody, mj: mujoco.MjModel, data: mujoco.MjData, paired: set[int]) -> None:
    """Fill in what a unit is made of."""
    carrier: dict[int, int] = {}  # the link whose frame moves with a body
    origin: dict[int, Floats | None] = {}  # of that frame, in the frame of the body
    hinges: dict[int, int] = {}
    shapes: dict[int, int] = {}
    for body in unit.bodies:
        joints, parent = joints_of(mj, body), int(mj.body_parentid[body])
        mass, center = float(mj.body_mass[body] > 0.0), mj.body_ipos[body]
        axes = plain(solid(mj, body)[1])
        if joints and mj.jnt_type[joints[0]] == FREE:
            unit.base["baseMass"] = mass
            unit.base["baseInertialFramePosition"] = center.tolist()
            unit.base["baseInertialFrameOrientation"] = axes
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
                anchor, axis = mj.jnt_pos[joint], mj.jnt_axis[joint].tolist()
                position = start + rotated(turn, anchor - at)
                link = unit.add(link, position, turn, JOINTS[int(mj.jnt_type[joint])], axis)
                hinges[joint], start, turn, at = link, ORIGIN, UNTURNED, anchor
            if not joints:
                link = unit.add(link, start, turn)
            unit.rows[link][0], unit.rows[link][5:7] = mass, ((center - at).tolist(), axes)
            carrier[body], origin[body] = link, at
        own = [geom for geom in unit.geoms if mj.geom_bodyid[geom] == body]
        for number, geom in enumerate(own):
            link = unit.add(carrier[body], ORIGIN, UNTURNED) if number else carrier[body]
            shapes[geom] = link
    if not unit.bodies:
        (geom,), place, turn = unit.geoms, data.geom_xpos[unit.geoms[0]], np.empty(4)
        mujoco.mju_mat2Quat(turn, data.geom_xmat[geom])
        body, shapes[geom] = int(mj.geom_bodyid[geom]), -1
        origin[body] = None
        if mj.geom_type[geom] == MESH:  # in the frame of the body, as it was drawn
            place, turn, origin[body] = data.xpos[body], data.xquat[body], ORIGIN
        unit.base = {"baseMass": 0.0, "useMaximalCoordinates": True}
        unit.base |= {"basePosition": place.tolist(), "baseOrientation": plain(turn)}
    unit.links = (
        [carrier[body] for body in unit.bodies],
        [hinges[joint] for joint in unit.joints],
        [shapes[geom] for geom in unit.geoms],
    )
    for geom in unit.geoms:
        shape = _shape(mj, geom, origin[int(mj.geom_bodyid[geom])])
        unit.shapes.append((shape, float(mj.geom_margin[geom])))
    for equality in np.flatnonzero(coupled(mj)).tolist():
        if int(mj.eq_obj1id[equality]) in hinges:
            ends = hinges[int(mj.eq_obj1id[equality])], hinges[int(mj.eq_obj2id[equality])]
            unit.gears.append((*ends, *mj.eq_data[equality, :2].tolist()))
    unit.rest = (
        *(mj.jnt_limited[unit.joints].tobytes(), mj.numeric_data.tobytes(), mj.opt.disableflags),
        *(geom in paired for geom in unit.geoms),
    )


def _shape(mj: mujoco.MjModel, geom: int, origin: Floats | None) -> dict[str, Any]:
    """Return the arguments that make a collision shape.

    Args:
        mj: The model.
        geom: The shape.
        origin: Of the frame that it is made in, which is turned like the body, in the frame of the
            body [m]; in its own frame if None.
    """
    radius, half, _ = size = mj.geom_size[geom].tolist()
    found: dict[str, Any] = {"shapeType": SHAPES[int(mj.geom_type[geom])]}
    match found["shapeType"]:
        case "GEOM_PLANE":
            found["planeNormal"] = [0.0, 0.0, 1.0]
        case "GEOM_SPHERE":
            found["radius"] = radius
        case "GEOM_CAPSULE" | "GEOM_CYLINDER":
            found |= {"radius": radius, "height": 2.0 * half}
        case "GEOM_BOX":
            found["halfExtents"] = size
        case _:
            return found | {"vertices": _kept(_corners(mj, geom, origin))}
    if origin is not None:
        place, turn = mj.geom_pos[geom] - origin, mj.geom_quat[geom]
        if place.any() or turn[0] != 1.0:  # a frame of its own, which has a price
            found["collisionFramePosition"] = place.tolist()
            found["collisionFrameOrientation"] = plain(turn)
    return found


def _units(mj: mujoco.MjModel, touching: list[int]) -> Iterator[EngineBody]:
    """List what becomes a unit: what hangs on the world; shapes that cannot move; free bodies.

    They meet in this order. Kinematic trees that hang on the world share a multibody, as far as
    there is room: the engine is asked and told of all of them at once, and solves each by itself.
    """
    free, hanging, room = list[EngineBody](), EngineBody([], [], []), MOST_LINKS
    for tree in range(mj.ntree):
        unit = unit_of(mj, tree, touching)
        if mj.jnt_type[unit.joints[0]] == FREE:
            free.append(unit)
            continue
        if links(mj, unit) > room:
            yield hanging
            hanging, room = EngineBody([], [], []), MOST_LINKS
        room -= links(mj, unit)
        hanging.bodies += unit.bodies
        hanging.joints += unit.joints
        hanging.geoms += unit.geoms
    yield from ([hanging] if hanging.bodies else [])
    still = mj.body_treeid[mj.geom_bodyid] < 0
    yield from (EngineBody([], [], [geom]) for geom in touching if still[geom])
    yield from free


def unit_of(mj: mujoco.MjModel, tree: int, touching: list[int]) -> EngineBody:
    """List what a kinematic tree consists of."""
    bodies = np.flatnonzero(mj.body_treeid == tree).tolist()
    joints = [joint for body in bodies for joint in joints_of(mj, body)]
    own = mj.body_treeid[mj.geom_bodyid] == tree
    return EngineBody(bodies, joints, [geom for geom in touching if own[geom]])


def links(mj: mujoco.MjModel, unit: EngineBody) -> int:
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


def coupled(mj: mujoco.MjModel) -> NDArray[np.bool_]:
    """Return which equality constraints are in force, shape (neq,)."""
    off = mujoco.mjtDisableBit.mjDSBL_EQUALITY | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    return np.asarray(mj.eq_active0, dtype=np.bool_) & (not mj.opt.disableflags & int(off))


def _corners(mj: mujoco.MjModel, geom: int, origin: Floats | None) -> bytes:
    """Return the corners of the convex hull of a mesh [m], see ``_shape``."""
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
