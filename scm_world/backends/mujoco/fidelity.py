"""How far a model, as it is simulated here, is from plain MuJoCo with its file."""

from __future__ import annotations

import copy
import hashlib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, final

import mujoco
import numpy as np

from scm_world._types import Floats
from scm_world.backends import make_backend
from scm_world.backends.mujoco.contacts import shapes_of
from scm_world.backends.mujoco.equalities import Violation, violations
from scm_world.backends.mujoco.fields import HINGE, SLIDE, element_names
from scm_world.backends.mujoco.scratch import silent
from scm_world.backends.mujoco.sources import EFFORTS, strain
from scm_world.errors import EngineFailure, some
from scm_world.models.model import HELD, Model, StateRow
from scm_world.models.scene import TOLERANCE as DEEP
from scm_world.models.scene import Scene

STEPS, CONTROL_STEP = 5, 0.02  # so many of this length [s]
_WHEN = f"in the first {STEPS} control steps of {CONTROL_STEP:g} s"
TOLERANCE = 1e-4
"""Differences of positions that are worth a warning [m] or [rad]."""
NUDGE = 1e-12
"""How far the start is moved to see what the file does with rounding [m] or [rad]."""
FAR = "It is far from plain MuJoCo"
"""The beginning of that warning."""
LOST = "state lost"
"""What a change is called that is a state that is not finite."""

_APART = "would tie trees together that do not touch"
_FEW = "without a warm start, a solver does not converge in as few as the file has"
_REASONS = {
    "jacobian": f"PGS and the noslip solver with a dense one {_APART}",
    "iterations": _FEW,
    "ls_iterations": _FEW,
    "tolerance": "without a warm start, a solver stops too early with that of the file",
    "warmstart": "the last solution is not a variable, and its choice ties trees together",
    "island": f"one solve for all constraints {_APART}",
    "autoreset": "a state that is not finite is an error",
    "sleep": "whether a tree sleeps is not a variable",
}
"""Why an option is not as in the file. Source: docs/models.md, "The graph"."""
_NOTED = {"jacobian": "Jacobian", "iterations": "number of iterations"}
"""Changes that are worth a note of their own, in words."""
_BAD = [int(getattr(mujoco.mjtWarning, f"mjWARN_BADQ{what}")) for what in ("POS", "VEL", "ACC")]

Change = tuple[str, str, str, str]


@final
@dataclass(frozen=True, eq=False)
class Fidelity:
    """How a model, as it is simulated here, differs from plain ``mj_step`` of its file.

    Differences are the largest ones over the first 5 control steps of 0.02 s from the start pose,
    with the controls that it has there (``idle``) and with random ones within the control limits,
    until a state is lost. What was asked for (``settings=``, ``ground=``, ``self_collision=``)
    counts as a part of the file.

    Attributes:
        backend: Name of the backend.
        changed: The rows of ``changes``.
        columns: The columns of ``differences``, each with a number for each state.
        units: The unit of each state; rotations differ by an angle [rad].
        violated: The rows of ``start``.
        notes: What a reader of results has to know, in sentences.
    """

    backend: str
    changed: tuple[Change, ...]
    columns: Mapping[str, Sequence[float]]
    units: Mapping[str, str]
    violated: tuple[Violation, ...]
    notes: tuple[str, ...] = ()

    @cached_property
    def changes(self) -> Any:
        """Data frame of the changes from the file: ``what``, ``file``, ``here``, ``why``."""
        import pandas

        return pandas.DataFrame([*self.changed], columns=["what", "file", "here", "why"])

    @cached_property
    def differences(self) -> Any:
        """Data frame by state: ``unit``, ``idle``, ``random``, ``floor`` and perhaps causes.

        ``floor`` is by how much a control step depends on the solver's memory of the last one (0
        if the model is exact). Where positions differ by more than 1e-4 m or rad, ``converged`` is
        the difference from plain MuJoCo with a converged solver, ``file`` that of the file from it,
        and ``rounding`` how far that ends from itself if it begins 1e-12 m or rad away.
        """
        import pandas

        return pandas.DataFrame({"unit": self.units.values(), **self.columns}, [*self.units])

    @cached_property
    def start(self) -> Any:
        """Data frame of contacts, constraints and limits that the start pose violates."""
        import pandas

        return pandas.DataFrame([*self.violated], columns=["kind", "what", "size", "unit"])

    @property
    def floors(self) -> Mapping[str, float]:
        """The noise floor of each unit: the largest effect of the solver's memory on any state."""
        units = dict.fromkeys(self.units.values())
        return {unit: self.largest("floor", (unit,))[0] for unit in units}

    def largest(self, column: str = "", units: Iterable[str] = ("m", "rad")) -> tuple[float, str]:
        """Return the largest difference of positions, as a number [m] or [rad] and in words.

        Args:
            column: A column of ``differences``; the larger of ``idle`` and ``random`` if empty.
            units: Of the states that are compared.
        """
        columns = [self.columns[one] for one in ((column,) if column else ("idle", "random"))]
        sizes = zip(map(max, *columns, columns[0]), self.units.items(), strict=True)
        kept = [(size, *state) for size, state in sizes if state[1] in units]
        size, name, unit = max(kept, default=(0.0, "", ""), key=lambda row: row[0])
        return size, f"{size:.2g} {unit} ({name})" if size else f"0 {' or '.join(units)}"

    @property
    def far(self) -> bool:
        """Whether positions differ by more than 1e-4 m or rad, or a state is lost only here."""
        lost = any(what == LOST and file == "not" for what, file, *_ in self.changed)
        return lost or self.largest()[0] > TOLERANCE

    def __str__(self) -> str:
        names = dict.fromkeys(
            what if what not in ("engine", "parameters") else f"{what} ({_short(why)})"
            for what, *_, why in self.changed
            if what != LOST
        )
        said = [f"up to {self.largest()[1]} from plain MuJoCo {_WHEN}"]
        if any(self.columns["floor"]):
            said.append(f"noise floor {self.noise}")
        said.append(f"changed: {', '.join(names) or 'nothing'}")
        if self.violated:
            said.append(f"at the start: {listed(self.violated)}")
        lost = (change for change in self.changed if change[0] == LOST)
        said += [f"{LOST}: {now} here, {then} in plain MuJoCo" for _, then, now, _ in lost]
        return "; ".join(dict.fromkeys(said))

    @property
    def noise(self) -> str:
        """The noise floor of each unit, in words."""
        sizes = self.floors.items()
        return ", ".join(f"{size:.2g} {unit}" for unit, size in sizes if size) or "0"


def _short(text: str, most: int = 160) -> str:
    return text if len(text) <= most else f"{text[:most].rpartition(',')[0]}, …"


def listed(violated: Sequence[Violation]) -> str:
    """Name the largest violations of the start pose, and count the others."""
    found = sorted(violated, key=lambda one: -one[2])
    return some([f"{what} ({size:.2g} {unit})" for _, what, size, unit in found])


def measured(model: Model, start: mujoco.MjData) -> Model:
    """Return a model with its fidelity, with notes of it, and with a solver that converges.

    The solver of an exact model that is far from the file goes on where that halves the distance.
    """
    source, commands = model.source, _commands(model)
    runs = [_path(model, source.whole, start, one) for one in commands]
    found = _compared(model, "mujoco", runs, start)
    if found.far and model.exact and not source.drop:
        file = source.lean()
        strain(file.opt, EFFORTS)
        ends, nudged = (
            [_path(model, file, start, one, nudge=by) for one in commands] for by in (0.0, NUDGE)
        )
        causes = {"file": _apart(model, runs, ends), "rounding": _apart(model, ends, nudged)}
        for effort in range(EFFORTS + 1):
            trial = replace(model, source=replace(model.source, effort=effort))
            other = _compared(trial, "mujoco", runs, start, ends)
            if not effort or other.largest()[0] < 0.5 * found.largest()[0]:
                found, source = replace(other, columns={**other.columns, **causes}), trial.source
            if not found.far or found.largest("rounding")[0] > TOLERANCE:
                break
        if source.effort:
            digest = hashlib.sha256(f"{model.digest}\0{source.effort}".encode()).hexdigest()
            model = replace(model, source=source, digest=digest)
    found = replace(found, notes=tuple(_notes(model, found)))
    return replace(model, fidelity=found, notes=(*_begun(found), *model.notes))


def fidelity(model: Model, backend: str = "mujoco", begin: Scene | None = None) -> Fidelity:
    """Return how far a model on a backend is from plain MuJoCo with its file.

    Violations are those of the scene in which episodes ``begin``, or of the file.

    Raises:
        ModelError: The backend cannot realise the model.
    """
    engine: Any = make_backend("mujoco")
    engine.build(model.default_scene())
    found, start = model.fidelity, engine.realization.data
    if backend != "mujoco" or not isinstance(found, Fidelity):
        runs = [_path(model, model.source.whole, start, one) for one in _commands(model)]
        found = _compared(model, backend, runs, start)
    if begin is None:
        return found
    engine.build(begin)
    now = engine.realization
    return replace(found, violated=tuple(_violations(now.model, now.data, model)))


def _compared(
    model: Model,
    backend: str,
    runs: Sequence[Floats],
    start: mujoco.MjData,
    converged: Sequence[Floats] = (),
) -> Fidelity:
    """Compare runs of the file with those of a model on a backend."""
    here, own, floors = model.source.realized, list[Floats](), list[list[float]]()
    changes = [*_changed(model.source.whole.opt, here.opt)]
    if backend != "mujoco":
        supports = make_backend(backend).capabilities.supports
        gone = [row.name for row in model.parameters if not supports(model, row.key)]
        gone += [name for name, why in model.refused.items() if why.endswith(f" of {backend}")]
        why = f"contacts, limits, solver and integrator are those of {backend}"
        changes = [("engine", "mujoco", backend, why)]
        why = f"no parameters of {backend}: {', '.join(gone)}"
        changes += [("parameters", "variables", "fixed", why)] * bool(gone)
    left = f"not in the file that {backend} simulates"
    changes += [(f"drop {feature}", "as it is", "left out", left) for feature in model.source.drop]
    endless = [row.name for row in model.inputs if not np.isfinite((row.low, row.high)).all()]
    changes += [("control limits", "none", "[-1, 1]", f"{name} has none") for name in endless]
    for label, commands, states in zip(("idle", "random"), _commands(model), runs, strict=True):
        if backend == "mujoco":
            alone = None if model.exact else states[1:].copy()
            own.append(_path(model, here, start, commands, alone=alone))
            if alone is not None:
                floors.append(_apart(model, [own[-1][1:]], [alone]))
        else:
            own.append(_steps_on(backend, model, commands))
        ends = [int(np.isfinite(one).all(axis=1).sum()) for one in (states, own[-1])]
        if min(ends) <= STEPS:
            then, now = (f"in control step {n}" if n <= STEPS else "not" for n in ends)
            why = "a shorter timestep, smaller forces or more damping keep it finite"
            changes.append((LOST, then, now, f"{label} controls: {why}"))
    units = {row.name: "rad" if row.kind == "rotation" else row.unit for row in _moving(model)}
    columns = {
        "floor": [max(sizes) for sizes in zip(*floors, strict=True)] or [0.0] * len(units),
        "idle": _apart(model, own[:1], runs[:1]),
        "random": _apart(model, own[1:], runs[1:]),
    }
    if converged:
        columns["converged"] = _apart(model, own, converged)
    violated = tuple(_violations(here, start, model))
    return Fidelity(backend, tuple(changes), columns, units, violated)


def _commands(model: Model) -> tuple[Floats, Floats]:
    """Return the idle command in each control step, and random ones, (5, n_commands) each."""
    ends = (np.array([getattr(row, end) for row in model.inputs], float) for end in ("low", "high"))
    low, high = (np.where(np.isfinite(e), e, s) for e, s in zip(ends, (-1.0, 1.0), strict=True))
    idle = np.array([row.default for row in model.inputs], float).clip(low, high)
    shape = STEPS, len(low)
    return np.broadcast_to(idle, shape), np.random.default_rng(0).uniform(low, high, shape)


def _moving(model: Model) -> list[StateRow]:
    return [row for row in model.states if row.array != HELD]


def _substeps(model: Model) -> int:
    return max(1, math.ceil(CONTROL_STEP / model.timestep - 1e-9))


def _path(
    model: Model,
    mj: mujoco.MjModel,
    start: mujoco.MjData,
    commands: Floats,
    *,
    nudge: float = 0.0,
    alone: Floats | None = None,
) -> Floats:
    """Return the states from the start on, (n + 1, k); infinite ones after the state is lost.

    Coordinates are moved by ``nudge`` first. Into ``alone``, (n, k), go the states after each
    control step that begins with the state and nothing else of the step before.
    """
    data, other = (silent(mujoco.MjData(mj)) for _ in range(2))
    inner = mujoco.mjtState.mjSTATE_FULLPHYSICS
    for one in (data, other):
        for name in ("qpos", "qvel", "act", "ctrl", "mocap_pos", "mocap_quat"):
            getattr(one, name)[:] = getattr(start, name)
    data.qpos += nudge
    moving, layout = [(row, model.layout.slices[row.name]) for row in _moving(model)], model.layout
    states = np.full((len(commands) + 1, layout.size), np.inf)
    before = np.empty(mujoco.mj_stateSize(mj, inner))

    def read(from_: mujoco.MjData, into: Floats) -> None:
        into[:] = 0.0
        for row, place in moving:
            into[place] = getattr(from_, row.array)[[*row.numbers]]

    read(data, states[0])
    for number, command in enumerate(commands):
        mujoco.mj_getState(mj, data, before, inner)
        for one in (data,) if alone is None else (data, other):
            one.ctrl[: len(command)] = command
            try:
                mujoco.mj_step(mj, one, _substeps(model))
            except (mujoco.FatalError, mujoco.UnexpectedError):
                return states  # there is no memory for all contacts
        if (data.warning.number[_BAD] != 1).any():  # a reset forgets the count
            return states
        read(data, states[number + 1])
        if alone is not None:
            read(other, alone[number])
            mujoco.mj_getState(mj, data, before, inner)
            mujoco.mj_setState(mj, other, before, inner)
            other.qacc_warmstart[:] = 0.0
    return states


def _steps_on(backend: str, model: Model, commands: Floats) -> Floats:
    """Return the states from the start on as another backend has them, likewise."""
    engine = make_backend(backend)
    engine.build(model.default_scene())
    states = np.full((len(commands) + 1, model.layout.size), np.inf)
    states[0] = engine.read().vector
    try:
        for number, command in enumerate(commands):
            engine.step(command, _substeps(model))
            states[number + 1] = engine.read().vector
    except EngineFailure:
        pass  # the rest stays infinite
    engine.close()
    return states


def _apart(model: Model, ones: Sequence[Floats], others: Sequence[Floats]) -> list[float]:
    """Return the largest difference of each state while neither is lost, in its unit or [rad]."""
    pairs = [
        (a[kept], b[kept])
        for a, b in zip(ones, others, strict=True)
        for kept in [np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)]
    ]
    one, other = (np.concatenate(side) for side in zip(*pairs, strict=True))
    found = []
    for row in _moving(model):
        a, b = (states[:, model.layout.slices[row.name]] for states in (one, other))
        if row.kind == "rotation":  # |q - p| = 2 sin(angle / 4), for the nearer of p and -p
            chord = np.minimum(*(np.linalg.norm(a - sign * b, axis=1) for sign in (1.0, -1.0)))
            apart = 4.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))
        else:
            apart = np.abs(a - b)
        found.append(float(apart.max(initial=0.0)))
    return found


def _said(name: str, value: float) -> str:
    """Return the value of an option in words of MJCF."""
    members = getattr(mujoco, f"mjt{name.capitalize()}", None)
    return members(value).name.partition("_")[2].capitalize() if members else f"{value:g}"


def _changed(file: mujoco.MjOption, here: mujoco.MjOption) -> Iterator[Change]:
    """List the options that are not as in the file."""
    for name in ("jacobian", "iterations", "ls_iterations", "tolerance"):
        old, new = getattr(file, name), getattr(here, name)
        if old != new:
            yield name, _said(name, old), _said(name, new), _REASONS[name]
    words = "disable", "enable"
    for name in ("warmstart", "island", "autoreset", "sleep"):
        bit = getattr(mujoco.mjtDisableBit, f"mjDSBL_{name.upper()}", None)
        flags = "enableflags" if bit is None else "disableflags"
        bit = int(mujoco.mjtEnableBit.mjENBL_SLEEP if bit is None else bit)
        old, new = (bool(getattr(one, flags) & bit) == (name == "sleep") for one in (file, here))
        if old != new:
            yield name, words[old], words[new], _REASONS[name]


def _violations(mj: mujoco.MjModel, start: mujoco.MjData, model: Model) -> Iterator[Violation]:
    """List what the start violates: bodies in one another [m], equality constraints, limits."""
    data, names = silent(copy.copy(start)), element_names(mj)
    try:
        mujoco.mj_fwdPosition(mj, data)
    except (mujoco.FatalError, mujoco.UnexpectedError):
        return  # there is no memory for all contacts; the first step says so
    deepest: dict[str, float] = {}
    owners, depths = model.owners, (-data.contact.dist).tolist()
    shapes = np.sort(shapes_of(mj, data), axis=1).tolist()
    for (one, other), depth in zip(shapes, depths, strict=True):
        pair = f"{owners[one]} and {owners[other]}"
        deepest[pair] = max(depth, deepest.get(pair, 0.0))
    yield from (("contact", pair, depth, "m") for pair, depth in deepest.items() if depth > 0.0)
    yield from violations(mj, data)
    scalar = np.isin(mj.jnt_type, (SLIDE, HINGE)) & (mj.jnt_limited != 0)
    for kind, which, values, ranges in (
        ("joint", scalar, data.qpos[mj.jnt_qposadr], mj.jnt_range),
        ("tendon", mj.tendon_limited != 0, data.ten_length, mj.tendon_range),
    ):
        beyond = np.maximum(ranges[:, 0] - values, values - ranges[:, 1])
        for i in np.flatnonzero(which & (beyond > 1e-9)).tolist():
            unit = "rad" if kind == "joint" and mj.jnt_type[i] == HINGE else "m"
            yield "limit", f"{kind} {names[kind][i]}", float(beyond[i]), unit


def _begun(found: Fidelity) -> Iterator[str]:
    for kind, least in (("contact", DEEP), ("limit", 1e-6), ("equality", 1e-6)):
        wrong = [one for one in found.violated if one[0] == kind and one[2] > least]
        lie, remedy = "is beyond limits", ""
        if kind == "contact":
            lie = "has bodies in one another"
            remedy = "; self_collision=False leaves out contacts within a robot"
        if kind == "equality":
            lie = "violates equality constraints"
            remedy = "; joints that follow others begin where these put them"
            remedy += ", and with follow=True so do loops"
        if wrong:
            yield f"The start pose {lie}: {listed(wrong)}{remedy}."


def _notes(model: Model, found: Fidelity) -> Iterator[str]:
    """List in sentences what a reader of results has to know."""
    for what, old, new, why in found.changed:
        if what in _NOTED:
            yield f"The {_NOTED[what]} is {new.lower()} instead of {old}: {why}."
    if not model.exact:
        yield (
            "exact=False: the solver begins with the solution of the last step, which is not a "
            f"variable; in the first steps that moves states by up to {found.noise}, so that "
            "smaller effects are noise."
        )
    if found.far:
        yield f"{FAR}: up to {found.largest()[1]} {_WHEN}. {_cause(model, found)}"


def _cause(model: Model, found: Fidelity) -> str:
    """Return why it is far from the file, in sentences."""
    if model.source.drop:
        return f"What drop= leaves out matters: {', '.join(model.source.drop)}."
    file, rounding, converged = map(found.largest, ("file", "rounding", "converged"))
    said = []
    if rounding[0] > TOLERANCE:
        said += [
            f"It is sensitive: begun {NUDGE:g} away, plain MuJoCo ends up to {rounding[1]} away"
        ]
    if file[0] > max(TOLERANCE, rounding[0]):
        said += [f"The solver of the file stops up to {file[1]} from where it converges"]
    if converged[0] > max(TOLERANCE, rounding[0]):
        said += [f"The solver here stops up to {converged[1]} from a converged one"]
    return ". ".join([*said, "exact=False keeps the solver of the file."])
