"""Who acts in a rollout."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, final

import numpy as np

from scm_world._types import Floats
from scm_world.errors import ActionError, UnknownOption
from scm_world.queries.grasping import Grasp
from scm_world.queries.planning import CrossEntropy
from scm_world.queries.ranges import action_range
from scm_world.scene import trifinger
from scm_world.scene.kinematics import forward, inverse
from scm_world.tasks import Task, TriFingerTask
from scm_world.world import World
from scm_world.world.start import whole_number

Policy = Callable[[World], Any]
"""Looks at a world and gives an action, shape (n_actions,) in the units of its action mode."""


class Blind(ABC):
    """A policy that does not look at what happens: all its actions are known beforehand."""

    @abstractmethod
    def ahead(self, world: World, first: int, count: int) -> Floats:
        """Give the actions of some control steps.

        Args:
            world: As it is now. A policy asked for the first time may look at it.
            first: The first control step.
            count: How many.

        Returns:
            Shape (count, n_actions).
        """

    def __call__(self, world: World) -> Floats:
        """Give the action of the present step."""
        action: Floats = self.ahead(world, world.index, 1)[0]
        return action


@final
@dataclass(frozen=True)
class Random(Blind):
    """Actions drawn uniformly, from the noise of the episode.

    Two worlds with the same noise get the same actions, whatever else differs between them.

    Attributes:
        share: Of the range of actions, around its middle.
        every: For how many control steps an action is kept.
    """

    share: float = 1.0
    every: int = 1

    def __post_init__(self) -> None:
        whole_number("every", self.every, least=1)
        if not np.isfinite(self.share):
            raise UnknownOption("share", self.share, ("a finite number",))

    def ahead(self, world: World, first: int, count: int) -> Floats:
        """Draw the actions of some control steps."""
        n, noise, episode = world.declaration.n_actions, world.noise, world.episode
        drawn = np.empty((count, n))
        for row, index in enumerate(range(first, first + count)):
            step = index // self.every
            drawn[row] = noise.uniforms("policy", n=n, episode=episode, step=step)[0]
        low, high = action_range(world)
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        actions: Floats = middle + self.share * half * (2.0 * drawn - 1.0)
        return actions


@final
class Sequence(Blind):
    """Actions that are given: one for all steps, or one for each.

    Args:
        actions: Shape (n_actions,) or (steps, n_actions); after the last one it is kept.

    Raises:
        ActionError: They are no rows of finite numbers; where they are used: of another length.
    """

    def __init__(self, actions: Any) -> None:
        try:
            given = np.atleast_2d(np.asarray(actions, dtype=np.float64))
        except (TypeError, ValueError):
            given = np.empty((0, 0))
        if given.ndim != 2 or not len(given):
            raise ActionError("actions have shape (n,) or (steps, n)", actions)
        if not np.isfinite(given).all():
            raise ActionError("actions must be finite", actions)
        self.actions: Floats = given

    def ahead(self, world: World, first: int, count: int) -> Floats:
        """Give the actions of some control steps."""
        n = world.declaration.n_actions
        if self.actions.shape[1] != n:
            raise ActionError(
                f"actions have shape ({n},) or (steps, {n}), got {self.actions.shape}", self.actions
            )
        return _kept(self.actions, first, count)


def _kept(actions: Floats, first: int, count: int) -> Floats:
    """Take rows of actions; after the last one it is kept."""
    found: Floats = actions[np.minimum(np.arange(first, first + count), len(actions) - 1)]
    return found


INWARD = ((0.33, 0.12, 0.0), (1.0, 0.02, 0.0))
ACROSS = ((0.25, 0.12, 0.0), (1.0, -0.11, 0.0))
"""Where a sweep is after shares of its way: distance from the middle, and above its level [m]."""


@final
class Sweep(Blind):
    """The fingertips sweep over the floor to its middle, and stay there.

    What lies in their way is pushed. It depends on nothing but the control step, so that it adds
    no cause and no noise to what happens.

    Args:
        across: Whether one of them goes through the middle to the other side, so that what it
            pushes comes to the wall, while the others stay where they are.
        steps: How many control steps the way takes.
        level: Height of the fingertips as they sweep [m].
    """

    def __init__(self, *, across: bool = False, steps: int = 14, level: float = 0.035) -> None:
        self.steps = whole_number("steps", steps, least=1)
        rest, height = np.array(trifinger.REST), trifinger.NOMINAL_HEIGHT
        tips = forward(rest, height).reshape(3, 3)
        far, high = float(np.hypot(*tips[0, :2])), float(tips[0, 2])
        stations = ACROSS if across else INWARD
        when, radius, lift = np.array([(0.0, far, high - level), *stations]).T
        share = np.arange(1, steps + 1) / steps
        way = np.empty((steps, 3, 3))
        way[..., :2] = np.interp(share, when, radius)[:, None, None] * tips[:, :2] / far
        way[..., 2] = level + np.interp(share, when, lift)[:, None]
        if across:
            way[:, 1:] = tips[1:]
        self._way = way.reshape(steps, 9)
        self._joints = np.array([inverse(t, height, rest).joint_positions for t in self._way])

    def ahead(self, world: World, first: int, count: int) -> Floats:
        """Give the actions of some control steps."""
        if world.action_mode == "joint_torques":
            raise ActionError("a sweep needs positions as actions, not", world.action_mode)
        return _kept(self._way if "effector" in world.action_mode else self._joints, first, count)


NAMED: Mapping[str, Callable[[], Policy]] = {
    "random": Random,
    "sweep": cache(Sweep),
    "across": cache(partial(Sweep, across=True)),
    "grasp": Grasp,
    "hold": partial(Grasp, holds=True),
    "mpc": cache(CrossEntropy),
}
"""Policies that have a name."""

ANY = ("random", "mpc")
"""Those of them that any system can have; the others move the fingers of the robot."""


def as_policy(given: Any, task: Task | None = None) -> Policy:
    """Turn what a user gives into a policy for one rollout.

    Args:
        given: A policy, actions, ``"random"``, ``"mpc"`` (plans), or None: the action that lets
            the system be, as it was in the first step. Of the block-building robot also
            ``"sweep"`` (to the middle), ``"across"`` (one finger), ``"grasp"`` (blocks, to their
            goals), ``"hold"`` (likewise, but the last block is not let go of).
        task: In which it acts, if that is known already.

    Raises:
        ActionError: It is none of these.
    """
    if given is None:
        return _Idle()
    if isinstance(given, str):
        known = [*NAMED] if task is None or isinstance(task, TriFingerTask) else [*ANY]
        if given in known:
            return NAMED[given]()
        raise ActionError(f"a policy is a function, actions, None, or one of {known}", given)
    return given if callable(given) else Sequence(given)


class _Idle(Blind):
    """Lets the system be: the same action as when it was asked for the first time."""

    def __init__(self) -> None:
        self._action: Floats | None = None

    def ahead(self, world: World, first: int, count: int) -> Floats:
        """Give the action of the first step, again and again."""
        if self._action is None:
            self._action = world.task.idle(world)
        return np.tile(self._action, (count, 1))
