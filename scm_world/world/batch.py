"""Many worlds that are stepped together, each with its own parameters, noise and clock."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import whole_number
from scm_world._types import Floats, Integers
from scm_world.errors import EngineFailure, UnknownOption
from scm_world.variables.reserved import CONTROL_INDEX
from scm_world.work.processes import cores
from scm_world.world.compiled_task import CompiledTask
from scm_world.world.simulation import Simulation

KEPT = 4
"""Tables of structures that are kept for when these come again."""


@final
class StateTable:
    """The present of worlds of one structure: a row for each world, columns for variables.

    Args:
        compiled: The task in that structure.
        names: What is computed after every step.
        n: How many worlds there could be.

    Attributes:
        compiled: The task in that structure.
        matrix: Shape (n, width); the first columns are those of the state.
        state_size: How many these are.
        where: The columns of each variable. What is computed and not in ``names`` may be old.
    """

    def __init__(self, compiled: CompiledTask, names: Iterable[str], n: int) -> None:
        self.compiled = compiled
        self.names = tuple(name for name in names if name in compiled.model)
        mechanisms = compiled.mechanisms
        self.matrix = np.repeat(mechanisms.start[None], n, axis=0)  # rows are views of this
        self.state_size, self.where = mechanisms.state_size, mechanisms.where

    def column(self, name: str) -> Floats:
        """Give the values of a variable in all rows, shape (n, k), as a view."""
        return self.matrix[:, self.where[name]]

    def actions(self) -> Floats:
        """Give the actions of all rows, shape (n, n_actions), as a view."""
        return self.matrix[:, self.compiled.mechanisms.actions]

    def clock(self, row: int) -> int:
        """Give the control step of a row."""
        return int(self.matrix[row, self.where[CONTROL_INDEX].start])


@final
class Batch:
    """Worlds of one task, options and backend, advanced in one call.

    A world in a batch is bit-identical to one that is stepped alone. Between steps,
    ``world`` gives a world as it is now, to ask it or to do something to it: use that, not a
    reference of your own, whose present may be older.

    Args:
        worlds: They belong to the batch from now on.
        threads: Of the backend, if it can use several; as many as there are cores if None.
        names: What is computed after every step.

    Raises:
        UnknownOption: The worlds are not alike, or the number of threads is none.

    Example:
        >>> worlds = [Simulation("pushing", backend="fake") for _ in range(3)]
        >>> for seed, world in enumerate(worlds):
        ...     world.reset(seed=seed)
        >>> batch = Batch(worlds, names=["reward"])
        >>> batch.advance(np.zeros((3, 9)))
        >>> batch.table(0).column("reward").shape, batch.world(2).index
        ((3, 1), 1)
    """

    def __init__(
        self, worlds: Sequence[Simulation], *, threads: int | None = None, names: Iterable[str] = ()
    ) -> None:
        self._worlds = tuple(worlds)
        if not self._worlds:
            raise UnknownOption("worlds", [], ("one or more",))
        kinds = {(world.identity, world.engine) for world in self._worlds}
        if len(kinds) > 1:
            raise UnknownOption("worlds", kinds, ("worlds of one task, options and engine",))
        count = cores() if threads is None else whole_number("threads", threads, least=1)
        backends = [world.backend for world in self._worlds]
        self._engine = backends[0].batch(backends, count)
        self._names = tuple(names)
        n = len(self._worlds)
        self._tables: dict[CompiledTask, StateTable] = {}
        self._kinds: list[tuple[Any, ...]] = [()] * n  # table, mode and substeps of each world
        self._groups: list[tuple[Any, Integers]] | None = None  # all worlds, by these
        self._stepped = np.zeros(n, dtype=np.bool_)  # the world does not know yet
        self._ready = np.zeros(n, dtype=np.bool_)  # unchanged since it was stepped
        self._fresh = np.zeros(n, dtype=np.bool_)  # what a step keeps has been computed
        self._all = np.arange(n)
        self._held: set[int] = set()
        self._translating: set[int] = set()
        self._commands = np.zeros((n, self._worlds[0].structure.n_commands))

    def __len__(self) -> int:
        """Count the worlds."""
        return len(self._worlds)

    def world(self, index: int) -> Simulation:
        """Give a world as it is now."""
        world = self._worlds[index]
        if self._stepped[index]:
            world.arrive(self.table(index).clock(index))
            self._stepped[index] = False
        self._ready[index] = False
        return world

    def fill(self, rows: Integers) -> None:
        """Move the present of some worlds to their rows, with what is computed.

        Raises:
            NotReset: A world has no episode yet.
        """
        for row in rows[~self._ready[rows]].tolist():
            self._take(row)

    def table(self, index: int) -> StateTable:
        """Give the table in whose row of this number the present of a world is."""
        kind = self._kinds[index]
        return kind[0] if kind else self._table(self._worlds[index].compiled)

    def tables(self, rows: Integers) -> list[tuple[StateTable, Integers]]:
        """Give the tables of some worlds, each with the rows of those that are in it."""
        found: dict[StateTable, list[Integers]] = {}
        for (table, *_), members in self._grouped(rows):
            found.setdefault(table, []).append(members)
        return [(table, np.sort(np.concatenate(parts))) for table, parts in found.items()]

    def advance(
        self, commands: Floats, which: NDArray[np.bool_] | None = None, *, evaluate: bool = True
    ) -> None:
        """Advance worlds one control step; see ``Simulation.advance``.

        Args:
            commands: For each world finite numbers in their range, shape (n, n_actions).
            which: Who is advanced, shape (n,); all if None.
            evaluate: Whether to compute what the tables have.

        Raises:
            NotReset: A world has no episode yet.
            EngineFailure: The backend lost a state, or a step function failed, whose world is as it
                was. All other worlds are one step further.
        """
        rows = self._all if which is None else np.flatnonzero(which)
        self.fill(rows)
        held = self._held.intersection(rows.tolist()) if self._held else ()
        if held:
            commands = commands.copy()
            for row in held:
                commands[row] = self.world(row).decided(commands[row])
        groups = self._grouped(rows)
        failed: EngineFailure | None = None
        for (table, substeps), members in groups:
            try:
                self._step(table, substeps, members, commands)
            except EngineFailure as error:
                failed = failed or error
        if failed is not None:
            raise failed
        for (table, *_), members in groups if evaluate else ():
            table.compiled.mechanisms.evaluate(table.names, table.matrix, members)
            self._fresh[members] = True

    def _step(self, table: StateTable, substeps: int, rows: Integers, commands: Floats) -> None:
        matrix, mechanisms = table.matrix, table.compiled.mechanisms
        if not self._translating:
            self._commands[rows] = commands[rows]
        for row in rows.tolist() if self._translating else ():
            self._commands[row] = self._worlds[row].command(commands[row], table.clock(row))
        stale = rows[~self._fresh[rows]]
        if len(stale):
            mechanisms.evaluate((), matrix, stale)
        kept, stepped = matrix[rows if self._engine.may_refuse else rows[:0]], self._stepped[rows]
        mechanisms.remember(matrix, rows)
        table.actions()[rows] = commands[rows]
        matrix[rows, table.where[CONTROL_INDEX].start] += 1.0
        self._fresh[rows] = False
        self._stepped[rows] = self._ready[rows] = True
        try:
            self._engine.step(rows, self._commands, substeps, matrix)
        except BaseException as error:  # or Ctrl-C: the others were stepped
            unmoved = error.unmoved if isinstance(error, EngineFailure) else ()
            for place, row in enumerate(rows.tolist()):
                if row in unmoved:
                    matrix[row], self._stepped[row] = kept[place], stepped[place]
                world = self.world(row)
                world.backend.read(world.current()[1])
            raise

    def _grouped(self, rows: Integers) -> list[tuple[Any, Integers]]:
        """Tell worlds of different structures and presets apart."""
        if self._groups is not None and len(self._groups) == 1:
            return [(self._groups[0][0], rows)] if len(rows) else []
        found: dict[tuple[Any, ...], list[int]] = {}
        for row in rows.tolist():
            found.setdefault(self._kinds[row] or (self.table(row), 0), []).append(row)
        return [(kind, np.array(members)) for kind, members in found.items()]

    def _take(self, row: int) -> None:
        """Move the present of a world to its row."""
        world = self._worlds[row]
        table = self._table(world.compiled)
        world.evaluate(table.names)
        if world.numbers.base is not table.matrix:
            world.move(table.matrix[row : row + 1])
        kind = (table, world.substeps)
        if self._kinds[row] != kind:
            self._kinds[row] = kind
            alike = all(other == kind for other in self._kinds)
            self._groups = [(kind, self._all)] if alike else None
        self._ready[row] = self._fresh[row] = True
        both = ((self._held, world.holds_action), (self._translating, world.translates))
        for rows, belongs in both:
            if belongs:
                rows.add(row)
            else:
                rows.discard(row)

    def _table(self, compiled: CompiledTask) -> StateTable:
        found = self._tables.get(compiled)
        if found is None:
            used = {id(kind[0]) for kind in self._kinds if kind}
            unused = [key for key, table in self._tables.items() if id(table) not in used]
            for key in unused[: max(0, len(self._tables) + 1 - KEPT)]:
                del self._tables[key]
            found = StateTable(compiled, self._names, len(self._worlds))
            self._tables[compiled] = found
        return found

    def close(self) -> None:
        """Free the backends of all worlds."""
        for world in self._worlds:
            world.close()
