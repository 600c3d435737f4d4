"""The parameters of a compiled model: for each kind of elements a table of rows.

Which fields may be changed, and which follow, is MuJoCo's own table (*Programming, Simulation,
mjModel changes*); every class was tried on foreign models by writing, undoing and comparing all
arrays bit by bit. Since MuJoCo 3.16 ``mj_setConst`` derives the bounds of shapes from their sizes
and places, so that nothing here needs another compilation.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import chain, count
from typing import Any, final

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from scm_world.backends.mujoco.slots import (
    GRAY,
    At,
    Finder,
    color,
    direction,
    gain,
    option,
    place,
    turn,
)
from scm_world.backends.mujoco.trees import NOTHING, Couplings, Effect, disabled
from scm_world.models.model import Numbers, Parameter

_TRN, _WRAP = mujoco.mjtTrn, mujoco.mjtWrap
_GAIN, _BIAS, _DYN, _GEOM = mujoco.mjtGain, mujoco.mjtBias, mujoco.mjtDyn, mujoco.mjtGeom
FREE, BALL, SLIDE, HINGE = (int(getattr(mujoco.mjtJoint, f"mjJNT_{name}")) for name in (
    "FREE", "BALL", "SLIDE", "HINGE",
))  # fmt: skip

FRICTIONS = ("friction", "torsional_friction", "rolling_friction")
MEDIUM = ("density", "viscosity")
"""Options that make a medium act, and wind with it."""

EXTERNAL = (("external_force", "N", slice(3)), ("external_torque", "N m", slice(3, 6)))
"""A wrench on a body, and its columns in ``mjData.xfrc_applied``."""

SCALE = "scale"
"""The factor of mass and inertia of a body: the task derives both from it."""

SMALLEST = 1e-9
"""Below this no mass [kg], time [s] or length [m] is accepted."""

FORCES, INERTIAS = {"m": "N", "rad": "N m"}, {"m": "kg", "rad": "kg m^2"}
"""Units of a force and of an inertia along a coordinate, by its unit."""

Rows = Iterator[Parameter]

# --- units -------------------------------------------------------------------------------------


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


def prefix(kind: str) -> str:
    """Return how MuJoCo calls the arrays of a kind of elements."""
    return {"joint": "jnt", "equality": "eq", "option": "opt"}.get(kind, kind)


def numbers(values: ArrayLike) -> Numbers:
    """Return a default or a bound: one number, or one for each component."""
    found = np.asarray(values, dtype=np.float64)
    return tuple(found.ravel().tolist()) if found.ndim else float(found)


@final
@dataclass(frozen=True)
class Element:
    """A body, joint, shape, ... of a compiled model; ``element["mass"]`` is its entry of an array.

    Attributes:
        mj: The model, which is only read.
        data: The state in which episodes begin.
        trees: Kinematic trees of the model.
        kind: See ``ROWS``.
        i: Its number among those of its kind.
        name: Its name.
    """

    mj: mujoco.MjModel
    data: mujoco.MjData
    trees: Couplings
    kind: str
    i: int
    name: str

    def __getitem__(self, array: str) -> Any:
        return getattr(self.mj, f"{prefix(self.kind)}_{array}")[self.i]

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
    def length(self) -> str:
        """Unit of the coordinate of a joint, a tendon or an actuator."""
        if self.kind == "joint":
            return {SLIDE: "m", FREE: "1"}.get(int(self["type"]), "rad")
        return (tendon_unit if self.kind == "tendon" else _length_unit)(self.mj, self.i)

    def row(
        self,
        attribute: str,
        unit: str,
        doc: str,
        where: str | Finder = "",
        index: Any = None,
        *,
        form: Callable[..., Any] = place,
        constant: bool = False,
        low: Numbers = -math.inf,
        high: Numbers = math.inf,
        usual: bool = True,
        off: str = "",
        acts: bool = True,
        reason: str = "",
        effect: Effect | None = None,
        **rest: Any,
    ) -> Parameter:
        """Return a parameter with its value in the model, and in the data.

        In a unit, {L} is that of the coordinate, {F} of a force and {I} of an inertia along it.
        ``where`` names the arrays of the value (see ``slots.At``) or finds it, ``index`` is its
        place in them (the number of the element if None), and ``form`` makes a slot of the views.
        Constants of the model follow ``constant`` fields (``mj_setConst``). A default below
        ``low`` is the lower bound. The flags ``off`` of the model disable it; where it does not
        act, ``reason`` says why. ``effect`` has the trees it acts on; those of the element if None.
        """
        slot: Finder | None = None
        if callable(where):
            slot = where
        elif where:
            index = self.i if index is None else index
            index = index if isinstance(index, tuple) else (index,)
            slot = At(form, where, index, constant)
        default = np.zeros(()) if slot is None else slot(self.mj, self.data).read()
        if isinstance(low, tuple):
            low = tuple(np.minimum(low, default).tolist())
        elif low > -math.inf:
            low = min(low, float(np.min(default)))
        if "{" in unit:
            length = self.length
            units = {"L": length, "F": FORCES.get(length), "I": INERTIAS.get(length)}
            unit = "1" if length == "1" else unit.format(**units)
        refusal = "" if slot is not None and acts else reason
        for flag in off.split():
            if disabled(self.mj, getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag.upper()}")):
                refusal = f"acts on nothing: the model disables {flag}"
                break
        always, contact = NOTHING
        if not refusal:
            always, contact = effect or getattr(self.trees, self.kind)(self.i)
        return Parameter(
            name=f"{self.name}.{attribute}" if self.name else attribute,
            unit=unit,
            shape=default.shape,
            default=numbers(default),
            low=low,
            high=high,
            doc=doc,
            always=always,
            contact=contact,
            slot=slot,
            body=self.body if self.kind in ("body", "geom") else -1,
            usual=bool(usual),
            refusal=refusal,
            **rest,
        )

    def turn(self, doc: str, array: str, index: Any = None, **rest: Any) -> Parameter:
        """Return an orientation."""
        rest = {"form": turn, "constant": True, "kind": "rotation", **rest}
        return self.row("orientation", "1", doc, array, index, low=-1.0, high=1.0, **rest)

    def pose(self) -> Rows:
        """List where a shape or a site is."""
        where = f"of the {'shape' if self.kind == 'geom' else 'site'} in the frame of its body."
        array = f"{self.kind}_pos"
        yield self.row("position", "m", f"Place {where}", array, constant=True, usual=False)
        yield self.turn(f"Orientation {where}", f"{self.kind}_quat", usual=False)

    def solver(self, suffix: str = "", **rest: Any) -> Rows:
        """List how stiff and how hard a constraint is."""
        array, rest["usual"] = prefix(self.kind), False
        low: Numbers = (SMALLEST, SMALLEST)
        high, doc = math.inf, "Time constant [s] and damping ratio of the constraint."
        if (self["solref"] < 0.0).any():
            low, high = -math.inf, 0.0
            doc = "Stiffness and damping of the constraint, both negative."
        yield self.row(f"solref{suffix}", "1", doc, f"{array}_solref", low=low, high=high, **rest)
        doc = "Smallest and largest impedance, width of the transition, its midpoint and power."
        rest |= {"low": (0.0, 0.0, 0.0, 0.0, 1.0), "high": (1.0, 1.0, math.inf, 1.0, math.inf)}
        yield self.row(f"solimp{suffix}", "1", doc, f"{array}_solimp", **rest)


_UNLIMITED = "is not in force: it has no limits"
_SIMPLE = "is fixed by the compiler; write simple='false' at the body"
SHOWN = 3
"""MuJoCo draws the first groups of shapes unless asked for others. Source: mjv_defaultOption."""

_SIZES = {
    int(_GEOM.mjGEOM_SPHERE): (1, "Radius"),
    int(_GEOM.mjGEOM_CAPSULE): (2, "Radius, and half length of the cylinder part,"),
    int(_GEOM.mjGEOM_CYLINDER): (2, "Radius and half length"),
    int(_GEOM.mjGEOM_ELLIPSOID): (3, "Radii along the axes"),
    int(_GEOM.mjGEOM_BOX): (3, "Half edge lengths"),
}


def _columns(n: int) -> int | slice:
    """Return the first columns of an array: a number, or a slice of several."""
    return 0 if n == 1 else slice(n)


# fmt: off
def _body(e: Element) -> Rows:
    mj, moves, heavy = e.mj, e.moves, e.trees.tree(e.i) >= 0 and e["mass"] > 0.0
    joints, body = list[int](), e.i  # kinds of those on the way to the world
    while body:
        first = int(mj.body_jntadr[body])
        joints += mj.jnt_type[first : first + int(mj.body_jntnum[body])].tolist()
        body = int(mj.body_parentid[body])
    turns = mj.body_treeid[e.i] < 0 or any(kind != SLIDE for kind in joints)
    weightless = "acts on nothing: the body cannot move, or has no mass"
    yield e.row("mass", "kg", "Mass of the body; its inertia stays as it is.", "body_mass",
        constant=True, low=SMALLEST, usual=moves, acts=heavy, reason=weightless)
    yield e.row("inertia", "kg m^2", "Principal moments of inertia of the body.", "body_inertia",
        constant=True, low=SMALLEST, kind="inertia", usual=moves,
        acts=heavy and e["inertia"].all() and turns,
        reason="acts on nothing: the body never turns, or has no inertia")
    yield e.row("center_of_mass", "m", "Center of mass in the frame of the body.", "body_ipos",
        constant=True, usual=False, acts=heavy and not e["simple"],
        reason=f"{_SIMPLE}, unless it has no mass")
    yield e.row("principal_axes", "1",
        "Orientation of the principal axes of inertia in the frame of the body.", "body_iquat",
        form=turn, kind="rotation", constant=True, low=-1.0, high=1.0, usual=False,
        acts=heavy and e["inertia"].all() and turns and not e["simple"],
        reason=f"{_SIMPLE}, unless it never turns or has no inertia")
    yield e.row("gravcomp", "1", "Share of the weight of the body that is held up.",
        "body_gravcomp", constant=True, usual=moves and e["gravcomp"], off="gravity", acts=heavy,
        reason=weightless)
    for attribute, unit, columns in EXTERNAL:
        yield e.row(attribute, unit,
            "What pushes the body from outside: at its center of mass, in the frame of the world.",
            "data.xfrc_applied", (e.i, columns), usual=False, acts=heavy, reason=weightless)
    scale = e.row(SCALE, "1", "Factor of the mass and of the moments of inertia of the body.",
        usual=False, reason="" if heavy else weightless)
    yield replace(scale, default=1.0, low=SMALLEST)
    effect, mocap, joint = e.trees.frame(e.i), int(e["mocapid"]), int(e["jntadr"])
    if mocap >= 0:
        yield e.row("position", "m", "Place of a body that is moved from outside.",
            "data.mocap_pos", mocap, effect=effect)
        yield e.turn("Orientation of a body that is moved from outside.", "data.mocap_quat",
            mocap, constant=False, effect=effect)
    elif joint >= 0 and mj.jnt_type[joint] == FREE:
        yield e.row("position", "m", "", usual=False,
            reason=f"is a state: set {e.name}.cartesian_position")
    else:
        yield e.row("position", "m", "Place of the frame of the body in its parent.", "body_pos",
            constant=True, usual=False, effect=effect)
        yield e.turn("Orientation of the body in its parent.", "body_quat", usual=False,
            effect=effect)


def _joint(e: Element) -> Rows:
    kind, first, position = int(e["type"]), int(e["dofadr"]), int(e["qposadr"])
    axes, usual = {FREE: 6, BALL: 3}.get(kind, 1), kind != FREE and e.moves  # FREE mixes units
    dofs = first if axes == 1 else slice(first, first + axes)
    for attribute, unit, doc, constant, off in (
        ("damping", "{F} s/{L}", "Force against the motion, for each unit of velocity.", False,
            "damper"),
        ("armature", "{I}", "Inertia that the joint itself adds.", True, ""),
        ("frictionloss", "{F}", "Dry friction: the force that motion has to overcome.", False,
            "frictionloss constraint"),
    ):
        values = np.atleast_1d(getattr(e.mj, f"dof_{attribute}")[dofs])
        yield e.row(attribute, unit, doc, f"dof_{attribute}", dofs, constant=constant, low=0.0,
            usual=usual or values[0], off=off, acts=np.ptp(values) == 0.0,
            reason="is not the same about all axes of the joint")
    yield e.row("stiffness", "{F}/{L}", "Stiffness of a spring that pulls to springref.",
        "jnt_stiffness", low=0.0, usual=usual or e["stiffness"], off="spring")
    if kind not in (SLIDE, HINGE):
        return
    yield e.row("springref", "{L}", "Position in which the spring is at rest.", "qpos_spring",
        position, constant=True, usual=e["stiffness"], off="spring")
    yield e.row("ref", "{L}", "Position of the joint in the pose of the file.", "qpos0", position,
        constant=True, usual=False)
    limits: dict[str, Any] = {"usual": False, "off": "limit"}
    limits |= {"acts": e["limited"], "reason": _UNLIMITED}
    yield e.row("range", "{L}", "Lower and upper limit of the joint.", "jnt_range", **limits)
    yield e.row("margin", "{L}", "Distance from the limits at which they begin to act.",
        "jnt_margin", low=0.0, **limits)
    yield from e.solver("limit", **limits)
    yield e.row("actuatorfrcrange", "{F}", "Range of the force of all its actuators.",
        "jnt_actfrcrange", usual=False, acts=e["actfrclimited"], reason=_UNLIMITED)
    placed = not e.mj.body_simple[e.body]
    yield e.row("axis", "1", "Unit vector of the axis in the frame of the body.", "jnt_axis",
        form=direction, low=-1.0, high=1.0, usual=False, acts=placed, reason=_SIMPLE)
    yield e.row("anchor", "m", "Point of the body through which the axis goes.", "jnt_pos",
        constant=True, usual=False, acts=kind != SLIDE and placed,
        reason=f"acts on nothing if the joint slides; otherwise it {_SIMPLE}")


def _shape(e: Element) -> Rows:
    touching, condim = e.trees.contact_of(e.i), e.trees.highest_condim(e.i)
    for column, (attribute, unit, doc, least) in enumerate((
        ("friction", "1", "Coefficient of sliding friction; a contact has the larger of two.", 3),
        ("torsional_friction", "m", "Coefficient of friction against turning on a spot.", 4),
        ("rolling_friction", "m", "Coefficient of friction against rolling.", 6),
    )):
        yield e.row(attribute, unit, doc, "geom_friction", (e.i, column), low=0.0,
            acts=condim >= least, effect=touching,
            reason="acts on nothing: its contacts have a smaller condim, or there are none")
    touches: dict[str, Any] = {"acts": condim > 0, "effect": touching}
    touches["reason"] = "acts on nothing: the shape touches nothing"
    yield e.row("margin", "m", "How far around it contacts act.", "geom_margin", constant=True,
        low=0.0, usual=e["margin"], **touches)
    yield e.row("gap", "m", "How much further contacts are found without acting.", "geom_gap",
        constant=True, low=0.0, usual=False, **touches)
    yield e.row("adhesion", "N", "Force with which its contacts hold on.", "geom_adhesion",
        constant=True, low=0.0, usual=e["adhesion"], **touches)
    yield e.row("surfacevel", "1",
        "Velocity of its surface in its frame: linear [m/s], angular [rad/s].",
        "geom_surfacevel", constant=True, usual=e["surfacevel"].any(), **touches)
    yield e.row("solmix", "1", "Weight of this shape when the solref of a contact is mixed.",
        "geom_solmix", low=0.0, usual=False, **touches)
    yield from e.solver(**touches)
    kind, effect = int(e["type"]), e.trees.geom(e.i)
    if kind in _SIZES:
        columns, what = _SIZES[kind]
        word = mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower()
        yield e.row("size", "m", f"{what} of the {word}; mass and inertia stay as they are.",
            "geom_size", (e.i, _columns(columns)), constant=True, low=SMALLEST, usual=any(effect),
            visual=not any(effect), effect=effect)
    else:
        yield e.row("size", "m", "", reason="belongs to a shape that only another file can change")
    material = int(e["matid"]) if (e["rgba"] == GRAY).all() else -1
    yield e.row("color", "1", "Red, green, blue and opacity of the shape.",
        partial(color, e.i, material), low=0.0, high=1.0, usual=e["group"] < SHOWN,
        visual=True, effect=NOTHING)
    yield from e.pose()
    whole = "is a whole number that only another file can change"
    for attribute in ("contype", "conaffinity", "condim", "type"):
        yield e.row(attribute, "1", "", reason=whole)


def _pair(e: Element) -> Rows:
    yield e.row("friction", "1",
        "Friction of the pair: sliding (2), torsional [m] and rolling [m] (2).", "pair_friction",
        low=0.0, off="contact")
    for what in ("margin", "gap"):
        yield e.row(what, "m", f"The {what} of contacts of the pair.", f"pair_{what}",
            constant=True, low=0.0, usual=False, off="contact")
    yield from e.solver(off="contact")


def _tendon(e: Element) -> Rows:
    stretched = e["stiffness"] or e["damping"] or e["frictionloss"]
    yield e.row("stiffness", "{F}/{L}", "Stiffness of the tendon as a spring.",
        "tendon_stiffness", constant=True, low=0.0, usual=stretched, off="spring")
    yield e.row("damping", "{F} s/{L}", "Force against changes of length, for each unit of speed.",
        "tendon_damping", constant=True, low=0.0, usual=stretched, off="damper")
    yield e.row("frictionloss", "{F}", "Dry friction along the tendon.",
        "tendon_frictionloss", constant=True, low=0.0, usual=stretched, off="frictionloss")
    yield e.row("armature", "{I}", "Inertia that the tendon adds.", "tendon_armature",
        constant=True, low=0.0, usual=e["armature"],
        acts=not e.trees.links["tendon"][e.i].geoms,
        reason="is not possible: the tendon runs around shapes")
    yield e.row("springlength", "{L}", "Lengths between which the spring is at rest.",
        "tendon_lengthspring", constant=True, usual=e["stiffness"], off="spring")
    yield e.row("range", "{L}", "Shortest and longest length of the tendon.", "tendon_range",
        usual=False, acts=e["limited"], reason=_UNLIMITED)


def _equality(e: Element) -> Rows:
    yield e.row("active", "1", "Whether the constraint is in force: 1, or 0.",
        "eq_active0 data.eq_active", low=0.0, high=1.0, kind="switch", off="equality constraint")
    yield from e.solver()
    if mujoco.mjtEq(int(e["type"])) in (mujoco.mjtEq.mjEQ_JOINT, mujoco.mjtEq.mjEQ_TENDON):
        yield e.row("polycoef", "1",
            "Coefficients of the polynomial that gives one from the other.", "eq_data",
            (e.i, slice(5)), constant=True, usual=False)


_GEARS = {int(_TRN.mjTRN_SITE): 6, int(_TRN.mjTRN_TENDON): 1, int(_TRN.mjTRN_SLIDERCRANK): 1}
"""How many components of the gear count, by transmission, if it is not to a joint."""
_TIMES = {int(_DYN.mjDYN_FILTER): 1, int(_DYN.mjDYN_FILTEREXACT): 1, int(_DYN.mjDYN_MUSCLE): 2}
"""How many time constants there are, by kind of dynamics."""
_GAIN_KP, _BIAS_KP, _BIAS_KV = ("gainprm", 0, 1), ("biasprm", 1, -1), ("biasprm", 2, -1)
"""Arrays of gains of servos, each with a column and a sign."""


def _actuator(e: Element) -> Rows:
    drives, gears = any(e.trees.actuator(e.i)), _GEARS.get(int(e["trntype"]), 0)
    always, contact = e.trees.actuator(e.i)
    driven = always | e.trees.inner(e.i), contact
    acts: dict[str, Any] = {"acts": drives}
    acts["reason"] = "acts on nothing: it is off or moves nothing"
    if e["trntype"] in (int(_TRN.mjTRN_JOINT), int(_TRN.mjTRN_JOINTINPARENT)):
        gears = {FREE: 6, BALL: 3}.get(int(e.mj.jnt_type[e["trnid"][0]]), 1)
    if gears:
        yield e.row("gear", "1", "Factor from the force of the actuator to that on its target.",
            "actuator_gear", (int(e["outadr"]), _columns(gears)), constant=True, **acts)
    kind, about = servo(e.mj, e.i), "Force of the servo for each unit of"
    for which, attribute, unit, what, places in (
        ("position", "kp", "{F}/{L}", "distance", (_GAIN_KP, _BIAS_KP)),
        ("position", "kv", "{F} s/{L}", "velocity", (_BIAS_KV,)),
        ("velocity", "kv", "{F} s/{L}", "velocity", (_GAIN_KP, _BIAS_KV)),
        ("damper", "kv", "1", "velocity and control", (("gainprm", 2, -1),)),
    ):
        if which == kind:
            signs = tuple(float(np.copysign(0.0, e[array][column])) for array, column, _ in places)
            yield e.row(attribute, unit, f"{about} {what}.", partial(gain, e.i, places, signs),
                low=0.0, **acts)  # a negative zero stays one
    gains, bias = _GAIN(int(e["gaintype"])), _BIAS(int(e["biastype"]))
    if not kind and gains == _GAIN.mjGAIN_FIXED:
        yield e.row("gain", "1", "Force for each unit of control.", "actuator_gainprm", (e.i, 0),
            usual=False, **acts)
    elif not kind:
        yield e.row("gainprm", "1", "Parameters of its gain, as MuJoCo numbers them.",
            "actuator_gainprm", usual=False, **acts)
    if not kind and bias == _BIAS.mjBIAS_AFFINE:
        yield e.row("bias", "1",
            "Force without control: constant, for each unit of length, of velocity.",
            "actuator_biasprm", (e.i, slice(3)), usual=e["biasprm"][:3].any(), **acts)
    elif not kind and bias != _BIAS.mjBIAS_NONE:
        yield e.row("biasprm", "1", "Parameters of its bias, as MuJoCo numbers them.",
            "actuator_biasprm", usual=False, **acts)
    times = _TIMES.get(int(e["dyntype"]), 0)
    if times:
        yield e.row("timeconst", "s", "Time that the activation takes to follow the control.",
            "actuator_dynprm", (e.i, _columns(times)), low=SMALLEST, effect=driven, **acts)
    unlimited = "is not in force: it is not limited, or the actuator is off"
    if e["ctrlnum"] == 1:
        control = int(e["ctrladr"])
        yield e.row("ctrlrange", control_unit(e.mj, e.i), "Range to which its control is clipped.",
            "actuator_ctrlrange", control, usual=False, effect=driven,
            acts=drives and e.mj.actuator_ctrllimited[control], reason=unlimited)
    yield e.row("forcerange", "{F}", "Range to which its force is clipped.",
        "actuator_forcerange", usual=False, acts=drives and e["forcelimited"], reason=unlimited)
    for what in ("damping", "armature"):
        yield e.row(what, "1", f"The {what} that the actuator adds to its target.",
            f"actuator_{what}", constant=True, low=0.0, usual=e[what], **acts)


def _option(e: Element) -> Rows:
    fluid, touching = e.trees.fluid, e.trees.touching(e.trees.every)
    yield e.row("gravity", "m/s^2", "Acceleration that acts on every mass.", "opt.gravity", (),
        off="gravity")
    inner = frozenset[int]().union(*map(e.trees.inner, e.trees.inners))
    yield e.row("timestep", "s", "Physics step; a control step has a fixed number of them.",
        partial(option, "timestep"), low=SMALLEST, effect=(e.trees.every | inner, frozenset()))
    yield e.row("wind", "m/s", "Velocity of the medium.", "opt.wind", (), acts=fluid,
        reason="acts on nothing: density and viscosity are zero")
    for what, unit in zip(MEDIUM, ("kg/m^3", "Pa s"), strict=True):
        yield e.row(what, unit, f"The {what} of the medium.", partial(option, what), low=0.0,
            usual=fluid)
    yield e.row("impratio", "1", "Stiffness of friction in relation to that of contact.",
        partial(option, "impratio"), low=SMALLEST, usual=False, effect=touching)
# fmt: on


ROWS: dict[str, Callable[[Element], Rows]] = {
    "body": _body, "joint": _joint, "geom": _shape, "pair": _pair, "site": Element.pose,
    "tendon": _tendon, "equality": _equality, "actuator": _actuator, "option": _option,
}  # fmt: skip
"""The parameters of each kind of elements, in the order in which they are listed."""


def table(mj: mujoco.MjModel, data: mujoco.MjData, trees: Couplings) -> list[Parameter]:
    """List the parameters of a compiled model, each with its own name, also those that are refused.

    Where two elements have the same name and attribute, the usual one keeps the plain name; if
    none or both are usual, both are distinguished by their kind: ``"geom:torso.color"``. So is what
    has the name of a state. The data are those of the beginning.
    """
    names, found = element_names(mj), list[tuple[str, Parameter]]()
    for kind, rows in ROWS.items():
        for i, name in enumerate(names.get(kind, ("",))):
            if (kind, i) != ("body", 0):  # the world has none
                found += ((kind, row) for row in rows(Element(mj, data, trees, kind, i, name)))
    states = set()  # names that parameters could have, too
    for name, body, kind in zip(names["joint"], mj.jnt_bodyid, mj.jnt_type, strict=True):
        owner = names["body"][int(body)] if kind == FREE else name
        states.add(f"{owner}.{'position' if kind in (SLIDE, HINGE) else 'orientation'}")
    alike = Counter(row.name for _, row in found)
    usual = Counter(row.name for _, row in found if row.usual and not row.refusal)
    return [
        row
        if row.name not in states
        and (alike[row.name] == 1 or (usual[row.name] == 1 and row.usual and not row.refusal))
        else replace(row, name=f"{kind}:{row.name}")
        for kind, row in found
    ]


# --- names -------------------------------------------------------------------------------------


def clean(name: str) -> str:
    """Replace what may not stand in the name of an element."""
    return re.sub(r"[^\w-]", "_", name)


_NAMED = (
    "body", "joint", "geom", "site", "tendon", "equality", "actuator", "pair", "sensor", "flex",
)  # fmt: skip
"""An order in which those come first after which others are named."""


@lru_cache(maxsize=2)  # a model is read in several steps
def element_names(mj: mujoco.MjModel) -> Mapping[str, tuple[str, ...]]:
    """Return the names of elements by kind: their own, cleaned, or names made from their body."""
    found: dict[str, tuple[str, ...]] = {}
    for kind in _NAMED:
        obj, size = getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), f"n{prefix(kind)}"
        given = [mujoco.mj_id2name(mj, obj, i) or "" for i in range(getattr(mj, size))]
        names, taken = [""] * len(given), set[str]()
        for i in sorted(range(len(given)), key=lambda i: not given[i]):  # those with names first
            plain = clean(given[i]) if given[i] else _made(mj, kind, i, names, found)
            numbered = (f"{plain}_{n}" for n in count(2))
            names[i] = next(name for name in chain([plain], numbered) if name not in taken)
            taken.add(names[i])
        found[kind] = tuple(names)
    return found


def _made(
    mj: mujoco.MjModel, kind: str, i: int, names: list[str], found: Mapping[str, tuple[str, ...]]
) -> str:
    """Name an element that has no name: after its body, its shapes or its target."""
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
