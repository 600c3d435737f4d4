"""Worlds to test with, and what happens in them."""

from __future__ import annotations

import hashlib
import importlib.util
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest

from scm_world.tasks.trifinger import hardware
from scm_world.variables import Categories, Draw, Integers, Scale, Shift
from scm_world.world import Simulation

TASKS = ("reaching", "pushing")
BACKENDS = ("fake", "mujoco", "bullet")
NEEDS_BULLET = pytest.mark.skipif(
    importlib.util.find_spec("pybullet") is None, reason="needs pybullet"
)
PARAMS = [
    pytest.param(b, t, id=f"{b}-{t}", marks=NEEDS_BULLET if b == "bullet" else ())
    for b in BACKENDS
    for t in TASKS
]
PUSHING = [
    pytest.param(b, "pushing", id=b, marks=NEEDS_BULLET if b == "bullet" else ()) for b in BACKENDS
]
PHYSICS = [p for p in PUSHING if p.id != "fake"]

REST = np.array(hardware.REST)

_WORLDS: dict[tuple[str, str], Simulation] = {}


def shared(backend: str, task: str) -> Simulation:
    """Give the one world of this kind; resetting it leaves no trace, as a test shows."""
    key = (backend, task)
    if key not in _WORLDS:
        _WORLDS[key] = Simulation(task, backend=backend)
    return _WORLDS[key]


def actions(n: int, seed: int = 0, spread: float = 0.4) -> np.ndarray:
    """Draw joint positions around the rest pose, shape (n, 9)."""
    return REST + np.random.default_rng(seed).uniform(-spread, spread, (n, 9))


def begin(backend: str, task: str, steps: int = 3) -> Simulation:
    """Give a world in the middle of an episode."""
    world = shared(backend, task)
    world.reset(seed=0)
    play(world, actions(steps, seed=7))
    return world


def play(world: Simulation, commands: Iterable[Any]) -> np.ndarray:
    """Take actions.

    Returns:
        State and reward after each of them, shape (n, 28 + 13 blocks).
    """
    rows = []
    for command in commands:
        world.step(command)
        now = world.evaluate(("reward", "fractional_success"))
        state = world.vector
        rows.append([*state, float(now["reward"]), float(now["fractional_success"])])
    return np.array(rows)


def same(first: dict[str, Any], second: dict[str, Any]) -> bool:
    """Compare all values of two worlds bit for bit."""
    return first.keys() == second.keys() and all(
        np.asarray(first[name]).tobytes() == np.asarray(second[name]).tobytes() for name in first
    )


def differing(first: dict[str, Any], second: dict[str, Any]) -> set[str]:
    """Name the values that differ."""
    return {name for name in first if not np.array_equal(first[name], second[name])}


_MOVES = {
    "size": 0.004,
    "cartesian_position": np.array([0.003, 0.004, 0.02]),
    "cylindrical_position": np.array([0.003, 0.004, 0.02]),
    "linear_velocity": 0.3,
    "angular_velocity": 0.3,
    "joint_velocities": 0.3,
    "joint_positions": np.tile([0.0, -0.02, 0.01], 3),
    "gravity": np.array([0.5, -0.3, 1.0]),
    "robot_height": 0.01,
    "control_index": 4,
}
_PLACES = {
    "orientation": np.array([0.0, 0.0, np.sin(0.1), np.cos(0.1)]),
    "euler_orientation": np.array([0.0, 0.0, 0.2]),
    **dict.fromkeys(("color", "floor_color", "stage_color"), np.array([0.2, 0.7, 0.4])),
}


def other(world: Simulation, name: str) -> np.ndarray:
    """Give another value of a variable, not far from the present one."""
    quantity = name.rpartition(".")[2]
    if quantity in _PLACES:
        return _PLACES[quantity]
    if quantity in _MOVES:
        return world[name] + np.resize(_MOVES[quantity], world[name].shape)
    variable, present = world.model.declared(name), world[name]
    if isinstance(variable.bounds, Categories):
        return np.array(next(m for m in variable.bounds.members if m != present))
    if isinstance(variable.bounds, Integers):
        return present + 1
    if not present.any():
        low, high = variable.bounds.bounds(variable.shape, {})
        return low + 0.02 * (high - low)
    return 0.8 * present


def settable(world: Simulation) -> list[str]:
    """Name everything that do accepts, but for the action."""
    model = world.model
    quantities = ((name, model.declared(model.target(name))) for name in model)
    return [name for name, one in quantities if one.settable and one.role != "action"]


def story(backend: str, task: str) -> str:
    """Play an episode with all kinds of interventions, and hash everything in it."""
    world = Simulation(task, backend=backend)
    digest = hashlib.sha256()

    def note() -> None:
        for name, value in sorted(world.values().items()):
            digest.update(name.encode())
            digest.update(np.asarray(value).tobytes())

    world.reset(seed=5, do={"floor_friction": Draw("A"), "robot_height": 0.345})
    note()
    for episode in range(2):
        for step, command in enumerate(actions(12, seed=episode)):
            world.step(command)
            if step == 4:
                world.do({"robot_finger_60_link_2.mass": Scale(0.7), "stage_friction": Draw("B")})
            if step == 6:
                world.do({"joint_velocities": Shift(0.1), "gravity": Draw("A|B")})
            if step == 8 and task == "pushing":
                world.do({"block.size": Shift(0.004), "goal_block": {"polar": Draw("A")}})
            note()
        world.reset()
    world.close()
    return digest.hexdigest()
