"""How a world takes a control step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numpy.typing import NDArray

from scm_world._types import Floats, Value, Values
from scm_world.backends import Backend
from scm_world.entities import ACTUATOR_NOISE
from scm_world.graph import SCM, Moment
from scm_world.models.scene import ControlMode
from scm_world.scene import PhysicalState
from scm_world.scene.kinematics import inverse_kernel
from scm_world.world.commands import clipped, disturbed
from scm_world.world.declared import Declared
from scm_world.world.proposal import Instant
from scm_world.world.readouts import Readouts


class Stepped(Declared):
    """A world that can be advanced, by itself or together with others.

    Attributes:
        backend: The engine.
        moment: Says where in the noise a control step draws.
        evaluate: Computes some variables of the present.
    """

    backend: Backend
    moment: Callable[[int], Moment]
    evaluate: Callable[[tuple[str, ...]], dict[str, Value]]
    _require_episode: Callable[[], None]
    _now: dict[str, Value]
    _before: dict[str, Value]
    _state: PhysicalState
    _held: SCM
    _readouts: Readouts
    _instant: Instant | None
    _mode: ControlMode
    _started: bool
    _substeps: int
    _index: int
    _clock: NDArray[Any]
    _action_is_held: bool
    _noisy: bool
    _by_tips: bool
    _inputs: tuple[str, ...]
    _action_unit: str
    _command: Floats
    _reached: NDArray[Any]

    def advance(self, command: Floats) -> None:
        """Advance one control step with nine finite numbers in their range; see ``step``."""
        self._require_episode()
        command = self.decided(command)
        self._readouts.remember()
        self._now["action"] = command
        self.backend.step(self._mode, self.told(command), self._substeps)
        self.backend.read(self._state)
        self._goes_on(self._index + 1)

    @property
    def has_begun(self) -> bool:
        """Whether there is an episode."""
        return self._started

    @property
    def lagged(self) -> tuple[str, ...]:
        """What a step remembers of the one before."""
        return self._readouts.lagged

    def needed(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """List what has to be computed for some variables and for the memory, causes first."""
        return self._readouts.needed(names)

    @property
    def pace(self) -> tuple[ControlMode, int]:
        """What the engine is told besides: what a command means, and physics steps for it."""
        return self._mode, self._substeps

    @property
    def holds_action(self) -> bool:
        """Whether the action has a mechanism."""
        return self._action_is_held

    @property
    def is_noisy(self) -> bool:
        """Whether the actuators have noise."""
        return self._noisy

    def decided(self, command: Floats) -> Floats:
        """Give the action that is taken: the command, unless the action has a mechanism."""
        if not self._action_is_held:
            return command
        known = {**self._now, **self.evaluate(self._inputs), "action": command}
        where = self.moment(self._index)
        command = self._held.solve(known, moment=where, only=("action",))["action"]
        return clipped(command, *self.declaration.action_bounds, self._action_unit)

    def told(self, command: Floats) -> Floats:
        """Give what the engine is told in a step; it holds until the next call."""
        if self._noisy:
            command = self.disturbed(command, self._index)
        if self._by_tips:
            height = float(self._now["robot_height"])
            joints = self._state.joint_positions
            inverse_kernel(command, height, joints, self._command, self._reached)
            command = self._command
        return command

    def disturbed(self, command: Floats, index: int) -> Floats:
        """Add the noise that the actuators have in a control step of this episode."""
        noise = float(self._now[ACTUATOR_NOISE])
        return disturbed(command, *self.declaration.action_bounds, noise, self.moment(index))

    def _goes_on(self, index: int) -> None:
        """Be at another control step; where everything is has been written already."""
        self._index = index
        self._clock[...] = index
        self._readouts.moved()
        self._instant = None

    def arrive(self, vector: Floats, index: int, action: Floats, earlier: Values) -> None:
        """Take over what happened while the engine was stepped by a ``Batch``.

        Args:
            vector: Where everything is.
            index: The control step.
            action: The last action.
            earlier: Values of one control step ago.
        """
        self._state.vector[:] = vector
        self._now["action"] = action
        for name, value in earlier.items():
            self._before[name][...] = value
        self._goes_on(index)
