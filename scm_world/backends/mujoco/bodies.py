"""A compiled model in plain words, for engines that cannot read its file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Any

import mujoco
import numpy as np

from scm_world.backends.mujoco.fields import Field, element_names, table
from scm_world.backends.mujoco.trees import Couplings, disabled
from scm_world.models.bodies import (
    Actuator,
    Bodies,
    Body,
    Coupling,
    Geom,
    Joint,
    Part,
    Place,
    Rotation,
    Vector,
)
from scm_world.models.scene import ParameterKey

_OFF, _JNT, _GEOM, _TRN, _GAIN, _BIAS, _DYN, _INT = (
    mujoco.mjtDisableBit,
    mujoco.mjtJoint,
    mujoco.mjtGeom,
    mujoco.mjtTrn,
    mujoco.mjtGain,
    mujoco.mjtBias,
    mujoco.mjtDyn,
    mujoco.mjtIntegrator,
)
_JOINTS: dict[int, Any] = {
    int(_JNT.mjJNT_FREE): "free",
    int(_JNT.mjJNT_BALL): "ball",
    int(_JNT.mjJNT_SLIDE): "slide",
    int(_JNT.mjJNT_HINGE): "hinge",
}
_NUMBERS = {"hinge": 2, "slide": 2, "ball": 7, "free": 13}
"""How many numbers of the state a joint has."""

_SHAPES: dict[int, tuple[Any, int]] = {
    int(_GEOM.mjGEOM_PLANE): ("plane", 0),
    int(_GEOM.mjGEOM_SPHERE): ("sphere", 1),
    int(_GEOM.mjGEOM_CAPSULE): ("capsule", 2),
    int(_GEOM.mjGEOM_CYLINDER): ("cylinder", 2),
    int(_GEOM.mjGEOM_BOX): ("box", 3),
    int(_GEOM.mjGEOM_MESH): ("mesh", 0),
}
"""The shapes that have a word, and how many numbers say their size."""

_FIELDS = {
    ("body", "mass"): "mass",
    ("body", "inertia"): "inertia",
    ("body", "center_of_mass"): "center",
    ("body", "position"): "position",
    ("body", "orientation"): "orientation",
    ("joint", "damping"): "damping",
    ("joint", "armature"): "armature",
    ("joint", "frictionloss"): "friction",
    ("joint", "stiffness"): "stiffness",
    ("joint", "springref"): "rest",
    ("joint", "ref"): "reference",
    ("joint", "range"): "range",
    ("joint", "actuatorfrcrange"): "effort",
    ("joint", "axis"): "axis",
    ("joint", "anchor"): "position",
    ("geom", "friction"): "friction",
    ("geom", "size"): "size",
    ("geom", "position"): "position",
    ("geom", "orientation"): "orientation",
    ("actuator", "gear"): "gear",
    ("actuator", "gain"): "gain",
    ("actuator", "bias"): "bias",
    ("actuator", "ctrlrange"): "control_range",
    ("actuator", "forcerange"): "force_range",
    ("option", "gravity"): "gravity",
    ("option", "timestep"): "timestep",
}
"""The parameters that have a place here, and the field that holds them."""

_TABLES = {
    "body": "bodies",
    "joint": "joints",
    "geom": "geoms",
    "actuator": "actuators",
    "option": "",
}


@lru_cache(maxsize=32)
def describe(mj: mujoco.MjModel) -> Bodies:
    """Describe the bodies of a compiled model, which must not be changed afterwards."""
    names = element_names(mj)
    couplings = Couplings(mj)
    joints, start = [], 0
    for number in range(mj.njnt):
        joint = _joint(mj, number, names["joint"][number], start)
        joints.append(joint)
        start += _NUMBERS[joint.kind]
    shapes = _touching(mj, couplings)
    number_of = {shape: number for number, shape in enumerate(shapes)}
    actuators = {
        number: _actuator(mj, number, names["actuator"][number])
        for number in range(mj.nactuator)
        if not _odd_actuator(mj, number) and _works(mj, number)
    }
    rows = {
        "geom": number_of,
        "actuator": {number: row for row, number in enumerate(actuators)},
    }
    gravity = (0.0, 0.0, 0.0) if disabled(mj, _OFF.mjDSBL_GRAVITY) else _vector(mj.opt.gravity)
    return Bodies(
        bodies=tuple(_body(mj, number, names["body"][number]) for number in range(mj.nbody)),
        joints=tuple(joints),
        geoms=tuple(_geom(mj, shape, names["geom"][shape]) for shape in shapes),
        actuators=tuple(actuators.values()),
        couplings=tuple(
            _coupling(mj, equality, names["equality"][equality])
            for equality in range(mj.neq)
            if _acts(mj, equality) and _is_linear(mj, equality)
        ),
        touching=tuple(
            (number_of[int(first)], number_of[int(second)])
            for first, second in np.argwhere(np.triu(couplings.touches))
            if int(first) in number_of and int(second) in number_of
        ),
        gravity=gravity,
        timestep=float(mj.opt.timestep),
        places=dict(_places(mj, names, rows)),
        missing=tuple(_missing(mj, names)),
        notes=tuple(_notes(mj)),
    )


# --- rows --------------------------------------------------------------------------------------


def _body(mj: mujoco.MjModel, body: int, name: str) -> Body:
    return Body(
        name,
        int(mj.body_parentid[body]),
        _vector(mj.body_pos[body]),
        _rotation(mj.body_quat[body]),
        float(mj.body_mass[body]),
        _vector(mj.body_inertia[body]),
        _vector(mj.body_ipos[body]),
        _rotation(mj.body_iquat[body]),
    )


def _joint(mj: mujoco.MjModel, joint: int, name: str, start: int) -> Joint:
    kind = _JOINTS[int(mj.jnt_type[joint])]
    place, dof = int(mj.jnt_qposadr[joint]), int(mj.jnt_dofadr[joint])
    scalar = kind in ("hinge", "slide")
    limited = mj.jnt_limited[joint] and not (
        disabled(mj, _OFF.mjDSBL_LIMIT) or disabled(mj, _OFF.mjDSBL_CONSTRAINT)
    )
    dry = not (disabled(mj, _OFF.mjDSBL_FRICTIONLOSS) or disabled(mj, _OFF.mjDSBL_CONSTRAINT))
    return Joint(
        name,
        kind,
        int(mj.jnt_bodyid[joint]),
        start,
        _vector(mj.jnt_pos[joint]),
        _vector(mj.jnt_axis[joint]),
        float(mj.qpos0[place]) if scalar else 0.0,
        _pair(mj.jnt_range[joint]) if limited else None,
        0.0 if disabled(mj, _OFF.mjDSBL_DAMPER) else float(mj.dof_damping[dof]),
        0.0 if disabled(mj, _OFF.mjDSBL_SPRING) else float(mj.jnt_stiffness[joint]),
        float(mj.qpos_spring[place]) if scalar else 0.0,
        float(mj.dof_frictionloss[dof]) if dry else 0.0,
        float(mj.dof_armature[dof]),
        _pair(mj.jnt_actfrcrange[joint]) if mj.jnt_actfrclimited[joint] else None,
    )


def _touching(mj: mujoco.MjModel, couplings: Couplings) -> list[int]:
    """List the geoms that may touch something and have a word."""
    touches = np.flatnonzero(couplings.touches.any(axis=1)).tolist()
    return [shape for shape in touches if int(mj.geom_type[shape]) in _SHAPES]


def _geom(mj: mujoco.MjModel, geom: int, name: str) -> Geom:
    kind, numbers = _SHAPES[int(mj.geom_type[geom])]
    return Geom(
        name,
        kind,
        int(mj.geom_bodyid[geom]),
        _vector(mj.geom_pos[geom]),
        _rotation(mj.geom_quat[geom]),
        tuple(mj.geom_size[geom, :numbers].tolist()),
        _hull(mj, int(mj.geom_dataid[geom])) if kind == "mesh" else (),
        float(mj.geom_friction[geom, 0]),
        bool(mj.geom_condim[geom] == 1),
        int(mj.geom_priority[geom]),
    )


def _hull(mj: mujoco.MjModel, mesh: int) -> tuple[Vector, ...]:
    """Copy the corners of the convex hull of a mesh [m]."""
    first, count = int(mj.mesh_vertadr[mesh]), int(mj.mesh_vertnum[mesh])
    vertices = mj.mesh_vert[first : first + count].astype(np.float64)
    graph = int(mj.mesh_graphadr[mesh])
    if graph >= 0:  # number of corners and faces, where their edges begin, which vertices they are
        corners = int(mj.mesh_graph[graph])
        numbers = mj.mesh_graph[graph + 2 + corners : graph + 2 + 2 * corners]
        vertices = vertices[numbers]
    return tuple(map(_vector, vertices))


def _actuator(mj: mujoco.MjModel, actuator: int, name: str) -> Actuator:
    joint, control = int(mj.actuator_trnid[actuator, 0]), _control(mj, actuator)
    gears = 3 if mj.jnt_type[joint] == int(_JNT.mjJNT_BALL) else 1
    gain, bias = mj.actuator_gainprm[actuator], mj.actuator_biasprm[actuator]
    affine = mj.actuator_gaintype[actuator] == int(_GAIN.mjGAIN_AFFINE)
    biased = mj.actuator_biastype[actuator] == int(_BIAS.mjBIAS_AFFINE)
    clipped = mj.actuator_ctrllimited[control] and not disabled(mj, _OFF.mjDSBL_CLAMPCTRL)
    return Actuator(
        name,
        joint,
        control,
        tuple(mj.actuator_gear[_output(mj, actuator), :gears].tolist()),
        _vector(gain[:3]) if affine else (float(gain[0]), 0.0, 0.0),
        _vector(bias[:3]) if biased else (0.0, 0.0, 0.0),
        _pair(mj.actuator_ctrlrange[control]) if clipped else None,
        _pair(mj.actuator_forcerange[actuator]) if mj.actuator_forcelimited[actuator] else None,
    )


def _control(mj: mujoco.MjModel, actuator: int) -> int:
    """Give the number of the control of an actuator; since MuJoCo 4 there may be several."""
    return int(mj.actuator_ctrladr[actuator]) if hasattr(mj, "actuator_ctrladr") else actuator


def _output(mj: mujoco.MjModel, actuator: int) -> int:
    """Give the row of the gear of an actuator."""
    return int(mj.actuator_outadr[actuator]) if hasattr(mj, "actuator_outadr") else actuator


def _works(mj: mujoco.MjModel, actuator: int) -> bool:
    """Tell whether an actuator is not switched off."""
    group = int(mj.actuator_group[actuator])
    off = 0 <= group < 31 and bool(mj.opt.disableactuator & (1 << group))
    return not (off or disabled(mj, _OFF.mjDSBL_ACTUATION))


def _acts(mj: mujoco.MjModel, equality: int) -> bool:
    """Tell whether an equality constraint is in force."""
    off = disabled(mj, _OFF.mjDSBL_EQUALITY) or disabled(mj, _OFF.mjDSBL_CONSTRAINT)
    return bool(mj.eq_active0[equality]) and not off


def _is_linear(mj: mujoco.MjModel, equality: int) -> bool:
    """Tell whether an equality constraint lets a joint follow another one in proportion."""
    joints = mj.eq_type[equality] == int(mujoco.mjtEq.mjEQ_JOINT) and mj.eq_obj2id[equality] >= 0
    return bool(joints and not mj.eq_data[equality, 2:5].any())


def _coupling(mj: mujoco.MjModel, equality: int, name: str) -> Coupling:
    joint, leader = int(mj.eq_obj1id[equality]), int(mj.eq_obj2id[equality])
    offset, ratio = mj.eq_data[equality, :2].tolist()
    return Coupling(name, joint, leader, offset, ratio)


# --- what there is no word for -----------------------------------------------------------------


def _odd_actuator(mj: mujoco.MjModel, actuator: int) -> str:
    """Say what is special about an actuator, if anything is."""
    if mj.actuator_trntype[actuator] not in (int(_TRN.mjTRN_JOINT), int(_TRN.mjTRN_JOINTINPARENT)):
        kind = mujoco.mjtTrn(int(mj.actuator_trntype[actuator])).name
        return f"acts on a {kind.removeprefix('mjTRN_').lower()}, not on a joint"
    kind = int(mj.jnt_type[mj.actuator_trnid[actuator, 0]])
    biased = mj.actuator_biastype[actuator] != int(_BIAS.mjBIAS_NONE)
    if kind == int(_JNT.mjJNT_FREE):
        return "acts on a free joint"
    if mj.actuator_dyntype[actuator] != int(_DYN.mjDYN_NONE):
        return "has an activation"
    gain = mj.actuator_gaintype[actuator]
    if gain not in (int(_GAIN.mjGAIN_FIXED), int(_GAIN.mjGAIN_AFFINE)) or (
        mj.actuator_biastype[actuator] not in (int(_BIAS.mjBIAS_NONE), int(_BIAS.mjBIAS_AFFINE))
    ):
        return "is a muscle, or another model of a motor"
    if kind == int(_JNT.mjJNT_BALL) and (biased or gain != int(_GAIN.mjGAIN_FIXED)):
        return "is a servo of a ball joint"
    if kind == int(_JNT.mjJNT_BALL) and (
        mj.actuator_trntype[actuator] == int(_TRN.mjTRN_JOINTINPARENT)
    ):
        return "acts on a ball joint in the frame of its parent"
    for what in ("damping", "armature"):
        if _has(mj, f"actuator_{what}", actuator):
            return f"adds {what} of its own"
    return ""


def _missing(mj: mujoco.MjModel, names: Mapping[str, tuple[str, ...]]) -> Iterator[str]:
    """List what acts in a model and has no words."""
    yield from (f"the flex {names['flex'][i]!r}" for i in range(mj.nflex))
    yield from (f"the pair {names['pair'][i]!r}" for i in range(mj.npair))
    for i in range(mj.ntendon):
        forces = ("stiffness", "damping", "frictionloss", "armature", "limited")
        if any(np.any(getattr(mj, f"tendon_{what}")[i]) for what in forces):
            yield f"the tendon {names['tendon'][i]!r}"
    for i in range(mj.neq):
        if _acts(mj, i) and not _is_linear(mj, i):
            kind = mujoco.mjtEq(int(mj.eq_type[i])).name.removeprefix("mjEQ_").lower()
            yield f"the equality constraint {names['equality'][i]!r} ({kind})"
    if mj.opt.density > 0.0 or mj.opt.viscosity > 0.0:
        yield f"a fluid (density {mj.opt.density:g}, viscosity {mj.opt.viscosity:g})"
    for i in range(mj.nactuator):
        if _works(mj, i) and _odd_actuator(mj, i):
            yield f"the actuator {names['actuator'][i]!r}, which {_odd_actuator(mj, i)}"
    yield from _missing_of_bodies(mj, names)


def _missing_of_bodies(mj: mujoco.MjModel, names: Mapping[str, tuple[str, ...]]) -> Iterator[str]:
    """List what bodies, joints and shapes do that has no words."""
    for i in range(mj.nbody):
        if mj.body_gravcomp[i] != 0.0:
            yield f"gravity compensation of the body {names['body'][i]!r}"
        if mj.body_mocapid[i] >= 0:
            yield f"the mocap body {names['body'][i]!r}"
    for i in range(mj.njnt):
        name, dof = names["joint"][i], int(mj.jnt_dofadr[i])
        if _has(mj, "jnt_stiffnesspoly", i) or _has(mj, "dof_dampingpoly", dof):
            yield f"the nonlinear stiffness or damping of the joint {name!r}"
        if mj.jnt_actgravcomp[i]:
            yield f"gravity compensation by the actuators of the joint {name!r}"
    touches = np.flatnonzero(Couplings(mj).touches.any(axis=1)).tolist()
    for i in range(mj.ngeom):
        name, kind = names["geom"][i], int(mj.geom_type[i])
        if i in touches and kind not in _SHAPES:
            yield f"the {mujoco.mjtGeom(kind).name.removeprefix('mjGEOM_').lower()} {name!r}"
        if _has(mj, "geom_adhesion", i) or _has(mj, "geom_surfacevel", i):
            yield f"adhesion or moving surface of the geom {name!r}"


def _has(mj: mujoco.MjModel, array: str, row: int) -> bool:
    """Tell whether a row of an array, which old versions of MuJoCo do not have, is not zero."""
    numbers = getattr(mj, array, None)
    return numbers is not None and bool(np.any(numbers[row]))


def _notes(mj: mujoco.MjModel) -> Iterator[str]:
    """List what is left out because it matters little."""
    if mj.opt.integrator == int(_INT.mjINT_RK4):
        yield "The Runge-Kutta integrator of the file is left out."
    if mj.ngeom and (mj.geom_condim > 3).any():
        yield "Friction against turning and rolling (condim 4 and 6) is left out."
    if mj.ngeom and (mj.geom_margin > 0.0).any():
        yield "Margins of shapes are left out: they touch where they are."


# --- places of parameters ----------------------------------------------------------------------


def _places(
    mj: mujoco.MjModel, names: Mapping[str, tuple[str, ...]], rows: dict[str, dict[int, int]]
) -> Iterator[tuple[ParameterKey, Place]]:
    """Find the place of every parameter, exposed or not, that has a meaning here."""
    for field in table(mj):
        if field.slot is None or field.kind not in _TABLES:
            continue
        number = names[field.kind].index(field.element) if field.element else 0
        row = rows[field.kind].get(number) if field.kind in rows else number
        parts = _parts(mj, field, number)
        if row is not None and parts:
            yield field.key, Place(_TABLES[field.kind], row, parts)


def _parts(mj: mujoco.MjModel, field: Field, number: int) -> tuple[Part, ...]:
    """Say which numbers of a row a parameter is; none if it has no meaning here."""
    if field.kind == "actuator" and field.attribute in ("kp", "kv"):
        return tuple(_servo(mj, number, field.attribute))
    name = _FIELDS.get((field.kind, field.attribute))
    if name is None:
        return ()
    if field.attribute == "size" and mj.geom_type[number] == int(_GEOM.mjGEOM_SPHERE):
        return (Part(name, 0),)
    if field.attribute == "gain":
        return (Part(name, 0),)
    if field.attribute == "gear" and mj.jnt_type[mj.actuator_trnid[number, 0]] != int(
        _JNT.mjJNT_BALL
    ):
        return (Part(name, 0),)
    return (Part(name),)


def _servo(mj: mujoco.MjModel, actuator: int, attribute: str) -> Iterator[Part]:
    """Say where the gains of a servo stand."""
    bias = mj.actuator_biasprm[actuator]
    if mj.actuator_gaintype[actuator] == int(_GAIN.mjGAIN_AFFINE):
        yield Part("gain", 2, -1.0)
    elif attribute == "kp":
        yield from (Part("gain", 0), Part("bias", 1, -1.0))
    elif bias[1] != 0.0:
        yield Part("bias", 2, -1.0)
    else:
        yield from (Part("gain", 0), Part("bias", 2, -1.0))


# --- conversions -------------------------------------------------------------------------------


def _vector(numbers: Any) -> Vector:
    x, y, z = (float(number) for number in numbers)
    return x, y, z


def _pair(numbers: Any) -> tuple[float, float]:
    low, high = (float(number) for number in numbers)
    return low, high


def _rotation(numbers: Any) -> Rotation:
    """Turn a quaternion of MuJoCo (w, x, y, z) into (x, y, z, w)."""
    w, x, y, z = (float(number) for number in numbers)
    return x, y, z, w
