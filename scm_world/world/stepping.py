"""How a world takes a control step."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from scm_world._types import Floats, Value
from scm_world.backends import Backend
from scm_world.errors import EngineFailure
from scm_world.graph import SCM, Moment
from scm_world.models import ControlMode, State
from scm_world.world.commands import clipped
from scm_world.world.declared import Declared
from scm_world.world.proposal import Instant

_ROW = np.zeros(1, dtype=np.int64)  # the only one of a matrix of one row


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
    _matrix: Floats
    _clock: Value
    _state: State
    _counted: tuple[tuple[Value, Value], ...]
    _held: SCM
    _instant: Instant | None
    _started: bool
    _substeps: int
    _index: int
    _action: Floats
    _held_actions: tuple[str, ...]
    _translates: bool
    _inputs: tuple[str, ...]
    _fresh: bool = False  # what a step remembers has been computed
    _lost: str = ""

    def advance(self, command: Floats) -> None:
        """Advance one control step with finite numbers in their range; see ``step``."""
        self._require_episode()
        self._refuse_lost()
        command = self.decided(command)
        if not self._fresh:
            self._compute(())
        self.declaration.mechanisms.remember(self._matrix, _ROW)
        self._action[:] = command
        try:
            told = self.told(command, self._index)
            self.backend.step(self.composition.mode, told, self._substeps)
        except EngineFailure as error:
            left = self.declaration.empty_state()
            self.backend.read(left)
            if np.isfinite(left.vector).all():
                raise
            said = f"{error}; {self._largest()}" if self._state.vector.size else str(error)
            self._lost = f"the state was lost in control step {self._index}: {said}"
            raise EngineFailure(self._lost, self.backend.name) from error
        self.backend.read(self._state)
        self.arrive(self._index + 1)

    def _largest(self) -> str:
        """Name the state with the largest number, as it was before a step."""
        vector = self._state.vector
        worst = int(np.abs(vector).argmax())
        places = self.declaration.composition.slices().items()
        name = next((name for name, where in places if where.start <= worst < where.stop), "")
        return f"before that step, the largest number was {vector[worst]:.3g}, of {name}"

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

    def _compute(self, names: tuple[str, ...] | None = None) -> None:
        """Compute variables, and what a step remembers, into the present values; all if None."""
        mechanisms = self.declaration.mechanisms
        wanted = mechanisms.computed if names is None else names
        mechanisms.evaluate(wanted, self._matrix, _ROW)
        self._fresh = True
        self._count()

    def _forget(self) -> None:
        """Let the present stand in for the step before, where there is none."""
        self._compute(())
        self.declaration.mechanisms.remember(self._matrix, _ROW)

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

    def told(self, action: Floats, index: int) -> Floats:
        """Turn an action into a command, at a control step; it holds until the next call."""
        commands = self.composition.commands
        if commands is None or not self._translates:
            return action
        return commands.told(action, self._now, self._state.vector, self.moment(index))

    def arrive(self, index: int) -> None:
        """Be at the next control step; where everything is has been written already."""
        self._be_at(index)
        self._instant = None

    def _be_at(self, index: int) -> None:
        self._index = index
        self._clock[...] = index
        self._fresh = False
        self._count()

    def _count(self) -> None:
        """Take over what is a whole number; the other values are views of the row."""
        for value, view in self._counted:
            value[...] = view
