"""A structure as MuJoCo realizes it: one class for each kind of structure.

``Realization`` holds a compiled model with its parameters and its state. ``backend`` has the one
of any ``Model``; a structure can bring its own (``Structure.realization``).
"""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar

import mujoco
import numba
import numpy as np
from mujoco.batch import Batch

from scm_world._types import Floats, Integers
from scm_world.backends.mujoco.contacts import Touches, touches
from scm_world.backends.mujoco.slots import Slot
from scm_world.errors import EngineFailure, Infeasible, UnknownOption
from scm_world.models.scene import (
    REVERSED,
    ControlMode,
    ParameterKey,
    Parameters,
    reversed_ranges,
)


@numba.njit("b1(f8[::1], f8[::1], f8[::1], i4[:])", cache=True)
def sound(positions: Floats, velocities: Floats, activations: Floats, counts: Any) -> bool:
    """Tell whether all numbers are finite, and no contact or constraint was left out.

    Args:
        positions: Shape (nq,).
        velocities: Shape (nv,).
        activations: Shape (na,).
        counts: Of MuJoCo's warnings, which begin with 1; the second is of contacts for which
            there was no memory, the third of constraints.
    """
    total = 0.0
    for value in positions:
        total += value * 0.0
    for value in velocities:
        total += value * 0.0
    for value in activations:
        total += value * 0.0
    return total == 0.0 and counts[1] + counts[2] == 2


@numba.njit("void(f8[::1], f8[::1], f8[::1], i8[::1], f8[::1])", cache=True)
def read_vector(
    positions: Floats, velocities: Floats, activations: Floats, places: Integers, into: Floats
) -> None:
    """Copy MuJoCo's coordinates into a state vector.

    Args:
        positions: Shape (nq,).
        velocities: Shape (nv,).
        activations: Shape (na,).
        places: Where in the vector each of them stands, in this order, shape (nq + nv + na,).
        into: Written, shape (nq + nv + na,).
    """
    nq, nv = positions.shape[0], velocities.shape[0]
    for i in range(nq):
        into[places[i]] = positions[i]
    for i in range(nv):
        into[places[nq + i]] = velocities[i]
    for i in range(activations.shape[0]):
        into[places[nq + nv + i]] = activations[i]


@numba.njit("void(f8[::1], f8[::1], f8[::1], i8[::1], f8[::1])", cache=True)
def write_vector(
    positions: Floats, velocities: Floats, activations: Floats, places: Integers, vector: Floats
) -> None:
    """Copy a state vector into MuJoCo's coordinates; see ``read_vector``."""
    nq, nv = positions.shape[0], velocities.shape[0]
    for i in range(nq):
        positions[i] = vector[places[i]]
    for i in range(nv):
        velocities[i] = vector[places[nq + i]]
    for i in range(activations.shape[0]):
        activations[i] = vector[places[nq + nv + i]]


@numba.njit("i8(f8[:, ::1], i8[::1], i4[::1], f8[:, ::1])", cache=True)
def read_rows(states: Floats, places: Integers, which: Any, into: Floats) -> int:
    """Copy some rows of MuJoCo's states (time, positions, velocities, activations, ...).

    Args:
        states: Of all simulations, one to a row.
        places: See ``read_vector``.
        which: The rows, shape (m,).
        into: The first columns of these rows are written.

    Returns:
        A row in which something is not finite; -1 if there is none.
    """
    wrong = -1
    for row in which:
        total = 0.0
        for i in range(places.shape[0]):
            value = states[row, 1 + i]
            into[row, places[i]] = value
            total += value * 0.0
        if total != 0.0:
            wrong = row
    return wrong


@numba.njit("b1(f8[::1], f8[:, ::1], f8[::1], f8[::1], f8[:, ::1])", cache=True)
def sensible(
    masses: Floats, moments: Floats, inertia: Floats, dof_weights: Floats, body_weights: Floats
) -> bool:
    """Tell whether masses and what MuJoCo derives from them are those of something that can move.

    Args:
        masses: Of the bodies, shape (nbody,).
        moments: Their principal moments of inertia, shape (nbody, 3).
        inertia: Diagonal of the inertia matrix, shape (nv,).
        dof_weights: Inverse weights, shape (nv,).
        body_weights: Inverse weights, shape (nbody, 2).
    """
    for body in range(masses.shape[0]):
        a, b, c = moments[body]
        least, most = min(a, b, c), max(a, b, c)
        if not (0.0 <= masses[body] < math.inf and least >= 0.0 and most < math.inf):
            return False
        if not a + b + c - 2.0 * most >= -1e-6 * most:  # the triangle inequality
            return False
        for weight in body_weights[body]:
            if not 0.0 <= weight < math.inf:
                return False
    for dof in range(inertia.shape[0]):
        if not (0.0 < inertia[dof] < math.inf and 0.0 <= dof_weights[dof] < math.inf):
            return False
    return True


def inertia_of(mj: mujoco.MjModel) -> tuple[Floats, ...]:
    """Return views of what ``sensible`` looks at."""
    return mj.body_mass, mj.body_inertia, mj.dof_M0, mj.dof_invweight0, mj.body_invweight0


STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
"""Everything that decides the future of a simulation of MuJoCo."""

FULL = (
    "MuJoCo has no memory for all contacts and constraints of this state; give it more in the file "
    "of the model, for example with <size memory='100M'/>"
)

CALLBACKS = {
    name: getattr(mujoco, f"get_mjcb_{name}")
    for name in ("control", "passive", "act_dyn", "act_gain", "act_bias", "contactfilter")
}
"""What gives the callbacks of a user that act on the physics."""
_control, _passive, _act_dyn, _act_gain, _act_bias, _filter = CALLBACKS.values()

Rows = Callable[[Any, Floats], int]
"""Reads some states of a batch, and gives a row that is not finite, or -1."""


def callbacks() -> list[str]:
    """Say of each callback that is in use why no model can have it; none of them is usual."""
    if not (_control() or _passive() or _act_dyn() or _act_gain() or _act_bias() or _filter()):
        return []
    return [
        f"the callback mjcb_{name} is in use: what it acts on is unknown; call "
        f"mujoco.set_mjcb_{name}(None)"
        for name, callback in CALLBACKS.items()
        if callback() is not None
    ]


def refuse_callbacks() -> None:
    """Refuse to step while a callback of the user acts.

    Raises:
        EngineFailure: With the callbacks.
    """
    found = callbacks()
    if found:
        raise EngineFailure("; ".join(found), "mujoco")


def lost(structure: Any, vector: Floats, time: float) -> str:
    """Say which states are not finite, and when.

    Args:
        structure: With the names of the states.
        vector: The state, shape (structure.layout.size,).
        time: Of the simulation, which begins with 0 at a reset [s].
    """
    places = structure.layout.slices
    names = [name for name, where in places.items() if not np.isfinite(vector[where]).all()]
    more = f" and {len(names) - 4} more" if len(names) > 4 else ""
    return (
        f"MuJoCo produced a state that is not finite at {time:g} s: {', '.join(names[:4])}{more}; "
        "a shorter timestep, smaller forces or more damping keep it finite"
    )


class Realization(ABC):
    """A compiled model with parameters and a state of its own.

    Args:
        structure: What was compiled.
        compiled: The result, which is copied and not changed.
        slots: Finds the places of all parameters in a model and its data.
        bodies: Name of each body.
        owners: Name of the body of each shape: the geoms, then the flexes.

    Attributes:
        structure: What was compiled.
        owners: Name of the body of each shape: the geoms, then the flexes.
        model: With the present parameters.
        data: With the present state.
        kept: The parameters in force; at first, none has been written.
        applied: The parameters of a snapshot, while they are those in force.
        mode: What a command means.
        command: Where it is written, shape (n_commands,).
        edited: Whether the model has changed since someone last cleared this.
        lean: Whether ``mjSTATE_INTEGRATION`` is all that a scene has to keep.
        replay: ``mjSTATE_INTEGRATION`` before the last steps and how many these were, if they were
            taken elsewhere, so that their contacts are not in the data.
    """

    modes: ClassVar[tuple[ControlMode, ...]]
    lean: ClassVar[bool] = False

    def __init__(
        self,
        structure: Any,
        compiled: mujoco.MjModel,
        slots: Callable[[mujoco.MjModel, mujoco.MjData], Mapping[ParameterKey, Slot]],
        bodies: tuple[str, ...],
        owners: tuple[str, ...],
    ) -> None:
        self.structure = structure
        self.model = model = copy.copy(compiled)
        self.data = data = mujoco.MjData(model)
        self._scratch = mujoco.MjData(model)
        self._slots = slots(model, data)
        self._constant = frozenset(key for key, slot in self._slots.items() if slot.constant)
        self._bodies, self.owners = bodies, owners
        self.kept: dict[ParameterKey, Floats] = {}
        self.applied: Parameters | None = None
        self._numbers: bytes | None = None  # of what is kept, if nothing was written since
        self.mode = self.modes[0]
        self.edited = True
        self.replay: tuple[Floats, int] | None = None
        self.command = data.ctrl[: structure.n_commands]
        self._positions, self._velocities, self._activations = data.qpos, data.qvel, data.act
        self._counts = data.warning.number
        self._weights = inertia_of(model)
        self._size = int(mujoco.mj_stateSize(model, STATE))
        # MuJoCo prints a warning, and writes it to a file, when it counts the first of its kind.
        self._counts[:] = self._scratch.warning.number[:] = 1

    # --- state: how numbers are converted differs between kinds of structures ------------------

    @abstractmethod
    def read(self, into: Floats) -> None:
        """Write the state into a vector."""

    @abstractmethod
    def place(self, vector: Floats) -> None:
        """Write a state; all else stays as it is."""

    @abstractmethod
    def rows(self, batch: Batch) -> Rows:
        """Give what reads states of such models out of a batch."""

    def reset(self) -> None:
        """Forget every step; parameters stay."""
        data = self.data
        places, turns = data.mocap_pos.copy(), data.mocap_quat.copy()
        mujoco.mj_resetData(self.model, data)
        data.mocap_pos[:], data.mocap_quat[:] = places, turns
        self.replay = None
        self._counts[:] = 1

    def forget(self) -> None:
        """Forget what was before a step that is made now."""
        self.replay = None

    def problem(self) -> str:
        """Say what is wrong with what a step left, or nothing."""
        if sound(self._positions, self._velocities, self._activations, self._counts):
            return ""
        full = self._counts[1] + self._counts[2] > 2
        self._counts[:] = 1
        if full:
            return FULL
        vector = self.structure.empty_state().vector
        self.read(vector)
        return lost(self.structure, vector, self.data.time)

    def recover(self) -> None:
        """Free what a step was using when it failed; the state stays as the step left it."""
        numbers = self.numbers()
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_setState(self.model, self.data, numbers, STATE)
        self._counts[:] = 1

    def touches(self) -> Touches:
        """Copy the contacts of the last physics step; of Runge-Kutta, those of its last stage."""
        if self.replay is not None:
            return self._replayed(*self.replay)
        return touches(self.model, self.data, self.owners)

    def _replayed(self, numbers: Floats, steps: int) -> Touches:
        """Take steps again on other data, and copy the contacts of the last one."""
        data = self._scratch
        mujoco.mj_setState(self.model, data, numbers, STATE)
        try:
            mujoco.mj_step(self.model, data, steps)
        except (mujoco.FatalError, mujoco.UnexpectedError):
            mujoco.mj_resetData(self.model, data)  # it failed then, too, and left no contacts
        found = touches(self.model, data, self.owners)
        mujoco.mj_resetData(self.model, data)
        data.warning.number[:] = 1
        return found

    def numbers(self) -> Floats:
        """Copy ``mjSTATE_INTEGRATION``."""
        numbers = np.empty(self._size)
        mujoco.mj_getState(self.model, self.data, numbers, STATE)
        return numbers

    def memory(self) -> Any:
        """Return what has to be kept in addition to ``mjSTATE_INTEGRATION``; it can be pickled."""
        return None

    def recall(self, numbers: Floats, memory: Any) -> None:
        """Restore what was kept."""
        mujoco.mj_setState(self.model, self.data, numbers, STATE)
        self._counts[:] = 1
        self.replay = None

    def follow(self, before: Realization) -> None:
        """Continue after the last step of another realization; then the state is written."""
        self.data.time = before.data.time

    def switch(self, mode: ControlMode) -> None:
        """Change the meaning of commands.

        Raises:
            UnknownOption: This structure has no such mode.
        """
        if mode not in self.modes:
            raise UnknownOption("control mode", str(mode), map(str, self.modes))
        self.mode = mode

    # --- model ---------------------------------------------------------------------------------

    def inertia(self, body: str) -> Floats:
        """Copy the principal moments of inertia of a body, shape (3,) [kg m²].

        Raises:
            UnknownOption: There is no such body.
        """
        if body not in self._bodies:
            raise UnknownOption("body", body, self._bodies)
        moments: Floats = self.model.body_inertia[self._bodies.index(body)].copy()
        return moments

    def remarks(self, before: Parameters) -> tuple[str, ...]:
        """Say which changes of parameters have no effect, and why."""
        return ()

    def fingerprint(self) -> tuple[Any, ...]:
        """Return a digest of the model without its structure: models of one digest are alike."""
        if self._numbers is None:
            self._numbers = b"".join(value.tobytes() for value in self.kept.values())
        return self.mode, tuple(self.kept), self._numbers

    def check(self, keys: Iterable[ParameterKey]) -> None:
        """Raise ``UnknownOption`` for the first parameter that there is not."""
        for key in keys:
            if key not in self._slots:
                raise UnknownOption("parameter", ".".join(key), map(".".join, self._slots))

    def parameters(self, keys: Iterable[ParameterKey]) -> Parameters:
        """Read parameters back from the arrays of the model."""
        keys = tuple(keys)
        self.check(keys)
        return {key: self._slots[key].read() for key in keys}

    def edit(self, parameters: Parameters) -> None:
        """Write parameters, then all numbers that follow from them; unchanged ones cost nothing.

        Raises:
            UnknownOption: There is no such parameter. Nothing has changed.
            Infeasible: The model could not move with them. Nothing has changed.
        """
        self.check(parameters)
        kept, slots = self.kept, self._slots
        before: dict[ParameterKey, Floats | None] = {}
        try:
            for key, value in parameters.items():
                present = kept.get(key)
                if present is value:
                    continue
                given = np.array(value, dtype=np.float64)
                if present is None or given.tobytes() != present.tobytes():
                    before[key], self.applied = present, None
                    slots[key].write(given)
                kept[key] = given
            if not before:
                return
            self.edited, self._numbers = True, None
            wrong = reversed_ranges({key: kept[key] for key in before})
            reason = REVERSED if wrong else self.followed(before)
            if reason:
                wrong = wrong or self._culprits(before)
                names = ", ".join(".".join(key).strip(".") for key in wrong)
                values = [parameters[key] for key in wrong]
                raise Infeasible(names, values[0] if len(values) == 1 else values, [reason])
        except BaseException:
            self._numbers = None
            for key, old in before.items():
                if old is not None:  # where there is none, the model is new and is given up
                    kept[key] = old
                    slots[key].write(old)
            self.followed(before)
            raise

    def followed(self, keys: Iterable[ParameterKey]) -> str:
        """Compute what follows from some parameters; say what is wrong with it, or nothing."""
        if self._constant.isdisjoint(keys):
            return ""
        try:
            mujoco.mj_setConst(self.model, self._scratch)
        except (mujoco.FatalError, mujoco.UnexpectedError) as error:
            self._scratch = mujoco.MjData(self.model)  # the old one may still be in use inside
            self._scratch.warning.number[:] = 1
            return f"MuJoCo says: {error}"
        singular = self._scratch.warning.number
        if singular[0] != 1 or not sensible(*self._weights):
            singular[0] = 1
            return "masses and moments of inertia would not be those of something that can move"
        return ""

    def _culprits(self, keys: Iterable[ParameterKey]) -> list[ParameterKey]:
        """Name those of some parameters that no body can have; all that count if none is wrong."""
        constant = [key for key in keys if key in self._constant]
        wrong = []
        for key in constant:
            value, most = self._slots[key].read(), self._slots[key].read().max()
            bad = not np.isfinite(value).all() or (key[1] == "mass" and value < 0.0)
            if bad or (key[1] == "inertia" and 2.0 * most - value.sum() > 1e-6 * most):
                wrong.append(key)
        return wrong or constant
