"""Any ``Model`` as MuJoCo realizes it."""

from __future__ import annotations

from typing import final

import numpy as np
from mujoco.batch import Batch

from scm_world._types import Floats
from scm_world.backends.mujoco import fields, reading
from scm_world.backends.mujoco.realization import Realization, Rows
from scm_world.backends.mujoco.state import read_rows, read_vector, write_vector
from scm_world.models.model import Model
from scm_world.models.scene import ControlMode


@final
class Articulated(Realization):
    """A ``Model``. Its state vector is a permutation of MuJoCo's numbers."""

    modes = (ControlMode.CONTROLS,)
    lean = True

    def __init__(self, structure: Model) -> None:
        compiled = reading.compiled(structure)
        keys = [row.key for row in structure.parameters]
        super().__init__(
            structure,
            compiled,
            lambda model, data: fields.slots(compiled, keys, model, data),
            reading.body_names(compiled),
            reading.contact_bodies(compiled),
        )
        self._places = np.concatenate(reading.permutation(compiled)).astype(np.int64)

    def read(self, into: Floats) -> None:
        """Write the state into a vector, shape (nq + nv + na,)."""
        read_vector(self._positions, self._velocities, self._activations, self._places, into)

    def place(self, vector: Floats) -> None:
        """Write a state; all else stays as it is."""
        write_vector(self._positions, self._velocities, self._activations, self._places, vector)

    def rows(self, batch: Batch) -> Rows:
        """Give what reads states of such models out of a batch."""
        states, places = batch.state, self._places
        return lambda which, into: int(read_rows(states, places, which, into))
