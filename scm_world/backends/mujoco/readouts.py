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
from scm_world.backends.mujoco.fields import clean, element_names, slots, tendon_unit
from scm_world.backends.mujoco.slots import Slot
from scm_world.backends.mujoco.sources import Source, realized
from scm_world.backends.mujoco.trees import disabled
from scm_world.errors import ModelError, nearest
from scm_world.geometry.chains import BALL, FREE, HINGE, OFFSET, SLIDE, Chain
from scm_world.models.model import Parameter, Readout, StateRow
from scm_world.models.scene import ParameterKey

_OBJ, _SENS, _STAGE, _TRN = mujoco.mjtObj, mujoco.mjtSensor, mujoco.mjtStage, mujoco.mjtTrn
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
    source: Source, keys: tuple[ParameterKey, ...], thread: int
) -> tuple[mujoco.MjModel, mujoco.MjData, mujoco.MjData, dict[ParameterKey, Slot]]:
    """Give a model and data to compute on: for each thread, and for each set of parameters."""
    compiled = realized(source)[0]
    mj = copy.copy(compiled) if keys else compiled
    data = mujoco.MjData(mj)
    for each in (data, other := mujoco.MjData(mj)):
        each.warning.number[:] = 1  # no warnings on the console
    return mj, data, other, slots(compiled, keys, mj, data) if keys else {}


@final
@dataclass(frozen=True)
class Computed:
    """A function of states and parameters, in this order: a pose, a velocity, or a sensor.

    Attributes:
        source: Of the model.
        states: For each state, which numbers of ``"qpos"``, ``"qvel"`` or ``"act"`` it is, and in
            which frame it is given; see ``StateRow``.
        keys: Of the parameters.
        kind: Of the element: ``"site"``, ``"body"``, ``"geom"`` or ``"sensor"``.
        index: Of the element.
        attribute: What is asked for.
    """

    source: Source
    states: tuple[tuple[str, tuple[int, ...], str], ...]
    keys: tuple[ParameterKey, ...]
    kind: str
    index: int
    attribute: str

    def __call__(self, *values: Any) -> Floats | float:
        """Compute the value from those of the parents."""
        mj, data, scratch, slots = _scratch(self.source, self.keys, threading.get_ident())
        data.qpos[:], data.qvel[:] = mj.qpos0, 0.0
        for (array, numbers, _), value in zip(self.states, values, strict=False):
            getattr(data, array)[list(numbers)] = value
        for array, numbers, frame in self.states:
            for dof in numbers if (array, frame) == ("qvel", "world") else ():
                joint = int(mj.dof_jntid[dof])  # MuJoCo has spins in the frame of the body
                if int(mj.jnt_type[joint]) == FREE and dof == mj.jnt_dofadr[joint] + 3:
                    start, back, spin = int(mj.jnt_qposadr[joint]) + 3, np.empty(4), np.empty(3)
                    mujoco.mju_negQuat(back, data.qpos[start : start + 4])
                    mujoco.mju_rotVecQuat(spin, data.qvel[dof : dof + 3], back)
                    data.qvel[dof : dof + 3] = spin
        for key, value in zip(self.keys, values[len(self.states) :], strict=True):
            slots[key].write(np.asarray(value, dtype=np.float64))
        if any(slots[key].constant for key in self.keys):
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
        """Describe a readout, or say what is wrong with its name."""
        prefix, _, plain = name.rpartition(":")
        element, _, attribute = plain.rpartition(".")
        taken = [row.name for row in (*self._parameters, *self._states)]
        if name in taken:
            kinds = [f"{kind}:{name}" for kind in _OBJECTS if clean(element) in self._names[kind]]
            return "it is a variable already" + (f"; write {kinds[0]!r}" if kinds else "")
        if attribute == "value":
            return self._sensor(name, element)
        if attribute not in _POSES:
            allowed = ", ".join((*_POSES, "value"))
            return f"{attribute!r} is nothing that can be computed; there are: {allowed}"
        kinds = [
            kind for kind in _OBJECTS
            if clean(element) in self._names[kind] and prefix in ("", kind)
        ]  # fmt: skip
        if len(kinds) > 1:
            choices = " or ".join(repr(f"{kind}:{plain}") for kind in kinds)
            return f"a {', a '.join(kinds)} are called {element!r}; write {choices}"
        if kinds:
            index = self._names[kinds[0]].index(clean(element))
            return self._pose(name, kinds[0], index, attribute)
        known = [n for kind in _OBJECTS for n in self._names[kind]]
        near = nearest(element, known)
        return f"no site, body or shape is called {element!r}" + (
            f"; did you mean {near!r}?" if near else ""
        )

    def _pose(self, name: str, kind: str, index: int, attribute: str) -> Readout:
        states, keys = self._parents([(kind, index)], attribute.endswith("velocity"))
        function: Callable[..., Any] | None = None
        if not keys and attribute in ("position", "orientation"):
            function = self._chain(kind, index, states, turn=attribute == "orientation")
        row = (name, *_POSES[attribute])
        return self._row(*row, states, keys, (kind, index, attribute), function)

    def _chain(self, kind: str, index: int, states: Sequence[str], *, turn: bool) -> Chain:
        """Write a pose down as a chain of joints, which is computed faster than by MuJoCo."""
        mj, first, numbers = self._mj, 0, dict[int, int]()
        for row in self._states:
            if row.name in states:
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
            steps = [
                *(_joint_step(mj, joint, numbers[joint]) for joint in joints),
                *steps,
            ]
            if kinds != [int(mujoco.mjtJoint.mjJNT_FREE)]:
                steps.insert(0, (OFFSET, 0.0, *mj.body_pos[body], *mj.body_quat[body]))
            body = int(mj.body_parentid[body])
        return Chain.of(steps, turn=turn)

    def _row(
        self,
        name: str,
        unit: str,
        shape: tuple[int, ...],
        doc: str,
        states: Sequence[str],
        keys: tuple[ParameterKey, ...],
        what: tuple[str, int, str],
        function: Callable[..., Any] | None = None,
    ) -> Readout:
        named = {row.key: row.name for row in self._parameters}
        where = {row.name: (row.array, row.numbers, row.frame) for row in self._states}
        places = tuple(where[state] for state in states)
        parents = (*states, *(named[key] for key in keys))
        function = function or Computed(self._source, places, keys, *what)
        return Readout(name, unit, shape, parents, function, doc.format(kind=what[0]))

    def _parents(
        self, objects: Iterable[tuple[str, int]], velocity: bool
    ) -> tuple[list[str], tuple[ParameterKey, ...]]:
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
            row.name
            for row in self._states
            if row.array in arrays and not joints.isdisjoint(self._joints[row.name])
        ]
        keys = tuple(
            row.key
            for row in self._parameters
            if row.key[1] in _MOVING
            and any(row.key[0] in (name, f"{kind}:{name}") for kind, name in elements)
        )
        return states, keys

    # --- sensors -------------------------------------------------------------------------------

    def _sensor(self, name: str, element: str) -> Readout | str:
        mj, sensors = self._mj, self._names["sensor"]
        if clean(element) not in sensors:
            near = nearest(element, sensors)
            return f"no sensor is called {element!r}" + (
                f"; did you mean {near!r}?" if near else ""
            )
        index = sensors.index(clean(element))
        kind = mujoco.mjtSensor(int(mj.sensor_type[index]))
        reason = self._hidden(index, kind)
        if reason:
            return reason
        velocity = mj.sensor_needstage[index] == int(_STAGE.mjSTAGE_VEL)
        objects = self._objects(index, kind)
        if kind in _OF_JOINTS:
            array, joint = "qvel" if velocity else "qpos", int(mj.sensor_objid[index])
            states = [
                row.name
                for row in self._states
                if row.array == array and joint in self._joints[row.name]
            ]
            keys: tuple[ParameterKey, ...] = ()
        elif objects is None:
            states = [row.name for row in self._states if row.array in ("qpos", "qvel")]
            keys = tuple(row.key for row in self._parameters)
        else:
            states, keys = self._parents(objects, velocity)
        size = int(mj.sensor_dim[index])
        shape = (size,) if size > 1 else ()
        doc = f"The {kind.name.removeprefix('mjSENS_').lower()} sensor."
        what = "sensor", index, "value"
        return self._row(name, self._unit(index, kind), shape, doc, states, keys, what)

    def _hidden(self, index: int, kind: mujoco.mjtSensor) -> str:
        """Say why a sensor is no function of states and parameters, if it is none."""
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

    def _objects(self, index: int, kind: mujoco.mjtSensor) -> list[tuple[str, int]] | None:
        """List what decides the value of a sensor; None where that may be anything."""
        mj = self._mj
        if kind not in _OF_FRAMES:
            return None
        ends = [(int(mj.sensor_objtype[index]), int(mj.sensor_objid[index]))]
        if mj.sensor_refid[index] >= 0:
            ends.append((int(mj.sensor_reftype[index]), int(mj.sensor_refid[index])))
        kinds = {int(obj): name for name, obj in _OBJECTS.items()}
        if any(obj not in kinds for obj, _ in ends):
            return None  # inertial frames and cameras follow more
        return [(kinds[obj], end) for obj, end in ends]

    def _unit(self, index: int, kind: mujoco.mjtSensor) -> str:
        """Give the unit of a sensor; ``"1"`` where it mixes or has none."""
        mj, target = self._mj, int(self._mj.sensor_objid[index])
        if kind in (_SENS.mjSENS_JOINTPOS, _SENS.mjSENS_JOINTVEL, _SENS.mjSENS_JOINTLIMITPOS):
            slides = mj.jnt_type[target] == int(mujoco.mjtJoint.mjJNT_SLIDE)
            unit = "m" if slides else "rad"
        elif kind in (_SENS.mjSENS_TENDONPOS, _SENS.mjSENS_TENDONVEL, _SENS.mjSENS_TENDONLIMITPOS):
            unit = tendon_unit(mj, target)
        else:
            return _UNITS.get(kind, "1")
        speed = kind in (_SENS.mjSENS_JOINTVEL, _SENS.mjSENS_TENDONVEL)
        return f"{unit}/s" if speed and unit != "1" else unit


_OF_FRAMES = (
    _SENS.mjSENS_FRAMEPOS,
    _SENS.mjSENS_FRAMEQUAT,
    _SENS.mjSENS_FRAMEXAXIS,
    _SENS.mjSENS_FRAMEYAXIS,
    _SENS.mjSENS_FRAMEZAXIS,
    _SENS.mjSENS_FRAMELINVEL,
    _SENS.mjSENS_FRAMEANGVEL,
    _SENS.mjSENS_VELOCIMETER,
    _SENS.mjSENS_GYRO,
)
_OF_JOINTS = (
    _SENS.mjSENS_JOINTPOS,
    _SENS.mjSENS_JOINTVEL,
    _SENS.mjSENS_BALLQUAT,
    _SENS.mjSENS_BALLANGVEL,
)
_UNITS = {
    _SENS.mjSENS_VELOCIMETER: "m/s",
    _SENS.mjSENS_GYRO: "rad/s",
    _SENS.mjSENS_MAGNETOMETER: "T",
    _SENS.mjSENS_RANGEFINDER: "m",
    _SENS.mjSENS_BALLANGVEL: "rad/s",
    _SENS.mjSENS_FRAMEPOS: "m",
    _SENS.mjSENS_FRAMELINVEL: "m/s",
    _SENS.mjSENS_FRAMEANGVEL: "rad/s",
    _SENS.mjSENS_SUBTREECOM: "m",
    _SENS.mjSENS_SUBTREELINVEL: "m/s",
    _SENS.mjSENS_SUBTREEANGMOM: "kg m^2/s",
    _SENS.mjSENS_GEOMDIST: "m",
    _SENS.mjSENS_GEOMFROMTO: "m",
    _SENS.mjSENS_E_POTENTIAL: "J",
    _SENS.mjSENS_E_KINETIC: "J",
}


def _joint_step(mj: mujoco.MjModel, joint: int, first: int) -> tuple[float, ...]:
    """Write a joint down as a step of a chain."""
    axis, anchor = mj.jnt_axis[joint], mj.jnt_pos[joint]
    reference = float(mj.qpos0[mj.jnt_qposadr[joint]])
    match mujoco.mjtJoint(int(mj.jnt_type[joint])):
        case mujoco.mjtJoint.mjJNT_HINGE:
            return (HINGE, first, *axis, *anchor, reference)
        case mujoco.mjtJoint.mjJNT_SLIDE:
            return (SLIDE, first, *axis, 0.0, 0.0, 0.0, reference)
        case mujoco.mjtJoint.mjJNT_BALL:
            return (BALL, first, *anchor)
    return (FREE, first)
