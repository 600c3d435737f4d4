"""One physics client of the engine, and what is particular to the robot in it."""

from __future__ import annotations

import math
import operator
import weakref
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import Any, ClassVar

import numpy as np

from scm_world._types import Floats
from scm_world.backends.base import ContactPoint
from scm_world.backends.bullet.client import Instant, Values
from scm_world.errors import EngineFailure
from scm_world.models.scene import ControlMode, ParameterKey, State

SOLVER_ITERATIONS = 50  # with 20, towers spike at 40 mm/s
TOLERANCE = 1e-6  # how far a state that was set may read back from what was asked
UNIT = 1e-12  # a quaternion whose squared norm is this near to 1 is taken as it is


class Client(ABC):
    """A physics client, and what is known about it without asking.

    There is one subclass for each kind of structure. It says which parameters there are, makes
    the bodies, sets and reads them, and steps. Everything else is here.

    Attributes:
        modes: What a command can mean.
        signed: Whether the quaternions of a state that is set have a w that is not negative.
        engine: The module ``pybullet``.
        handle: The number of the client; None once it is closed.
        applied: The value of each parameter that is in force.
        generation: Counts the canonical states; a saved state is exact within one of them.
    """

    modes: ClassVar[tuple[ControlMode, ...]]
    signed: ClassVar[bool] = False

    def __init__(self, engine: Any) -> None:
        self.engine = engine
        self.handle = engine.connect(engine.DIRECT)
        if self.handle < 0:
            raise EngineFailure("Bullet has no physics client left; close some backends", "bullet")
        self.applied: Values = {}
        self.generation = 0
        self._untouched: list[float] | None = None
        self._rotations: Sequence[int] = ()  # where quaternions begin in the state
        self._reported: Sequence[int] = ()  # places of the numbers that cannot be set
        self._saved: dict[int, int] = {}  # ticket to the engine's number, which it uses again
        self._tickets = 0
        self._doomed: list[int] = []
        self._close = weakref.finalize(self, _disconnect, engine, self.handle)

    # --- what a structure of this kind is -------------------------------------------------------

    @staticmethod
    @abstractmethod
    def keys(structure: Any) -> Iterable[ParameterKey]:
        """List every parameter of a structure, in the order in which they are set."""

    @staticmethod  # noqa: B027 # most can honour all
    def check(structure: Any, parameters: Values) -> None:
        """Say what the engine cannot honour, before anything is made.

        Raises:
            ModelError: Something in the structure.
            NotIntervenable: A parameter that is not as in the structure.
        """

    @staticmethod
    @abstractmethod
    def heavy(structure: Any) -> Iterable[ParameterKey]:
        """List the parameters that need new bodies, or new contacts."""

    @staticmethod
    @abstractmethod
    def rotations(structure: Any) -> Sequence[int]:
        """List where in the state the quaternions (x, y, z, w) begin."""

    @classmethod
    def settle(cls, structure: Any, given: State) -> list[float]:
        """Turn a state into plain numbers: unit quaternions, and 0 for what cannot be set.

        Raises:
            ValueError: It is a state of another structure.
            EngineFailure: A number is not finite.
        """
        numbers: list[float] = given.vector.tolist()
        if len(numbers) != structure.layout.size:
            raise ValueError(f"expected a state of {structure.layout.size} numbers, got {given!r}")
        if not math.isfinite(sum(numbers)):
            raise EngineFailure(f"a state must be finite, got {given!r}", "bullet")
        for name in structure.layout.reported:
            where = structure.layout.slices[name]
            numbers[where] = [0.0] * (where.stop - where.start)
        for start in cls.rotations(structure):
            turn = numbers[start : start + 4]
            square = sum(part * part for part in turn)
            if abs(square - 1.0) >= UNIT and square != 0.0:
                scale = math.sqrt(square)
                turn = numbers[start : start + 4] = [part / scale for part in turn]
            if cls.signed and turn[3] < 0.0:
                numbers[start : start + 4] = [-part for part in turn]
        return numbers

    # --- what is done in the engine -------------------------------------------------------------

    def furnish(self) -> None:
        """Add what stands in every scene, and set how the engine solves for contacts."""
        self.engine.setPhysicsEngineParameter(
            numSolverIterations=SOLVER_ITERATIONS,
            # An early end, decided for all bodies together, would let bodies act on each other
            # without touching.
            solverResidualThreshold=0.0,
            deterministicOverlappingPairs=1,
            physicsClientId=self.handle,
        )

    @abstractmethod
    def construct(self, structure: Any, parameters: Values) -> None:
        """Make sure that the bodies are there, with their shapes.

        What is made again has no parameters in ``applied``.
        """

    @abstractmethod
    def pose(self, parameters: Values, state: list[float]) -> None:
        """Put all that moves in its place, and make the engine forget what touched what."""

    def write(self, key: ParameterKey, value: Any) -> None:
        """Set one parameter of live bodies."""
        raise NotImplementedError

    def written(self, keys: Iterable[ParameterKey]) -> None:
        """Do what follows from parameters that were set: ``applied`` has them."""
        raise NotImplementedError

    @abstractmethod
    def parameter(self, key: ParameterKey) -> Floats:
        """Ask the engine for a parameter, in the units of the scene."""

    @abstractmethod
    def carrier(self, body: str) -> tuple[int, int]:
        """Give multibody and link that carry the mass of a body.

        Raises:
            UnknownOption: There is no such body.
        """

    @abstractmethod
    def advance(self, mode: ControlMode, command: Sequence[float], substeps: int) -> list[float]:
        """Hold a command for some physics steps, and return the numbers that cannot be set."""

    @abstractmethod
    def ask(self) -> list[float]:
        """Ask the engine for the state, with 0 for what cannot be set."""

    @abstractmethod
    def owner(self, multibody: int, link: int) -> str:
        """Name the body that a shape of the engine belongs to."""

    # --- the same for all -----------------------------------------------------------------------

    def contacts(self) -> tuple[ContactPoint, ...]:
        """List the points of the last physics step that touch or press.

        The engine also keeps points of bodies that only came near; they are left out.
        """
        return tuple(
            ContactPoint(
                bodies=(self.owner(point[1], point[3]), self.owner(point[2], point[4])),
                position=(np.array(point[5]) + np.array(point[6])) / 2,
                normal=-np.array(point[7]),  # the engine's points to the first body
                depth=-point[8],
                force=point[9],
            )
            for point in self.engine.getContactPoints(physicsClientId=self.handle)
            if point[8] <= 0.0 or point[9] > 0.0
        )

    def inertia(self, body: str) -> Floats:
        """Ask the engine for principal moments of inertia, shape (3,) [kg m²]."""
        info = self.engine.getDynamicsInfo(*self.carrier(body), physicsClientId=self.handle)
        return np.array(info[2])

    def remarks(self, before: Values) -> tuple[str, ...]:
        """Say which parameters were changed without an effect; see ``Backend.remarks``."""
        return ()

    def parameters(self, keys: Iterable[ParameterKey]) -> dict[ParameterKey, Floats]:
        """Ask the engine for parameters."""
        return {key: self.parameter(key) for key in keys}

    def gravity(self) -> Floats:
        """Ask the engine for gravity, shape (3,) [m/s²]."""
        physics = self.engine.getPhysicsEngineParameters(physicsClientId=self.handle)
        return np.array([physics[f"gravityAcceleration{axis}"] for axis in "XYZ"])

    def close(self) -> None:
        """Disconnect. Closing twice is harmless."""
        self._close()
        self.handle = None

    def canonicalize(self, instant: Instant) -> None:
        """Build the one world with these parameters and this state, independently of the past.

        Bodies stay where all their shapes stay; all else that depends on the past, the contact
        caches, is cleared by entering the collision objects again, always in one order.
        """
        self.generation += 1
        self._doomed.extend(self._saved)
        self._bury()
        structure, parameters = instant.structure, instant.parameters
        self._rotations = self.rotations(structure)
        self._reported = np.flatnonzero(~structure.layout.can_be_set).tolist()
        self.construct(structure, parameters)
        self.pose(parameters, instant.state)
        self.applied.update((key, parameters[key]) for key in self.heavy(structure))
        self.edit(parameters)
        self._check(instant.state)
        self._untouched = instant.state

    def edit(self, parameters: Values) -> None:
        """Change parameters that need no new bodies. What is in force already is left alone."""
        others = []
        for key, value in parameters.items():
            if self.applied.get(key) != value:
                self.applied.pop(key, None)  # unknown, should the engine fail
                self.write(key, value)
                self.applied[key] = value
                others.append(key)
        if others:
            self.written(others)

    def step(self, mode: ControlMode, command: Sequence[float], substeps: int) -> list[float]:
        """Hold a command for some physics steps; see ``advance``."""
        self._untouched = None
        return self.advance(mode, command, substeps)

    def read(self, reported: list[float]) -> list[float]:
        """Read the present state; the numbers that cannot be set are given.

        A state that was set and not stepped yet reads as it was set; ``canonicalize`` has made
        sure that the engine agrees up to rounding.
        """
        state = self.ask() if self._untouched is None else list(self._untouched)
        for place, value in zip(self._reported, reported, strict=True):
            state[place] = value
        return state

    def _check(self, state: list[float]) -> None:
        """Make sure that the engine took the state, up to rounding and the sign of a quaternion.

        Raises:
            EngineFailure: It did not.
        """
        actual = self.ask()
        for start in self._rotations:
            turn, wanted = actual[start : start + 4], state[start : start + 4]
            if sum(map(operator.mul, turn, wanted)) < 0.0:
                actual[start : start + 4] = [-part for part in turn]
        if any(
            not abs(there - here) <= TOLERANCE * (1.0 + abs(here))
            for here, there in zip(state, actual, strict=True)
        ):
            raise EngineFailure("Bullet did not take the state that was set", "bullet")

    def save(self) -> int:
        """Keep the engine's own state in this process and return a ticket for it."""
        self._bury()
        self._tickets += 1
        self._saved[self._tickets] = self.engine.saveState(physicsClientId=self.handle)
        return self._tickets

    def load(self, ticket: int) -> None:
        """Go back to a state saved in this generation. Parameters are not part of it."""
        self.engine.restoreState(stateId=self._saved[ticket], physicsClientId=self.handle)
        self._untouched = None

    def forget(self, ticket: int) -> None:
        """Free a saved state, at the next quiet moment: this may run amid an engine call."""
        self._doomed.append(ticket)

    def _bury(self) -> None:
        while self._doomed:
            number = self._saved.pop(self._doomed.pop(), None)
            if number is not None:
                self.engine.removeState(number, physicsClientId=self.handle)


def _disconnect(engine: Any, handle: int) -> None:
    with suppress(engine.error):
        engine.disconnect(physicsClientId=handle)
