"""Any model file as a ``Model``: tables of what there is, and of what acts on what."""

from __future__ import annotations

import copy
import fnmatch
import hashlib
import math
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from scm_world._types import Integers
from scm_world.backends.mujoco.bodies import describe
from scm_world.backends.mujoco.fields import (
    MEDIUM,
    Field,
    control_unit,
    element_names,
    servo,
    table,
)
from scm_world.backends.mujoco.readouts import find_readouts
from scm_world.backends.mujoco.realization import callbacks, inertia_of, sensible
from scm_world.backends.mujoco.sources import Source, read_source, realized, understood
from scm_world.backends.mujoco.trees import Couplings
from scm_world.errors import ModelError, UnknownOption, nearest
from scm_world.models.bodies import ModelBodies
from scm_world.models.model import Input, Model, Numbers, Parameter, StateRow
from scm_world.models.scene import REVERSED, reversed_ranges

_DSBL, _JNT, _TRN, _INT = (
    mujoco.mjtDisableBit,
    mujoco.mjtJoint,
    mujoco.mjtTrn,
    mujoco.mjtIntegrator,
)
_CONTROLS = {
    "position": "Position that the servo goes to.",
    "velocity": "Velocity that the servo keeps to.",
    "damper": "How much the actuator damps.",
    "": "What the actuator makes a force of, with its gain and gear.",
}


def read_model(
    source: Any,
    *,
    name: str | None = None,
    expose: Iterable[str] | str | None = None,
    readouts: Iterable[str] = (),
    fixed_base: bool = True,
    keyframe: str | int | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Model:
    """Read a model, and describe it by tables.

    Args:
        source: A path to an MJCF or URDF file, XML text, a ``mujoco.MjSpec`` or a
            ``mujoco.MjModel``. It is not changed.
        name: Of the model; the one in the file if None.
        expose: Patterns of the parameters that can be set: ``"*.mass"``, ``"cube.*"``. A pattern
            that ends in ``*`` means the usual attributes; the others are exposed where they are
            named, as in ``["*", "*.solref"]``. All usual ones if None.
        readouts: Names of what is computed from the states: ``"tip.position"``,
            ``"tip.orientation"``, ``"tip.linear_velocity"``, ``"tip.angular_velocity"`` of sites,
            bodies and shapes, and ``"imu.value"`` of sensors.
        fixed_base: Whether the root link of a URDF is fixed to the world.
        keyframe: Name or number of a keyframe of the file whose state, controls and mocap poses are
            the defaults; the pose of the file if None.
        settings: Options of MJCF to be set to something else: ``{"timestep": 0.001}``.

    Raises:
        UnreadableFile: There is no such file, or it is no text.
        ModelError: It is no model, or one that cannot be a causal model; or a pattern or readout
            names nothing.
        UnknownOption: A setting or keyframe does not exist.
    """
    found = callbacks()
    if found:
        raise ModelError(found)
    sealed, own_name, where, replaced = read_source(
        source, fixed_base=fixed_base, options=dict(settings or {})
    )
    with understood(where):
        mj, changed = realized(sealed)
    _check(mj, where)
    start = _start(mj, keyframe)
    trees = Couplings(mj)
    names = element_names(mj)
    states = tuple(_states(mj, names, trees, start))
    inputs = tuple(_inputs(mj, names, trees, start))
    placed = [
        (row, state.array, state.numbers, state.number if state.kind == "joint" else -1)
        for row, state in zip(states, _moving(mj, names), strict=True)
    ]
    patterns = None if expose is None else [expose] if isinstance(expose, str) else list(expose)
    fluid = patterns is not None and any(fnmatch.filter(MEDIUM, p) for p in patterns if p != "*")
    fields = table(mj, fluid=fluid)
    chosen = _exposed(fields, patterns)
    parameters = tuple(_parameter(mj, start, field) for field in fields if field.name in chosen)
    wrong = reversed_ranges({row.key: row.default for row in parameters})
    if wrong:
        raise ModelError([f"{where}: {'.'.join(key)}: {REVERSED}" for key in wrong])
    drift = tuple(_drift(mj, sealed, start))
    for note in drift:
        warnings.warn(note, stacklevel=3)
    keys = "\0".join(f"{row.name}\0{row.key}" for row in parameters)
    keys += "" if keyframe is None else f"\0{keyframe}"
    return Model(
        name=name or own_name or "model",
        digest=hashlib.sha256(f"{sealed.digest}\0{keys}".encode()).hexdigest(),
        source=sealed,
        timestep=float(mj.opt.timestep),
        parameters=parameters,
        states=states,
        inputs=inputs,
        readouts=tuple(find_readouts(mj, sealed, placed, parameters, tuple(readouts))),
        trees=tuple(names["body"][root] for root in trees.roots),
        refused=tuple(
            (field.name, field.refusal or "is not exposed; name it in expose=[…]")
            for field in fields
            if field.name not in chosen
        ),
        notes=(*replaced, *changed, *drift, *_notes(mj, keyframe)),
        staged=_is_staged(mj),
        describe=described,
    )


def compiled(model: Model) -> mujoco.MjModel:
    """Compile what a description was read from, with settings under which it is exact.

    It is compiled once in a process. Callers copy it before they change it.
    """
    return realized(model.source)[0]


def described(model: Model) -> ModelBodies:
    """Describe the bodies of a model, for engines that do not read its source."""
    return describe(compiled(model))


def _check(mj: mujoco.MjModel, where: str) -> None:
    """Refuse what has effects that no graph could declare.

    Raises:
        ModelError: All that is wrong.
    """
    problems = []
    if mj.nv == 0:
        hint = "add a joint, or a freejoint; for a URDF, fixed_base=False lets its root link move"
        problems.append(f"{where} has no joint, so that nothing in it can move; {hint}")
    labels = element_names(mj)["actuator"]
    for i in range(mj.nactuator):
        kinds = mj.actuator_dyntype[i], mj.actuator_gaintype[i], mj.actuator_biastype[i]
        users = mujoco.mjtDyn.mjDYN_USER, mujoco.mjtGain.mjGAIN_USER, mujoco.mjtBias.mjBIAS_USER
        label = labels[i]
        if any(int(kind) == int(user) for kind, user in zip(kinds, users, strict=True)):
            problems.append(
                f"{where}: the actuator {label!r} needs a callback of the user; give it one of "
                "MuJoCo's own types"
            )
        if mj.actuator_historyadr[i] >= 0:
            problems.append(
                f"{where}: the actuator {label!r} acts with a delay, and what it remembers is no "
                "state; remove its delay and nsample"
            )
    if getattr(mj, "nplastic", 0):  # since MuJoCo 4
        problems.append(
            f"{where} has plastic springs or flexes, whose rest shape is a hidden state; remove "
            "springyield and yield"
        )
    problems += _check_inertia(mj, where) if mj.nv else ()
    if problems:
        raise ModelError(problems)


def _check_inertia(mj: mujoco.MjModel, where: str) -> Iterator[str]:
    """Say which bodies have no inertia that there can be, or which joints have none to move."""
    model, data = copy.copy(mj), mujoco.MjData(mj)
    data.warning.number[:] = 1  # MuJoCo prints the first warning of a kind
    mujoco.mj_setConst(model, data)
    if data.warning.number[0] == 1 and sensible(*inertia_of(model)):
        return
    moments, names = mj.body_inertia, element_names(mj)
    possible = (mj.body_mass >= 0.0) & (moments.min(axis=1) >= 0.0)
    possible &= 2.0 * moments.max(axis=1) <= moments.sum(axis=1) * (1.0 + 1e-6)
    if not possible.all():
        wrong = ", ".join(repr(names["body"][body]) for body in np.flatnonzero(~possible))
        yield f"{where}: no body has such a mass, or such moments of inertia, as {wrong}"
        return
    matrix = np.empty((mj.nv, mj.nv))
    mujoco.mj_fullM(model, data, matrix)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(scale[:, None] * matrix * scale)
    weak = np.abs(vectors[:, values < 1e-9]).max(axis=1, initial=0.0) > 1e-6
    joints = dict.fromkeys(names["joint"][int(joint)] for joint in mj.dof_jntid[weak])
    yield (
        f"{where}: the joints {', '.join(map(repr, joints))} depend on one another or move no "
        "mass, so that the mass matrix is singular; remove one of them, or give them armature"
    )


def _start(mj: mujoco.MjModel, keyframe: str | int | None) -> mujoco.MjData:
    """Return the state in which episodes begin.

    Raises:
        UnknownOption: There is no such keyframe.
    """
    data = mujoco.MjData(mj)
    if keyframe is not None:
        names = [mj.key(i).name or str(i) for i in range(mj.nkey)]
        if str(keyframe) not in names:
            raise UnknownOption("keyframe", keyframe, names)
        mujoco.mj_resetDataKeyframe(mj, data, names.index(str(keyframe)))
    return data


FEW = 50
"""Below so many iterations a solver depends on where it begins."""
DRIFT_SECONDS = 0.5
DRIFT = 1e-4
"""Differences that are worth a note [m] or [rad]."""


def _drift(mj: mujoco.MjModel, source: Source, start: mujoco.MjData) -> Iterator[str]:
    """Say how far plain MuJoCo, with its warm start, goes elsewhere where iterations are few."""
    if mj.opt.iterations >= FEW:
        return
    ends = []
    steps = max(1, round(DRIFT_SECONDS / mj.opt.timestep))
    for model in (mj, source.compile()):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = start.qpos, start.qvel, start.ctrl
        data.act[:], data.warning.number[:] = start.act, 1
        mujoco.mj_step(model, data, steps)
        ends.append(data.qpos.copy())
    apart = np.empty(mj.nv)
    mujoco.mj_differentiatePos(mj, apart, 1.0, *ends)
    kinds = mj.jnt_type[mj.dof_jntid]
    place = np.arange(mj.nv) - mj.jnt_dofadr[mj.dof_jntid]
    slides = (kinds == int(_JNT.mjJNT_SLIDE)) | ((kinds == int(_JNT.mjJNT_FREE)) & (place < 3))
    found = [
        f"{np.abs(apart[which]).max():.2g} {unit}"
        for which, unit in ((~slides, "rad"), (slides, "m"))
        if np.abs(apart[which]).max(initial=0.0) > DRIFT or not np.isfinite(apart[which]).all()
    ]
    if found:
        few = mj.opt.iterations
        yield (
            f"With {few} iteration{'s' * (few > 1)} the solver has to begin with the solution of "
            "the last step; here every step begins anew, because that solution is no variable. "
            f"After {steps * mj.opt.timestep:g} s without commands, "
            f"MuJoCo with the file as it is differs by up to {' and '.join(found)}; "
            "<option iterations='100' ls_iterations='50'/> makes that small."
        )


def _notes(mj: mujoco.MjModel, keyframe: str | int | None) -> Iterator[str]:
    """Say what acts without having a variable, and what is not used."""
    if mj.nflex:
        yield f"{mj.nflex} flex(es) act through their vertices; their material has no variables."
    if _is_staged(mj):
        yield (
            "RK4 looks for contacts in four stages of a physics step; those of the last one are "
            "listed, and an edge by contact may act in an earlier one."
        )
    if mj.nskin:
        yield f"{mj.nskin} skin(s) act on pictures only."
    if mj.nkey and keyframe is None:
        yield (
            f"{mj.nkey} keyframe(s) are not used: episodes begin in the pose of the file; "
            "keyframe='name' begins with one."
        )


def _is_staged(mj: mujoco.MjModel) -> bool:
    """Return whether bodies may touch in several stages of a physics step."""
    touch = mj.nflex > 0 or bool(Couplings(mj).touches.any())
    return touch and int(mj.opt.integrator) == int(mujoco.mjtIntegrator.mjINT_RK4)


# --- parameters --------------------------------------------------------------------------------


def _exposed(fields: Sequence[Field], patterns: Sequence[str] | None) -> set[str]:
    """Choose the parameters that can be set.

    Raises:
        ModelError: A pattern names nothing, or only what cannot be set.
    """
    can = [field for field in fields if not field.refusal]
    if patterns is None:
        return {field.name for field in can if field.usual}
    found: set[str] = set()
    problems = []
    for pattern in patterns:
        open_end = pattern.rpartition(".")[2] == "*"
        named = {
            field.name
            for field in can
            if fnmatch.fnmatchcase(field.name, pattern) and (field.usual or not open_end)
        }
        found |= named
        if named:
            continue
        refused = [f for f in fields if f.refusal and fnmatch.fnmatchcase(f.name, pattern)]
        if refused:
            problems.append(f"expose={pattern!r}: {refused[0].name!r} {refused[0].refusal}")
        else:
            near = nearest(pattern, (field.name for field in can))
            hint = f"; did you mean {near!r}?" if near else ""
            problems.append(f"expose={pattern!r} names no parameter{hint}")
    if problems:
        raise ModelError(problems)
    return found


def _parameter(mj: mujoco.MjModel, data: mujoco.MjData, field: Field) -> Parameter:
    """Describe a field with what it is in the model as it was given."""
    if field.slot is None:
        raise TypeError(f"{field.name} has no place")
    slot = field.slot(mj, data)
    default = slot.read()
    always, contact = field.effect()
    return Parameter(
        name=field.name,
        unit=field.unit,
        shape=default.shape,
        default=_numbers(default),
        low=field.low,
        high=field.high,
        doc=field.doc,
        always=always,
        contact=contact,
        key=field.key,
        kind=field.nature,
        visual=field.visual,
    )


def _numbers(values: Any) -> Numbers:
    found = np.asarray(values, dtype=np.float64)
    return tuple(found.ravel().tolist()) if found.ndim else float(found)


# --- states and inputs -------------------------------------------------------------------------


class Permutation(NamedTuple):
    """Where each of MuJoCo's numbers stands in the state vector.

    Attributes:
        positions: ``vector[positions]`` is ``qpos``.
        velocities: ``vector[velocities]`` is ``qvel``.
        activations: ``vector[activations]`` is ``act``.
    """

    positions: Integers
    velocities: Integers
    activations: Integers


def permutation(mj: mujoco.MjModel) -> Permutation:
    """Give the place of every number of MuJoCo's state in that of the tables."""
    found = Permutation(*(np.empty(n, dtype=np.int64) for n in (mj.nq, mj.nv, mj.na)))
    arrays = {"qpos": found.positions, "qvel": found.velocities, "act": found.activations}
    end = 0
    for state in _moving(mj, element_names(mj)):
        arrays[state.array][state.numbers] = np.arange(end, end + len(state.numbers))
        end += len(state.numbers)
    return found


class _Moving(NamedTuple):
    """A state: which of MuJoCo's numbers it is, and what it means."""

    array: str
    numbers: list[int]
    kind: str
    number: int
    element: str
    attribute: str
    unit: str
    doc: str
    low: float = -math.inf
    high: float = math.inf


def _moving(mj: mujoco.MjModel, names: Mapping[str, tuple[str, ...]]) -> Iterator[_Moving]:
    """List what moves, in the order of the state vector."""
    for joint in range(mj.njnt):
        name, body = names["joint"][joint], names["body"][int(mj.jnt_bodyid[joint])]
        q, v = int(mj.jnt_qposadr[joint]), int(mj.jnt_dofadr[joint])
        match mujoco.mjtJoint(int(mj.jnt_type[joint])):
            case _JNT.mjJNT_FREE:
                for array, numbers, attribute, unit, doc in (
                    ("qpos", [q, q + 1, q + 2], "cartesian_position", "m",
                     "Place of the frame of the body in the world."),
                    ("qpos", [q + 4, q + 5, q + 6, q + 3], "orientation", "1",
                     "Orientation of the body in the world (x, y, z, w)."),
                    ("qvel", [v, v + 1, v + 2], "linear_velocity", "m/s",
                     "Velocity of the origin of the body's frame, in the world."),
                    ("qvel", [v + 3, v + 4, v + 5], "angular_velocity", "rad/s",
                     "Angular velocity of the body, in its own frame."),
                ):  # fmt: skip
                    yield _Moving(array, numbers, "joint", joint, body, attribute, unit, doc)
            case _JNT.mjJNT_BALL:
                doc = "Orientation of the body in its parent (x, y, z, w)."
                numbers = [q + 1, q + 2, q + 3, q]
                yield _Moving("qpos", numbers, "joint", joint, name, "orientation", "1", doc)
                doc, numbers = "Angular velocity in the frame of the body.", [v, v + 1, v + 2]
                yield _Moving(
                    "qvel", numbers, "joint", joint, name, "angular_velocity", "rad/s", doc
                )
            case kind:
                turns = kind == _JNT.mjJNT_HINGE
                unit, what = ("rad", "Angle") if turns else ("m", "Displacement")
                low, high = mj.jnt_range[joint] if mj.jnt_limited[joint] else (-math.inf, math.inf)
                yield _Moving(
                    "qpos", [q], "joint", joint, name, "position", unit, f"{what} of the joint.",
                    float(low), float(high),
                )  # fmt: skip
                doc = "Angular velocity of the joint." if turns else "Velocity of the joint."
                yield _Moving("qvel", [v], "joint", joint, name, "velocity", f"{unit}/s", doc)
    for actuator in range(mj.nactuator):
        first, count = int(mj.actuator_actadr[actuator]), int(mj.actuator_actnum[actuator])
        if first < 0 or not count:
            continue
        limited = mj.actuator_actlimited[actuator]
        low, high = mj.actuator_actrange[actuator] if limited else (-math.inf, math.inf)
        yield _Moving(
            "act", list(range(first, first + count)), "actuator", actuator,
            names["actuator"][actuator], "activation", "1", "Inner state of the actuator.",
            float(low), float(high),
        )  # fmt: skip


def _states(
    mj: mujoco.MjModel, names: Mapping[str, tuple[str, ...]], trees: Couplings, data: mujoco.MjData
) -> Iterator[StateRow]:
    """Describe what moves, in the order of the state vector; the data are where it begins."""
    states = list(_moving(mj, names))
    named = Counter(f"{state.element}.{state.attribute}" for state in states)
    for state in states:
        plain = f"{state.element}.{state.attribute}"
        default = getattr(data, state.array)[state.numbers]
        if state.kind == "joint":
            tree = trees.tree(int(mj.jnt_bodyid[state.number]))
            always, contact = trees.always([tree])
        else:
            tree, always, contact = _of_actuator(trees, state.number, stateful=True)
        scalar = len(state.numbers) == 1
        rotation = state.attribute == "orientation"
        yield StateRow(
            name=f"{state.kind}:{plain}" if named[plain] > 1 else plain,
            unit=state.unit,
            shape=() if scalar else (len(state.numbers),),
            default=_numbers(default[0] if scalar else default),
            low=-1.0 if rotation else min(state.low, float(default.min())),
            high=1.0 if rotation else max(state.high, float(default.max())),
            doc=state.doc,
            always=always,
            contact=contact,
            tree=tree,
            kind="rotation" if rotation else "real",
        )


def _of_actuator(
    trees: Couplings, actuator: int, *, stateful: bool
) -> tuple[int, frozenset[int], frozenset[int]]:
    """Give the tree that an actuator is counted to, and what it acts on.

    The inner state of an actuator belongs to the tree it moves.
    """
    always, contact = trees.actuator(actuator)
    tree = min(always or contact or {0})
    if stateful:
        always |= {tree}
    return tree, always, contact - always


def _inputs(
    mj: mujoco.MjModel, names: Mapping[str, tuple[str, ...]], trees: Couplings, data: mujoco.MjData
) -> Iterator[Input]:
    """Describe the components of a command; the data have those of the beginning."""
    for actuator in range(mj.nactuator):
        name = names["actuator"][actuator]
        first, count = int(mj.actuator_ctrladr[actuator]), int(mj.actuator_ctrlnum[actuator])
        unit, doc = control_unit(mj, actuator), _CONTROLS[servo(mj, actuator)]
        stateful = bool(mj.actuator_actnum[actuator])
        _, always, contact = _of_actuator(trees, actuator, stateful=stateful)
        for i in range(count):
            limited = mj.actuator_ctrllimited[first + i]
            low, high = mj.actuator_ctrlrange[first + i] if limited else (-math.inf, math.inf)
            yield Input(
                name=f"{name}.control" if count == 1 else f"{name}.control_{i}",
                unit=unit,
                shape=(),
                default=min(max(float(data.ctrl[first + i]), float(low)), float(high)),
                low=float(low),
                high=float(high),
                doc=doc,
                always=always,
                contact=contact,
            )


def contact_bodies(mj: mujoco.MjModel) -> tuple[str, ...]:
    """Name the body of every shape, then the flexes, as lists of contacts do."""
    names = element_names(mj)
    return (*(names["body"][int(body)] for body in mj.geom_bodyid), *names["flex"])


def body_names(mj: mujoco.MjModel) -> tuple[str, ...]:
    """Name all bodies, by number; the first is the world."""
    return element_names(mj)["body"]
