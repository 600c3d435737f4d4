"""A row of the table of parameters, and what rows are made from."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, Literal, final

import mujoco
import numpy as np

from scm_world.backends.mujoco.slots import Slot, first, place, turn
from scm_world.backends.mujoco.trees import NOTHING, Couplings, Effect, disabled
from scm_world.models.model import Numbers
from scm_world.models.scene import ParameterKey

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


SMALLEST = 1e-9
"""Below this no mass [kg], time [s] or length [m] is accepted."""

FREE, BALL, SLIDE, HINGE = (
    int(kind)
    for kind in (
        mujoco.mjtJoint.mjJNT_FREE,
        mujoco.mjtJoint.mjJNT_BALL,
        mujoco.mjtJoint.mjJNT_SLIDE,
        mujoco.mjtJoint.mjJNT_HINGE,
    )
)
OFF = mujoco.mjtDisableBit

Slots = Callable[[mujoco.MjModel, mujoco.MjData], Slot]
"""Finds a place in a model and its data."""


@final
@dataclass(frozen=True)
class Field:
    """A parameter of one element of a compiled model.

    Attributes:
        kind: Of the element: ``"body"``, ``"joint"``, ..., or ``"option"``.
        element: Its name, ``""`` for an option.
        attribute: What it is.
        unit: SI unit.
        doc: One sentence.
        slot: Finds its place in a model and its data.
        effect: The trees it acts on.
        low: Lower bound.
        high: Upper bound.
        nature: The kind of its values.
        usual: Whether it is exposed unless something else is asked for.
        visual: Whether it acts on pictures only.
        refusal: Why it cannot be set, to be read after its name; empty if it can.
        name: Unique in the model.
    """

    kind: str
    element: str
    attribute: str
    unit: str
    doc: str
    slot: Slots | None
    effect: Callable[[], Effect] = lambda: NOTHING
    low: Numbers = -math.inf
    high: Numbers = math.inf
    nature: Literal["real", "rotation", "inertia", "switch"] = "real"
    usual: bool = True
    visual: bool = False
    refusal: str = ""
    name: str = ""

    @property
    def plain_name(self) -> str:
        """The name, if no other element has the same."""
        return f"{self.element}.{self.attribute}" if self.element else self.attribute

    @property
    def key(self) -> ParameterKey:
        """How engines know it."""
        element, _, attribute = self.name.rpartition(".")
        return element, attribute


@final
@dataclass(frozen=True)
class Scope:
    """A compiled model, which is only read.

    Attributes:
        mj: The model.
        names: Of its elements.
        trees: Its trees.
        fluid: Whether a medium acts, or may be made to act.
    """

    mj: mujoco.MjModel
    names: Mapping[str, tuple[str, ...]]
    trees: Couplings
    fluid: bool

    def rows(self, kind: str, index: int, effect: Callable[[], Effect]) -> Callable[..., Field]:
        """Give what makes the fields of one element, from the attribute on."""
        return partial(Field, kind, self.names[kind][index], effect=effect)

    def off(self, flag: mujoco.mjtDisableBit, what: str) -> str:
        """Say that a flag of the model disables something, if it does."""
        return f"acts on nothing: the model disables {what}" if disabled(self.mj, flag) else ""


def at(array: str, *index: Any, constant: bool = False) -> Slots:
    """Find a place in an array of the model; constants of the model may have to follow it."""
    return lambda mj, _: place(getattr(mj, array)[(*index, ...)], constant=constant)


def turn_at(array: str, index: int) -> Slots:
    """Find a quaternion; constants of the model follow it."""
    return lambda mj, _: turn(getattr(mj, array)[index])


def repeated_at(array: str, rows: slice, *, constant: bool = False) -> Slots:
    """Find the same number in several rows of an array."""
    return lambda mj, _: place(getattr(mj, array)[rows], constant=constant, back=first)


def least(value: Any) -> float:
    """Give a lower bound for what has to be positive."""
    return min(SMALLEST, float(np.min(value)))


def solver_rows(
    row: Callable[..., Field], mj: mujoco.MjModel, prefix: str, index: int, **rest: Any
) -> tuple[Field, Field]:
    """Give how stiff and how hard a constraint is: its ``solref`` and ``solimp``."""
    suffix = rest.pop("suffix", "")
    reference = getattr(mj, f"{prefix}_solref")[index]
    if (reference < 0.0).any():
        doc, low, high = "Stiffness and damping of the constraint, both negative.", -math.inf, 0.0
        bounds: dict[str, Any] = {"low": low, "high": high}
    else:
        doc = "Time constant [s] and damping ratio of the constraint."
        bounds = {"low": (least(reference[0]), least(reference[1]))}
    impedance = row(
        f"solimp{suffix}", "1",
        "Smallest and largest impedance, width of the transition, its midpoint and power.",
        at(f"{prefix}_solimp", index), low=(0.0, 0.0, 0.0, 0.0, 1.0),
        high=(1.0, 1.0, math.inf, 1.0, math.inf), **rest,
    )  # fmt: skip
    slot = at(f"{prefix}_solref", index)
    return row(f"solref{suffix}", "1", doc, slot, **bounds, **rest), impedance
