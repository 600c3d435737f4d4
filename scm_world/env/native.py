"""Many environments in this process, which the backend steps in one call."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

from scm_world._arguments import whole_number
from scm_world._types import Floats, Integers
from scm_world.env.delta import JOINTS
from scm_world.env.environment import ScmWorldEnv
from scm_world.env.many import ScmWorldVectorEnv, act, member_shapes
from scm_world.errors import EngineFailure, FunctionFailure, ScmWorldError
from scm_world.tasks.model import REWARD
from scm_world.tasks.rewards import TERMINATED, one_number
from scm_world.variables.reserved import CONTROL_INDEX, SENSOR_NOISE
from scm_world.world.batch import Batch, Mask, located
from scm_world.world.mechanisms import Rows


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
            ``CurriculumEnv``, whose ``over`` is called where an episode ends.
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
        self._shapes = member_shapes(first)
        self._inner: list[Any] = [env.unwrapped for env in self.envs]
        for inner in self._inner:
            inner._ezpickle_kwargs = lead._ezpickle_kwargs
        self._delta = lead._delta
        self._reads = None if self._delta is None else self._delta.reads
        names = (*lead._observer.needed, *(() if self._reads is None else (self._reads,)))
        worlds = [inner.world for inner in self._inner]
        self._batch = Batch(worlds, threads=threads, names=names)
        self._commands = np.empty((count, self._action_size))
        self._counting = hasattr(first, "over")

    # --- one of them by itself --------------------------------------------------------------------

    def _act(self, method: str, given: Mapping[int, Mapping[str, Any]]) -> dict[int, Any]:
        answers, before, index = {}, {}, 0
        try:
            for index, arguments in given.items():
                if self._inner[index].world.has_begun:  # else there is nothing to lose
                    before[index] = self.envs[index].get_wrapper_attr("snapshot")()
                answers[index], shown = act(self.envs[index], self._shapes, method, arguments)
                self._write(index, *shown)
        except BaseException as error:
            for row, snapshot in before.items():
                self.envs[row].get_wrapper_attr("restore")(snapshot)
                self._write(row, *self._inner[row].present())
            if isinstance(error, ScmWorldError):
                located(error, index, "environment")
            raise
        return answers

    def call_in(self, indices: Iterable[int], name: str, *args: Any, **kwargs: Any) -> list[Any]:
        """Call a method of some environments; return what cannot be called as it is."""
        found = [self.envs[index].get_wrapper_attr(name) for index in indices]
        return [one(*args, **kwargs) if callable(one) else one for one in found]

    def _assign(self, name: str, values: Sequence[Any]) -> None:
        for env, value in zip(self.envs, values, strict=True):
            env.set_wrapper_attr(name, value)

    def present(self) -> tuple[Any, dict[str, Any]]:
        """Return observations and infos of the present, as after an intervention."""
        if self._begun.all():
            self._read_alone(self._everyone)
        return super().present()

    def _read_alone(self, which: Mask) -> None:
        """Read environments one by one; the row of one that cannot be read stays as it is."""
        for row in np.flatnonzero(which).tolist():
            with suppress(ScmWorldError):
                self._write(row, *self._inner[row].present())

    def close_extras(self, **kwargs: Any) -> None:
        """Free the backends."""
        for env in self.envs:
            env.close()

    # --- a control step ---------------------------------------------------------------------------

    def _advance(self, which: Mask, actions: Floats) -> None:
        rows = np.flatnonzero(which)
        if not len(rows):
            return
        commands = self._commanded(rows, actions)
        try:
            self._batch.advance(commands, which)
        except (FunctionFailure, EngineFailure) as error:  # the others are a step further
            self._read_alone(which)
            if isinstance(error, FunctionFailure):
                raise located(error, error.row or 0, "environment") from error.__cause__
            raise
        for table, members in self._batch.tables(rows):
            whole = len(members) == self.num_envs
            now = table if whole else Rows(table.mechanisms, table.numbers[members])
            self._take(self._inner[int(members[0])], now, members)
        ended = self._terminations | self._truncations
        for row in rows[~ended[rows]].tolist():
            if self._inner[row].world.is_planned:
                self._intervene(row)
        success = self._known.get("is_success", np.zeros(self.num_envs, bool))
        for row in rows[ended[rows]].tolist() if self._counting else ():
            self.envs[row].get_wrapper_attr("over")(success=bool(success[row]))

    def _take(self, lead: ScmWorldEnv, now: Rows, rows: Integers) -> None:
        """Write what a step led to in environments of one structure; ``lead`` is one of them."""
        rewards = lead._scale * now[REWARD]
        for row in rows[~np.isfinite(rewards)].tolist():
            self._explain(row)
        self._rewards[rows] = rewards
        self._terminations[rows] = now[TERMINATED] != 0.0 if TERMINATED in now else False
        self._truncations[rows] = now[CONTROL_INDEX] >= lead.limit
        observation, info = lead.read(now)
        self._write(rows, observation, info)
        alone = np.full(len(rows), observation is None)
        if SENSOR_NOISE in now:
            alone |= now[SENSOR_NOISE] != 0.0
        for row in rows[alone].tolist():
            self._write(row, *self._inner[row].present())

    def _commanded(self, rows: Integers, actions: Floats) -> Floats:
        """Return the commands of some environments, shape (n, n_actions); it holds until the next.

        Actions are added to what they are relative to, scaled, and clipped.
        """
        lead = self._lead
        if self._delta is not None:
            actions = np.array(actions)
            for table, members in self._batch.tables(rows):
                offset = table.actions if self._reads is None else table[self._reads]
                offset = offset[members]
                if self._reads is None and lead.world.options.action_mode == JOINTS:
                    # Where joints were put since the last command, actions are relative to them.
                    deltas: Any = (self._inner[row]._delta for row in members.tolist())
                    put = np.array([delta.is_set() for delta in deltas])
                    offset = np.where(put[:, None], table[JOINTS][members], offset)
                actions[members] = self._delta.moved(actions[members], offset)
        scaled, world = lead._middle + lead._half * actions[rows], lead.world
        self._commands[rows] = np.minimum(np.maximum(scaled, world.action_low), world.action_high)
        return self._commands

    def _intervene(self, row: int) -> None:
        """Do what the plan of one environment contains after a control step."""
        if not self._inner[row].world.may_act(self._inner[row].world.index):
            return
        terms = self._known["reward_terms"]
        earned = {name: column[row] for name, column in terms.items()}
        try:
            _, shown = act(self.envs[row], self._shapes, "act", {})
        except ScmWorldError as error:
            raise located(error, row, "environment") from error.__cause__
        self._write(row, *shown)
        for name, value in earned.items():
            terms[name][row] = value  # of the step: an intervention earns nothing

    def _explain(self, row: int) -> None:
        """Raise the error that an environment whose reward is not finite would raise alone."""
        env = self._inner[row]
        try:
            one_number(env.world.evaluate((REWARD, *env._terms)), REWARD, env._terms)
        except ScmWorldError as error:
            raise located(error, row, "environment") from error.__cause__
