"""What the variables of a task mean to a backend."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world._types import Integers as Places
from scm_world.geometry.hulls import Hull
from scm_world.geometry.numbers import njit, scalar
from scm_world.graph import NoiseKey
from scm_world.models import GoalRegion, Light, Model, ParameterKey, Scene, Structure
from scm_world.models.camera import Camera
from scm_world.models.scene import SURFACES, TOLERANCE, Overlap
from scm_world.variables import Box, Function, Integers, Measured, Parent, Variable
from scm_world.variables.reserved import CONTROL_INDEX


@dataclass(frozen=True, eq=False)
class Entity:
    """Something in the world: its variables, and their meaning to a backend.

    Attributes:
        name: Prefix of its variables.
        variables: Its declarations. A ``Measured`` variable without a mechanism is a state: its
            parents are those that act when something is set, and physics adds the others.
        kind: Its kind, such as ``"goal"``, where it can be taken away; else empty.
        hull: The shape of a block or goal that is not a box.
        shape: The shape of a goal without a hull: ``"box"`` or ``"sphere"``.
    """

    name: str
    variables: tuple[Variable, ...]
    kind: str = ""
    hull: Hull | None = None
    shape: str = "box"


@dataclass(frozen=True, slots=True)
class Held:
    """What states that the world keeps by itself are after a control step.

    Attributes:
        numbers: Their values, as far as they are known, shape (k,).
        samples: By a number of physics steps after which some are read: their places, and the
            shares of these values in those that they then have, shape (m,) each.
        read: Returns all of them, given a state of this control step.
    """

    numbers: Floats
    samples: Mapping[int, tuple[Places, Floats]]
    read: Callable[[Floats], Floats]

    def see(self, step: int, vector: Floats) -> None:
        """Read those that belong to the state after some physics steps."""
        if step in self.samples:
            places, shares = self.samples[step]
            found = self.read(vector)[places]
            self.numbers[places] = (1.0 - shares) * self.numbers[places] + shares * found


class Commands(ABC):
    """The conversion of an action into a command of the backend, where they differ.

    Attributes:
        noisy: Where the noise of a control step is in the command, by name.
        added: If all that happens is that normal noise is added: the variable that scales it, its
            stream, and its standard deviations where that is one, shape (n_commands,); else None.
    """

    noisy: Mapping[str, slice] = {}  # a constant
    added: tuple[str, str, Floats] | None = None

    def applies(self, values: Values) -> Any:
        """Return whether it is needed, given the values of all that physics does not move.

        Values of many worlds have a leading axis; then it may be one answer for each, shape (n,).
        """
        return True

    @abstractmethod
    def command(
        self, action: Floats, values: Values, vector: Floats, key: NoiseKey, substeps: int
    ) -> Floats:
        """Return the command of one control step.

        Args:
            action: All action variables, shape (n_actions,).
            values: Those of everything that physics does not move.
            vector: The state.
            key: Where in the noise this control step draws.
            substeps: How many physics steps the control step has.

        Returns:
            Shape (n_commands,), or (substeps, n_commands) if it changes within the control step. It
            is valid until the next call.
        """

    def held(
        self, action: Floats, values: Values, vector: Floats, key: NoiseKey, substeps: int
    ) -> Held | None:
        """Return what states that the world keeps by itself are after a control step.

        They are the last ones of the state; arguments are those of ``command``, before that step.
        None if there are no such states.
        """
        return None


def parts(commands: Floats, also: Iterable[int] = ()) -> Iterator[tuple[int, Floats]]:
    """Divide a control step where its commands change.

    Args:
        commands: Those of each physics step, shape (substeps, …).
        also: Physics steps before which it is divided, too.

    Yields:
        A number of physics steps, and the commands that are held in them, shape (…).
    """
    changes = (commands[1:] != commands[:-1]).any(axis=tuple(range(1, commands.ndim)))
    ends = {0, *(1 + np.flatnonzero(changes)).tolist(), *also, len(commands)}
    for first, last in pairwise(sorted(ends)):
        yield last - first, commands[first]


class Composition:
    """What the variables of a world mean to a backend: rows of the tables of its system.

    Args:
        system: A ``Model`` or a ``StepModel``.
        commands: What turns an action into a command; None where they are the same.

    Attributes:
        system: Its tables of parameters, states and bodies.
        commands: As above.
        entities: In the order of the observation.
        bodies: Names of the bodies that can come and go. Their variables begin with these names.
        kept_clear: The variables of places that draws must not put into bodies that never move;
            see ``obstructed``. Draws of them are repeated like those of bodies.
        solid: Whether no episode may begin with two bodies in one place.
        screened: The variables of which ``first_clear`` can tell that bodies lie in one another.
        structural: The variables whose values determine ``structure``.
    """

    system: Structure
    commands: Commands | None = None
    entities: tuple[Entity, ...] = ()
    bodies: tuple[str, ...] = ()
    kept_clear: frozenset[str] = frozenset()
    solid: bool = False
    screened: tuple[str, ...] = ()
    structural: frozenset[str] = frozenset()

    def __init__(self, system: Structure, commands: Commands | None = None) -> None:
        self.system, self.commands = system, commands

    def structure(self, values: Values) -> Structure:
        """Return what the backend has to compile; equal values give the same object."""
        return self.system

    def parameters(self) -> Mapping[str, ParameterKey]:
        """Map variables to the physical parameters that they set."""
        return {row.name: row.key for row in self.system.parameters}

    @cached_property
    def surfaces(self) -> frozenset[ParameterKey]:
        """The parameters that decide where the surfaces of bodies are."""
        return frozenset(row.key for row in self.system.parameters if row.key[1] in SURFACES)

    @cached_property
    def _meant(self) -> frozenset[tuple[int, int]]:
        """The shapes that lie in one another in the pose of the file: they are meant to."""
        from scm_world.backends.mujoco.overlaps import touching

        return touching(self.system.default_scene(), TOLERANCE)

    def _is_as_given(self, scene: Scene, tolerance: float | None) -> bool:
        """Return whether all is where it is in the file; not asked for any more once it was not."""
        if tolerance is not None or "_meant" in vars(self):
            return False
        default, there = self.system.default_scene(), scene.parameters
        same = all(np.array_equal(there[key], default.parameters[key]) for key in self.surfaces)
        return same and bool(scene.state == default.state)

    def overlaps(
        self, scene: Scene, tolerance: float | None = None, asked: Iterable[str] = ()
    ) -> tuple[Overlap, ...]:
        """List the bodies that lie deeper in one another than a tolerance.

        Not listed are shapes that do so in the pose of the file.

        Args:
            scene: With complete parameters.
            tolerance: How deep is too deep [m]; what the task allows if None.
            asked: The variables that an intervention is on.
        """
        if not self.system.bodies or self._is_as_given(scene, tolerance):
            return ()
        from scm_world.backends.mujoco.overlaps import overlaps

        return overlaps(scene, TOLERANCE if tolerance is None else tolerance, self._meant)

    def violated(self, scene: Scene) -> Iterable[tuple[str, str, float, str]]:
        """List the equality constraints that do not hold: kind, name, size and its unit."""
        if not self.system.bodies:
            return ()
        from scm_world.backends.mujoco.overlaps import violated

        return violated(scene)

    def first_clear(self, values: Values, limit: float) -> int:
        """Return the index of the first of n draws that does not obviously put bodies in one place.

        The values of ``screened`` have shape (n, k) each; bodies lie ``limit`` deep in one another
        already [m]. The result is n if all of them do so.
        """
        return 0

    def obstructed(self, scene: Scene, drawn: Collection[str]) -> tuple[Overlap, ...]:
        """List the places that draws of these variables put into something that never moves."""
        return ()

    def movers(self) -> tuple[str, ...]:
        """Name the bodies between which local graphs are; none if it has no such bodies."""
        return ()

    def touched(self) -> Mapping[str, tuple[str, ...]]:
        """Map each body, as contacts name it, to the states of its tree; none if it is fixed."""
        states = dict[int, list[str]]()
        for row in self.system.states if isinstance(self.system, Model) else ():
            for tree in row.trees:
                states.setdefault(tree, []).append(row.name)
        return {body.name: (*states.get(body.tree, ()),) for body in self.system.bodies}

    def shaped(self) -> Mapping[str, str]:
        """Map parameters to the body whose contacts they shape, as far as that is known."""
        if not isinstance(self.system, Model):
            return {}
        names = self.system.body_names
        return {row.name: names[row.body] for row in self.system.parameters if row.body >= 0}

    def looks(self, values: Values) -> tuple[tuple[GoalRegion, ...], Light]:
        """Describe all goals, and the light of pictures."""
        return (), Light()

    def cameras(self, values: Values) -> tuple[Camera, ...]:
        """Describe the cameras whose places are variables."""
        return ()


@njit(cache=True)
def remaining(control_index: Value, steps: float, seconds_per_step: float) -> float:
    """Compute the time left [s], never below zero."""
    return max(steps - scalar(control_index), 0.0) * seconds_per_step


def clock(steps: int, seconds_per_step: float) -> tuple[Measured, Measured]:
    """Declare how many control steps of the episode are over, and the time that is left [s]."""
    index = Measured(
        name=CONTROL_INDEX,
        dtype="integer",
        bounds=Integers(0, 10**9),
        parents=(Parent(CONTROL_INDEX, 1),),
        settable_state=True,
        default=0,
        doc="Control steps since the start of the episode.",
    )
    length = {"steps": float(steps), "seconds_per_step": seconds_per_step}
    left = Measured(
        name="time_left_for_task",
        unit="s",
        bounds=Box(0.0, steps * seconds_per_step),
        parents=(CONTROL_INDEX,),
        mechanism=Function(remaining, constants=length),
        doc="Time until the episode is cut off.",
    )
    return index, left
