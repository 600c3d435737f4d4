"""A wrapper that averages actions, and the search for the environment inside of wrappers."""

from __future__ import annotations

from collections import deque
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from scm_world._arguments import whole_number
from scm_world.env.actions import doubles
from scm_world.env.environment import ScmWorldEnv
from scm_world.errors import UnknownOption

Actions = NDArray[Any]


def unwrapped_env(env: gymnasium.Env[Any, Any], wrapper: str) -> ScmWorldEnv:
    """Return the environment of this package inside of wrappers."""
    inner = env.unwrapped
    if not isinstance(inner, ScmWorldEnv):
        raise UnknownOption(f"environment for {wrapper}", type(inner).__name__, ("ScmWorldEnv",))
    return inner


@final
class MovingAverageAction(gymnasium.ActionWrapper[Any, Actions, Actions], RecordConstructorArgs):
    """Averages the last actions; at the start of an episode, those that there are.

    Args:
        env: With actions in a box.
        window: How many actions count.

    Raises:
        UnknownOption: ``window`` is not a positive whole number.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], window: int = 8) -> None:
        window = whole_number("window", window, least=1)
        RecordConstructorArgs.__init__(self, window=window)
        super().__init__(env)
        self._last: deque[Actions] = deque(maxlen=window)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; earlier actions are forgotten."""
        self._last.clear()
        return super().reset(seed=seed, options=options)

    def action(self, action: Actions) -> Actions:
        """Return the mean of the last actions."""
        doubles(action, int(np.prod(self.action_space.shape or ())))  # refuses other shapes
        self._last.append(np.array(action))
        mean: Any = np.mean(self._last, axis=0, dtype=np.float64)
        kind = self._last[-1].dtype
        averaged: Actions = mean.astype(kind) if np.issubdtype(kind, np.floating) else mean
        return averaged
