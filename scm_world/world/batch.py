"""Many worlds that are stepped together, each with its own parameters, noise and clock."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats, Integers
from scm_world.errors import UnknownOption
from scm_world.work.threads import cores
from scm_world.world.columns import Table
from scm_world.world.declaration import Declaration
from scm_world.world.start import whole_number
from scm_world.world.world import World

KEPT = 4
"""Tables of structures that are kept for when these come again."""


@final
class Batch:
    """Worlds of one task, options and engine, advanced in one call.

    What happens in a world is, bit for bit, what happens if it is stepped alone. Between steps,
    ``world`` gives a world as it is now, to ask it or to do something to it: use that, not a
    reference of your own, whose present may be older.

    Args:
        worlds: They belong to the batch from now on.
        threads: Of the engine, if it can use several; as many as there are cores if None.
        names: What ``table`` is to have besides the states.

    Raises:
        UnknownOption: The worlds are not alike, or the number of threads is none.

    Example:
        >>> worlds = [World("pushing", backend="fake") for _ in range(3)]
        >>> for seed, world in enumerate(worlds):
        ...     world.reset(seed=seed)
        >>> batch = Batch(worlds, names=["reward"])
        >>> batch.advance(np.zeros((3, 9)))
        >>> batch.table(0).column("reward").shape, batch.world(2).index
        ((3, 1), 1)
    """

    def __init__(
        self, worlds: Sequence[World], *, threads: int | None = None, names: Iterable[str] = ()
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
        self._tables: dict[Declaration, Table] = {}
        self._homes: list[Table | None] = [None] * len(self._worlds)
        self._shared: Table | None = None  # in which all worlds are, if they are in one
        self._tempo: list[Any] = [None] * len(self._worlds)
        self._in_time: Any = None  # the pace of all worlds, if they have one
        self._away = np.zeros(len(self._worlds), dtype=np.bool_)  # it went on in its row only
        self._loaded = np.zeros(len(self._worlds), dtype=np.bool_)  # its row is as it is
        self._all = np.arange(len(self._worlds))
        self._held: set[int] = set()
        self._translating: set[int] = set()
        commands = self._worlds[0].structure.n_commands
        self._told = np.zeros((len(self._worlds), commands))

    def __len__(self) -> int:
        """Count the worlds."""
        return len(self._worlds)

    def world(self, index: int) -> World:
        """Give a world as it is now."""
        world = self._worlds[index]
        if self._away[index]:
            table = self._homes[index]
            if table is not None:
                table.hand_over(index, world)
            self._away[index] = False
        self._loaded[index] = False
        return world

    def fill(self, rows: Integers) -> None:
        """Write the present of some worlds into their rows, where it is not there already."""
        for row in rows[~self._loaded[rows]].tolist():
            self._load(row)

    def table(self, index: int) -> Table:
        """Give the table in whose row of this number the present of a world is.

        The row is as it was after the last step of that world.
        """
        return self._homes[index] or self._table(self._worlds[index])

    def tables(self, rows: Integers) -> list[tuple[Table, Integers]]:
        """Give the tables of some worlds, each with the rows of those that are in it."""
        if self._shared is not None and len(rows):
            return [(self._shared, rows)]
        found: dict[int, tuple[Table, list[int]]] = {}
        for row in rows.tolist():
            table = self.table(row)
            found.setdefault(id(table), (table, []))[1].append(row)
        return [(table, np.array(members)) for table, members in found.values()]

    def advance(
        self, commands: Floats, which: NDArray[np.bool_] | None = None, *, evaluate: bool = True
    ) -> None:
        """Advance worlds one control step; see ``World.advance``.

        Args:
            commands: For each world finite numbers in their range, shape (n, n_actions).
            which: Who is advanced, shape (n,); all if None.
            evaluate: Whether to compute what the tables have.

        Raises:
            NotReset: A world has no episode yet.
            EngineFailure: The engine lost a state.
        """
        rows = self._all if which is None else np.flatnonzero(which)
        self.fill(rows)
        held = self._held.intersection(rows.tolist()) if self._held else ()
        if held:
            commands = commands.copy()
            for row in held:
                commands[row] = self.world(row).decided(commands[row])
        tables = self.tables(rows)
        for table, members in tables:
            self._step(table, members, commands)
        for table, members in tables if evaluate else ():
            table.evaluate(members)

    def _step(self, table: Table, rows: Integers, commands: Floats) -> None:
        self._tell(table, rows, commands)
        table.remember(rows)
        table.advance(rows, commands)
        self._away[rows] = self._loaded[rows] = True
        try:
            for (mode, substeps), members in self._paces(rows):
                self._engine.step(members, mode, self._told, substeps, table.matrix)
        except BaseException:  # a state is lost, or somebody interrupts: the others were stepped
            for row in rows.tolist():
                world = self.world(row)
                world.backend.read(world.current()[1])
            raise

    def _tell(self, table: Table, rows: Integers, commands: Floats) -> None:
        """Write what the engine is told; mostly these are the actions."""
        told = self._told
        if not self._translating:
            told[rows] = commands[rows]
            return
        for row in rows.tolist():
            vector = table.matrix[row, : table.state_size]
            told[row] = self._worlds[row].translated(commands[row], vector, table.clock(row))

    def _paces(self, rows: Integers) -> list[tuple[Any, Integers]]:
        """Tell worlds with different presets apart."""
        if self._in_time is not None:
            return [(self._in_time, rows)]
        found: dict[Any, list[int]] = {}
        for row in rows.tolist():
            found.setdefault(self._tempo[row], []).append(row)
        return [(pace, np.array(members)) for pace, members in found.items()]

    def _load(self, row: int) -> None:
        """Take a world as it is now into its row."""
        world = self._worlds[row]
        table = self._table(world)
        if self._homes[row] is not table:
            self._homes[row] = table
            alike = all(home is table for home in self._homes)
            self._shared = table if alike else None
        table.load(row, world)
        if self._tempo[row] != world.pace:
            self._tempo[row] = world.pace
            self._in_time = world.pace if len(set(self._tempo)) == 1 else None
        self._loaded[row] = True
        both = ((self._held, world.holds_action), (self._translating, world.translates))
        for rows, belongs in both:
            if belongs:
                rows.add(row)
            else:
                rows.discard(row)

    def _table(self, world: World) -> Table:
        declaration = world.declaration
        found = self._tables.get(declaration)
        if found is None:
            used = {id(table) for table in self._homes}
            unused = [key for key, table in self._tables.items() if id(table) not in used]
            for key in unused[: max(0, len(self._tables) + 1 - KEPT)]:
                del self._tables[key]
            there = [name for name in self._names if name in declaration.model]
            found = self._tables[declaration] = Table(world, there, len(self._worlds))
        return found

    def close(self) -> None:
        """Free the engines of all worlds."""
        for world in self._worlds:
            world.close()
