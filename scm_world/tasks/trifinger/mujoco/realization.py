"""The TriFinger as MuJoCo realizes it: its states, its servos, and the friction of its pairs."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, final

import numpy as np
from mujoco.batch import Batch

from scm_world._types import Floats
from scm_world.backends.mujoco.realization import Realization, Rows
from scm_world.models.scene import ControlMode, ParameterKey
from scm_world.tasks.trifinger.hardware import N_JOINTS
from scm_world.tasks.trifinger.mujoco.model import compiled, shape_owners
from scm_world.tasks.trifinger.mujoco.parameters import couple, slots
from scm_world.tasks.trifinger.mujoco.servos import steer
from scm_world.tasks.trifinger.mujoco.state import (
    Instant,
    nothing,
    read_state,
    read_states,
    settle,
    write_state,
)
from scm_world.tasks.trifinger.structure import Structure

_COUPLED = {"friction", "spinning_friction"}
_STEERED = {"position_gains", "velocity_gains"}


@final
class TriFinger(Realization):
    """A ``Structure`` of the TriFinger.

    What the last physics step left is kept in an ``Instant`` as soon as the state is written.
    """

    modes = (ControlMode.JOINT_POSITIONS, ControlMode.JOINT_TORQUES)

    def __init__(self, structure: Structure) -> None:
        model = compiled(structure)
        owners = shape_owners(structure)
        super().__init__(
            structure,
            model,
            lambda model, _: slots(model, structure),
            tuple(model.body(i).name for i in range(model.nbody)),
            tuple(owners[model.geom(i).name] for i in range(model.ngeom)),
        )
        model = self.model
        self._torques = self.data.qfrc_actuator[:N_JOINTS]
        self._gains = model.actuator_gainprm, model.actuator_biasprm
        self._pairs = (
            model.geom_friction,
            model.pair_geom1,
            model.pair_geom2,
            model.pair_friction,
        )
        self._begin()

    def _begin(self) -> None:
        self._instant: Instant | None = nothing()
        self._source = self._instant.source(self.structure.blocks)
        self._written: Floats | None = None  # since the last step

    def read(self, into: Floats) -> None:
        """Write the state into a vector, shape (27 + 13 n,)."""
        read_state(self._positions, self._velocities, self._torques, into)
        if self._written is not None:
            settle(self._written, into)

    def place(self, vector: Floats) -> None:
        """Write a state; what equals the last instant gets the numbers it had there."""
        self._remember()
        last = self._instant or nothing()
        write_state(
            vector,
            self._positions,
            self._velocities,
            self._source,
            last.vector,
            last.positions,
            last.velocities,
        )
        self._written = vector.copy()

    def _remember(self) -> None:
        """Keep what the last physics step left, before the first change of the state."""
        if self._instant is not None:
            return
        vector = np.empty(self.structure.layout.size)
        self.read(vector)
        self._instant = Instant(
            self.structure.blocks, vector, self._positions.copy(), self._velocities.copy()
        )
        self._source = np.arange(len(self.structure.blocks))

    def forget(self) -> None:
        """Forget what was before a step that is made now."""
        self._instant = self._written = None

    def rows(self, batch: Batch) -> Rows:
        """Give what reads states of such models out of a batch."""
        arrays = batch.bind("qpos"), batch.bind("qvel"), batch.bind("qfrc_actuator")
        return lambda which, into: int(read_states(*arrays, which, into))

    def reset(self) -> None:
        """Forget every step."""
        super().reset()
        self._begin()

    def memory(self) -> Any:
        """Give torques, instant and the state that was written since."""
        return self._torques.copy(), self._instant, self._written

    def recall(self, numbers: Floats, memory: Any) -> None:
        """Go on from what was remembered."""
        super().recall(numbers, memory)
        self._torques[:], self._instant, self._written = memory
        if self._instant is not None:
            self._source = self._instant.source(self.structure.blocks)

    def follow(self, before: Realization) -> None:
        """Keep torques and blocks of the last step."""
        super().follow(before)
        if isinstance(before, TriFinger):
            before._remember()
            self._torques[:], self._instant = before._torques, before._instant
            self._source = (self._instant or nothing()).source(self.structure.blocks)

    def switch(self, mode: ControlMode) -> None:
        """Make the nine servos follow positions, or pass torques on."""
        super().switch(mode)
        steer(*self._gains, mode)
        self.edited = True

    def followed(self, keys: Iterable[ParameterKey]) -> str:
        """Update pairs and servos, and then what MuJoCo derives."""
        keys = tuple(keys)
        changed = {attribute for _, attribute in keys}
        if not _COUPLED.isdisjoint(changed):
            couple(*self._pairs)
        if not _STEERED.isdisjoint(changed):
            steer(*self._gains, self.mode)
        return super().followed(keys)
