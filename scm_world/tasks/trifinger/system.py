"""The TriFinger and its blocks as a model: an ``MjSpec``, and parameters bound to its arrays.

Stock settings cannot lift a block with three fingers, let it creep on a slope and make a fast one
hover. A softer friction reference for contacts without fingers, elliptic cones and a high
``impratio`` mend all three. Fingers keep the hard reference: they have to grip.

Source:
    Measured; see the parity table in ``docs/design``.

Every binding is a pure function of the values in force afterwards, so that any order of changes
ends in the same model bit for bit. Frictions of pairs follow with ``couple``, derived constants of
the model (bounding radii, inverse weights) with ``mj_setConst``.

The first nine actuators are servos or motors, as the action mode says; the other nine are the
dampers of the safety filter.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import combinations, product
from typing import Any, final

import mujoco
import numpy as np

from scm_world._types import Floats
from scm_world.backends.mujoco.fields import numbers
from scm_world.backends.mujoco.reading import read_model
from scm_world.backends.mujoco.slots import Finder, Slot, first, place, turn
from scm_world.backends.mujoco.trees import NOTHING, Couplings, Effect
from scm_world.geometry.hulls import Hull
from scm_world.models.model import Model, Parameter
from scm_world.models.scene import State
from scm_world.tasks.trifinger import fake, hardware
from scm_world.tasks.trifinger.cameras import VIEWS
from scm_world.tasks.trifinger.hardware import (
    FAST,
    FINGERS,
    N_JOINTS,
    RESOLUTIONS,
    SPINNING_FRICTION,
    WALL_HEIGHT,
    WALL_RADIUS,
    WALL_SEGMENTS,
    WALL_THICKNESS,
    ControllerSpec,
    Preset,
    joints_of,
    link_name,
)
from scm_world.tasks.trifinger.published import SIDES, alter, restore, spinning_weights, touching
from scm_world.tasks.trifinger.state import PhysicalState

FLOOR = "floor"
STAGE = "stage"
ROBOT = "robot"  # the hub that carries the fingers; nothing touches it
UNSEEN = 3  # the first group of shapes that no picture shows
HUB_COLOR = (0.35, 0.35, 0.38, 1.0)
HUB_HALVES = (0.034, 0.034, 0.012)  # [m] of an ellipsoid
MOUNT = hardware.Capsule((0.012, 0.0, 0.0), (-0.004, 0.0, 0.0), 0.0235)
"""How link 0 looks; its published mesh is a frame that hides the arena from above."""

SHAPES = ("upper", "middle", "lower", "tip")  # in the order of the links 1, 2, 3 and 3
LINK_SHAPES = (("base",), ("upper",), ("middle",), ("lower", "tip"))
"""The shapes of links 0 to 3 of a finger; the base touches nothing."""

CONTACT = {"fast": (0.010, 1.0), "precise": (0.004, 1.0)}
"""Time constant [s] and damping ratio of contacts, by preset."""

SLIDING = {"fast": (0.04, 1.0), "precise": (0.02, 1.0)}
"""The same for friction between blocks, floor and stage."""

IMPRATIO = 100.0  # stiffness of friction over stiffness of the normal
MANY = 8
"""From more blocks than this on, the Jacobian of the constraints is a sparse matrix."""

_PLANE = mujoco.mjtGeom.mjGEOM_PLANE  # has no end where it collides, whatever its size
_BLOCK_HALF = 0.0325  # [m] any positive size and mass do: parameters follow
_BLOCK_MASS = 0.02  # [kg]
_SPEC = ControllerSpec()
_OBSTACLE_POSE = {"pos": (0.1, 0.2, 0.3), "quat": (0.9, 0.1, 0.2, 0.3)}
"""MuJoCo fixes poses of zero for good."""

AHEAD = (0.0, 0.0, 0.0, 1.0)  # the orientation of something that is not turned
_ROLLING_FRICTION = 1e-4  # not in force: contacts have four dimensions


@dataclass(frozen=True, kw_only=True)
class Assembly:
    """What there is, and how it is commanded.

    Attributes:
        blocks: Names of the movable blocks, in the order of the state.
        preset: Numerical settings.
        obstacles: Names of boxes that never move by themselves. Blocks, middle and lower links
            and fingertips collide with them.
        hulls: The movable blocks that are no boxes, each with its convex shape.
        torques: Whether joint torques are commanded [N m], and not joint positions [rad].
        resolution: Whether all joints, those of a finger, or each are a state; see ``joints_of``.
        published: Whether Bullet realises the bodies of the predecessor; see ``published``.
    """

    blocks: tuple[str, ...] = ()
    preset: Preset = FAST
    obstacles: tuple[str, ...] = ()
    hulls: tuple[tuple[str, Hull], ...] = ()
    torques: bool = False
    resolution: str = RESOLUTIONS[0]
    published: bool = False


@final
@dataclass(frozen=True, eq=False)
class TriFinger(Model, Assembly):
    """The robot with blocks and obstacles."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how it is made, so that pickling costs little."""
        return self.with_, ()

    @property
    def with_(self) -> Callable[..., TriFinger]:
        """A function that makes this model with some arguments of ``trifinger`` replaced."""
        return partial(trifinger, **{name: getattr(self, name) for name in _PARTS})

    def empty_state(self) -> State:
        """Return a state to read into."""
        return PhysicalState(self.layout)


_PARTS = tuple(Assembly.__dataclass_fields__)
START = "start"
"""The keyframe in which fingers and blocks are clear of one another."""
COLUMNS, ROWS = 3, 2
SPACING = 0.1  # [m] between the centers of blocks that stand side by side
LAYER = 0.07  # [m] between the centers of blocks that stand on one another


@lru_cache(maxsize=64)
def trifinger(
    blocks: tuple[str, ...] = (),
    preset: Preset = FAST,
    obstacles: tuple[str, ...] = (),
    hulls: tuple[tuple[str, Hull], ...] = (),
    *,
    torques: bool = False,
    resolution: str = RESOLUTIONS[0],
    published: bool = False,
) -> TriFinger:
    """Return the model of the robot with some blocks and obstacles; it is made once in a process.

    The arguments are those of ``Assembly``. The parameters of the model are, with the friction of a
    contact as the product of those of its two bodies:

    ======================  ==========================================
    element                 properties
    ======================  ==========================================
    ``world``               ``gravity`` (3,) [m/s²], ``restitution``, ``spinning_friction``
    ``robot``               ``height`` [m], ``friction``, ``joint_damping`` [N m s/rad]
    ``controller``          ``position_gains`` (3,) [N m/rad], ``velocity_gains`` (3,)
                            [N m s/rad], ``safety_damping`` (3,) [N m s/rad],
                            ``torque_limit`` [N m]; see ``ControllerSpec``
    ``robot_finger_F_link_i``  ``mass`` [kg], ``color`` (3,)
    ``floor``, ``stage``    ``friction``, ``color`` (3,)
    every block             ``mass`` [kg], ``size`` (3,) [m], ``friction``, ``color`` (3,);
                            one that is a hull has no ``size``
    every obstacle          ``size`` (3,) [m], ``friction``, ``color`` (3,), ``position`` (3,)
                            [m], ``orientation`` (4,)
    ======================  ==========================================
    """
    parts = Assembly(
        blocks=blocks,
        preset=preset,
        obstacles=obstacles,
        hulls=hulls,
        torques=torques,
        resolution=resolution,
        published=published,
    )
    read = _read(replace(parts, published=False))
    described = {name: getattr(read, name) for name in read.__dataclass_fields__}
    described["digest"] += f" {published}"
    instead = partial(_read, parts) if published else None
    described |= {"instead": instead, "views": VIEWS, "fake": fake}
    return TriFinger(**described, **vars(parts))


@lru_cache(maxsize=64)
def _read(parts: Assembly) -> Model:
    """Compile what there is, and describe it; ``published`` is the variant of the predecessor."""
    states: dict[str, list[str]] = {}
    for index, what in enumerate(("position", "velocity", "actuator_torque")):
        for group in joints_of(parts.resolution):
            joints = range(group.where.start, group.where.stop)
            states[group.names[index]] = [f"{_JOINT_NAMES[i]}.{what}" for i in joints]
    for block in parts.blocks:
        names = (f"{block}.{what}" for what in MOTION)
        states |= {name: [name] for name in names}
    return read_model(
        _compiled(parts),
        name="trifinger",
        keyframe=START,
        states=states,
        controls=N_JOINTS,
        bindings=lambda mj, data, trees: (one for one, _ in _rows(mj, data, trees, parts)),
        frame="world",
        part_of={tip_name(finger): link_name(finger, 3) for finger in FINGERS},
    )


MOTION = ("cartesian_position", "orientation", "linear_velocity", "angular_velocity")
"""The states of a block, in the order of the state vector."""
_JOINT_NAMES = tuple(link_name(finger, index) for finger in FINGERS for index in (1, 2, 3))


def _compiled(parts: Assembly) -> mujoco.MjModel:
    """Compile what there is, with the default of every parameter, and with the start."""
    hulls = dict(parts.hulls)
    spec = mujoco.MjSpec()
    spec.modelname = "scm_world"
    spec.compiler.degree = False
    spec.default.geom.contype = spec.default.geom.conaffinity = 0  # pairs say what touches
    _write_options(spec, parts)
    floor = spec.worldbody.add_body(name=FLOOR)
    floor.add_geom(name=FLOOR, type=_PLANE, size=(WALL_RADIUS, WALL_RADIUS, 0.1))
    box = {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": (_BLOCK_HALF,) * 3}
    for name in parts.obstacles:
        spec.worldbody.add_body(name=name).add_geom(name=name, **box, **_OBSTACLE_POSE)
    _add_wall(spec.worldbody)
    _add_robot(spec, parts)
    for name in parts.blocks:
        body, hull = spec.worldbody.add_body(name=name), hulls.get(name)
        body.add_freejoint()
        body.mass = _BLOCK_MASS
        body.inertia = (_BLOCK_MASS / 6 * (2 * _BLOCK_HALF) ** 2,) * 3
        body.explicitinertial = True
        if hull is None:
            body.add_geom(name=name, **box)
        else:  # MuJoCo moves a mesh into a frame of its own and the shape back by as much
            mesh = spec.add_mesh(name=name)
            mesh.uservert = [number for vertex in hull.vertices for number in vertex]
            mesh.userface = [index for face in hull.faces for index in face]
            body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)
    spec.add_numeric(name="bullet_explicit_servos", size=1, data=[1.0])
    pairs = contact_pairs(parts)
    if parts.published:
        alter(spec)
        pairs = touching(parts.blocks, parts.obstacles)
    contact, sliding = (table[parts.preset.name] for table in (CONTACT, SLIDING))
    pair = spec.default.pair
    pair.condim, pair.margin, pair.gap, pair.solref = 4, 0.0, 0.0, contact
    pair.friction = (1.0, 1.0, SPINNING_FRICTION, _ROLLING_FRICTION, _ROLLING_FRICTION)
    for one, other, slides in pairs:
        reference = sliding if slides else contact
        spec.add_pair(geomname1=one, geomname2=other, solreffriction=reference)
    start = [*hardware.REST]
    for index in range(len(parts.blocks)):
        layer, spot = divmod(index, COLUMNS * ROWS)
        row, column = divmod(spot, COLUMNS)
        x = SPACING * (column - (min(len(parts.blocks), COLUMNS) - 1) / 2)
        start += [x, 0.09 * row, _BLOCK_HALF + LAYER * layer, 1.0, 0.0, 0.0, 0.0]
    spec.add_key(name=START, qpos=start)
    model = spec.compile()
    if parts.published:
        restore(model)
    scratch = mujoco.MjData(model)
    for bound, default in _rows(model, scratch, Couplings(model), parts):
        slot = bound.slot(model, scratch)  # type: ignore[misc] # every binding has one
        slot.write(np.asarray(default, dtype=np.float64))
    couple(model)
    mujoco.mj_setConst(model, scratch)
    return model


def tip_name(finger: str) -> str:
    """Name the tip of a finger."""
    return f"robot_finger_{finger}_tip"


def contact_pairs(parts: Assembly) -> Iterator[tuple[str, str, bool]]:
    """List which shapes can touch, and whether they slide (True) or grip (False).

    Yields:
        Two shapes, and whether their friction is the soft one.
    """
    walls, blocks = [f"{STAGE}/{i}" for i in range(WALL_SEGMENTS)], parts.blocks
    for i, block in enumerate(blocks):
        yield FLOOR, block, True
        yield from ((fixed, block, True) for fixed in (*walls, *parts.obstacles))
        yield from ((block, other, True) for other in blocks[i + 1 :])
        for finger in FINGERS:
            yield from ((f"{finger}/{shape}", block, False) for shape in SHAPES)
    for finger in FINGERS:
        yield from (
            (fixed, f"{finger}/{shape}", False)
            for fixed in (FLOOR, *parts.obstacles)
            for shape in SHAPES[1:]
        )
        # Nothing but a tip reaches the ring: the knee stays within 0.232 m of the center.
        yield from ((wall, f"{finger}/tip", False) for wall in walls)
    for finger, other in combinations(FINGERS, 2):
        for mine, its in product(SHAPES[1:], repeat=2):
            yield f"{finger}/{mine}", f"{other}/{its}", False


def _write_options(spec: mujoco.MjSpec, parts: Assembly) -> None:
    """Write everything that concerns the whole simulation."""
    option = spec.option
    option.timestep = parts.preset.timestep
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
    option.jacobian = sparse if len(parts.blocks) > MANY else dense
    # A simulation that explodes must say so instead of starting again. A warm start is accepted
    # or rejected for all islands together, so that bodies that do not touch would act on each
    # other's last digits; without it, a step is a function of positions, velocities and command
    # alone, and a parameter of what does not touch does exactly nothing.
    off = mujoco.mjtDisableBit.mjDSBL_AUTORESET | mujoco.mjtDisableBit.mjDSBL_WARMSTART
    option.disableflags = int(off)
    option.enableflags = 0  # sleeping islands, in particular, cannot be restored exactly


def _add_wall(world: mujoco.MjsBody) -> None:
    stage = world.add_body(name=STAGE)
    outer = WALL_RADIUS + WALL_THICKNESS
    half = (WALL_THICKNESS / 2, outer * math.tan(math.pi / WALL_SEGMENTS), WALL_HEIGHT / 2)
    center = WALL_RADIUS + WALL_THICKNESS / 2
    for i in range(WALL_SEGMENTS):
        angle = 2 * math.pi * i / WALL_SEGMENTS
        stage.add_geom(
            name=f"{STAGE}/{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=(center * math.cos(angle), center * math.sin(angle), WALL_HEIGHT / 2),
            quat=_yaw(angle),
            size=half,
            group=UNSEEN,
        )
        w, _, _, z = _yaw(angle)
        stage.add_geom(  # seen from within only
            name=f"{STAGE}/{i}/inside",
            type=_PLANE,
            pos=(WALL_RADIUS * math.cos(angle), WALL_RADIUS * math.sin(angle), WALL_HEIGHT / 2),
            quat=(w, z, -w, z),
            size=(WALL_HEIGHT / 2, WALL_RADIUS * math.tan(math.pi / WALL_SEGMENTS), 0.1),
        )


def _add_robot(spec: mujoco.MjSpec, parts: Assembly) -> None:
    """Hang each finger from the world; then add nine servos or motors, and nine dampers.

    MuJoCo works in the frame of the center of mass of a kinematic tree. With a tree per finger,
    and the links that cannot move outside of them, no mass changes the roundings elsewhere.
    """
    contact = CONTACT[parts.preset.name]
    height, world = hardware.NOMINAL_HEIGHT - hardware.TABLE_OFFSET, spec.worldbody
    hub = world.add_body(name=ROBOT, pos=(0.0, 0.0, height))
    ellipsoid = mujoco.mjtGeom.mjGEOM_ELLIPSOID
    hub.add_geom(name=ROBOT, type=ellipsoid, size=HUB_HALVES, rgba=HUB_COLOR)
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
        _add_capsule(fixed, f"{finger}/base", MOUNT)
        body = world.add_body(name=f"{finger}/base", **pose)
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
                actfrcrange=(-_SPEC.limit, _SPEC.limit),
            )
            name = SHAPES[index - 1]
            _add_capsule(body, f"{finger}/{name}", hardware.COLLISION[name])
        tip = body.add_body(name=tip_name(finger), pos=hardware.TIP_ORIGIN)
        tip.mass, tip.inertia, tip.explicitinertial = hardware.TIP_MASS, hardware.TIP_INERTIA, True
        tip.ipos = (0.0, 0.0, 0.0)  # MuJoCo takes ``pos`` where none is said
        tip.add_site(name=tip_name(finger), group=UNSEEN)
        _add_capsule(tip, f"{finger}/tip", hardware.COLLISION["tip"])
    for purpose, limit in (("servo", _SPEC.limit), ("safety", 0.0)):
        motor = float(parts.torques and purpose == "servo")
        for joint in _JOINT_NAMES:
            spec.add_actuator(  # without gains: they are parameters and follow
                name=f"{joint}_{purpose}",
                trntype=mujoco.mjtTrn.mjTRN_JOINT,
                target=joint,
                gaintype=mujoco.mjtGain.mjGAIN_FIXED,
                gainprm=[motor, *[0.0] * 9],
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
    ends, size = (*capsule.start, *capsule.end), (capsule.radius, 0.0, 0.0)
    body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=ends, size=size)


def _yaw(angle: float) -> tuple[float, float, float, float]:
    """Return the MuJoCo quaternion (w, x, y, z) of a turn about z."""
    return (math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2))


# --- bindings ----------------------------------------------------------------------------------


GAINS: tuple[tuple[Any, ...], ...] = (
    ("position_gains", _SPEC.kp, "N m/rad", ("gainprm", 0, 0, 1.0), ("biasprm", 0, 1, -1.0)),
    ("safety_damping", _SPEC.safety, "N m s/rad", ("biasprm", N_JOINTS, 2, -1.0)),
    ("velocity_gains", _SPEC.kd, "N m s/rad", ("biasprm", 0, 2, -1.0)),
)
"""Name, default and unit; then array, first actuator, column and sign of each place."""

Row = tuple[Parameter, object]
"""A parameter, and its default."""


def _rows(
    mj: mujoco.MjModel, data: mujoco.MjData, trees: Couplings, parts: Assembly
) -> Iterator[Row]:
    """List the parameters: what each is, where it is written, on which trees it acts, default."""
    fingers = [trees.tree(mj.body(link_name(finger, 1)).id) for finger in FINGERS]
    everything, touching = trees.always(trees.every), trees.touching(trees.every)
    touched, robot = trees.touching(fingers), trees.always(fingers)

    def row(
        name: str, default: object, unit: str, slot: Finder, effect: Effect, doc: str, **rest: Any
    ) -> Row:
        now, (always, contact) = slot(mj, data).read(), effect
        bounds = numbers(now), -math.inf, math.inf
        made = Parameter(name, unit, now.shape, *bounds, doc, always, contact, slot=slot, **rest)
        return made, default

    def color(element: str, default: object, shapes: Sequence[str]) -> Row:
        slot, doc = partial(_color, shapes=tuple(shapes)), "Red, green and blue."
        return row(f"{element}.color", default, "1", slot, NOTHING, doc, visual=True)

    def friction(element: str, default: float, shapes: Sequence[str], effect: Effect) -> Row:
        slot, doc = partial(_friction, shapes=tuple(shapes)), "Factor of all its contacts."
        return row(f"{element}.friction", default, "1", slot, effect, doc)

    down, free = (0.0, 0.0, -9.81), "Acceleration of free fall."
    yield row("world.gravity", down, "m/s^2", _gravity, everything, free)
    rigid = partial(_restitution, rigid=CONTACT[parts.preset.name])
    doc = "Speed after an impact over that before."
    yield row("world.restitution", 0.0, "1", rigid, touching, doc)
    spins, doc = partial(_spinning, parts=parts), "Torsional, of every contact."
    yield row("world.spinning_friction", SPINNING_FRICTION, "m", spins, touching, doc)
    doc = "Height of the base; see ``hardware``."
    yield row("robot.height", hardware.NOMINAL_HEIGHT, "m", _height, touched, doc)
    links = [f"{f}/{shape}" for f in FINGERS for shapes in LINK_SHAPES for shape in shapes]
    yield friction("robot", 0.5, links, touched)
    yield row("robot.joint_damping", 0.0, "N m s/rad", _damping, robot, "Of every joint.")
    for name, gain, unit, *places in GAINS[1:2] if parts.torques else GAINS:
        slot, doc = partial(_gains, places=places), "Of the three joints of a finger."
        yield row(f"controller.{name}", gain, unit, slot, robot, doc)
    doc = "Largest torque of a joint."
    yield row("controller.torque_limit", _SPEC.limit, "N m", _limit, robot, doc)
    for tree, finger in zip(fingers, FINGERS, strict=True):
        for index, inertial in enumerate(hardware.INERTIAL):
            link, mass = link_name(finger, index), hardware.LINK_MASS[index]
            scaled = partial(_scaled_mass, body=link, per_mass=inertial.per_mass)
            effect = trees.always([tree]) if index else NOTHING
            yield row(f"{link}.mass", mass, "kg", scaled, effect, "Its inertia scales with it.")
            shapes = [f"{finger}/{shape}" for shape in LINK_SHAPES[index]]
            yield color(link, hardware.LINK_COLORS[finger], shapes)
    walls = [f"{STAGE}/{i}" for i in range(SIDES if parts.published else WALL_SEGMENTS)]
    insides = [f"{STAGE}/{i}/inside" for i in range(WALL_SEGMENTS)]
    yield friction(FLOOR, 0.5, [FLOOR], touching)
    yield color(FLOOR, (0.31, 0.27, 0.25), [FLOOR])
    yield friction(STAGE, 0.5, walls, touching)
    yield color(STAGE, (0.95, 0.95, 0.95), insides)
    hulls, size = dict(parts.hulls), (2.0 * _BLOCK_HALF,) * 3
    for name in parts.blocks:
        tree, slot = trees.tree(mj.body(name).id), partial(_box, name=name, quantity="mass")
        own, contact = trees.always([tree]), trees.touching([tree])
        if name in hulls:
            slot = partial(_scaled_mass, body=name, per_mass=hulls[name].moments)
        # A free body falls and tumbles as it does whatever its mass is.
        yield row(f"{name}.mass", _BLOCK_MASS, "kg", slot, contact, "Its inertia follows.")
        if name not in hulls:
            slot = partial(_box, name=name, quantity="size")
            doc = "Full edge lengths; the inertia follows."
            yield row(f"{name}.size", size, "m", slot, own, doc)
        yield friction(name, 1.0, [name], contact)
        yield color(name, (1.0, 0.0, 0.0), [name])
    for index, name in enumerate(parts.obstacles):
        effect = trees.contact_of(mj.geom(name).id)
        center = (0.02 * index - 0.1, 0.15, 0.005)
        for what, default in (("size", (0.01,) * 3), ("position", center), ("orientation", AHEAD)):
            unit = "m" if default is not AHEAD else "1"
            nature: Any = "real" if default is not AHEAD else "rotation"
            slot = partial(_obstacle, name=name, quantity=what)
            yield row(f"{name}.{what}", default, unit, slot, effect, "Of the box.", kind=nature)
        yield friction(name, 0.5, [name], effect)
        yield color(name, (0.0,) * 3, [name])


def _gravity(mj: mujoco.MjModel, _: Any) -> Slot:
    return place(mj.opt.gravity)


def _spinning(mj: mujoco.MjModel, _: Any, *, parts: Assembly) -> Slot:
    if parts.published:
        weights = spinning_weights(mj, parts.blocks, parts.obstacles)
    else:
        weights = np.ones(mj.ngeom)
    view, base = mj.geom_friction[:, 1], mj.geom(f"{FINGERS[0]}/base").id
    own = view[base, ...]

    def write(value: Floats) -> None:
        view[:] = value * weights

    return Slot(write, own.copy, follow_up=couple)


def _height(mj: mujoco.MjModel, _: Any) -> Slot:
    names = [name for finger in FINGERS for name in (f"{finger}/base", link_name(finger, 0))]
    heights = [mj.body_pos[mj.body(name).id, 2, ...] for name in (ROBOT, *names)]
    offset = hardware.TABLE_OFFSET
    return place(*heights, to=lambda z: z - offset, back=lambda z: z + offset, constant=True)


def _damping(mj: mujoco.MjModel, _: Any) -> Slot:
    return place(mj.dof_damping[:N_JOINTS], back=first)


def _limit(mj: mujoco.MjModel, _: Any) -> Slot:
    """Find the limit of servo and joint: the joint clips the sum of servo and damper."""
    ranges = mj.actuator_forcerange[:N_JOINTS], mj.jnt_actfrcrange[:N_JOINTS]
    return place(*ranges, to=lambda limit: np.array([-limit, limit]), back=lambda r: r[0, 1])


def _gains(mj: mujoco.MjModel, _: Any, *, places: Sequence[tuple[str, int, int, float]]) -> Slot:
    """Find a number for each joint of a finger, shape (3,); all fingers have the same."""
    views = [
        (getattr(mj, f"actuator_{array}")[start : start + N_JOINTS, column], sign)
        for array, start, column, sign in places
    ]

    def write(value: Floats) -> None:
        for view, sign in views:
            view[:] = np.tile(sign * value, len(FINGERS))

    view, sign = views[0]
    return Slot(write, lambda: sign * view[: N_JOINTS // len(FINGERS)])


def _friction(mj: mujoco.MjModel, _: Any, *, shapes: tuple[str, ...]) -> Slot:
    """Find the factor of one body. Contact pairs get products; the factors rest in the shapes."""
    views = (mj.geom_friction[mj.geom(name).id, 0, ...] for name in shapes)
    return place(*views, follow_up=couple)


def _color(mj: mujoco.MjModel, _: Any, *, shapes: tuple[str, ...]) -> Slot:
    """Find red, green, blue, shape (3,); MuJoCo keeps 32 bits of each."""
    return place(*(mj.geom_rgba[mj.geom(name).id, :3] for name in shapes))


def _scaled_mass(mj: mujoco.MjModel, _: Any, *, body: str, per_mass: tuple[float, ...]) -> Slot:
    """Find the mass of a link or a hull [kg]; its moments of inertia scale with it."""
    index, moments = mj.body(body).id, np.array(per_mass)
    mass, inertia = mj.body_mass[index, ...], mj.body_inertia[index]

    def write(value: Floats) -> None:
        mass[...] = value
        inertia[:] = value * moments

    return Slot(write, mass.copy, constant=True)


def _box(mj: mujoco.MjModel, _: Any, *, name: str, quantity: str) -> Slot:
    """Find mass [kg] or full edge lengths [m] of a solid box; its inertia follows both."""
    body = mj.body(name).id
    mass, inertia = mj.body_mass[body, ...], mj.body_inertia[body]
    half = mj.geom_size[mj.geom(name).id]

    def write(value: Floats) -> None:
        if quantity == "mass":
            mass[...] = value
        else:
            half[:] = 0.5 * value
        (x, y, z), third = (half * half).tolist(), float(mass) / 3.0
        inertia[:] = third * (y + z), third * (z + x), third * (x + y)  # m/12 (b² + c²)

    read = mass.copy if quantity == "mass" else lambda: 2.0 * half
    return Slot(write, read, constant=True)


def _obstacle(mj: mujoco.MjModel, _: Any, *, name: str, quantity: str) -> Slot:
    """Find edge lengths [m], center [m] or orientation of a box that nothing moves."""
    shape = mj.geom(name).id
    if quantity == "position":
        return place(mj.geom_pos[shape], constant=True)
    if quantity == "orientation":
        return turn(mj.geom_quat[shape])
    return place(mj.geom_size[shape], to=lambda v: 0.5 * v, back=lambda v: 2.0 * v, constant=True)


def _restitution(mj: mujoco.MjModel, _: Any, *, rigid: tuple[float, float]) -> Slot:
    """Find how much of its speed a body keeps when it bounces, in [0, 1).

    A contact is a spring and a damper. A damping ratio z leaves ``exp(-pi z / sqrt(1 - z²))`` of
    the speed after half a period; the frequency stays, and with it how far a body sinks in.

    ``rigid`` has time constant [s] and damping ratio of a contact without restitution, which is
    critically damped.
    """
    time, ratio = rigid
    references = mj.pair_solref

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


def couple(mj: mujoco.MjModel) -> None:
    """Write the product of its two frictions into every contact pair, and its spinning friction."""
    factors, first = mj.geom_friction, mj.pair_geom1
    both = factors[first, 0] * factors[mj.pair_geom2, 0]
    mj.pair_friction[:, :2] = both[:, None]
    mj.pair_friction[:, 2] = np.minimum(factors[first, 1], SPINNING_LIMIT * both)
