"""The TriFinger and its blocks as a model: an ``MjSpec``, and parameters bound to its arrays.

Stock settings cannot lift a block with three fingers, let it creep on a slope and make a fast one
hover. A softer friction reference for contacts without fingers, elliptic cones and a high
``impratio`` mend all three. Fingers keep the hard reference: they have to grip.

Source:
    Measured; see ``docs/decisions.md``.

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
from weakref import WeakValueDictionary

import mujoco
import numpy as np

from scm_world._types import ArrayLike, Floats
from scm_world.backends.mujoco.fields import numbers
from scm_world.backends.mujoco.reading import read_model
from scm_world.backends.mujoco.slots import Finder, Slot, first, place, turn
from scm_world.backends.mujoco.trees import NOTHING, Couplings, Effect
from scm_world.geometry.hulls import Hull
from scm_world.models.model import Model, Parameter
from scm_world.models.scene import Parameters, State
from scm_world.tasks.trifinger import hardware, published
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
    Preset,
    joints_of,
    link_name,
)

FLOOR, STAGE = "floor", "stage"
ROBOT = "robot"  # the hub that carries the fingers; nothing touches it
UNSEEN = 3  # the first group of shapes that no picture shows
MOUNT = hardware.Capsule((0.012, 0.0, 0.0), (-0.004, 0.0, 0.0), 0.0235)
"""How link 0 looks; its published mesh is a frame that hides the arena from above."""

SHAPES = ("upper", "middle", "lower", "tip")  # in the order of the links 1, 2, 3 and 3
LINK_SHAPES = (("base",), ("upper",), ("middle",), ("lower", "tip"))
"""The shapes of links 0 to 3 of a finger; the base touches nothing."""

MANY = 8
"""From more blocks than this on, the Jacobian of the constraints is a sparse matrix."""
SPINNING_LIMIT = 1.0
"""At most this many times its sliding friction is the spinning friction of a pair [m]. Above about
five times the solver of the engine speeds a spinning body up, tenfold and more in a step; a real
patch of contact gives two thirds of its radius."""

START = "start"
"""The keyframe in which fingers and blocks are clear of one another."""

_PLANE = mujoco.mjtGeom.mjGEOM_PLANE  # has no end where it collides, whatever its size
_BOX = mujoco.mjtGeom.mjGEOM_BOX
_BLOCK_HALF = 0.0325  # [m] any positive size and mass do: parameters follow
_BLOCK_MASS = 0.02  # [kg]
_JOINT_NAMES = tuple(link_name(finger, index) for finger in FINGERS for index in (1, 2, 3))


def _joints(first: int, doc: str) -> Any:
    return property(lambda state: state.vector[first : first + N_JOINTS], doc=doc)


def _columns(first: int, end: int, doc: str) -> Any:
    return property(lambda state: state.blocks[:, first:end], doc=doc)


@final
class PhysicalState(State):
    """What moves.

    The vector is ``[joint positions (9) | joint velocities (9) | joint torques (9) | block 0 (13)
    | block 1 (13) | …]`` and a block is ``[position (3) | orientation (4) | linear velocity (3) |
    angular velocity (3)]``. All properties are views: writing into them writes the vector.

    Positions are in the world frame with the table top at z = 0 [m], orientations are unit
    quaternions (x, y, z, w) with w >= 0, velocities are those of the center in the world frame
    [m/s], [rad/s]. Joint torques [N m] are the ones of the last physics step; they can be read
    but not set.
    """

    __slots__ = ()

    joint_positions = _joints(0, "Shape (9,) [rad].")
    joint_velocities = _joints(N_JOINTS, "Shape (9,) [rad/s].")
    joint_torques = _joints(2 * N_JOINTS, "Shape (9,) [N m].")
    blocks = property(lambda self: self.vector[27:].reshape(-1, 13), doc="Shape (n, 13).")
    positions = _columns(0, 3, "Shape (n, 3) [m].")
    orientations = _columns(3, 7, "Shape (n, 4).")
    linear_velocities = _columns(7, 10, "Shape (n, 3) [m/s].")
    angular_velocities = _columns(10, 13, "Shape (n, 3) [rad/s].")


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
        parts = Assembly.__dataclass_fields__
        return partial(trifinger, **{name: getattr(self, name) for name in parts})

    def empty_state(self) -> PhysicalState:
        """Return a state to read into."""
        return PhysicalState(self.layout)

    def move(self, state: PhysicalState, command: Floats, seconds: float) -> None:
        """Move blocks and joints without physics: joints jump, or stay under torques.

        See ``backends.fake``, as for the two below.
        """
        if not self.torques:
            state.joint_positions[:] = command
        state.joint_torques[:] = command if self.torques else 0.0
        blocks = state.blocks
        blocks[:, :3] += seconds * blocks[:, 7:10]

    def settle(self, state: PhysicalState) -> None:
        """Turn quaternions so that w is not negative."""
        state.orientations[state.orientations[:, 3] < 0.0] *= -1.0

    def inertia(self, parameters: Parameters, body: str) -> Floats:
        """Compute the principal moments of inertia of a block or a link, shape (3,) [kg m²]."""
        mass, hull = parameters[body, "mass"], dict(self.hulls).get(body)
        if hull is None and body not in hardware.LINK_NAMES:
            squares = parameters[body, "size"] ** 2
            return np.asarray(mass / 12.0 * (squares.sum() - squares))
        per_mass = hull.moments if hull else hardware.INERTIAL[int(body[-1])].per_mass
        return np.asarray(mass * np.array(per_mass))


_MADE: WeakValueDictionary[Assembly, TriFinger] = WeakValueDictionary()


def trifinger(
    blocks: tuple[str, ...] = (),
    preset: Preset = FAST,
    obstacles: tuple[str, ...] = (),
    hulls: tuple[tuple[str, Hull], ...] = (),
    **options: Any,
) -> TriFinger:
    """Return the model of the robot with some blocks and obstacles: one object while it is used.

    The arguments are those of ``Assembly``. The parameters of the model are, with the friction of a
    contact as the product of those of its two bodies:

    ======================  ==========================================
    element                 properties
    ======================  ==========================================
    ``world``               ``gravity`` (3,) [m/s²], ``restitution``, ``spinning_friction``
    ``robot``               ``height`` [m], ``friction``, ``joint_damping`` [N m s/rad]
    ``controller``          ``position_gains`` (3,) [N m/rad], ``velocity_gains`` (3,)
                            [N m s/rad], ``safety_damping`` (3,) [N m s/rad],
                            ``torque_limit`` [N m]; see ``hardware``
    ``robot_finger_F_link_i``  ``mass`` [kg], ``color`` (3,)
    ``floor``, ``stage``    ``friction``, ``color`` (3,)
    every block             ``mass`` [kg], ``size`` (3,) [m], ``friction``, ``color`` (3,);
                            one that is a hull has no ``size``
    every obstacle          ``size`` (3,) [m], ``friction``, ``color`` (3,), ``position`` (3,)
                            [m], ``orientation`` (4,)
    ======================  ==========================================
    """
    parts = Assembly(blocks=blocks, preset=preset, obstacles=obstacles, hulls=hulls, **options)
    if parts in _MADE:
        return _MADE[parts]
    read = _read(replace(parts, published=False))
    described = {name: getattr(read, name) for name in read.__dataclass_fields__}
    described["digest"] += f" {parts.published}"
    described["instead"] = partial(_published, parts) if parts.published else None
    return _MADE.setdefault(parts, TriFinger(**described | vars(parts) | {"views": VIEWS}))


@lru_cache(maxsize=8)
def _published(parts: Assembly) -> Model:
    return _read(parts)


def _read(parts: Assembly) -> Model:
    """Compile what there is, and describe it; ``published`` is the variant of the predecessor."""
    states: dict[str, list[str]] = {}
    for index, what in enumerate(("position", "velocity", "actuator_torque")):
        for group in joints_of(parts.resolution):
            states[group.names[index]] = [f"{joint}.{what}" for joint in _JOINT_NAMES[group.where]]
    moves = ("cartesian_position", "orientation", "linear_velocity", "angular_velocity")
    states |= {f"{block}.{what}": [f"{block}.{what}"] for block in parts.blocks for what in moves}
    return read_model(
        _compiled(parts),
        name="trifinger",
        keyframe=START,
        states=states,
        controls=N_JOINTS,
        bindings=partial(_rows, parts),
        frame="world",
        part_of={tip_name(finger): link_name(finger, 3) for finger in FINGERS},
    )


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
    box = {"type": _BOX, "size": (_BLOCK_HALF,) * 3}
    pose = {"pos": (0.1, 0.2, 0.3), "quat": (0.9, 0.1, 0.2, 0.3)}  # zeros would be fixed for good
    for name in parts.obstacles:
        spec.worldbody.add_body(name=name).add_geom(name=name, **box, **pose)
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
        published.alter(spec)
        pairs = published.touching(parts.blocks, parts.obstacles)
    pair, contact = spec.default.pair, parts.preset.contact
    pair.condim, pair.margin, pair.gap, pair.solref = 4, 0.0, 0.0, contact
    pair.friction = (1.0, 1.0, SPINNING_FRICTION, 1e-4, 1e-4)  # rolling is not in force
    for one, other, slides in pairs:
        reference = parts.preset.sliding if slides else contact
        spec.add_pair(geomname1=one, geomname2=other, solreffriction=reference)
    start = [*hardware.REST]
    for index in range(len(parts.blocks)):  # in layers of two rows of three
        layer, spot = divmod(index, 6)
        row, column = divmod(spot, 3)
        x = 0.1 * (column - (min(len(parts.blocks), 3) - 1) / 2)
        start += [x, 0.09 * row, _BLOCK_HALF + 0.07 * layer, 1.0, 0.0, 0.0, 0.0]
    spec.add_key(name=START, qpos=start)
    model = spec.compile()
    if parts.published:
        published.restore(model)
    scratch = mujoco.MjData(model)
    for _ in _rows(parts, model, scratch, Couplings(model)):
        pass  # each has written its default
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
    option.impratio = 100.0  # stiffness of friction over that of the normal
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
            type=_BOX,
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
    height, world = hardware.NOMINAL_HEIGHT - hardware.TABLE_OFFSET, spec.worldbody
    strongest = hardware.TORQUE_LIMIT
    hub = world.add_body(name=ROBOT, pos=(0.0, 0.0, height))
    ellipsoid = mujoco.mjtGeom.mjGEOM_ELLIPSOID
    color, halves = (0.35, 0.35, 0.38, 1.0), (0.034, 0.034, 0.012)
    hub.add_geom(name=ROBOT, type=ellipsoid, size=halves, rgba=color)
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
                axis=hardware.JOINT_AXES[index - 1],
                range=(-reach, reach),
                solref_limit=parts.preset.contact,
                actfrcrange=(-strongest, strongest),  # the joint clips the sum of servo and damper
            )
            name = SHAPES[index - 1]
            _add_capsule(body, f"{finger}/{name}", hardware.COLLISION[name])
        tip = body.add_body(name=tip_name(finger), pos=hardware.TIP_ORIGIN)
        tip.mass, tip.inertia, tip.explicitinertial = hardware.TIP_MASS, hardware.TIP_INERTIA, True
        tip.ipos = (0.0, 0.0, 0.0)  # MuJoCo takes ``pos`` where none is said
        tip.add_site(name=tip_name(finger), group=UNSEEN)
        _add_capsule(tip, f"{finger}/tip", hardware.COLLISION["tip"])
    for purpose, limit in (("servo", strongest), ("safety", 0.0)):
        motor = float(parts.torques and purpose == "servo")
        for joint in _JOINT_NAMES:
            spec.add_actuator(  # without gains: they are parameters and follow
                name=f"{joint}_{purpose}",
                trntype=mujoco.mjtTrn.mjTRN_JOINT,
                target=joint,
                gainprm=[motor, *[0.0] * 9],
                biastype=mujoco.mjtBias.mjBIAS_AFFINE,
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


def _rows(
    parts: Assembly, mj: mujoco.MjModel, data: mujoco.MjData, trees: Couplings
) -> Iterator[Parameter]:
    """Describe the parameters, and on which trees each acts; write the default of each."""
    fingers = [trees.tree(mj.body(link_name(finger, 1)).id) for finger in FINGERS]
    everything, touching = trees.always(trees.every), trees.touching(trees.every)
    touched, robot = trees.touching(fingers), trees.always(fingers)

    def row(
        name: str, default: Any, unit: str, effect: Effect, doc: str, find: Finder, **rest: Any
    ) -> Parameter:
        slot, (always, contact) = find(mj, data), effect
        slot.write(np.asarray(default, dtype=np.float64))
        now = slot.read()
        bounds = numbers(now), -math.inf, math.inf
        return Parameter(name, unit, now.shape, *bounds, doc, always, contact, slot=find, **rest)

    def color(element: str, default: ArrayLike, shapes: Sequence[str]) -> Parameter:
        find, doc = _of_shapes(shapes, "geom_rgba", slice(3)), "Red, green and blue."
        return row(f"{element}.color", default, "1", NOTHING, doc, find, visual=True)

    def friction(element: str, default: float, shapes: Sequence[str], effect: Effect) -> Parameter:
        # Contact pairs get products; the factors rest in the shapes.
        find = _of_shapes(shapes, "geom_friction", 0, follow_up=couple)
        return row(f"{element}.friction", default, "1", effect, "Factor of all its contacts.", find)

    doc, down = "Acceleration of free fall.", (0.0, 0.0, -9.81)
    yield row("world.gravity", down, "m/s^2", everything, doc, lambda mj, _: place(mj.opt.gravity))
    doc, find = "Speed after an impact over that before.", _restitution(*parts.preset.contact)
    yield row("world.restitution", 0.0, "1", touching, doc, find)
    doc, find = "Torsional, of every contact.", partial(_spinning, parts)
    yield row("world.spinning_friction", SPINNING_FRICTION, "m", touching, doc, find)
    doc = "Height of the base; see ``hardware``."
    yield row("robot.height", hardware.NOMINAL_HEIGHT, "m", touched, doc, _height)
    links = [f"{f}/{shape}" for f in FINGERS for shapes in LINK_SHAPES for shape in shapes]
    yield friction("robot", 0.5, links, touched)
    yield row(
        "robot.joint_damping", 0.0, "N m s/rad", robot, "Of every joint.",
        lambda mj, _: place(mj.dof_damping[:N_JOINTS], back=first),
    )  # fmt: skip
    gains: tuple[tuple[Any, ...], ...] = (  # array, first actuator, column and sign of each place
        ("position_gains", "N m/rad", ("gainprm", 0, 0, 1.0), ("biasprm", 0, 1, -1.0)),
        ("safety_damping", "N m s/rad", ("biasprm", N_JOINTS, 2, -1.0)),
        ("velocity_gains", "N m s/rad", ("biasprm", 0, 2, -1.0)),
    )
    for name, unit, *places in gains[1:2] if parts.torques else gains:
        default, doc = getattr(hardware, name.upper()), "Of the three joints of a finger."
        yield row(f"controller.{name}", default, unit, robot, doc, partial(_gains, places))
    doc, limit = "Largest torque of a joint.", hardware.TORQUE_LIMIT
    yield row("controller.torque_limit", limit, "N m", robot, doc, _limit)
    for tree, finger in zip(fingers, FINGERS, strict=True):
        for index, inertial in enumerate(hardware.INERTIAL):
            link, mass = link_name(finger, index), hardware.LINK_MASS[index]
            effect, doc = trees.always([tree]) if index else NOTHING, "Its inertia scales with it."
            find = _solid(link, "mass", inertial.per_mass)
            yield row(f"{link}.mass", mass, "kg", effect, doc, find)
            shapes = [f"{finger}/{shape}" for shape in LINK_SHAPES[index]]
            yield color(link, hardware.LINK_COLORS[finger], shapes)
    segments = published.SIDES if parts.published else WALL_SEGMENTS
    yield friction(FLOOR, 0.5, [FLOOR], touching)
    yield color(FLOOR, (0.31, 0.27, 0.25), [FLOOR])
    yield friction(STAGE, 0.5, [f"{STAGE}/{i}" for i in range(segments)], touching)
    yield color(STAGE, (0.95,) * 3, [f"{STAGE}/{i}/inside" for i in range(WALL_SEGMENTS)])
    hulls, size = dict(parts.hulls), (2.0 * _BLOCK_HALF,) * 3
    for name in parts.blocks:
        tree = trees.tree(mj.body(name).id)
        own, contact = trees.always([tree]), trees.touching([tree])
        find = _solid(name, "mass", hulls[name].moments if name in hulls else None)
        # A free body falls and tumbles as it does whatever its mass is.
        yield row(f"{name}.mass", _BLOCK_MASS, "kg", contact, "Its inertia follows.", find)
        if name not in hulls:
            doc = "Full edge lengths; the inertia follows."
            yield row(f"{name}.size", size, "m", own, doc, _solid(name, "size"))
        yield friction(name, 1.0, [name], contact)
        yield color(name, (1.0, 0.0, 0.0), [name])
    for index, name in enumerate(parts.obstacles):
        effect, center = trees.contact_of(mj.geom(name).id), (0.02 * index - 0.1, 0.15, 0.005)
        half, double = lambda v: 0.5 * v, lambda v: 2.0 * v
        find = _of_shapes([name], "geom_size", to=half, back=double, constant=True)
        yield row(f"{name}.size", (0.01,) * 3, "m", effect, "Of the box.", find)
        find = _of_shapes([name], "geom_pos", constant=True)
        yield row(f"{name}.position", center, "m", effect, "Of the box.", find)
        find, ahead = _of_shapes([name], "geom_quat", form=turn), (0.0, 0.0, 0.0, 1.0)
        yield row(f"{name}.orientation", ahead, "1", effect, "Of the box.", find, kind="rotation")
        yield friction(name, 0.5, [name], effect)
        yield color(name, (0.0,) * 3, [name])


def _of_shapes(
    shapes: Sequence[str],
    array: str,
    columns: int | slice = slice(None),
    form: Callable[..., Slot] = place,
    **how: object,
) -> Finder:
    """Return what finds columns of an array that are alike for some shapes."""

    def find(mj: mujoco.MjModel, _: mujoco.MjData) -> Slot:
        rows = getattr(mj, array)
        return form(*(rows[mj.geom(shape).id, columns, ...] for shape in shapes), **how)

    return find


def _spinning(parts: Assembly, mj: mujoco.MjModel, _: mujoco.MjData) -> Slot:
    weights = np.ones(mj.ngeom)
    if parts.published:
        weights = published.spinning_weights(mj, parts.blocks, parts.obstacles)
    view, base = mj.geom_friction[:, 1], mj.geom(f"{FINGERS[0]}/base").id
    own = view[base, ...]

    def write(value: Floats) -> None:
        view[:] = value * weights

    return Slot(write, own.copy, follow_up=couple)


def _height(mj: mujoco.MjModel, _: mujoco.MjData) -> Slot:
    names = [name for finger in FINGERS for name in (f"{finger}/base", link_name(finger, 0))]
    heights = [mj.body_pos[mj.body(name).id, 2, ...] for name in (ROBOT, *names)]
    offset = hardware.TABLE_OFFSET
    return place(*heights, to=lambda z: z - offset, back=lambda z: z + offset, constant=True)


def _limit(mj: mujoco.MjModel, _: mujoco.MjData) -> Slot:
    """Find the limit of servo and joint: the joint clips the sum of servo and damper."""
    ranges = mj.actuator_forcerange[:N_JOINTS], mj.jnt_actfrcrange[:N_JOINTS]
    return place(*ranges, to=lambda limit: np.array([-limit, limit]), back=lambda r: r[0, 1])


def _gains(
    places: Sequence[tuple[str, int, int, float]], mj: mujoco.MjModel, _: mujoco.MjData
) -> Slot:
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


def _solid(body: str, quantity: str, per_mass: Sequence[float] | None = None) -> Finder:
    """Return what finds mass [kg] or full edge lengths [m] of a body; its inertia follows both.

    Its moments of inertia are those of a box, unless they are given as multiples of the mass [m²].
    """

    def find(mj: mujoco.MjModel, _: mujoco.MjData) -> Slot:
        index = mj.body(body).id
        mass, inertia = mj.body_mass[index, ...], mj.body_inertia[index]
        half = mj.geom_size[mj.body_geomadr[index]]

        def write(value: Floats) -> None:
            if quantity == "mass":
                mass[...] = value
            else:
                half[:] = 0.5 * value
            if per_mass is not None:
                inertia[:] = value * np.array(per_mass)
                return
            (x, y, z), third = (half * half).tolist(), float(mass) / 3.0
            inertia[:] = third * (y + z), third * (z + x), third * (x + y)  # m/12 (b² + c²)

        read = mass.copy if quantity == "mass" else lambda: 2.0 * half
        return Slot(write, read, constant=True)

    return find


def _restitution(time: float, ratio: float) -> Finder:
    """Return what finds how much of its speed a body keeps when it bounces, in [0, 1).

    A contact is a spring and a damper. A damping ratio z leaves ``exp(-pi z / sqrt(1 - z²))`` of
    the speed after half a period; the frequency stays, and with it how far a body sinks in.

    ``time`` [s] and ``ratio`` are time constant and damping ratio of a contact without restitution,
    which is critically damped.
    """

    def find(mj: mujoco.MjModel, _: mujoco.MjData) -> Slot:
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

    return find


def couple(mj: mujoco.MjModel) -> None:
    """Write the product of its two frictions into every contact pair, and its spinning friction."""
    factors, first = mj.geom_friction, mj.pair_geom1
    both = factors[first, 0] * factors[mj.pair_geom2, 0]
    mj.pair_friction[:, :2] = both[:, None]
    mj.pair_friction[:, 2] = np.minimum(factors[first, 1], SPINNING_LIMIT * both)
