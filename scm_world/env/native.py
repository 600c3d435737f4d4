"""Many environments in this process, which the backend steps in one call."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any, final
from weakref import WeakKeyDictionary

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

from scm_world._arguments import whole_number
from scm_world._types import Floats, Integers
from scm_world.env.delta import JOINTS
from scm_world.env.environment import REWARD, ScmWorldEnv
from scm_world.env.many import Mask, MemberShapes, ScmWorldVectorEnv, located
from scm_world.env.observer import DictObserver
from scm_world.env.vector import KEYPOINTS, Vector
from scm_world.errors import EngineFailure, FunctionFailure, ScmWorldError
from scm_world.tasks.rewards import FRACTION, SUCCESS, TERMINATED, one_number
from scm_world.variables.reserved import CONTROL_INDEX, SENSOR_NOISE
from scm_world.world.batch import Batch, StateTable
from scm_world.world.mechanisms import places


@final
class NativeVectorEnv(ScmWorldVectorEnv):
    """Environments that the backend steps together, and that are read in compiled loops.

    MuJoCo steps them in threads; other backends step one after another. Pictures, the corners of
    blocks and the noise of sensors are read in one environment after another.

    Args:
        num_envs: How many.
        autoreset_mode: As in ``ScmWorldVectorEnv``.
        copy: Likewise.
        threads: Of the backend; as many as there are cores if None. Results do not depend on it.
        member: Makes one of them from the options: a ``ScmWorldEnv``, or one in a
            ``CurriculumEnv``, whose ``over`` is called at the end of an episode.
        options: Of ``ScmWorldEnv``.

    Raises:
        UnknownOption: An option does not exist, or does not go with the others.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        copy: bool = True,
        threads: int | None = None,
        member: Callable[..., gymnasium.Env[Any, Any]] = ScmWorldEnv,
        **options: Any,
    ) -> None:
        count = whole_number("num_envs", num_envs, least=1)
        first = member(**options)
        super().__init__(
            count,
            first.observation_space,
            first.action_space,
            metadata=first.metadata,
            render_mode=first.render_mode,
            autoreset_mode=autoreset_mode,
            copy=copy,
        )
        lead: Any = first.unwrapped
        self._lead: ScmWorldEnv = lead
        # They share what is declared, and each can be made again by itself.
        shared = {**options, "task": lead.world.structures, "task_options": None}
        self.envs = [first, *(member(**shared) for _ in range(count - 1))]
        self._alike = [MemberShapes.of(env) for env in self.envs]
        self._inner: list[Any] = [env.unwrapped for env in self.envs]
        for inner in self._inner:
            inner._ezpickle_kwargs = lead._ezpickle_kwargs
        self._delta = lead._delta
        self._reads = None if self._delta is None else self._delta.reads
        names = (*lead._needed, *(() if self._reads is None else (self._reads,)))
        worlds = [inner.world for inner in self._inner]
        self._batch = Batch(worlds, threads=threads, names=names)
        self._readers: WeakKeyDictionary[StateTable, ObservationReader] = WeakKeyDictionary()
        self._commands = np.empty((count, self._action_size))
        # Where joints were put since the last command: relative actions are relative to them.
        self._are_set = np.zeros(count, dtype=np.bool_)
        self._sensed: set[int] = set()
        self._planned: set[int] = set()  # with a plan that acts within the episode
        self._alone: set[int] = set()  # they were used by themselves since they were stepped
        self._counting = hasattr(first, "over")

    # --- one of them by itself --------------------------------------------------------------------

    def _bring(self, index: int) -> gymnasium.Env[Any, Any]:
        """Return an environment as it is now, to be used by itself."""
        self._batch.world(index)
        self._alone.add(index)
        return self.envs[index]

    def _act(self, method: str, given: Mapping[int, Mapping[str, Any]]) -> dict[int, Any]:
        answers, before, index = {}, {}, 0
        try:
            for index, arguments in given.items():
                env = self._bring(index)
                if self._inner[index].world.has_begun:  # else there is nothing to lose
                    before[index] = env.get_wrapper_attr("snapshot")()
                answers[index], shown = self._alike[index].act(env, method, arguments)
                self._write(index, *shown)
        except BaseException as error:
            for row, snapshot in before.items():
                self.envs[row].get_wrapper_attr("restore")(snapshot)
                self._write(row, *self._inner[row].present())
            if isinstance(error, ScmWorldError):
                located(error, index)
            raise
        return answers

    def call_in(self, indices: Iterable[int], name: str, *args: Any, **kwargs: Any) -> list[Any]:
        """Call a method of some environments; return what cannot be called as it is."""
        found = [self._bring(index).get_wrapper_attr(name) for index in indices]
        return [one(*args, **kwargs) if callable(one) else one for one in found]

    def _assign(self, name: str, values: Sequence[Any]) -> None:
        for env, value in zip(self.envs, values, strict=True):
            env.set_wrapper_attr(name, value)

    def present(self) -> tuple[Any, dict[str, Any]]:
        """Return observations and infos of the present, as after an intervention."""
        for index in self._alone:
            self._read(index)
        return super().present()

    def _read(self, index: int) -> None:
        """Read an environment by itself; the row of one that cannot be read stays as it is."""
        self._bring(index)
        with suppress(ScmWorldError):
            self._write(index, *self._inner[index].present())

    def close_extras(self, **kwargs: Any) -> None:
        """Free the backends."""
        for index in range(self.num_envs):
            self._bring(index).close()

    # --- a control step ---------------------------------------------------------------------------

    def _advance(self, which: Mask, actions: Floats) -> None:
        rows = np.flatnonzero(which)
        if not len(rows):
            return
        self._look()
        commands = self._commanded(rows, actions)
        try:
            self._batch.advance(commands, which)
        except (FunctionFailure, EngineFailure) as error:  # the others are a step further
            self._are_set[rows] = False
            for row in rows.tolist():
                self._read(row)
            if isinstance(error, FunctionFailure):
                raise located(error, error.row or 0) from error.__cause__
            raise
        self._are_set[rows] = False
        for table, members in self._batch.tables(rows):
            reader = self._readers.get(table)
            if reader is None:
                reader = ObservationReader(self._inner[int(members[0])], table)
                self._readers[table] = reader
            numbers = table.matrix
            rewards = reader.scale * numbers[members, reader.reward]
            for row in members[~np.isfinite(rewards)].tolist():
                self._explain(row)
            ends = reader.terminated
            self._rewards[members] = rewards
            self._terminations[members] = False if ends is None else numbers[members, ends] != 0.0
            self._truncations[members] = numbers[members, reader.clock] >= reader.limit
            if not reader.is_partial:
                reader.write(numbers, members, self._seen, self._known)
            again: Iterable[int] = members.tolist() if reader.is_partial else self._sensed
            for row in again:
                if which[row]:
                    self._bring(row)
                    self._write(row, *self._inner[row].present())
        ended = self._terminations | self._truncations
        for row in [row for row in self._planned if which[row] and not ended[row]]:
            self._intervene(row, self._batch.table(row).clock(row))
        if self._counting:
            success = self._known.get("is_success", np.zeros(self.num_envs, bool))
            for row in np.flatnonzero(which & ended).tolist():
                self.envs[row].get_wrapper_attr("over")(success=bool(success[row]))

    def _look(self) -> None:
        """Note what was changed in environments that were used by themselves."""
        for index in self._alone:
            env = self._inner[index]
            if not env.world.has_begun:
                continue
            if env._delta is not None and env.world.action_mode == JOINTS:
                self._are_set[index] = env._delta.is_set()
            for which, belongs in (
                (self._sensed, env.world.current()[0].get(SENSOR_NOISE)),
                (self._planned, env.world.is_planned),
            ):
                if belongs:
                    which.add(index)
                else:
                    which.discard(index)
        self._alone.clear()

    def _commanded(self, rows: Integers, actions: Floats) -> Floats:
        """Return the commands of some environments, shape (n, n_actions); it holds until the next.

        Actions are added to what they are relative to, scaled, and clipped.
        """
        lead = self._lead
        if self._delta is not None:
            self._batch.fill(rows)
            actions = np.array(actions)
            for table, members in self._batch.tables(rows):
                if self._reads is not None:
                    offset = table.column(self._reads)[members]
                else:
                    offset = table.actions()[members]
                    if lead.world.action_mode == JOINTS:
                        put = self._are_set[members, None]
                        offset = np.where(put, table.column(JOINTS)[members], offset)
                actions[members] = self._delta.moved(actions[members], offset)
        scaled, world = lead._middle + lead._half * actions[rows], lead.world
        self._commands[rows] = np.minimum(np.maximum(scaled, world.action_low), world.action_high)
        return self._commands

    def _intervene(self, row: int, step: int) -> None:
        """Do what the plan of one environment contains after a control step."""
        if not self._inner[row].world.may_act(step):
            return
        terms = self._known["reward_terms"]
        earned = {name: column[row] for name, column in terms.items()}
        self._bring(row)
        try:
            _, shown = self._alike[row].act(self.envs[row], "act", {})
        except ScmWorldError as error:
            raise located(error, row) from error.__cause__
        self._write(row, *shown)
        for name, value in earned.items():
            terms[name][row] = value  # of the step: an intervention earns nothing

    def _explain(self, row: int) -> None:
        """Raise the error that an environment whose reward is not finite would raise alone."""
        self._bring(row)
        env = self._inner[row]
        try:
            one_number(env.world.evaluate((REWARD, *env._terms)), REWARD, env._terms)
        except ScmWorldError as error:
            raise located(error, row) from error.__cause__


@final
class ObservationReader:
    """Reads observations and infos of one structure.

    Args:
        env: Of this structure.
        table: In which its world is.

    Attributes:
        is_partial: Whether observation and info have to be read in each environment by itself.
        clock: Column of the number of control steps.
        limit: When episodes are truncated.
        reward: Column of the reward.
        scale: What rewards are multiplied by.
        terminated: Column of the variable that ends episodes, if there is one.
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
        where = {name: place.start for name, place in table.where.items()}
        self.reward, self.terminated = where[REWARD], where.get(TERMINATED)
        self.clock, self.scale, self.limit = where[CONTROL_INDEX], env._scale, env.limit
        self._success, self._fraction = where.get(SUCCESS), where.get(FRACTION)
        self._terms = {name: where[name] for name in env._terms}
        self._shows_goals = together and seen._goals is not None
        goal, self._bound = env.world.task.goal, 0.0 if goals is None else goals.bound
        sides = {"achieved_goal": goal.achieved, "desired_goal": goal.desired}
        self._goals = {
            name: places(table.where[one] for one in side)
            for name, side in (sides.items() if goals is not None else ())
        }

    def write(self, numbers: Floats, rows: Integers, seen: Any, infos: dict[str, Any]) -> None:
        """Write the observations and infos of some environments into their rows.

        Args:
            numbers: The table of all of them.
            rows: Which ones, shape (m,).
            seen: Their observations.
            infos: Their infos.
        """
        for part, vector in self._vectors.items():
            vector.write(numbers, rows, seen if part is None else seen[part])
        if self._success is not None:
            infos["is_success"][rows] = numbers[rows, self._success] != 0.0
            infos["success"][rows] = infos["is_success"][rows]
        if self._fraction is not None:
            infos["fractional_success"][rows] = numbers[rows, self._fraction]
        for name, column in self._terms.items():
            infos["reward_terms"][name][rows] = numbers[rows, column]
        for name, columns in self._goals.items():
            found = infos[name][rows] = numbers[rows[:, None], columns]
            if self._shows_goals:
                seen[name][rows] = np.clip(found, -self._bound, self._bound)
