"""From a structure to a compiled model, and where each parameter stands in it.

Stock settings cannot lift a block with three fingers, let it creep on a slope and make a fast one
hover. A softer friction reference for contacts without fingers, elliptic cones and a high
``impratio`` mend all three. Fingers keep the hard reference: they have to grip.

Source:
    Measured; see the parity table in ``docs/design``.

Every write of a parameter is a pure function of the values in force afterwards, so that any order
of changes ends in the same model bit for bit. Derived constants of the model (bounding radii,
inverse weights) follow with ``mj_setConst``, wherever ``constant`` says so; frictions of pairs with
``couple``.

The first nine actuators are servos, the other nine the dampers of the safety filter. What a servo
does depends on the control mode, so its gains rest in numbers that MuJoCo does not use, and
``steer`` copies them from there.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from functools import lru_cache
from typing import Any

import mujoco
import numba
import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.backends.mujoco.slots import Slot, first, place, turn
from scm_world.models.scene import ControlMode, ParameterKey
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.hardware import FINGERS, N_JOINTS, ControllerSpec, link_name
from scm_world.tasks.trifinger.structure import (
    SPINNING_FRICTION,
    WALL_HEIGHT,
    WALL_RADIUS,
    WALL_SEGMENTS,
    WALL_THICKNESS,
    TriFingerStructure,
)

FLOOR = "floor"
STAGE = "stage"
ROBOT = "robot"  # the hub that carries the fingers; nothing touches it
UNSEEN = 3  # the first group of shapes that no picture shows
HUB_COLOR = (0.35, 0.35, 0.38, 1.0)
HUB_HALVES = (0.034, 0.034, 0.012)  # [m] of an ellipsoid
MOUNT = hardware.Capsule((0.012, 0.0, 0.0), (-0.004, 0.0, 0.0), 0.0235)
"""How link 0 looks; its published mesh is a frame that hides the arena from above."""

SHAPES = ("upper", "middle", "lower", "tip")  # in the order of the links 1, 2, 3 and 3

CONTACT = {"fast": (0.010, 1.0), "precise": (0.004, 1.0)}
"""Time constant [s] and damping ratio of contacts, by preset."""

SLIDING = {"fast": (0.04, 1.0), "precise": (0.02, 1.0)}
"""The same for friction between blocks, floor and stage."""

IMPRATIO = 100.0  # stiffness of friction over stiffness of the normal
MANY = 8
"""From more blocks than this on, the Jacobian of the constraints is a sparse matrix."""

_BLOCK_HALF = 0.0325  # [m] any positive size and mass do: parameters follow
_BLOCK_MASS = 0.02  # [kg]
_TORQUE_LIMIT = ControllerSpec().limit  # [N m] any positive one does
_OBSTACLE_POSE = {"pos": (0.1, 0.2, 0.3), "quat": (0.9, 0.1, 0.2, 0.3)}
"""MuJoCo fixes poses of zero for good."""

_ROLLING_FRICTION = 1e-4  # not in force: contacts have four dimensions


@lru_cache(maxsize=32)
def compiled(structure: TriFingerStructure) -> mujoco.MjModel:
    """Compile a structure once. Callers copy the model before they change it."""
    spec = mujoco.MjSpec()
    spec.modelname = "scm_world"
    spec.compiler.degree = False
    _write_options(spec, structure)
    _add_arena(spec.worldbody)
    box = {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": (_BLOCK_HALF,) * 3}
    for name in structure.obstacles:
        _add_shape(spec.worldbody, name, **box, **_OBSTACLE_POSE)
    _add_robot(spec, CONTACT[structure.preset.name])
    for name in structure.blocks:
        body, hull = spec.worldbody.add_body(name=name), structure.hull(name)
        body.add_freejoint()
        body.mass = _BLOCK_MASS
        body.inertia = (_BLOCK_MASS / 6 * (2 * _BLOCK_HALF) ** 2,) * 3
        body.explicitinertial = True
        if hull is None:
            _add_shape(body, name, **box)
        else:  # MuJoCo moves a mesh into a frame of its own and the shape back by as much
            mesh = spec.add_mesh(name=name)
            mesh.uservert = [number for vertex in hull.vertices for number in vertex]
            mesh.userface = [index for face in hull.faces for index in face]
            _add_shape(body, name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)
    contact, slide = (table[structure.preset.name] for table in (CONTACT, SLIDING))
    gripping = spec.default
    sliding = spec.add_default("sliding", gripping)
    for kind, friction in ((gripping, contact), (sliding, slide)):
        pair = kind.pair
        pair.condim, pair.margin, pair.gap = 4, 0.0, 0.0
        pair.solref, pair.solreffriction = contact, friction
        pair.friction = (1.0, 1.0, SPINNING_FRICTION, _ROLLING_FRICTION, _ROLLING_FRICTION)
    for one, other, slides in contact_pairs(structure):
        spec.add_pair(sliding if slides else gripping, geomname1=one, geomname2=other)
    return spec.compile()


def shape_name(finger: str, shape: str) -> str:
    """Name a collision shape of the robot."""
    return f"{finger}/{shape}"


def base_name(finger: str) -> str:
    """Name the frame from which a finger hangs."""
    return f"{finger}/base"


def wall_name(segment: int) -> str:
    """Name a segment of the ring."""
    return f"{STAGE}/{segment}"


def link_shapes(finger: str, index: int) -> tuple[str, ...]:
    """List the shapes that belong to a link; the base has one that touches nothing."""
    shapes = {0: ("base",), 1: ("upper",), 2: ("middle",), 3: ("lower", "tip")}[index]
    return tuple(shape_name(finger, shape) for shape in shapes)


def shape_owners(structure: TriFingerStructure) -> dict[str, str]:
    """Map every shape to the published name of its body."""
    owners = {FLOOR: FLOOR, ROBOT: ROBOT}
    owners |= {wall_name(i): STAGE for i in range(WALL_SEGMENTS)}
    owners |= {f"{wall_name(i)}/inside": STAGE for i in range(WALL_SEGMENTS)}
    for finger in FINGERS:
        for index in range(hardware.LINKS_PER_FINGER):
            owners |= {name: link_name(finger, index) for name in link_shapes(finger, index)}
    return owners | {name: name for name in (*structure.blocks, *structure.obstacles)}


def contact_pairs(structure: TriFingerStructure) -> Iterator[tuple[str, str, bool]]:
    """List which shapes can touch, and whether they slide (True) or grip (False).

    Yields:
        Two shapes, and whether their friction is the soft one.
    """
    walls, blocks = [wall_name(i) for i in range(WALL_SEGMENTS)], structure.blocks
    for i, block in enumerate(blocks):
        yield FLOOR, block, True
        yield from ((fixed, block, True) for fixed in (*walls, *structure.obstacles))
        yield from ((block, other, True) for other in blocks[i + 1 :])
        for finger in FINGERS:
            yield from ((shape_name(finger, shape), block, False) for shape in SHAPES)
    for finger in FINGERS:
        yield from (
            (fixed, shape_name(finger, shape), False)
            for fixed in (FLOOR, *structure.obstacles)
            for shape in SHAPES[1:]
        )
        # Nothing but a tip reaches the ring: the knee stays within 0.232 m of the center.
        yield from ((wall, shape_name(finger, "tip"), False) for wall in walls)
    for i, finger in enumerate(FINGERS):
        for other in FINGERS[i + 1 :]:
            yield from (
                (shape_name(finger, mine), shape_name(other, its), False)
                for mine in SHAPES[1:]
                for its in SHAPES[1:]
            )


def _write_options(spec: mujoco.MjSpec, structure: TriFingerStructure) -> None:
    """Write everything that concerns the whole simulation."""
    option = spec.option
    option.timestep = structure.preset.timestep
    # The only one besides Euler in which bodies that do not touch are solved apart, to the last
    # digit; ``discrete`` scales by the masses of all of them.
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.impratio = IMPRATIO
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    # MuJoCo 4.0.0 factors the Hessian wrongly where the Jacobian is sparse (#3767). The price of a
    # dense one: its sums are grouped by the numbers of the degrees of freedom, so one block more
    # changes the last digits of the others. Parameters of what does not touch still do nothing.
    # With many blocks it is 17 times faster in a built wall; there, in 48 states, accelerations
    # differed by less than 1e-6 from those of a dense one, as much as either did from the truth.
    sparse, dense = mujoco.mjtJacobian.mjJAC_SPARSE, mujoco.mjtJacobian.mjJAC_DENSE
    option.jacobian = sparse if len(structure.blocks) > MANY else dense
    # A simulation that explodes must say so instead of starting again. A warm start is accepted
    # or rejected for all islands together, so that bodies that do not touch would act on each
    # other's last digits; without it, a step is a function of positions, velocities and command
    # alone, and a parameter of what does not touch does exactly nothing.
    off = mujoco.mjtDisableBit.mjDSBL_AUTORESET | mujoco.mjtDisableBit.mjDSBL_WARMSTART
    option.disableflags = int(off)
    option.enableflags = 0  # sleeping islands, in particular, cannot be restored exactly


def _add_shape(body: mujoco.MjsBody, name: str, **options: Any) -> None:
    """Add a shape that touches what pairs say."""
    body.add_geom(name=name, contype=0, conaffinity=0, **options)


def _add_arena(world: mujoco.MjsBody) -> None:
    plane = mujoco.mjtGeom.mjGEOM_PLANE  # without an end where it collides
    _add_shape(world, FLOOR, type=plane, size=(WALL_RADIUS, WALL_RADIUS, 0.1))
    stage = world.add_body(name=STAGE)
    outer = WALL_RADIUS + WALL_THICKNESS
    half = (WALL_THICKNESS / 2, outer * math.tan(math.pi / WALL_SEGMENTS), WALL_HEIGHT / 2)
    center = WALL_RADIUS + WALL_THICKNESS / 2
    for i in range(WALL_SEGMENTS):
        angle = 2 * math.pi * i / WALL_SEGMENTS
        _add_shape(
            stage,
            wall_name(i),
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=(center * math.cos(angle), center * math.sin(angle), WALL_HEIGHT / 2),
            quat=_yaw(angle),
            size=half,
            group=UNSEEN,
        )
        w, _, _, z = _yaw(angle)
        _add_shape(  # seen from within only
            stage,
            f"{wall_name(i)}/inside",
            type=plane,
            pos=(WALL_RADIUS * math.cos(angle), WALL_RADIUS * math.sin(angle), WALL_HEIGHT / 2),
            quat=(w, z, -w, z),
            size=(WALL_HEIGHT / 2, WALL_RADIUS * math.tan(math.pi / WALL_SEGMENTS), 0.1),
        )


def _add_robot(spec: mujoco.MjSpec, contact: tuple[float, float]) -> None:
    """Hang each finger from the world; then add nine servos with a limit, and nine dampers.

    MuJoCo works in the frame of the center of mass of a kinematic tree. With a tree per finger,
    and the links that cannot move outside of them, no mass changes the roundings elsewhere.
    """
    height, world = hardware.NOMINAL_HEIGHT - hardware.TABLE_OFFSET, spec.worldbody
    hub = world.add_body(name=ROBOT, pos=(0.0, 0.0, height))
    ellipsoid = mujoco.mjtGeom.mjGEOM_ELLIPSOID
    _add_shape(hub, ROBOT, type=ellipsoid, size=HUB_HALVES, rgba=HUB_COLOR)
    cos, sin = math.cos(hardware.WORLD_YAW), math.sin(hardware.WORLD_YAW)
    for finger, (x, y, z), yaw in zip(
        FINGERS, hardware.FINGER_OFFSET, hardware.FINGER_YAW, strict=True
    ):
        pose: dict[str, Any] = {
            "pos": (cos * x - sin * y, sin * x + cos * y, z + height),
            "quat": _yaw(hardware.WORLD_YAW + yaw),
        }
        fixed = world.add_body(name=link_name(finger, 0), **pose)
        _set_inertial(fixed, 0)
        _add_capsule(fixed, shape_name(finger, "base"), MOUNT)
        body = world.add_body(name=base_name(finger), **pose)
        for index in (1, 2, 3):
            name = link_name(finger, index)
            body = body.add_body(name=name, pos=hardware.JOINT_ORIGINS[index - 1])
            _set_inertial(body, index)
            reach = hardware.ENGINE_LIMITS[index - 1]
            body.add_joint(
                name=name,
                type=mujoco.mjtJoint.mjJNT_HINGE,
                axis=hardware.JOINT_AXES[index - 1],
                limited=True,
                range=(-reach, reach),
                solref_limit=contact,
                actfrclimited=True,  # the joint clips the sum of servo and damper
                actfrcrange=(-_TORQUE_LIMIT, _TORQUE_LIMIT),
            )
            shape = SHAPES[index - 1]
            _add_capsule(body, shape_name(finger, shape), hardware.COLLISION[shape])
        tip = body.add_body(name=f"robot_finger_{finger}_tip", pos=hardware.TIP_ORIGIN)
        tip.mass, tip.inertia, tip.explicitinertial = hardware.TIP_MASS, hardware.TIP_INERTIA, True
        tip.ipos = hardware.TIP_CENTER["mujoco"]
        _add_capsule(tip, shape_name(finger, "tip"), hardware.COLLISION["tip"])
    for purpose, limit in (("servo", _TORQUE_LIMIT), ("safety", 0.0)):
        for joint in (link_name(finger, index) for finger in FINGERS for index in (1, 2, 3)):
            spec.add_actuator(  # without gains: they are parameters and follow
                name=f"{joint}/{purpose}",
                trntype=mujoco.mjtTrn.mjTRN_JOINT,
                target=joint,
                gaintype=mujoco.mjtGain.mjGAIN_FIXED,
                gainprm=[0.0] * 10,
                biastype=mujoco.mjtBias.mjBIAS_AFFINE,
                forcelimited=limit > 0.0,
                forcerange=(-limit, limit),
            )


def _set_inertial(body: mujoco.MjsBody, index: int) -> None:
    inertial, mass = hardware.INERTIAL[index], hardware.LINK_MASS[index]
    x, y, z, w = inertial.orientation
    body.mass = mass
    body.ipos = inertial.center
    body.iquat = (w, x, y, z)
    body.inertia = [mass * moment for moment in inertial.per_mass]
    body.explicitinertial = True


def _add_capsule(body: mujoco.MjsBody, name: str, capsule: hardware.Capsule) -> None:
    _add_shape(
        body,
        name,
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=(*capsule.start, *capsule.end),
        size=(capsule.radius, 0.0, 0.0),
    )


def _yaw(angle: float) -> tuple[float, float, float, float]:
    """Give the MuJoCo quaternion (w, x, y, z) of a turn about z."""
    return (math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2))


_POSITION, _VELOCITY = 1, 2  # where gains rest among the parameters of a gain that is fixed


def slots(model: mujoco.MjModel, structure: TriFingerStructure) -> dict[ParameterKey, Slot]:
    """Find the place of every parameter of this structure in this model."""
    hanging = [name(f) for f in hardware.FINGERS for name in (base_name, _fixed_link)]
    heights = [model.body_pos[model.body(name).id, 2, ...] for name in (ROBOT, *hanging)]
    offset = hardware.TABLE_OFFSET
    rest = model.actuator_gainprm[:N_JOINTS]
    ranges = model.actuator_forcerange[:N_JOINTS], model.jnt_actfrcrange[:N_JOINTS]
    found: dict[ParameterKey, Slot] = {
        ("world", "gravity"): place(model.opt.gravity),
        ("world", "restitution"): _restitution(model.pair_solref, CONTACT[structure.preset.name]),
        ("world", "spinning_friction"): place(model.geom_friction[:, 1], back=first),
        ("robot", "height"): place(
            *heights, to=lambda z: z - offset, back=lambda z: z + offset, constant=True
        ),
        ("robot", "joint_damping"): place(model.dof_damping[:N_JOINTS], back=first),
        ("controller", "position_gains"): _gains(rest[:, _POSITION]),
        ("controller", "velocity_gains"): _gains(rest[:, _VELOCITY]),
        ("controller", "safety_damping"): _gains(model.actuator_biasprm[N_JOINTS:, 2], -1.0),
        ("controller", "torque_limit"): place(
            *ranges, to=lambda limit: np.array([-limit, limit]), back=lambda range_: range_[0, 1]
        ),
    }
    owners = shape_owners(structure)
    links = [name for name, owner in owners.items() if owner in hardware.LINK_NAMES]
    found["robot", "friction"] = _friction(model, links)
    for finger in hardware.FINGERS:
        for index, inertial in enumerate(hardware.INERTIAL):
            link = hardware.link_name(finger, index)
            found[link, "mass"] = _scaled_mass(model, link, inertial.per_mass)
            found[link, "color"] = _color(model, link_shapes(finger, index))
    surfaces = {FLOOR: [FLOOR], STAGE: [name for name, owner in owners.items() if owner == STAGE]}
    surfaces |= {name: [name] for name in (*structure.blocks, *structure.obstacles)}
    for name, shapes in surfaces.items():
        found[name, "friction"] = _friction(model, shapes)
        found[name, "color"] = _color(model, shapes)
    for name in structure.blocks:
        hull = structure.hull(name)
        if hull is None:
            found[name, "mass"], found[name, "size"] = _box(model, name)
        else:
            found[name, "mass"] = _scaled_mass(model, name, hull.moments)
    for name in structure.obstacles:
        shape = model.geom(name).id
        found[name, "size"] = place(
            model.geom_size[shape], to=lambda v: 0.5 * v, back=lambda v: 2.0 * v, constant=True
        )
        found[name, "position"] = place(model.geom_pos[shape], constant=True)
        found[name, "orientation"] = turn(model.geom_quat[shape])
    return found


def _fixed_link(finger: str) -> str:
    return hardware.link_name(finger, 0)


def _friction(model: mujoco.MjModel, shapes: Iterable[str]) -> Slot:
    """Find the factor of one body. Contact pairs get products; the factors rest in the shapes."""
    return place(*(model.geom_friction[model.geom(name).id, 0, ...] for name in shapes))


def _color(model: mujoco.MjModel, shapes: Iterable[str]) -> Slot:
    """Find red, green, blue, shape (3,); MuJoCo keeps 32 bits of each."""
    return place(*(model.geom_rgba[model.geom(name).id, :3] for name in shapes))


def _gains(places: Floats, factor: float = 1.0) -> Slot:
    """Find a number for each joint of a finger, shape (3,); all fingers have the same."""
    fingers = len(hardware.FINGERS)
    return place(
        places,
        to=lambda value: np.tile(factor * value, fingers),
        back=lambda all_: factor * all_[: N_JOINTS // fingers],
    )


def _scaled_mass(model: mujoco.MjModel, name: str, per_mass: tuple[float, ...]) -> Slot:
    """Find the mass of a link or a hull [kg]; its moments of inertia scale with it."""
    body, moments = model.body(name).id, np.array(per_mass)
    mass, inertia = model.body_mass[body, ...], model.body_inertia[body]

    def write(value: Floats) -> None:
        mass[...] = value
        inertia[:] = value * moments

    return Slot(write, mass.copy, constant=True)


def _box(model: mujoco.MjModel, name: str) -> tuple[Slot, Slot]:
    """Find mass [kg] and full edge lengths [m] of a solid box; its inertia follows both."""
    body = model.body(name).id
    mass, inertia = model.body_mass[body, ...], model.body_inertia[body]
    half = model.geom_size[model.geom(name).id]

    def weigh(value: Floats) -> None:
        mass[...] = value
        _fill_box(float(mass), half, inertia)

    def resize(value: Floats) -> None:
        np.multiply(value, 0.5, out=half)
        _fill_box(float(mass), half, inertia)

    return Slot(weigh, mass.copy, constant=True), Slot(resize, lambda: 2.0 * half, constant=True)


@numba.njit("void(f8, f8[::1], f8[::1])", cache=True)
def _fill_box(mass: float, half: Floats, inertia: Floats) -> None:
    """Give a solid box its moments of inertia, m/12 (b² + c²)."""
    for axis in range(3):
        b, c = half[(axis + 1) % 3], half[(axis + 2) % 3]
        inertia[axis] = mass / 3.0 * (b * b + c * c)


def _restitution(references: Floats, rigid: tuple[float, float]) -> Slot:
    """Find how much of its speed a body keeps when it bounces, in [0, 1).

    A contact is a spring and a damper. A damping ratio z leaves ``exp(-pi z / sqrt(1 - z²))`` of
    the speed after half a period; the frequency stays, and with it how far a body sinks in.

    Args:
        references: Time constant [s] and damping ratio of every pair, shape (n, 2).
        rigid: Both of a contact without restitution, which is critically damped.
    """
    time, ratio = rigid

    def write(value: Floats) -> None:
        loss = -math.log(value) if value > 0.0 else math.inf
        damping = loss / math.hypot(math.pi, loss) if loss < math.inf else 1.0
        references[:, 0], references[:, 1] = time / damping, ratio * damping

    def read() -> Floats:
        damping = float(references[0, 1]) / ratio
        if damping >= 1.0:
            return np.array(0.0)
        return np.array(math.exp(-math.pi * damping / math.sqrt(1.0 - damping * damping)))

    return Slot(write, read)


SPINNING_LIMIT = 1.0
"""At most this many times its sliding friction is the spinning friction of a pair [m]. Above about
five times the solver of the engine speeds a spinning body up, tenfold and more in a step; a real
patch of contact gives two thirds of its radius."""


@numba.njit("void(f8[:, ::1], i4[::1], i4[::1], f8[:, ::1])", cache=True)
def couple(
    factors: Floats, first: NDArray[np.int32], second: NDArray[np.int32], pairs: Floats
) -> None:
    """Give every contact pair the product of its two frictions, and its friction of spinning."""
    for i in range(first.shape[0]):
        product = factors[first[i], 0] * factors[second[i], 0]
        pairs[i, 0] = product
        pairs[i, 1] = product
        pairs[i, 2] = min(factors[first[i], 1], SPINNING_LIMIT * product)


def steer(gains: Floats, biases: Floats, mode: ControlMode) -> None:
    """Make the nine servos follow positions, or pass torques on.

    Args:
        gains: ``actuator_gainprm``, shape (18, 10).
        biases: ``actuator_biasprm``, shape (18, 10).
        mode: What the command means.
    """
    gain, bias = gains[:N_JOINTS], biases[:N_JOINTS]
    if mode is ControlMode.JOINT_POSITIONS:
        gain[:, 0] = gain[:, _POSITION]
        np.negative(gain[:, _POSITION : _VELOCITY + 1], out=bias[:, 1:3])
    else:
        gain[:, 0], bias[:, 1:3] = 1.0, 0.0
