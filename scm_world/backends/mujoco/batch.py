"""Many scenes in MuJoCo, stepped in one call by a thread pool."""

from __future__ import annotations

import atexit
import copy
import ctypes
import os
import threading
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, final
from weakref import WeakSet

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError
from numpy.typing import NDArray

from scm_world._types import Floats, Integers
from scm_world.backends.base import SeparateScenes
from scm_world.backends.mujoco.realization import FILLED, FULL, LOST, STATE, Realization, lost
from scm_world.backends.mujoco.states import MOST
from scm_world.errors import EngineFailure
from scm_world.models.model import Model

if TYPE_CHECKING:
    from scm_world.backends.mujoco.backend import MujocoBackend

Slot = tuple["Simulations", int]
"""The place of a scene in a batch: the simulations that it belongs to, and its number there."""

KEPT = 4
"""Structures whose simulations are kept although no scene is in them at the moment."""

_ALL: WeakSet[Simulations] = WeakSet()


def _after_fork() -> None:
    """Keep simulations for ever: their threads are not in the new process, and are joined else."""
    for simulations in _ALL:
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(simulations))
    _ALL.clear()


def _at_exit() -> None:
    """Wait for steps in other threads, which would crash when they come back from the engine."""
    for simulations in [*_ALL]:
        simulations.lock.acquire()


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_after_fork)
atexit.register(_at_exit)


@final
class Simulations:
    """The simulations of all scenes of one structure, of which there could be n."""

    def __init__(self, scene: Realization, n: int, threads: int) -> None:
        self.structure = scene.structure
        # An MjData for each scene, so that contacts of the last step can be asked for; or one for
        # each thread, which stays in the cache, and that step is taken again if anybody asks.
        self.batch = Batch(scene.model, n, threads, persistent=not scene.lean)
        self.before: Floats = np.zeros(self.batch.state.shape if scene.lean else (n, 0))
        self.taken = np.zeros(n, dtype=np.int64)  # physics steps of the last step
        self.batch.warning[..., 1] = 1  # MuJoCo prints the first of each kind of warning
        # Scenes that are as the first one was share a copy of its model: it stays in the cache.
        self.usual = scene.fingerprint(), copy.copy(scene.model)
        self.models: list[mujoco.MjModel] = [self.usual[1]] * n
        self.seen: list[Any] = [None] * n  # the model and revision of each scene
        self.read = scene.rows(self.batch)
        self._width = len(scene.command)
        self._commands = self.batch.bind("ctrl")
        model = scene.model
        self._motions = self.batch.state[:, 1 : 1 + model.nq + model.nv + model.na]
        self.lock = threading.RLock()  # held at the end by the main thread, which may step on
        _ALL.add(self)

    def take(self, index: int, scene: Realization) -> None:
        """Take over the state of a scene."""
        mujoco.mj_getState(scene.model, scene.data, self.batch.state[index], STATE)
        self.taken[index] = 0

    def give_back(self, index: int, scene: Realization) -> None:
        """Copy everything that the last step left, or the numbers that give it again."""
        if scene.lean and self.taken[index]:
            mujoco.mj_setState(scene.model, scene.data, self.batch.state[index], STATE)
            scene.replay = self.before[index].copy(), int(self.taken[index])
        elif not scene.lean:
            self.batch.get_data(index, scene.data)

    def step(
        self, which: NDArray[np.int32], commands: Floats, substeps: int, into: Floats
    ) -> EngineFailure | None:
        """Step some of the simulations and read them; return what went wrong."""
        batch, width, failed = self.batch, self._width, None
        everyone = len(which) == len(self.models)
        rows = slice(None) if everyone else which
        self._commands[rows, :width] = commands[rows, :width]
        if self.before.size:
            self.before[rows], self.taken[rows] = batch.state[rows], substeps
        try:
            with self.lock:
                batch.step(ids=None if everyone else which, nstep=substeps)
        except SimulationError as error:
            ids = error.ids.tolist()
            failed = EngineFailure(f"MuJoCo: {error}", "mujoco", row=ids[0], lost=tuple(ids))
        counts, wrong = batch.warning[..., 1], self.read(which, into)
        if counts.max() == 1 and wrong < 0:
            return failed
        size = self.structure.layout.size
        gone = (counts[which, LOST] > 1).any(axis=1)
        gone |= ~(np.abs(self._motions[which]) <= MOST).all(axis=1)
        full, rows = (counts[which, FILLED] > 1).any(axis=1), which[gone].tolist()
        counts[:] = 1
        if rows and failed is None:
            row, time = rows[0], float(batch.state[rows[0], 0])
            said = FULL if full[gone][0] else lost(self.structure, into[row, :size], time)
            failed = EngineFailure(said, "mujoco", row=row, diverged=True)
        if failed is not None:
            failed.lost = tuple(sorted({*failed.lost, *rows}))
        return failed


@final
class MujocoBatch(SeparateScenes):
    """Scenes of MuJoCo, each with its own parameters, stepped by C threads.

    While a scene is stepped here, its state is in a slot. Any other call of its backend copies the
    state back. Results are bit-identical to those of single scenes, with any number of threads.
    """

    may_refuse: ClassVar[bool] = False

    def __init__(self, backends: Sequence[MujocoBackend], threads: int = 1) -> None:
        super().__init__(backends, threads)
        self._threads = max(1, min(threads, len(self._backends)))
        self._groups: dict[Model, Simulations] = {}
        self._slots: list[Slot | None] = [None] * len(self._backends)
        self._process = os.getpid()
        self._last: Simulations | None = None  # if all were stepped in one group

    def step(self, which: Integers, commands: Floats, substeps: int, into: Floats) -> None:
        """Hold commands for some physics steps.

        Raises:
            EngineFailure: Some scenes lost their state; all were stepped.
        """
        if self._process != os.getpid():
            # Threads do not survive a fork, so all simulations are made again.
            self._groups, self._slots = {}, [None] * len(self._backends)
            self._process, self._last = os.getpid(), None
        failed: EngineFailure | None = None
        for group, members in self._grouped(which):
            found = group.step(members, commands, substeps, into)
            if found is not None:
                failed = found.after(failed)
        if failed is not None:
            raise failed

    def _grouped(self, which: Integers) -> Iterable[tuple[Simulations, NDArray[np.int32]]]:
        """Move the states of scenes to their slots; return these by structure."""
        everyone = len(which) == len(self._backends)
        slots = [backend.slot for backend in self._backends] if everyone else None
        if self._last is not None and slots == self._slots:
            return [(self._last, which.astype(np.int32))]
        groups: dict[Simulations, list[int]] = {}
        changed: set[Simulations] = set()
        for index in which.tolist():
            slot = group, _ = self._slot(index)
            groups.setdefault(group, []).append(index)
            scene = self._backends[index].move_to(slot)
            if group.seen[index] != (scene.model, scene.revision):
                group.seen[index] = scene.model, scene.revision
                alike = scene.fingerprint() == group.usual[0]
                group.models[index] = group.usual[1] if alike else scene.model
                changed.add(group)
        self._last = next(iter(groups)) if everyone and len(groups) == 1 else None
        for group in changed:
            group.batch.set_models(group.models)
        return [(group, np.array(members, dtype=np.int32)) for group, members in groups.items()]

    def _slot(self, index: int) -> Slot:
        """Return the slot of a scene in the group of its structure."""
        scene, slot = self._backends[index].realization, self._slots[index]
        if slot is not None and slot[0].structure == scene.structure:
            return slot
        self._slots[index], group = None, self._groups.get(scene.structure)
        if group is None:
            used = {slot[0] for slot in self._slots if slot is not None}
            unused = [key for key, other in self._groups.items() if other not in used]
            for key in unused[: max(0, len(self._groups) + 1 - KEPT)]:
                del self._groups[key]
            group = Simulations(scene, len(self._backends), self._threads)
            self._groups[scene.structure] = group
        slot = self._slots[index] = group, index
        return slot
