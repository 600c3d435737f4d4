"""From a structure to a compiled model; parameters have their defaults in it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache

import mujoco

from scm_world.geometry.hulls import Hull
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.controller import ControllerSpec
from scm_world.tasks.trifinger.hardware import FINGERS, link_name
from scm_world.tasks.trifinger.mujoco.settings import Settings, settings, write_options
from scm_world.tasks.trifinger.presets import Preset
from scm_world.tasks.trifinger.structure import (
    SPINNING_FRICTION,
    WALL_HEIGHT,
    WALL_RADIUS,
    WALL_SEGMENTS,
    WALL_THICKNESS,
    Structure,
)

FLOOR = "floor"
STAGE = "stage"
SHAPES = ("upper", "middle", "lower", "tip")  # in the order of the links 1, 2, 3 and 3

_BLOCK_HALF = 0.0325  # [m] any positive size and mass do: parameters follow
_BLOCK_MASS = 0.02  # [kg]
_TORQUE_LIMIT = ControllerSpec().limit  # [N m] any positive one does
_OBSTACLE_POSE = (0.1, 0.2, 0.3), (0.9, 0.1, 0.2, 0.3)  # MuJoCo fixes poses of zero for good
_ROLLING_FRICTION = 1e-4  # not in force: contacts have four dimensions


@lru_cache(maxsize=32)
def compiled(structure: Structure) -> mujoco.MjModel:
    """Compile a structure once. Callers copy the model before they change it."""
    spec = mujoco.MjSpec()
    spec.modelname = "scm_world"
    spec.compiler.degree = False
    write_options(spec, structure.preset, len(structure.blocks))
    _add_arena(spec)
    for name in structure.obstacles:
        _add_obstacle(spec, name)
    _add_robot(spec, structure.preset)
    for name in structure.blocks:
        _add_block(spec, name, structure.hull(name))
    gripping, sliding = _pair_classes(spec, settings(structure.preset))
    for first, second, slides in contact_pairs(structure):
        spec.add_pair(sliding if slides else gripping, geomname1=first, geomname2=second)
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


def shape_owners(structure: Structure) -> dict[str, str]:
    """Map every shape to the published name of its body."""
    owners = {FLOOR: FLOOR}
    owners |= {wall_name(i): STAGE for i in range(WALL_SEGMENTS)}
    for finger in FINGERS:
        for index in range(hardware.LINKS_PER_FINGER):
            owners |= {name: link_name(finger, index) for name in link_shapes(finger, index)}
    return owners | {name: name for name in (*structure.blocks, *structure.obstacles)}


def contact_pairs(structure: Structure) -> Iterator[tuple[str, str, bool]]:
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
        yield from (
            # Nothing but a tip reaches the ring: the knee stays within 0.232 m of the center.
            (wall, shape_name(finger, "tip"), False)
            for wall in walls
        )
    for i, finger in enumerate(FINGERS):
        for other in FINGERS[i + 1 :]:
            yield from (
                (shape_name(finger, mine), shape_name(other, its), False)
                for mine in SHAPES[1:]
                for its in SHAPES[1:]
            )


def _pair_classes(
    spec: mujoco.MjSpec, chosen: Settings
) -> tuple[mujoco.MjsDefault, mujoco.MjsDefault]:
    """Declare what contact pairs have in common: those that grip, and those that slide."""
    gripping = spec.default
    sliding = spec.add_default("sliding", gripping)
    for kind, friction in ((gripping, chosen.contact), (sliding, chosen.sliding)):
        pair = kind.pair
        pair.condim = 4
        pair.solref = chosen.contact
        pair.solreffriction = friction
        pair.friction = (1.0, 1.0, SPINNING_FRICTION, _ROLLING_FRICTION, _ROLLING_FRICTION)
        pair.margin = pair.gap = 0.0
    return gripping, sliding


def _add_arena(spec: mujoco.MjSpec) -> None:
    spec.worldbody.add_geom(
        name=FLOOR,
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=(1.0, 1.0, 0.1),
        contype=0,
        conaffinity=0,
    )
    stage = spec.worldbody.add_body(name=STAGE)
    outer = WALL_RADIUS + WALL_THICKNESS
    half = (WALL_THICKNESS / 2, outer * math.tan(math.pi / WALL_SEGMENTS), WALL_HEIGHT / 2)
    for i in range(WALL_SEGMENTS):
        angle = 2 * math.pi * i / WALL_SEGMENTS
        center = WALL_RADIUS + WALL_THICKNESS / 2
        stage.add_geom(
            name=wall_name(i),
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=(center * math.cos(angle), center * math.sin(angle), WALL_HEIGHT / 2),
            quat=_yaw(angle),
            size=half,
            contype=0,
            conaffinity=0,
        )


def _add_obstacle(spec: mujoco.MjSpec, name: str) -> None:
    position, orientation = _OBSTACLE_POSE
    _add_box(spec.worldbody, name, pos=position, quat=orientation)


def _add_block(spec: mujoco.MjSpec, name: str, hull: Hull | None) -> None:
    body = spec.worldbody.add_body(name=name)
    body.add_freejoint()
    body.mass = _BLOCK_MASS
    body.inertia = (_BLOCK_MASS / 6 * (2 * _BLOCK_HALF) ** 2,) * 3
    body.explicitinertial = True
    if hull is None:
        _add_box(body, name)
    else:
        _add_hull(spec, body, name, hull)


def _add_box(body: mujoco.MjsBody, name: str, **pose: tuple[float, ...]) -> None:
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=(_BLOCK_HALF,) * 3,
        contype=0,
        conaffinity=0,
        **pose,
    )


def _add_hull(spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, hull: Hull) -> None:
    """Add a mesh. MuJoCo moves it into a frame of its own and the shape back by as much."""
    mesh = spec.add_mesh(name=name)
    mesh.uservert = [number for vertex in hull.vertices for number in vertex]
    mesh.userface = [index for face in hull.faces for index in face]
    body.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, contype=0, conaffinity=0
    )


def _add_robot(spec: mujoco.MjSpec, preset: Preset) -> None:
    """Hang each finger from the world.

    MuJoCo works in the frame of the center of mass of a kinematic tree. With a tree per finger,
    and the links that cannot move outside of them, no mass changes the roundings elsewhere.
    """
    height = hardware.NOMINAL_HEIGHT - hardware.TABLE_OFFSET
    for finger, (x, y, z), yaw in zip(
        FINGERS, hardware.FINGER_OFFSET, hardware.FINGER_YAW, strict=True
    ):
        cos, sin = math.cos(hardware.WORLD_YAW), math.sin(hardware.WORLD_YAW)
        position = (cos * x - sin * y, sin * x + cos * y, z + height)
        orientation = _yaw(hardware.WORLD_YAW + yaw)
        fixed = spec.worldbody.add_body(name=link_name(finger, 0), pos=position, quat=orientation)
        _set_inertial(fixed, 0)
        fixed.add_geom(
            name=shape_name(finger, "base"),
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=(0.01, 0.0, 0.0),
            contype=0,
            conaffinity=0,
        )
        root = spec.worldbody.add_body(name=base_name(finger), pos=position, quat=orientation)
        _add_finger(root, finger, preset)
    _add_controller(spec)


def _add_finger(body: mujoco.MjsBody, finger: str, preset: Preset) -> None:
    for index in (1, 2, 3):
        body = body.add_body(name=link_name(finger, index), pos=hardware.JOINT_ORIGINS[index - 1])
        _set_inertial(body, index)
        reach = hardware.ENGINE_LIMITS[index - 1]
        body.add_joint(
            name=link_name(finger, index),
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=hardware.JOINT_AXES[index - 1],
            limited=True,
            range=(-reach, reach),
            solref_limit=settings(preset).contact,
            actfrclimited=True,
            actfrcrange=(-_TORQUE_LIMIT, _TORQUE_LIMIT),
        )
        _add_capsule(body, finger, SHAPES[index - 1])
    tip = body.add_body(name=f"robot_finger_{finger}_tip", pos=hardware.TIP_ORIGIN)
    tip.mass, tip.inertia, tip.explicitinertial = hardware.TIP_MASS, hardware.TIP_INERTIA, True
    _add_capsule(tip, finger, "tip")


def _set_inertial(body: mujoco.MjsBody, index: int) -> None:
    inertial, mass = hardware.INERTIAL[index], hardware.LINK_MASS[index]
    x, y, z, w = inertial.orientation
    body.mass = mass
    body.ipos = inertial.center
    body.iquat = (w, x, y, z)
    body.inertia = [mass * moment for moment in inertial.per_mass]
    body.explicitinertial = True


def _add_capsule(body: mujoco.MjsBody, finger: str, shape: str) -> None:
    capsule = hardware.COLLISION[shape]
    body.add_geom(
        name=shape_name(finger, shape),
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=(*capsule.start, *capsule.end),
        size=(capsule.radius, 0.0, 0.0),
        contype=0,
        conaffinity=0,
    )


def _add_controller(spec: mujoco.MjSpec) -> None:
    """Add nine servos whose force is clipped, then nine dampers; the joint clips the sum."""
    joints = [link_name(finger, index) for finger in FINGERS for index in (1, 2, 3)]
    for joint in joints:
        _add_actuator(spec, joint, "servo", limit=_TORQUE_LIMIT)
    for joint in joints:
        _add_actuator(spec, joint, "safety")


def _add_actuator(
    spec: mujoco.MjSpec, joint: str, purpose: str, limit: float | None = None
) -> None:
    """Add a source of torque without gains: they are parameters and follow."""
    spec.add_actuator(
        name=f"{joint}/{purpose}",
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        target=joint,
        gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        gainprm=[0.0] * 10,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        forcelimited=limit is not None,
        forcerange=(-(limit or 0.0), limit or 0.0),
    )


def _yaw(angle: float) -> tuple[float, float, float, float]:
    """Give the MuJoCo quaternion (w, x, y, z) of a turn about z."""
    return (math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2))
