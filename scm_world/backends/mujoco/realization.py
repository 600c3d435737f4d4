"""A model as MuJoCo realizes it: compiled, with parameters and a state."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable
from functools import cached_property, partial
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.backends.mujoco import fields, reading
from scm_world.backends.mujoco.contacts import Touches, touches
from scm_world.backends.mujoco.scratch import forget, scratch, silent
from scm_world.backends.mujoco.slots import Slot
from scm_world.backends.mujoco.states import (
    MOST,
    MOTION,
    LastStep,
    into_bodies,
    is_sound,
    motion_of,
    read_rows,
    table_of,
    turned_bodies,
)
from scm_world.backends.mujoco.trees import Couplings
from scm_world.errors import EngineFailure, Infeasible, UnknownOption, some
from scm_world.models.model import REPORTED, Model
from scm_world.models.scene import REVERSED, ParameterKey, Parameters, Structure, reversed_ranges

FILLED, LOST = slice(1, 3), slice(1, 6)
"""Kinds of warnings: no memory for contacts or constraints; these, and numbers beyond ``MOST``."""

STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
"""Everything that decides the future of a simulation of MuJoCo."""

FULL = (
    "MuJoCo has no memory for all contacts and constraints of this state; give it more in the file "
    "of the model, for example with <size memory='100M'/>"
)

OF_DATA = ("xfrc_applied", "mocap_pos", "mocap_quat", "eq_active")
"""Arrays of the data into which parameters are written; all others are of the model."""

Memory = tuple[Floats, LastStep | None, Floats | None]
"""Forces, what the last step left of turned bodies, and the vector that was written since."""

Usual = tuple[dict[ParameterKey, Floats], mujoco.MjModel, dict[str, NDArray[Any]]]
"""Parameters, the model with them, and the arrays ``OF_DATA``."""

_ONLY = np.zeros(1, dtype=np.int32)
"""The row of a single vector."""


def lost(structure: Model, vector: Floats, time: float, engine: str = "MuJoCo") -> str:
    """Return which states of a vector an engine has lost, and when [s], as a sentence."""
    sizes = {name: np.abs(vector[at]) for name, at in structure.layout.slices.items()}
    names, kind = [n for n, size in sizes.items() if not np.isfinite(size).all()], "not finite"
    if not names:  # or only an acceleration is so large
        names, kind = [n for n, size in sizes.items() if (size > MOST).any()], "unstable"
        kind += f" (a number or an acceleration is beyond {MOST:.0e})"
    where = f": {some(names)}" * bool(names)
    return (
        f"{engine} produced a state that is {kind} at {time:g} s{where}; a shorter timestep, "
        "smaller forces or more damping keep it finite"
    )


class Realization:
    """A compiled model with parameters and a state of its own.

    The parameters that it is made with are all that differ from it, and all that are compared. It
    has what only pictures show if it is whole.

    Attributes:
        structure: The compiled structure.
        model: With the present parameters.
        data: With the present state.
        kept: The parameters in force; at first, none has been written.
        revision: An object that identifies the parameters in force; new with every change.
        command: As it is held, shape (n_commands,).
        lean: Whether ``mjSTATE_INTEGRATION`` is all that a scene has to keep.
        replay: ``mjSTATE_INTEGRATION`` before the last steps and how many these were, if they were
            taken elsewhere, so that their contacts are not in the data.
    """

    def __init__(
        self, structure: Structure, parameters: Parameters, *, whole: bool = False
    ) -> None:
        self.structure = structure = Model.of(structure, "MuJoCo")
        self._compiled = compiled = reading.compiled(structure)
        source = structure.source.whole if whole else compiled
        usual = None if whole else self._usual(parameters)
        self.model = model = copy.copy(source if usual is None else usual[1])
        self.data = data = mujoco.MjData(source)
        self._slots: dict[ParameterKey, Slot] = {}
        self.kept: dict[ParameterKey, Floats] = {}
        self.revision = object()
        self.replay: tuple[Floats, int] | None = None
        self.command = data.ctrl[: structure.n_commands]
        self._forces = data.qfrc_actuator
        motion = [structure.places(array)[1] for array in ("qpos", "qvel", "act")]
        self._motion, sources = motion_of(data)
        self._places = np.stack([sources, np.concatenate(motion)])
        self._names, self._turned, self._own = turned_bodies(structure, compiled)
        self._spins = self._turned[:, 4:]
        self._reported = structure.places(REPORTED)
        self._table = table_of(self._places, self._reported, self._turned)
        self._row = self._motion, self._forces[None], self._table, _ONLY
        self._into: tuple[Any, Floats] = None, np.empty((1, 0))  # a vector, and the same as a row
        self.lean = not (self._reported.size or self._names)
        self._last: LastStep | None = None
        self._written: Floats | None = None  # since the last step, if bodies are turned
        self._counts = data.warning.number
        self._losses = self._counts[LOST]
        self._size = int(mujoco.mj_stateSize(model, STATE))
        # MuJoCo prints a warning, and writes it to a file, when it counts the first of its kind.
        self._counts[:] = 1
        if usual is not None:
            self.kept |= usual[0]
            for name, values in usual[2].items():
                getattr(data, name)[...] = values
            return
        self.edit(parameters)
        self._slots.clear()  # most are not needed again
        if not whole and len(parameters) == len(structure.rows):
            arrays = {name: getattr(data, name).copy() for name in OF_DATA}
            vars(structure).setdefault("_usual", (dict(self.kept), copy.copy(model), arrays))

    def _usual(self, parameters: Parameters) -> Usual | None:
        """Return what the first whole scene began with, if it had these parameters."""
        found: Usual | None = vars(self.structure).get("_usual")
        if found is None or [*found[0]] != [*parameters]:
            return None
        pairs = zip(found[0].values(), parameters.values(), strict=True)
        same = all(a is b or a.tobytes() == np.asarray(b, np.float64).tobytes() for a, b in pairs)
        return found if same else None

    # --- state ---------------------------------------------------------------------------------

    def read(self, into: Floats) -> None:
        """Write the state into a vector, shape (layout.size,)."""
        if self._into[0] is not into:
            self._into = into, into[None]
        read_rows(*self._row, self._into[1])
        if self._written is not None:  # as it was written, although turning has rounded it
            into[self._spins] = self._written[self._spins]

    def place(self, vector: Floats) -> None:
        """Write a state; all else stays as it is. Values that the last step left stay exact."""
        motion = vector[self._places[1]]
        if self._names:
            names, known, exact = self._remembered()
            if names != self._names:
                where = [names.index(name) if name in names else -1 for name in self._names]
                nobody = np.full((1, 7), np.nan)
                known, exact = (np.vstack([part, nobody])[where] for part in (known, exact))
            into_bodies(vector, self._turned, self._own, known, exact, motion)
            self._written = vector.copy()
        mujoco.mj_setState(self.model, self.data, motion, MOTION)

    def _remembered(self) -> LastStep:
        """Return what the last physics step left of turned bodies, before the first change."""
        if self._last is None:
            vector = np.empty(self.structure.layout.size)
            self.read(vector)
            exact = self._motion[0, self._places[0, self._own]]
            self._last = self._names, vector[self._turned], exact
        return self._last

    def rows(self, batch: Batch) -> Callable[[Any, Floats], int]:
        """Return what reads some states out of a batch, and returns a row that is lost."""
        forces = batch.bind("qfrc_actuator") if self._reported.size else np.empty((0, 0))
        count = self._places.shape[1]
        places = np.stack([np.arange(count), self._places[1]])
        motions = batch.state[:, 1 : 1 + count]
        table = table_of(places, self._reported, self._turned)
        return partial(read_rows, motions, forces, table)

    def reset(self) -> None:
        """Forget every step; parameters stay."""
        data = self.data
        given = data.mocap_pos, data.mocap_quat, data.xfrc_applied
        kept = [array.copy() for array in given]
        mujoco.mj_resetData(self.model, data)
        for array, values in zip(given, kept, strict=True):
            array[:] = values
        self.replay = self._written = None
        self._last = (), np.empty((0, 7)), np.empty((0, 7))
        self._counts[:] = 1

    def forget(self) -> None:
        """Forget the state before a step that is made now."""
        self.replay = self._last = self._written = None

    def step(self, command: Floats, substeps: int) -> str:
        """Hold a command; return why the state is lost, or nothing.

        Raises:
            EngineFailure: MuJoCo could not take one of the steps, and the state is lost.
        """
        self.command[:] = command
        self.replay = self._last = self._written = None
        try:
            mujoco.mj_step(self.model, self.data, substeps)
        except (mujoco.FatalError, mujoco.UnexpectedError) as error:
            numbers = self.numbers()
            mujoco.mj_resetData(self.model, self.data)  # what the step was using is free again
            self.recall(numbers, None)
            raise EngineFailure(f"MuJoCo: {error}", "mujoco", lost=(0,)) from error
        if is_sound(self._motion, self._table, self._losses):
            return ""
        full = (self._counts[FILLED] != 1).any()
        self._counts[:] = 1
        if full:
            return FULL
        vector = self.structure.empty_state().vector
        self.read(vector)
        return lost(self.structure, vector, self.data.time)

    def _data_to_compute_on(self) -> mujoco.MjData:
        return scratch(self.structure, "data", lambda: silent(mujoco.MjData(self._compiled)))

    def touches(self) -> Touches:
        """Copy the contacts of the last physics step; of Runge-Kutta, those of its last stage."""
        owners = self.structure.owners
        if self.replay is None:
            return touches(self.model, self.data, owners)
        data, (numbers, steps) = self._data_to_compute_on(), self.replay
        mujoco.mj_setState(self.model, data, numbers, STATE)
        try:
            mujoco.mj_step(self.model, data, steps)
        except (mujoco.FatalError, mujoco.UnexpectedError):
            mujoco.mj_resetData(self.model, data)  # it failed then, too, and left no contacts
        found = touches(self.model, data, owners)
        mujoco.mj_resetData(self.model, data)
        silent(data)
        return found

    def numbers(self) -> Floats:
        """Copy ``mjSTATE_INTEGRATION``."""
        numbers = np.empty(self._size)
        mujoco.mj_getState(self.model, self.data, numbers, STATE)
        return numbers

    def memory(self) -> Memory | None:
        """Return the state beside ``mjSTATE_INTEGRATION``; it can be pickled."""
        return None if self.lean else (self._forces.copy(), self._last, self._written)

    def recall(self, numbers: Floats, memory: Memory | None) -> None:
        """Restore the state that was kept."""
        mujoco.mj_setState(self.model, self.data, numbers, STATE)
        self._counts[:] = 1
        self.replay = None
        if memory is not None:
            self._forces[:], self._last, self._written = memory

    def follow(self, before: Realization) -> None:
        """Continue after the last step of another realization; then the state is written."""
        self.data.time = before.data.time
        if not (self.lean and before.lean):
            self._last = before._remembered()
        there = before.structure.layout.slices
        for row in (row for row in self.structure.states if row.reported and row.name in there):
            other = next(one for one in before.structure.states if one.name == row.name)
            self._forces[list(row.numbers)] = before._forces[list(other.numbers)]

    # --- model ---------------------------------------------------------------------------------

    @cached_property
    def _dynamic(self) -> NDArray[np.bool_]:
        """Which shapes touch with coefficients of their own, shape (ngeom, ngeom)."""
        return Couplings(self._compiled).dynamic

    @cached_property
    def _frictions(self) -> dict[str, int]:
        """The numbers of the shapes whose own friction may not count, by the names of elements."""
        names = fields.element_names(self._compiled)["geom"]
        shapes = {name: n for n, name in enumerate(names) if self._dynamic[n].any()}
        return shapes | {f"geom:{name}": n for name, n in shapes.items()}

    def remarks(self, before: Parameters) -> tuple[str, ...]:
        """List with which shapes a friction that was changed has no effect.

        Source:
            MuJoCo, *Computation, Contact*: of two shapes the one with the higher priority decides,
            and with equal priorities the larger of each of their coefficients.
        """
        mj, found = self.model, []
        for (element, attribute), old in before.items():
            if attribute not in fields.FRICTIONS or element not in self._frictions:
                continue
            geom, column = self._frictions[element], fields.FRICTIONS.index(attribute)
            rank, theirs = mj.geom_priority, mj.geom_friction[:, column]
            larger = (rank == rank[geom]) & (theirs >= max(float(old), theirs[geom]))
            others = np.flatnonzero(self._dynamic[geom] & ((rank > rank[geom]) | larger))
            if len(others):
                names = fields.element_names(self._compiled)["geom"]
                shown = some([f"{names[i]} ({theirs[i]:g})" for i in others.tolist()])
                found.append(
                    f"{element}.{attribute} has no effect in contacts with {shown}: the larger "
                    "coefficient counts, or the one with priority"
                )
        return tuple(found)

    def fingerprint(self) -> tuple[Any, ...]:
        """Return a digest of the model without its structure: models of one digest are alike."""
        return tuple(self.kept), b"".join(value.tobytes() for value in self.kept.values())

    def check(self, keys: Iterable[ParameterKey]) -> None:
        """Raise ``UnknownOption`` for the first parameter that there is not."""
        rows = self.structure.rows
        for key in keys:
            if key not in rows:
                raise UnknownOption("parameter", ".".join(key), map(".".join, rows))

    def _slot(self, key: ParameterKey) -> Slot:
        found = self._slots.get(key)
        if found is None:
            find: Any = self.structure.rows[key].slot
            found = self._slots[key] = find(self.model, self.data)
        return found

    def parameters(self, keys: Iterable[ParameterKey]) -> Parameters:
        """Read parameters and moments of inertia back from the arrays of the model."""
        found, bodies = dict[ParameterKey, Floats](), self.structure.body_names
        for key in keys:
            if key in self.structure.rows:
                found[key] = self._slot(key).read()
            elif key[1] == "inertia" and key[0] in bodies:
                found[key] = self.model.body_inertia[bodies.index(key[0])].copy()
            else:
                self.check([key])
        return found

    def _impossible(self, keys: list[ParameterKey]) -> list[ParameterKey]:
        """List the masses and inertias that no body can have; all of them if none is wrong."""
        wrong = []
        for key in keys:
            value, most = self._slot(key).read(), self._slot(key).read().max()
            bad = not np.isfinite(value).all() or (key[1] == "mass" and value < 0.0)
            if bad or (key[1] == "inertia" and 2.0 * most - value.sum() > 1e-6 * most):
                wrong.append(key)
        return wrong or keys

    def edit(self, parameters: Parameters) -> None:
        """Write parameters, then all numbers that follow; refuse them, or change all of them."""
        self.check(parameters)
        kept = self.kept
        before: dict[ParameterKey, Floats | None] = {}
        try:
            for key, value in parameters.items():
                present = kept.get(key)
                if present is value:
                    continue
                given = np.array(value, dtype=np.float64)
                default = self.structure.defaults[key] if present is None else present
                if default.tobytes() == given.tobytes():
                    given = default  # most values are those of all worlds
                if given is not present:
                    before[key], self.revision = present, object()
                    self._slot(key).write(given)
                kept[key] = given
            if not before:
                return
            wrong = reversed_ranges({key: kept[key] for key in before})
            reason = REVERSED if wrong else self._followed([*before])
            if reason:
                wrong = wrong or self._impossible([k for k in before if self._slot(k).constant])
                names = ", ".join(".".join(key).strip(".") for key in wrong)
                values = [parameters[key] for key in wrong]
                raise Infeasible(names, values[0] if len(values) == 1 else values, [reason])
        except BaseException:
            for key, old in before.items():
                if old is not None:  # where there is none, the model is new and is given up
                    kept[key] = old
                    self._slot(key).write(old)
            self._followed([*before])
            raise

    def _followed(self, keys: list[ParameterKey]) -> str:
        """Compute what follows from some parameters; return why that is invalid, or nothing."""
        slots = [self._slot(key) for key in keys]
        for follow_up in {slot.follow_up for slot in slots if slot.follow_up is not None}:
            follow_up(self.model)
        if not any(slot.constant for slot in slots):
            return ""
        data = self._data_to_compute_on()
        try:
            mujoco.mj_setConst(self.model, data)
        except (mujoco.FatalError, mujoco.UnexpectedError) as error:
            forget(self.structure)  # it may still be in use inside
            return f"MuJoCo says: {error}"
        singular = data.warning.number
        if singular[0] != 1 or not reading.sensible(self.model):
            singular[0] = 1
            return "masses and moments of inertia would not be those of something that can move"
        return ""
