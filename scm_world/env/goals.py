"""What is achieved and what is desired, for learners that ask."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, final

import gymnasium
import numpy as np
from numpy.typing import ArrayLike

from scm_world._types import Floats
from scm_world.env.bounds import WIDE
from scm_world.errors import UnknownOption
from scm_world.tasks import Task
from scm_world.tasks.rewards import FRACTION, SUCCESS
from scm_world.variables import Linear
from scm_world.world import World
from scm_world.world.compiled_task import CompiledTask
from scm_world.world.mechanisms import places

BOUND = 10.0
"""Goals that saturate are positions [m], sizes [m] and unit quaternions; beyond they saturate."""

TERMS: dict[str, Callable[[Task, Floats, Floats], Any]] = {
    FRACTION: lambda task, have, want: task.fraction(have, want),
    SUCCESS: lambda task, have, want: task.fulfilled(task.fraction(have, want)),
    "reach_error": lambda task, have, want: np.abs(have - want).mean(axis=-1),
}
"""The reward terms that goals alone decide."""


@final
class Goals:
    """The two goal vectors of a structure.

    Args:
        declaration: Of the structure.

    Attributes:
        names: The variables that have to be computed.
        bound: Numbers beyond it saturate in observations.
        spaces: Of ``achieved_goal`` and of ``desired_goal``: 64-bit floats of their true shapes,
            so that a reward that is computed from them is exact.
    """

    def __init__(self, declaration: CompiledTask) -> None:
        sides = declaration.task.goal_names()
        self.names = (*sides[0], *sides[1])
        where = declaration.mechanisms.where
        self._sides = tuple(places(where[name] for name in side) for side in sides)
        self.bound = BOUND if declaration.task.saturates else WIDE
        self.spaces: dict[str, gymnasium.Space[Any]] = {
            name: gymnasium.spaces.Box(-self.bound, self.bound, (side.size,), np.float64)
            for name, side in zip(("achieved_goal", "desired_goal"), self._sides, strict=True)
        }

    def read(self, world: World) -> tuple[Floats, Floats]:
        """Give what is achieved and what is desired."""
        row, (achieved, desired) = world.numbers[0], self._sides
        return row.take(achieved), row.take(desired)

    def observe(self, world: World) -> dict[str, Floats]:
        """Give both vectors, by name."""
        pair = zip(self.spaces, self.read(world), strict=True)
        return {name: np.clip(goal, -self.bound, self.bound) for name, goal in pair}


@final
class GoalReward:
    """The part of the reward that goals alone decide.

    With ``weights="sparse"``, or where only ``fractional_success`` and ``success`` have weights,
    it is the reward of the step. Else the first call warns: goals do not decide dense terms.

    Args:
        world: Whose task, weights and conventions hold.

    Raises:
        UnknownOption: The reward is no weighted sum of terms.
    """

    def __init__(self, world: World) -> None:
        reward: Any = world.model.declared("reward")
        if not isinstance(reward.mechanism, Linear):
            allowed = ("False", "a reward that is Linear in terms: Measured(mechanism=Linear(…))")
            raise UnknownOption("goal_env", True, allowed)
        self._world = world
        self._warned = False

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
            if name not in TERMS:
                self._warn(name)
            else:
                total = total + weight * TERMS[name](self._world.task, have, want)
        return reward_scale(self._world) * total

    def _warn(self, term: str) -> None:
        if not self._warned:
            self._warned = True
            gymnasium.logger.warn(
                f"compute_reward leaves out {term!r} and every other dense term, which the rewards "
                "of steps contain; make the environment with task_options={'weights': 'sparse'}"
            )


def reward_scale(world: World) -> float:
    """Give what rewards are multiplied by."""
    return world.control_period if world.conventions.reward_times_dt else 1.0
