"""The present values of a world, as views of one row of numbers."""

from __future__ import annotations

from typing import final

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.variables.reserved import CONTROL_INDEX
from scm_world.world.compiled_task import CompiledTask

_ROW = np.zeros(1, dtype=np.int64)  # the only one of a matrix of one row


@final
class PresentValues:
    """The values of all variables at one control step, and what is kept of the last one.

    Args:
        compiled: The task in the structure that there is.

    Attributes:
        compiled: The same.
        matrix: Shape (1, width); see ``Mechanisms``.
        state: Where everything is.
        action: The last action, shape (n_actions,).
        now: By variable. Computed ones may be old; see ``compute``.
        before: Of one control step ago.
        static: What physics does not move, as it was taken over.
    """

    def __init__(self, compiled: CompiledTask) -> None:
        self.compiled = compiled
        self.static: Values = {}
        self._fresh = False  # what a step keeps has been computed
        self._view(compiled.mechanisms.start[None].copy())

    def move(self, matrix: Floats) -> None:
        """Keep the values in another matrix from now on, shape (1, width)."""
        matrix[...] = self.matrix
        self._view(matrix)

    def _view(self, matrix: Floats) -> None:
        self.matrix = matrix
        row, mechanisms = matrix[0], self.compiled.mechanisms
        self.state = self.compiled.empty_state(row[: mechanisms.state_size])
        self.action, self._clock = row[mechanisms.actions], row[mechanisms.where[CONTROL_INDEX]]
        self.now: dict[str, Value] = {n: mechanisms.view(row, n) for n in mechanisms.where}
        counted = {n: (self.now[n].astype(np.int64), self.now[n]) for n in mechanisms.whole}
        self._counted = tuple(counted.values())
        self.now |= {name: whole for name, (whole, _) in counted.items()} | dict(self.static)
        self.before = {n: mechanisms.view(row, n, earlier=True) for n in mechanisms.earlier}

    def take(self, static: Values) -> None:
        """Take over values of everything that physics does not move."""
        if static is self.static:
            return
        row, where = self.matrix[0], self.compiled.mechanisms.where
        for name, value in static.items():
            if value is not self.static.get(name):
                if isinstance(value, np.ndarray):
                    value.flags.writeable = False  # snapshots share it
                row[where[name]] = np.ravel(value)
        self.static = static
        self.now.update(static)

    def be_at(self, index: int) -> None:
        """Be at a control step; where everything is has been written already."""
        self._clock[...] = index
        self._fresh = False
        self._count()

    def compute(self, names: tuple[str, ...] | None = None) -> None:
        """Compute variables, and what a step keeps, into the present values; all if None."""
        mechanisms = self.compiled.mechanisms
        wanted = mechanisms.computed if names is None else names
        mechanisms.evaluate(wanted, self.matrix, _ROW)
        self._fresh = True
        self._count()

    def remember(self) -> None:
        """Keep the present as the values of one control step ago."""
        if not self._fresh:
            self.compute(())
        self.compiled.mechanisms.remember(self.matrix, _ROW)

    def _count(self) -> None:
        """Take over what is a whole number; the other values are views of the row."""
        for value, view in self._counted:
            value[...] = view
