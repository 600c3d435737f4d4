"""Names of elements."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import lru_cache

import mujoco
import numpy as np

_OBJ, _TRN = mujoco.mjtObj, mujoco.mjtTrn


def clean(name: str) -> str:
    """Replace what may not stand in the name of an element.

    Example:
        >>> clean("arm/joint.1"), clean("left hand")
        ('arm_joint_1', 'left_hand')
    """
    return re.sub(r"[^\w-]", "_", name)


_KINDS = {
    "body": (_OBJ.mjOBJ_BODY, "nbody"),
    "joint": (_OBJ.mjOBJ_JOINT, "njnt"),
    "geom": (_OBJ.mjOBJ_GEOM, "ngeom"),
    "site": (_OBJ.mjOBJ_SITE, "nsite"),
    "tendon": (_OBJ.mjOBJ_TENDON, "ntendon"),
    "equality": (_OBJ.mjOBJ_EQUALITY, "neq"),
    "actuator": (_OBJ.mjOBJ_ACTUATOR, "nactuator"),
    "pair": (_OBJ.mjOBJ_PAIR, "npair"),
    "sensor": (_OBJ.mjOBJ_SENSOR, "nsensor"),
    "flex": (_OBJ.mjOBJ_FLEX, "nflex"),
}


@lru_cache(maxsize=32)
def element_names(mj: mujoco.MjModel) -> Mapping[str, tuple[str, ...]]:
    """Name the elements of each kind: their own names, cleaned, or names made from their body."""
    found: dict[str, tuple[str, ...]] = {}
    for kind, (obj, size) in _KINDS.items():
        given = [mujoco.mj_id2name(mj, obj, i) or "" for i in range(getattr(mj, size))]
        taken: set[str] = set()
        names = [_free(clean(name), taken) if name else "" for name in given]
        for i, name in enumerate(names):
            names[i] = name or _free(_made(mj, kind, i, names, found), taken)
        found[kind] = tuple(names)
    return found


def _free(name: str, taken: set[str]) -> str:
    """Give a name that is not taken, with a number if need be, and take it."""
    free, n = name, 1
    while free in taken:
        n += 1
        free = f"{name}_{n}"
    taken.add(free)
    return free


def _made(
    mj: mujoco.MjModel, kind: str, i: int, names: list[str], found: Mapping[str, tuple[str, ...]]
) -> str:
    """Name an element that has no name."""
    match kind:
        case "body":
            parent = int(mj.body_parentid[i])
            siblings = np.flatnonzero(mj.body_parentid == parent).tolist()
            return f"{names[parent]}_body_{[s for s in siblings if s].index(i)}"
        case "joint":
            body = int(mj.jnt_bodyid[i])
            if mj.body_jntnum[body] == 1:
                return found["body"][body]
            return f"{found['body'][body]}_joint_{i - int(mj.body_jntadr[body])}"
        case "geom":
            body = int(mj.geom_bodyid[i])
            return f"{found['body'][body]}_geom_{i - int(mj.body_geomadr[body])}"
        case "site":
            body = int(mj.site_bodyid[i])
            before = int(np.count_nonzero(mj.site_bodyid[:i] == body))
            return f"{found['body'][body]}_site_{before}"
        case "actuator":
            return _target(mj, i, found)
        case "pair":
            geoms = found["geom"]
            return f"{geoms[int(mj.pair_geom1[i])]}_{geoms[int(mj.pair_geom2[i])]}"
        case _:
            return f"{kind}_{i}"


def _target(mj: mujoco.MjModel, actuator: int, found: Mapping[str, tuple[str, ...]]) -> str:
    """Name what an actuator acts on."""
    target = int(mj.actuator_trnid[actuator, 0])
    match mujoco.mjtTrn(int(mj.actuator_trntype[actuator])):
        case _TRN.mjTRN_TENDON:
            return found["tendon"][target]
        case _TRN.mjTRN_SITE | _TRN.mjTRN_SLIDERCRANK:
            return found["site"][target]
        case _TRN.mjTRN_BODY:
            return found["body"][target]
        case _TRN.mjTRN_SO3 if mj.actuator_trnid[actuator, 1] >= 0:
            return found["site"][target]
        case _:
            return found["joint"][target]
