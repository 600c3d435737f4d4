"""Scenes, commands and comparisons for the conformance suites."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

import numpy as np

from scm_world._types import Floats
from scm_world.backends.base import Backend
from scm_world.scene import trifinger
from scm_world.scene.controller import ControlMode
from scm_world.scene.presets import FAST, Preset
from scm_world.scene.scene import (
    ParameterKey,
    Parameters,
    Scene,
    Structure,
    default_scene,
)
from scm_world.scene.state import PhysicalState

SUBSTEPS = 10
LONG = 250  # control steps

SEED = 20_26


def busy_scene(preset: Preset = FAST) -> Scene:
    """Make a scene in which everything touches something sooner or later.

    One block stands before a finger, one falls askew on it, one slides into the ring.
    """
    scene = default_scene(Structure(("near", "falling", "sliding"), preset=preset))
    state = scene.state
    state.positions[:] = [[-0.06, 0.11, 0.0325], [-0.05, 0.1, 0.12], [-0.02, -0.13, 0.0325]]
    state.orientations[1] = np.array([0.1, -0.2, 0.3, 0.9]) / np.sqrt(0.95)
    state.linear_velocities[2] = [1.8, -0.2, 0.0]
    state.angular_velocities[1] = [0.5, -1.0, 2.0]
    state.joint_velocities[:] = np.linspace(-0.5, 0.5, 9)
    return scene


def apart_scene(preset: Preset = FAST) -> Scene:
    """Make a scene of a block that rocks alone, and of one that a finger pushes."""
    scene = default_scene(Structure(("apart", "near"), preset=preset))
    state = scene.state
    state.positions[:] = [[0.03, -0.05, 0.05], [-0.06, 0.11, 0.0325]]
    state.angular_velocities[0] = [1.0, -2.0, 0.5]
    return scene


def play(
    backend: Backend,
    steps: int,
    *,
    seed: int = SEED,
    mode: ControlMode = ControlMode.JOINT_POSITIONS,
) -> Floats:
    """Give random commands near the rest pose.

    Returns:
        The state after each control step, shape (steps, 27 + 13 n).
    """
    generator = np.random.default_rng(seed)
    center = np.array(trifinger.REST) if mode is ControlMode.JOINT_POSITIONS else np.zeros(9)
    states = np.empty((steps, backend.state().vector.size))
    for row in states:
        command = center + generator.uniform(-0.3, 0.3, 9)
        backend.step(mode, command, SUBSTEPS)
        backend.read(PhysicalState(backend.n_blocks, row))
    return states


def digest(backend: Backend, preset: Preset) -> str:
    """Hash what the busy scene does for a while."""
    backend.build(busy_scene(preset))
    return hashlib.sha256(play(backend, 30).tobytes()).hexdigest()


def other_value(key: ParameterKey, value: Floats) -> Floats:
    """Give another possible value of a parameter."""
    match key[1]:
        case "gravity":
            return np.array([0.5, -0.3, -7.0])
        case "height":
            return np.asarray(value + 0.02)
        case "color":
            return np.array([0.2, 0.7, 0.4])
        case "size":
            return np.asarray(value * np.array([0.8, 0.9, 0.7]))
        case _:
            return np.asarray(value * 0.7)


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


def same(first: Floats, second: Floats) -> bool:
    """Compare two arrays bit for bit, but for the sign of zero."""
    return bool(np.array_equal(first, second))


def check_parameters(actual: Parameters, expected: Parameters) -> None:
    """Compare parameters as engines keep them: colors with 32 bits or less."""
    assert set(actual) == set(expected)
    for key, value in expected.items():
        tolerance = 1e-6 if key[1] == "color" else 1e-12
        np.testing.assert_allclose(
            actual[key], value, rtol=0, atol=tolerance, err_msg=".".join(key)
        )
        assert actual[key].shape == value.shape
