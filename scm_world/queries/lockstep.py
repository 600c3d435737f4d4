"""Rollouts whose actions are known beforehand, advanced together.

What a world does by itself (to begin, to be intervened on, to look for an event) it does alone, by
the very lines of a single rollout; the steps in between are those of all worlds at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np

from scm_world._types import Floats, Integers, Value
from scm_world.queries.courses import Course
from scm_world.queries.traces import ALL, Trace, intervene, note_parameters, write
from scm_world.queries.units import Unit
from scm_world.tasks.policies import Blind
from scm_world.world import World
from scm_world.world.batch import Batch, Table
from scm_world.world.commands import clipped


def is_known(unit: Unit) -> bool:
    """Tell whether all actions of a unit are known beforehand, so that it can be in a batch."""
    return isinstance(unit.acts(), Blind) and ALL not in unit.names


def advanced(batch: Batch, units: Sequence[Unit]) -> list[Trace | Exception]:
    """Let units happen together.

    Args:
        batch: Of as many worlds or more, whose tables have the names of the units.
        units: All with the same first control step, as many steps, and the same names.

    Returns:
        What each leaves behind, or what stopped it.

    Raises:
        EngineFailure: The engine lost one of the states; that stops all of them.
    """
    lives = [_Life(batch.world(row), unit) for row, unit in enumerate(units)]
    first, steps = units[0].first, units[0].steps
    together = _Together(batch, lives)
    for row in range(len(lives)):
        together.alone(row, first)
    for step in range(first, steps):
        together.advance(step)
        for row in together.concerned(step + 1) if step + 1 < steps else ():
            together.alone(row, step + 1)
        together.write()
    return [together.ended(row) for row in range(len(lives))]


@final
@dataclass
class _Layout:
    """Where in a table everything is that has to be written down.

    Attributes:
        columns: Of the table, those of the state first.
        size: How many are those of the state.
        names: For each variable its place among these columns, and its shape.
    """

    columns: Integers
    size: int
    names: dict[str, tuple[slice, tuple[int, ...]]]

    @classmethod
    def of(cls, table: Table, names: Sequence[str]) -> _Layout:
        """Look it up."""
        declaration = table.declaration
        size = width = table.state_size
        parts, places = [np.arange(size)], {}
        for name in names:
            if name in declaration.model:
                where = table.where[name]
                parts.append(np.arange(where.start, where.stop))
                shape = declaration.model.declared(name).shape
                places[name] = slice(width, width + len(parts[-1])), shape
                width += len(parts[-1])
        return cls(np.concatenate(parts), size, places)


@final
@dataclass
class _Life:
    """A unit while it happens.

    Attributes:
        world: Its own.
        unit: What is to happen.
        error: What stopped it.
        rows: What is not in the trace yet: numbers in the order of the layout.
    """

    world: World
    unit: Unit
    error: Exception | None = None
    rows: list[Floats] = field(default_factory=list)
    layout: _Layout | None = None
    version: int = -1

    def __post_init__(self) -> None:
        self.course, self.policy = Course(()), self.unit.acts(self.world)
        self.trace = self.unit.goes_on()
        self.ahead: Floats = np.empty((0, self.world.declaration.n_actions))
        self._shift = 0

    def arrive(self) -> None:
        """Be at the first instant."""
        self.course = Course(self.unit.layers)
        self.unit.arrive(self.world)

    def note(self, step: int) -> None:
        """Write an instant down, and know what to do from then on."""
        if self.world.version != self.version:
            self.version = self.world.version
            note_parameters(self.world, self.trace, step)
        write(self.world, self.trace, self.unit.names)
        shift = self.world.index - step
        if step == self.unit.first or shift != self._shift:
            self._shift = shift
            self._look_ahead(step)

    def _look_ahead(self, step: int) -> None:
        """Ask for all actions that are left."""
        world, left = self.world, self.unit.steps - step
        policy: Any = self.policy
        given = policy.ahead(world, world.index, left)
        bounds, unit = world.declaration.action_bounds, world.declaration.action_unit
        commands = np.empty((self.unit.steps, world.declaration.n_actions))
        for row, action in zip(commands[step:], given, strict=True):
            row[:] = clipped(action, *bounds, unit)
        self.ahead = commands
        self.trace.actions[step:] = np.array(given)

    def flush(self) -> None:
        """Take over into the trace what is not there yet."""
        if not self.rows or self.layout is None:
            return
        numbers, self.rows = np.array(self.rows), []
        self.trace.vectors.extend(numbers[:, : self.layout.size].copy())
        for name, (place, shape) in self.layout.names.items():
            values = self.trace.values[name]
            like = values[-1].dtype  # the last one was written down by the world itself
            values.extend(_typed(numbers[:, place].reshape(-1, *shape), like))


@final
class _Together:
    """Lives in the rows of a batch."""

    def __init__(self, batch: Batch, lives: Sequence[_Life]) -> None:
        self._batch, self._lives = batch, lives
        self._names = lives[0].unit.names
        self._layouts: dict[int, tuple[Table, _Layout]] = {}
        self._goes_on = np.zeros(len(batch), dtype=np.bool_)
        self._goes_on[: len(lives)] = True
        self._pending = self._goes_on.copy()
        self._commands = np.zeros((len(batch), lives[0].world.declaration.n_actions))

    def alone(self, row: int, step: int) -> None:
        """Let a world do something by itself at an instant, and write the instant down."""
        life = self._lives[row]
        life.flush()
        self._pending[row] = False
        self._batch.world(row)
        try:
            if step == life.unit.first:
                life.arrive()
            intervene(life.world, life.course, step, life.trace)
            life.note(step)
        except Exception as error:  # it ends this life, and no other one
            life.error = error
            self._goes_on[row] = False

    def concerned(self, step: int) -> list[int]:
        """List the worlds in which something may be due."""
        return [
            row
            for row in np.flatnonzero(self._goes_on).tolist()
            for life in (self._lives[row],)
            if life.course.concerns(life.world, step, life.trace.fired)
        ]

    def advance(self, step: int) -> None:
        """Let all worlds take a control step."""
        rows = np.flatnonzero(self._goes_on)
        for row in rows.tolist():
            self._commands[row] = self._lives[row].ahead[step]
        if len(rows):
            self._batch.advance(self._commands, self._goes_on)
        self._pending[:] = self._goes_on

    def write(self) -> None:
        """Keep the present of those worlds that have not written it down themselves."""
        rows = np.flatnonzero(self._pending)
        for table, members in self._batch.tables(rows) if len(rows) else ():
            layout = self._layout(table)
            numbers = table.matrix[members[:, None], layout.columns]
            for row, mine in zip(members.tolist(), numbers, strict=True):
                life = self._lives[row]
                life.layout = layout
                life.rows.append(mine)

    def _layout(self, table: Table) -> _Layout:
        found = self._layouts.get(id(table))
        if found is None:
            found = self._layouts[id(table)] = table, _Layout.of(table, self._names)
        return found[1]

    def ended(self, row: int) -> Trace | Exception:
        """Give what a life leaves behind."""
        life = self._lives[row]
        life.flush()
        return life.trace if life.error is None else life.error


def _typed(values: Floats, kind: Any) -> Value:
    """Give numbers the type that they have in a single world, where that loses nothing."""
    cast = values.astype(kind)
    return cast if np.array_equal(cast, values, equal_nan=True) else values
