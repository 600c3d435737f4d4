"""Actions of many environments, turned into what their worlds take."""

from __future__ import annotations

from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats, Integers
from scm_world.env.batched.executor import check_actions
from scm_world.env.batched.reader import EnvLayout
from scm_world.env.delta import JOINTS
from scm_world.env.environment import ScmWorldEnv
from scm_world.world.batch import Batch, Table


@final
class ActionScaler:
    """Scales actions, adds what they are relative to, and clips them.

    Args:
        env: Any of the environments.
        num_envs: How many there are.

    Attributes:
        names: What has to be known of the present.
    """

    def __init__(self, env: ScmWorldEnv, num_envs: int) -> None:
        inside = EnvLayout.of(env)
        self._middle, self._half = inside.middle, inside.half
        self._low, self._high = env.world.action_low, env.world.action_high
        self._delta = inside.delta
        self._mode = env.world.action_mode
        self._reads = None if self._delta is None else self._delta.reads
        self.names = () if self._reads is None else (self._reads,)
        # Where the joints were put since the last command: it is relative to them.
        self._are_set = np.zeros(num_envs, dtype=np.bool_)
        self._found = np.empty((num_envs, env.world.compiled.n_actions))

    def read(self, rows: Integers, actions: NDArray[Any], batch: Batch) -> Floats:
        """Give the commands of some environments.

        Args:
            rows: Their numbers, shape (m,).
            actions: Shape (n, n_actions).
            batch: Their worlds.

        Returns:
            Shape (n, n_actions); rows of others mean nothing. It holds until the next call.

        Raises:
            ActionError: A number is not finite.
        """
        check_actions(rows, actions)
        given = actions[rows].astype(np.float64)
        if self._delta is not None:
            batch.fill(rows)
            actions = np.array(actions, dtype=np.float64)
            for table, members in batch.tables(rows):
                offset = self._offset(table, members)
                actions[members] = self._delta.moved(actions[members], offset)
            given = actions[rows]
        scaled = self._middle + self._half * given
        self._found[rows] = np.minimum(np.maximum(scaled, self._low), self._high)
        return self._found

    def _offset(self, table: Table, rows: Integers) -> Floats:
        """Give what actions are relative to, shape (m, n_actions)."""
        if self._reads is not None:
            return table.column(self._reads)[rows]
        last = table.actions()[rows]
        if self._mode != JOINTS:
            return last
        return np.where(self._are_set[rows, None], table.column(JOINTS)[rows], last)

    def look(self, index: int, env: ScmWorldEnv) -> None:
        """Note whether the joints of an environment were put somewhere."""
        if self._delta is not None and self._mode == JOINTS:
            delta = EnvLayout.of(env).delta
            self._are_set[index] = delta is not None and delta.is_set()

    def passed(self, rows: Integers) -> None:
        """Note that some environments were told something."""
        self._are_set[rows] = False
