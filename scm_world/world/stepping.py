"""How a world takes a control step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats, Value, Values
from scm_world.backends import Backend
from scm_world.errors import EngineFailure
from scm_world.graph import SCM, Moment
from scm_world.models import ControlMode, State
from scm_world.world.commands import clipped
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
    _state: State
    _counted: tuple[tuple[Value, Value], ...]
    _held: SCM
    _readouts: Readouts
    _instant: Instant | None
    _started: bool
    _substeps: int
    _index: int
    _clock: NDArray[Any]
    _action: Floats
    _held_actions: tuple[str, ...]
    _translates: bool
    _inputs: tuple[str, ...]
    _lost: str = ""

    def advance(self, command: Floats) -> None:
        """Advance one control step with finite numbers in their range; see ``step``."""
        self._require_episode()
        self._refuse_lost()
        command = self.decided(command)
        self._readouts.remember()
        self._act(command)
        try:
            self.backend.step(self.composition.mode, self.told(command), self._substeps)
        except EngineFailure as error:
            left = self.declaration.empty_state()
            self.backend.read(left)
            if not np.isfinite(left.vector).all():
                self._lost = f"the state was lost in control step {self._index}: {error}"
            raise
        self.backend.read(self._state)
        self._goes_on(self._index + 1)

    def _refuse_lost(self) -> None:
        """Refuse to go on from a state that the engine has lost.

        Raises:
            EngineFailure: It has; a reset or a snapshot goes on.
        """
        if self._lost:
            advice = "reset the world, or restore a snapshot"
            raise EngineFailure(f"{self._lost}; {advice}", self.backend.name)

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
        return self.composition.mode, self._substeps

    @property
    def holds_action(self) -> bool:
        """Whether an action has a mechanism, or a value of its own."""
        return bool(self._held_actions)

    @property
    def translates(self) -> bool:
        """Whether the engine is told something else than the action; see ``told``."""
        return self._translates

    def _act(self, command: Floats) -> None:
        """Remember the action; present values are views of it, which stay the same objects."""
        self._action[:] = command

    def decided(self, command: Floats) -> Floats:
        """Give the action that is taken: the command, where no action has a mechanism."""
        held = self._held_actions
        if not held:
            return command
        given = self.declaration.split(command)
        known = {**self._now, **self.evaluate(self._inputs), **given}
        solved = self._held.solve(known, moment=self.moment(self._index), only=held)
        command = command.copy()
        for name in held:
            command[self.declaration.actions[name]] = np.ravel(solved[name])
        return clipped(command, *self.declaration.action_bounds, self.declaration.action_unit)

    def told(self, action: Floats) -> Floats:
        """Give what the engine is told in a step; it holds until the next call."""
        return self.translated(action, self._state.vector, self._index)

    def translated(self, action: Floats, vector: Floats, index: int) -> Floats:
        """Turn an action into a command, at a state and a control step of this episode."""
        commands = self.composition.commands
        if commands is None or not self._translates:
            return action
        return commands.told(action, self._now, vector, self.moment(index))

    def _goes_on(self, index: int) -> None:
        """Be at another control step; where everything is has been written already."""
        self._index = index
        self._clock[...] = index
        self._count()
        self._readouts.moved()
        self._instant = None

    def _count(self) -> None:
        """Take over the states that are whole numbers; the others are views of the vector."""
        for value, view in self._counted:
            value[...] = view

    def arrive(self, vector: Floats, index: int, action: Floats, earlier: Values) -> None:
        """Take over what happened while the engine was stepped by a ``Batch``.

        Args:
            vector: Where everything is.
            index: The control step.
            action: The last action.
            earlier: Values of one control step ago.
        """
        self._state.vector[:] = vector
        self._act(action)
        for name, value in earlier.items():
            self._before[name][...] = value
        self._goes_on(index)
