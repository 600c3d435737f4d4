"""Many environments whose backend steps all of them in one call."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, final
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats, Integers
from scm_world.env.batched.buffers import FLAGS, GOALS, TERMS, Buffers
from scm_world.env.batched.loop import LoopExecutor, check_actions, located
from scm_world.env.delta import JOINTS
from scm_world.env.environment import REWARD, ScmWorldEnv
from scm_world.env.observer import DictObserver
from scm_world.env.vector import KEYPOINTS, Vector
from scm_world.errors import EngineFailure, FunctionFailure, ScmWorldError
from scm_world.tasks.rewards import FRACTION, SUCCESS, TERMINATED, one_number
from scm_world.variables.reserved import CONTROL_INDEX, SENSOR_NOISE
from scm_world.world.batch import Batch, StateTable
from scm_world.world.mechanisms import places


@final
class NativeExecutor(LoopExecutor):
    """Environments that are stepped by threads of the backend, and read in compiled loops.

    Pictures, the corners of blocks and the noise of sensors are read in one environment
    after another.

    Args:
        make: Makes one of them. What it makes may have methods ``stepped`` and ``act``, as members
            of a curriculum have: they are used after each control step.
        num_envs: How many.
        threads: Of the backend; as many as there are cores if None. Results do not depend on it.
    """

    def __init__(
        self, make: Callable[[], ScmWorldEnv], num_envs: int, *, threads: int | None = None
    ) -> None:
        super().__init__(make, num_envs)
        lead = self.envs[0]
        self._delta = lead._delta
        self._reads = None if self._delta is None else self._delta.reads
        names = (*lead._needed, *(() if self._reads is None else (self._reads,)))
        self._batch = Batch([env.world for env in self.envs], threads=threads, names=names)
        self._readers: WeakKeyDictionary[StateTable, ObservationReader] = WeakKeyDictionary()
        self._commands = np.empty((num_envs, lead.world.compiled.n_actions))
        # Where joints were put since the last command: relative actions are relative to them.
        self._are_set = np.zeros(num_envs, dtype=np.bool_)
        self._sensed: set[int] = set()
        self._alone: set[int] = set()  # they were used by themselves since they were stepped
        self._acting: Any = self.envs if hasattr(lead, "stepped") else ()

    def step(self, which: NDArray[Any], actions: NDArray[Any]) -> None:
        """Advance some of them one control step."""
        rows = np.flatnonzero(which)
        if not len(rows):
            return
        self._look()
        check_actions(rows, actions)
        commands = self._commanded(rows, actions)
        try:
            self._batch.advance(commands, which)
        except (FunctionFailure, EngineFailure) as error:  # the others are a step further
            self._are_set[rows] = False
            self._bring(rows.tolist())
            for row in rows.tolist():
                with suppress(ScmWorldError):
                    self._show(row)
            if isinstance(error, FunctionFailure):
                raise located(error, error.row or 0) from error.__cause__
            raise
        self._are_set[rows] = False
        for table, members in self._batch.tables(rows):
            reader = self._readers.get(table)
            if reader is None:
                reader = ObservationReader(self.envs[int(members[0])], table)
                self._readers[table] = reader
            wrong = reader.write(table, members, self.buffers)
            if wrong is not None:
                self._explain(wrong)
            again: Iterable[int] = members.tolist() if reader.is_partial else self._sensed
            for row in again:
                if which[row]:
                    self._bring([row])
                    self._show(row)
            for row in members.tolist() if self._acting else ():
                self._act(row, int(table.matrix[row, reader.clock]))

    def _commanded(self, rows: Integers, actions: NDArray[Any]) -> Floats:
        """Return the commands of some environments, shape (n, n_actions); it holds until the next.

        Actions are added to what they are relative to, scaled, and clipped.
        """
        given, lead = actions[rows].astype(np.float64), self.envs[0]
        if self._delta is not None:
            self._batch.fill(rows)
            actions = np.array(actions, dtype=np.float64)
            for table, members in self._batch.tables(rows):
                if self._reads is not None:
                    offset = table.column(self._reads)[members]
                else:
                    offset = table.actions()[members]
                    if lead.world.action_mode == JOINTS:
                        put = self._are_set[members, None]
                        offset = np.where(put, table.column(JOINTS)[members], offset)
                actions[members] = self._delta.moved(actions[members], offset)
            given = actions[rows]
        scaled, world = lead._middle + lead._half * given, lead.world
        self._commands[rows] = np.minimum(np.maximum(scaled, world.action_low), world.action_high)
        return self._commands

    def _act(self, row: int, step: int) -> None:
        """Run what is due in one member after a control step."""
        buffers, infos = self.buffers, self.buffers.infos
        over = bool(buffers.terminations[row] or buffers.truncations[row])
        success: Any = infos.get(FLAGS[0])
        if not self._acting[row].stepped(
            step, over=over, success=success is not None and bool(success[row])
        ):
            return
        terms: Any = infos[TERMS]
        earned = {name: column[row] for name, column in terms.items()}
        try:
            with self.alone(row):
                self._acting[row].act()
        except ScmWorldError as error:
            located(error, row)
            raise
        for name, value in earned.items():
            terms[name][row] = value  # of the step: an intervention earns nothing

    @contextmanager
    def alone(self, index: int) -> Iterator[ScmWorldEnv]:
        """Let one of them be used by itself; what it shows afterwards is in its row.

        Unlike ``do`` and ``reset``, this takes nothing back if something is refused.

        Raises:
            InterventionError: It is not observed like the others any more.
        """
        self._bring([index])
        yield self.envs[index]
        shown = self.envs[index].present()
        self._accept(index, "what was done")
        self.buffers.write(index, *shown)

    def close(self) -> None:
        """Free their engines."""
        self._bring(range(self.num_envs))  # no row counts any more
        super().close()

    def _bring(self, indices: Iterable[int]) -> None:
        for index in indices:
            self._batch.world(index)
            self._alone.add(index)

    def _look(self) -> None:
        """Note what was changed in environments that were used by themselves."""
        for index in self._alone:
            env = self.envs[index]
            if not env.world.has_begun:
                continue
            if env._delta is not None and env.world.action_mode == JOINTS:
                self._are_set[index] = env._delta.is_set()
            if env.world.current()[0].get(SENSOR_NOISE):
                self._sensed.add(index)
            else:
                self._sensed.discard(index)
        self._alone.clear()

    def _explain(self, row: int) -> None:
        """Raise the error that the environment would raise alone.

        Raises:
            ModelError: Its reward is no finite number.
        """
        self._bring([row])
        terms = self.envs[row]._terms
        try:
            one_number(self.envs[row].world.evaluate((REWARD, *terms)), REWARD, terms)
        except ScmWorldError as error:
            raise located(error, row) from error.__cause__


@final
class ObservationReader:
    """Reads observations, rewards and infos of one structure.

    Args:
        env: Of this structure.
        table: In which its world is.

    Attributes:
        is_partial: Whether observation and info have to be read in each environment by itself.
        clock: Column of the number of control steps.
    """

    def __init__(self, env: ScmWorldEnv, table: StateTable) -> None:
        seen: Any = env._observer
        goals = env._goals
        together = isinstance(seen, DictObserver)
        parts: dict[str | None, Any] = dict(seen._parts) if together else {None: seen}
        self._vectors: dict[str | None, Vector] = {
            name: part
            for name, part in parts.items()
            if isinstance(part, Vector) and KEYPOINTS not in part._slices
        }
        self.is_partial = len(self._vectors) < len(parts)
        self._shows_goals = isinstance(seen, DictObserver) and seen._goals is not None
        goal = env.world.task.goal
        sides = (goal.achieved, goal.desired) if goals is not None else ()
        self._goals = {
            name: places(table.where[one] for one in side)
            for name, side in zip(GOALS, sides, strict=False)
        }
        self._bound = 0.0 if goals is None else goals.bound
        where = {name: place.start for name, place in table.where.items()}
        self._terms = {name: where[name] for name in env._terms}
        self._reward, self._terminated = where[REWARD], where.get(TERMINATED)
        self._success, self._fraction = where.get(SUCCESS), where.get(FRACTION)
        self.clock, self._scale, self._limit = where[CONTROL_INDEX], env._scale, env.limit

    def write(self, table: StateTable, rows: Integers, buffers: Buffers) -> int | None:
        """Write some rows of the buffers.

        Returns:
            A row whose reward is no finite number; None if all are.
        """
        numbers = table.matrix
        rewards = self._scale * numbers[rows, self._reward]
        wrong = ~np.isfinite(rewards)
        if wrong.any():
            return int(rows[wrong][0])
        buffers.rewards[rows] = rewards
        ends = self._terminated
        buffers.terminations[rows] = False if ends is None else numbers[rows, ends] != 0.0
        buffers.truncations[rows] = numbers[rows, self.clock] >= self._limit
        if self.is_partial:
            return None
        for part, vector in self._vectors.items():
            shown = buffers.observations if part is None else buffers.observations[part]
            vector.write(numbers, rows, shown)
        infos: dict[str, Any] = buffers.infos
        if self._success is not None:
            infos[FLAGS[0]][rows] = infos[FLAGS[1]][rows] = numbers[rows, self._success] != 0.0
        if self._fraction is not None:
            infos[FRACTION][rows] = numbers[rows, self._fraction]
        for name, column in self._terms.items():
            infos[TERMS][name][rows] = numbers[rows, column]
        for name, columns in self._goals.items():
            found = infos[name][rows] = numbers[rows[:, None], columns]
            if self._shows_goals:
                buffers.observations[name][rows] = np.clip(found, -self._bound, self._bound)
        return None
