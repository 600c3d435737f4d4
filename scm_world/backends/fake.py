"""A backend without physics: things stay where they are put. For fast tests."""

from __future__ import annotations

from typing import ClassVar, final

import numpy as np

from scm_world._types import Floats
from scm_world.backends.base import Capabilities
from scm_world.backends.memory import InMemory
from scm_world.errors import EngineFailure
from scm_world.models.scene import ControlMode
from scm_world.models.state import State
from scm_world.scene import trifinger
from scm_world.scene.scene import Structure
from scm_world.scene.state import PhysicalState


@final
class FakeBackend(InMemory):
    """No forces and no contacts.

    In ``joint_positions`` mode the joints of the robot jump to the command; in ``joint_torques``
    mode they stay. Blocks keep their velocity and their orientation. In any other structure
    nothing moves.
    """

    name: ClassVar[str] = "fake"
    capabilities: ClassVar[Capabilities] = Capabilities(physics=False)

    def inertia(self, body: str) -> Floats:
        """Compute the principal moments of inertia of a block or link, shape (3,) [kg m²].

        Raises:
            UnknownOption: There is no such body, or the structure is not that of the robot.
        """
        self._check([(body, "mass")])
        mass = self._parameters[body, "mass"]
        if not isinstance(self._structure, Structure):
            self._check([(body, "inertia")])
            return self._parameters[body, "inertia"].copy()
        if body in trifinger.LINK_NAMES:
            index = trifinger.LINK_NAMES.index(body) % trifinger.LINKS_PER_FINGER
            return np.asarray(mass * np.array(trifinger.INERTIAL[index].per_mass))
        hull = self._structure.hull(body)
        if hull is not None:
            return np.asarray(mass * np.array(hull.moments))
        squares = self._parameters[body, "size"] ** 2
        return np.asarray(mass / 12.0 * (squares.sum() - squares))

    def step(self, mode: ControlMode, command: Floats, substeps: int) -> None:
        """Let blocks drift and joints jump.

        Raises:
            EngineFailure: A number is not finite afterwards.
        """
        state = self._state
        if not isinstance(state, PhysicalState):
            return
        if mode is ControlMode.JOINT_POSITIONS:
            state.joint_positions[:] = command
            state.joint_torques[:] = 0.0
        else:
            state.joint_torques[:] = command
        state.positions[:] += substeps * self._structure.timestep * state.linear_velocities
        if not np.isfinite(state.vector).all():
            raise EngineFailure("a number is not finite", self.name)

    def _place(self, state: State) -> None:
        super()._place(state)
        if isinstance(self._state, PhysicalState):
            self._state.orientations[self._state.orientations[:, 3] < 0.0] *= -1.0
