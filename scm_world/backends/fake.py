"""A backend without physics: things stay where they are put. For fast tests."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar, final

import numpy as np

from scm_world._types import Floats
from scm_world.backends.base import Backend, Capabilities, Contact, EngineSnapshot
from scm_world.errors import EngineFailure, SnapshotMismatch, UnknownOption
from scm_world.models.scene import (
    ControlMode,
    Difference,
    ParameterKey,
    Parameters,
    Scene,
    complete,
)
from scm_world.scene import trifinger
from scm_world.scene.scene import Structure
from scm_world.scene.state import PhysicalState


@final
@dataclass(frozen=True)
class Payload:
    """What a snapshot of the fake holds: the scene."""

    structure: Structure
    parameters: Parameters
    vector: Floats


@final
class FakeBackend(Backend):
    """No forces and no contacts.

    In ``joint_positions`` mode the joints jump to the command; in ``joint_torques`` mode they
    stay. Blocks keep their velocity and their orientation.
    """

    name: ClassVar[str] = "fake"
    capabilities: ClassVar[Capabilities] = Capabilities(physics=False)

    @property
    def version(self) -> str:
        """Version of the fake."""
        return "1"

    @property
    def n_blocks(self) -> int:
        """How many movable blocks the scene has."""
        return self._state.n_blocks

    def build(self, scene: Scene) -> None:
        """Remember the scene."""
        self._structure = scene.structure
        self._parameters: dict[ParameterKey, Floats] = {}
        self._keep(scene.parameters)
        self._place(scene.state)
        self._state.joint_torques[:] = 0.0

    def apply(self, difference: Difference) -> None:
        """Change structure, parameters and state without advancing time.

        Raises:
            UnknownOption: There is no such parameter. Nothing has changed.
        """
        torques, structure = self._state.joint_torques.copy(), difference.structure
        if structure is not None:
            now = Scene(self._structure, self._parameters, self._state)
            difference = complete(now, structure, difference)
            self._structure, self._parameters = structure, {}
        else:
            self._check(difference.parameters)
        self._keep(difference.parameters)
        if difference.state is not None:
            self._place(difference.state)
            self._state.joint_torques[:] = torques

    def parameters(self, keys: Iterable[ParameterKey]) -> Parameters:
        """Give the parameters that were set.

        Raises:
            UnknownOption: There is no such parameter.
        """
        keys = tuple(keys)
        self._check(keys)
        return {key: self._parameters[key].copy() for key in keys}

    def inertia(self, body: str) -> Floats:
        """Compute the principal moments of inertia of a block or link, shape (3,) [kg m²]."""
        mass = self._parameters[body, "mass"]
        if body in trifinger.LINK_NAMES:
            index = trifinger.LINK_NAMES.index(body) % trifinger.LINKS_PER_FINGER
            return np.asarray(mass * np.array(trifinger.INERTIAL[index].per_mass))
        hull = self._structure.hull(body)
        if hull is not None:
            return np.asarray(mass * np.array(hull.moments))
        squares = self._parameters[body, "size"] ** 2
        return np.asarray(mass / 12.0 * (squares.sum() - squares))

    def read(self, into: PhysicalState) -> None:
        """Write the present state into an existing vector."""
        into.vector[:] = self._state.vector

    def step(self, mode: ControlMode, command: Floats, substeps: int) -> None:
        """Let blocks drift and joints jump.

        Raises:
            EngineFailure: A number is not finite afterwards.
        """
        state = self._state
        duration = substeps * self._structure.preset.timestep
        if mode is ControlMode.JOINT_POSITIONS:
            state.joint_positions[:] = command
            state.joint_torques[:] = 0.0
        else:
            state.joint_torques[:] = command
        state.positions[:] += duration * state.linear_velocities
        if not np.isfinite(state.vector).all():
            raise EngineFailure("a number is not finite", self.name)

    def contacts(self) -> tuple[Contact, ...]:
        """Nothing ever touches anything."""
        return ()

    def snapshot(self) -> EngineSnapshot:
        """Save everything."""
        payload = Payload(self._structure, dict(self._parameters), self._state.vector.copy())
        return EngineSnapshot(f"{self.name} {self.version}", payload)

    def restore(self, snapshot: EngineSnapshot) -> None:
        """Go back to a snapshot.

        Raises:
            SnapshotMismatch: It was taken by another engine.
        """
        here = f"{self.name} {self.version}"
        if snapshot.engine != here:
            raise SnapshotMismatch(f"a snapshot of {snapshot.engine} cannot be restored by {here}")
        payload: Payload = snapshot.payload
        self._structure, self._parameters = payload.structure, dict(payload.parameters)
        self._state = PhysicalState(len(payload.structure.blocks), payload.vector.copy())

    def _keep(self, parameters: Parameters) -> None:
        for key, value in parameters.items():
            self._parameters[key] = np.array(value, dtype=np.float64)

    def _place(self, state: PhysicalState) -> None:
        self._state = state.copy()
        flip = self._state.orientations[:, 3] < 0.0
        self._state.orientations[flip] *= -1.0

    def _check(self, keys: Iterable[ParameterKey]) -> None:
        for key in keys:
            if key not in self._parameters:
                raise UnknownOption("parameter", ".".join(key), map(".".join, self._parameters))
