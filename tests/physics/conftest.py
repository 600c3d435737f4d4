"""A laboratory in which each experiment runs on every engine and every preset."""

import importlib.util
from collections.abc import Iterator, Mapping

import numpy as np
import pytest
from numpy.typing import ArrayLike

from scm_world.backends import Backend, make_backend
from scm_world.models import ControlMode, Difference
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.hardware import FAST, PRECISE, Preset
from scm_world.tasks.trifinger.state import PhysicalState
from scm_world.tasks.trifinger.structure import TriFingerStructure, default_scene

ENGINES = [
    name
    for name in ("mujoco", "bullet")
    if importlib.util.find_spec(name.replace("bullet", "pybullet"))
]


class Lab:
    """An engine, with the robot far above the table unless told otherwise."""

    def __init__(self, backend: Backend, preset: Preset) -> None:
        self.backend = backend
        self.preset = preset

    def place(
        self,
        positions: ArrayLike,
        parameters: Mapping[tuple[str, str], ArrayLike],
        *,
        velocities: ArrayLike = 0.0,
        joints: ArrayLike = hardware.REST,
        height: float = 1.5,
    ) -> None:
        """Build a scene with blocks ``block_0``, ``block_1``, … at positions (n, 3) [m]."""
        positions = np.atleast_2d(positions)
        names = tuple(f"block_{i}" for i in range(len(positions)))
        scene = default_scene(TriFingerStructure(names, preset=self.preset))
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
        self.backend.step(ControlMode.JOINT_POSITIONS, self.rest, steps)
        return self.backend.state()

    def push(self, velocity: ArrayLike) -> None:
        """Give every block a velocity [m/s]."""
        state = self.backend.state()
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


@pytest.fixture(
    params=[(name, preset) for name in ENGINES for preset in (FAST, PRECISE)],
    ids=lambda p: f"{p[0]}-{p[1].name}",
)
def lab(request: pytest.FixtureRequest) -> Iterator[Lab]:
    """Provide every engine with every preset."""
    name, preset = request.param
    backend = make_backend(name)
    yield Lab(backend, preset)
    backend.close()
