"""Many environments whose engine steps all of them in one call."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any, final
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.env.batched.commands import ActionScaler
from scm_world.env.batched.executor import located
from scm_world.env.batched.loop import LoopExecutor
from scm_world.env.batched.reader import EnvLayout, ObservationReader
from scm_world.env.copies import EnvSnapshot
from scm_world.env.environment import REWARD, ScmWorldEnv
from scm_world.errors import EngineFailure, ScmWorldError
from scm_world.tasks.rewards import one_number
from scm_world.variables.reserved import SENSOR_NOISE
from scm_world.variables.subsets import AnyRegion
from scm_world.world import Audit
from scm_world.world.batch import Batch, Table
from scm_world.world.mechanisms import FunctionFailure


@final
class NativeExecutor:
    """Environments that are stepped by threads of the engine, and read in compiled loops.

    Pictures, the corners of blocks, contacts and the noise of sensors are read in one environment
    after another. See ``EnvExecutor``.

    Args:
        make: Makes one of them.
        num_envs: How many.
        threads: Of the engine; as many as there are cores if None. Results do not depend on it.

    Attributes:
        num_envs: How many there are.
        form: What they have in common.
        buffers: What they said last.
    """

    def __init__(
        self, make: Callable[[], ScmWorldEnv], num_envs: int, *, threads: int | None = None
    ) -> None:
        self._members = LoopExecutor(make, num_envs)
        self.num_envs = num_envs
        self.form, self.buffers = self._members.form, self._members.buffers
        self._envs = self._members.envs
        lead = self._envs[0]
        self._commands = ActionScaler(lead, num_envs)
        names = (*EnvLayout.of(lead).needed, *self._commands.names)
        self._batch = Batch([env.world for env in self._envs], threads=threads, names=names)
        self._readers: WeakKeyDictionary[Table, ObservationReader] = WeakKeyDictionary()
        self._sensed: set[int] = set()
        self._alone: set[int] = set()  # they were used by themselves since they were stepped

    def step(self, which: NDArray[Any], actions: NDArray[Any]) -> None:
        """Advance some of them one control step."""
        rows = np.flatnonzero(which)
        if not len(rows):
            return
        self._look()
        commands = self._commands.read(rows, actions, self._batch)
        try:
            self._batch.advance(commands, which)
        except (FunctionFailure, EngineFailure) as error:  # the others are a step further
            self._commands.passed(rows)
            self._bring(rows.tolist())
            for row in rows.tolist():
                with suppress(ScmWorldError):
                    self.buffers.write(row, *self._envs[row].present())
            if isinstance(error, FunctionFailure):
                raise located(error, error.row) from error.__cause__
            raise
        self._commands.passed(rows)
        for table, members in self._batch.tables(rows):
            reader = self._reader(table, int(members[0]))
            wrong = reader.write(table, members, self.buffers)
            if wrong is not None:
                self._explain(wrong)
            again: Iterable[int] = members.tolist() if reader.is_partial else self._sensed
            for row in again:
                if which[row]:
                    self._bring([row])
                    self.buffers.write(row, *self._envs[row].present())

    def reset(
        self,
        which: NDArray[Any],
        seeds: Sequence[int | None],
        options: Sequence[Mapping[str, Any] | None],
    ) -> None:
        """Begin an episode in some of them."""
        self._bring(np.flatnonzero(which).tolist())
        self._members.reset(which, seeds, options)

    def do(
        self, requests: Mapping[int, Mapping[str, Any]], space: AnyRegion | None = None
    ) -> dict[int, Audit]:
        """Intervene in some of them."""
        self._bring(requests)
        return self._members.do(requests, space)

    def snapshot(self, indices: Sequence[int]) -> list[EnvSnapshot]:
        """Save some of them."""
        self._bring(indices)
        return self._members.snapshot(indices)

    def restore(self, snapshots: Mapping[int, EnvSnapshot]) -> None:
        """Take some of them to a snapshot."""
        self._bring(snapshots)
        self._members.restore(snapshots)

    def undo(self) -> None:
        """Take back what the last reset, intervention or restoration did."""
        self._bring(range(self.num_envs))
        self._members.undo()

    def call(self, indices: Sequence[int], name: str, *args: Any, **kwargs: Any) -> list[Any]:
        """Call a method of some of them; what cannot be called is given as it is."""
        self._bring(indices)
        return self._members.call(indices, name, *args, **kwargs)

    def attribute(self, indices: Sequence[int], name: str) -> list[Any]:
        """Look an attribute of some of them up."""
        self._bring(indices)
        return self._members.attribute(indices, name)

    def assign(self, name: str, values: Mapping[int, Any]) -> None:
        """Set an attribute of some of them."""
        self._bring(values)
        self._members.assign(name, values)

    @contextmanager
    def alone(self, index: int) -> Iterator[ScmWorldEnv]:
        """Let one of them be used by itself; what it shows afterwards is in its row.

        Unlike ``do`` and ``reset``, this takes nothing back if something is refused.

        Raises:
            InterventionError: It is not observed like the others any more.
        """
        env = self._envs[index]
        seen = env.observation_space
        self._bring([index])
        yield env
        shown = env.present()
        if env.observation_space is not seen:
            self.form.check(env, "what was done")
        self.buffers.write(index, *shown)

    def state(self, index: int) -> Floats:
        """Give where everything is in one that was just stepped, as ``PhysicalState.vector``.

        It holds until the next step.
        """
        size = self._envs[index].world.current()[1].vector.size
        found: Floats = self._batch.table(index).matrix[index, :size]
        return found

    def close(self) -> None:
        """Free their engines."""
        self._bring(range(self.num_envs))  # no row counts any more
        self._members.close()

    def _bring(self, indices: Iterable[int]) -> None:
        """Let environments be as they are now, so that each can be used by itself."""
        for index in indices:
            self._batch.world(index)
            self._alone.add(index)

    def _look(self) -> None:
        """Note what was changed in environments that were used by themselves."""
        for index in self._alone:
            env = self._envs[index]
            if not env.world.has_begun:
                continue
            self._commands.look(index, env)
            if env.world.current()[0].get(SENSOR_NOISE):
                self._sensed.add(index)
            else:
                self._sensed.discard(index)
        self._alone.clear()

    def _reader(self, table: Table, row: int) -> ObservationReader:
        found = self._readers.get(table)
        if found is None:
            found = self._readers[table] = ObservationReader(self._envs[row], table)
        return found

    def _explain(self, row: int) -> None:
        """Raise the error that the environment would raise alone.

        Raises:
            ModelError: Its reward is no finite number.
        """
        self._bring([row])
        terms = EnvLayout.of(self._envs[row]).terms
        try:
            one_number(self._envs[row].world.evaluate((REWARD, *terms)), REWARD, terms)
        except ScmWorldError as error:
            raise located(error, row) from error.__cause__
