"""A curriculum for environments that are stepped in one call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world.curricula.curriculum import Curriculum
from scm_world.curricula.runner import CurriculumRunner
from scm_world.curricula.situations import Memory
from scm_world.curricula.wrapper import is_checked
from scm_world.env.batched.buffers import TERMS
from scm_world.env.batched.executor import located
from scm_world.env.batched.native import NativeExecutor
from scm_world.env.copies import EnvSnapshot
from scm_world.errors import ScmWorldError
from scm_world.graph import flatten
from scm_world.variables.subsets import AnyRegion
from scm_world.world import Audit

OWN = ("curriculum", "memory", "turn", "where")
"""What each member has besides its environment, as in ``CurriculumEnv``."""


@final
class CurriculumExecutor:
    """Environments of which each is intervened on as in a ``CurriculumEnv``. See ``EnvExecutor``.

    An environment is used by itself at its resets, and after those control steps at which the
    curriculum may act; all others are stepped in one call. The numbers of the episodes, and the
    stages, come from ``CurriculumVectorEnv``.

    Args:
        executor: The environments.
        curriculum: What is done in each of them.

    Raises:
        InterventionError: The curriculum names something that does not exist.

    Attributes:
        num_envs: How many there are.
        form: What they have in common.
        buffers: What they said last.
    """

    def __init__(self, executor: NativeExecutor, curriculum: Curriculum) -> None:
        self._executor, self._curriculum = executor, curriculum
        self.num_envs, self.form, self.buffers = executor.num_envs, executor.form, executor.buffers
        (world,) = executor.attribute([0], "world")
        self._checked = is_checked(curriculum, world)
        self._turns = [CurriculumRunner(curriculum) for _ in range(self.num_envs)]
        self._next: list[tuple[int, Memory] | None] = [None] * self.num_envs
        self._places: list[tuple[int, int] | None] = [None] * self.num_envs
        self._begun = np.zeros(self.num_envs, bool)
        self._running = np.zeros(self.num_envs, bool)
        self._steps = np.zeros(self.num_envs, np.int64)
        self._waits = curriculum.steps_matter

    # --- what the curriculum does -----------------------------------------------------------------

    def reset(
        self,
        which: NDArray[Any],
        seeds: Sequence[int | None],
        options: Sequence[Mapping[str, Any] | None],
    ) -> None:
        """Begin an episode in some of them, with what is due."""
        chosen, given = list(seeds), list(options)
        indices = np.flatnonzero(which).tolist()
        for index in indices:
            place = self._places[index]
            if place is not None and chosen[index] is None:
                chosen[index] = place[0]
                given[index] = {"episode": place[1], **(given[index] or {})}
        self._running[which] = False
        self._executor.reset(which, chosen, given)
        try:
            for index in indices:
                self._begin(index, (given[index] or {}).get("do") or {})
        except BaseException:
            self._executor.undo()
            raise
        for index in indices:
            self._next[index] = self._places[index] = None
        self._begun[which] = self._running[which] = True
        self._steps[which] = 0

    def _begin(self, index: int, besides: Mapping[str, Any]) -> None:
        turn, told = self._turns[index], self._next[index]
        if told is not None:
            turn.memory = Memory(told[0], told[1].stages)
        try:
            with self._executor.alone(index) as env:
                if not self._checked:
                    self._curriculum.check(env.world)
                    self._checked = True
                turn.begin(env, besides=flatten(besides))
        except ScmWorldError as error:
            located(error, index)
            raise

    def step(self, which: NDArray[Any], actions: NDArray[Any]) -> None:
        """Advance some of them one control step, then do what is due."""
        self._executor.step(which, actions)
        self._steps[which] += 1
        over = which & (self.buffers.terminations | self.buffers.truncations)
        self._running[over] = False
        if self._waits:
            for index in np.flatnonzero(which & ~over).tolist():
                if self._turns[index].may_act(int(self._steps[index])):
                    self._act(index)

    def _act(self, index: int) -> None:
        columns: Any = self.buffers.infos[TERMS]
        terms = {name: column[index] for name, column in columns.items()}
        try:
            with self._executor.alone(index) as env:
                self._turns[index].step(env)
        except ScmWorldError as error:
            located(error, index)
            raise
        for name, value in terms.items():
            columns[name][index] = value  # of the step: an intervention earns nothing

    # --- what a member has besides ----------------------------------------------------------------

    def call(self, indices: Sequence[int], name: str, *args: Any, **kwargs: Any) -> list[Any]:
        """Call a method of some of them; what cannot be called is given as it is."""
        if name in OWN:
            return self.attribute(indices, name)
        return self._executor.call(indices, name, *args, **kwargs)

    def attribute(self, indices: Sequence[int], name: str) -> list[Any]:
        """Look an attribute of some of them up."""
        match name:
            case "curriculum":
                return [self._curriculum for _ in indices]
            case "memory":
                return [self._turns[index].memory for index in indices]
            case "turn":
                return [self._next[index] for index in indices]
            case "where":
                return [self._where(index) for index in indices]
        return self._executor.attribute(indices, name)

    def assign(self, name: str, values: Mapping[int, Any]) -> None:
        """Set an attribute of some of them; see ``CurriculumEnv.turn`` and ``where``."""
        for index, value in values.items():
            if name == "turn":
                self._next[index] = value or self._next[index]
            elif name == "where":
                self._places[index], self._running[index] = value, False
        if name not in OWN:
            self._executor.assign(name, values)

    def _where(self, index: int) -> tuple[int, int] | None:
        place = self._places[index]
        if place is not None or not self._begun[index]:
            return place
        (world,) = self._executor.attribute([index], "world")
        return world.noise.seed, world.episode + int(not self._running[index])

    # --- the same as without a curriculum ---------------------------------------------------------

    def do(
        self, requests: Mapping[int, Mapping[str, Any]], space: AnyRegion | None = None
    ) -> dict[int, Audit]:
        """Intervene in some of them."""
        return self._executor.do(requests, space)

    def snapshot(self, indices: Sequence[int]) -> list[EnvSnapshot]:
        """Save some of them; what the curriculum remembers is not a part of that."""
        return self._executor.snapshot(indices)

    def restore(self, snapshots: Mapping[int, EnvSnapshot]) -> None:
        """Take some of them to a snapshot."""
        self._executor.restore(snapshots)
        for index, snapshot in snapshots.items():
            self._steps[index] = snapshot.world.index

    def close(self) -> None:
        """Free everything they hold."""
        self._executor.close()
