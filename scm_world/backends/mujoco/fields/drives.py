"""Parameters of tendons, equality constraints and actuators."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import mujoco

from scm_world.backends.mujoco.fields.rows import (
    BALL,
    FREE,
    HINGE,
    OFF,
    SLIDE,
    Field,
    Scope,
    Slots,
    at,
    least,
    solver_rows,
)
from scm_world.backends.mujoco.slots import gain as gain_slot
from scm_world.backends.mujoco.slots import place

_TRN, _WRAP = mujoco.mjtTrn, mujoco.mjtWrap
_GAIN, _BIAS, _DYN = mujoco.mjtGain, mujoco.mjtBias, mujoco.mjtDyn
_TIMES = {
    int(_DYN.mjDYN_FILTER): 1,
    int(_DYN.mjDYN_FILTEREXACT): 1,
    int(_DYN.mjDYN_MUSCLE): 2,
}
"""How many time constants an actuator has."""

FORCES = {"m": "N", "rad": "N m"}
"""Unit of what moves something along a coordinate with this unit."""


def per(force: str, *units: str) -> str:
    """Divide the unit of a force; ``"1"`` where that has none.

    Example:
        >>> per("N m", "rad"), per("N", "m/s"), per("1", "m")
        ('N m/rad', 'N s/m', '1')
    """
    if force == "1" or "1" in units:
        return "1"
    (unit,) = units
    length, _, second = unit.partition("/")
    return f"{force} {second}/{length}" if second else f"{force}/{length}"


# --- tendons -----------------------------------------------------------------------------------


def tendon_unit(mj: mujoco.MjModel, tendon: int) -> str:
    """Give the unit of the length of a tendon; ``"1"`` where it sums meters and radians."""
    first, count = int(mj.tendon_adr[tendon]), int(mj.tendon_num[tendon])
    if mj.wrap_type[first] != int(_WRAP.mjWRAP_JOINT):
        return "m"
    units = {
        "m" if mj.jnt_type[joint] == SLIDE else "rad"
        for joint in mj.wrap_objid[first : first + count]
    }
    return units.pop() if len(units) == 1 else "1"


def tendons(scope: Scope) -> Iterator[Field]:
    """List the fields of all tendons."""
    for tendon in range(scope.mj.ntendon):
        yield from _tendon(scope, tendon)


def _tendon(scope: Scope, tendon: int) -> Iterator[Field]:
    mj, unit = scope.mj, tendon_unit(scope.mj, tendon)
    row = scope.rows("tendon", tendon, lambda: scope.trees.tendon(tendon))
    force = FORCES.get(unit, "1")
    stiffness, armature = bool(mj.tendon_stiffness[tendon]), bool(mj.tendon_armature[tendon])
    active = stiffness or bool(mj.tendon_damping[tendon] or mj.tendon_frictionloss[tendon])
    first = int(mj.tendon_adr[tendon])
    path = mj.wrap_type[first : first + int(mj.tendon_num[tendon])]
    around = any(kind in (int(_WRAP.mjWRAP_SPHERE), int(_WRAP.mjWRAP_CYLINDER)) for kind in path)
    unsprung = scope.off(OFF.mjDSBL_SPRING, "springs")
    inertia = {"m": "kg", "rad": "kg m^2"}.get(unit, "1")
    for attribute, of, usual, refusal, doc in (
        ("stiffness", per(force, unit), active, unsprung, "Stiffness of the tendon as a spring."),
        ("damping", per(force, f"{unit}/s"), active, scope.off(OFF.mjDSBL_DAMPER, "damping"),
         "Force against changes of length, for each unit of speed."),
        ("frictionloss", force, active, scope.off(OFF.mjDSBL_FRICTIONLOSS, "friction loss"),
         "Dry friction along the tendon."),
        ("armature", inertia, armature,
         "is not possible: the tendon runs around shapes" if around else "",
         "Inertia that the tendon adds."),
    ):  # fmt: skip
        yield row(
            attribute, of, doc, at(f"tendon_{attribute}", tendon, constant=True), low=0.0,
            usual=usual, refusal=refusal,
        )  # fmt: skip
    yield row(
        "springlength", unit, "Lengths between which the spring is at rest.",
        at("tendon_lengthspring", tendon, constant=True), usual=stiffness, refusal=unsprung,
    )  # fmt: skip
    unlimited = "" if mj.tendon_limited[tendon] else "is not in force: it has no limits"
    yield row(
        "range", unit, "Shortest and longest length of the tendon.",
        at("tendon_range", tendon), usual=False, refusal=unlimited,
    )  # fmt: skip


def equalities(scope: Scope) -> Iterator[Field]:
    """List the fields of all equality constraints."""
    mj = scope.mj
    curves = int(mujoco.mjtEq.mjEQ_JOINT), int(mujoco.mjtEq.mjEQ_TENDON)
    for equality in range(mj.neq):
        row = scope.rows("equality", equality, partial(scope.trees.equality, equality))
        off = scope.off(OFF.mjDSBL_EQUALITY, "equality constraints")
        yield row(
            "active", "1", "Whether the constraint is in force: 1, or 0.",
            _active(equality), low=0.0, high=1.0, nature="switch",
            refusal=off or scope.off(OFF.mjDSBL_CONSTRAINT, "constraints"),
        )  # fmt: skip
        yield from solver_rows(row, mj, "eq", equality, usual=False)
        if mj.eq_type[equality] in curves:
            yield row(
                "polycoef", "1", "Coefficients of the polynomial that gives one from the other.",
                at("eq_data", equality, slice(5), constant=True), usual=False,
            )  # fmt: skip


def _active(equality: int) -> Slots:
    """Find the switch of a constraint: in the state, and in the model that a reset copies."""
    where = (equality, ...)
    return lambda mj, data: place(mj.eq_active0[where], data.eq_active[where])


# --- actuators ---------------------------------------------------------------------------------


def length_unit(mj: mujoco.MjModel, actuator: int) -> str:
    """Give the unit of the length of an actuator; ``"1"`` where a gear or several axes mix it."""
    target = int(mj.actuator_trnid[actuator, 0])
    if mj.actuator_gear[int(mj.actuator_outadr[actuator]), 0] != 1.0:
        return "1"
    match mujoco.mjtTrn(int(mj.actuator_trntype[actuator])):
        case _TRN.mjTRN_JOINT:
            return {HINGE: "rad", SLIDE: "m"}.get(int(mj.jnt_type[target]), "1")
        case _TRN.mjTRN_TENDON:
            return tendon_unit(mj, target)
        case _:
            return "1"


def servo(mj: mujoco.MjModel, actuator: int) -> str:
    """Say what an actuator is: ``"position"`` or ``"velocity"`` servo, ``"damper"``, or ``""``."""
    gain, bias = mj.actuator_gainprm[actuator], mj.actuator_biasprm[actuator]
    affine = mj.actuator_biastype[actuator] == int(_BIAS.mjBIAS_AFFINE)
    if mj.actuator_gaintype[actuator] == int(_GAIN.mjGAIN_AFFINE):
        return "damper" if not gain[:2].any() and gain[2] <= 0.0 and not affine else ""
    fixed = mj.actuator_gaintype[actuator] == int(_GAIN.mjGAIN_FIXED)
    if not (fixed and affine) or bias[0] != 0.0 or gain[0] <= 0.0 or bias[2] > 0.0:
        return ""
    if bias[1] == -gain[0]:
        return "position"
    return "velocity" if bias[1] == 0.0 and bias[2] == -gain[0] else ""


def actuators(scope: Scope) -> Iterator[Field]:
    """List the fields of all actuators."""
    for actuator in range(scope.mj.nactuator):
        yield from _actuator(scope, actuator)


def _actuator(scope: Scope, actuator: int) -> Iterator[Field]:
    mj, trees = scope.mj, scope.trees
    row = scope.rows("actuator", actuator, lambda: trees.actuator(actuator))
    off = "" if any(trees.actuator(actuator)) else "acts on nothing: it is off or moves nothing"
    first, unit = int(mj.actuator_outadr[actuator]), length_unit(mj, actuator)
    force = FORCES.get(unit, "1")
    used = _gear_length(mj, actuator)
    if used:
        index = (first, 0) if used == 1 else (first, slice(used))
        yield row(
            "gear", "1", "Factor from the force of the actuator to that on what it moves.",
            at("actuator_gear", *index, constant=True), refusal=off,
        )  # fmt: skip
    yield from _law(mj, actuator, row, off)
    control = int(mj.actuator_ctrladr[actuator])
    if mj.actuator_ctrlnum[actuator] == 1:
        free = "" if mj.actuator_ctrllimited[control] else "is not in force: it is not limited"
        yield row(
            "ctrlrange", control_unit(mj, actuator), "Range to which its control is clipped.",
            at("actuator_ctrlrange", control), usual=False, refusal=off or free,
        )  # fmt: skip
    free = "" if mj.actuator_forcelimited[actuator] else "is not in force: it is not limited"
    yield row(
        "forcerange", force, "Range to which its force is clipped.",
        at("actuator_forcerange", actuator), usual=False, refusal=off or free,
    )  # fmt: skip
    for attribute in ("damping", "armature"):
        yield row(
            attribute, "1", f"The {attribute} that the actuator adds to what it moves.",
            at(f"actuator_{attribute}", actuator, constant=True), low=0.0,
            usual=bool(getattr(mj, f"actuator_{attribute}")[actuator]), refusal=off,
        )  # fmt: skip


def _gear_length(mj: mujoco.MjModel, actuator: int) -> int:
    """Say how many components of the gear are in use."""
    match mujoco.mjtTrn(int(mj.actuator_trntype[actuator])):
        case _TRN.mjTRN_JOINT | _TRN.mjTRN_JOINTINPARENT:
            kind = int(mj.jnt_type[mj.actuator_trnid[actuator, 0]])
            return {FREE: 6, BALL: 3}.get(kind, 1)
        case _TRN.mjTRN_SITE:
            return 6
        case _TRN.mjTRN_TENDON | _TRN.mjTRN_SLIDERCRANK:
            return 1
        case _:
            return 0


def control_unit(mj: mujoco.MjModel, actuator: int) -> str:
    """Give the unit of the control of an actuator; ``"1"`` where gears and gains scale it."""
    unit = length_unit(mj, actuator)
    match servo(mj, actuator):
        case "position":
            return unit if mj.actuator_dyntype[actuator] != int(_DYN.mjDYN_INTEGRATOR) else "1"
        case "velocity":
            return f"{unit}/s" if unit != "1" else "1"
        case _:
            plain = mj.actuator_gaintype[actuator] == int(_GAIN.mjGAIN_FIXED)
            plain = plain and mj.actuator_gainprm[actuator, 0] == 1.0
            return FORCES.get(unit, "1") if plain and not mj.actuator_dyntype[actuator] else "1"


def _law(mj: mujoco.MjModel, actuator: int, row: Callable[..., Field], off: str) -> Iterator[Field]:
    """Give what makes a control a force: the gains of a servo, or what else the type has."""
    unit = length_unit(mj, actuator)
    force = FORCES.get(unit, "1")
    stiffness, damping = per(force, unit), per(force, f"{unit}/s")
    gain, bias = ("actuator_gainprm", actuator), ("actuator_biasprm", actuator)
    about = "Force of the servo for each unit of "
    match servo(mj, actuator):
        case "position":
            slot = _gain((*gain, 0), (*bias, 1))
            yield row("kp", stiffness, about + "distance.", slot, low=0.0, refusal=off)
            slot = _gain((), (*bias, 2))
            yield row("kv", damping, about + "velocity.", slot, low=0.0, refusal=off)
        case "velocity":
            slot = _gain((*gain, 0), (*bias, 2))
            yield row("kv", damping, about + "velocity.", slot, low=0.0, refusal=off)
        case "damper":
            slot = _gain((), (*gain, 2))
            yield row("kv", "1", about + "velocity and control.", slot, low=0.0, refusal=off)
        case _:  # gain and bias as MuJoCo has them
            fixed = mj.actuator_gaintype[actuator] == int(_GAIN.mjGAIN_FIXED)
            kind = int(mj.actuator_biastype[actuator])
            biased = bool(mj.actuator_biasprm[actuator, :3].any())
            for present, name, usual, doc, at_ in (
                (fixed, "gain", False, "Force for each unit of control.", at(*gain, 0)),
                (not fixed, "gainprm", False, "Parameters of its gain, as MuJoCo numbers them.",
                 at(*gain)),
                (kind == int(_BIAS.mjBIAS_AFFINE), "bias", biased,
                 "Force without control: constant, for each unit of length, of velocity.",
                 at(*bias, slice(3))),
                (kind not in (int(_BIAS.mjBIAS_AFFINE), int(_BIAS.mjBIAS_NONE)), "biasprm", False,
                 "Parameters of its bias, as MuJoCo numbers them.", at(*bias)),
            ):  # fmt: skip
                if present:
                    yield row(name, "1", doc, at_, usual=usual, refusal=off)
    times = _TIMES.get(int(mj.actuator_dyntype[actuator]), 0)
    if times:
        used = 0 if times == 1 else slice(times)
        yield row(
            "timeconst", "s", "Time that the activation takes to follow the control.",
            at("actuator_dynprm", actuator, used), refusal=off,
            low=least(mj.actuator_dynprm[actuator, :times]),
        )  # fmt: skip


def _gain(plus: tuple[Any, ...], minus: tuple[Any, ...] = ()) -> Slots:
    """Find a gain in two arrays of the model: each is an array, an actuator, and a column."""

    def places(mj: mujoco.MjModel, where: tuple[Any, ...]) -> list[Any]:
        return [getattr(mj, where[0])[where[1], where[2], ...]] if where else []

    return lambda mj, _: gain_slot(places(mj, plus), places(mj, minus))
