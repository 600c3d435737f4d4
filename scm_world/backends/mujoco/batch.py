"""Many scenes in MuJoCo, stepped in one call by threads of its own."""

from __future__ import annotations

import copy
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, final

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from scm_world._types import Floats, Integers
from scm_world.backends.base import EngineBatch
from scm_world.backends.mujoco.realization import FULL, STATE, Realization, lost, refuse_callbacks
from scm_world.errors import EngineFailure
from scm_world.models.scene import ControlMode

if TYPE_CHECKING:
    from scm_world.backends.mujoco.backend import MujocoBackend

KEPT = 4
"""Structures whose simulations are kept although no scene is in them at the moment."""

_STRANDED: list[_Room] = []
"""Simulations whose threads were left behind by a fork."""


@final
class Seat:
    """A place in a batch, for one scene.

    Attributes:
        room: Where it is.
        index: Of the simulation.
    """

    __slots__ = ("index", "room")

    def __init__(self, room: _Room, index: int) -> None:
        self.room, self.index = room, index

    def take(self, scene: Realization) -> None:
        """Take over the state of a scene."""
        mujoco.mj_getState(scene.model, scene.data, self.room.batch.state[self.index], STATE)
        self.room.taken[self.index] = 0

    def give_back(self, scene: Realization) -> None:
        """Copy everything that the last step left, or what it takes to compute it again."""
        room, index = self.room, self.index
        if scene.lean and room.taken[index]:
            mujoco.mj_setState(scene.model, scene.data, room.batch.state[index], STATE)
            scene.replay = room.before[index].copy(), int(room.taken[index])
        elif not scene.lean:
            room.batch.get_data(index, scene.data)
        scene.began = room.began[index]


@final
class _Room:
    """The simulations of all scenes of one structure.

    Args:
        scene: Any of them.
        n: How many scenes there could be.
        threads: That step them.
    """

    def __init__(self, scene: Realization, n: int, threads: int) -> None:
        self.structure = scene.structure
        # An MjData for each scene, so that contacts of the last step can be asked for; or one for
        # each thread, which stays in the cache, and that step is taken again if anybody asks.
        self.batch: Any = Batch(scene.model, n, threads, persistent=not scene.lean)
        self.before: Floats = np.zeros(self.batch.state.shape if scene.lean else (n, 0))
        self.taken = np.zeros(n, dtype=np.int64)  # physics steps of the last step
        self.batch.warning[..., 1] = 1  # MuJoCo prints the first of each kind of warning
        self.seats = [Seat(self, index) for index in range(n)]
        # Scenes that are as the first one was share a copy of its model: it stays in the cache.
        self.usual = scene.fingerprint(), copy.copy(scene.model)
        self.models: list[mujoco.MjModel] = [self.usual[1]] * n
        self.read = scene.rows(self.batch)
        self.began: list[Floats | None] = [None] * n  # see ``Realization``
        self._staged = scene.staged
        self._width = len(scene.command)
        self._commands = self.batch.bind("ctrl")

    def step(self, which: Integers, commands: Floats, substeps: int) -> None:
        """Hold commands, shape (n, at least n_commands), in some of the simulations."""
        width, everyone = self._width, len(which) == len(self.seats)
        rows = slice(None) if everyone else which
        self._commands[rows, :width] = commands[rows, :width]
        if self.before.size:
            self.before[rows], self.taken[rows] = self.batch.state[rows], substeps
        for index in which.tolist() if self._staged else ():
            self.began[index] = self.batch.state[index].copy() if substeps == 1 else None
        self.batch.step(ids=None if everyone else which, nstep=substeps)


@final
class MujocoBatch(EngineBatch):
    """Scenes of MuJoCo, each with parameters of its own, stepped by C threads.

    While a scene is being stepped here, its state is in a seat; as soon as anything else is asked
    of it, it takes its state back. Results are, bit for bit, those of single scenes.

    Args:
        guests: The scenes.
        threads: That step them; the results do not depend on how many.
    """

    def __init__(self, guests: Sequence[MujocoBackend], threads: int) -> None:
        self._guests = tuple(guests)
        self._threads = max(1, min(threads, len(self._guests)))
        self._rooms: dict[Any, _Room] = {}
        self._seats: list[Seat | None] = [None] * len(self._guests)
        self._process = os.getpid()
        self._last: tuple[_Room, ControlMode] | None = None  # if all were stepped in one room

    def step(
        self, which: Integers, mode: ControlMode, commands: Floats, substeps: int, into: Floats
    ) -> None:
        """Hold commands for some physics steps.

        Raises:
            EngineFailure: A number is not finite afterwards, or memory did not suffice; all were
                stepped. Or a callback of the user is in use; none was.
        """
        if self._process != os.getpid():
            # Everything is made anew after a fork: threads stay in the process that started them.
            # What they worked for cannot be freed here: that would wait for them for ever.
            self._process, self._last = os.getpid(), None
            _STRANDED.extend(self._rooms.values())
            _STRANDED.extend(seat.room for seat in self._seats if seat is not None)
            self._rooms.clear()
            self._seats = [None] * len(self._guests)
        refuse_callbacks()
        if self._last is not None and len(which) == len(self._guests):
            room, last = self._last
            if mode is last and [guest.seat for guest in self._guests] == self._seats:
                problem = _step(room, which.astype(np.int32), commands, substeps, into)
                if problem:
                    raise EngineFailure(problem, "mujoco")
                return
        rooms: dict[int, tuple[_Room, list[int]]] = {}
        changed: set[int] = set()
        for index in which.tolist():
            seat = self._seat(index)
            key = id(seat.room)
            rooms.setdefault(key, (seat.room, []))[1].append(index)
            if self._guests[index].depart(seat, mode):
                scene, (fingerprint, model) = self._guests[index].realization, seat.room.usual
                alike = scene.fingerprint() == fingerprint
                seat.room.models[index] = model if alike else scene.model
                changed.add(key)
        problems = []
        everyone = len(rooms) == 1 and len(which) == len(self._guests)
        self._last = (next(iter(rooms.values()))[0], mode) if everyone else None
        for key, (room, members) in rooms.items():
            if key in changed:
                room.batch.set_models(room.models)
            problem = _step(room, np.array(members, dtype=np.int32), commands, substeps, into)
            problems += [problem] if problem else []
        if problems:
            raise EngineFailure("; ".join(problems), "mujoco")

    def _seat(self, index: int) -> Seat:
        """Give the seat of a scene in the room of its structure."""
        scene, seat = self._guests[index].realization, self._seats[index]
        if seat is not None and seat.room.structure == scene.structure:
            return seat
        self._seats[index], room = None, self._rooms.get(scene.structure)
        if room is None:
            used = {id(seat.room) for seat in self._seats if seat is not None}
            unused = [key for key, other in self._rooms.items() if id(other) not in used]
            for key in unused[: max(0, len(self._rooms) + 1 - KEPT)]:
                del self._rooms[key]
            room = _Room(scene, len(self._guests), self._threads)
            self._rooms[scene.structure] = room
        seat = self._seats[index] = room.seats[index]
        return seat


def _step(room: _Room, which: Any, commands: Floats, substeps: int, into: Floats) -> str:
    """Step and read; say what went wrong, or nothing."""
    said = ""
    try:
        room.step(which, commands, substeps)
    except SimulationError as error:
        said = f"MuJoCo: {error}"
    counts = room.batch.warning[..., 1]
    wrong, full = room.read(which, into), counts[:, 1:3].max(axis=1) > 1
    counts[:] = 1
    if not said and full[which].any():
        said = f"scene {which[full[which]][0]} of the batch: {FULL}"
    elif not said and wrong >= 0:
        vector, time = into[wrong, : room.structure.layout.size], float(room.batch.state[wrong, 0])
        said = f"scene {wrong} of the batch: {lost(room.structure, vector, time)}"
    return said
