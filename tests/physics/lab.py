"""A laboratory in which blocks and the robot are put, pushed and watched on one engine."""

import importlib.util
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from scm_world.backends import Backend
from scm_world.backends.base import BackendWrapper
from scm_world.models import Difference
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.hardware import PRECISE, Preset
from scm_world.tasks.trifinger.system import PhysicalState, trifinger

ENGINES = [
    name
    for name in ("mujoco", "bullet")
    if importlib.util.find_spec(name.replace("bullet", "pybullet"))
]


class Lab:
    """An engine, with the robot far above the table unless told otherwise."""

    def __init__(self, backend: Backend, preset: Preset) -> None:
        self.backend, self.preset = backend, preset
        while isinstance(backend, BackendWrapper):
            backend = backend.engine
        self.engine = backend.name

    def place(
        self,
        positions: ArrayLike,
        parameters: Mapping[tuple[str, str], ArrayLike],
        *,
        velocities: ArrayLike = 0.0,
        joints: ArrayLike = hardware.REST,
        height: float = 1.5,
        torques: bool = False,
    ) -> None:
        """Build a scene with blocks ``tool_block``, ``block_1``, … at positions (n, 3) [m]."""
        positions = np.atleast_2d(positions)
        names = ("tool_block", *(f"block_{i}" for i in range(1, len(positions))))
        scene = trifinger(names, preset=self.preset, torques=torques).default_scene()
        changed = {key: np.asarray(value, dtype=float) for key, value in parameters.items()}
        changed["robot", "height"] = np.asarray(height)
        scene.state.positions[:] = positions
        scene.state.linear_velocities[:] = velocities
        scene.state.joint_positions[:] = joints
        self.rest = np.array(joints, dtype=float)
        self.backend.build(scene.with_(parameters={**scene.parameters, **changed}))

    def wait(self, seconds: float) -> PhysicalState:
        """Hold the robot still for a while."""
        steps = round(seconds / self.preset.timestep)
        self.backend.step(self.rest, steps)
        return self.backend.read()

    def push(self, velocity: ArrayLike) -> None:
        """Give every block a velocity [m/s]."""
        state = self.backend.read()
        state.linear_velocities[:] = velocity
        state.angular_velocities[:] = 0.0
        self.backend.apply(Difference(state=state))

    def set(self, body: str, name: str, value: ArrayLike) -> None:
        """Set one parameter."""
        changed = {(body, name): np.asarray(value, dtype=float)}
        self.backend.apply(Difference(parameters=changed))

    @property
    def precise(self) -> bool:
        """Whether the narrower bounds hold."""
        return self.preset is PRECISE
