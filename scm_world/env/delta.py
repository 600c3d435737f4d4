"""Actions that are relative to where the robot is, or to the last command."""

from __future__ import annotations

from typing import Any, final

import numpy as np

from scm_world._arguments import one_of
from scm_world._types import Floats
from scm_world.env.vector import box
from scm_world.errors import UnknownOption
from scm_world.world import Simulation

PREFIX = "delta_"
JOINTS, TIPS = "joint_positions", "end_effector_positions"
COMMAND, MEASURED = "command", "measured"


def checked_mode(mode: Any, modes: tuple[str, ...]) -> str:
    """Check an action mode; None stands for the first mode of the task."""
    if mode is None:
        return modes[0]
    one_of("action_mode", mode, (*modes, *(PREFIX + one for one in modes)))
    return str(mode)


@final
class Delta:
    """Turns relative actions into absolute ones.

    What they are relative to is a function of the world alone, so that snapshots and
    counterfactuals hold: for joint positions the last target (the present joints at the start of
    an episode and after an intervention on them), for fingertips the present ones, for torques
    and the controls of a model the last ones.

    Args:
        world: That takes the actions.
        middle: What an absolute action of 0 stands for, shape (n,).
        half: What an absolute action of 1 adds, shape (n,).
        scale: Share of half of the range that the largest relative action stands for, in (0, 1].
        origin: ``"command"``: joint positions are relative to their last target; ``"measured"``:
            to where the joints are.

    Attributes:
        reads: The variable that actions are relative to; None if that is the last command.
        space: Of relative actions: by itself, half of the range to either side.
    """

    def __init__(
        self, world: Simulation, middle: Floats, half: Floats, *, scale: float, origin: str
    ) -> None:
        self._world, self._middle, self._half = world, middle, half
        self._low, self._high = (
            (world.action_low - middle) / half,
            (world.action_high - middle) / half,
        )
        if not (isinstance(scale, int | float) and 0.0 < scale <= 1.0):
            raise UnknownOption("delta_scale", scale, ("a number in (0, 1]",))
        one_of("delta_origin", origin, (COMMAND, MEASURED))
        # Normalized actions fill [-1, 1] at every scale; others keep their unit.
        normalized = bool(np.any(half != 1.0) or np.any(middle != 0.0))
        reach = (self._high - self._low) / 2.0
        self._gain, self._reach = (scale, reach) if normalized else (1.0, scale * reach)
        self.space = box(-self._reach, self._reach)
        mode = world.options.action_mode
        self.reads = TIPS if mode == TIPS else None if origin == COMMAND else mode
        if self.reads not in (None, TIPS, JOINTS):
            allowed = f"{COMMAND!r}, or action_mode={PREFIX + JOINTS!r}"
            raise UnknownOption(f"delta_origin of {PREFIX}{mode}", origin, (allowed,))

    def moved(self, action: Floats, offset: Floats) -> Floats:
        """Add what actions are relative to, shape (..., n) [SI units]; clip to the range."""
        relative = (offset - self._middle) / self._half
        step = self._gain * np.clip(action, -self._reach, self._reach)
        found: Floats = np.clip(step + relative, self._low, self._high)
        return found

    def toward(self, command: Floats) -> Floats:
        """Return the relative action that leads to a command [SI units], or as near as one can."""
        step = (command - self.offset()) / self._half
        found: Floats = np.clip(step / self._gain, -self._reach, self._reach)
        return found

    def offset(self) -> Floats:
        """Return what actions are relative to now, shape (n,) [SI units]."""
        world = self._world
        if self.reads is not None:
            measured: Floats = world.evaluate((self.reads,))[self.reads]
            return measured
        if world.options.action_mode == JOINTS and self.is_set():
            return world.row[JOINTS]
        return world.row.actions

    def is_set(self) -> bool:
        """Return whether nothing was commanded since the joints were put where they are."""
        base = self._world.base
        if base is None:  # a step was taken since
            return False
        joints = self._world.model.targets("joint_positions")
        return base.at_start or any(joint in base.pending for joint in joints)
