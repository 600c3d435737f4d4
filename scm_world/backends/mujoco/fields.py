"""The parameters of a compiled model: a table of rows, and what makes parameters of them.

What may be changed, and what has to follow, is MuJoCo's own table (*Programming, Simulation,
mjModel changes*); every class was tried on foreign models by writing, undoing and comparing all
arrays bit by bit. Since MuJoCo 3.16 ``mj_setConst`` derives the bounds of shapes from their sizes
and places, so that nothing here needs another compilation.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, Literal, final

import mujoco
import numpy as np

from scm_world._types import Floats
from scm_world.backends.mujoco.slots import Finder, at, color, direction, gain, option, place, turn
from scm_world.backends.mujoco.trees import NOTHING, Couplings, Effect, disabled
from scm_world.models.model import Numbers, Parameter

_TRN, _WRAP, _OFF = mujoco.mjtTrn, mujoco.mjtWrap, mujoco.mjtDisableBit
_GAIN, _BIAS, _DYN, _GEOM = mujoco.mjtGain, mujoco.mjtBias, mujoco.mjtDyn, mujoco.mjtGeom
FREE, BALL, SLIDE, HINGE = (int(getattr(mujoco.mjtJoint, f"mjJNT_{name}")) for name in (
    "FREE", "BALL", "SLIDE", "HINGE",
))  # fmt: skip

FRICTIONS = ("friction", "torsional_friction", "rolling_friction")
MEDIUM = ("density", "viscosity")
"""Options that make a medium act, and wind with it."""

SMALLEST = 1e-9
"""Below this no mass [kg], time [s] or length [m] is accepted."""

FORCES, INERTIAS = {"m": "N", "rad": "N m"}, {"m": "kg", "rad": "kg m^2"}
"""Units of a force and of an inertia along a coordinate, by its unit."""

# --- elements ----------------------------------------------------------------------------------


def prefix(kind: str) -> str:
    """Return how MuJoCo calls the arrays of a kind of elements."""
    return {"joint": "jnt", "equality": "eq", "option": "opt"}.get(kind, kind)


@final
@dataclass(frozen=True)
class Element:
    """A body, joint, shape, ... of a compiled model; ``element["mass"]`` is its entry of an array.

    Attributes:
        mj: The model, which is only read.
        trees: Its trees.
        kind: See ``ROWS``.
        i: Its number among those of its kind.
        name: Its name.
    """

    mj: mujoco.MjModel
    trees: Couplings
    kind: str
    i: int
    name: str

    def __getitem__(self, array: str) -> Any:
        return getattr(self.mj, f"{prefix(self.kind)}_{array}")[self.i]

    def is_(self, array: str, *members: Any) -> bool:
        """Return whether an entry is one of some constants of MuJoCo."""
        return int(self[array]) in map(int, members)

    @property
    def body(self) -> int:
        """Number of its body."""
        return self.i if self.kind == "body" else int(self["bodyid"])

    @property
    def moves(self) -> bool:
        """Whether it belongs to a body that moves, and is not but a vertex of a flex."""
        vertex = self.body in self.mj.flex_vertbodyid or self.body in self.mj.flex_nodebodyid
        return bool(self.mj.body_treeid[self.body] >= 0) and not vertex

    @property
    def heavy(self) -> bool:
        """Whether the inertia of a body acts."""
        return self.trees.tree(self.i) >= 0 and self["mass"] > 0.0

    @property
    def turns(self) -> bool:
        """Whether a joint on the way to a body turns it, or it cannot move at all."""
        body = self.i
        while body and self.mj.body_treeid[self.i] >= 0:
            start = int(self.mj.body_jntadr[body])
            if any(self.mj.jnt_type[start : start + int(self.mj.body_jntnum[body])] != SLIDE):
                return True
            body = int(self.mj.body_parentid[body])
        return body > 0

    @property
    def is_simple(self) -> bool:
        """Whether the compiler has fixed the place of the center of mass and of the joints."""
        return bool(self.mj.body_simple[self.body])

    @property
    def is_free(self) -> bool:
        """Whether a body moves by a free joint."""
        joint = int(self["jntadr"])
        return joint >= 0 and bool(self.mj.jnt_type[joint] == FREE)

    @property
    def length(self) -> str:
        """Unit of the coordinate of a joint, a tendon or an actuator."""
        match self.kind:
            case "joint":
                return {SLIDE: "m", FREE: "1"}.get(int(self["type"]), "rad")
            case "tendon":
                return tendon_unit(self.mj, self.i)
            case _:
                return _length_unit(self.mj, self.i)

    @property
    def dofs(self) -> Any:
        """Places of a joint in arrays of degrees of freedom: a number, or a slice of several."""
        start = int(self["dofadr"])
        count = {FREE: 6, BALL: 3}.get(int(self["type"]), 1)
        return start if count == 1 else slice(start, start + count)

    @property
    def servo(self) -> str:
        """The kind of servo that an actuator is; see ``servo``."""
        return servo(self.mj, self.i)

    @property
    def gears(self) -> int:
        """How many components of the gear of an actuator are in use."""
        kind = int(self["trntype"])
        if kind not in _JOINTS:
            return _GEARS.get(kind, 0)
        return {FREE: 6, BALL: 3}.get(int(self.mj.jnt_type[self["trnid"][0]]), 1)

    @property
    def times(self) -> int:
        """How many time constants an actuator has."""
        return _TIMES.get(int(self["dyntype"]), 0)


_JOINTS = (int(_TRN.mjTRN_JOINT), int(_TRN.mjTRN_JOINTINPARENT))
_GEARS = {int(_TRN.mjTRN_SITE): 6, int(_TRN.mjTRN_TENDON): 1, int(_TRN.mjTRN_SLIDERCRANK): 1}
_TIMES = {
    int(_DYN.mjDYN_FILTER): 1,
    int(_DYN.mjDYN_FILTEREXACT): 1,
    int(_DYN.mjDYN_MUSCLE): 2,
}


def tendon_unit(mj: mujoco.MjModel, tendon: int) -> str:
    """Return the unit of the length of a tendon; ``"1"`` where it sums meters and radians."""
    start, count = int(mj.tendon_adr[tendon]), int(mj.tendon_num[tendon])
    if mj.wrap_type[start] != int(_WRAP.mjWRAP_JOINT):
        return "m"
    joints = mj.wrap_objid[start : start + count]
    units = {"m" if mj.jnt_type[joint] == SLIDE else "rad" for joint in joints}
    return units.pop() if len(units) == 1 else "1"


def _length_unit(mj: mujoco.MjModel, actuator: int) -> str:
    """Return the unit of the length of an actuator; ``"1"`` where a gear or several axes mix it."""
    kind, target = int(mj.actuator_trntype[actuator]), int(mj.actuator_trnid[actuator, 0])
    if mj.actuator_gear[int(mj.actuator_outadr[actuator]), 0] != 1.0:
        return "1"
    if kind == int(_TRN.mjTRN_TENDON):
        return tendon_unit(mj, target)
    joint = int(mj.jnt_type[target]) if kind == int(_TRN.mjTRN_JOINT) else FREE
    return {HINGE: "rad", SLIDE: "m"}.get(joint, "1")


def servo(mj: mujoco.MjModel, actuator: int) -> str:
    """Return ``"position"`` or ``"velocity"`` of a servo, ``"damper"``, or ``""``."""
    gains, bias = mj.actuator_gainprm[actuator], mj.actuator_biasprm[actuator]
    affine = mj.actuator_biastype[actuator] == int(_BIAS.mjBIAS_AFFINE)
    if mj.actuator_gaintype[actuator] == int(_GAIN.mjGAIN_AFFINE):
        return "damper" if not gains[:2].any() and gains[2] <= 0.0 and not affine else ""
    fixed = mj.actuator_gaintype[actuator] == int(_GAIN.mjGAIN_FIXED)
    if not (fixed and affine) or bias[0] != 0.0 or gains[0] <= 0.0 or bias[2] > 0.0:
        return ""
    if bias[1] == -gains[0]:
        return "position"
    return "velocity" if bias[1] == 0.0 and bias[2] == -gains[0] else ""


def control_unit(mj: mujoco.MjModel, actuator: int) -> str:
    """Return the unit of the control of an actuator; ``"1"`` where gears and gains scale it."""
    unit = _length_unit(mj, actuator)
    match servo(mj, actuator):
        case "position":
            return unit if mj.actuator_dyntype[actuator] != int(_DYN.mjDYN_INTEGRATOR) else "1"
        case "velocity":
            return f"{unit}/s" if unit != "1" else "1"
        case _:
            plain = mj.actuator_gaintype[actuator] == int(_GAIN.mjGAIN_FIXED)
            plain = plain and mj.actuator_gainprm[actuator, 0] == 1.0
            return FORCES.get(unit, "1") if plain and not mj.actuator_dyntype[actuator] else "1"


# --- rows --------------------------------------------------------------------------------------


@final
@dataclass(frozen=True)
class Field:
    """A parameter that every element of a kind has. What depends on the element is a function.

    Attributes:
        attribute: Its name.
        unit: SI unit; L is that of the coordinate, F of a force and I of an inertia along it.
        doc: One sentence.
        array: Arrays with its value, or a function that returns a finder; ``""`` if nothing can be
            written. See ``slots.at``.
        at: Place in the arrays; the number of the element by default.
        form: How the value stands there.
        constant: Whether constants of the model follow it (``mj_setConst``).
        low: Lower bound, or a function of the present value.
        high: Upper bound, likewise.
        nature: The kind of its values.
        usual: Whether it is exposed by default; a function of the element and the present value.
        visual: Whether it acts on pictures only.
        exists: Which elements have it.
        flags: Flags of the model that disable it.
        acts: Whether it can be set, if no flag disables it.
        reason: Why not, to be read after its name.
        effect: The trees it acts on; those of the element by default.
    """

    attribute: str
    unit: str | Callable[[Element], str]
    doc: str | Callable[[Element], str]
    array: str | Callable[[Element], Finder] = ""
    at: Callable[[Element], Any] = lambda e: e.i
    form: Callable[..., Any] = place
    constant: bool = False
    low: Numbers | Callable[[Floats], Numbers] = -math.inf
    high: Numbers | Callable[[Floats], Numbers] = math.inf
    nature: Literal["real", "rotation", "inertia", "switch"] = "real"
    usual: bool | Callable[[Element, Floats], bool] = True
    visual: bool | Callable[[Element], bool] = False
    exists: Callable[[Element], bool] = lambda e: True
    flags: tuple[mujoco.mjtDisableBit, ...] = ()
    acts: Callable[[Element], bool] = lambda e: True
    reason: str = ""
    effect: Callable[[Element], Effect] | None = None


def _parameter(row: Field, e: Element, data: mujoco.MjData) -> Parameter:
    """Return the parameter of an element with its value in the model, and in the data."""

    def of(value: Any, *arguments: Any) -> Any:
        return value(*arguments) if callable(value) else value

    if callable(row.array):
        slot: Finder | None = row.array(e)
    else:
        index = row.at(e) if row.array else ()
        index = index if isinstance(index, tuple) else (index,)
        slot = partial(at, row.form, row.array, index, row.constant) if row.array else None
    default = np.zeros(()) if slot is None else slot(e.mj, data).read()
    off = [flag for flag in row.flags if disabled(e.mj, flag)]
    refusal = "" if slot is not None and row.acts(e) else row.reason.format(e.name)
    if off:
        word = off[0].name.removeprefix("mjDSBL_").lower()
        refusal = f"acts on nothing: the model disables {word}"
    always, contact = NOTHING
    if not refusal:
        always, contact = row.effect(e) if row.effect else getattr(e.trees, e.kind)(e.i)
    return Parameter(
        name=f"{e.name}.{row.attribute}" if e.name else row.attribute,
        unit=_unit(of(row.unit, e), e),
        shape=default.shape,
        default=numbers(default),
        low=of(row.low, default),
        high=of(row.high, default),
        doc=of(row.doc, e),
        always=always,
        contact=contact,
        slot=slot,
        kind=row.nature,
        visual=of(row.visual, e),
        body=e.body if e.kind in ("body", "geom") else -1,
        usual=bool(of(row.usual, e, default)),
        refusal=refusal,
    )


def numbers(values: Any) -> Numbers:
    """Return a default or a bound: one number, or one for each component."""
    found = np.asarray(values, dtype=np.float64)
    return tuple(found.ravel().tolist()) if found.ndim else float(found)


def _unit(written: str, e: Element) -> str:
    """Return the unit of a row; ``"1"`` where that of the coordinate is none."""
    if "{" not in written:
        return written
    length = e.length
    if length == "1":
        return "1"
    return written.format(L=length, F=FORCES[length], I=INERTIAS[length])


def _positive(value: Floats) -> float:
    """Return a lower bound for what has to be positive."""
    return min(SMALLEST, float(np.min(value)))


def _not_negative(value: Floats) -> float:
    """Return a lower bound for what is rarely negative."""
    return min(0.0, float(np.min(value)))


def _nonzero(_: Element, value: Floats) -> bool:
    return bool(np.any(value))


_TURN: dict[str, Any] = {
    "form": turn, "constant": True, "low": -1.0, "high": 1.0, "nature": "rotation",
}  # fmt: skip
"""How a quaternion stands in arrays."""


def _gains(*places: tuple[str, int, int]) -> Callable[[Element], Finder]:
    """Return what finds a gain in arrays of the model: each with a column, and a sign."""
    return lambda e: partial(gain, e.i, places)


def _pose(kind: str, what: str) -> tuple[Field, Field]:
    """List where a shape or a site is."""
    where = f"of the {what} in the frame of its body."
    return (
        Field("position", "m", f"Place {where}", f"{kind}_pos", constant=True, usual=False),
        Field("orientation", "1", f"Orientation {where}", f"{kind}_quat", usual=False, **_TURN),
    )  # fmt: skip


def _solver(prefix: str, suffix: str = "", **rest: Any) -> tuple[Field, Field]:
    """List how stiff and how hard a constraint is."""
    rest["usual"] = False

    def doc(e: Element) -> str:
        if (getattr(e.mj, f"{prefix}_solref")[e.i] < 0.0).any():
            return "Stiffness and damping of the constraint, both negative."
        return "Time constant [s] and damping ratio of the constraint."

    def low(v: Floats) -> Numbers:
        return -math.inf if (v < 0.0).any() else (_positive(v[0]), _positive(v[1]))

    return (
        Field(f"solref{suffix}", "1", doc, f"{prefix}_solref", low=low,
            high=lambda v: 0.0 if (v < 0.0).any() else math.inf, **rest),
        Field(f"solimp{suffix}", "1",
            "Smallest and largest impedance, width of the transition, its midpoint and power.",
            f"{prefix}_solimp", low=(0.0, 0.0, 0.0, 0.0, 1.0),
            high=(1.0, 1.0, math.inf, 1.0, math.inf), **rest),
    )  # fmt: skip


_GRAVITY = (_OFF.mjDSBL_GRAVITY,)
_DAMPER = (_OFF.mjDSBL_DAMPER,)
_SPRING = (_OFF.mjDSBL_SPRING,)
_LIMIT = (_OFF.mjDSBL_LIMIT,)
_CONTACT = (_OFF.mjDSBL_CONTACT,)
_FRICTION = (_OFF.mjDSBL_FRICTIONLOSS,)
_CONSTRAINT = (_OFF.mjDSBL_CONSTRAINT,)
_EQUALITY = (_OFF.mjDSBL_EQUALITY,)
_UNLIMITED = "is not in force: it has no limits"
_SIMPLE = "is fixed by the compiler; write simple='false' at the body"
_WEIGHTLESS = "acts on nothing: the body cannot move, or has no mass"
_UNTOUCHED = "acts on nothing: the shape touches nothing"
_FRICTIONLESS = "acts on nothing: its contacts have a smaller condim, or there are none"
_WHOLE = "is a whole number that only another file can change"
_SHOWN = 3
"""MuJoCo draws the first groups of shapes unless it is asked for others."""

_SIZES = {
    int(_GEOM.mjGEOM_SPHERE): (1, "Radius"),
    int(_GEOM.mjGEOM_CAPSULE): (2, "Radius, and half length of the cylinder part,"),
    int(_GEOM.mjGEOM_CYLINDER): (2, "Radius and half length"),
    int(_GEOM.mjGEOM_ELLIPSOID): (3, "Radii along the axes"),
    int(_GEOM.mjGEOM_BOX): (3, "Half edge lengths"),
}


def _sized(e: Element) -> bool:
    return int(e["type"]) in _SIZES


def _word(e: Element) -> str:
    return str(mujoco.mjtGeom(int(e["type"])).name).removeprefix("mjGEOM_").lower()


def _columns(count: int) -> Any:
    """Return the first columns of an array: a number, or a slice of several."""
    return 0 if count == 1 else slice(count)


_BODY = (
    Field("mass", "kg", "Mass of the body; its inertia stays as it is.", "body_mass", constant=True,
        low=_positive, usual=lambda e, v: e.moves, acts=lambda e: e.heavy, reason=_WEIGHTLESS),
    Field("inertia", "kg m^2", "Principal moments of inertia of the body.", "body_inertia",
        constant=True, low=_positive, nature="inertia", usual=lambda e, v: e.moves,
        acts=lambda e: e.heavy and e["inertia"].all() and e.turns,
        reason="acts on nothing: the body never turns, or has no inertia"),
    Field("center_of_mass", "m", "Center of mass in the frame of the body.", "body_ipos",
        constant=True, usual=False, acts=lambda e: e.heavy and not e.is_simple,
        reason=f"{_SIMPLE}, unless it has no mass"),
    Field("gravcomp", "1", "Share of the weight of the body that is held up.", "body_gravcomp",
        constant=True, usual=lambda e, v: e.moves and v != 0.0, acts=lambda e: e.heavy,
        flags=_GRAVITY, reason=_WEIGHTLESS),
    Field("position", "m", "Place of a body that is moved from outside.",
        "data.mocap_pos", lambda e: e["mocapid"],
        exists=lambda e: e["mocapid"] >= 0, effect=lambda e: e.trees.frame(e.i)),
    Field("orientation", "1", "Orientation of a body that is moved from outside.",
        "data.mocap_quat", lambda e: e["mocapid"], exists=lambda e: e["mocapid"] >= 0,
        effect=lambda e: e.trees.frame(e.i), **{**_TURN, "constant": False}),
    Field("position", "m", "", exists=lambda e: e["mocapid"] < 0 and e.is_free, usual=False,
        reason="is a state: set {}.cartesian_position"),
    Field("position", "m", "Place of the frame of the body in its parent.", "body_pos",
        constant=True, usual=False, exists=lambda e: e["mocapid"] < 0 and not e.is_free,
        effect=lambda e: e.trees.frame(e.i)),
    Field("orientation", "1", "Orientation of the body in its parent.", "body_quat",
        usual=False, exists=lambda e: e["mocapid"] < 0 and not e.is_free,
        effect=lambda e: e.trees.frame(e.i), **_TURN),
)  # fmt: skip


def _resisted(e: Element, value: Floats) -> bool:
    """Return whether what resists a joint is exposed; a free joint mixes units."""
    return (e["type"] != FREE and e.moves) or bool(value.flat[0])


def _alike(array: str) -> Callable[[Element], bool]:
    """Return whether one number says what the file says."""
    return lambda e: bool(np.ptp(getattr(e.mj, array)[e.dofs]) == 0.0)


_UNEVEN = "is not the same about all axes of the joint"


def _scalar(e: Element) -> bool:
    return e["type"] in (SLIDE, HINGE)


_LIMITED: dict[str, Any] = {
    "exists": _scalar,
    "usual": False,
    "flags": _LIMIT,
    "acts": lambda e: e["limited"],
    "reason": _UNLIMITED,
}
_JOINT = (
    Field("damping", "{F} s/{L}", "Force against the motion, for each unit of velocity.",
        "dof_damping", lambda e: e.dofs, low=0.0, usual=_resisted, flags=_DAMPER,
        acts=_alike("dof_damping"), reason=_UNEVEN),
    Field("armature", "{I}", "Inertia that the joint itself adds.", "dof_armature",
        lambda e: e.dofs, constant=True, low=0.0, usual=_resisted, acts=_alike("dof_armature"),
        reason=_UNEVEN),
    Field("frictionloss", "{F}", "Dry friction: the force that motion has to overcome.",
        "dof_frictionloss", lambda e: e.dofs, low=0.0, usual=_resisted,
        flags=_FRICTION + _CONSTRAINT, acts=_alike("dof_frictionloss"), reason=_UNEVEN),
    Field("stiffness", "{F}/{L}", "Stiffness of a spring that pulls to springref.",
        "jnt_stiffness", low=0.0, usual=_resisted, flags=_SPRING),
    Field("springref", "{L}", "Position in which the spring is at rest.",
        "qpos_spring", lambda e: int(e["qposadr"]), constant=True, exists=_scalar, flags=_SPRING,
        usual=lambda e, v: bool(e["stiffness"])),
    Field("ref", "{L}", "Position of the joint in the pose of the file.", "qpos0",
        lambda e: int(e["qposadr"]), constant=True, exists=_scalar, usual=False),
    Field("range", "{L}", "Lower and upper limit of the joint.", "jnt_range", **_LIMITED),
    Field("margin", "{L}", "Distance from the limits at which they begin to act.", "jnt_margin",
        low=0.0, **_LIMITED),
    *_solver("jnt", "limit", **_LIMITED),
    Field("actuatorfrcrange", "{F}", "Range of the force of all its actuators.",
        "jnt_actfrcrange", exists=_scalar, usual=False, acts=lambda e: e["actfrclimited"],
        reason=_UNLIMITED),
    Field("axis", "1", "Unit vector of the axis in the frame of the body.",
        "jnt_axis", form=direction, low=-1.0, high=1.0, exists=_scalar,
        usual=False, acts=lambda e: not e.is_simple, reason=_SIMPLE),
    Field("anchor", "m", "Point of the body through which the axis goes.", "jnt_pos",
        constant=True, exists=_scalar, usual=False,
        acts=lambda e: e["type"] != SLIDE and not e.is_simple,
        reason=f"acts on nothing if the joint slides; otherwise it {_SIMPLE}"),
)  # fmt: skip


def _rubs(condim: int) -> dict[str, Any]:
    """Return when a coefficient of friction acts."""
    return {
        "low": 0.0,
        "acts": lambda e: e.trees.highest_condim(e.i) >= condim,
        "reason": _FRICTIONLESS,
        "effect": lambda e: e.trees.contact_of(e.i),
    }


_TOUCHES: dict[str, Any] = {
    "acts": lambda e: e.trees.highest_condim(e.i) > 0,
    "reason": _UNTOUCHED,
    "effect": lambda e: e.trees.contact_of(e.i),
}
_SHAPE = (
    Field("friction", "1", "Coefficient of sliding friction; a contact has the larger of two.",
        "geom_friction", lambda e: (e.i, 0), **_rubs(3)),
    Field("torsional_friction", "m", "Coefficient of friction against turning on a spot.",
        "geom_friction", lambda e: (e.i, 1), **_rubs(4)),
    Field("rolling_friction", "m", "Coefficient of friction against rolling.",
        "geom_friction", lambda e: (e.i, 2), **_rubs(6)),
    Field("margin", "m", "How far around it contacts act.", "geom_margin", constant=True,
        low=_not_negative, usual=_nonzero, **_TOUCHES),
    Field("gap", "m", "How much further contacts are found without acting.", "geom_gap",
        constant=True, low=0.0, usual=False, **_TOUCHES),
    Field("adhesion", "N", "Force with which its contacts hold on.", "geom_adhesion",
        constant=True, low=0.0, usual=_nonzero, **_TOUCHES),
    Field("surfacevel", "1", "Velocity of its surface in its frame: linear [m/s], angular [rad/s].",
        "geom_surfacevel", constant=True, usual=_nonzero, **_TOUCHES),
    Field("solmix", "1", "Weight of this shape when the solref of a contact is mixed.",
        "geom_solmix", low=0.0, usual=False, **_TOUCHES),
    *_solver("geom", **_TOUCHES),
    Field("size", "m", lambda e: f"{_SIZES[int(e['type'])][1]} of the {_word(e)}; "
        "mass and inertia stay as they are.", "geom_size",
        lambda e: (e.i, _columns(_SIZES[int(e["type"])][0])), constant=True, low=_positive,
        exists=_sized, usual=lambda e, v: any(e.trees.geom(e.i)),
        visual=lambda e: not any(e.trees.geom(e.i))),
    Field("size", "m", "", exists=lambda e: not _sized(e),
        reason="belongs to a shape that only another file can change"),
    Field("color", "1", "Red, green, blue and opacity of the shape.",
        lambda e: partial(color, e.i, int(e["matid"])),
        low=0.0, high=1.0, usual=lambda e, v: e["group"] < _SHOWN, visual=True,
        effect=lambda e: NOTHING),
    *_pose("geom", "shape"),
    *(Field(name, "1", "", reason=_WHOLE) for name in ("contype", "conaffinity", "condim", "type")),
)  # fmt: skip
_PAIR = (
    Field("friction", "1", "Friction of the pair: sliding (2), torsional [m] and rolling [m] (2).",
        "pair_friction", low=0.0, flags=_CONTACT),
    Field("margin", "m", "The margin of contacts of the pair.", "pair_margin", constant=True,
        low=_not_negative, usual=False, flags=_CONTACT),
    Field("gap", "m", "The gap of contacts of the pair.", "pair_gap", constant=True,
        low=_not_negative, usual=False, flags=_CONTACT),
    *_solver("pair", flags=_CONTACT),
)  # fmt: skip


def _stretched(e: Element, _: Floats) -> bool:
    return bool(e["stiffness"] or e["damping"] or e["frictionloss"])


_TENDON = (
    Field("stiffness", "{F}/{L}", "Stiffness of the tendon as a spring.",
        "tendon_stiffness", constant=True, low=0.0, usual=_stretched, flags=_SPRING),
    Field("damping", "{F} s/{L}", "Force against changes of length, for each unit of speed.",
        "tendon_damping", constant=True, low=0.0, usual=_stretched, flags=_DAMPER),
    Field("frictionloss", "{F}", "Dry friction along the tendon.",
        "tendon_frictionloss", constant=True, low=0.0, usual=_stretched, flags=_FRICTION),
    Field("armature", "{I}", "Inertia that the tendon adds.", "tendon_armature",
        constant=True, low=0.0, usual=_nonzero,
        acts=lambda e: not e.trees.links["tendon"][e.i].geoms,
        reason="is not possible: the tendon runs around shapes"),
    Field("springlength", "{L}", "Lengths between which the spring is at rest.",
        "tendon_lengthspring", constant=True, usual=lambda e, v: bool(e["stiffness"]),
        flags=_SPRING),
    Field("range", "{L}", "Shortest and longest length of the tendon.",
        "tendon_range", usual=False, acts=lambda e: e["limited"], reason=_UNLIMITED),
)  # fmt: skip
_CONSTRAINED = (
    Field("active", "1", "Whether the constraint is in force: 1, or 0.",
        "eq_active0 data.eq_active",
        low=0.0, high=1.0, nature="switch", flags=_EQUALITY + _CONSTRAINT),
    *_solver("eq"),
    Field("polycoef", "1", "Coefficients of the polynomial that gives one from the other.",
        "eq_data", lambda e: (e.i, slice(5)), constant=True, usual=False,
        exists=lambda e: e.is_("type", mujoco.mjtEq.mjEQ_JOINT, mujoco.mjtEq.mjEQ_TENDON)),
)  # fmt: skip
_DRIVES: dict[str, Any] = {
    "acts": lambda e: any(e.trees.actuator(e.i)),
    "reason": "acts on nothing: it is off or moves nothing",
}
_SERVO: dict[str, Any] = {"low": 0.0, **_DRIVES}
_AFFINE, _FIXED, _UNBIASED = _BIAS.mjBIAS_AFFINE, _GAIN.mjGAIN_FIXED, _BIAS.mjBIAS_NONE
_ABOUT = "Force of the servo for each unit of"
_ACTUATOR = (
    Field("gear", "1", "Factor from the force of the actuator to that on what it moves.",
        "actuator_gear", lambda e: (int(e["outadr"]), _columns(e.gears)), constant=True,
        exists=lambda e: e.gears > 0, **_DRIVES),
    Field("kp", "{F}/{L}", f"{_ABOUT} distance.",
        _gains(("gainprm", 0, 1), ("biasprm", 1, -1)),
        exists=lambda e: e.servo == "position", **_SERVO),
    Field("kv", "{F} s/{L}", f"{_ABOUT} velocity.", _gains(("biasprm", 2, -1)),
        exists=lambda e: e.servo == "position", **_SERVO),
    Field("kv", "{F} s/{L}", f"{_ABOUT} velocity.",
        _gains(("gainprm", 0, 1), ("biasprm", 2, -1)),
        exists=lambda e: e.servo == "velocity", **_SERVO),
    Field("kv", "1", f"{_ABOUT} velocity and control.", _gains(("gainprm", 2, -1)),
        exists=lambda e: e.servo == "damper", **_SERVO),
    Field("gain", "1", "Force for each unit of control.", "actuator_gainprm", lambda e: (e.i, 0),
        usual=False, exists=lambda e: not e.servo and e.is_("gaintype", _FIXED), **_DRIVES),
    Field("gainprm", "1", "Parameters of its gain, as MuJoCo numbers them.", "actuator_gainprm",
        usual=False, exists=lambda e: not e.servo and not e.is_("gaintype", _FIXED), **_DRIVES),
    Field("bias", "1", "Force without control: constant, for each unit of length, of velocity.",
        "actuator_biasprm", lambda e: (e.i, slice(3)), usual=_nonzero,
        exists=lambda e: not e.servo and e.is_("biastype", _AFFINE), **_DRIVES),
    Field("biasprm", "1", "Parameters of its bias, as MuJoCo numbers them.", "actuator_biasprm",
        usual=False, exists=lambda e: not e.servo and not e.is_("biastype", _AFFINE, _UNBIASED),
        **_DRIVES),
    Field("timeconst", "s", "Time that the activation takes to follow the control.",
        "actuator_dynprm", lambda e: (e.i, _columns(e.times)), low=_positive,
        exists=lambda e: e.times > 0, **_DRIVES),
    Field("ctrlrange", lambda e: control_unit(e.mj, e.i), "Range to which its control is clipped.",
        "actuator_ctrlrange", lambda e: int(e["ctrladr"]), usual=False,
        exists=lambda e: e["ctrlnum"] == 1, acts=lambda e: (
            any(e.trees.actuator(e.i)) and e.mj.actuator_ctrllimited[e["ctrladr"]]),
        reason="is not in force: it is not limited, or the actuator is off"),
    Field("forcerange", "{F}", "Range to which its force is clipped.",
        "actuator_forcerange", usual=False,
        acts=lambda e: any(e.trees.actuator(e.i)) and e["forcelimited"],
        reason="is not in force: it is not limited, or the actuator is off"),
    Field("damping", "1", "The damping that the actuator adds to what it moves.",
        "actuator_damping", constant=True, usual=_nonzero, **_SERVO),
    Field("armature", "1", "The armature that the actuator adds to what it moves.",
        "actuator_armature", constant=True, usual=_nonzero, **_SERVO),
)  # fmt: skip


def _number(name: str) -> Callable[[Element], Finder]:
    return lambda e: partial(option, name)


_OPTION = (
    Field("gravity", "m/s^2", "Acceleration that acts on every mass.",
        "opt.gravity", lambda e: (), flags=_GRAVITY),
    Field("timestep", "s", "Physics step; a control step has a fixed number of them.",
        _number("timestep"), low=SMALLEST),
    Field("wind", "m/s", "Velocity of the medium.", "opt.wind", lambda e: (),
        acts=lambda e: e.trees.fluid, reason="acts on nothing: density and viscosity are zero"),
    Field("density", "kg/m^3", "The density of the medium.", _number("density"), low=0.0,
        usual=lambda e, v: e.trees.fluid),
    Field("viscosity", "Pa s", "The viscosity of the medium.", _number("viscosity"), low=0.0,
        usual=lambda e, v: e.trees.fluid),
    Field("impratio", "1", "Stiffness of friction in relation to that of contact.",
        _number("impratio"), low=SMALLEST, usual=False,
        effect=lambda e: e.trees.touching(e.trees.every)),
)  # fmt: skip


ROWS: dict[str, tuple[Field, ...]] = {
    "body": _BODY, "joint": _JOINT, "geom": _SHAPE, "pair": _PAIR, "site": _pose("site", "site"),
    "tendon": _TENDON, "equality": _CONSTRAINED, "actuator": _ACTUATOR, "option": _OPTION,
}  # fmt: skip
"""The parameters of each kind of elements, in the order in which they are listed."""


def table(mj: mujoco.MjModel, data: mujoco.MjData, trees: Couplings) -> list[Parameter]:
    """List the parameters of a compiled model, each with its own name, also those that are refused.

    Where two elements have the same name and attribute, the usual one keeps the plain name; if
    none or both are usual, both are distinguished by their kind: ``"geom:torso.color"``. So is what
    has the name of a state.

    Args:
        mj: The model.
        data: The state in which episodes begin.
        trees: Of the model.
    """
    names = element_names(mj)
    found: dict[str, list[tuple[str, Parameter]]] = {}
    order = []
    for kind, rows in ROWS.items():
        for i, name in enumerate(names.get(kind, ("",))):
            element = Element(mj, trees, kind, i, name)
            for row in rows if (kind, i) != ("body", 0) else ():  # the world has none
                if row.exists(element):
                    order.append((kind, _parameter(row, element, data)))
                    found.setdefault(order[-1][1].name, []).append(order[-1])
    states = _state_names(mj, names)
    named = []
    for kind, one in order:
        rivals = found[one.name]
        usual = [rival for _, rival in rivals if rival.usual and not rival.refusal]
        alone = len(rivals) == 1 or (len(usual) == 1 and usual[0] is one)
        plain = alone and one.name not in states
        named.append(one if plain else replace(one, name=f"{kind}:{one.name}"))
    return named


def _state_names(mj: mujoco.MjModel, names: Mapping[str, tuple[str, ...]]) -> set[str]:
    """Name the states that have an attribute in common with parameters."""
    found = set()
    for joint, kind in enumerate(mj.jnt_type.tolist()):
        name, body = names["joint"][joint], names["body"][int(mj.jnt_bodyid[joint])]
        if kind in (SLIDE, HINGE):
            found.add(f"{name}.position")
        else:
            found.add(f"{body if kind == FREE else name}.orientation")
    return found


# --- names -------------------------------------------------------------------------------------


def clean(name: str) -> str:
    """Replace what may not stand in the name of an element.

    Example:
        >>> clean("arm/joint.1"), clean("left hand")
        ('arm_joint_1', 'left_hand')
    """
    return re.sub(r"[^\w-]", "_", name)


@lru_cache(maxsize=32)
def element_names(mj: mujoco.MjModel) -> Mapping[str, tuple[str, ...]]:
    """Return the names of elements by kind: their own, cleaned, or names made from their body."""
    found: dict[str, tuple[str, ...]] = {}
    for kind in _NAMED:
        obj, size = getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), f"n{prefix(kind)}"
        given = [mujoco.mj_id2name(mj, obj, i) or "" for i in range(getattr(mj, size))]
        taken: set[str] = set()
        names = [_free(clean(name), taken) if name else "" for name in given]
        for i, name in enumerate(names):
            names[i] = name or _free(_made(mj, kind, i, names, found), taken)
        found[kind] = tuple(names)
    return found


_NAMED = (
    "body", "joint", "geom", "site", "tendon", "equality", "actuator", "pair", "sensor", "flex",
)  # fmt: skip
"""An order in which those come first after which others are named."""


def _free(name: str, taken: set[str]) -> str:
    """Return a name that is not taken, with a number if need be, and take it."""
    free, n = name, 1
    while free in taken:
        n += 1
        free = f"{name}_{n}"
    taken.add(free)
    return free


def _made(
    mj: mujoco.MjModel, kind: str, i: int, names: list[str], found: Mapping[str, tuple[str, ...]]
) -> str:
    """Name an element that has no name: after its body, its shapes or what it acts on."""
    match kind:
        case "body":
            parent = int(mj.body_parentid[i])
            before = int(np.count_nonzero(mj.body_parentid[1:i] == parent))
            return f"{names[parent]}_body_{before}"
        case "joint" | "geom" | "site":
            bodies = getattr(mj, f"{prefix(kind)}_bodyid")
            body = found["body"][int(bodies[i])]
            if kind == "joint" and mj.body_jntnum[bodies[i]] == 1:
                return body
            return f"{body}_{kind}_{int(np.count_nonzero(bodies[:i] == bodies[i]))}"
        case "actuator":
            acts, (target, second) = int(mj.actuator_trntype[i]), mj.actuator_trnid[i].tolist()
            on_site = acts == int(_TRN.mjTRN_SO3) and second >= 0
            of = "site" if on_site else _ACTS_ON.get(acts, "joint")
            return found[of][int(target)]
        case "pair":
            return "_".join(found["geom"][pair[i]] for pair in (mj.pair_geom1, mj.pair_geom2))
        case _:
            return f"{kind}_{i}"


_ACTS_ON = {
    int(_TRN.mjTRN_TENDON): "tendon",
    int(_TRN.mjTRN_SITE): "site",
    int(_TRN.mjTRN_SLIDERCRANK): "site",
    int(_TRN.mjTRN_BODY): "body",
}
