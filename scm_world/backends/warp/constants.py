"""The numbers of a model that differ between worlds, derived by MuJoCo's own C code.

Parameters are written by the slots of the MuJoCo backend into one model, where C derives what
follows from them (``mj_setConst``; Warp's ``set_const`` gives other numbers for joints that cannot
translate, or not rotate). Then every word of the model is compared with the compiled one, so that
no derived array can be forgotten.
"""

from __future__ import annotations

import copy
import ctypes
import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, final

import mujoco
import mujoco_warp as mjw
import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.backends.mujoco.realization import OF_DATA, Realization
from scm_world.backends.warp.device import STATIC, batched_names, put
from scm_world.errors import NotIntervenable
from scm_world.geometry.numbers import njit
from scm_world.models.model import Model
from scm_world.models.scene import ParameterKey, Parameters

OPTIONS = "gravity", "wind", "magnetic", "timestep", "density", "viscosity", "impratio_invsqrt"
"""Options that worlds can differ in, as the device calls them."""
MOVES = frozenset({"body_pos", "body_quat", "geom_pos", "geom_quat"})
UNUSED = frozenset({"eq_active0", "dof_length"})
"""Arrays that the device has once for all worlds, and reads only in a reset or for sleep."""

Rows = dict[str, NDArray[Any]]
"""Values of device arrays for one world, flat, by name."""


@njit(cache=True)
def _compare(
    words: NDArray[np.uint64],
    compiled: NDArray[np.uint64],
    owners: NDArray[np.int16],
    found: NDArray[np.bool_],
) -> None:
    for i in range(words.size):
        if words[i] != compiled[i]:
            found[owners[i]] = True


def _memory(model: mujoco.MjModel) -> tuple[NDArray[np.uint64], dict[str, tuple[int, int]]]:
    """Return the block of memory that has all arrays of a model, as words, and where each is."""
    arrays = {
        name: array
        for name in dir(model)
        if not name.startswith("_")
        and isinstance(array := getattr(model, name), np.ndarray)
        and array.size
    }
    starts = {name: int(array.ctypes.data) for name, array in arrays.items()}
    first = min(starts.values())
    last = max(starts[name] + array.nbytes for name, array in arrays.items())
    block: Any = (ctypes.c_uint64 * ((last - first) // 8)).from_address(first)
    where = {
        name: ((starts[name] - first) // 8, -(-(starts[name] - first + array.nbytes) // 8))
        for name, array in arrays.items()
    }
    return np.frombuffer(block, dtype=np.uint64), where


@final
@dataclass(frozen=True, eq=False)
class Constants:
    """What the parameters of a world make of the arrays of the device. It can be pickled.

    Attributes:
        parameters: Those that differ from the defaults.
        rows: All arrays that differ from the compiled model, as the device keeps them.
        switches: Names of what the device has to compute in addition.
    """

    parameters: Parameters
    rows: Rows
    switches: frozenset[str] = frozenset()

    @cached_property
    def content(self) -> tuple[Any, ...]:
        """The parameters, as something that can be compared and hashed."""
        return tuple(sorted((key, value.tobytes()) for key, value in self.parameters.items()))


NOTHING = Constants({}, {})
"""Those of the compiled model."""


@final
class Derivation:
    """Derives the constants of one structure, for one world after another.

    Attributes:
        scene: The model that is written to, without a state.
        defaults: The values of the compiled model of every array that worlds can differ in.
    """

    def __init__(self, structure: Model, reference: mjw.Model) -> None:
        self.scene = scene = Realization(structure, {})
        self._reference = reference
        self._defaults = structure.defaults
        self._words, where = _memory(scene.model)
        self._compiled = self._words.copy()
        fields = {field.name for field in dataclasses.fields(mjw.Model)}
        self._names = tuple(name for name in where if name in batched_names())
        self._fixed = tuple(sorted((fields & {*where}) - {*self._names} - UNUSED))
        kinds = {name: number for number, name in enumerate((*self._names, *self._fixed), 1)}
        self._owners = np.zeros(len(self._words), dtype=np.int16)
        for name, (start, end) in where.items():
            self._owners[start:end] = kinds.get(name, 0)
        self._found = np.zeros(1 + len(kinds), dtype=np.bool_)
        self._data = mujoco.MjData(scene.model)
        mujoco.mj_kinematics(scene.model, self._data)
        names = *self._names, *OPTIONS, *OF_DATA, *STATIC
        self.defaults: Rows = {name: row for name in names if (row := self._row(name)).size}
        self._others = tuple(name for name in (*OPTIONS, *OF_DATA) if name in self.defaults)
        self._patterns: dict[Any, frozenset[str]] = {}
        self._last = NOTHING

    def _row(self, name: str) -> NDArray[Any]:
        """Copy the present value of an array of the device."""
        mj, data = self.scene.model, self.scene.data
        if name == "impratio_invsqrt":
            ratio = max(mj.opt.impratio, mujoco.mjMINVAL)
            return np.array([1.0 / np.sqrt(ratio)], dtype=np.float32)
        owner = mj.opt if name in OPTIONS else data if name in OF_DATA else mj
        value = np.asarray(getattr(self._data if name in STATIC else owner, name)).ravel()
        kind = np.bool_ if name == "eq_active" or value.dtype == np.bool_ else np.float32
        return value.astype(value.dtype if value.dtype == np.int32 else kind)

    def changed(self, parameters: Parameters) -> dict[ParameterKey, Floats]:
        """Return copies of the parameters that are not those of the compiled model.

        Raises:
            UnknownOption: There is no such parameter.
        """
        self.scene.check(parameters)
        found = {}
        for key, value in parameters.items():
            given = np.array(value, dtype=np.float64)
            if given.tobytes() != self._defaults[key].tobytes():
                found[key] = given
        return found

    def load(self, parameters: Parameters) -> None:
        """Write the parameters of a world into the model; all others get their defaults.

        Raises:
            Infeasible: Nothing could move with them.
        """
        defaults = self._defaults
        back = {key: defaults[key] for key in self.scene.kept if key not in parameters}
        self.scene.edit({**back, **parameters})

    def __call__(self, parameters: Parameters) -> Constants:
        """Derive the constants of a world from the parameters that differ from the defaults.

        Raises:
            Infeasible: Nothing could move with them.
            NotIntervenable: The device cannot have such values in some worlds.
        """
        if not parameters:
            return NOTHING
        found = Constants(parameters, {})
        if found.content == self._last.content:
            return self._last
        self.load(parameters)
        self._found[:] = False
        _compare(self._words, self._compiled, self._owners, self._found)
        numbers = np.flatnonzero(self._found[1:]).tolist()
        count = len(self._names)
        names = [self._names[number] for number in numbers if number < count]
        fixed = [self._fixed[number - count] for number in numbers if number >= count]
        if fixed:
            raise self._refused(parameters, fixed)
        if not MOVES.isdisjoint(names):
            self._data.mocap_pos[:], self._data.mocap_quat[:] = (
                self.scene.data.mocap_pos,
                self.scene.data.mocap_quat,
            )
            mujoco.mj_kinematics(self.scene.model, self._data)
            names += [name for name in STATIC if name in self.defaults]
        rows = {name: self._row(name) for name in (*names, *self._others)}
        for name in self._others:
            if rows[name].tobytes() == self.defaults[name].tobytes():
                del rows[name]
        self._last = Constants(parameters, rows, self._switches(parameters, rows))
        return self._last

    def _switches(self, parameters: Parameters, rows: Rows) -> frozenset[str]:
        """Find out what the device leaves out because the compiled model has only zeros there."""
        pattern = tuple((name, (row != 0).tobytes()) for name, row in rows.items())
        if pattern in self._patterns:
            return self._patterns[pattern]
        new, switches = put(copy.copy(self.scene.model)), set[str]()
        for field in dataclasses.fields(mjw.Model):
            if field.name in batched_names() or field.name in ("opt", *UNUSED):
                continue
            here, there = getattr(self._reference, field.name), getattr(new, field.name)
            if hasattr(here, "numpy"):
                if not np.array_equal(here.numpy(), there.numpy()):
                    raise self._refused(parameters, [field.name])
            elif isinstance(here, bool | np.bool_):
                if there and not here:
                    switches.add(field.name)
            elif isinstance(here, int | np.integer) and here != there:
                raise self._refused(parameters, [field.name])
        self._patterns[pattern] = frozenset(switches)
        return self._patterns[pattern]

    def _refused(self, parameters: Parameters, names: Iterable[str]) -> NotIntervenable:
        self._last = NOTHING
        self.load({})
        what = ", ".join(".".join(key).strip(".") for key in parameters)
        reason = f"mujoco-warp has {', '.join(names)} once for all worlds, and these values need"
        return NotIntervenable(what, f"{reason} another one; use backend='mujoco'")
