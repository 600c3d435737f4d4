"""Many scenes in mujoco-warp."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, ClassVar, Self, final

import mujoco
import mujoco_warp as mjw
import numpy as np
from mujoco_warp import OverflowType
from numpy.typing import NDArray

from scm_world._types import Floats, Integers
from scm_world.backends.base import ContactPoint, EngineSnapshot, Scenes
from scm_world.backends.mujoco.contacts import Touches, named
from scm_world.backends.mujoco.fields import FRICTIONS
from scm_world.backends.mujoco.reading import compiled
from scm_world.backends.mujoco.realization import lost
from scm_world.backends.mujoco.states import MOST, into_bodies, read_rows, table_of, turned_bodies
from scm_world.backends.warp.constants import NOTHING, Constants, Derivation, Rows
from scm_world.backends.warp.device import FATAL, GROWS, STATE, Engine, SharedModel
from scm_world.errors import EngineFailure, ScmWorldError
from scm_world.models.model import REPORTED, Model
from scm_world.models.scene import (
    Difference,
    ParameterKey,
    Parameters,
    Scene,
    Structure,
    complete,
)

_NOBODY: tuple[Any, ...] = ((), np.empty((0, 7)), np.empty((0, 7)))


def prepared(structure: Model, device: str) -> tuple[SharedModel, Derivation]:
    """Put a structure on a device, once for each thread: constants are derived in one model."""
    return _prepared(structure, device, threading.get_ident())


@lru_cache(maxsize=32)
def _prepared(structure: Model, device: str, thread: int) -> tuple[SharedModel, Derivation]:
    base = SharedModel(compiled(structure), device)
    return base, Derivation(structure, base.model)


@final
class Group:
    """The scenes of one structure: all their numbers on the host, and the engine that steps them.

    Between two steps the host has the truth. Parameters that are read back are those of the
    engine.

    Attributes:
        structure: Their structure.
        derive: Derives the constants of one of them.
        rows: What a step continues from, shape (capacity, width).
        constants: The ``Constants`` of each.
    """

    def __init__(self, structure: Model, device: str) -> None:
        self.structure = structure
        self._base, self.derive = prepared(structure, device)
        self._engine: Engine | None = None
        mj = self._base.mj
        data, width = mujoco.MjData(mj), 0
        self._slices, parts = dict[str, slice](), []
        for name in STATE:
            values = np.atleast_1d(getattr(data, name))
            if values.size:
                self._slices[name] = slice(width, width + values.size)
                width += values.size
                parts.append(values)
        self._start = np.concatenate(parts).astype(np.float32)
        count = mj.nq + mj.nv + mj.na
        self._motion = slice(1, 1 + count)  # after the time
        self._places = np.concatenate([structure.places(a)[1] for a in ("qpos", "qvel", "act")])
        self._names, self._turned, self._own = turned_bodies(structure, mj)
        reported = structure.places(REPORTED)
        pairs = np.stack([np.arange(count), self._places])
        self._table = table_of(pairs, reported, self._turned)
        self._forces = self._slices["qfrc_actuator"] if reported.size else None
        self._settable = structure.layout.can_be_set
        self._free: list[int] = []
        self.rows = np.empty((0, width), dtype=np.float32)
        self.constants, self._last, self._touch = (np.empty(0, dtype=object) for _ in range(3))
        # As states were set after the last step, with 64 bits; nan if they were not.
        self._written = np.empty((0, structure.layout.size))
        self._fields: Rows = {}
        self._pending, self._live = np.zeros(0, dtype=bool), np.zeros(0, dtype=bool)
        self._floor: float | None = None  # see ``floor``
        self._is_watched = False  # whether anybody reads states on the device
        self._found: tuple[int, dict[str, Any]] = (-1, {})

    def add(self, constants: Constants) -> int:
        """Return the number of a new scene, in the state of the compiled model, before any step."""
        if not self._free:
            self._enlarge()
        slot = self._free.pop()
        here = np.array([slot])
        self.adopt(here, constants)
        self.reset(here)
        return slot

    def remove(self, slot: int) -> None:
        """Forget a scene."""
        self.adopt(np.array([slot]), NOTHING)
        self._live[slot] = False
        self._free.append(slot)

    def reset(self, slots: Integers) -> None:
        """Forget every step of some scenes."""
        self.rows[slots] = self._start
        self._written[slots], self._touch[slots], self._live[slots] = np.nan, None, False
        for slot in slots.tolist():
            self._last[slot] = _NOBODY

    def _enlarge(self) -> None:
        count = len(self.rows)
        more = max(1, count)
        self._keep_touches(np.zeros(count, dtype=bool))
        self._free = [*range(count + more - 1, count - 1, -1)]
        self.rows = np.concatenate([self.rows, np.repeat(self._start[None], more, axis=0)])
        nothing = np.full(more, None, dtype=object)
        self._last, self._touch = (
            np.concatenate([one, nothing]) for one in (self._last, self._touch)
        )
        blank = np.full((more, self._written.shape[1]), np.nan)
        self._written = np.concatenate([self._written, blank])
        self.constants = np.concatenate([self.constants, np.full(more, NOTHING, dtype=object)])
        for name, rows in self._fields.items():
            usual = np.repeat(self.derive.defaults[name][None], more, axis=0)
            self._fields[name] = np.concatenate([rows, usual])
        self._live = np.zeros(count + more, dtype=bool)
        self._pending = np.ones(count + more, dtype=bool)
        self._engine = None

    # --- parameters ----------------------------------------------------------------------------

    def adopt(self, slots: Integers, constants: Constants) -> None:
        """Set the constants of some scenes."""
        for name in constants.rows.keys() - self._fields.keys():
            usual = self.derive.defaults[name][None]
            self._fields[name] = np.repeat(usual, len(self.rows), axis=0)
        for name, rows in self._fields.items():
            rows[slots] = constants.rows.get(name, self.derive.defaults[name])
        for slot in slots.tolist():
            self.constants[slot] = constants
        self._pending[slots] = True

    def all_parameters(self, slot: int) -> Parameters:
        """Return all parameters of a scene."""
        return {**self.structure.defaults, **self.constants[slot].parameters}

    def edited(
        self, slots: Integers, parameters: Parameters
    ) -> Iterator[tuple[list[int], Callable[[], Constants]]]:
        """Group scenes that will have the same parameters.

        Returned are their places among ``slots``, and what derives their constants.

        Raises:
            UnknownOption: There is no such parameter.
        """
        self.derive.scene.check(parameters)
        values = {key: np.asarray(value, dtype=np.float64) for key, value in parameters.items()}
        alike: dict[Any, list[int]] = {}
        differ = [value for value in values.values() if len(value) > 1]
        for place, slot in enumerate(slots.tolist()):
            own = b"".join([value[place].tobytes() for value in differ])
            alike.setdefault((self.constants[slot].content, own), []).append(place)
        for places in alike.values():
            first = places[0]
            before = self.constants[slots[first]].parameters
            own_ones = {key: value[first * (len(value) > 1)] for key, value in values.items()}

            def derived(before: Parameters = before, own: Parameters = own_ones) -> Constants:
                kept = {key: value for key, value in before.items() if key not in own}
                return self.derive({**kept, **self.derive.changed(own)})

            yield places, derived

    def synced(self) -> Engine:
        """Return the engine, with the parameters of all scenes on the device."""
        engine = self._engine
        if engine is None:
            engine = self._engine = Engine(self._base, len(self.rows))
            self._pending[:] = True
        if self._pending.any():
            for name, rows in self._fields.items():
                column = engine.field(name)
                column.host[self._pending] = rows[self._pending]
                column.push()
            for constants in self.constants[self._pending]:
                if constants.switches:
                    engine.switch(constants.switches)
            self._pending[:] = False
        return engine

    def parameters(
        self, slots: Integers, keys: Iterable[ParameterKey]
    ) -> dict[ParameterKey, Floats]:
        """Read parameters back from the device, each of shape (m, *shape).

        A parameter is the number that C has, if the device has all that follows from it, rounded to
        32 bits, to the last bit.

        Raises:
            UnknownOption: There is no such parameter.
            EngineFailure: The device has other numbers.
        """
        wanted, bodies = tuple(keys), self.structure.body_names
        derived = [k for k in wanted if k[1] == "inertia" and k[0] in bodies]
        own = [key for key in wanted if key in self.structure.rows]
        self.derive.scene.check([key for key in wanted if key not in {*own, *derived}])
        engine = self.synced()
        wrong = [name for name, rows in self._fields.items() if engine.differs(name, slots, rows)]
        if wrong:
            said = f"the device does not have the numbers of {', '.join(wrong)} that it was given"
            raise EngineFailure(said, "warp")
        defaults, found = self.structure.defaults, dict[ParameterKey, Floats]()
        constants = self.constants[slots]
        for key in own:
            default = defaults[key]
            if any(key in one.parameters for one in constants):
                found[key] = np.stack([one.parameters.get(key, default) for one in constants])
            else:
                found[key] = np.repeat(default[None], len(slots), axis=0)
        for key in derived:
            at = slice(3 * bodies.index(key[0]), 3 * bodies.index(key[0]) + 3)
            usual = self.derive.defaults["body_inertia"]
            moments = [one.rows.get("body_inertia", usual)[at] for one in constants]
            shortest = [[float(str(number)) for number in row] for row in moments]
            found.setdefault(key, np.array(shortest, dtype=np.float64))
        return found

    # --- states --------------------------------------------------------------------------------

    def read(self, slots: Integers) -> Floats:
        """Return states, shape (m, layout.size); as they were set, if no step came after."""
        rows, size = self.rows[slots].astype(np.float64), self.structure.layout.size
        found = np.empty((len(slots), size))
        forces = np.empty((0, 0)) if self._forces is None else rows[:, self._forces]
        which = np.arange(len(slots), dtype=np.int32)
        read_rows(rows[:, self._motion], forces, self._table, which, found)
        written = self._written[slots]
        np.copyto(found, written, where=self._settable & ~np.isnan(written))
        return found

    @np.errstate(over="ignore", invalid="ignore")
    def place(self, slots: Integers, vectors: Floats) -> None:
        """Write states; all else stays as it is. Values that the last step left stay exact."""
        motions = vectors[:, self._places]
        for place, slot in enumerate(slots.tolist()):
            written = vectors[place].copy()
            if self._names:
                names, known, exact = self._remembered(slot)
                if names != self._names:
                    where = [names.index(n) if n in names else -1 for n in self._names]
                    nobody = np.full((1, 7), np.nan)
                    known, exact = (np.vstack([part, nobody])[where] for part in (known, exact))
                motion = np.ascontiguousarray(motions[place])
                into_bodies(written, self._turned, self._own, known, exact, motion)
                motions[place] = motion
                for turn in self._turned[:, :4]:
                    if written[turn[3]] < 0.0:
                        written[turn] = -written[turn]
            self._written[slot] = written
        self.rows[slots, self._motion] = motions

    def _remembered(self, slot: int) -> Any:
        """Return what the last step left of turned bodies, before the first change."""
        if self._last[slot] is None:
            vector = self.read(np.array([slot]))[0]
            motion = self.rows[slot, self._motion].astype(np.float64)
            self._last[slot] = self._names, vector[self._turned], motion[self._own]
        return self._last[slot]

    def follow(self, slot: int, before: Group, there: int) -> None:
        """Continue after the last step of a scene of another structure."""
        self.rows[slot, 0] = before.rows[there, 0]
        self._last[slot] = before._remembered(there) if before._names else _NOBODY
        self._touch[slot] = before.touches(there)
        old = {row.name: row for row in before.structure.states if row.reported}
        for row in (row for row in self.structure.states if row.reported and row.name in old):
            at = self._slices["qfrc_actuator"].start + np.array(row.numbers)
            of = before._slices["qfrc_actuator"].start + np.array(old[row.name].numbers)
            self.rows[slot, at] = before.rows[there, of]

    def tensor(self, slots: Integers, name: str) -> Any:
        """Return a state of scenes that follow one another, as a view of the device's array.

        Raises:
            EngineFailure: The device has it in another form, or the scenes have other places.
        """
        row: Any = next((row for row in self.structure.states if row.name == name), None)
        first, last = (row.numbers[0], row.numbers[-1] + 1) if row else (0, 0)
        plain = row is not None and row.array in self._slices and row.kind == "real"
        plain = plain and row.numbers == tuple(range(first, last))
        if not plain or (row.frame == "world" and row.array == "qvel"):
            said = (
                f"{name} is not a state that the device has as it is; world[{name!r}] computes it"
            )
            raise EngineFailure(said, "warp")
        if (np.diff(slots) != 1).any():
            raise EngineFailure("the worlds have different structures; read world[name]", "warp")
        self._is_watched = True
        engine = self.synced()
        self._show(engine, np.arange(len(self.rows)))
        array = engine.state[row.array].array[int(slots[0]) : int(slots[-1]) + 1, first:last]
        return array.numpy() if array.device.is_cpu else array

    def resident(self, slots: Integers, copies: Counter[str]) -> Any:
        """Return what steps all scenes on the device; they follow one another."""
        from scm_world.backends.warp.resident import Resident  # needs torch

        if (np.diff(slots) != 1).any():
            raise EngineFailure("the worlds do not follow one another", "warp")
        return Resident(self, slots, self._places, self._turned, copies)

    def numbers(self, slots: Integers) -> dict[str, NDArray[np.float32]]:
        """Return what a step continues from in some scenes, by name, shape (m, k) each."""
        return {name: self.rows[slots, where] for name, where in self._slices.items()}

    def adopt_step(self, slots: Integers, numbers: Mapping[str, NDArray[np.float32]]) -> None:
        """Take over what a step has left in some scenes, without its contacts."""
        for name, where in self._slices.items():
            self.rows[slots, where] = numbers[name]
        self._written[slots], self._live[slots] = np.nan, False
        self._last[slots] = self._touch[slots] = None

    def _show(self, engine: Engine, slots: Integers) -> None:
        """Write the states of some scenes to the device."""
        for name, where in self._slices.items():
            engine.state[name].host[slots] = self.rows[slots, where]
            engine.state[name].push()

    def saved(self, slot: int) -> tuple[Any, ...]:
        """Return everything of a scene beside its structure; it can be pickled."""
        memory = self._written[slot].copy(), self._last[slot], self.touches(slot)
        return self.constants[slot], self.rows[slot].copy(), memory

    def restore(self, slot: int, saved: tuple[Any, ...]) -> None:
        """Write a saved state into a scene."""
        constants, row, memory = saved
        if constants is not self.constants[slot]:
            self.adopt(np.array([slot]), constants)
        self.rows[slot], self._live[slot] = row, False
        self._written[slot], self._last[slot], self._touch[slot] = memory

    def step(
        self, slots: Integers, commands: Floats, substeps: int
    ) -> tuple[Floats, dict[int, str]]:
        """Step some scenes; return their states, and why some are lost, by place."""
        engine, reasons = self.synced(), dict[int, str]()
        staying = np.ones(len(self.rows), dtype=bool)
        staying[slots] = False
        self._keep_touches(~staying)
        place_of = {slot: place for place, slot in enumerate(slots.tolist())}
        sound = (np.abs(self.rows[slots, self._motion]) <= MOST).all(axis=1)
        going = slots[sound]
        while len(going):
            for name, column in engine.state.items():
                if name in self._slices:
                    column.host[:] = self._start[self._slices[name]]
                    column.host[going] = self.rows[going, self._slices[name]]
                else:
                    column.host[:] = 0
            if "ctrl" in engine.state:
                rows = commands[[place_of[slot] for slot in going.tolist()]]
                engine.state["ctrl"].host[going, : rows.shape[1]] = rows
            for column in engine.state.values():
                column.push()
            engine.step(substeps)
            over = engine.state["overflow"].host[:, 0]
            full = (over[going] & GROWS) != 0  # those that are parked do not count
            if not full.any():
                break
            grew, worst = engine.grow(over)
            blamed = np.isin(going, worst)
            if not grew and not blamed.any():
                blamed = full
            for slot in going[blamed].tolist():
                reasons[place_of[slot]] = FULL
            going = going[~blamed]
        for name, where in self._slices.items():
            self.rows[going, where] = engine.state[name].host[going]
        if self._is_watched:
            self._show(engine, np.setdiff1d(np.arange(len(self.rows)), going))
        self._live[:] = False
        self._live[going] = True
        self._written[slots] = np.nan
        self._last[slots] = self._touch[slots] = None
        found = self.read(slots)
        sound = (np.abs(self.rows[slots, self._motion]) <= MOST).all(axis=1)
        for place in np.flatnonzero(~sound).tolist():
            time = float(self.rows[slots[place], 0])
            said = lost(self.structure, found[place], time, "mujoco-warp")
            reasons.setdefault(place, said)
        if len(going):
            full = np.flatnonzero(engine.state["overflow"].host[slots, 0] & FATAL)
            for place in full.tolist():
                bits = int(engine.state["overflow"].host[slots[place], 0]) & FATAL
                names = ", ".join(
                    one.name or "" for one in OverflowType if one & bits and one != OverflowType.ALL
                )
                reasons.setdefault(place, f"mujoco-warp has no memory for {names} of this state")
        return found, reasons

    # --- contacts ------------------------------------------------------------------------------

    def floor(self) -> float:
        """Measure how far apart equal runs are on this device: 50 random control steps, twice.

        The largest difference of any number of a state, in 64 worlds that are alike.
        """
        if self._floor is not None:
            return self._floor
        here, commands = Group(self.structure, self._base.device), self.structure.n_commands
        slots = np.array([here.add(NOTHING) for _ in range(64)])
        runs, seen = [], range(2)
        for _ in seen:
            here.reset(slots)
            random = np.random.default_rng(0)
            for _ in range(50):
                found, _ = here.step(slots, random.uniform(-1.0, 1.0, (64, commands)), 5)
            runs.append(found)
        self._floor = float(np.abs(runs[0] - runs[1]).max())
        return self._floor

    def touches(self, slot: int) -> Touches:
        """Copy the contacts of the last physics step of a scene."""
        owners = self.structure.owners
        if not self._live[slot]:
            kept: Touches | None = self._touch[slot]
            return kept or (owners, np.empty((0, 2), dtype=np.int64), np.empty((0, 8)))
        engine = self._engine
        assert engine is not None  # noqa: S101 # it has stepped the scene
        if self._found[0] != engine.launched:
            self._found = engine.launched, engine.touches()
        found = self._found[1]
        at = slice(*found["starts"][slot : slot + 2].tolist())
        numbers = np.zeros((at.stop - at.start, 8))
        numbers[:, :3], numbers[:, 6] = found["pos"][at], found["dist"][at]
        numbers[:, 3:6] = found["frame"][at][:, 0]
        shapes = found["geom"][at].astype(np.int64)
        if "flex" in found:
            shapes = np.where(shapes < 0, self._base.mj.ngeom + found["flex"][at], shapes)
        forces, pyramids = found["force"][slot], self._base.mj.opt.cone == _PYRAMID
        for i, (rows, size) in enumerate(
            zip(found["efc_address"][at], found["dim"][at], strict=True)
        ):
            if rows[0] >= 0:
                several = 2 * (int(size) - 1) if pyramids and size > 1 else 1
                numbers[i, 7] = forces[rows[:several]].astype(np.float64).sum()
        return owners, shapes, numbers

    def _keep_touches(self, stepped: NDArray[np.bool_]) -> None:
        """Copy the contacts of scenes that the engine is about to forget."""
        for slot in np.flatnonzero(self._live & ~stepped).tolist():
            self._touch[slot] = self.touches(slot)
            self._live[slot] = False


_PYRAMID = int(mujoco.mjtCone.mjCONE_PYRAMIDAL)

FULL = (
    "mujoco-warp has no memory for all contacts and constraints of this state: a world has at most "
    "2048 contacts and 8192 rows of constraints"
)


@final
class WarpScenes(Scenes):
    """Scenes on one device, those of one structure in arrays with a row for each.

    Attributes:
        device: Name of the device of Warp.
        name: Name of the engine with its device.
    """

    may_refuse: ClassVar[bool] = False
    stays: ClassVar[bool] = True
    version = mjw.__version__

    def __init__(self, n: int, threads: int = 1, device: str = "cpu") -> None:
        self.device, self.name = device, f"warp:{device}"
        self._groups: dict[Model, Group] = {}
        self._where: list[tuple[Group, int] | None] = [None] * n

    @classmethod
    def made_by(cls, make: Callable[[], Any], n: int, threads: int = 1) -> Self:
        """Return an engine of n scenes, on the device of a backend that ``make`` makes."""
        return cls(n, threads, make().device)

    def __len__(self) -> int:
        return len(self._where)

    def _at(self, index: int) -> tuple[Group, int]:
        found = self._where[index]
        if found is None:
            raise EngineFailure("there is no scene; call build() first", self.name)
        return found

    def structure(self, index: int) -> Structure:
        """Return the compiled structure of a scene."""
        return self._at(index)[0].structure

    def _group(self, structure: Structure) -> Group:
        """Return the group of a structure, made if there is none."""
        model = Model.of(structure, "mujoco-warp")
        if model not in self._groups:
            used = {where[0].structure for where in self._where if where is not None}
            self._groups = {m: one for m, one in self._groups.items() if m in used}
            self._groups[model] = Group(model, self.device)
        return self._groups[model]

    def _grouped(self, which: Integers) -> list[tuple[Group, Integers, Integers]]:
        """Group scenes by structure: the group, their places in ``which``, their slots there."""
        found: dict[Group, list[tuple[int, int]]] = {}
        for place, index in enumerate(which.tolist()):
            group, slot = self._at(index)
            found.setdefault(group, []).append((place, slot))
        pairs = {group: np.array(each) for group, each in found.items()}
        return [(group, each[:, 0], each[:, 1]) for group, each in pairs.items()]

    def _move(self, index: int, group: Group, slot: int) -> None:
        before = self._where[index]
        self._where[index] = group, slot
        if before is not None:
            before[0].remove(before[1])

    def build(self, which: Integers, scene: Scene) -> None:
        """Realise one scene from nothing in each of some places."""
        group = self._group(scene.structure)
        constants = group.derive(group.derive.changed(scene.parameters))
        slots = []
        for index in which.tolist():
            now = self._where[index]
            if now is None or now[0] is not group:
                self._move(index, group, group.add(constants))
            slots.append(self._at(index)[1])
        here = np.array(slots)
        group.adopt(here, constants)
        group.reset(here)
        group.place(here, np.repeat(scene.state.vector[None], len(here), axis=0))

    def apply(
        self,
        which: Integers,
        parameters: Parameters,
        states: Floats | None = None,
        structure: Structure | None = None,
    ) -> None:
        """Change some scenes without advancing time.

        Scenes that have the same parameters afterwards cost one derivation of constants.
        """
        first: ScmWorldError | None = None
        refused = list[int]()

        def refuse(error: ScmWorldError, places: Iterable[int]) -> None:
            nonlocal first
            first = first or error
            refused.extend(places)

        for group, places, slots in self._grouped(which):
            if structure is not None and structure != group.structure:
                for place in places.tolist():
                    own = {k: np.array(v[place * (len(v) > 1)]) for k, v in parameters.items()}
                    vector = None if states is None else states[place].copy()
                    try:
                        self._rebuild(int(which[place]), structure, own, vector)
                    except ScmWorldError as error:
                        refuse(error, [place])
                continue
            taken = np.ones(len(places), dtype=bool)
            try:
                here = {k: v[places] if len(v) > 1 else v for k, v in parameters.items()}
                for members, derived in group.edited(slots, here) if here else ():
                    try:
                        group.adopt(slots[members], derived())
                    except ScmWorldError as error:
                        refuse(error, places[members].tolist())
                        taken[members] = False
            except ScmWorldError as error:
                refuse(error, places.tolist())
                taken[:] = False
            if states is not None and taken.any():
                group.place(slots[taken], np.asarray(states[places[taken]], dtype=np.float64))
        if first is not None:
            first.scenes = tuple(sorted(int(which[place]) for place in refused))
            raise first

    def _rebuild(
        self, index: int, structure: Structure, parameters: Parameters, vector: Floats | None
    ) -> None:
        """Set the structure of a scene."""
        before, there = self._at(index)
        state = before.structure.empty_state().with_vector(before.read(np.array([there]))[0])
        now = Scene(before.structure, before.all_parameters(there), state)
        new = None if vector is None else structure.empty_state().with_vector(vector)
        change = complete(now, structure, Difference(structure, parameters, new))
        group = self._group(structure)
        constants = group.derive(group.derive.changed(change.parameters))
        slot = group.add(constants)
        group.follow(slot, before, there)
        self._move(index, group, slot)
        if change.state is not None:
            group.place(np.array([slot]), change.state.vector[None])

    def parameters(
        self, which: Integers, keys: Iterable[ParameterKey]
    ) -> dict[ParameterKey, Floats]:
        """Read parameters back from the device."""
        wanted, found = tuple(keys), dict[ParameterKey, Floats]()
        for group, places, slots in self._grouped(which):
            for key, values in group.parameters(slots, wanted).items():
                if key not in found:
                    found[key] = np.empty((len(which), *values.shape[1:]))
                found[key][places] = values
        return found

    def read(self, which: Integers) -> Floats:
        """Return the present states of some scenes."""
        groups = self._grouped(which)
        found = np.empty((len(which), groups[0][0].structure.layout.size))
        for group, places, slots in groups:
            found[places] = group.read(slots)
        return found

    def step(self, which: Integers, commands: Floats, substeps: int, into: Floats) -> None:
        """Hold commands for some physics steps.

        Raises:
            EngineFailure: Some scenes lost their state; all others were stepped.
        """
        failed: EngineFailure | None = None
        for group, places, slots in self._grouped(which):
            members, structure = which[places], group.structure
            given = commands[members, : structure.n_commands]
            states, reasons = group.step(slots, given, substeps)
            into[members, : structure.layout.size] = states
            if reasons:
                gone = sorted((int(members[place]), said) for place, said in reasons.items())
                row, said = gone[0]
                rows = tuple(index for index, _ in gone)
                error = EngineFailure(said, self.name, row=row, lost=rows, diverged=True)
                failed = error.after(failed)
        if failed is not None:
            failed.lost = tuple(sorted(failed.lost))
            raise failed

    def contacts(self, which: Integers) -> tuple[tuple[ContactPoint, ...], ...]:
        """List the contact points of the last physics step of some scenes."""
        return tuple(named(group.touches(slot)) for group, slot in map(self._at, which.tolist()))

    def tensor(self, which: Integers, name: str) -> Any:
        """Return a state of some scenes as the device has it, shape (m, size), in 32 bits."""
        groups = self._grouped(which)
        if len(groups) > 1:
            raise EngineFailure("the worlds have different structures; read world[name]", self.name)
        return groups[0][0].tensor(groups[0][2], name)

    def resident(self, which: Integers, copies: Counter[str]) -> Any:
        """Return what steps scenes whose states stay on the device; see ``Resident``."""
        groups = self._grouped(which)
        if len(groups) > 1:
            raise EngineFailure("the worlds have different structures", self.name)
        return groups[0][0].resident(groups[0][2], copies)

    def remarks(self, index: int, before: Parameters) -> tuple[str, ...]:
        """List which of some changed parameters of a scene have no effect, and why."""
        group, slot = self._at(index)
        if not any(attribute in FRICTIONS for _, attribute in before):
            return ()
        group.derive.load(group.constants[slot].parameters)
        return group.derive.scene.remarks(before)

    def floor(self, index: int) -> float:
        """Return how far apart two equal runs of a scene are; 0 on the CPU device."""
        return self._at(index)[0].floor() if self.device != "cpu" else 0.0

    def snapshot(self, which: Integers) -> tuple[EngineSnapshot, ...]:
        """Save some scenes, each by itself."""
        engine: Any = self
        return tuple(
            EngineSnapshot.of(engine, (group.structure, *group.saved(slot)))
            for group, slot in map(self._at, which.tolist())
        )

    def restore(self, which: Integers, snapshots: Sequence[EngineSnapshot]) -> None:
        """Restore one snapshot for each scene, or a single one in all of them."""
        engine: Any = self
        opened = [snapshot.opened(engine) for snapshot in snapshots]
        for place, index in enumerate(which.tolist()):
            structure, *saved = opened[place * (len(opened) > 1)]
            group, now = self._group(structure), self._where[index]
            if now is None or now[0] is not group:
                self._move(index, group, group.add(saved[0]))
            group.restore(self._at(index)[1], tuple(saved))

    def close(self) -> None:
        """Free the memory on the device."""
        self._groups, self._where = {}, [None] * len(self._where)
