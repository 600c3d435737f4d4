"""A backend that is a function: the new state follows from parameters, state, action and noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Literal, final

import numpy as np

from scm_world._fingerprint import digest, fingerprint
from scm_world._types import ArrayLike, Floats, Integers, Value
from scm_world.backends.base import InMemory, Scenes, SeparateScenes
from scm_world.errors import EngineFailure, ModelError
from scm_world.models.model import Numbers, Readout
from scm_world.models.scene import (
    Difference,
    ParameterKey,
    Parameters,
    Scene,
    StateLayout,
    Structure,
)


@final
@dataclass(frozen=True)
class Quantity:
    """Something that a step function is given, or that it gives.

    Attributes:
        name: Name of the variable.
        shape: Of one value.
        default: One number, or one for each component.
        integer: Whether the function is given whole numbers (int64), and has to give such.
    """

    name: str
    shape: tuple[int, ...] = ()
    default: Numbers = 0.0
    integer: bool = False

    @property
    def key(self) -> ParameterKey:
        """How it is named among the parameters of a scene."""
        element, _, attribute = self.name.rpartition(".")
        return element, attribute

    @property
    def value(self) -> Floats:
        """The default, of the declared shape."""
        if np.ndim(self.default):
            return np.array(self.default, dtype=np.float64).reshape(self.shape)
        return np.full(self.shape, self.default, dtype=np.float64)


_KINDS = "parameters", "states", "actions", "noise"
"""What a step function is given, in this order."""


@final
@dataclass(frozen=True)
class StepModel(Structure):
    """A system whose physics is one function, ``step(parameters, state, action, noise)``.

    With the signature ``"dicts"`` the function is given four dicts of read-only values by name
    (NumPy scalars where the shape is ``()``), and gives a dict with the new value of every state.
    With ``"arrays"`` it is given four flat arrays of floats, in the order of declaration, and
    gives the new state as one: compiled functions take that. In both cases it must not change
    its arguments, must keep no memory from one call to the next, and must draw no random
    numbers of its own: steps 1, 2, 4, 8, … after a change are taken twice to find that out, and
    ``verify`` finds further dependences.

    A command is the action followed by the noise. Two models are equal if they have the same
    function and tables; it can be pickled if the function can.

    Attributes:
        name: Name of the system.
        function: The step.
        timestep: What one call of the function advances [s].
        parameters: What holds until it is set again.
        states: What the function moves, in the order of the state vector.
        actions: What a policy decides, in the order of the command.
        noise: Distributions of the noise of every step; it follows the actions in a command.
        vectorized: Whether the function takes many systems together: every value has a leading
            axis, and no row may depend on another one, to the last bit.
        signature: How the function is called.
    """

    name: str
    function: Callable[..., Any]
    timestep: float
    parameters: tuple[Quantity, ...]
    states: tuple[Quantity, ...]
    actions: tuple[Quantity, ...] = ()
    noise: tuple[Quantity, ...] = ()
    vectorized: bool = False
    signature: Literal["dicts", "arrays"] = "dicts"

    readouts: ClassVar[tuple[Readout, ...]] = ()

    @cached_property
    def digest(self) -> str:  # type: ignore[override] # it is computed where it is needed
        """Hash of the function and the tables."""
        return digest(fingerprint({"model": self}, libraries=False))

    @cached_property
    def _layouts(self) -> dict[str, StateLayout]:
        """Where each quantity stands among those of its kind."""
        found = {}
        for kind in _KINDS:
            rows: tuple[Quantity, ...] = getattr(self, kind)
            names, values = tuple(row.name for row in rows), [row.value.ravel() for row in rows]
            start = np.concatenate([*values, np.empty(0)]).tolist()
            found[kind] = StateLayout(names, tuple(value.size for value in values), tuple(start))
        return found

    @property
    def n_commands(self) -> int:
        """How many numbers a command has: those of the actions and those of the noise."""
        return self._layouts["actions"].size + self._layouts["noise"].size

    @cached_property
    def layout(self) -> StateLayout:
        """Where each state stands in the vector."""
        return self._layouts["states"]

    @cached_property
    def defaults(self) -> Parameters:
        """The default of every parameter, by key."""
        return {quantity.key: quantity.value for quantity in self.parameters}

    def advance(
        self, parameters: Floats, states: Floats, commands: Floats, *, twice: bool = False
    ) -> Floats:
        """Take one step in m systems; return the new states, shape (m, s), in a new array.

        Parameters are flat, in the order of declaration, shape (m, p). With ``twice`` the step is
        taken again, and must give the same.

        Raises:
            EngineFailure: The function raised an error, changed its arguments, gave something else
                than finite numbers of the declared names, shapes and kinds, or other numbers the
                second time.
        """
        if twice:
            first, again = (self.advance(parameters, states, commands) for _ in range(2))
            if failure := self._of_memory(first, again):
                raise failure
            return first
        if self.vectorized:
            return self._checked(self._call(parameters, states, commands), (len(states),))
        new = np.empty_like(states)
        for row in range(len(states)):
            given = parameters[row], states[row], commands[row]
            new[row] = self._checked(self._call(*given), ())
        return new

    def _call(self, parameters: Floats, states: Floats, commands: Floats) -> Any:
        split = self._layouts["actions"].size
        arrays = [parameters, states, commands[..., :split], commands[..., split:]]
        given: list[Any] = [np.array(array) for array in arrays]  # it may keep them
        if self.signature == "dicts":
            given = [self._named(kind, array) for kind, array in zip(_KINDS, given, strict=True)]
        try:
            result = self.function(*given)
        except Exception as error:
            advice = ""
            if isinstance(error, KeyError):
                names = {kind: self._layouts[kind].names for kind in _KINDS}
                known = (f"{kind} {', '.join(named)}" for kind, named in names.items() if named)
                advice = f"; it is given {'; '.join(known)}"
            elif "read-only" in str(error):
                advice = "; its arguments must not be changed: let it work on a copy"
            raise self._failure(f"raised {type(error).__name__}: {error}{advice}") from error
        if self.signature == "arrays":
            kinds = ("parameters", "state", "action", "noise")
            for kind, array, copy in zip(kinds, arrays, given, strict=True):
                if array.tobytes() != copy.tobytes():
                    changed = f"changed the {kind} it was given; let it work on a copy"
                    raise self._failure(changed)
        return result

    def _of_memory(self, first: Floats, again: Floats) -> EngineFailure | None:
        """Return why equal arguments gave other numbers the second time; None if they did not."""
        for name, where in self.layout.slices.items():
            if first[:, where].tobytes() != again[:, where].tobytes():
                return self._failure(
                    f"gives another {name!r} when it is called again with the same arguments: "
                    "it keeps a memory or draws random numbers of its own; declare what it "
                    "remembers as a state, and take random numbers from its argument noise"
                )
        return None

    def _failure(self, what: str, **data: object) -> EngineFailure:
        return EngineFailure(f"the step function of {self.name!r} {what}", "step", **data)

    def _named(self, kind: str, numbers: Floats) -> dict[str, Any]:
        """Name the parts of flat numbers, shape (..., size); they cannot be written."""
        numbers.flags.writeable = False
        lead, found, places = numbers.shape[:-1], dict[str, Any](), self._layouts[kind].slices
        for quantity in getattr(self, kind):
            where = places[quantity.name]
            if not lead and not quantity.shape:
                number = numbers[where.start]
                found[quantity.name] = np.int64(number) if quantity.integer else number
                continue
            part: Value = numbers[..., where].reshape(*lead, *quantity.shape)
            if quantity.integer:
                part = part.astype(np.int64)
                part.flags.writeable = False
            found[quantity.name] = part
        return found

    def _checked(self, result: ArrayLike, lead: tuple[int, ...]) -> Floats:
        """Put what the function gave into an array, shape (*lead, s), or refuse it."""
        places, problems = self.layout.slices, list[str]()
        new = np.empty((*lead, self.layout.size))
        given: list[tuple[str, Any, slice, tuple[int, ...]]] = []
        if self.signature == "arrays":
            given = [("the state", result, slice(None), new.shape)]
        elif not isinstance(result, Mapping):
            problems = [f"it must be a dict of the states by name: {result!r}"]
        else:
            problems = [f"{name!r} is missing" for name in places if name not in result]
            problems += [f"{name!r} is not a state" for name in result if name not in places]
            given = [
                (repr(q.name), result[q.name], places[q.name], (*lead, *q.shape))
                for q in (self.states if not problems else ())
            ]
        for name, numbers, where, shape in given:
            try:
                value = np.asarray(numbers)
            except ValueError:  # a ragged list
                value = np.asarray(None)
            if value.dtype.kind not in "biuf":
                problems.append(f"{name} must be numbers, not {value.dtype}")
            elif value.shape != shape:
                problems.append(f"{name} must have shape {shape}, not {value.shape}")
            else:
                new[..., where] = value.reshape(*lead, -1)
        finite = bool(problems) or np.isfinite(new).all()
        for q in self.states if not problems else ():
            part = new[..., places[q.name]]
            if not finite and not np.isfinite(part).all():
                problems.append(f"{q.name!r} has a number that is not finite")
            elif q.integer and ((np.rint(part) != part).any() or (np.abs(part) > 2.0**53).any()):
                whole = f"whole numbers of at most 2**53, not {part.tolist()}"
                problems.append(f"{q.name!r} must be {whole}")
        if problems:
            raise self._failure(f"gave no new state: {'; '.join(problems)}", diverged=not finite)
        return new


@final
class StepBatch(SeparateScenes):
    """Systems of step functions; a vectorised function is called once for all of them."""

    def __init__(self, backends: Sequence[StepFunction], threads: int = 1) -> None:
        super().__init__(backends, threads)
        self._compared: set[tuple[StepModel, int]] = set()

    def step(self, which: Integers, commands: Floats, substeps: int, into: Floats) -> None:
        """Hold commands for some steps.

        A vectorised function that fails is asked for each system alone, to find out which fail.
        A row of it must not depend on how many there are, which is asked once for every number.
        """
        failed: EngineFailure | None = None
        alone: list[int] = []
        together: dict[StepModel, list[int]] = {}
        for index in which.tolist():
            model = self._backends[index].structure
            (together.setdefault(model, []) if model.vectorized else alone).append(index)
        for model, rows in together.items():
            members = [self._backends[row] for row in rows]
            try:
                refused = self._together(model, members, commands[rows], substeps)
            except EngineFailure:
                alone += rows
                continue
            if refused:
                refused.row, refused.unmoved = rows[0], tuple(rows)
                failed = refused.after(failed)
            into[rows, : model.layout.size] = [member._state.vector for member in members]
        try:
            super().step(np.array(alone, dtype=np.int64), commands, substeps, into)
        except EngineFailure as error:
            failed = error.after(failed)
        if failed is not None:
            raise failed

    def _together(
        self, model: StepModel, members: list[StepFunction], commands: Floats, substeps: int
    ) -> EngineFailure | None:
        """Step systems of one vectorised function; return or raise why none was stepped."""
        commands = commands[:, : model.n_commands]
        states = np.array([member._state.vector for member in members])
        parameters = np.array([member.numbers for member in members])
        counted = [member._is_taken_twice() for member in members]
        if any(counted):  # not asked again for each system: its memory is of all of them by now
            twice = (model.advance(parameters, states, commands) for _ in range(2))
            if failure := model._of_memory(*twice):
                return failure
        if (model, len(members)) not in self._compared:
            among = model.advance(parameters, states, commands)
            rows = [slice(row, row + 1) for row in range(len(states))]
            alone = [model.advance(parameters[one], states[one], commands[one]) for one in rows]
            if np.concatenate(alone).tobytes() != among.tobytes():
                return model._failure(
                    f"gives a row other numbers among {len(states)} rows than alone; write it "
                    "without matrix products over the rows (np.einsum adds up each row by itself), "
                    "or set vectorized=False"
                )
            self._compared.add((model, len(members)))
        for _ in range(substeps):
            states = model.advance(parameters, states, commands)
        for member, vector in zip(members, states, strict=True):
            member._state.vector[:] = vector
        return None


@final
class StepFunction(InMemory):
    """Realises a ``StepModel``.

    Attributes:
        numbers: The parameters in the order of declaration, flat, shape (p,).
        taken: Number of steps since a scene was built, changed or restored.
    """

    name: ClassVar[str] = "step"
    batch: ClassVar[type[Scenes]] = StepBatch
    structure: StepModel
    numbers: Floats
    taken: int

    def build(self, scene: Scene) -> None:
        """Keep the scene, which has to be that of a step function."""
        if not isinstance(scene.structure, StepModel):
            kind = type(scene.structure).__name__
            only = "the backend 'step' realises step functions only (World)"
            raise ModelError([f"{only}, not a {kind}; choose 'mujoco' or 'bullet'"])
        super().build(scene)

    def apply(self, difference: Difference) -> None:
        """Change the structure, parameters and the state, which has to be finite."""
        state = difference.state
        if state is not None and not np.isfinite(state.vector).all():
            raise EngineFailure(f"a state must be finite, got {state!r}", self.name)
        super().apply(difference)

    def step(self, command: Floats, substeps: int) -> None:
        """Hold a command, the action and the noise, for some steps; see ``StepModel.advance``."""
        parameters, states, commands = self.numbers[None], self._state.vector[None], command[None]
        for _ in range(substeps):
            twice = self._is_taken_twice()
            states = self.structure.advance(parameters, states, commands, twice=twice)
        self._state.vector[:] = states[0]

    def _is_taken_twice(self) -> bool:
        """Count a step, and return whether it is taken twice: steps 1, 2, 4, 8, … are."""
        self.taken += 1
        return self.taken & (self.taken - 1) == 0

    def _keep(self, parameters: Parameters) -> None:
        self.taken = 0
        super()._keep(parameters)
        parts = [self._parameters[quantity.key].ravel() for quantity in self.structure.parameters]
        self.numbers = np.concatenate([*parts, np.empty(0)])
