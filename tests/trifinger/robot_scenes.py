"""Scenes of the robot, commands and comparisons."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from itertools import product
from typing import Any

import mujoco
import numpy as np

from scm_world._types import ArrayLike, Floats
from scm_world.backends import Backend
from scm_world.backends.mujoco.realization import Realization
from scm_world.geometry.hulls import Hull, hull_of
from scm_world.geometry.rotations import from_rotation_vector, quaternion_product
from scm_world.models.scene import Difference, ParameterKey, Scene
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.hardware import FAST, PRECISE, Preset
from scm_world.tasks.trifinger.system import PhysicalState, tip_name, trifinger

SUBSTEPS = 10
SEED = 20_26


def box_hull(size: ArrayLike) -> Hull:
    """Make a box of these edge lengths [m] as a hull."""
    return hull_of(np.asarray(size) * (np.indices((2, 2, 2)).reshape(3, 8).T - 0.5))


def octahedron(a: float, b: float, c: float) -> Hull:
    """Make a hull whose six corners lie on its axes, at these distances from the center [m].

    Example:
        >>> round(octahedron(1.0, 1.0, 1.0).volume, 3)
        1.333
    """
    corners, planes, faces = (a, b, c), [], []
    for signs in product((1.0, -1.0), repeat=3):
        normal = [sign / corner for sign, corner in zip(signs, corners, strict=True)]
        length = math.hypot(*normal)
        planes.append((normal[0] / length, normal[1] / length, normal[2] / length, 1.0 / length))
        i, j, k = (axis + (0 if sign > 0.0 else 3) for axis, sign in enumerate(signs))
        faces.append((i, j, k) if math.prod(signs) > 0.0 else (i, k, j))
    vertices = ((a, 0.0, 0.0), (0.0, b, 0.0), (0.0, 0.0, c))
    opposite = tuple((-x, -y, -z) for x, y, z in vertices)
    moments = ((b * b + c * c) / 10.0, (a * a + c * c) / 10.0, (a * a + b * b) / 10.0)
    volume = 4.0 / 3.0 * a * b * c
    return Hull((*vertices, *opposite), tuple(faces), tuple(planes), volume, moments)


STONE = octahedron(0.03, 0.035, 0.025)


def link_frames(joint_positions: ArrayLike) -> tuple[Floats, Floats]:
    """Ask MuJoCo for the frames of links 0 to 3 and of the tip, finger by finger.

    Returns:
        Origins, shape (15, 3) [m], and quaternions (x, y, z, w), shape (15, 4).
    """
    scene = trifinger().default_scene()
    model = Realization(scene.structure, scene.parameters).model
    data = mujoco.MjData(model)
    data.qpos[:9] = joint_positions
    mujoco.mj_kinematics(model, data)
    names = [
        name
        for finger in hardware.FINGERS
        for name in (*(hardware.link_name(finger, i) for i in range(4)), tip_name(finger))
    ]
    bodies = [model.body(name).id for name in names]
    return data.xpos[bodies], np.roll(data.xquat[bodies], -1, axis=1)


def busy_scene(preset: Preset = FAST) -> Scene:
    """Make a scene in which everything touches something sooner or later.

    One block stands before a finger, one falls askew on it, one slides into the ring, and a stone
    falls on a ledge.
    """
    blocks = ("near", "falling", "sliding", "stone")
    structure = trifinger(blocks, preset, obstacles=("ledge",), hulls=(("stone", STONE),))
    scene = structure.default_scene()
    state = scene.state
    state.positions[:3] = [[-0.06, 0.11, 0.0325], [-0.05, 0.1, 0.12], [-0.02, -0.13, 0.0325]]
    state.positions[3] = [0.1, 0.1, 0.06]
    state.orientations[1] = np.array([0.1, -0.2, 0.3, 0.9]) / np.sqrt(0.95)
    state.linear_velocities[2] = [1.8, -0.2, 0.0]
    state.angular_velocities[1] = [0.5, -1.0, 2.0]
    state.angular_velocities[3] = [1.0, 0.5, 4.0]
    state.joint_velocities[:] = np.linspace(-0.5, 0.5, 9)
    ledge = {"size": [0.06, 0.05, 0.02], "position": [0.11, 0.1, 0.012]}
    return scene.with_(parameters={**scene.parameters, **named("ledge", ledge)})


def named(body: str, values: Mapping[str, ArrayLike]) -> dict[ParameterKey, Floats]:
    """Write down parameters of one body."""
    return {(body, name): np.asarray(value, dtype=np.float64) for name, value in values.items()}


def apart_scene(preset: Preset = FAST) -> Scene:
    """Make a scene of a block that rocks alone on a ledge, and of one that a finger pushes."""
    scene = trifinger(("apart", "near"), preset, obstacles=("ledge",)).default_scene()
    state = scene.state
    state.positions[:] = [[0.1, 0.12, 0.05], [-0.06, 0.11, 0.0325]]
    state.angular_velocities[0] = [1.0, -2.0, 0.5]
    ledge = {"size": [0.04, 0.04, 0.01], "position": [0.1, 0.08, 0.005]}
    return scene.with_(parameters={**scene.parameters, **named("ledge", ledge)})


def play(
    backend: Backend,
    steps: int,
    *,
    seed: int = SEED,
    torques: bool = False,
) -> Floats:
    """Give random commands near the rest pose, or random torques.

    Returns:
        The state after each control step, shape (steps, 27 + 13 n).
    """
    generator = np.random.default_rng(seed)
    structure: Any = backend.structure
    if structure.torques is not torques:
        backend.apply(Difference(structure.with_(torques=torques)))
    center = np.zeros(9) if torques else np.array(hardware.REST)
    state = backend.read()
    states = np.empty((steps, state.vector.size))
    for row in states:
        command = center + generator.uniform(-0.3, 0.3, 9)
        backend.step(command, SUBSTEPS)
        backend.read(state.with_vector(row))
    return states


def other_value(key: ParameterKey, value: Floats) -> Floats:
    """Return another possible value of a parameter."""
    match key[1]:
        case "gravity":
            return np.asarray(value + np.array([0.5, -0.3, 2.8]))
        case "height":
            return np.asarray(value + 0.02)
        case "color":
            return np.asarray(0.5 * value + 0.1)
        case "restitution":
            return np.asarray(value + 0.4)
        case "joint_damping":
            return np.asarray(value + 0.05)
        case "position":
            return np.asarray(value + np.array([0.004, -0.006, 0.003]))
        case "orientation":
            return quaternion_product(from_rotation_vector([0.05, -0.03, 0.1]), value)
        case "size":
            return np.asarray(value * np.array([0.8, 0.9, 0.7]))
        case "position_gains" | "velocity_gains" | "safety_damping" | "torque_limit":
            return np.asarray(value * 1.2)  # with less of them, fingers reach farther
        case _:
            return np.asarray(value * 0.7)


def another(preset: Preset) -> Preset:
    """Return the other numerical settings."""
    return PRECISE if preset is FAST else FAST


def changed_states(state: PhysicalState) -> Iterator[tuple[str, PhysicalState]]:
    """Change one field of a state after the other."""
    generator = np.random.default_rng(3)
    for field in (
        "joint_positions",
        "joint_velocities",
        "positions",
        "orientations",
        "linear_velocities",
        "angular_velocities",
    ):
        changed = state.copy()
        values = getattr(changed, field)
        values += generator.normal(size=values.shape, scale=0.2)
        norms = np.linalg.norm(changed.orientations, axis=1, keepdims=True)
        changed.orientations[:] /= norms
        yield field, changed
