"""What of a model the engine can honour, and what it cannot."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Any, Literal

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
    plan_of,
    takes_armature,
)
from scm_world.backends.mujoco import fields, reading
from scm_world.backends.mujoco.trees import Couplings, works
from scm_world.errors import EngineFailure, ModelError, NotIntervenable
from scm_world.models.model import Model, Parameter
from scm_world.models.scene import ParameterKey, State

UNIT = 1e-12  # a quaternion whose squared norm is this near to 1 is taken as it is


@lru_cache(maxsize=64)
def realized(model: Model) -> Model:
    """Return the model that stands for another one in this engine; usually itself."""
    return model if model.instead is None else model.instead()


@lru_cache(maxsize=64)
def unsupported(model: Model) -> tuple[str, ...]:
    """List everything in a model that the engine cannot honour."""
    mj = reading.compiled(realized(model))
    names, trees = fields.element_names(mj), Couplings(mj)
    parts = _of_joints(mj, names), _of_contacts(mj, names, trees), _of_bodies(mj, names, trees)
    return tuple(sentence for part in parts for sentence in part)


def _of_joints(mj: mujoco.MjModel, names: Mapping[str, tuple[str, ...]]) -> Iterator[str]:
    """List what joints, and what joins them, ask for in vain."""
    for joint, kind in enumerate(mj.jnt_type.tolist()):
        name, dof = names["joint"][joint], int(mj.jnt_dofadr[joint])
        if mj.dof_armature[dof] and not takes_armature(mj, int(mj.jnt_bodyid[joint])):
            yield (
                f"armature of the joint {name!r}, which is not a hinge that alone carries a body "
                "on the world"
            )
        if kind == BALL and mj.jnt_limited[joint]:
            yield f"limits of the ball joint {name!r}"
        if kind in (FREE, BALL) and mj.dof_frictionloss[dof]:
            yield f"frictionloss of the {('free', 'ball')[kind]} joint {name!r}"
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
    for tendon, name in enumerate(names["tendon"]):
        if any(
            getattr(mj, f"tendon_{what}")[tendon]
            for what in ("frictionloss", "armature", "limited")
        ):
            yield f"frictionloss, armature or limits of the tendon {name!r}"
    for actuator, name in enumerate(names["actuator"]):
        adhesion = mj.actuator_trntype[actuator] == int(mujoco.mjtTrn.mjTRN_BODY)
        if works(mj, actuator) and (adhesion or mj.actuator_armature[actuator]):
            what = "acts by contact" if adhesion else "adds armature of its own"
            yield f"the actuator {name!r}, which {what}"


def _of_contacts(
    mj: mujoco.MjModel, names: Mapping[str, tuple[str, ...]], trees: Couplings
) -> Iterator[str]:
    """List what shapes ask for in vain."""
    yield from (f"the flex {name!r}" for name in names["flex"])
    for geom in np.flatnonzero(trees.touches.any(axis=1)).tolist():
        name, kind = names["geom"][geom], int(mj.geom_type[geom])
        if kind not in SHAPES:
            yield f"the {mujoco.mjtGeom(kind).name.removeprefix('mjGEOM_').lower()} {name!r}"
        if mj.geom_adhesion[geom] or np.any(mj.geom_surfacevel[geom]):
            yield f"adhesion or moving surface of the geom {name!r}"
    dynamic: NDArray[np.bool_] = np.asarray(trees.dynamic.any(axis=1))
    for name, one, other, alike in zip(
        names["pair"], mj.pair_geom1, mj.pair_geom2, _multiplied(mj), strict=True
    ):
        if dynamic[one] or dynamic[other] or not alike:
            yield f"the pair {name!r}, whose friction is not the product of those of its shapes"


def _multiplied(mj: mujoco.MjModel) -> NDArray[np.bool_]:
    """Tell which pairs have the product of the frictions of their shapes, shape (npair,)."""
    factors = mj.geom_friction[:, 0]
    products = factors[mj.pair_geom1] * factors[mj.pair_geom2]
    same: Any = mj.pair_friction[:, :2] == products[:, None]
    found: NDArray[np.bool_] = same.all(axis=1)
    return found


def _of_bodies(
    mj: mujoco.MjModel, names: Mapping[str, tuple[str, ...]], trees: Couplings
) -> Iterator[str]:
    """List what bodies ask for in vain."""
    yield from (
        f"the mocap body {names['body'][body]!r}" for body in np.flatnonzero(mj.body_mocapid >= 0)
    )
    touching = np.flatnonzero(trees.touches.any(axis=1)).tolist()
    for tree in range(mj.ntree):
        plan = plan_of(mj, tree, touching)
        count = links(mj, plan)
        if count > MOST_LINKS:
            yield (
                f"the {count} links that {names['body'][plan.bodies[0]]!r} and all that hangs on "
                f"it need: there is room for {MOST_LINKS}"
            )


def check(model: Model, parameters: Mapping[ParameterKey, Any]) -> None:
    """Say what the engine cannot honour, before anything is made.

    Raises:
        ModelError: All of it that is in the model.
        NotIntervenable: A parameter that the engine lacks is not as in the model.
        EngineFailure: A rotation has no direction.
    """
    problems = unsupported(model)
    if problems:
        advice = "take it out of the model, or use backend='mujoco'"
        raise ModelError([f"Bullet cannot honour {what}; {advice}" for what in problems])
    known = changes(model)
    for row in model.parameters:
        if row.kind == "rotation" and not any(parameters[row.key]):
            found = parameters[row.key]
            raise EngineFailure(f"{row.name} must be a quaternion, got {found}", "bullet")
        if row.visual or row.key in known:
            continue
        default, value = np.array(row.default), parameters[row.key]
        if not np.array_equal(np.broadcast_to(default, row.shape), value):
            raise NotIntervenable(
                row.name,
                f"is no parameter on Bullet: there it keeps its default {row.default}; use "
                "backend='mujoco'",
            )


def rotations(model: Model) -> list[int]:
    """List where in the state the quaternions begin."""
    slices = model.layout.slices
    return [slices[row.name].start for row in model.states if row.kind == "rotation"]


def settle(model: Model, given: State) -> list[float]:
    """Turn a state into plain numbers: unit quaternions, and 0 for what cannot be set.

    Raises:
        ValueError: It is a state of another structure.
        EngineFailure: A number is not finite.
    """
    numbers: list[float] = given.vector.tolist()
    if len(numbers) != model.layout.size:
        raise ValueError(f"expected a state of {model.layout.size} numbers, got {given!r}")
    if not math.isfinite(sum(numbers)):
        raise EngineFailure(f"a state must be finite, got {given!r}", "bullet")
    for name in model.layout.reported:
        where = model.layout.slices[name]
        numbers[where] = [0.0] * (where.stop - where.start)
    slices = model.layout.slices
    for row in model.states:
        if row.kind == "rotation":
            where = slices[row.name]
            turn = numbers[where]
            square = sum(part * part for part in turn)
            scale = math.sqrt(square) if abs(square - 1.0) >= UNIT and square else 1.0
            scale = -scale if row.frame == "world" and turn[3] < 0.0 else scale
            numbers[where] = [part / scale for part in turn]
    return numbers


# --- parameters -----------------------------------------------------------------------------------

Kind = Literal["live", "rebuilt"]
"""What a change takes: live bodies take it on, or only new ones do."""

FORCES = (
    "actuator_gainprm", "actuator_biasprm", "actuator_gear", "actuator_ctrlrange",
    "actuator_forcerange", "actuator_damping", "actuator_dynprm", "jnt_actfrcrange",
    "dof_damping", "jnt_stiffness", "qpos_spring", "tendon_stiffness", "tendon_damping",
    "tendon_lengthspring", "site_pos", "site_quat", "body_gravcomp", "opt.wind", "opt.density",
    "opt.viscosity",
)  # fmt: skip
"""What acts by smooth forces alone: they come from MuJoCo."""


def _honoured(mj: mujoco.MjModel) -> Iterator[tuple[str, Kind, Any]]:
    """List arrays, what a change of them takes, and which of their rows or numbers count."""
    hinged = np.array([takes_armature(mj, body) for body in range(mj.nbody)])
    scalar = ~np.isin(mj.jnt_type, (FREE, BALL))
    dynamic = Couplings(mj).dynamic.any(axis=1)
    frictions = np.stack([dynamic | True, ~dynamic, ~dynamic], axis=1)
    dofs = scalar[mj.dof_jntid]
    yield from ((name, "live", True) for name in FORCES)
    yield from ((name, "live", True) for name in ("opt.gravity", "opt.timestep"))
    yield from (("body_mass", "live", True), ("body_inertia", "live", ~hinged[:, None]))
    yield from (("jnt_range", "live", scalar[:, None]), ("dof_frictionloss", "live", dofs))
    yield from (("geom_friction", "live", frictions), ("pair_solref", "live", True))
    yield "pair_friction", "live", np.arange(5) < 3
    yield from (("body_inertia", "rebuilt", hinged[:, None]), ("body_pos", "rebuilt", True))
    yield from (("body_quat", "rebuilt", True), ("body_ipos", "rebuilt", True))
    yield from ((name, "rebuilt", True) for name in ("jnt_pos", "jnt_axis", "qpos0"))
    yield "dof_armature", "rebuilt", hinged[mj.dof_bodyid]
    yield from ((name, "rebuilt", True) for name in ("geom_pos", "geom_quat", "geom_size"))


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
    """Give another value of a parameter."""
    value = np.array(np.broadcast_to(row.default, row.shape), dtype=np.float64)
    if row.kind == "switch":
        return 1.0 - value
    near = np.where(value == 0.0, 0.01, 1.1 * value)
    return np.where((near >= row.low) & (near <= row.high), near, 0.9 * value)


@lru_cache(maxsize=64)
def changes(model: Model) -> Mapping[ParameterKey, Kind]:
    """Map the parameters that the engine has to what a change of them takes.

    Each is tried on a copy of the compiled model: the engine has a parameter if nothing is written
    but what it honours.
    """
    model = realized(model)
    mj = copy.copy(reading.compiled(model))
    slots = model.slots(mj, mujoco.MjData(mj))
    untouched, found = _saved(mj), dict[ParameterKey, Kind]()
    rows = [(name, kind, which, _read(mj, name)) for name, kind, which in _honoured(mj)]
    for row in model.parameters:
        slot = slots[row.key]
        before = slot.read()
        slot.write(_other(row))
        if slot.follow_up:
            slot.follow_up(mj)
        takes, multiplied = set[Kind](), _multiplied(mj).all()
        for name, kind, which, was in rows:
            now = _read(mj, name)
            changed = (now != was) & which
            if changed.any():
                takes.add(kind)
                _write(mj, name, np.where(changed, was, now))
        if takes and multiplied and np.array_equal(_saved(mj), untouched):
            found[row.key] = "rebuilt" if "rebuilt" in takes else "live"
        for name, _, _, was in rows:
            _write(mj, name, was)
        slot.write(before)
    return found


def keys(model: Model) -> list[ParameterKey]:
    """List every parameter of a model, also those that the engine lacks."""
    return [row.key for row in model.parameters]


def heavy(model: Model) -> list[ParameterKey]:
    """List the parameters that need new bodies."""
    return [key for key, takes in changes(model).items() if takes == "rebuilt"]


def supports(model: Model, key: ParameterKey) -> bool:
    """Tell whether a parameter of a model can be set: the engine has it, or only pictures do."""
    return key in changes(model) or any(row.key == key and row.visual for row in model.parameters)
