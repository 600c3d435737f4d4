"""Actions that are relative to where the robot is, or to what it was told last."""

from __future__ import annotations

from typing import final

import gymnasium
import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.entities import ACTIONS
from scm_world.env.vector import box
from scm_world.world import World

PREFIX = "delta_"
TIPS = "end_effector_positions"
MODES = (*ACTIONS, *(PREFIX + mode for mode in ACTIONS))
"""What an environment calls its actions."""


@final
class Delta:
    """Turns relative actions into absolute ones.

    What they are relative to is a function of the world alone, so that snapshots and
    counterfactuals hold: for joint positions the last target (the present joints at the start of
    an episode and after an intervention on them), for torques the last torques, for fingertips
    the present ones.

    Args:
        world: That takes the actions.
        middle: What an absolute action of 0 stands for, shape (9,).
        half: What an action of 1 adds, shape (9,).
    """

    def __init__(self, world: World, middle: Floats, half: Floats) -> None:
        self._world, self._middle, self._half = world, middle, half
        low, high = world.action_low, world.action_high
        self._low, self._high = (low - middle) / half, (high - middle) / half
        self._version = self._fresh = -1

    def space(self) -> gymnasium.Space[NDArray[np.float32]]:
        """Give the space of relative actions: half of the range to either side."""
        reach = (self._high - self._low) / 2.0
        return box(-reach, reach)

    def absolute(self, action: Floats) -> Floats:
        """Add what the action is relative to; what leaves the range of actions is clipped.

        Args:
            action: Shape (9,), in the units of the environment.
        """
        return self.moved(action, self._offset())

    def moved(self, action: Floats, offset: Floats) -> Floats:
        """Add what actions are relative to, shape (..., 9) [SI units]; clip to the range."""
        relative = (offset - self._middle) / self._half
        found: Floats = np.clip(action + relative, self._low, self._high)
        return found

    def _offset(self) -> Floats:
        world = self._world
        if world.action_mode == TIPS:
            tips: Floats = world.evaluate((TIPS,))[TIPS]
            return tips
        now, state = world.current()
        if world.action_mode == "joint_positions" and self.is_set():
            return state.joint_positions
        last: Floats = now["action"]
        return last

    def is_set(self) -> bool:
        """Tell whether nothing was commanded since the joints were put where they are."""
        world = self._world
        if world.version != self._version:
            self._version = world.version
            instant = world.snapshot().instant
            set_now = instant and (instant.at_start or "joint_positions" in instant.requests)
            self._fresh = world.index if set_now else -1
        return self._fresh == world.index
