"""What many environments show, read out of a table in compiled loops."""

from __future__ import annotations

from typing import Any, final

import numpy as np

from scm_world._types import Floats, Integers
from scm_world.env.batched.inside import Inside
from scm_world.env.batched.sheet import FLAGS, FRACTION, GOALS, TERMS, Sheet
from scm_world.env.environment import REWARD, TERMINATED, ScmWorldEnv
from scm_world.tasks.rewards import SUCCESS
from scm_world.variables.reserved import CONTROL_INDEX
from scm_world.world.batch import Table
from scm_world.world.mechanisms import places


@final
class Lens:
    """Reads observations, rewards and infos of one structure.

    Args:
        env: Of this structure.
        table: In which its world is.

    Attributes:
        is_partial: Whether observation and info have to be read in each environment by itself.
    """

    def __init__(self, env: ScmWorldEnv, table: Table) -> None:
        inside = Inside.of(env)
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

    def write(self, table: Table, rows: Integers, sheet: Sheet) -> int | None:
        """Write some rows of the sheet.

        Returns:
            A row whose reward is no finite number; None if all are.
        """
        numbers = table.matrix
        rewards = self._scale * numbers[rows, self._reward]
        wrong = ~np.isfinite(rewards)
        if wrong.any():
            return int(rows[wrong][0])
        sheet.rewards[rows] = rewards
        if self._terminated is None:
            sheet.terminations[rows] = False
        else:
            sheet.terminations[rows] = numbers[rows, self._terminated] != 0.0
        sheet.truncations[rows] = numbers[rows, self._clock] >= self._limit
        if not self.is_partial:
            self._show(numbers, rows, sheet)
        return None

    def _show(self, numbers: Floats, rows: Integers, sheet: Sheet) -> None:
        for name, vector in self._vectors.items():
            shown = sheet.observations if name is None else sheet.observations[name]
            vector.write(numbers, rows, shown)
        infos: dict[str, Any] = sheet.infos
        if self._success is not None:
            infos[FLAGS[0]][rows] = infos[FLAGS[1]][rows] = numbers[rows, self._success] != 0.0
        if self._fraction is not None:
            infos[FRACTION][rows] = numbers[rows, self._fraction]
        for name, column in self._terms.items():
            infos[TERMS][name][rows] = numbers[rows, column]
        for name, columns in self._goals.items():
            found = infos[name][rows] = numbers[rows[:, None], columns]
            if self._shows_goals:
                sheet.observations[name][rows] = np.clip(found, -self._bound, self._bound)
