"""The bodies of a compiled model in a physics client.

What can move is one multibody for each free body with what hangs on it, and one for all that hangs
on the world. A body is one link for each of its joints, all but the last without mass. Its first
shape is that of the last link; each further one is a link without mass that is fixed there, so that
shapes of one body can differ in their contacts. A shape that cannot move is a body by itself.
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
from scm_world.backends.bullet.engine import Connection
from scm_world.backends.mujoco.fields import BALL, FREE, HINGE, SLIDE

Handle = tuple[int, int]
"""A multibody and a link of it; -1 is its base."""

MOST_LINKS = 127  # the engine has room for no more of them in a multibody
FASTEST = 1e4  # [rad/s] or [m/s]; the engine would cut at 100
HULL_MARGIN = 1e-5  # [m] a mesh is inflated by so much, or by the margin of its shape
GEAR_ERP = 0.2  # share of the error of a coupling that a step takes away
STRONGEST = 1e9  # [N m] or [N] of a coupling

REVOLUTE, PRISMATIC, SPHERICAL, FIXED = 0, 1, 2, 4
"""Kinds of joints, as the engine numbers them. Source: SharedMemoryPublic.h, ``JointType``."""
JOINTS = {HINGE: REVOLUTE, SLIDE: PRISMATIC, BALL: SPHERICAL}

PLANE, SPHERE, CAPSULE, CYLINDER, BOX, MESH = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"))
    for kind in ("PLANE", "SPHERE", "CAPSULE", "CYLINDER", "BOX", "MESH")
)
SHAPES = {PLANE: 6, SPHERE: 2, CAPSULE: 7, CYLINDER: 4, BOX: 3, MESH: 5}
"""The shapes that the engine has, as it numbers them, by MuJoCo's kind. Source:
SharedMemoryPublic.h, ``eUrdfGeomTypes``."""

ORIGIN, UNTURNED = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])


@final
@dataclass
class EngineBody:
    """A multibody, or a body that cannot move. Equal ones need not be made again.

    Attributes:
        bodies: The link that carries the mass of each body, by its number in the compiled model.
        joints: The link of each joint; -1, the base, of a free one.
        geoms: The link of each shape that can touch something.
        multibody: Its number in the engine.
        base: Arguments of ``createMultiBody`` for the base.
        links: Those for the links. Masses are 1 or 0 until they are set.
        shapes: Of each shape, the arguments of ``createCollisionShape`` and its margin [m].
        gears: Of each coupling, two joints, an offset and a ratio.
        rest: What else cannot be changed while it is there.
    """

    bodies: dict[int, int] = field(default_factory=dict, compare=False)
    joints: dict[int, int] = field(default_factory=dict, compare=False)
    geoms: dict[int, int] = field(default_factory=dict, compare=False)
    multibody: int = field(default=-1, compare=False)
    base: dict[str, Any] = field(default_factory=dict)
    links: dict[str, list[Any]] = field(default_factory=dict)
    shapes: list[tuple[dict[str, Any], float]] = field(default_factory=list)
    gears: list[tuple[int, int, float, float]] = field(default_factory=list)
    rest: tuple[Any, ...] = ()

    def add(
        self,
        parent: int,
        position: Floats,
        turn: Floats,
        kind: int = FIXED,
        axis: Sequence[float] = (0.0, 0.0, 1.0),
    ) -> int:
        """Add a link without mass whose frame is given in that of its parent."""
        link = {
            "linkMasses": 0.0,
            "linkCollisionShapeIndices": -1,
            "linkVisualShapeIndices": -1,
            "linkPositions": position.tolist(),
            "linkOrientations": plain(turn),
            "linkInertialFramePositions": [0.0, 0.0, 0.0],
            "linkInertialFrameOrientations": [0.0, 0.0, 0.0, 1.0],
            "linkParentIndices": parent + 1,  # the engine counts them from the base
            "linkJointTypes": kind,
            "linkJointAxis": list(axis),
        }
        for name, value in link.items():
            self.links.setdefault(name, []).append(value)
        return len(self.links["linkMasses"]) - 1


def renewed(
    engine: Connection, before: list[EngineBody], mj: mujoco.MjModel, touching: list[int]
) -> list[EngineBody]:
    """Make missing units, remove those not needed, and return all.

    Everything stays in one order: what comes after something new is new, too.
    """
    data, kept = mujoco.MjData(mj), 0
    mujoco.mj_kinematics(mj, data)
    units = list(units_of(mj, touching))
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
        _create(engine, unit, custom(mj, "bullet_damping", -1 in unit.joints.values()))
    return units


def _create(engine: Connection, unit: EngineBody, damping: float) -> None:
    """Make a unit, without what the engine does by itself: motors, sleep, a highest speed."""
    base, shapes = dict(unit.base), [-1] * len(unit.links.get("linkMasses", ()))
    for (shape, _), link in zip(unit.shapes, unit.geoms.values(), strict=True):
        number = engine.createCollisionShape(**shape)
        if link < 0:
            base["baseCollisionShapeIndex"] = number
        else:
            shapes[link] = number
    links = {**unit.links, "linkCollisionShapeIndices": shapes} if shapes else {}
    # Pairs of shapes alone decide what touches, also within the multibody.
    flags = engine.URDF_USE_SELF_COLLISION | engine.URDF_USE_SELF_COLLISION_INCLUDE_PARENT
    made = engine.createMultiBody(flags=flags if unit.bodies else 0, **base, **links)
    unit.multibody = made
    if unit.bodies:
        # One property a call: beside damping or maxJointVelocity, others land on the base.
        awake = engine.ACTIVATION_STATE_DISABLE_SLEEPING
        engine.changeDynamics(made, -1, linearDamping=damping)
        engine.changeDynamics(made, -1, angularDamping=damping)
        engine.changeDynamics(made, -1, maxJointVelocity=FASTEST)
        engine.changeDynamics(made, -1, activationState=awake)
    for link in unit.joints.values():
        if link >= 0 and unit.links["linkJointTypes"][link] == SPHERICAL:
            engine.setJointMotorControlMultiDof(
                made,
                link,
                engine.POSITION_CONTROL,
                targetPosition=[0.0, 0.0, 0.0, 1.0],
                positionGain=0.0,
                velocityGain=0.0,
                force=[0.0, 0.0, 0.0],
            )
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
    for (shape, margin), link in zip(unit.shapes, unit.geoms.values(), strict=True):
        if shape["shapeType"] == SHAPES[MESH]:
            engine.changeDynamics(made, link, collisionMargin=max(HULL_MARGIN, margin))


def _describe(unit: EngineBody, mj: mujoco.MjModel, data: mujoco.MjData, paired: set[int]) -> None:
    """Fill in what a unit is made of."""
    origin: dict[int, Floats | None] = {}  # of the frame of its link, in the frame of a body
    for body in unit.bodies:
        joints, parent = joints_of(mj, body), int(mj.body_parentid[body])
        mass, center = float(mj.body_mass[body] > 0.0), mj.body_ipos[body]
        axes = plain(mj.body_iquat[body])
        if joints and mj.jnt_type[joints[0]] == FREE:
            unit.base["baseMass"] = mass
            unit.base["baseInertialFramePosition"] = center.tolist()
            unit.base["baseInertialFrameOrientation"] = axes
            origin[body] = ORIGIN
        else:
            start, turn = mj.body_pos[body], mj.body_quat[body]
            if parent in unit.bodies:
                link, start = unit.bodies[parent], start - origin[parent]
            else:  # the parent cannot move
                link, start = -1, data.xpos[parent] + rotated(data.xquat[parent], start)
                turn = composed(data.xquat[parent], turn)
            at = ORIGIN
            for joint in joints:
                anchor, axis = mj.jnt_pos[joint], mj.jnt_axis[joint].tolist()
                position = start + rotated(turn, anchor - at)
                link = unit.add(link, position, turn, JOINTS[int(mj.jnt_type[joint])], axis)
                unit.joints[joint], start, turn, at = link, ORIGIN, UNTURNED, anchor
            if not joints:
                link = unit.add(link, start, turn)
            unit.links["linkMasses"][link] = mass
            unit.links["linkInertialFramePositions"][link] = (center - at).tolist()
            unit.links["linkInertialFrameOrientations"][link] = axes
            unit.bodies[body], origin[body] = link, at
        own = [geom for geom in unit.geoms if mj.geom_bodyid[geom] == body]
        for number, geom in enumerate(own):
            carrier = unit.bodies[body]
            unit.geoms[geom] = unit.add(carrier, ORIGIN, UNTURNED) if number else carrier
    if not unit.bodies:
        (geom,), turn = unit.geoms, np.empty(4)
        place = data.geom_xpos[geom]
        mujoco.mju_mat2Quat(turn, data.geom_xmat[geom])
        body = int(mj.geom_bodyid[geom])
        origin[body] = None
        if mj.geom_type[geom] == MESH:  # in the frame of the body, as it was drawn
            place, turn, origin[body] = data.xpos[body], data.xquat[body], ORIGIN
        unit.base = {"baseMass": 0.0, "useMaximalCoordinates": True}
        unit.base |= {"basePosition": place.tolist(), "baseOrientation": plain(turn)}
    for geom in unit.geoms:
        shape = _shape(mj, geom, origin[int(mj.geom_bodyid[geom])])
        unit.shapes.append((shape, float(mj.geom_margin[geom])))
    for equality in np.flatnonzero(coupled(mj)).tolist():
        if int(mj.eq_obj1id[equality]) in unit.joints:
            ends = (unit.joints[int(end[equality])] for end in (mj.eq_obj1id, mj.eq_obj2id))
            unit.gears.append((*ends, *mj.eq_data[equality, :2].tolist()))
    unit.rest = (
        *(tuple(links.values()) for links in (unit.bodies, unit.joints, unit.geoms)),
        *(mj.jnt_limited[[*unit.joints]].tobytes(), mj.numeric_data.tobytes()),
        *(mj.opt.disableflags, [geom in paired for geom in unit.geoms]),
    )


def _shape(mj: mujoco.MjModel, geom: int, origin: Floats | None) -> dict[str, Any]:
    """Return the arguments that make a collision shape.

    ``origin`` is that of the frame that it is made in, which is turned like the body, in the frame
    of the body [m]; it is made in its own frame if None.
    """
    radius, half, _ = size = mj.geom_size[geom].tolist()
    kind = int(mj.geom_type[geom])
    found: dict[str, Any] = {"shapeType": SHAPES[kind]}
    if kind == MESH:
        return found | {"vertices": _kept(_corners(mj, geom, origin))}
    if kind == PLANE:
        found["planeNormal"] = [0.0, 0.0, 1.0]
    elif kind == BOX:
        found["halfExtents"] = size
    else:
        found |= {"radius": radius} | ({"height": 2.0 * half} if kind != SPHERE else {})
    if origin is not None:
        place, turn = mj.geom_pos[geom] - origin, mj.geom_quat[geom]
        if place.any() or turn[0] != 1.0:  # a frame of its own, which has a price
            found["collisionFramePosition"] = place.tolist()
            found["collisionFrameOrientation"] = plain(turn)
    return found


def units_of(mj: mujoco.MjModel, touching: list[int]) -> Iterator[EngineBody]:
    """List what becomes a unit: what hangs on the world; shapes that cannot move; free bodies.

    They meet in this order. Kinematic trees that hang on the world share a multibody, as far as
    there is room: the engine is asked for all of them at once, and solves each by itself.
    """
    free, hanging, room = list[EngineBody](), EngineBody(), MOST_LINKS
    for tree in range(mj.ntree):
        unit = unit_of(mj, tree, touching)
        if mj.jnt_type[min(unit.joints)] == FREE:
            free.append(unit)
            continue
        if links(mj, unit) > room:
            yield hanging
            hanging, room = EngineBody(), MOST_LINKS
        room -= links(mj, unit)
        hanging.bodies |= unit.bodies
        hanging.joints |= unit.joints
        hanging.geoms |= unit.geoms
    yield from ([hanging] if hanging.bodies else [])
    still = mj.body_treeid[mj.geom_bodyid] < 0
    yield from (EngineBody(geoms={geom: -1}) for geom in touching if still[geom])
    yield from free


def unit_of(mj: mujoco.MjModel, tree: int, touching: list[int]) -> EngineBody:
    """List what a kinematic tree consists of."""
    bodies = np.flatnonzero(mj.body_treeid == tree).tolist()
    joints = [joint for body in bodies for joint in joints_of(mj, body)]
    own = mj.body_treeid[mj.geom_bodyid] == tree
    geoms = [geom for geom in touching if own[geom]]
    return EngineBody(
        dict.fromkeys(bodies, -1), dict.fromkeys(joints, -1), dict.fromkeys(geoms, -1)
    )


def links(mj: mujoco.MjModel, unit: EngineBody) -> int:
    """Count the links that a tree needs."""
    free = mj.jnt_type[min(unit.joints)] == FREE
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
    """Make a list, always the same one: the engine never releases its arguments."""
    found: list[list[float]] = np.frombuffer(vertices).reshape(-1, 3).tolist()
    return found


def custom(mj: mujoco.MjModel, name: str, index: int = 0) -> float:
    """Return a custom number that a model has for this engine; 0 if it has none.

    ``bullet_damping`` is what multibodies lose of their speed in a second, roughly: what hangs on
    the world, and free bodies. ``bullet_early_end`` is the residual at which the solver ends.
    ``bullet_explicit_servos`` says that actuators act with the speed before a step: one that brakes
    with the speed after it, as if nothing were touched, presses too little on touched bodies.
    """
    number = mujoco.mj_name2id(mj, mujoco.mjtObj.mjOBJ_NUMERIC, name)
    return 0.0 if number < 0 else float(mj.numeric_data[mj.numeric_adr[number] + index])
