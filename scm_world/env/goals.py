"""What is achieved and what is desired, for learners that ask."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, final

import gymnasium
import numpy as np
from numpy.typing import ArrayLike

from scm_world._types import Floats, Values
from scm_world.env.bounds import WIDE
from scm_world.errors import UnknownOption
from scm_world.geometry.direct import direct
from scm_world.geometry.gather import gather_copied, places
from scm_world.tasks import Task, TriFingerTask
from scm_world.tasks.rewards import FRACTION, SUCCESS
from scm_world.variables import Linear
from scm_world.world import World
from scm_world.world.declaration import Declaration

BOUND = 10.0
"""Goals of the robot are positions [m], sizes [m] and unit quaternions; beyond they saturate."""

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

    def __init__(self, declaration: Declaration) -> None:
        sides = declaration.task.goal_names()
        self.names = (*sides[0], *sides[1])
        self._both = Collected(declaration, self.names)
        self._middle = Collected(declaration, sides[0]).size
        sizes = (self._middle, self._both.size - self._middle)
        self.bound = BOUND if isinstance(declaration.task, TriFingerTask) else WIDE
        self.spaces: dict[str, gymnasium.Space[Any]] = {
            name: gymnasium.spaces.Box(-self.bound, self.bound, (size,), np.float64)
            for name, size in zip(("achieved_goal", "desired_goal"), sizes, strict=True)
        }

    def read(self, world: World, now: Values) -> tuple[Floats, Floats]:
        """Give what is achieved and what is desired."""
        both, middle = self._both.read(world, now), self._middle
        return both[:middle], both[middle:]

    def observe(self, world: World, now: Values) -> dict[str, Floats]:
        """Give both vectors, by name."""
        pair = zip(self.spaces, self.read(world, now), strict=True)
        return {name: np.clip(goal, -self.bound, self.bound) for name, goal in pair}


@final
class Collected:
    """The numbers of some variables, one after another.

    Args:
        declaration: Of the structure.
        names: The variables.

    Attributes:
        size: How many numbers there are.
    """

    def __init__(self, declaration: Declaration, names: tuple[str, ...]) -> None:
        sizes = [int(np.prod(declaration.model.declared(name).shape)) for name in names]
        ends = np.cumsum(sizes).tolist()
        where = [(n, slice(e - s, e)) for n, e, s in zip(names, ends, sizes, strict=True)]
        self.size = ends[-1] if ends else 0
        still, states = frozenset(declaration.static_names), declaration.slices
        self._still = [(n, place) for n, place in where if n in still]
        self._computed = [(n, at) for n, at in where if n not in states and n not in still]
        self._numbers = np.empty(self.size)
        sources = places(states[n] for n, _ in where if n in states)
        self._moving = (sources, places(at for n, at in where if n in states), self._numbers)
        self._copy = direct(gather_copied, np.empty(0), *self._moving, self._numbers)
        self._version = -1

    def read(self, world: World, now: Values) -> Floats:
        """Copy the present numbers, shape (n,)."""
        if self._version != world.version:
            self._version = world.version
            for name, place in self._still:
                self._numbers[place] = np.ravel(now[name])
        for name, place in self._computed:
            self._numbers[place] = np.ravel(now[name])
        found = np.empty(self.size)
        self._copy(world.current()[1].vector, *self._moving, found)
        return found


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
