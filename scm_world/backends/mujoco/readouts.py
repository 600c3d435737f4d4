"""What follows from the states of a model at lag 0: poses, velocities, sensors.

A readout computes on a model and data of its own, in which everything that is not among its
parents stays as it is in the file. So its value is a function of its parents, to the last bit.
"""

from __future__ import annotations

import copy
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, final

import mujoco
import numpy as np

from scm_world._types import Floats
from scm_world.backends.mujoco.fields import clean, element_names, tendon_unit
from scm_world.backends.mujoco.slots import Finder, Slot
from scm_world.backends.mujoco.sources import Source, realized
from scm_world.backends.mujoco.trees import disabled
from scm_world.errors import ModelError, nearest
from scm_world.geometry.chains import BALL, FREE, HINGE, OFFSET, SLIDE, Chain
from scm_world.models.model import Parameter, Readout, StateRow

_JNT, _OBJ, _SENS, _STAGE = mujoco.mjtJoint, mujoco.mjtObj, mujoco.mjtSensor, mujoco.mjtStage
_POSES = {
    "position": ("m", (3,), "Place of the {kind} in the world."),
    "orientation": ("1", (4,), "Orientation of the {kind} in the world (x, y, z, w), w >= 0."),
    "linear_velocity": ("m/s", (3,), "Velocity of the {kind} in the world."),
    "angular_velocity": ("rad/s", (3,), "Angular velocity of the {kind} in the world."),
}
_OBJECTS = {"site": _OBJ.mjOBJ_SITE, "body": _OBJ.mjOBJ_XBODY, "geom": _OBJ.mjOBJ_GEOM}
_MOVING = ("position", "orientation", "axis", "anchor", "ref")
"""Attributes that decide where things are."""


@lru_cache(maxsize=64)
def _scratch(
    source: Source, finders: tuple[Finder, ...], thread: int
) -> tuple[mujoco.MjModel, mujoco.MjData, mujoco.MjData, list[Slot]]:
    """Return a model and data to compute on: for each thread, and for each set of parameters."""
    compiled = realized(source)[0]
    mj = copy.copy(compiled) if finders else compiled
    data = mujoco.MjData(mj)
    for each in (data, other := mujoco.MjData(mj)):
        each.warning.number[:] = 1  # no warnings on the console
    return mj, data, other, [finder(mj, data) for finder in finders]


@final
@dataclass(frozen=True)
class Computed:
    """A function of states and parameters, in this order: a pose, a velocity, or a sensor.

    Attributes:
        source: Of the model.
        states: For each state, which numbers of ``"qpos"``, ``"qvel"`` or ``"act"`` it is, and in
            which frame it is given; see ``StateRow``.
        finders: Places of the parameters.
        kind: Of the element: ``"site"``, ``"body"``, ``"geom"`` or ``"sensor"``.
        index: Of the element.
        attribute: Attribute of the element that is computed.
    """

    source: Source
    states: tuple[tuple[str, tuple[int, ...], str], ...]
    finders: tuple[Finder, ...]
    kind: str
    index: int
    attribute: str

    def __call__(self, *values: Any) -> Floats | float:
        """Compute the value from those of the parents."""
        mj, data, scratch, slots = _scratch(self.source, self.finders, threading.get_ident())
        data.qpos[:], data.qvel[:] = mj.qpos0, 0.0
        for (array, numbers, _), value in zip(self.states, values, strict=False):
            getattr(data, array)[list(numbers)] = value
        for array, numbers, frame in self.states:
            for dof in numbers if (array, frame) == ("qvel", "world") else ():
                joint = int(mj.dof_jntid[dof])  # MuJoCo has spins in the frame of the body
                if mj.jnt_type[joint] == int(_JNT.mjJNT_FREE) and dof == mj.jnt_dofadr[joint] + 3:
                    start, back, spin = int(mj.jnt_qposadr[joint]) + 3, np.empty(4), np.empty(3)
                    mujoco.mju_negQuat(back, data.qpos[start : start + 4])
                    mujoco.mju_rotVecQuat(spin, data.qvel[dof : dof + 3], back)
                    data.qvel[dof : dof + 3] = spin
        for slot, value in zip(slots, values[len(self.states) :], strict=True):
            slot.write(np.asarray(value, dtype=np.float64))
        if any(slot.constant for slot in slots):
            mujoco.mj_setConst(mj, scratch)
        if self.kind == "sensor":
            # MuJoCo keeps what it computed for an earlier sensor until the velocity stage is over,
            # which sensors of the position stage (e_kinetic is one) do not reach here.
            data.flg_energyvel = data.flg_subtreevel = False
            mujoco.mj_fwdPosition(mj, data)
            mujoco.mj_sensorPos(mj, data)
            if mj.sensor_needstage[self.index] == int(_STAGE.mjSTAGE_VEL):
                mujoco.mj_fwdVelocity(mj, data)
                mujoco.mj_sensorVel(mj, data)
            first, size = int(mj.sensor_adr[self.index]), int(mj.sensor_dim[self.index])
            found = data.sensordata[first : first + size].copy()
            return found if size > 1 else float(found[0])
        mujoco.mj_kinematics(mj, data)
        if self.attribute.endswith("velocity"):
            mujoco.mj_comPos(mj, data)
            mujoco.mj_comVel(mj, data)
            speeds = np.empty(6)
            mujoco.mj_objectVelocity(mj, data, _OBJECTS[self.kind], self.index, speeds, 0)
            return speeds[:3] if self.attribute == "angular_velocity" else speeds[3:]
        prefix = {"site": "site_x", "body": "x", "geom": "geom_x"}[self.kind]
        if self.attribute == "position":
            return np.array(getattr(data, f"{prefix}pos")[self.index])
        turned = np.empty(4)
        mujoco.mju_mat2Quat(turned, getattr(data, f"{prefix}mat")[self.index])
        return turned[[1, 2, 3, 0]] * (-1.0 if turned[0] < 0.0 else 1.0)


# --- finding -----------------------------------------------------------------------------------


def find_readouts(
    mj: mujoco.MjModel,
    source: Source,
    states: Sequence[StateRow],
    parameters: Sequence[Parameter],
    wanted: Sequence[str],
) -> Iterator[Readout]:
    """Describe what was asked for.

    Args:
        mj: The compiled model.
        source: What it was compiled from.
        states: Rows of the state vector.
        parameters: Those that are exposed.
        wanted: Names: ``"tip.position"``, ``"body:tip.position"``, ``"imu.value"``.

    Raises:
        ModelError: All names that cannot be computed, with the reasons.
    """
    finder = _Finder(mj, source, states, parameters)
    problems = []
    for name in wanted:
        found = finder.find(name)
        if isinstance(found, str):
            problems.append(f"readouts={name!r}: {found}")
        else:
            yield found
    if problems:
        raise ModelError(problems)


def _joints_of(mj: mujoco.MjModel, row: StateRow) -> list[int]:
    """Return the joint of each number of a state; none for activations."""
    if row.array == "qpos":
        found = np.searchsorted(mj.jnt_qposadr, row.numbers, side="right") - 1
    else:
        found = mj.dof_jntid[list(row.numbers) if row.array == "qvel" else []]
    return [int(joint) for joint in found]


@final
class _Finder:
    """Looks for elements, and for what decides where they are."""

    def __init__(
        self,
        mj: mujoco.MjModel,
        source: Source,
        states: Sequence[StateRow],
        parameters: Sequence[Parameter],
    ) -> None:
        self._mj, self._source, self._states = mj, source, states
        self._joints = {row.name: _joints_of(mj, row) for row in states}
        self._parameters = [row for row in parameters if not row.visual]
        self._names = element_names(mj)

    def find(self, name: str) -> Readout | str:
        """Describe a readout, or return what is wrong with its name."""
        prefix, _, plain = name.rpartition(":")
        element, _, attribute = plain.rpartition(".")
        kinds = [
            kind for kind in (("sensor",) if attribute == "value" else _OBJECTS)
            if clean(element) in self._names[kind] and prefix in ("", kind)
        ]  # fmt: skip
        if name in [row.name for row in (*self._parameters, *self._states)]:
            others = [f"{kind}:{name}" for kind in _OBJECTS if clean(element) in self._names[kind]]
            return "it is a variable already" + (f"; write {others[0]!r}" if others else "")
        if attribute not in (*_POSES, "value"):
            allowed = ", ".join((*_POSES, "value"))
            return f"{attribute!r} is nothing that can be computed; there are: {allowed}"
        if len(kinds) > 1:
            choices = " or ".join(repr(f"{kind}:{plain}") for kind in kinds)
            return f"a {', a '.join(kinds)} are called {element!r}; write {choices}"
        if not kinds:
            sought = ("sensor",) if attribute == "value" else (*_OBJECTS,)
            near = nearest(element, [n for kind in sought for n in self._names[kind]])
            what = "sensor" if attribute == "value" else "site, body or shape"
            hint = f"; did you mean {near!r}?" if near else ""
            return f"no {what} is called {element!r}{hint}"
        kind, index = kinds[0], self._names[kinds[0]].index(clean(element))
        if kind == "sensor":
            return self._sensor(name, index)
        states, parameters = self._parents([(kind, index)], attribute.endswith("velocity"))
        function: Callable[..., Any] | None = None
        if not parameters and attribute in ("position", "orientation"):
            function = self._chain(kind, index, states, turn=attribute == "orientation")
        row = (name, *_POSES[attribute])
        return self._row(*row, states, parameters, (kind, index, attribute), function)

    def _chain(self, kind: str, index: int, states: Sequence[StateRow], *, turn: bool) -> Chain:
        """Write a pose down as a chain of joints, which is computed faster than by MuJoCo."""
        mj, first, numbers = self._mj, 0, dict[int, int]()
        for row in states:
            for joint in dict.fromkeys(self._joints[row.name]):
                numbers.setdefault(joint, first)
                first += self._joints[row.name].count(joint)
        steps: list[tuple[float, ...]] = []
        body = index
        if kind != "body":
            owner, places, turns = {
                "site": (mj.site_bodyid, mj.site_pos, mj.site_quat),
                "geom": (mj.geom_bodyid, mj.geom_pos, mj.geom_quat),
            }[kind]
            steps, body = [(OFFSET, 0.0, *places[index], *turns[index])], int(owner[index])
        while body:
            joints = range(
                mj.body_jntadr[body], mj.body_jntadr[body] + max(0, mj.body_jntnum[body])
            )
            kinds = [int(mj.jnt_type[joint]) for joint in joints]
            steps = [*(_joint_step(mj, joint, numbers[joint]) for joint in joints), *steps]
            if kinds != [int(_JNT.mjJNT_FREE)]:
                steps.insert(0, (OFFSET, 0.0, *mj.body_pos[body], *mj.body_quat[body]))
            body = int(mj.body_parentid[body])
        return Chain.of(steps, turn=turn)

    def _row(
        self,
        name: str,
        unit: str,
        shape: tuple[int, ...],
        doc: str,
        states: Sequence[StateRow],
        parameters: Sequence[Parameter],
        what: tuple[str, int, str],
        function: Callable[..., Any] | None = None,
    ) -> Readout:
        places = tuple((row.array, row.numbers, row.frame) for row in states)
        finders = tuple(row.slot for row in parameters if row.slot is not None)
        parents = tuple(row.name for row in (*states, *parameters))
        function = function or Computed(self._source, places, finders, *what)
        return Readout(name, unit, shape, parents, function, doc.format(kind=what[0]))

    def _parents(
        self, objects: Iterable[tuple[str, int]], velocity: bool
    ) -> tuple[list[StateRow], list[Parameter]]:
        """Find the states and parameters that decide where some objects are."""
        mj, elements, joints = self._mj, set[tuple[str, str]](), set[int]()
        for kind, index in objects:
            elements.add((kind, self._names[kind][index]))
            body = {"site": mj.site_bodyid, "geom": mj.geom_bodyid}.get(kind, range(mj.nbody))[
                index
            ]
            while body:
                elements.add(("body", self._names["body"][body]))
                first = int(mj.body_jntadr[body])
                joints |= set(range(first, first + int(mj.body_jntnum[body])))
                body = mj.body_parentid[body]
        elements |= {("joint", self._names["joint"][joint]) for joint in joints}
        arrays = ("qpos", "qvel") if velocity else ("qpos",)
        states = [
            row
            for row in self._states
            if row.array in arrays and not joints.isdisjoint(self._joints[row.name])
        ]
        parameters = [
            row
            for row in self._parameters
            if row.key[1] in _MOVING
            and any(row.key[0] in (name, f"{kind}:{name}") for kind, name in elements)
        ]
        return states, parameters

    # --- sensors -------------------------------------------------------------------------------

    def _sensor(self, name: str, index: int) -> Readout | str:
        mj = self._mj
        kind = mujoco.mjtSensor(int(mj.sensor_type[index]))
        reason = self._hidden(index, kind)
        if reason:
            return reason
        velocity = mj.sensor_needstage[index] == int(_STAGE.mjSTAGE_VEL)
        word, target = kind.name.removeprefix("mjSENS_"), int(mj.sensor_objid[index])
        unit, scope = _SENSORS.get(word, ("1", "all"))
        if "{L}" in unit:
            if word.startswith("TENDON"):
                length = tendon_unit(mj, target)
            else:
                length = "m" if mj.jnt_type[target] == int(_JNT.mjJNT_SLIDE) else "rad"
            unit = "1" if length == "1" else unit.format(L=length)
        states = [row for row in self._states if row.array in ("qpos", "qvel")]
        parameters = self._parameters
        objects = self._objects(index) if scope == "frames" else None
        if scope == "joint":
            array, parameters = "qvel" if velocity else "qpos", []
            states = [
                row for row in states
                if row.array == array and target in self._joints[row.name]
            ]  # fmt: skip
        elif objects is not None:
            states, parameters = self._parents(objects, velocity)
        size = int(mj.sensor_dim[index])
        shape, doc = (size,) if size > 1 else (), f"The {word.lower()} sensor."
        return self._row(name, unit, shape, doc, states, parameters, ("sensor", index, "value"))

    def _hidden(self, index: int, kind: mujoco.mjtSensor) -> str:
        """Return why a sensor is no function of states and parameters; empty if it is one."""
        mj = self._mj
        if disabled(mj, mujoco.mjtDisableBit.mjDSBL_SENSOR):
            return "the model disables sensors"
        if kind == _SENS.mjSENS_CLOCK:
            return "it is the time, and no function of the state"
        if kind in (_SENS.mjSENS_USER, _SENS.mjSENS_PLUGIN):
            return "what it measures is decided by a callback or plugin"
        if (
            mj.sensor_historyadr[index] >= 0
            or mj.sensor_delay[index]
            or mj.sensor_interval[index, 0]
        ):
            return "it has a delay or an interval, and so a memory"
        if mj.sensor_needstage[index] not in (int(_STAGE.mjSTAGE_POS), int(_STAGE.mjSTAGE_VEL)):
            return "it measures forces or accelerations, which are no function of the state alone"
        return ""

    def _objects(self, index: int) -> list[tuple[str, int]] | None:
        """List the objects whose frames a sensor compares; None for frames that follow more."""
        mj, kinds = self._mj, {int(obj): name for name, obj in _OBJECTS.items()}
        ends = [(int(mj.sensor_objtype[index]), int(mj.sensor_objid[index]))]
        if mj.sensor_refid[index] >= 0:
            ends.append((int(mj.sensor_reftype[index]), int(mj.sensor_refid[index])))
        if any(obj not in kinds for obj, _ in ends):  # inertial frames and cameras
            return None
        return [(kinds[obj], end) for obj, end in ends]


_SENSORS = {
    "JOINTPOS": ("{L}", "joint"), "JOINTVEL": ("{L}/s", "joint"), "BALLQUAT": ("1", "joint"),
    "BALLANGVEL": ("rad/s", "joint"), "JOINTLIMITPOS": ("{L}", "all"),
    "TENDONPOS": ("{L}", "all"), "TENDONVEL": ("{L}/s", "all"), "TENDONLIMITPOS": ("{L}", "all"),
    "FRAMEPOS": ("m", "frames"), "FRAMEQUAT": ("1", "frames"), "FRAMEXAXIS": ("1", "frames"),
    "FRAMEYAXIS": ("1", "frames"), "FRAMEZAXIS": ("1", "frames"),
    "FRAMELINVEL": ("m/s", "frames"), "FRAMEANGVEL": ("rad/s", "frames"),
    "VELOCIMETER": ("m/s", "frames"), "GYRO": ("rad/s", "frames"),
    "MAGNETOMETER": ("T", "all"), "RANGEFINDER": ("m", "all"), "SUBTREECOM": ("m", "all"),
    "SUBTREELINVEL": ("m/s", "all"), "SUBTREEANGMOM": ("kg m^2/s", "all"),
    "GEOMDIST": ("m", "all"), "GEOMFROMTO": ("m", "all"), "E_POTENTIAL": ("J", "all"),
    "E_KINETIC": ("J", "all"),
}  # fmt: skip
"""Unit of a sensor, with L for that of the coordinate, and what decides its value: a joint, the
frames that it compares, or all states and parameters."""


def _joint_step(mj: mujoco.MjModel, joint: int, first: int) -> tuple[float, ...]:
    """Write a joint down as a step of a chain."""
    axis, anchor = mj.jnt_axis[joint], mj.jnt_pos[joint]
    reference = float(mj.qpos0[mj.jnt_qposadr[joint]])
    match mujoco.mjtJoint(int(mj.jnt_type[joint])):
        case _JNT.mjJNT_HINGE:
            return (HINGE, first, *axis, *anchor, reference)
        case _JNT.mjJNT_SLIDE:
            return (SLIDE, first, *axis, 0.0, 0.0, 0.0, reference)
        case _JNT.mjJNT_BALL:
            return (BALL, first, *anchor)
    return (FREE, first)
