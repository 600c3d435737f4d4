"""How far a model, as it is simulated here, is from plain MuJoCo with its file."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, final

import mujoco
import numpy as np

from scm_world._types import Floats
from scm_world.backends import make_backend
from scm_world.backends.mujoco.contacts import shapes_of
from scm_world.backends.mujoco.fields import element_names
from scm_world.errors import EngineFailure
from scm_world.models.model import Model
from scm_world.models.scene import TOLERANCE as DEEP
from scm_world.models.scene import Scene

STEPS, CONTROL_STEP = 5, 0.02  # so many of this length [s]
TOLERANCE = 1e-4
"""Differences of positions that are worth a warning [m] or [rad]."""
FAR = "It is far from plain MuJoCo"
"""The beginning of that warning."""

LOST = "state lost"
"""What a change is called that is a state that is not finite."""

_APART = "would tie trees together that do not touch"
_FEW = "without a warm start, a solver does not converge in as few as the file has"
_REASONS = {
    "integrator": f"Euler's implicit damping {_APART}",
    "eulerdamp": f"Euler's implicit damping {_APART}",
    "jacobian": f"PGS and the noslip solver with a dense one {_APART}",
    "iterations": _FEW,
    "ls_iterations": _FEW,
    "warmstart": "the last solution is not a variable, and its choice ties trees together",
    "island": f"one solve for all constraints {_APART}",
    "autoreset": "a state that is not finite is an error",
    "sleep": "whether a tree sleeps is not a variable",
}
"""Why an option is not as in the file. Source: docs/models.md, "The graph"."""
_ALWAYS = ("warmstart", "island", "autoreset", "sleep", "ls_iterations")
"""Changes that are not worth a note of their own."""
_WORDS = {
    "jacobian": "Jacobian",
    "iterations": "number of iterations",
    "eulerdamp": "flag eulerdamp",
}

Change = tuple[str, str, str, str]


@final
@dataclass(frozen=True, eq=False)
class Fidelity:
    """How a model, as it is simulated here, differs from plain ``mj_step`` of its file.

    Differences are the largest ones over the first 5 control steps of 0.02 s from the start pose,
    with the controls that it has there (``idle``) and with random ones within the control limits.
    What was asked for (``settings=``, ``ground=``, ``self_collision=``) counts as a part of the
    file.

    Attributes:
        backend: Name of the backend.
        changes: Data frame of what is not as in the file: ``what``, ``file``, ``here``, ``why``.
        differences: Data frame by state: ``unit``, ``idle``, ``random``; ``floor``, by how much a
            control step depends on the solver's memory of the last one (0 if ``exact``); and
            ``converged``, the largest difference from plain MuJoCo with as many iterations as
            here, where the file has fewer. Rotations differ by an angle [rad].
        start: Data frame of contacts and limits that the start pose violates: ``kind``, ``what``,
            ``size`` and ``unit``.
    """

    backend: str
    changes: Any
    differences: Any
    start: Any

    @property
    def floor(self) -> float:
        """The noise floor: the largest effect of the solver's memory on any state."""
        return float(self.differences["floor"].max())

    def largest(self, column: str = "") -> tuple[float, str]:
        """Return the largest difference of positions, as a number [m] or [rad] and in words.

        Args:
            column: A column of ``differences``; the larger of ``idle`` and ``random`` if empty.
        """
        table = self.differences[self.differences["unit"].isin(("m", "rad"))]
        sizes = table[column] if column else table[["idle", "random"]].max(axis=1)
        if not len(sizes) or not sizes.max():
            return 0.0, "0 rad or m"
        name = sizes.idxmax()
        return float(sizes[name]), f"{sizes[name]:.2g} {table['unit'][name]} ({name})"

    def __str__(self) -> str:
        names = dict.fromkeys(w for w in self.changes["what"] if w not in ("note", LOST))
        changed = ", ".join(names) or "nothing"
        violated = f"; contacts and limits violated at the start: {len(self.start)}"
        return (
            f"up to {self.largest()[1]} from plain MuJoCo in the first {STEPS} control steps of "
            f"{CONTROL_STEP:g} s; noise floor {self.floor:.2g}; changed: {changed}"
            f"{violated if len(self.start) else ''}{self._lost}"
        )

    @property
    def _lost(self) -> str:
        rows = self.changes[self.changes["what"] == LOST]
        said = (f"{LOST}: {row.here} here, {row.file} in plain MuJoCo" for row in rows.itertuples())
        return "".join(f"; {one}" for one in dict.fromkeys(said))


def _said(name: str, value: int) -> str:
    """Return the value of an option in words of MJCF."""
    members = getattr(mujoco, f"mjt{name.capitalize()}", None)
    return members(value).name.partition("_")[2].capitalize() if members else str(value)


def _changed(file: mujoco.MjOption, here: mujoco.MjOption) -> Iterator[Change]:
    """List the options that are not as in the file."""
    for name in ("integrator", "jacobian", "iterations", "ls_iterations"):
        old, new = int(getattr(file, name)), int(getattr(here, name))
        if old != new:
            yield name, _said(name, old), _said(name, new), _REASONS[name]
    words = "disable", "enable"
    for name in ("eulerdamp", "warmstart", "island", "autoreset", "sleep"):
        bit = getattr(mujoco.mjtDisableBit, f"mjDSBL_{name.upper()}", None)
        flags = "enableflags" if bit is None else "disableflags"
        bit = int(mujoco.mjtEnableBit.mjENBL_SLEEP if bit is None else bit)
        old, new = (bool(getattr(one, flags) & bit) == (name == "sleep") for one in (file, here))
        if old != new:
            yield name, words[old], words[new], _REASONS[name]


def _violations(
    mj: mujoco.MjModel, start: mujoco.MjData, model: Model
) -> Iterator[tuple[str, str, float, str]]:
    """List pairs of bodies that lie in one another [m], and joints and tendons beyond limits."""
    data, names = copy.copy(start), element_names(mj)
    data.warning.number[:] = 1  # MuJoCo prints the first warning of a kind
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
    scalar = np.isin(mj.jnt_type, (2, 3)) & (mj.jnt_limited != 0)  # slides and hinges
    for kind, which, values, ranges in (
        ("joint", scalar, data.qpos[mj.jnt_qposadr], mj.jnt_range),
        ("tendon", mj.tendon_limited != 0, data.ten_length, mj.tendon_range),
    ):
        beyond = np.maximum(ranges[:, 0] - values, values - ranges[:, 1])
        for i in np.flatnonzero(which & (beyond > 1e-9)).tolist():
            unit = "rad" if kind == "joint" and mj.jnt_type[i] == 3 else "m"
            yield "limit", f"{kind} {names[kind][i]}", float(beyond[i]), unit


def notes_of(model: Model, plain: mujoco.MjModel, start: mujoco.MjData) -> Iterator[str]:
    """List in sentences what a reader of results has to know; the file is plain and in a state."""
    here = model.source.realized
    changes = [change for change in _changed(plain.opt, here.opt) if change[0] not in _ALWAYS]
    for what, old, new, why in changes:
        yield f"The {_WORDS.get(what, what)} is {new.lower()} instead of {old}: {why}."
    for kind, least in (("contact", DEEP), ("limit", 1e-6)):
        wrong = [v for v in _violations(here, start, model) if v[0] == kind and v[2] > least]
        more = f" and {len(wrong) - 4} more" if len(wrong) > 4 else ""
        listed = ", ".join(f"{what} ({size:.2g} {unit})" for _, what, size, unit in wrong[:4])
        lie = "has bodies in one another" if kind == "contact" else "is beyond limits"
        if wrong:
            yield f"The start pose {lie}: {listed}{more}."
    few = any(what == "iterations" for what, *_ in changes)
    found = fidelity(model) if few or not model.exact else None
    if found and model.exact and not found.largest()[0] <= TOLERANCE:
        yield (
            f"{FAR}: in the first {STEPS} control steps of {CONTROL_STEP:g} s it differs by up to "
            f"{found.largest()[1]}, and from MuJoCo with as many iterations by "
            f"{found.largest('converged')[1]}. exact=False keeps the solver of the file."
        )
    if found and not model.exact:
        yield (
            "exact=False: the solver begins with the solution of the last step, which is not a "
            f"variable; in the first steps that moves a state by up to {found.floor:.2g}, so that "
            "smaller effects are noise."
        )


@lru_cache(maxsize=32)
def fidelity(model: Model, backend: str = "mujoco") -> Fidelity:
    """Measure how far a model on a backend is from plain MuJoCo with its file.

    Raises:
        ModelError: The backend cannot realise the model.
    """
    import pandas

    plain, here = model.source.whole, model.source.realized
    changes = [*_changed(plain.opt, here.opt)]
    if backend != "mujoco":
        gone = ", ".join(name for name, why in model.refused if why.endswith(f" of {backend}"))
        why = f"contacts, limits, solver and integrator are those of {backend}"
        changes = [("engine", "mujoco", backend, why)]
        changes += [("parameters", "", "fixed", f"{gone}: no parameters of {backend}")] * bool(gone)
    few = any(what == "iterations" for what, *_ in changes)
    low, high = (
        np.array([getattr(row, end) for row in model.inputs], dtype=np.float64)
        for end in ("low", "high")
    )
    endless = [row.name for row in model.inputs if not np.isfinite((row.low, row.high)).all()]
    changes += [("control limits", "none", "[-1, 1]", f"{name} has none") for name in endless]
    changes += [("note", "", "", note) for note in model.notes]
    steps = max(1, math.ceil(CONTROL_STEP / model.timestep - 1e-9))
    low, high = np.where(np.isfinite(low), low, -1.0), np.where(np.isfinite(high), high, 1.0)
    idle = np.array([row.default for row in model.inputs]).clip(low, high)
    drawn = np.random.default_rng(0).uniform(low, high, (STEPS, len(low)))
    found = {row.name: {"unit": row.unit} for row in model.states}
    table = pandas.DataFrame.from_dict(found, orient="index").assign(floor=0.0)
    table.loc[[row.name for row in model.states if row.kind == "rotation"], "unit"] = "rad"
    for label, commands in (("idle", np.tile(idle, (STEPS, 1))), ("random", drawn)):
        states, floors = _run(model, backend, commands, steps, memory=not model.exact)
        file = _run(_with(model, "plain"), "mujoco", commands, steps)[0]
        table[label] = _apart(model, states, file)
        if not model.exact:
            table["floor"] = np.maximum(table["floor"], _apart(model, floors, states[1:]))
        ends = [int(np.isfinite(found).all(axis=1).sum()) for found in (file, states)]
        if min(ends) <= STEPS:
            then, now = (f"in control step {n - 1}" if n <= STEPS else "not" for n in ends)
            why = "a shorter timestep, smaller forces or more damping keep it finite"
            changes.append((LOST, then, now, f"{label} controls: {why}"))
        if few:
            more = _apart(model, states, _run(_with(model, "raised"), "mujoco", commands, steps)[0])
            table["converged"] = np.maximum(more, table.get("converged", 0.0))
    violated = pandas.DataFrame(
        [*_violations(here, _started(model), model)], columns=["kind", "what", "size", "unit"]
    )
    frame = pandas.DataFrame(changes, columns=["what", "file", "here", "why"])
    return Fidelity(backend, frame, table, violated)


def _with(model: Model, settings: Any) -> Model:
    return replace(model, source=replace(model.source, settings=settings))


def _started(model: Model) -> mujoco.MjData:
    """Return MuJoCo's data in the start pose."""
    engine: Any = make_backend("mujoco")
    engine.build(model.default_scene())
    return engine.realization.data


def _run(
    model: Model, backend: str, commands: Floats, substeps: int, *, memory: bool = False
) -> tuple[Floats, Floats]:
    """Return the states from the start on, (n + 1, k), and those after each step without memory.

    The latter, (n, k), begin with the state alone: nothing else of the last step is known.
    """
    engine, other = make_backend(backend), make_backend(backend)
    scene = model.default_scene()
    if model.source.settings in ("plain", "raised"):  # numbers of the file, but for a keyframe
        poses = ("position", "orientation")
        scene = scene.with_(parameters={k: v for k, v in scene.parameters.items() if k[1] in poses})
    engine.build(scene)
    states = np.full((len(commands) + 1, model.layout.size), np.inf)
    states[0] = engine.read().vector
    anew = states[1:].copy()
    try:
        for number, command in enumerate(commands):
            engine.step(command, substeps)
            states[number + 1] = engine.read().vector
            if memory:
                now = model.empty_state().with_vector(states[number].copy())
                other.build(Scene(model, model.default_parameters(), now))
                other.step(command, substeps)
                anew[number] = other.read().vector
    except EngineFailure:
        pass  # the rest stays infinite
    engine.close()
    other.close()
    return states, anew if memory else states[1:]


def _apart(model: Model, one: Floats, other: Floats) -> list[float]:
    """Return the largest difference of each state over all rows, in its unit or [rad]."""
    found = []
    for row in model.states:
        a, b = (states[:, model.layout.slices[row.name]] for states in (one, other))
        with np.errstate(invalid="ignore"):
            if row.kind == "rotation":  # |q - p| = 2 sin(angle / 4), for the nearer of p and -p
                chord = np.minimum(*(np.linalg.norm(a - sign * b, axis=1) for sign in (1.0, -1.0)))
                apart = 4.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))
            else:
                apart = np.abs(a - b)
        found.append(float(np.nan_to_num(apart, nan=np.inf, posinf=np.inf).max()))
    return found
