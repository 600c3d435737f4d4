"""Many worlds that are stepped together, each with its own parameters, noise and clock."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import whole_number
from scm_world._types import Floats, Integers
from scm_world.errors import EngineFailure, UnknownOption
from scm_world.work.processes import cores
from scm_world.world.compiled_task import CompiledTask
from scm_world.world.mechanisms import Rows
from scm_world.world.simulation import Simulation


@final
class Batch:
    """Worlds of one task, options and backend, advanced in one call.

    The present of each world is a row of the values of all worlds of its structure. A world in a
    batch is bit-identical to one that is stepped alone, and can be used alone at any time.

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
        >>> batch.table(0)["reward"].shape, batch.world(2).index
        ((3,), 1)
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
        self._names, n = tuple(names), len(self._worlds)
        self._tables: dict[CompiledTask, Rows] = {}
        self._versions = [-1] * n  # of each world when its row was filled
        self._kinds: list[Any] = [None] * n  # structure of each world, and physics steps
        self._acts_alone: set[int] = set()
        self._all = np.arange(n)

    def __len__(self) -> int:
        """Count the worlds."""
        return len(self._worlds)

    def world(self, index: int) -> Simulation:
        """Give a world."""
        return self._worlds[index]

    def table(self, index: int) -> Rows:
        """Give the rows of all worlds of the structure that a world has."""
        self.fill(self._all[index : index + 1])
        return self._tables[self._kinds[index][0]]

    def tables(self, rows: Integers) -> list[tuple[Rows, Integers]]:
        """Give the rows of some worlds by structure, and which worlds of it are among them."""
        self.fill(rows)
        found: dict[CompiledTask, list[Integers]] = {}
        for (compiled, _), members in self._grouped(rows):
            found.setdefault(compiled, []).append(members)
        parts = found.items()
        return [(self._tables[one], np.sort(np.concatenate(members))) for one, members in parts]

    def advance(
        self, commands: Floats, which: NDArray[np.bool_] | None = None, *, evaluate: bool = True
    ) -> None:
        """Advance worlds one control step; see ``Simulation.advance``.

        Args:
            commands: For each world finite numbers in their range, shape (n, n_actions).
            which: Who is advanced, shape (n,); all if None.
            evaluate: Whether to compute what is computed after every step.

        Raises:
            NotReset: A world has no episode yet.
            EngineFailure: The backend lost a state, or a step function failed, whose world is as it
                was. All other worlds are one step further.
        """
        rows = self._all if which is None else np.flatnonzero(which)
        self.fill(rows)
        sent = commands
        if self._acts_alone:
            commands = commands.copy()
            sent = np.zeros((len(self), self._worlds[0].structure.n_commands))
            for row in rows.tolist():
                world = self._worlds[row]
                commands[row] = world.decided(commands[row])
                sent[row] = world.command(commands[row])
        failed: EngineFailure | None = None
        groups = self._grouped(rows)
        for (compiled, substeps), members in groups:
            try:
                self._step(self._tables[compiled], substeps, members, commands, sent)
            except EngineFailure as error:
                failed = failed or error
        if failed is not None:
            raise failed
        for (compiled, _), members in groups if evaluate else ():
            self._tables[compiled].evaluate(self._names, members)

    def _step(
        self, table: Rows, substeps: int, rows: Integers, commands: Floats, sent: Floats
    ) -> None:
        matrix, clock = table.numbers, table.mechanisms.clock
        kept = matrix[rows if self._engine.may_refuse else rows[:0]]
        table.remember(rows)
        table.actions[rows] = commands[rows]
        matrix[rows, clock] += 1.0
        try:
            self._engine.step(rows, sent, substeps, matrix)
        except BaseException as error:  # or Ctrl-C: the others were stepped
            unmoved = error.unmoved if isinstance(error, EngineFailure) else ()
            for place, row in enumerate(rows.tolist()):
                if row in unmoved:
                    matrix[row] = kept[place]
                self._worlds[row].backend.read(self._worlds[row].state)
            raise

    def _grouped(self, rows: Integers) -> list[tuple[Any, Integers]]:
        """Tell worlds of different structures and presets apart."""
        first = self._kinds[0]
        if self._kinds.count(first) == len(self):
            return [(first, rows)] if len(rows) else []
        found: dict[Any, list[int]] = {}
        for row in rows.tolist():
            found.setdefault(self._kinds[row], []).append(row)
        return [(kind, np.array(members)) for kind, members in found.items()]

    def fill(self, rows: Integers) -> None:
        """Give worlds that have changed their rows, with what is computed after every step.

        Raises:
            NotReset: A world has no episode yet.
        """
        for row in rows.tolist():
            world = self._worlds[row]
            if world.version == self._versions[row]:
                continue
            world.evaluate(self._names)
            self._kinds[row] = world.compiled, world.substeps
            table = self._table(world.compiled)
            if world.row.numbers.base is not table.numbers:
                world.move(table.row(row))
            (self._acts_alone.add if world.acts_alone else self._acts_alone.discard)(row)
            self._versions[row] = world.version

    def _table(self, compiled: CompiledTask) -> Rows:
        if compiled not in self._tables:
            used = {kind[0] for kind in self._kinds if kind}
            start = np.repeat(compiled.mechanisms.start[None], len(self), axis=0)
            kept = {one: table for one, table in self._tables.items() if one in used}
            self._tables = {**kept, compiled: Rows(compiled.mechanisms, start)}
        return self._tables[compiled]

    def close(self) -> None:
        """Free the backends of all worlds."""
        for world in self._worlds:
            world.close()
