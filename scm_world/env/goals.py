"""What is achieved and what is desired, for learners that ask."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, final

import gymnasium
import numpy as np
from numpy.typing import ArrayLike

from scm_world._types import Floats, Values
from scm_world.entities import CONTROL_INDEX
from scm_world.tasks import Task
from scm_world.tasks.rewards import FRACTION, SUCCESS
from scm_world.world import World
from scm_world.world.declaration import Declaration
from scm_world.world.start import beginning

BOUND = 10.0
"""Goals are positions [m], sizes [m] and unit quaternions; what lies beyond saturates."""

TERMS: dict[str, Callable[[Task, Floats, Floats], Any]] = {
    FRACTION: lambda task, have, want: task.fraction(have, want),
    SUCCESS: lambda task, have, want: task.fulfilled(task.fraction(have, want)),
    "reach_error": lambda task, have, want: np.abs(have - want).mean(axis=-1),
}
"""The reward terms that goals alone decide."""


class _Read(dict[str, Any]):
    """Values that remember which of them were looked at."""

    def __init__(self, values: Values) -> None:
        super().__init__(values)
        self.names: dict[str, None] = {}

    def __getitem__(self, name: str) -> Any:
        self.names[name] = None
        return super().__getitem__(name)


@final
class Goals:
    """The two goal vectors of a structure.

    Args:
        declaration: Of the structure.

    Attributes:
        names: The variables that have to be computed.
        spaces: Of ``achieved_goal`` and of ``desired_goal``: 64-bit floats of their true shapes,
            so that a reward that is computed from them is exact.
    """

    def __init__(self, declaration: Declaration) -> None:
        self._task = declaration.task
        values = _Read(example(declaration))
        pair = zip(("achieved_goal", "desired_goal"), self._task.goals(values), strict=True)
        self.names = tuple(values.names)
        self.spaces: dict[str, gymnasium.Space[Any]] = {
            name: gymnasium.spaces.Box(-BOUND, BOUND, np.shape(goal), np.float64)
            for name, goal in pair
        }

    def observe(self, now: Values) -> dict[str, Floats]:
        """Give both vectors, by name."""
        pair = zip(self.spaces, self._task.goals(now), strict=True)
        return {name: np.clip(goal, -BOUND, BOUND) for name, goal in pair}


def example(declaration: Declaration) -> Values:
    """Give every variable the value that it has when an episode begins by default."""
    static, state = beginning(declaration, None)
    known = {**static, **declaration.states(state), "action": np.zeros(9)}
    known[CONTROL_INDEX] = np.zeros((), dtype=np.int64)
    return declaration.model.solve(known)


@final
class GoalReward:
    """The part of the reward that goals alone decide.

    With ``weights="sparse"``, or where only ``fractional_success`` and ``success`` have weights,
    it is the reward of the step.

    Args:
        world: Whose task, weights and conventions hold.
    """

    def __init__(self, world: World) -> None:
        self._world = world

    def __call__(self, achieved: ArrayLike, desired: ArrayLike, info: Any = None) -> Any:
        """Compute the reward of having achieved one goal while another one was desired.

        Args:
            achieved: As in the observation, shape (..., n).
            desired: Shape (..., n).
            info: Not needed; learners give it.

        Returns:
            The weighted sum of the terms that goals alone decide, shape (...); times the control
            period under the conventions that say so.
        """
        have, want = np.asarray(achieved, dtype=float), np.asarray(desired, dtype=float)
        node: Any = self._world.model.declared("reward")
        weights = zip((parent.name for parent in node.parents), node.mechanism.weights, strict=True)
        total = np.zeros(np.broadcast_shapes(have.shape[:-1], want.shape[:-1]))
        for name, weight in weights:
            if name in TERMS:
                total = total + weight * TERMS[name](self._world.task, have, want)
        return reward_scale(self._world) * total


def reward_scale(world: World) -> float:
    """Give what rewards are multiplied by."""
    return world.control_period if world.conventions.reward_times_dt else 1.0
