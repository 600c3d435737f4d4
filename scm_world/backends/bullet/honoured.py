"""The parts of a model that the engine can honour, and those it cannot."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.backends.bullet.build import (
    MOST_LINKS,
    SHAPES,
    coupled,
    links,
    unit_of,
    units_of,
)
from scm_world.backends.mujoco import fields, reading
from scm_world.backends.mujoco.fields import BALL, FREE
from scm_world.backends.mujoco.scratch import kept
from scm_world.backends.mujoco.sources import bytes_of
from scm_world.backends.mujoco.trees import Couplings, works
from scm_world.errors import EngineFailure, ModelError, NotIntervenable, UnknownOption
from scm_world.models.model import Model, Parameter
from scm_world.models.scene import ParameterKey, Parameters, State, Structure

UNIT = 1e-12  # a quaternion whose squared norm is this near to 1 is taken as it is


@kept
def realized(model: Model) -> Model:
    """Return the model that stands for another one in this engine; usually itself."""
    return model if model.instead is None else model.instead()


@kept
def unsupported(model: Model) -> tuple[str, ...]:
    """List everything in a model that the engine cannot honour."""
    mj = reading.compiled(realized(model))
    names, trees = fields.element_names(mj), Couplings(mj)
    touching: NDArray[np.bool_] = np.asarray(trees.touches.any(axis=1))
    dynamic: NDArray[np.bool_] = np.asarray(trees.dynamic.any(axis=1))
    ball, free, odd = mj.jnt_type == BALL, mj.jnt_type == FREE, ~np.isin(mj.geom_type, [*SHAPES])
    loss, armature = (a[mj.jnt_dofadr] != 0.0 for a in (mj.dof_frictionloss, mj.dof_armature))
    tendons = (mj.tendon_frictionloss != 0.0) | (mj.tendon_armature != 0.0) | mj.tendon_limited
    working = np.array([works(mj, actuator) for actuator in range(mj.nactuator)], dtype=np.bool_)
    adhesion = mj.actuator_trntype == int(mujoco.mjtTrn.mjTRN_BODY)
    surface = (mj.geom_adhesion != 0.0) | (mj.geom_surfacevel != 0.0).any(axis=1)
    own = dynamic[mj.pair_geom1] | dynamic[mj.pair_geom2] | ~_multiplied(mj)
    follows = (mj.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)) & (mj.eq_obj2id >= 0)
    follows &= ~mj.eq_data[:, 2:5].any(axis=1)
    units = enumerate(units_of(mj, np.flatnonzero(touching).tolist()))
    multibody = {joint: number for number, unit in units for joint in unit.joints}
    ends = (e[follows].tolist() for e in (mj.eq_obj1id, mj.eq_obj2id))
    follows[follows] = [multibody[a] == multibody[b] for a, b in zip(*ends, strict=True)]
    tables: list[tuple[str, Any, str]] = [
        ("joint", armature, "armature of the joint {!r}"),
        ("joint", ball & (mj.jnt_limited != 0), "limits of the ball joint {!r}"),
        ("joint", (ball | free) & loss, "frictionloss of the joint {!r}, no hinge or slide"),
        ("tendon", tendons, "frictionloss, armature or limits of the tendon {!r}"),
        ("actuator", working & adhesion, "the actuator {!r}, which acts by contact"),
        ("actuator", working & (mj.actuator_armature != 0.0), "armature of the actuator {!r}"),
        ("flex", np.ones(mj.nflex), "the flex {!r}"),
        (
            "geom",
            touching & odd,
            "the geom {!r}, which is not a box, ball, capsule, cylinder or mesh",
        ),
        ("geom", touching & surface, "adhesion or moving surface of the geom {!r}"),
        ("pair", own, "the pair {!r}, whose friction is not the product of those of its shapes"),
        ("body", mj.body_mocapid >= 0, "the mocap body {!r}"),
        (
            "equality",
            coupled(mj) & ~follows,
            "the equality constraint {!r}: only joints of one tree, or of trees that hang on the "
            "world, can follow one another, in proportion",
        ),
    ]
    found = [
        sentence.format(names[element][number])
        for element, which, sentence in tables
        for number in np.flatnonzero(which).tolist()
    ]
    for tree in range(mj.ntree):
        unit = unit_of(mj, tree, np.flatnonzero(touching).tolist())
        if links(mj, unit) > MOST_LINKS:
            found.append(
                f"{names['body'][unit.bodies[0]]!r} and all that hangs on it, which need "
                f"{links(mj, unit)} links: there is room for {MOST_LINKS}"
            )
    return tuple(found)


def _multiplied(mj: mujoco.MjModel) -> NDArray[np.bool_]:
    """Return which pairs have the product of the frictions of their shapes, shape (npair,)."""
    factors = mj.geom_friction[:, 0]
    products = factors[mj.pair_geom1] * factors[mj.pair_geom2]
    found: NDArray[np.bool_] = (mj.pair_friction[:, :2] == products[:, None]).all(axis=1)
    return found


def accepted(structure: Model, given: Parameters, known: Parameters) -> Parameters:
    """Check all parameters before anything is made; return them, as known where they stay."""
    problems = unsupported(structure)
    if problems:
        advice = "take it out of the model, or leave it out by drop=; or use backend='mujoco'"
        raise ModelError([f"Bullet cannot honour {what}; {advice}" for what in problems])
    rows, honoured = structure.rows, changes(structure)
    for key in rows.keys() ^ given.keys():
        raise UnknownOption("parameter", ".".join(key), map(".".join, known or given))
    found = dict[ParameterKey, Floats]()
    for key, value in given.items():
        old = known.get(key)
        if old is None or value is not old:
            new = np.array(value, dtype=np.float64)
            if old is None or old.tobytes() != new.tobytes():
                _check(rows[key], key in honoured, new)
                old = new
        found[key] = old
    return found


def _check(row: Parameter, honoured: bool, value: Floats) -> None:
    """Refuse a value that the engine cannot honour."""
    if not np.isfinite(value).all():
        raise EngineFailure(f"{row.name} must be finite, got {value.tolist()}", "bullet")
    if row.kind == "rotation" and not value.any():
        raise EngineFailure(f"{row.name} must be a quaternion, got {value.tolist()}", "bullet")
    if not honoured and not np.array_equal(np.broadcast_to(row.default, row.shape), value):
        raise NotIntervenable(
            row.name,
            f"is not a parameter on Bullet: there it keeps its default {row.default}; use "
            "backend='mujoco'",
        )


def settle(model: Model, given: State, last: State | None = None) -> Floats:
    """Return the vector of a state with unit quaternions; the rest keeps its last value."""
    layout, vector = model.layout, given.vector.copy()
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
LIVE = (*FORCES, "opt.gravity", "opt.timestep", "body_mass", "body_inertia", "pair_solref")
"""What bodies that are there take on."""
REBUILT = (
    "body_pos", "body_quat", "body_ipos", "body_iquat", "jnt_pos", "jnt_axis", "qpos0", "geom_pos",
    "geom_quat", "geom_size",
)  # fmt: skip
"""What only new bodies take on."""


def _bytes(mj: mujoco.MjModel, arrays: Mapping[str, Any]) -> NDArray[np.bool_]:
    """Return which bytes of a saved model hold some arrays or options, where a mask is true."""
    mj, before = copy.copy(mj), bytes_of(mj)
    for path, mask in arrays.items():
        of, _, name = path.rpartition(".")
        owner = getattr(mj, of) if of else mj
        value = np.array(getattr(owner, name), dtype=np.float64)
        inverted = np.where(mask, (~value.view(np.int64)).view(np.float64), value)
        if value.ndim:
            getattr(owner, name)[...] = inverted
        else:
            setattr(owner, name, float(inverted))
    found: NDArray[np.bool_] = bytes_of(mj) != before
    return found


@kept
def changes(model: Model) -> Mapping[ParameterKey, bool]:
    """Map the parameters that can be set to whether a change of them needs new bodies.

    Each is tried on a copy of the compiled model: the engine has a parameter if nothing is written
    but what it honours, or if only pictures have it.
    """
    mj = copy.copy(reading.compiled(realized(model)))
    scalar = ~np.isin(mj.jnt_type, (FREE, BALL))
    dynamic = Couplings(mj).dynamic.any(axis=1)
    live = {
        **dict.fromkeys(LIVE, True),
        "jnt_range": scalar[:, None],
        "dof_frictionloss": scalar[mj.dof_jntid],
        "geom_friction": np.stack([dynamic | True, ~dynamic, ~dynamic], axis=1),
        "pair_friction": np.arange(5) < 3,
    }
    new = dict.fromkeys(REBUILT, True)
    before, taken, built = bytes_of(mj), _bytes(mj, live), _bytes(mj, new)
    slots = realized(model).slots(mj, mujoco.MjData(mj))
    needs = dict[ParameterKey, bool]()
    for row in realized(model).parameters:
        slot = slots[row.key]
        value = np.array(np.broadcast_to(row.default, row.shape), dtype=np.float64)
        near = np.where(value == 0.0, 0.01, 1.1 * value)
        other = np.where((near >= row.low) & (near <= row.high), near, 0.9 * value)
        present, follow_up = slot.read(), slot.follow_up or (lambda mj: None)
        slot.write(1.0 - value if row.kind == "switch" else other)
        follow_up(mj)
        changed = np.flatnonzero(bytes_of(mj) != before)
        honoured = (taken[changed] | built[changed]).all() and _multiplied(mj).all()
        if len(changed) and honoured:
            needs[row.key] = bool(built[changed].any())
        slot.write(present)
        follow_up(mj)
    outside = {attribute for attribute, _, _ in fields.EXTERNAL}
    free = (row.key for row in model.parameters if row.visual or row.key[1] in outside)
    return needs | dict.fromkeys(free, False)


@kept
def rebuilt(model: Model) -> tuple[ParameterKey, ...]:
    """List the parameters that need new bodies."""
    return tuple(key for key, new in changes(model).items() if new)


def supports(model: Structure, key: ParameterKey) -> bool:
    """Return whether a parameter of a model can be set."""
    return isinstance(model, Model) and key in changes(model)
