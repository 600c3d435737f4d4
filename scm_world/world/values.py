"""The present values of a world, as views of one row of numbers."""

from __future__ import annotations

from collections.abc import Iterable
from typing import final

import numpy as np

from scm_world._types import Floats, Value
from scm_world.variables.reserved import CONTROL_INDEX
from scm_world.world.compiled_task import CompiledTask
from scm_world.world.mechanisms import Row

_ROW = np.zeros(1, dtype=np.int64)  # the only one of a matrix of one row


@final
class PresentValues:
    """The values of all variables at one control step, and what is kept of the last one.

    Args:
        compiled: The task in the structure that there is.

    Attributes:
        compiled: The same.
        matrix: Shape (1, width); see ``Mechanisms``.
        row: The values by name. Computed ones may be old; see ``compute``.
        state: Where everything is.
        action: The last action, shape (n_actions,).
        now: The values by variable: views of what moves, and arrays of what only interventions
            decide, which stay the same objects until a value changes.
        before: Of one control step ago.
    """

    def __init__(self, compiled: CompiledTask) -> None:
        self.compiled = compiled
        self._fresh = False  # what a step keeps has been computed
        self._view(compiled.mechanisms.start[None].copy())
        self._decide(compiled.static_names)

    def move(self, matrix: Floats) -> None:
        """Keep the values in another matrix from now on, shape (1, width)."""
        matrix[...] = self.matrix
        decided = {name: self.now[name] for name in self.compiled.static_names}
        self._view(matrix)
        self.now |= decided

    def _view(self, matrix: Floats) -> None:
        self.matrix = matrix
        row, mechanisms, static = matrix[0], self.compiled.mechanisms, self.compiled.static
        self.row = Row(mechanisms, row)
        self.state = self.compiled.state_of(self.row)
        self.action, self._clock = row[mechanisms.actions], row[mechanisms.where[CONTROL_INDEX]]
        self.now: dict[str, Value] = {n: mechanisms.view(row, n) for n in mechanisms.where}
        counted = {
            n: (self.now[n].astype(np.int64), self.now[n])
            for n in mechanisms.where
            if n in mechanisms.whole and n not in static
        }
        self._counted = tuple(counted.values())
        self.now |= {name: whole for name, (whole, _) in counted.items()}
        self.before = {n: mechanisms.view(row, n, earlier=True) for n in mechanisms.earlier}

    def put(self, row: Row, changed: Iterable[str]) -> None:
        """Take over a row; ``changed``: what ``Row.differing`` lists."""
        self.matrix[0] = row.numbers
        self._decide(changed)
        self.be_at(int(self._clock[0]))

    def _decide(self, names: Iterable[str]) -> None:
        for name in names:
            self.now[name] = value = np.array(self.row[name])
            value.flags.writeable = False

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
