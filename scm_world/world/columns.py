"""Present values of many worlds of one structure: a row for each world, columns for variables.

What a control step needs is computed for all rows at once, by the very functions that a single
world calls, so that the bits are the same.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, final

import numpy as np

from scm_world._types import Floats, Integers, Value
from scm_world.entities import CONTROL_INDEX
from scm_world.geometry.gather import places
from scm_world.geometry.rows import move_columns
from scm_world.world.equations import Columns, Equation, equation
from scm_world.world.world import World


@final
class Table:
    """The values that some variables need, of all worlds of one structure.

    Args:
        world: Any of this structure.
        names: What is wanted of the present.
        n: How many worlds there could be.

    Attributes:
        declaration: Of the structure.
        matrix: Shape (n, w); the first columns are those of the state.
        state_size: How many these are.
        where: The columns of each variable.
        names: What can be asked for.
        computed: What is computed in every step, causes before effects.
    """

    def __init__(self, world: World, names: Iterable[str], n: int) -> None:
        self.declaration = world.declaration
        self.lagged = world.lagged
        self._given = tuple(names)
        self.names = tuple(dict.fromkeys((*self._given, *self.lagged)))
        self.computed = world.needed(self.names)
        self._width = self.state_size = self.declaration.empty_state().vector.size
        self.where: dict[str, slice] = dict(self.declaration.slices)
        self.earlier: dict[str, slice] = {}
        self._place_all()
        more = Columns(self._width)
        self._equations = self._bound(more)
        self.matrix = np.zeros((n, self._width + len(more.values)))
        self.matrix[:, self._width :] = more.values
        self._still = tuple(
            (name, self.where[name])
            for name in self.declaration.static_names
            if name in self.where and name not in self.computed
        )
        self._remembered = self._memory()
        needed = set(world.needed(()))  # for what is remembered
        both = zip(self.computed, self._equations, strict=True)
        self._for_memory = tuple(bound for name, bound in both if name in needed)
        self._fresh = np.zeros(n, dtype=np.bool_)  # what is remembered has been computed

    def _place_all(self) -> None:
        """Give columns to everything that is needed and is no state."""
        model = self.declaration.model
        parents = [p for name in self.computed for p in model.declared(name).all_parents]
        present = [p.name for p in parents if p.lag == 0]
        self._action = self._columns(None)
        for name, part in self.declaration.commanded.items():
            first = self._action.start
            self.where[name] = slice(first + part.start, first + part.stop)
        for name in (CONTROL_INDEX, *self.names, *self.computed, *present):
            if name not in self.where:
                self.where[name] = self._columns(name)
        for name in self.lagged:
            self.earlier[name] = self._columns(name)

    def _columns(self, name: str | None) -> slice:
        """Take the next columns, for a variable or for all actions."""
        if name is None:
            size = self.declaration.n_actions
        else:
            size = int(np.prod(self.declaration.model.declared(name).shape))
        first, self._width = self._width, self._width + size
        return slice(first, self._width)

    def _bound(self, more: Columns) -> tuple[Equation, ...]:
        """Bind the mechanisms of what is computed."""
        model, said = self.declaration.model, dict[str, dict[int, Any]]()
        return tuple(
            equation(model, name, self.where, self.earlier, more, said) for name in self.computed
        )

    def _memory(self) -> tuple[Integers, Integers]:
        """List the columns that a step remembers, and where it does."""
        present = places(self.where[name] for name in self.lagged)
        return present, places(self.earlier[name] for name in self.lagged)

    # --- to and from single worlds ------------------------------------------------------------

    def load(self, row: int, world: World) -> None:
        """Take over the present of a world of this structure."""
        numbers = self.matrix[row]
        now, (_, state) = world.evaluate(self._given), world.current()  # and what is remembered
        numbers[: state.vector.size] = state.vector
        for name, place in self._still:
            numbers[place] = np.ravel(now[name])
        numbers[self.where[CONTROL_INDEX]] = world.index
        parts = [np.ravel(now[name]) for name in self.declaration.actions]
        self.act(row, np.concatenate([np.empty(0), *parts]))
        for name in self.lagged:
            numbers[self.where[name]] = np.ravel(now[name])
        for bound in self._equations:
            bound.begin(row, now)
        self._fresh[row] = True

    def actions(self) -> Floats:
        """Give the actions of all rows, shape (n, n_actions), as a view."""
        return self.matrix[:, self._action]

    def act(self, row: int, action: Value) -> None:
        """Write the action of a row."""
        self.matrix[row, self._action] = action

    def hand_over(self, row: int, world: World) -> None:
        """Give a world the present of its row."""
        numbers = self.matrix[row]
        earlier = {
            name: numbers[place].reshape(self.declaration.model.declared(name).shape)
            for name, place in self.earlier.items()
        }
        vector = numbers[: self.state_size]
        world.arrive(vector, self.clock(row), numbers[self._action].copy(), earlier)

    # --- a control step -----------------------------------------------------------------------

    def remember(self, rows: Integers) -> None:
        """Let the present of some rows become what was one control step ago."""
        stale = rows[~self._fresh[rows]]
        if len(stale):
            _compute(self._for_memory, self.matrix, stale)
        move_columns(self.matrix, rows, *self._remembered)

    def advance(self, rows: Integers, actions: Floats) -> None:
        """Write the actions of some rows, shape (n, n_actions), and let their clocks go on."""
        self.matrix[rows, self._action] = actions[rows]
        self.matrix[rows, self.where[CONTROL_INDEX].start] += 1.0
        self._fresh[rows] = False

    def clock(self, row: int) -> int:
        """Give the control step of a row."""
        return int(self.matrix[row, self.where[CONTROL_INDEX].start])

    def evaluate(self, rows: Integers) -> None:
        """Compute everything for some rows, after a step."""
        _compute(self._equations, self.matrix, rows)
        self._fresh[rows] = True

    def column(self, name: str) -> Floats:
        """Give the values of a variable in all rows, shape (n, k), as a view."""
        return self.matrix[:, self.where[name]]


def _compute(equations: Iterable[Equation], matrix: Floats, rows: Integers) -> None:
    for bound in equations:
        bound.compute(matrix, rows)
