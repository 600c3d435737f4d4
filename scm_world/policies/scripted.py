"""Policies without a network: random, given, idle, and those that have a name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol, final, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import real_number, real_numbers, typed, whole_number
from scm_world._types import ArrayLike, Floats
from scm_world.errors import ActionError
from scm_world.policies.planning import CrossEntropy, action_range
from scm_world.tasks import TASKS
from scm_world.variables.distributions import word_of
from scm_world.world import CausalSystem
from scm_world.world.philox import uniforms

Policy = Callable[[Any], ArrayLike]
"""Looks at a world and gives an action, shape (n_actions,) in the units of its action mode."""


@runtime_checkable
class OpenLoopPolicy(Protocol):
    """A policy that ignores the state: all its actions are known beforehand.

    One that reads no world either may have a method ``together``, as ``Random`` has it.
    """

    def ahead(self, world: CausalSystem, first: int, count: int) -> Floats:
        """Return the actions of some control steps, shape (count, n_actions).

        Args:
            world: The present world. A policy asked for the first time may read it.
            first: The first control step.
            count: Number of control steps.
        """
        ...

    def __call__(self, world: CausalSystem) -> Floats:
        """Return the action of the present step."""
        action: Floats = self.ahead(world, world.index, 1)[0]
        return action


@typed
@final
@dataclass(frozen=True)
class Random(OpenLoopPolicy):
    """Actions drawn uniformly, from the noise of the episode.

    Two worlds with the same noise get the same actions, even if everything else differs.

    Attributes:
        share: Share of the range of actions, around its middle.
        every: For how many control steps an action is kept.
    """

    share: float = 1.0
    every: int = 1

    def __post_init__(self) -> None:
        whole_number("every", self.every, least=1)
        real_number("share", self.share)

    def ahead(self, world: CausalSystem, first: int, count: int) -> Floats:
        """Draw the actions of some control steps."""
        episode = np.array([[world.noise.key, world.episode]], dtype=np.uint64)
        found: Floats = self.together(world, episode, first, count)[0]
        return found

    def together(
        self, world: CausalSystem, episodes: NDArray[np.uint64], first: int, count: int
    ) -> Floats:
        """Draw the actions of several episodes, shape (n, count, n_actions).

        Args:
            world: One with these actions.
            episodes: The key of the noise and the number of each, shape (n, 2).
            first: The first control step.
            count: Number of control steps.
        """
        where = np.empty((len(episodes), count, 3), dtype=np.uint64)
        where[..., :2] = episodes[:, None]
        where[..., 2] = np.arange(first, first + count) // self.every
        word = np.array([word_of("policy")], dtype=np.uint64)
        n = world.compiled.n_actions
        drawn = uniforms(where.reshape(-1, 3), word, n).reshape(len(episodes), count, n)
        low, high = action_range(world)
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        half = half + 0.5 * world.compiled.whole  # each of them is as likely, once it is rounded
        actions: Floats = middle + self.share * half * (2.0 * drawn - 1.0)
        return actions


@final
class Sequence(OpenLoopPolicy):
    """Actions that are given: one for all steps, or one for each.

    Args:
        actions: Shape (n_actions,) or (steps, n_actions); after the last one it is kept.

    Raises:
        ActionError: They are no rows of finite numbers; where they are used: of another length.
    """

    def __init__(self, actions: ArrayLike) -> None:
        try:
            given = np.atleast_2d(real_numbers(actions))
        except (TypeError, ValueError):
            given = np.empty((0, 0))
        if given.ndim != 2 or not len(given):
            raise ActionError("actions have shape (n,) or (steps, n)", actions)
        if not np.isfinite(given).all():
            raise ActionError("actions must be finite", actions)
        self.actions: Floats = given

    def ahead(self, world: CausalSystem, first: int, count: int) -> Floats:
        """Return the actions of some control steps."""
        n = world.compiled.n_actions
        if self.actions.shape[1] != n:
            raise ActionError(
                f"actions have shape ({n},) or (steps, {n}), got {self.actions.shape}", self.actions
            )
        rows = np.arange(first, first + count)
        found: Floats = self.actions[np.minimum(rows, len(self.actions) - 1)]
        return found

    def together(self, world: CausalSystem, episodes: Any, first: int, count: int) -> Floats:
        """Return the same actions for several episodes; see ``Random.together``."""
        return np.repeat(self.ahead(world, first, count)[None], len(episodes), axis=0)


FREE: Mapping[str, Callable[[], Policy]] = {"random": Random}
"""Policies that any system can have."""

ANY: Mapping[str, Callable[[], Policy]] = {**FREE, "mpc": cache(CrossEntropy)}
"""Policies that any system with an engine can have."""

NAMED: Mapping[str, Callable[[], Policy]] = {
    **ANY,
    **{name: made for task in TASKS.values() for name, made in task.policies.items()},
}
"""Policies that have a name, those of the tasks of this package included."""


AnyPolicy = Policy | ArrayLike | None
"""A policy, or an argument in place of one; see ``as_policy``."""


def as_policy(given: AnyPolicy, world: CausalSystem | None = None) -> Policy:
    """Return a policy for one rollout.

    Args:
        given: A policy, actions, ``"random"``, ``"mpc"`` (plans), or None: the idle
            action of the first step. Of the block-building robot also
            ``"sweep"`` (to the middle), ``"across"`` (one finger), ``"feedback"`` (grasps blocks
            and brings them to their goals).
        world: In which it acts, if that is known already.

    Raises:
        ActionError: It is something else.
    """
    if given is None:
        return _Idle()
    if isinstance(given, str):
        known = NAMED
        if world is not None:
            known = {**(ANY if world.backend is not None else FREE), **world.policies}
        if given in known:
            return known[given]()
        raise ActionError(f"a policy is a function, actions, None, or one of {[*known]}", given)
    return given if callable(given) else Sequence(given)


class _Idle(OpenLoopPolicy):
    """The idle policy: the same action as in its first call."""

    def __init__(self) -> None:
        self._action: Floats | None = None

    def ahead(self, world: CausalSystem, first: int, count: int) -> Floats:
        """Return the action of the first step, again and again."""
        if self._action is None:
            self._action = world.idle()
        return np.tile(self._action, (count, 1))
