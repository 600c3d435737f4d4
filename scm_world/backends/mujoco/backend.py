"""MuJoCo as a backend."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar, final

import mujoco
import numpy as np

from scm_world._types import Floats
from scm_world.backends.base import (
    Backend,
    Capabilities,
    Contact,
    EngineBatch,
    EngineSnapshot,
)
from scm_world.backends.mujoco.batch import MujocoBatch, Seat
from scm_world.backends.mujoco.contacts import Touches, touches
from scm_world.backends.mujoco.model import compiled, shape_owners
from scm_world.backends.mujoco.parameters import couple, slots
from scm_world.backends.mujoco.servos import steer
from scm_world.backends.mujoco.slots import Slot
from scm_world.backends.mujoco.state import (
    Instant,
    finite,
    nothing,
    read_state,
    settle,
    write_state,
)
from scm_world.errors import EngineFailure, SnapshotMismatch, UnknownOption
from scm_world.models.scene import (
    ControlMode,
    Difference,
    ParameterKey,
    Parameters,
    Scene,
    complete,
)
from scm_world.scene.scene import Structure
from scm_world.scene.state import PhysicalState
from scm_world.scene.trifinger import N_JOINTS

# Everything that decides how MuJoCo goes on.
_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


@final
@dataclass(frozen=True)
class Payload:
    """What a snapshot of MuJoCo holds.

    Attributes:
        structure: Of the scene.
        parameters: All of them, as they were applied.
        numbers: ``mjSTATE_INTEGRATION``.
        torques: Of the last physics step, shape (9,) [N m].
        instant: What the last physics step left, if the state was changed since.
        written: The state that was written since, if one was.
        touches: The contacts of the last physics step.
    """

    structure: Structure
    parameters: Parameters
    numbers: Floats
    torques: Floats
    instant: Instant | None
    written: Floats | None
    touches: Touches | None


@final
class MujocoBackend(Backend):
    """MuJoCo, with one compiled model per structure and everything else edited in place."""

    name: ClassVar[str] = "mujoco"
    capabilities: ClassVar[Capabilities] = Capabilities(batch=True)

    _structure: Structure | None = None
    _instant: Instant | None
    _written: Floats | None
    _touches: Touches | None
    _seat: Seat | None = None
    _edited = True

    @property
    def version(self) -> str:
        """Version of the engine."""
        return str(mujoco.__version__)

    @property
    def n_blocks(self) -> int:
        """How many movable blocks the scene has."""
        return self._n_blocks

    def build(self, scene: Scene) -> None:
        """Realise a scene from nothing; where the structure is the same, that costs little."""
        self._seat = None
        if scene.structure == self._structure:
            mujoco.mj_resetData(self._model, self._data)
        else:
            self._load(scene.structure)
        self._touches = None
        self._instant = nothing()
        self._source = self._instant.source(scene.structure.blocks)
        self._edit(scene.parameters)
        self._place(scene.state.vector)

    def apply(self, difference: Difference) -> None:
        """Change structure, parameters and state without advancing time.

        Raises:
            UnknownOption: There is no such parameter. Nothing has changed.
        """
        self._return()
        if difference.structure is not None:
            difference = self._restructure(difference.structure, difference)
        if difference.parameters:
            self._edit(difference.parameters)
        if difference.state is not None:
            self._remember()
            self._place(difference.state.vector)

    def parameters(self, keys: Iterable[ParameterKey]) -> Parameters:
        """Read parameters back from the arrays of the model.

        Raises:
            UnknownOption: There is no such parameter.
        """
        keys = tuple(keys)
        self._check(keys)
        return {key: self._slots[key].read() for key in keys}

    def inertia(self, body: str) -> Floats:
        """Read the principal moments of inertia of a block or link, shape (3,) [kg m²]."""
        moments: Floats = self._model.body(body).inertia.copy()
        return moments

    def read(self, into: PhysicalState) -> None:
        """Write the present state into an existing vector."""
        self._return()
        vector = into.vector
        read_state(self._positions, self._velocities, self._torques, vector)
        if self._written is not None:
            settle(self._written, vector)

    def step(self, mode: ControlMode, command: Floats, substeps: int) -> None:
        """Hold a command for some physics steps.

        Raises:
            EngineFailure: A position or velocity is not finite afterwards.
        """
        self._return()
        if mode is not self._mode:
            self._switch(mode)
        self._command[:] = command
        mujoco.mj_step(self._model, self._data, substeps)
        self._instant = self._written = self._touches = None
        if not finite(self._positions, self._velocities):
            raise EngineFailure("MuJoCo produced a state that is not finite", self.name)

    def contacts(self) -> tuple[Contact, ...]:
        """List the contact points of the last physics step."""
        return self._last_touches().contacts()

    def snapshot(self) -> EngineSnapshot:
        """Save everything."""
        self._return()
        numbers = np.empty(self._size)
        mujoco.mj_getState(self._model, self._data, numbers, _STATE)
        payload = Payload(
            self._present,
            dict(self._kept),
            numbers,
            self._torques.copy(),
            self._instant,
            self._written,
            self._last_touches(),
        )
        return EngineSnapshot(f"{self.name} {self.version}", payload)

    def restore(self, snapshot: EngineSnapshot) -> None:
        """Go back to a snapshot.

        Raises:
            SnapshotMismatch: It was taken by another engine, or another version of this one.
        """
        here = f"{self.name} {self.version}"
        if snapshot.engine != here:
            raise SnapshotMismatch(f"a snapshot of {snapshot.engine} cannot be restored by {here}")
        self._seat = None  # nothing of the present counts
        payload: Payload = snapshot.payload
        if payload.structure != self._structure:
            self._load(payload.structure)
        self._edit(payload.parameters)
        mujoco.mj_setState(self._model, self._data, payload.numbers, _STATE)
        self._torques[:] = payload.torques
        self._instant, self._written = payload.instant, payload.written
        self._touches = payload.touches
        if self._instant is not None:
            self._source = self._instant.source(payload.structure.blocks)

    @classmethod
    def batch(cls, backends: Sequence[Backend], threads: int) -> EngineBatch:
        """Give what steps several scenes in one call, with C threads."""
        guests = [backend for backend in backends if isinstance(backend, MujocoBackend)]
        return MujocoBatch(guests, threads)

    @property
    def structure(self) -> Structure:
        """The structure of the scene."""
        return self._present

    @property
    def model(self) -> mujoco.MjModel:
        """The compiled model, with the present parameters."""
        return self._model

    def depart(self, seat: Seat, mode: ControlMode) -> bool:
        """Let a seat have the state; tell whether the model has changed since the last time."""
        if mode is not self._mode:
            self._switch(mode)
        edited = self._edited
        if self._seat is not seat:
            self._return()
            seat.take(self._data)
            self._seat, edited = seat, True
        self._instant = self._written = self._touches = None
        self._edited = False
        return edited

    def _return(self) -> None:
        """Take the state back from where it is stepped."""
        if self._seat is not None:
            self._seat.give_back(self._data)
            self._seat = None

    def close(self) -> None:
        """Free the model and its data."""
        for name in list(vars(self)):
            delattr(self, name)

    def _load(self, structure: Structure) -> None:
        """Take a fresh copy of a compiled model; parameters have yet to follow."""
        model = copy.copy(compiled(structure))
        data = mujoco.MjData(model)
        self._model, self._data, self._scratch = model, data, mujoco.MjData(model)
        self._structure = self._present = structure
        self._n_blocks = len(structure.blocks)
        owners = shape_owners(structure)
        self._owners = tuple(owners[model.geom(i).name] for i in range(model.ngeom))
        self._slots: dict[ParameterKey, Slot] = slots(model, structure)
        self._kept: dict[ParameterKey, Floats] = {}
        self._pairs = (
            model.geom_friction,
            model.pair_geom1,
            model.pair_geom2,
            model.pair_friction,
        )
        self._size = mujoco.mj_stateSize(model, _STATE)
        self._positions, self._velocities = data.qpos, data.qvel
        self._torques = data.qfrc_actuator[:N_JOINTS]
        self._command = data.ctrl[:N_JOINTS]
        self._mode = ControlMode.JOINT_POSITIONS
        self._edited = True

    def _switch(self, mode: ControlMode) -> None:
        """Make the nine servos follow positions, or pass torques on."""
        steer(self._model.actuator_gainprm, self._model.actuator_biasprm, mode)
        self._mode = mode
        self._edited = True

    def _edit(self, parameters: Parameters) -> None:
        """Write parameters, then whatever follows from them; those in force cost nothing."""
        self._check(parameters)
        kept, places = self._kept, self._slots
        constant = coupled = steered = False
        for key, value in parameters.items():
            present = kept.get(key)
            if present is value:
                continue
            place = places[key]
            kept[key] = given = np.array(value, dtype=np.float64)
            if present is not None and given.tobytes() == present.tobytes():
                continue
            place.write(given)
            self._edited = True
            constant |= place.constant
            coupled |= place.coupled
            steered |= place.steered
        if coupled:
            couple(*self._pairs)
        if steered:
            self._switch(self._mode)
        if constant:
            mujoco.mj_setConst(self._model, self._scratch)

    def _place(self, vector: Floats) -> None:
        """Write a state; what equals the last instant gets the numbers it had there."""
        last = self._instant or nothing()
        write_state(
            vector,
            self._positions,
            self._velocities,
            self._source,
            last.vector,
            last.positions,
            last.velocities,
        )
        self._written = vector.copy()

    def _remember(self) -> None:
        """Keep what the last physics step left, before the first change of the state."""
        if self._instant is not None:
            return
        vector = self.state().vector
        self._instant = Instant(
            self._present.blocks,
            vector,
            self._positions.copy(),
            self._velocities.copy(),
        )
        self._source = np.arange(self._n_blocks)

    def _restructure(self, structure: Structure, difference: Difference) -> Difference:
        """Let bodies come and go, and complete the difference with what stays as it is."""
        self._remember()
        now = Scene(self._present, self._kept, self.state())
        torques, record = self._torques.copy(), self._last_touches()
        if structure != self._structure:
            self._load(structure)
        self._torques[:] = torques
        self._touches = record
        self._source = (self._instant or nothing()).source(structure.blocks)
        return complete(now, structure, difference)

    def _check(self, keys: Iterable[ParameterKey]) -> None:
        for key in keys:
            if key not in self._slots:
                raise UnknownOption("parameter", ".".join(key), map(".".join, self._slots))

    def _last_touches(self) -> Touches:
        if self._touches is None:
            self._return()
            self._touches = touches(self._data, self._owners)
        return self._touches
