"""The TriFinger and its blocks in the words of ``ModelBodies``, as the declared values say.

No backend builds from it: ``queries.laws`` compares what a backend does with what it says.
"""

from __future__ import annotations

import math

import numpy as np

from scm_world._types import Integers
from scm_world.geometry.rotations import quaternion_product
from scm_world.models.bodies import Actuator, Body, Geom, Joint, ModelBodies, Rotation, Vector
from scm_world.models.scene import ControlMode, Parameters
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.state import BLOCK_SIZE, ROBOT_SIZE
from scm_world.tasks.trifinger.structure import (
    WALL_HEIGHT,
    WALL_RADIUS,
    WALL_SEGMENTS,
    WALL_THICKNESS,
    TriFingerStructure,
    controller_spec,
)

_ZERO, _UNTURNED = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)


def described(
    structure: TriFingerStructure, parameters: Parameters, mode: ControlMode, backend: str
) -> tuple[ModelBodies, Integers]:
    """Describe bodies, joints, shapes and servos.

    Args:
        structure: The bodies that there are.
        parameters: All of them.
        mode: What a command means.
        backend: Name of the engine: fingertips have their mass in different places.

    Returns:
        The description, and where each of its coordinates stands in the state vector. Angular
        velocities of blocks are those in their own frame only while they are not turned.
    """
    bodies = [Body("world", 0, _ZERO, _UNTURNED, 0.0, _ZERO, _ZERO, _UNTURNED)]
    joints: list[Joint] = []
    geoms = _surfaces(structure, parameters)
    actuators: list[Actuator] = []
    spec, grip = controller_spec(parameters), float(parameters["robot", "friction"])
    damping = float(parameters["robot", "joint_damping"])
    height = float(parameters["robot", "height"]) - hardware.TABLE_OFFSET
    places: list[int] = []
    for finger, (x, y, z), yaw in zip(
        hardware.FINGERS, hardware.FINGER_OFFSET, hardware.FINGER_YAW, strict=True
    ):
        cos, sin = math.cos(hardware.WORLD_YAW), math.sin(hardware.WORLD_YAW)
        origin = (cos * x - sin * y, sin * x + cos * y, z + height)
        turn = _yaw(hardware.WORLD_YAW + yaw)
        parent = 0
        for index, inertial in enumerate(hardware.INERTIAL):
            name = hardware.link_name(finger, index)
            mass = float(parameters[name, "mass"])
            moments = tuple(mass * moment for moment in inertial.per_mass)
            place, orientation = origin, turn
            if index > 1:
                place, orientation = hardware.JOINT_ORIGINS[index - 1], _UNTURNED
            bodies.append(
                Body(
                    name, parent, place, orientation, mass, _vector(moments),
                    inertial.center, inertial.orientation,
                )
            )  # fmt: skip
            if not index:
                continue  # what hangs on it has the same frame
            parent = len(bodies) - 1
            joint, k = len(joints), index - 1
            joints.append(
                Joint(
                    name, "hinge", parent, 2 * joint, axis=hardware.JOINT_AXES[k],
                    range=(-hardware.ENGINE_LIMITS[k], hardware.ENGINE_LIMITS[k]),
                    damping=damping, effort=(-spec.limit, spec.limit),
                )
            )  # fmt: skip
            places += [joint, hardware.N_JOINTS + joint]
            follows = mode is ControlMode.JOINT_POSITIONS
            kp, kd = (spec.kp[k], spec.kd[k]) if follows else (1.0, 0.0)
            bias = (0.0, -kp, -kd) if follows else _ZERO
            limit = (-spec.limit, spec.limit)
            actuators.append(
                Actuator(name, joint, joint, gain=(kp, 0.0, 0.0), bias=bias, force_range=limit)
            )
            safety = (0.0, 0.0, -spec.safety[k])
            actuators.append(Actuator(name, joint, joint, gain=_ZERO, bias=safety))
            part = ("upper", "middle", "lower")[k]
            geoms.append(_capsule(name, parent, hardware.COLLISION[part], grip))
        tip = Body(
            f"robot_finger_{finger}_tip", parent, hardware.TIP_ORIGIN, _UNTURNED,
            hardware.TIP_MASS, hardware.TIP_INERTIA, hardware.TIP_CENTER[backend], _UNTURNED,
        )  # fmt: skip
        bodies.append(tip)
        geoms.append(_capsule(tip.name, len(bodies) - 1, hardware.COLLISION["tip"], grip))
    for number, name in enumerate(structure.blocks):
        mass, hull = float(parameters[name, "mass"]), structure.hull(name)
        friction, body = float(parameters[name, "friction"]), len(bodies)
        if hull is None:
            a, b, c = (float(edge) for edge in parameters[name, "size"])
            per_mass = [(b * b + c * c) / 12, (a * a + c * c) / 12, (a * a + b * b) / 12]
            box = (a / 2, b / 2, c / 2)
            geoms.append(Geom(name, "box", body, _ZERO, _UNTURNED, box, friction=friction))
        else:
            per_mass = list(hull.moments)
        moments = tuple(mass * moment for moment in per_mass)
        bodies.append(Body(name, 0, _ZERO, _UNTURNED, mass, _vector(moments), _ZERO, _UNTURNED))
        joints.append(Joint(name, "free", body, len(places)))
        start = ROBOT_SIZE + BLOCK_SIZE * number
        places += range(start, start + BLOCK_SIZE)
    moving = [g for g, geom in enumerate(geoms) if geom.name in structure.blocks]
    fixed = [g for g, geom in enumerate(geoms) if not geom.body]
    gravity = _vector(parameters["world", "gravity"])
    description = ModelBodies(
        tuple(bodies), tuple(joints), tuple(geoms), tuple(actuators), (),
        tuple((one, other) for one in fixed for other in moving), gravity, structure.timestep,
        product=True,
    )  # fmt: skip
    return description, np.array(places, dtype=np.int64)


def _surfaces(structure: TriFingerStructure, parameters: Parameters) -> list[Geom]:
    """List floor, wall and obstacles."""
    floor, stage = (float(parameters[name, "friction"]) for name in ("floor", "stage"))
    geoms = [Geom("floor", "plane", 0, _ZERO, _UNTURNED, friction=floor)]
    width = (WALL_RADIUS + WALL_THICKNESS) * math.tan(math.pi / WALL_SEGMENTS)
    half, radius = (WALL_THICKNESS / 2, width, WALL_HEIGHT / 2), WALL_RADIUS + WALL_THICKNESS / 2
    for segment in range(WALL_SEGMENTS):
        angle = 2 * math.pi * segment / WALL_SEGMENTS
        at = (radius * math.cos(angle), radius * math.sin(angle), WALL_HEIGHT / 2)
        geoms.append(Geom("stage", "box", 0, at, _yaw(angle), half, friction=stage))
    for name in structure.obstacles:
        turn = np.array(parameters[name, "orientation"], dtype=np.float64)
        x, y, z, w = (turn / np.linalg.norm(turn)).tolist()
        size, friction = 0.5 * np.array(parameters[name, "size"]), parameters[name, "friction"]
        position = _vector(parameters[name, "position"])
        geoms.append(
            Geom(name, "box", 0, position, (x, y, z, w), _vector(size), friction=float(friction))
        )
    return geoms


def _capsule(name: str, body: int, shape: hardware.Capsule, friction: float) -> Geom:
    """Describe a capsule between two points."""
    start, end = np.array(shape.start), np.array(shape.end)
    x, y, z = (end - start).tolist()
    length = math.hypot(x, y, z)
    tilt = math.atan2(math.hypot(x, y), z)
    sideways = (0.0, math.sin(tilt / 2), 0.0, math.cos(tilt / 2))
    turn = quaternion_product(np.array(_yaw(math.atan2(y, x))), np.array(sideways)).tolist()
    middle = _vector((start + end) / 2)
    size = (shape.radius, length / 2)
    return Geom(name, "capsule", body, middle, tuple(turn), size, friction=friction)


def _yaw(angle: float) -> Rotation:
    return (0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2))


def _vector(values: object) -> Vector:
    x, y, z = np.asarray(values, dtype=np.float64).tolist()
    return (x, y, z)
