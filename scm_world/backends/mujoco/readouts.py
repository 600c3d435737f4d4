"""What follows from the states of a model at lag 0: poses, velocities, sensors.

A readout computes on a model and data of its own, in which everything that is not among its
parents stays as it is in the file. So its value is a function of its parents, to the last bit.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, final

import mujoco
import numpy as np

from scm_world._types import ArrayLike, Floats
from scm_world.backends.mujoco.fields import clean, element_names, tendon_unit
from scm_world.backends.mujoco.scratch import scratch, silent
from scm_world.backends.mujoco.slots import Finder, Slot
from scm_world.backends.mujoco.sources import Source
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
MOVING = ("position", "orientation", "axis", "anchor", "ref")
"""Attributes that decide where things are."""


def to_compute_on(
    source: Source, finders: tuple[Finder, ...], values: Sequence[ArrayLike]
) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return a model with the values of some parameters, and data to compute on."""
    mj, data, other, slots = scratch(source, finders, partial(_computed, source, finders))
    for slot, value in zip(slots, values, strict=True):
        slot.write(np.asarray(value, dtype=np.float64))
    if any(slot.constant for slot in slots):
        mujoco.mj_setConst(mj, other)
    return mj, data


def _computed(
    source: Source, finders: tuple[Finder, ...]
) -> tuple[mujoco.MjModel, mujoco.MjData, mujoco.MjData, list[Slot]]:
    mj = copy.copy(source.realized) if finders else source.realized
    data = silent(mujoco.MjData(mj))
    other = silent(mujoco.MjData(mj))
    return mj, data, other, [finder(mj, data) for finder in finders]


@final
@dataclass(frozen=True)
class Computed:
    """A function of states and parameters, in this order: a pose, a velocity, or a sensor.

    Attributes:
        source: Source of the model.
        states: For each state, which numbers of ``"qpos"``, ``"qvel"`` or ``"act"`` it is, and in
            which frame it is given; see ``StateRow``.
        finders: Places of the parameters.
        kind: Kind of the element: ``"site"``, ``"body"``, ``"geom"`` or ``"sensor"``.
        index: Index of the element.
        attribute: Attribute of the element that is computed.
    """

    source: Source
    states: tuple[tuple[str, tuple[int, ...], str], ...]
    finders: tuple[Finder, ...]
    kind: str
    index: int
    attribute: str

    def __call__(self, *values: ArrayLike) -> Floats | float:
        """Compute the value from those of the parents."""
        mj, data = to_compute_on(self.source, self.finders, values[len(self.states) :])
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
        if self.kind == "sensor":
            # MuJoCo keeps the results for an earlier sensor until the velocity stage is over,
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
_MEMORY = (
    "it measures forces or accelerations, the time, or what a callback, a plugin or a delay "
    "decides, which is not a function of the state alone"
)


def find_readouts(
    mj: mujoco.MjModel,
    source: Source,
    states: Sequence[StateRow],
    parameters: Sequence[Parameter],
    wanted: Sequence[str],
) -> Iterator[Readout]:
    """Describe readouts by name: ``"tip.position"``, ``"body:tip.position"``, ``"imu.value"``."""
    finder = _Finder(mj, source, states, [row for row in parameters if not row.visual])
    problems = []
    for name in wanted:
        found = finder.find(name)
        if isinstance(found, str):
            problems.append(f"readouts={name!r}: {found}")
        else:
            yield found
    if problems:
        raise ModelError(problems)


@final
@dataclass
class _Finder:
    """Looks for elements, and for what decides where they are; see ``find_readouts``."""

    mj: mujoco.MjModel
    source: Source
    states: Sequence[StateRow]
    parameters: Sequence[Parameter]

    def __post_init__(self) -> None:
        self.names, self.joints = element_names(self.mj), dict[str, list[int]]()
        for row in self.states:  # the joint of each number; none of activations
            found = self.mj.dof_jntid[list(row.numbers) if row.array == "qvel" else []]
            if row.array == "qpos":
                found = np.searchsorted(self.mj.jnt_qposadr, row.numbers, side="right") - 1
            self.joints[row.name] = [int(joint) for joint in found]

    def find(self, name: str) -> Readout | str:
        """Describe a readout, or return why its name is refused."""
        prefix, _, plain = name.rpartition(":")
        element, _, attribute = plain.rpartition(".")
        sought = ("sensor",) if attribute == "value" else (*_OBJECTS,)
        kinds = [
            kind for kind in sought
            if clean(element) in self.names[kind] and prefix in ("", kind)
        ]  # fmt: skip
        if name in [row.name for row in (*self.parameters, *self.states)]:
            others = [f"{kind}:{name}" for kind in _OBJECTS if clean(element) in self.names[kind]]
            return "it is a variable already" + (f"; write {others[0]!r}" if others else "")
        if attribute not in (*_POSES, "value"):
            allowed = ", ".join((*_POSES, "value"))
            return f"{attribute!r} is nothing that can be computed; there are: {allowed}"
        if len(kinds) > 1:
            choices = " or ".join(repr(f"{kind}:{plain}") for kind in kinds)
            return f"a {', a '.join(kinds)} are called {element!r}; write {choices}"
        if not kinds:
            near = nearest(element, [n for kind in sought for n in self.names[kind]])
            what = "sensor" if attribute == "value" else "site, body or shape"
            hint = f"; did you mean {near!r}?" if near else ""
            return f"no {what} is called {element!r}{hint}"
        kind, index = kinds[0], self.names[kinds[0]].index(clean(element))
        if kind == "sensor":
            return self._sensor(name, index)
        unit, shape, doc = _POSES[attribute]
        states, parameters = self._parents([(kind, index)], attribute.endswith("velocity"))
        function: Any = self._computed(states, parameters, kind, index, attribute)
        if not parameters and attribute in ("position", "orientation"):
            function = self._chain(kind, index, states, turn=attribute == "orientation")
        parents = tuple(row.name for row in (*states, *parameters))
        return Readout(name, unit, shape, parents, function, doc.format(kind=kind))

    def _computed(
        self,
        states: Sequence[StateRow],
        parameters: Sequence[Parameter],
        kind: str,
        index: int,
        attribute: str,
    ) -> Computed:
        places = tuple((row.array, row.numbers, row.frame) for row in states)
        finders = tuple(row.slot for row in parameters if row.slot is not None)
        return Computed(self.source, places, finders, kind, index, attribute)

    def _chain(self, kind: str, index: int, states: Sequence[StateRow], *, turn: bool) -> Chain:
        """Write a pose down as a chain of joints, which is computed faster than by MuJoCo."""
        mj, first, numbers = self.mj, 0, dict[int, int]()
        for row in states:
            for joint in dict.fromkeys(self.joints[row.name]):
                numbers.setdefault(joint, first)
                first += self.joints[row.name].count(joint)
        steps: list[tuple[float, ...]] = []
        body = index
        if kind != "body":
            owner, places, turns = {
                "site": (mj.site_bodyid, mj.site_pos, mj.site_quat),
                "geom": (mj.geom_bodyid, mj.geom_pos, mj.geom_quat),
            }[kind]
            steps, body = [(OFFSET, 0.0, *places[index], *turns[index])], int(owner[index])
        while body:
            start, own = int(mj.body_jntadr[body]), list[tuple[float, ...]]()
            for joint in range(start, start + int(mj.body_jntnum[body])):
                axis, anchor, first = mj.jnt_axis[joint], mj.jnt_pos[joint], numbers[joint]
                reference = float(mj.qpos0[mj.jnt_qposadr[joint]])
                own.append(
                    {
                        int(_JNT.mjJNT_HINGE): (HINGE, first, *axis, *anchor, reference),
                        int(_JNT.mjJNT_SLIDE): (SLIDE, first, *axis, 0.0, 0.0, 0.0, reference),
                        int(_JNT.mjJNT_BALL): (BALL, first, *anchor),
                        int(_JNT.mjJNT_FREE): (FREE, first),
                    }[int(mj.jnt_type[joint])]
                )
            if not own or own[0][0] != FREE:
                own.insert(0, (OFFSET, 0.0, *mj.body_pos[body], *mj.body_quat[body]))
            steps, body = [*own, *steps], int(mj.body_parentid[body])
        return Chain.of(steps, turn=turn)

    def _parents(
        self, objects: Iterable[tuple[str, int]], velocity: bool
    ) -> tuple[list[StateRow], list[Parameter]]:
        """Find the states and parameters that decide where some objects are."""
        mj, elements, joints = self.mj, set[tuple[str, str]](), set[int]()
        for kind, index in objects:
            elements.add((kind, self.names[kind][index]))
            owners = {"site": mj.site_bodyid, "geom": mj.geom_bodyid}
            body = int(owners[kind][index]) if kind in owners else index
            while body:
                elements.add(("body", self.names["body"][body]))
                first = int(mj.body_jntadr[body])
                joints |= set(range(first, first + int(mj.body_jntnum[body])))
                body = int(mj.body_parentid[body])
        elements |= {("joint", self.names["joint"][joint]) for joint in joints}
        arrays = ("qpos", "qvel") if velocity else ("qpos",)
        states = [
            row
            for row in self.states
            if row.array in arrays and not joints.isdisjoint(self.joints[row.name])
        ]
        parameters = [
            row
            for row in self.parameters
            if row.key[1] in MOVING
            and any(row.key[0] in (name, f"{kind}:{name}") for kind, name in elements)
        ]
        return states, parameters

    def _sensor(self, name: str, index: int) -> Readout | str:
        """Describe a sensor; one that compares frames follows from what decides where they are."""
        mj, target = self.mj, int(self.mj.sensor_objid[index])
        kind, stage = mujoco.mjtSensor(int(mj.sensor_type[index])), int(mj.sensor_needstage[index])
        if disabled(mj, mujoco.mjtDisableBit.mjDSBL_SENSOR):
            return "the model disables sensors"
        if (
            kind in (_SENS.mjSENS_CLOCK, _SENS.mjSENS_USER, _SENS.mjSENS_PLUGIN)
            or mj.sensor_historyadr[index] >= 0
            or mj.sensor_delay[index]
            or mj.sensor_interval[index, 0]
            or stage not in (int(_STAGE.mjSTAGE_POS), int(_STAGE.mjSTAGE_VEL))
        ):
            return _MEMORY
        velocity, word = stage == int(_STAGE.mjSTAGE_VEL), kind.name.removeprefix("mjSENS_")
        unit, scope = _SENSORS.get(word, ("1", "all"))
        if "{L}" in unit:
            if word.startswith("TENDON"):
                length = tendon_unit(mj, target)
            else:
                length = "m" if mj.jnt_type[target] == int(_JNT.mjJNT_SLIDE) else "rad"
            unit = "1" if length == "1" else unit.format(L=length)
        states = [row for row in self.states if row.array in ("qpos", "qvel")]
        parameters = self.parameters
        known = {int(obj): element for element, obj in _OBJECTS.items()}
        ends = [(int(mj.sensor_objtype[index]), target)]
        if mj.sensor_refid[index] >= 0:
            ends.append((int(mj.sensor_reftype[index]), int(mj.sensor_refid[index])))
        if scope == "joint":
            array, parameters = "qvel" if velocity else "qpos", []
            states = [
                row for row in states
                if row.array == array and target in self.joints[row.name]
            ]  # fmt: skip
        elif scope == "frames" and all(obj in known for obj, _ in ends):
            # others are inertial frames and cameras, which follow more
            states, parameters = self._parents([(known[obj], i) for obj, i in ends], velocity)
        size, parents = int(mj.sensor_dim[index]), (row.name for row in (*states, *parameters))
        function = self._computed(states, parameters, "sensor", index, "value")
        shape, doc = (size,) if size > 1 else (), f"The {word.lower()} sensor."
        return Readout(name, unit, shape, tuple(parents), function, doc)
