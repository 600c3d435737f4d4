"""Scripted policies of the robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import TYPE_CHECKING, Any, final

import numpy as np

from scm_world._types import Floats
from scm_world.errors import ActionError
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.grasping import Feedback
from scm_world.tasks.trifinger.kinematics import forward, inverse

if TYPE_CHECKING:
    from scm_world.tasks.base import Simulation

INWARD, ACROSS = ((0.33, 0.12), (1.0, 0.02)), ((0.25, 0.12), (1.0, -0.11))
"""How far a sweep is from the middle [m] after shares of its way, on its level."""

STEPS = 14  # control steps that the way takes
LEVEL = 0.035  # [m] height of the fingertips as they sweep


@final
class Sweep:
    """The fingertips sweep over the floor to its middle, and stay there.

    What lies in their way is pushed. It depends on nothing but the control step, so that it adds
    no cause and no noise to the episode.

    Args:
        across: Whether one of them goes through the middle to the other side, so that a block
            that it pushes comes to the wall, while the others stay where they are.
    """

    def __init__(self, *, across: bool = False) -> None:
        rest, height = np.array(hardware.REST), hardware.NOMINAL_HEIGHT
        tips = forward(rest, height).reshape(3, 3)
        far, high = float(np.hypot(*tips[0, :2])), float(tips[0, 2])
        when, radius = np.array([(0.0, far), *(ACROSS if across else INWARD)]).T
        share = np.arange(1, STEPS + 1) / STEPS
        way = np.empty((STEPS, 3, 3))
        way[..., :2] = np.interp(share, when, radius)[:, None, None] * tips[:, :2] / far
        way[..., 2] = LEVEL + np.interp(share, when, (high - LEVEL, 0.0, 0.0))[:, None]
        if across:
            way[:, 1:] = tips[1:]
        self._way = way.reshape(STEPS, 9)
        self._joints = np.array([inverse(t, height, rest).joint_positions for t in self._way])

    def ahead(self, world: Simulation, first: int, count: int) -> Floats:
        """Return the actions of some control steps."""
        if world.options.action_mode == "joint_torques":
            raise ActionError("a sweep needs positions as actions, not", world.options.action_mode)
        rows = self._way if "effector" in world.options.action_mode else self._joints
        return rows[np.minimum(np.arange(first, first + count), len(rows) - 1)]

    def together(self, world: Simulation, episodes: Any, first: int, count: int) -> Floats:
        """Return the same actions for several episodes; see ``OpenLoopPolicy``."""
        return np.repeat(self.ahead(world, first, count)[None], len(episodes), axis=0)

    def __call__(self, world: Simulation) -> Floats:
        """Return the action of the present step."""
        action: Floats = self.ahead(world, world.index, 1)[0]
        return action


SCRIPTED: Mapping[str, Callable[[], Any]] = {
    "sweep": cache(Sweep),
    "across": cache(partial(Sweep, across=True)),
    "feedback": Feedback,
}
"""By name."""
