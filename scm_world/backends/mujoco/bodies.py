"""A compiled model in plain words, for engines that cannot read its file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any

import mujoco
import numpy as np

from scm_world.backends.mujoco.fields import Field, element_names, table
from scm_world.backends.mujoco.trees import Couplings, disabled, works
from scm_world.models.bodies import (
    Actuator,
    Body,
    Coupling,
    Geom,
    Joint,
    ModelBodies,
    Place,
    Rotation,
    RowPart,
    Vector,
)
from scm_world.models.scene import ParameterKey

_OFF, _JNT, _GEOM, _TRN, _GAIN, _BIAS, _DYN = (
    mujoco.mjtDisableBit,
    mujoco.mjtJoint,
    mujoco.mjtGeom,
    mujoco.mjtTrn,
    mujoco.mjtGain,
    mujoco.mjtBias,
    mujoco.mjtDyn,
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
def describe(mj: mujoco.MjModel) -> ModelBodies:
    """Describe the bodies of a compiled model, which must not be changed afterwards."""
    names, couplings = element_names(mj), Couplings(mj)
    joints, start = [], 0
    for number, name in enumerate(names["joint"]):
        joints.append(_joint(mj, number, name, start))
        start += _NUMBERS[joints[-1].kind]
    touching = np.flatnonzero(couplings.touches.any(axis=1)).tolist()
    shapes = [shape for shape in touching if int(mj.geom_type[shape]) in _SHAPES]
    row = {shape: number for number, shape in enumerate(shapes)}
    driven = [i for i in range(mj.nactuator) if not _odd_actuator(mj, i) and works(mj, i)]
    rows = {"geom": row, "actuator": {number: i for i, number in enumerate(driven)}}
    followed = [i for i in range(mj.neq) if _acts(mj, i) and _is_linear(mj, i)]
    return ModelBodies(
        bodies=tuple(
            Body(
                name,
                int(mj.body_parentid[i]),
                _vector(mj.body_pos[i]),
                _rotation(mj.body_quat[i]),
                float(mj.body_mass[i]),
                _vector(mj.body_inertia[i]),
                _vector(mj.body_ipos[i]),
                _rotation(mj.body_iquat[i]),
            )
            for i, name in enumerate(names["body"])
        ),
        joints=tuple(joints),
        geoms=tuple(_geom(mj, shape, names["geom"][shape]) for shape in shapes),
        actuators=tuple(_actuator(mj, number, names["actuator"][number]) for number in driven),
        couplings=tuple(
            Coupling(
                names["equality"][i],
                int(mj.eq_obj1id[i]),
                int(mj.eq_obj2id[i]),
                *mj.eq_data[i, :2].tolist(),
            )
            for i in followed
        ),
        touching=tuple(
            (row[int(first)], row[int(second)])
            for first, second in np.argwhere(np.triu(couplings.touches))
            if int(first) in row and int(second) in row
        ),
        gravity=_vector(np.zeros(3) if disabled(mj, _OFF.mjDSBL_GRAVITY) else mj.opt.gravity),
        timestep=float(mj.opt.timestep),
        places=dict(_places(mj, names, rows)),
        missing=tuple(_missing(mj, names, touching)),
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


def _geom(mj: mujoco.MjModel, geom: int, name: str) -> Geom:
    kind, numbers = _SHAPES[int(mj.geom_type[geom])]
    corners: tuple[Vector, ...] = ()
    if kind == "mesh":  # the corners of its convex hull
        mesh = int(mj.geom_dataid[geom])
        first, count = int(mj.mesh_vertadr[mesh]), int(mj.mesh_vertnum[mesh])
        vertices = mj.mesh_vert[first : first + count].astype(np.float64)
        graph = int(mj.mesh_graphadr[mesh])
        if graph >= 0:  # number of corners and faces, where their edges begin, which vertices
            n = int(mj.mesh_graph[graph])
            vertices = vertices[mj.mesh_graph[graph + 2 + n : graph + 2 + 2 * n]]
        corners = tuple(map(_vector, vertices))
    return Geom(
        name,
        kind,
        int(mj.geom_bodyid[geom]),
        _vector(mj.geom_pos[geom]),
        _rotation(mj.geom_quat[geom]),
        tuple(mj.geom_size[geom, :numbers].tolist()),
        corners,
        float(mj.geom_friction[geom, 0]),
        bool(mj.geom_condim[geom] == 1),
    )


def _actuator(mj: mujoco.MjModel, actuator: int, name: str) -> Actuator:
    joint = int(mj.actuator_trnid[actuator, 0])
    # Since MuJoCo 4 an actuator may have several controls and several rows of gears.
    control = int(mj.actuator_ctrladr[actuator]) if hasattr(mj, "actuator_ctrladr") else actuator
    output = int(mj.actuator_outadr[actuator]) if hasattr(mj, "actuator_outadr") else actuator
    gears = 3 if mj.jnt_type[joint] == int(_JNT.mjJNT_BALL) else 1
    gain, bias = mj.actuator_gainprm[actuator], mj.actuator_biasprm[actuator]
    affine = mj.actuator_gaintype[actuator] == int(_GAIN.mjGAIN_AFFINE)
    biased = mj.actuator_biastype[actuator] == int(_BIAS.mjBIAS_AFFINE)
    clipped = mj.actuator_ctrllimited[control] and not disabled(mj, _OFF.mjDSBL_CLAMPCTRL)
    return Actuator(
        name,
        joint,
        control,
        tuple(mj.actuator_gear[output, :gears].tolist()),
        _vector(gain[:3]) if affine else (float(gain[0]), 0.0, 0.0),
        _vector(bias[:3]) if biased else (0.0, 0.0, 0.0),
        _pair(mj.actuator_ctrlrange[control]) if clipped else None,
        _pair(mj.actuator_forcerange[actuator]) if mj.actuator_forcelimited[actuator] else None,
    )


def _acts(mj: mujoco.MjModel, equality: int) -> bool:
    """Tell whether an equality constraint is in force."""
    off = disabled(mj, _OFF.mjDSBL_EQUALITY) or disabled(mj, _OFF.mjDSBL_CONSTRAINT)
    return bool(mj.eq_active0[equality]) and not off


def _is_linear(mj: mujoco.MjModel, equality: int) -> bool:
    """Tell whether an equality constraint lets a joint follow another one in proportion."""
    joints = mj.eq_type[equality] == int(mujoco.mjtEq.mjEQ_JOINT) and mj.eq_obj2id[equality] >= 0
    return bool(joints and not mj.eq_data[equality, 2:5].any())


# --- what there is no word for -----------------------------------------------------------------


def _odd_actuator(mj: mujoco.MjModel, actuator: int) -> str:
    """Say what is special about an actuator, if anything is."""
    if mj.actuator_trntype[actuator] not in (int(_TRN.mjTRN_JOINT), int(_TRN.mjTRN_JOINTINPARENT)):
        if mj.actuator_trntype[actuator] == int(_TRN.mjTRN_SO3):
            return "is a servo of an orientation"
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


def _missing(
    mj: mujoco.MjModel, names: Mapping[str, tuple[str, ...]], touching: Sequence[int]
) -> Iterator[str]:
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
        if works(mj, i) and _odd_actuator(mj, i):
            yield f"the actuator {names['actuator'][i]!r}, which {_odd_actuator(mj, i)}"
    yield from _missing_of_bodies(mj, names, touching)


def _missing_of_bodies(
    mj: mujoco.MjModel, names: Mapping[str, tuple[str, ...]], touching: Sequence[int]
) -> Iterator[str]:
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
    for i in range(mj.ngeom):
        name, kind = names["geom"][i], int(mj.geom_type[i])
        if i in touching and kind not in _SHAPES:
            yield f"the {mujoco.mjtGeom(kind).name.removeprefix('mjGEOM_').lower()} {name!r}"
        if _has(mj, "geom_adhesion", i) or _has(mj, "geom_surfacevel", i):
            yield f"adhesion or moving surface of the geom {name!r}"


def _has(mj: mujoco.MjModel, array: str, row: int) -> bool:
    """Tell whether a row of an array, which old versions of MuJoCo do not have, is not zero."""
    numbers = getattr(mj, array, None)
    return numbers is not None and bool(np.any(numbers[row]))


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
        if row is not None and (parts := tuple(_parts(mj, field, number))):
            yield field.key, Place(_TABLES[field.kind], row, parts)


def _parts(mj: mujoco.MjModel, field: Field, number: int) -> Iterator[RowPart]:
    """Say which numbers of a row a parameter is; none if it has no meaning here."""
    name = _FIELDS.get((field.kind, field.attribute))
    if name is not None:
        whole = field.attribute != "gain"
        if field.attribute == "size":
            whole = mj.geom_type[number] != int(_GEOM.mjGEOM_SPHERE)
        elif field.attribute == "gear":
            whole = mj.jnt_type[mj.actuator_trnid[number, 0]] == int(_JNT.mjJNT_BALL)
        yield RowPart(name) if whole else RowPart(name, 0)
    elif field.kind == "actuator" and field.attribute in ("kp", "kv"):
        damped = mj.actuator_biasprm[number, 1] != 0.0
        if mj.actuator_gaintype[number] == int(_GAIN.mjGAIN_AFFINE):
            yield RowPart("gain", 2, -1.0)
        elif field.attribute == "kp":
            yield from (RowPart("gain", 0), RowPart("bias", 1, -1.0))
        else:
            yield from (() if damped else (RowPart("gain", 0),))
            yield RowPart("bias", 2, -1.0)


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
