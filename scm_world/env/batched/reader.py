"""What many environments show, read out of a table in compiled loops."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np

from scm_world._types import Floats, Integers
from scm_world.env.batched.buffers import FLAGS, FRACTION, GOALS, TERMS, Buffers
from scm_world.env.delta import Delta
from scm_world.env.environment import REWARD, TERMINATED, ScmWorldEnv
from scm_world.env.goals import Goals
from scm_world.env.keypoints import KEYPOINTS
from scm_world.env.observer import DictObserver
from scm_world.env.vector import Vector
from scm_world.tasks.rewards import SUCCESS
from scm_world.variables.reserved import CONTROL_INDEX
from scm_world.world.batch import Table
from scm_world.world.mechanisms import places


@final
@dataclass(frozen=True)
class EnvLayout:
    """How an environment turns actions into commands, and values into what it returns.

    Attributes:
        needed: Variables that have to be computed.
        middle: The command that an action of 0 stands for, shape (n_actions,).
        half: What an action of 1 adds to it, shape (n_actions,).
        delta: What makes actions relative, if they are.
        vectors: Observations that are vectors of variables, by name; None is the whole.
        is_partial: Whether something else is observed, or told in ``info``.
        shows_goals: Whether goals are part of the observation.
        goals: What is achieved and desired, if the task has goals.
        terms: Names of the reward terms.
        scale: What rewards are multiplied by.
        limit: Control steps of an episode.
    """

    needed: tuple[str, ...]
    middle: Floats
    half: Floats
    delta: Delta | None
    vectors: dict[str | None, Vector]
    is_partial: bool
    shows_goals: bool
    goals: Goals | None
    terms: tuple[str, ...]
    scale: float
    limit: int

    @classmethod
    def of(cls, env: ScmWorldEnv) -> EnvLayout:
        """Look into an environment, as it is in its present structure."""
        seen: Any = env._observer
        together = isinstance(seen, DictObserver)
        parts: dict[str | None, Any] = dict(seen._parts) if together else {None: seen}
        vectors = {name: part for name, part in parts.items() if isinstance(part, Vector)}
        plain = {name: part for name, part in vectors.items() if KEYPOINTS not in part._slices}
        return cls(
            env._needed,
            env._middle,
            env._half,
            env._delta,
            plain,
            len(plain) < len(parts) or any(env._rich),
            together and seen._goals is not None,
            env._goals,
            env._terms,
            env._scale,
            env.limit,
        )


@final
class ObservationReader:
    """Reads observations, rewards and infos of one structure.

    Args:
        env: Of this structure.
        table: In which its world is.

    Attributes:
        is_partial: Whether observation and info have to be read in each environment by itself.
    """

    def __init__(self, env: ScmWorldEnv, table: Table) -> None:
        inside = EnvLayout.of(env)
        self._vectors = inside.vectors
        self.is_partial, self._shows_goals = inside.is_partial, inside.shows_goals
        sides = env.world.task.goal_names() if inside.goals is not None else ()
        self._goals = {
            name: places(table.where[one] for one in side)
            for name, side in zip(GOALS, sides, strict=False)
        }
        self._bound = 0.0 if inside.goals is None else inside.goals.bound
        where = {name: place.start for name, place in table.where.items()}
        self._terms = {name: where[name] for name in inside.terms}
        self._reward, self._terminated = where[REWARD], where.get(TERMINATED)
        self._success, self._fraction = where.get(SUCCESS), where.get(FRACTION)
        self._clock = where[CONTROL_INDEX]
        self._scale, self._limit = inside.scale, inside.limit

    def write(self, table: Table, rows: Integers, buffers: Buffers) -> int | None:
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
        if self._terminated is None:
            buffers.terminations[rows] = False
        else:
            buffers.terminations[rows] = numbers[rows, self._terminated] != 0.0
        buffers.truncations[rows] = numbers[rows, self._clock] >= self._limit
        if not self.is_partial:
            self._show(numbers, rows, buffers)
        return None

    def _show(self, numbers: Floats, rows: Integers, buffers: Buffers) -> None:
        for name, vector in self._vectors.items():
            shown = buffers.observations if name is None else buffers.observations[name]
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
