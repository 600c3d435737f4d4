"""Scripted policies of the robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any, final

import numpy as np

from scm_world._types import Floats
from scm_world.errors import ActionError, UnknownOption
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.grasping import Feedback
from scm_world.tasks.trifinger.kinematics import forward, inverse

INWARD = ((0.33, 0.12, 0.0), (1.0, 0.02, 0.0))
ACROSS = ((0.25, 0.12, 0.0), (1.0, -0.11, 0.0))
"""Where a sweep is after shares of its way: distance from the middle, and above its level [m]."""


@final
class Sweep:
    """The fingertips sweep over the floor to its middle, and stay there.

    What lies in their way is pushed. It depends on nothing but the control step, so that it adds
    no cause and no noise to the episode.

    Args:
        across: Whether one of them goes through the middle to the other side, so that what it
            pushes comes to the wall, while the others stay where they are.
        steps: How many control steps the way takes.
        level: Height of the fingertips as they sweep [m].
    """

    def __init__(self, *, across: bool = False, steps: int = 14, level: float = 0.035) -> None:
        if not isinstance(steps, int) or steps < 1:
            raise UnknownOption("steps", steps, ("a whole number from 1",))
        self.steps = steps
        rest, height = np.array(hardware.REST), hardware.NOMINAL_HEIGHT
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

    def ahead(self, world: Any, first: int, count: int) -> Floats:
        """Return the actions of some control steps."""
        if world.action_mode == "joint_torques":
            raise ActionError("a sweep needs positions as actions, not", world.action_mode)
        rows = self._way if "effector" in world.action_mode else self._joints
        found: Floats = rows[np.minimum(np.arange(first, first + count), len(rows) - 1)]
        return found

    def __call__(self, world: Any) -> Floats:
        """Return the action of the present step."""
        action: Floats = self.ahead(world, world.index, 1)[0]
        return action


SCRIPTED: Mapping[str, Callable[[], Any]] = {
    "sweep": cache(Sweep),
    "across": cache(partial(Sweep, across=True)),
    "feedback": Feedback,
}
"""By name."""
