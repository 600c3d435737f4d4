"""What of a model the engine can honour, and what it cannot."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.backends.bullet.build import (
    BALL,
    FREE,
    MOST_LINKS,
    SHAPES,
    couplings,
    links,
    takes_armature,
    unit_of,
)
from scm_world.backends.mujoco import fields, reading
from scm_world.backends.mujoco.trees import Couplings, works
from scm_world.errors import EngineFailure, ModelError, NotIntervenable
from scm_world.models.model import Model, Parameter
from scm_world.models.scene import ParameterKey, Parameters, State

UNIT = 1e-12  # a quaternion whose squared norm is this near to 1 is taken as it is


@lru_cache(maxsize=64)
def realized(model: Model) -> Model:
    """Return the model that stands for another one in this engine; usually itself."""
    return model if model.instead is None else model.instead()


@lru_cache(maxsize=64)
def unsupported(model: Model) -> tuple[str, ...]:
    """List everything in a model that the engine cannot honour."""
    mj = reading.compiled(realized(model))
    names, trees, tables = fields.element_names(mj), Couplings(mj), list[tuple[str, Any, str]]()
    touching: NDArray[np.bool_] = np.asarray(trees.touches.any(axis=1))
    dynamic: NDArray[np.bool_] = np.asarray(trees.dynamic.any(axis=1))
    kinds, dofs = mj.jnt_type, mj.jnt_dofadr
    loss, odd = mj.dof_frictionloss[dofs] != 0.0, ~np.isin(mj.geom_type, list(SHAPES))
    working = np.array([works(mj, actuator) for actuator in range(mj.nactuator)], dtype=np.bool_)
    adhesion = mj.actuator_trntype == int(mujoco.mjtTrn.mjTRN_BODY)
    tables += [
        (
            "joint",
            (mj.dof_armature[dofs] != 0.0) & ~_hinged(mj)[mj.jnt_bodyid],
            "armature of the joint {!r}, which is not a hinge that alone carries a body on the "
            "world",
        ),
        ("joint", (kinds == BALL) & (mj.jnt_limited != 0), "limits of the ball joint {!r}"),
        ("joint", (kinds == FREE) & loss, "frictionloss of the free joint {!r}"),
        ("joint", (kinds == BALL) & loss, "frictionloss of the ball joint {!r}"),
        (
            "tendon",
            (mj.tendon_frictionloss != 0.0) | (mj.tendon_armature != 0.0) | mj.tendon_limited,
            "frictionloss, armature or limits of the tendon {!r}",
        ),
        ("actuator", working & adhesion, "the actuator {!r}, which acts by contact"),
        (
            "actuator",
            working & ~adhesion & (mj.actuator_armature != 0.0),
            "the actuator {!r}, which adds armature of its own",
        ),
        ("flex", np.ones(mj.nflex), "the flex {!r}"),
        ("geom", touching & odd, "the {kind} {!r}"),
        (
            "geom",
            touching & ((mj.geom_adhesion != 0.0) | (mj.geom_surfacevel != 0.0).any(axis=1)),
            "adhesion or moving surface of the geom {!r}",
        ),
        (
            "pair",
            dynamic[mj.pair_geom1] | dynamic[mj.pair_geom2] | ~_multiplied(mj),
            "the pair {!r}, whose friction is not the product of those of its shapes",
        ),
        ("body", mj.body_mocapid >= 0, "the mocap body {!r}"),
    ]
    found = []
    for element, which, sentence in tables:
        for number in np.flatnonzero(which).tolist():
            kind = mujoco.mjtGeom(mj.geom_type[number]).name if element == "geom" else ""
            kind = kind.removeprefix("mjGEOM_").lower()
            found.append(sentence.format(names[element][number], kind=kind))
    found += _of_couplings(mj, names)
    for tree in range(mj.ntree):
        unit = unit_of(mj, tree, np.flatnonzero(touching).tolist())
        count = links(mj, unit)
        if count > MOST_LINKS:
            found.append(
                f"the {count} links that {names['body'][unit.bodies[0]]!r} and all that hangs on "
                f"it need: there is room for {MOST_LINKS}"
            )
    return tuple(found)


def _of_couplings(mj: mujoco.MjModel, names: Mapping[str, tuple[str, ...]]) -> Iterator[str]:
    """List the equality constraints that are not joints which follow one another in proportion."""
    for equality in couplings(mj, range(mj.njnt)):
        kind = int(mj.eq_type[equality])
        ends = int(mj.eq_obj1id[equality]), int(mj.eq_obj2id[equality])
        what = f"the equality constraint {names['equality'][equality]!r}"
        joints = kind == int(mujoco.mjtEq.mjEQ_JOINT) and ends[1] >= 0
        if not joints or mj.eq_data[equality, 2:5].any():
            word = mujoco.mjtEq(kind).name.removeprefix("mjEQ_").lower()
            yield f"{what} ({word})"
        elif len({int(mj.body_treeid[mj.jnt_bodyid[end]]) for end in ends}) > 1:
            one, other = (names["joint"][end] for end in ends)
            yield f"{what}, which joins {one!r} and {other!r} of two trees"


def _multiplied(mj: mujoco.MjModel) -> NDArray[np.bool_]:
    """Return which pairs have the product of the frictions of their shapes, shape (npair,)."""
    factors = mj.geom_friction[:, 0]
    products = factors[mj.pair_geom1] * factors[mj.pair_geom2]
    same: Any = mj.pair_friction[:, :2] == products[:, None]
    found: NDArray[np.bool_] = same.all(axis=1)
    return found


def _hinged(mj: mujoco.MjModel) -> NDArray[np.bool_]:
    """Return which bodies take the armature of their joint, shape (nbody,)."""
    return np.array([takes_armature(mj, body) for body in range(mj.nbody)], dtype=np.bool_)


def check(model: Model, parameters: Parameters) -> None:
    """Refuse what the engine cannot honour, before anything is made.

    Args:
        model: What is to be built.
        parameters: Those that are given.

    Raises:
        ModelError: All of it that is in the model.
        NotIntervenable: A parameter that the engine lacks is not as in the model.
        EngineFailure: A number is not finite, or a rotation has no direction.
    """
    problems = unsupported(model)
    if problems:
        advice = "take it out of the model, or use backend='mujoco'"
        raise ModelError([f"Bullet cannot honour {what}; {advice}" for what in problems])
    known, rows = changes(model), {row.key: row for row in model.parameters}
    for key, value in parameters.items():
        row = rows[key]
        if not np.isfinite(value).all():
            name, found = ".".join(key), value.tolist()
            raise EngineFailure(f"{name} must be finite, got {found}", "bullet")
        if row.kind == "rotation" and not value.any():
            found = value.tolist()
            raise EngineFailure(f"{row.name} must be a quaternion, got {found}", "bullet")
        if row.visual or key in known:
            continue
        if not np.array_equal(np.broadcast_to(np.array(row.default), row.shape), value):
            raise NotIntervenable(
                row.name,
                f"is no parameter on Bullet: there it keeps its default {row.default}; use "
                "backend='mujoco'",
            )


@lru_cache(maxsize=64)
def rotations(model: Model) -> tuple[int, ...]:
    """List where in the state the quaternions begin."""
    slices = model.layout.slices
    return tuple(slices[row.name].start for row in model.states if row.kind == "rotation")


def settle(model: Model, given: State, last: State | None = None) -> Floats:
    """Return the vector of a state with unit quaternions; what cannot be set is as it was last.

    Raises:
        ValueError: It is a state of another structure.
        EngineFailure: A number is not finite.
    """
    layout, vector = model.layout, given.vector.copy()
    if vector.size != layout.size:
        raise ValueError(f"expected a state of {layout.size} numbers, got {given!r}")
    for name in layout.reported:
        there = last is not None and name in last.layout.slices
        vector[layout.slices[name]] = last[name] if last is not None and there else 0.0
    numbers: list[float] = vector.tolist()
    if not math.isfinite(sum(numbers)):
        raise EngineFailure(f"a state must be finite, got {given!r}", "bullet")
    for row in model.states:
        if row.kind == "rotation":
            where = layout.slices[row.name]
            turn = numbers[where]
            square = sum(part * part for part in turn)
            scale = math.sqrt(square) if abs(square - 1.0) >= UNIT and square else 1.0
            scale = -scale if row.frame == "world" and turn[3] < 0.0 else scale
            vector[where] = [part / scale for part in turn]
    return vector


# --- parameters -----------------------------------------------------------------------------------

FORCES = (
    "actuator_gainprm", "actuator_biasprm", "actuator_gear", "actuator_ctrlrange",
    "actuator_forcerange", "actuator_damping", "actuator_dynprm", "jnt_actfrcrange",
    "dof_damping", "jnt_stiffness", "qpos_spring", "tendon_stiffness", "tendon_damping",
    "tendon_lengthspring", "site_pos", "site_quat", "body_gravcomp", "opt.wind", "opt.density",
    "opt.viscosity",
)  # fmt: skip
"""What acts by smooth forces alone: they come from MuJoCo."""
LIVE = (*FORCES, "opt.gravity", "opt.timestep", "body_mass", "pair_solref")
"""What bodies that are there take on."""
REBUILT = (
    "body_pos", "body_quat", "body_ipos", "jnt_pos", "jnt_axis", "qpos0", "geom_pos", "geom_quat",
    "geom_size",
)  # fmt: skip
"""What only new bodies take on."""


def _honoured(mj: mujoco.MjModel) -> list[tuple[str, bool, Any]]:
    """List arrays, whether they need new bodies, and which of their rows or numbers count."""
    hinged, scalar = _hinged(mj), ~np.isin(mj.jnt_type, (FREE, BALL))
    dynamic = Couplings(mj).dynamic.any(axis=1)
    return [
        *((name, False, True) for name in LIVE),
        *((name, True, True) for name in REBUILT),
        ("body_inertia", False, ~hinged[:, None]),
        ("body_inertia", True, hinged[:, None]),
        ("dof_armature", True, hinged[mj.dof_bodyid]),
        ("jnt_range", False, scalar[:, None]),
        ("dof_frictionloss", False, scalar[mj.dof_jntid]),
        ("geom_friction", False, np.stack([dynamic | True, ~dynamic, ~dynamic], axis=1)),
        ("pair_friction", False, np.arange(5) < 3),
    ]


def _read(mj: mujoco.MjModel, name: str) -> Floats:
    """Copy an array of the model, or an option."""
    of, _, option = name.rpartition(".")
    return np.array(getattr(getattr(mj, of) if of else mj, option), dtype=np.float64)


def _write(mj: mujoco.MjModel, name: str, value: Floats) -> None:
    """Write what ``_read`` has copied."""
    of, _, option = name.rpartition(".")
    if value.ndim:
        getattr(getattr(mj, of) if of else mj, option)[...] = value
    else:
        setattr(mj.opt, option, float(value))


def _saved(mj: mujoco.MjModel) -> NDArray[np.uint8]:
    """Copy everything in a model."""
    buffer = np.empty(mujoco.mj_sizeModel(mj), np.uint8)
    mujoco.mj_saveModel(mj, None, buffer)
    return buffer


def _other(row: Parameter) -> Floats:
    """Return another value of a parameter."""
    value = np.array(np.broadcast_to(row.default, row.shape), dtype=np.float64)
    if row.kind == "switch":
        return 1.0 - value
    near = np.where(value == 0.0, 0.01, 1.1 * value)
    return np.where((near >= row.low) & (near <= row.high), near, 0.9 * value)


@lru_cache(maxsize=64)
def changes(model: Model) -> Mapping[ParameterKey, bool]:
    """Map the parameters that the engine has to whether a change of them needs new bodies.

    Each is tried on a copy of the compiled model: the engine has a parameter if nothing is written
    but what it honours.
    """
    model = realized(model)
    mj = copy.copy(reading.compiled(model))
    slots = model.slots(mj, mujoco.MjData(mj))
    untouched, found = _saved(mj), dict[ParameterKey, bool]()
    rows = [(name, new, which, _read(mj, name)) for name, new, which in _honoured(mj)]
    for row in model.parameters:
        slot = slots[row.key]
        before = slot.read()
        slot.write(_other(row))
        if slot.follow_up:
            slot.follow_up(mj)
        takes, multiplied = set[bool](), _multiplied(mj).all()
        for name, new, which, was in rows:
            now = _read(mj, name)
            changed = (now != was) & which
            if changed.any():
                takes.add(new)
                _write(mj, name, np.where(changed, was, now))
        if takes and multiplied and np.array_equal(_saved(mj), untouched):
            found[row.key] = any(takes)
        for name, _, _, was in rows:
            _write(mj, name, was)
        slot.write(before)
    return found


@lru_cache(maxsize=64)
def rebuilt(model: Model) -> tuple[ParameterKey, ...]:
    """List the parameters that need new bodies."""
    return tuple(key for key, new in changes(model).items() if new)


def supports(model: Any, key: ParameterKey) -> bool:
    """Return whether a parameter of a model can be set: the engine has it, or only pictures do."""
    if not isinstance(model, Model):
        return False
    return key in changes(model) or any(row.key == key and row.visual for row in model.parameters)
