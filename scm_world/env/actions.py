"""What actions mean: normalized, relative to where the robot is, or commands as they are."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any, final

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from scm_world._arguments import finite_numbers, one_of, real_number
from scm_world._types import Floats
from scm_world.env.vector import box
from scm_world.errors import ActionError, UnknownOption
from scm_world.geometry.numbers import scale_and_clip
from scm_world.world import Simulation

PREFIX = "delta_"
JOINTS, TIPS = "joint_positions", "end_effector_positions"
COMMAND, MEASURED = "command", "measured"


@final
class Actions:
    """Turns the actions of an environment into commands of its world, and back.

    An action stands for ``middle + half * action``. What relative actions are added to is a
    function of the world alone, so that snapshots and counterfactuals hold: for joint positions
    the last target (the present joints at the start of an episode and after an intervention on
    them), for fingertips the present ones, for torques and the controls of a model the last ones.

    Args:
        world: That takes the commands.
        relative: Whether actions are relative.
        normalized: Whether actions fill [-1, 1], instead of SI units; a number without two bounds
            keeps its unit.
        scale: Share of half of the range that the largest relative action stands for, in (0, 1].
        origin: ``"command"``: joint positions are relative to their last target; ``"measured"``:
            to where the joints are.

    Attributes:
        relative: As above.
        converts: Whether ``absolute`` is more than the action itself.
        scale: What a world needs to know of them; see ``CompiledTask.clipped``.
        reads: The variable that actions are relative to; None if that is the last command.
        bounds: The least and the greatest number of each part of an action, shape (n,).
        space: Space of the actions; relative ones reach half of the range to either side. Where
            all are whole numbers it is ``Discrete`` or ``MultiDiscrete``, counted from 0.
    """

    def __init__(
        self, world: Simulation, *, relative: bool, normalized: bool, scale: float, origin: str
    ) -> None:
        self._world, self.relative = world, relative
        low, high = world.action_low, world.action_high
        bounded = normalized & np.isfinite(low) & np.isfinite(high) & (low < high)
        ends = np.where(bounded, low, -1.0), np.where(bounded, high, 1.0)
        self._middle, self._half = (ends[0] + ends[1]) / 2.0, (ends[1] - ends[0]) / 2.0
        self._low, self._high = ((end - self._middle) / self._half for end in (low, high))
        self.scale = np.stack([self._middle, self._half, low, high])
        far = np.full(low.size, np.inf)
        self._as_given = np.stack([np.full(low.size, -0.0), np.ones(low.size), -far, far])
        self.space: gymnasium.Space[Any] = box(self._low, self._high)
        self._is_choice = low.size > 0 and bool(world.compiled.whole.all())
        self.converts = relative or self._is_choice
        if self._is_choice:  # one of several, counted from 0
            self._middle, self._half = low, np.ones(low.size)
            self._low, self._high = np.zeros(low.size), high - low
            self.scale = np.stack([self._middle, self._half, low, high])
            counts = (self._high + 1.0).astype(np.int64)
            several = gymnasium.spaces.MultiDiscrete(counts)
            self.space = gymnasium.spaces.Discrete(int(counts[0])) if low.size == 1 else several
        low, high = self.ends
        self.bounds = np.ravel(low).astype(float), np.ravel(high).astype(float)
        self.reads: str | None = None
        self._gain, self._reach = 1.0, (self._high - self._low) / 2.0
        mode = world.options.action_mode
        if relative and self._is_choice:
            raise UnknownOption("action_mode", PREFIX + mode, (f"{mode}, of what is counted",))
        if not relative:
            if (scale, origin) != (1.0, COMMAND):
                given = {"delta_scale": scale, "delta_origin": origin}
                allowed = (f"none, or an action_mode that begins with {PREFIX!r}",)
                raise UnknownOption(f"relative actions of {mode}", given, allowed)
            return
        scale = real_number("delta_scale", scale)
        if not 0.0 < scale <= 1.0:
            raise UnknownOption("delta_scale", scale, ("a number in (0, 1]",))
        one_of("delta_origin", origin, (COMMAND, MEASURED))
        # Normalized actions fill [-1, 1] at every scale; others keep their unit.
        normalized = bool(np.any(self._half != 1.0) or np.any(self._middle != 0.0))
        if normalized:
            self._gain = scale
        else:
            self._reach = scale * self._reach
        self.space = box(-self._reach, self._reach)
        self.bounds = -self._reach, self._reach
        self.reads = TIPS if mode == TIPS else None if origin == COMMAND else mode
        if self.reads not in (None, TIPS, JOINTS):
            allowed = (f"{COMMAND!r}, or action_mode={PREFIX + JOINTS!r}",)
            raise UnknownOption(f"delta_origin of {PREFIX}{mode}", origin, allowed)

    @property
    def ends(self) -> tuple[Floats, Floats]:
        """The least and the greatest number of each part of an action."""
        space: Any = self.space
        if self._is_choice:
            return self._low.reshape(space.shape), self._high.reshape(space.shape)
        return space.low, space.high

    def in_space(self, actions: Any) -> Any:
        """Clip actions to the space, as they are executed, shape (..., n)."""
        return actions.clip(*self.bounds)

    def read(self, action: ArrayLike) -> Floats:
        """Return an action or a command as it is, checked, shape (n,)."""
        return self._world.compiled.clipped(action, self._as_given)

    def command(self, action: ArrayLike) -> Floats:
        """Return the command of an action, shape (n,) [SI units]."""
        return self._world.compiled.clipped(self.absolute(action), self.scale)

    def absolute(self, action: ArrayLike) -> ArrayLike:
        """Return the action that stands for ``middle + half * action`` now."""
        if self._is_choice:
            return np.ravel(self.chosen(action))
        return self.moved(self.read(action), self.offset()) if self.relative else action

    def chosen(self, actions: ArrayLike) -> ArrayLike:
        """Return actions of one world or of several as arrays; refuse a choice that there is not.

        Raises:
            ActionError: A choice is no whole number, or there are fewer.
        """
        if not self._is_choice:
            return actions
        given: Any = finite_numbers(actions)
        size = self._low.size
        if given is None or given.size % size or not given.size:
            raise ActionError(f"an action is in {self.space}, got {actions!r}", actions)
        rows: Floats = np.reshape(given, (-1, size))
        if (rows != np.rint(rows)).any() or (rows < 0.0).any() or (rows > self._high).any():
            raise ActionError(f"an action is in {self.space}, got {actions!r}", actions)
        return rows

    def commands(self, actions: Floats) -> Floats:
        """Return the commands of finite absolute actions, shape (m, n) [SI units]."""
        found = np.empty(actions.shape)
        scale_and_clip(actions.reshape(-1), self.scale, found.reshape(-1))
        return found

    def toward(self, command: ArrayLike) -> NDArray[Any]:
        """Return the action that leads to a command [SI units], or as near as one can."""
        origin = self.offset() if self.relative else self._middle
        step: Floats = (self.read(command) - origin) / self._half
        if self._is_choice:
            whole: Floats = np.rint(np.clip(step, self._low, self._high))
            return whole.astype(np.int64).reshape(self.space.shape or ())
        return np.clip(step / self._gain, -self._reach, self._reach) if self.relative else step

    def moved(self, action: Floats, offset: Floats) -> Floats:
        """Add the origin of relative actions, shape (..., n) [SI units]; clip to the range."""
        step = self._gain * action.clip(-self._reach, self._reach)
        relative = (offset - self._middle) / self._half
        return (step + relative).clip(self._low, self._high)

    def with_arrays(self, made: Callable[[Floats], Any]) -> Any:
        """Return the same with arrays of another library, for ``moved`` and ``scale``."""
        other = copy.copy(self)
        for name in ("_middle", "_half", "_low", "_high", "_reach", "scale", "bounds"):
            setattr(other, name, made(getattr(self, name)))
        return other

    def offset(self) -> Floats:
        """Return the present origin of relative actions, shape (n,) [SI units]."""
        world = self._world
        if self.reads is not None:
            return world.evaluate((self.reads,))[self.reads]
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
