"""A model and the states of many worlds on a device of Warp."""

from __future__ import annotations

import copy
import dataclasses
import math
import os
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any, final

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from mujoco_warp import OverflowType
from mujoco_warp._src import types
from numpy.typing import NDArray
from warp._src.logger import get_logger

from scm_world._types import Floats, Integers
from scm_world.errors import ModelError, UnknownOption
from scm_world.models.model import REPORTED, Model

GROWS = int(
    OverflowType.NEFC
    | OverflowType.NJMAX_NNZ
    | OverflowType.BROADPHASE
    | OverflowType.NARROWPHASE
    | OverflowType.CCD
)
"""Overflows after which there is more memory, and the step is taken again."""
FATAL = int(
    OverflowType.HFIELD
    | OverflowType.CONTACT_MATCH
    | OverflowType.NVMAX
    | OverflowType.EPA_HORIZON
    | OverflowType.TACTILE
)
"""Overflows of memory that Warp has in one size only."""
MOST_CONTACTS, MOST_ROWS = 2048, 8192
"""How many contacts, and rows of constraints, a world may have at most."""
STATE = (
    "time", "qpos", "qvel", "act", "history", "plastic", "qacc_warmstart", "qfrc_actuator",
)  # fmt: skip
"""What a step continues from, and the forces that models report."""
STATIC = "geom_xpos", "geom_xmat"
"""Poses of shapes, which the device computes in each step only for those that can move."""
_DENSE = 60
"""The largest number of degrees of freedom with a dense Jacobian. Source: ``put_model``."""


@cache
def batched_names() -> frozenset[str]:
    """Return the names of the arrays of a model that worlds can differ in."""
    fields = dataclasses.fields(mjw.Model)
    return frozenset(f.name for f in fields if getattr(f.type, "shape", (0,))[:1] == ("*",))


# --- devices --------------------------------------------------------------------------------------


class _CompilerMessages:
    """Takes what Warp says; tells the user only that kernels are compiled, for how long and where.

    Args:
        device: The device that they are compiled for.
    """

    def __init__(self, device: str) -> None:
        self._device, self._start, self._count = device, time.monotonic(), 0

    def debug(self, message: str, **about: object) -> None:
        """Ignore it."""

    warning = error = debug

    def info(self, message: str) -> None:
        """Count the modules that were compiled, and not read from the cache."""
        if message.endswith("(compiled)"):
            self._count += 1
            if self._count == 1:
                where = f"they are kept in {wp.config.kernel_cache_dir}\n"
                sys.stderr.write(f"mujoco-warp compiles kernels for {self._device!r}; {where}")
            if self._count % 10 == 1:
                self.close()

    def close(self) -> None:
        """Print how many there are by now."""
        if self._count:
            seconds = time.monotonic() - self._start
            sys.stderr.write(f"  {self._count} of about 40 modules in {seconds:.0f} s\n")


@contextmanager
def quiet(device: str = "", *, compiles: bool = False) -> Iterator[None]:
    """Silence Warp; where it compiles, print that it does."""
    level, logger = wp.config.log_level, get_logger()
    listener = _CompilerMessages(device)
    wp.config.log_level = wp.LOG_INFO if compiles else wp.LOG_ERROR
    wp.set_logger(listener)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        wp.config.log_level = level
        wp.set_logger(logger)
        listener.close()


@contextmanager
def _muted() -> Iterator[None]:
    """Discard what C writes to the standard error: without a GPU, that there is no driver."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


@cache
def resolve(device: str) -> str:
    """Return the full name of a device of Warp, such as ``"cpu"`` or ``"cuda:0"``.

    Args:
        device: ``"cpu"``, ``"cuda"``, one of several as ``"cuda:1"``; a GPU if Warp sees one and
            else the CPU, if it is empty.

    Raises:
        UnknownOption: Warp does not see it.
    """
    with quiet(), _muted():
        wp.init()
        known = [str(one) for one in wp.get_devices()]
    if not device:
        return known[-1] if len(known) == 1 else str(wp.get_preferred_device())
    if device == "cuda" and "cuda:0" in known:
        return str(wp.get_device("cuda"))
    if device not in known:
        raise UnknownOption("device of backend 'warp'", device, (*known, "cuda", "left out"))
    return device


# --- models ---------------------------------------------------------------------------------------


def refusals(mj: mujoco.MjModel) -> list[str]:
    """List everything in a model that mujoco-warp does not compute, with what to do instead.

    It refuses by itself those parts of flexes that it does not compute.

    Source:
        ``put_model`` of mujoco-warp 4.0.0.
    """
    found, opt = [], mj.opt
    for values, known, kind in (
        (mj.actuator_trntype, types.TrnType, mujoco.mjtTrn),
        (mj.actuator_dyntype, types.DynType, mujoco.mjtDyn),
        (mj.actuator_gaintype, types.GainType, mujoco.mjtGain),
        (mj.actuator_biastype, types.BiasType, mujoco.mjtBias),
        (mj.eq_type, types.EqType, mujoco.mjtEq),
        (mj.geom_type, types.GeomType, mujoco.mjtGeom),
        (mj.sensor_type, types.SensorType, mujoco.mjtSensor),
        (mj.wrap_type, types.WrapType, mujoco.mjtWrap),
        ([opt.integrator], types.IntegratorType, mujoco.mjtIntegrator),
        ([opt.cone], types.ConeType, mujoco.mjtCone),
        ([opt.solver], types.SolverType, mujoco.mjtSolver),
    ):
        allowed = {int(one) for one in known}
        for value in sorted({int(one) for one in values} - allowed):
            names = ", ".join(one.name for one in known)
            found.append(f"{kind(value).name}; it has {names}")
    for flags, known, kind in (
        (opt.disableflags, types.DisableBit, mujoco.mjtDisableBit),
        (opt.enableflags, types.EnableBit, mujoco.mjtEnableBit),
    ):
        extra = int(flags) & ~sum(int(bit) for bit in known)
        found += [f"the flag {kind(1 << i).name}" for i in range(32) if extra >> i & 1]
    if opt.noslip_iterations and opt.integrator == int(mujoco.mjtIntegrator.mjINT_DISCRETE):
        found.append("noslip with the integrator 'discrete'; set noslip_iterations to 0")
    for kind in ("body", "actuator", "sensor"):
        if (getattr(mj, f"{kind}_plugin") >= 0).any():
            found.append(f"a plugin of a {kind}")
    if mj.nv > _DENSE and opt.jacobian == int(mujoco.mjtJacobian.mjJAC_DENSE):
        what = f"a dense Jacobian of {mj.nv} degrees of freedom, more than {_DENSE}"
        found.append(f"{what}; write jacobian='sparse' or 'auto'")
    if opt.enableflags & int(mujoco.mjtEnableBit.mjENBL_SLEEP):
        found.append("sleep, whose counters are not a state here; disable it")
    return found


def put(mj: mujoco.MjModel) -> Any:
    """Put a model on the present device; its memory overflows without a word.

    Raises:
        ModelError: It has something that mujoco-warp does not compute; everything is listed.
    """
    # Warp never resets a state, and has no midphase: neither flag changes its results.
    for bit in (mujoco.mjtDisableBit.mjDSBL_AUTORESET, mujoco.mjtDisableBit.mjDSBL_MIDPHASE):
        mj.opt.disableflags &= ~int(bit)
    problems = refusals(mj)
    if not problems:
        try:
            with quiet():
                model = mjw.put_model(mj)
        except (NotImplementedError, ValueError) as error:
            problems = [str(error).rstrip(".")]
        else:
            model.opt.warn_overflow = 0
            return model
    advice = "take it out of the model, leave it out by drop=, or use backend='mujoco'"
    raise ModelError([f"mujoco-warp does not compute {what}; {advice}" for what in problems])


@final
class SharedModel:
    """A compiled model on a device, shared by all worlds of one structure.

    Attributes:
        mj: The model.
        device: Name of the device.
        model: The same on the device, with one row for all worlds.
        contacts: How many contacts there is memory for in a world, at first: twice those of the
            state in which episodes begin, and at least 16.
        rows: How many rows of constraints, by the same rule: at least 32.
    """

    def __init__(self, mj: mujoco.MjModel, device: str) -> None:
        self.mj, self.device = copy.copy(mj), device
        with wp.ScopedDevice(device):
            self.model = put(self.mj)
        data = mujoco.MjData(mj)
        mujoco.mj_forward(mj, data)
        self.contacts = min(MOST_CONTACTS, 16 * math.ceil(max(8, data.ncon) / 8))
        self.rows = min(MOST_ROWS, 16 * math.ceil(max(16, data.nefc) / 8))
        with quiet(device, compiles=True), wp.ScopedDevice(device):
            mjw.step(self.model, mjw.make_data(self.mj, 1, nconmax=self.contacts, njmax=self.rows))

    def coupling(self, structure: Model, substeps: int) -> Floats:
        """Return how far bodies that do not touch may move each number of a state in a step.

        One solver computes all accelerations a of a world, and stops at an improvement of its cost
        below its tolerance t times the trace of the mass matrix M, so that a is within
        (2 t tr(M) M⁻¹ᵢᵢ)^½ of the solution, and two runs are twice as far apart.

        Source:
            ``_solve_done`` and ``_inertia_scale`` of mujoco-warp 4.0.0; ``dof_invweight0`` is the
            diagonal of M⁻¹.
        """
        mj, found = self.mj, np.zeros(structure.layout.size)
        if mj.ntree < 2:
            return found
        tolerance = float(self.model.opt.tolerance.numpy()[0])
        trace, step = mj.stat.meaninertia * mj.nv, mj.opt.timestep
        faster = 2.0 * substeps * step * np.sqrt(2.0 * tolerance * trace * mj.dof_invweight0)
        moved = faster * step * (substeps + 1) / 2.0
        data, moment = mujoco.MjData(mj), np.zeros((mj.nu, mj.nv))
        mujoco.mj_forward(mj, data)
        rows = data.moment_rownnz, data.moment_rowadr, data.moment_colind
        mujoco.mju_sparse2dense(moment, data.actuator_moment, *rows)
        arms, bias = np.abs(moment), np.abs(mj.actuator_biasprm)
        force = arms.T @ (bias[:, 1] * (arms @ moved) + bias[:, 2] * (arms @ faster))
        ends = np.append(mj.jnt_qposadr[1:], mj.nq) - mj.jnt_qposadr
        position = np.repeat(np.maximum.reduceat(moved, mj.jnt_dofadr), ends)
        for array, sizes in (("qpos", position), ("qvel", faster), (REPORTED, force)):
            numbers, places = structure.places(array)
            found[places] = sizes[numbers]
        return found


# --- states ---------------------------------------------------------------------------------------


@final
class DeviceArray:
    """An array of a device with a row for each world, and the same on the host.

    Attributes:
        array: On the device.
        host: On the host, flat rows; on Warp's CPU device it is the memory of the array.
    """

    def __init__(self, array: Any) -> None:
        self.array, self._pinned = array, None
        if not array.device.is_cpu:
            self._pinned = wp.empty(array.shape, dtype=array.dtype, device="cpu", pinned=True)
        host = (array if self._pinned is None else self._pinned).numpy()
        self.host = host.reshape(len(host), -1)

    def push(self) -> None:
        """Copy it to the device."""
        if self._pinned is not None:
            wp.copy(self.array, self._pinned)

    def pull(self) -> None:
        """Copy it from the device, and wait for it."""
        if self._pinned is not None:
            wp.copy(self._pinned, self.array)
            wp.synchronize_device(self.array.device)


@final
class Engine:
    """The states of n worlds on a device, stepped together.

    Attributes:
        base: The model that they share.
        n: Number of worlds.
        state: What a step continues from, by name, with the controls and the overflows.
        launched: How often it was stepped.
    """

    def __init__(self, base: SharedModel, n: int, contacts: int = 0, rows: int = 0) -> None:
        self.base, self.n, self.launched = base, n, 0
        self.model = copy.copy(base.model)
        self.model.opt = copy.copy(base.model.opt)
        self._sizes = max(contacts, base.contacts), max(rows, base.rows)
        self._fields: dict[str, DeviceArray] = {}
        self._allocate()

    def _allocate(self) -> None:
        """Make the memory of the states."""
        contacts, rows = self._sizes
        kept = {name: one.host.copy() for name, one in self._fields.items() if self._is_data(name)}
        with quiet(), wp.ScopedDevice(self.base.device):
            self.data = mjw.make_data(self.base.mj, self.n, nconmax=contacts, njmax=rows)
            self.state = {
                name: DeviceArray(array)
                for name in (*STATE, "ctrl", "overflow")
                if (array := getattr(self.data, name)).size
            }
        self._graphs: dict[int, Any] = {}
        for name, values in kept.items():
            del self._fields[name]
            self.field(name).host[:] = values
            self.field(name).push()

    def _is_data(self, name: str) -> bool:
        return not hasattr(self.model, name) and not hasattr(self.model.opt, name)

    def field(self, name: str) -> DeviceArray:
        """Return an array of the model in which worlds can differ, with a row for each of them."""
        found = self._fields.get(name)
        if found is None:
            owners = self.model.opt, self.model, self.data
            owner = next(one for one in owners if hasattr(one, name))
            array = getattr(owner, name)
            if owner is not self.data:
                shared, shape = array.numpy(), (self.n, *array.shape[1:])
                array = wp.empty(shape, dtype=array.dtype, device=self.base.device)
                array._is_batched = True
                setattr(owner, name, array)
                self._graphs = {}
            found = self._fields[name] = DeviceArray(array)
            if owner is not self.data:
                found.host[:] = shared.reshape(1, -1)
                found.push()
            else:
                found.pull()
        return found

    def differs(self, name: str, worlds: Integers, rows: NDArray[Any]) -> bool:
        """Return whether the device has other numbers in some worlds than these rows.

        Poses of shapes count only of those that cannot move: all others are states.
        """
        column = self.field(name)
        column.pull()
        found, given = column.host[worlds], rows[worlds]
        if name in STATIC:
            mj, shape = self.base.mj, (len(worlds), self.base.mj.ngeom, -1)
            moved = mj.body_mocapid[mj.body_rootid] >= 0
            fixed = ((mj.body_weldid == 0) & ~moved)[mj.geom_bodyid]
            found, given = (one.reshape(shape)[:, fixed] for one in (found, given))
        return not np.array_equal(found, given, equal_nan=rows.dtype.kind == "f")

    def switch(self, names: frozenset[str]) -> None:
        """Compute the terms that were left out because it was zero in all worlds."""
        for name in names:
            if not getattr(self.model, name):
                setattr(self.model, name, True)
                self._graphs = {}

    def step(self, substeps: int) -> None:
        """Take some physics steps in all worlds, and copy their states to the host."""
        self.launch(substeps)
        for column in self.state.values():
            column.pull()

    def launch(self, substeps: int) -> None:
        """Take some physics steps in all worlds: a captured graph, on a GPU of all of them."""
        self.launched += 1
        with wp.ScopedDevice(self.base.device):
            once = substeps if wp.get_device().is_cuda else 1
            if once not in self._graphs:
                with quiet(self.base.device, compiles=True), wp.ScopedCapture() as capture:
                    for _ in range(once):
                        mjw.step(self.model, self.data)
                self._graphs[once] = capture.graph
            for _ in range(substeps // once):
                wp.capture_launch(self._graphs[once])

    def grow(self, over: Integers) -> tuple[bool, list[int]]:
        """Make more memory after an overflow.

        Returned are whether there is more, and the worlds that need more than there may be.

        Args:
            over: The overflows of each world, shape (n,).
        """
        contacts, rows = self._sizes
        of_rows = int(OverflowType.NEFC | OverflowType.NJMAX_NNZ)
        needed = self.data.nefc.numpy()
        wrong = np.flatnonzero(needed > MOST_ROWS)
        if (over & of_rows).any():
            rows = min(MOST_ROWS, max(2 * rows, int(needed.max())))
        if (over & GROWS & ~of_rows).any():
            total = max(int(self.data.nacon.numpy()[0]), int(self.data.ncollision.numpy()[0]))
            wanted = max(2 * contacts, -(-total // self.n))
            if contacts == MOST_CONTACTS and not len(wrong):
                stored = self.data.contact.worldid.numpy()[: self.data.naconmax]
                wrong = np.array([np.bincount(stored, minlength=self.n).argmax()])
            contacts = min(MOST_CONTACTS, wanted)
        grew = (contacts, rows) != self._sizes
        if grew:
            self._sizes = contacts, rows
            self._allocate()
        return grew, wrong.tolist()

    def touches(self) -> dict[str, Any]:
        """Copy the contacts of the last physics step, sorted by world, to the host."""
        data = self.data
        count = min(int(data.nacon.numpy()[0]), data.naconmax)
        contact = data.contact
        owner = contact.worldid.numpy()[:count]
        kinds = contact.type.numpy()[:count] & int(types.ContactType.CONSTRAINT)
        order = np.argsort(owner, kind="stable")
        order = order[kinds[order] != 0]
        found = {
            name: getattr(contact, name).numpy()[:count][order]
            for name in ("pos", "frame", "dist", "dim", "geom", "efc_address", "flex")
            if getattr(contact, name).size
        }
        found["starts"] = np.searchsorted(owner[order], np.arange(self.n + 1))
        found["force"] = data.efc.force.numpy()
        return found
