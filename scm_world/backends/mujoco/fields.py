"""The parameters of a compiled model: names, units, bounds, and where each of them is kept.

What may be changed, and what has to follow, is MuJoCo's own table (*Programming, Simulation,
mjModel changes*); every class was tried on foreign models by writing, undoing and comparing all
arrays bit by bit. Since MuJoCo 3.16 ``mj_setConst`` derives the bounds of shapes from their sizes
and places, so that nothing here needs another compilation.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, final

import mujoco
import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.backends.mujoco.slots import Slot
from scm_world.backends.mujoco.trees import NOTHING, Couplings, Effect, disabled
from scm_world.models.model import Model, Numbers
from scm_world.models.scene import ParameterKey

SMALLEST = 1e-9
"""Below this no mass [kg], time [s] or length [m] is accepted."""

MEDIUM = ("density", "viscosity", "wind")
"""Options that act once a medium does."""

GRAY = (0.5, 0.5, 0.5, 1.0)
"""The color of a shape for which MuJoCo takes that of its material."""

_INF = math.inf
_OBJ, _JNT, _GEOM, _TRN, _OFF = (
    mujoco.mjtObj,
    mujoco.mjtJoint,
    mujoco.mjtGeom,
    mujoco.mjtTrn,
    mujoco.mjtDisableBit,
)
_FREE, _BALL, _SLIDE, _HINGE = (
    int(kind) for kind in (_JNT.mjJNT_FREE, _JNT.mjJNT_BALL, _JNT.mjJNT_SLIDE, _JNT.mjJNT_HINGE)
)
_SIZES = {
    int(_GEOM.mjGEOM_SPHERE): ((), "Radius"),
    int(_GEOM.mjGEOM_CAPSULE): ((2,), "Radius and half length of the cylinder part"),
    int(_GEOM.mjGEOM_CYLINDER): ((2,), "Radius and half length"),
    int(_GEOM.mjGEOM_ELLIPSOID): ((3,), "Radii along the axes"),
    int(_GEOM.mjGEOM_BOX): ((3,), "Half edge lengths"),
}


# --- places ------------------------------------------------------------------------------------


@final
@dataclass(frozen=True)
class Place(Slot):
    """Numbers that MuJoCo keeps as they are; a view of any shape."""

    numbers: Floats
    constant: bool = False

    def write(self, value: Floats) -> None:
        """Write all numbers."""
        self.numbers[...] = value

    def read(self) -> Floats:
        """Copy them."""
        return self.numbers.copy()


@final
@dataclass(frozen=True)
class Repeated(Slot):
    """Numbers that stand in several rows, such as the damping of all axes of a ball joint."""

    rows: Floats
    constant: bool = False

    def write(self, value: Floats) -> None:
        """Write every row."""
        self.rows[:] = value

    def read(self) -> Floats:
        """Read the first row."""
        return np.array(self.rows[0])


@final
@dataclass(frozen=True)
class Option(Slot):
    """A number among the options of the model."""

    options: Any
    name: str

    def write(self, value: Floats) -> None:
        """Write it."""
        setattr(self.options, self.name, float(value))

    def read(self) -> Floats:
        """Read it."""
        return np.array(float(getattr(self.options, self.name)))


@final
class Gain(Slot):
    """A gain that stands in two places, once with the other sign.

    Args:
        plus: Views of the places with the sign of the gain.
        minus: Views of those with the other sign. A zero keeps the sign it has now.
    """

    def __init__(self, plus: Sequence[Floats], minus: Sequence[Floats]) -> None:
        self._plus, self._minus = tuple(plus), tuple(minus)
        self._zeros = [np.copysign(0.0, place) for place in self._minus]

    def write(self, value: Floats) -> None:
        """Write it everywhere."""
        for place in self._plus:
            place[...] = value
        for place, zero in zip(self._minus, self._zeros, strict=True):
            place[...] = -value if value else zero

    def read(self) -> Floats:
        """Read the first place."""
        return self._plus[0].copy() if self._plus else 0.0 - self._minus[0]


@final
@dataclass(frozen=True)
class Turn(Slot):
    """A quaternion, which MuJoCo keeps as (w, x, y, z)."""

    numbers: Floats
    constant: bool = False

    def write(self, value: Floats) -> None:
        """Write a quaternion (x, y, z, w)."""
        self.numbers[0], self.numbers[1:] = value[3], value[:3]

    def read(self) -> Floats:
        """Read it as (x, y, z, w)."""
        return self.numbers[[1, 2, 3, 0]]


@final
@dataclass(frozen=True)
class Direction(Slot):
    """A unit vector."""

    numbers: Floats
    constant: bool = True

    def write(self, value: Floats) -> None:
        """Write a vector with the length one."""
        squared = float(value @ value)
        self.numbers[:] = value if abs(squared - 1.0) < 1e-14 else value / math.sqrt(squared)

    def read(self) -> Floats:
        """Copy it."""
        return self.numbers.copy()


@final
class Color(Slot):
    """Red, green, blue and opacity, which MuJoCo keeps as 32 bits each.

    A shape with a material has the color of the material while its own is ``GRAY``.

    Args:
        numbers: Of the shape.
        material: Of its material, or None.
    """

    def __init__(self, numbers: NDArray[np.float32], material: NDArray[np.float32] | None) -> None:
        self._numbers, self._material = numbers, material
        self._inherits = material is not None and self._is_gray()

    def _is_gray(self) -> bool:
        return bool((self._numbers == np.array(GRAY, dtype=np.float32)).all())

    def write(self, value: Floats) -> None:
        """Write a color."""
        self._numbers[:] = value
        if self._inherits and (self._numbers == self._material).all():
            self._numbers[:] = GRAY
        elif self._inherits and self._is_gray():  # as little as can be, so that it is shown
            self._numbers[0] = np.nextafter(np.float32(0.5), np.float32(1.0))

    def read(self) -> Floats:
        """Read it with the digits that 32 bits hold: 0.3 is read as 0.3."""
        found = self._numbers
        if self._inherits and self._material is not None and self._is_gray():
            found = self._material
        return np.array([float(str(number)) for number in found])


# --- names -------------------------------------------------------------------------------------


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


def element_names(mj: mujoco.MjModel) -> dict[str, tuple[str, ...]]:
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


# --- the table ---------------------------------------------------------------------------------


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
    slot: Callable[[mujoco.MjModel, mujoco.MjData | None], Slot] | None
    effect: Callable[[], Effect] = lambda: NOTHING
    low: Numbers = -_INF
    high: Numbers = _INF
    nature: Literal["real", "rotation", "inertia"] = "real"
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


_Slots = Callable[[mujoco.MjModel, mujoco.MjData | None], Slot]


def _at(array: str, *index: Any, constant: bool = False) -> _Slots:
    """Find a place in an array of the model."""
    return lambda mj, _: Place(getattr(mj, array)[(*index, ...)], constant)


def _turn(array: str, *index: Any) -> _Slots:
    """Find a quaternion; constants of the model follow it."""
    return lambda mj, _: Turn(getattr(mj, array)[index], constant=True)


def _rows(array: str, first: int, count: int, *, constant: bool = False) -> _Slots:
    """Find the same number in several rows of an array."""
    return lambda mj, _: Repeated(getattr(mj, array)[first : first + count], constant)


def _least(value: Any) -> float:
    """Give a lower bound for what has to be positive."""
    return min(SMALLEST, float(np.min(value)))


@final
class Table:
    """All parameters of a compiled model, exposed or not, and those that it refuses.

    Args:
        mj: The model. It is only read.
        names: Of its elements.
        trees: Its trees.
        fluid: Whether a medium acts, or may be made to act.
    """

    def __init__(
        self,
        mj: mujoco.MjModel,
        names: Mapping[str, tuple[str, ...]],
        trees: Couplings,
        fluid: bool,
    ) -> None:
        self._mj, self._names, self._trees, self._fluid = mj, names, trees, fluid
        self._flexible = {int(b) for b in (*mj.flex_vertbodyid, *mj.flex_nodebodyid)}

    def fields(self) -> Iterator[Field]:
        """List all fields, element by element."""
        mj = self._mj
        for body in range(1, mj.nbody):
            yield from self._body(body)
        for joint in range(mj.njnt):
            yield from self._joint(joint)
        for geom in range(mj.ngeom):
            yield from self._geom(geom)
        for pair in range(mj.npair):
            yield from self._pair(pair)
        for site in range(mj.nsite):
            yield from self._site(site)
        for tendon in range(mj.ntendon):
            yield from self._tendon(tendon)
        for equality in range(mj.neq):
            yield from self._equality(equality)
        for actuator in range(mj.nactuator):
            yield from self._actuator(actuator)
        yield from self._options()

    def _off(self, flag: mujoco.mjtDisableBit, what: str) -> str:
        """Say that a flag of the model disables something, if it does."""
        return f"acts on nothing: the model disables {what}" if disabled(self._mj, flag) else ""

    # --- bodies --------------------------------------------------------------------------------

    def _body(self, body: int) -> Iterator[Field]:
        mj, name = self._mj, self._names["body"][body]
        moves, mass = mj.body_treeid[body] >= 0, float(mj.body_mass[body])
        static = "" if self._trees.tree(body) >= 0 else "is that of a body that cannot move"
        light = "" if mass > 0.0 else "is zero: the body is a frame without inertia"
        usual = moves and body not in self._flexible

        def effect() -> Effect:
            return self._trees.body(body)

        yield Field(
            "body", name, "mass", "kg", "Mass of the body; its inertia stays as it is.",
            _at("body_mass", body, constant=True), effect,
            low=_least(mass), usual=usual, refusal=static or light,
        )  # fmt: skip
        still = "" if self._turns(body) else "acts on nothing: the body never turns"
        massless = "" if mj.body_inertia[body].all() else "is zero: the body is a point mass"
        yield Field(
            "body", name, "inertia", "kg m^2", "Principal moments of inertia of the body.",
            _at("body_inertia", body, constant=True), effect,
            low=_least(mj.body_inertia[body]), nature="inertia", usual=usual,
            refusal=static or light or massless or (still if moves else ""),
        )  # fmt: skip
        simple = "is fixed by the compiler; write simple='false' at the body"
        yield Field(
            "body", name, "center_of_mass", "m", "Center of mass in the frame of the body.",
            _at("body_ipos", body, constant=True), effect,
            usual=False, refusal=static or light or (simple if mj.body_simple[body] else ""),
        )  # fmt: skip
        yield Field(
            "body", name, "gravcomp", "1", "Share of the weight of the body that is held up.",
            _at("body_gravcomp", body, constant=True), effect,
            usual=usual and mj.body_gravcomp[body] != 0.0,
            refusal=static or light or self._off(_OFF.mjDSBL_GRAVITY, "gravity"),
        )  # fmt: skip
        yield from self._pose_of_body(body, name)

    def _pose_of_body(self, body: int, name: str) -> Iterator[Field]:
        mj, mocap = self._mj, int(self._mj.body_mocapid[body])

        def effect() -> Effect:
            return self._trees.frame(body)

        if mocap >= 0:
            yield Field(
                "body", name, "position", "m", "Place of a body that is moved from outside.",
                lambda _, data: Place(_of(data).mocap_pos[mocap]), effect,
            )  # fmt: skip
            yield Field(
                "body", name, "orientation", "1", "Orientation of a body moved from outside.",
                lambda _, data: Turn(_of(data).mocap_quat[mocap]), effect,
                -1.0, 1.0, nature="rotation",
            )  # fmt: skip
            return
        first = int(mj.body_jntadr[body])
        free = first >= 0 and mj.jnt_type[first] == _FREE
        reason = f"is a state: set {name}.cartesian_position or {name}.orientation" if free else ""
        yield Field(
            "body", name, "position", "m", "Place of the frame of the body in its parent.",
            _at("body_pos", body, constant=True), effect, usual=False, refusal=reason,
        )  # fmt: skip
        if not free:
            yield Field(
                "body", name, "orientation", "1", "Orientation of the body in its parent.",
                _turn("body_quat", body), effect, -1.0, 1.0, nature="rotation", usual=False,
            )  # fmt: skip

    def _turns(self, body: int) -> bool:
        """Tell whether a joint on the way to a body turns it."""
        mj = self._mj
        while body:
            first = int(mj.body_jntadr[body])
            kinds = mj.jnt_type[first : first + int(mj.body_jntnum[body])] if first >= 0 else []
            if any(kind != _SLIDE for kind in kinds):
                return True
            body = int(mj.body_parentid[body])
        return False

    # --- joints --------------------------------------------------------------------------------

    def _joint(self, joint: int) -> Iterator[Field]:
        mj, name, kind = self._mj, self._names["joint"][joint], int(self._mj.jnt_type[joint])
        turns, dof = kind != _SLIDE, int(mj.jnt_dofadr[joint])
        count = {_FREE: 6, _BALL: 3}.get(kind, 1)
        force, angle = ("N m", "rad") if turns else ("N", "m")
        body = int(mj.jnt_bodyid[joint])
        usual = kind != _FREE and body not in self._flexible

        def effect() -> Effect:
            return self._trees.body(body)

        def dofs(array: str, *, constant: bool = False) -> _Slots:
            if count == 1:
                return _at(array, dof, constant=constant)
            return _rows(array, dof, count, constant=constant)

        mixed = kind == _FREE
        per_speed = "1" if mixed else "N m s/rad" if turns else "N s/m"
        undamped = self._off(_OFF.mjDSBL_DAMPER, "damping")
        unsprung = self._off(_OFF.mjDSBL_SPRING, "springs")
        yield Field(
            "joint", name, "damping", per_speed, "Force against the motion, for each unit of it.",
            dofs("dof_damping"), effect, 0.0,
            usual=usual or bool(mj.dof_damping[dof]), refusal=undamped,
        )  # fmt: skip
        inertia = "1" if mixed else "kg m^2" if turns else "kg"
        yield Field(
            "joint", name, "armature", inertia, "Inertia that the joint itself adds.",
            dofs("dof_armature", constant=True), effect, 0.0,
            usual=usual or bool(mj.dof_armature[dof]),
        )  # fmt: skip
        yield Field(
            "joint", name, "frictionloss", "1" if mixed else force,
            "Dry friction: force that motion has to overcome.",
            dofs("dof_frictionloss"), effect, 0.0,
            usual=usual or bool(mj.dof_frictionloss[dof]),
            refusal=self._off(_OFF.mjDSBL_FRICTIONLOSS, "friction loss")
            or self._off(_OFF.mjDSBL_CONSTRAINT, "constraints"),
        )  # fmt: skip
        yield Field(
            "joint", name, "stiffness", "1" if mixed else "N m/rad" if turns else "N/m",
            "Stiffness of a spring that pulls the joint to its springref.",
            _at("jnt_stiffness", joint), effect, 0.0,
            usual=usual or bool(mj.jnt_stiffness[joint]), refusal=unsprung,
        )  # fmt: skip
        if kind in (_SLIDE, _HINGE):
            yield from self._scalar_joint(joint, name, force, angle, effect)

    def _scalar_joint(
        self, joint: int, name: str, force: str, angle: str, effect: Callable[[], Effect]
    ) -> Iterator[Field]:
        mj, place = self._mj, int(self._mj.jnt_qposadr[joint])
        body = int(mj.jnt_bodyid[joint])
        yield Field(
            "joint", name, "springref", angle, "Position in which the spring is at rest.",
            _at("qpos_spring", place, constant=True), effect,
            usual=bool(mj.jnt_stiffness[joint]), refusal=self._off(_OFF.mjDSBL_SPRING, "springs"),
        )  # fmt: skip
        yield Field(
            "joint", name, "ref", angle, "Position of the joint in the pose of the file.",
            _at("qpos0", place, constant=True), effect, usual=False,
        )  # fmt: skip
        unlimited = "" if mj.jnt_limited[joint] else "is not in force: the joint has no limits"
        unlimited = unlimited or self._off(_OFF.mjDSBL_LIMIT, "limits")
        yield Field(
            "joint", name, "range", angle, "Lower and upper limit of the joint.",
            _at("jnt_range", joint), effect, usual=False, refusal=unlimited,
        )  # fmt: skip
        yield Field(
            "joint", name, "margin", angle, "Distance from the limits at which they begin to act.",
            _at("jnt_margin", joint), effect, 0.0, usual=False, refusal=unlimited,
        )  # fmt: skip
        yield from self._solver("joint", name, "limit", "jnt", joint, effect, unlimited)
        clipped = "" if mj.jnt_actfrclimited[joint] else "is not in force: it is not limited"
        yield Field(
            "joint", name, "actuatorfrcrange", force, "Range of the force of all its actuators.",
            _at("jnt_actfrcrange", joint), effect, usual=False, refusal=clipped,
        )  # fmt: skip
        simple = "is fixed by the compiler; write simple='false' at the body"
        simple = simple if mj.body_simple[body] else ""
        yield Field(
            "joint", name, "axis", "1", "Unit vector of the axis in the frame of the body.",
            lambda mj, _: Direction(mj.jnt_axis[joint]), effect, -1.0, 1.0,
            usual=False, refusal=simple,
        )  # fmt: skip
        yield Field(
            "joint", name, "anchor", "m", "Point of the body through which the axis goes.",
            _at("jnt_pos", joint, constant=True), effect, usual=False,
            refusal=simple if mj.jnt_type[joint] == _HINGE else "acts on nothing: the joint slides",
        )  # fmt: skip

    def _solver(
        self,
        kind: str,
        name: str,
        suffix: str,
        prefix: str,
        index: int,
        effect: Callable[[], Effect],
        refusal: str = "",
    ) -> Iterator[Field]:
        """Give how hard and how stiff a constraint is."""
        where = f"{prefix}_solref", f"{prefix}_solimp"
        reference = getattr(self._mj, where[0])[index]
        direct = bool((reference < 0.0).any())
        yield Field(
            kind, name, f"solref{suffix}", "1",
            "Stiffness and damping, both negative, of the constraint." if direct else
            "Time constant [s] and damping ratio of the constraint.",
            _at(where[0], index), effect,
            -_INF if direct else (_least(reference[0]), _least(reference[1])),
            0.0 if direct else _INF, usual=False, refusal=refusal,
        )  # fmt: skip
        yield Field(
            kind, name, f"solimp{suffix}", "1",
            "Smallest and largest impedance, width of the transition, its midpoint and power.",
            _at(where[1], index), effect,
            (0.0, 0.0, 0.0, 0.0, 1.0), (1.0, 1.0, _INF, 1.0, _INF),
            usual=False, refusal=refusal,
        )  # fmt: skip

    # --- shapes --------------------------------------------------------------------------------

    def _geom(self, geom: int) -> Iterator[Field]:
        mj, name = self._mj, self._names["geom"][geom]
        kind, condim = int(mj.geom_type[geom]), self._trees.highest_condim(geom)

        def touch() -> Effect:
            return self._trees.contact_of(geom)

        def shape() -> Effect:
            return self._trees.shape(geom)

        untouched = "" if condim else "acts on nothing: the shape touches nothing"
        smooth = untouched or ("acts on nothing: its contacts have condim 1" if condim < 3 else "")
        for attribute, column, needed, unit, doc in (
            ("friction", 0, 3, "1", "Coefficient of sliding friction; a contact has the larger."),
            ("torsional_friction", 1, 4, "m", "Coefficient of friction against turning on a spot."),
            ("rolling_friction", 2, 6, "m", "Coefficient of friction against rolling."),
        ):
            lower = f"acts on nothing: its contacts have a condim below {needed}"
            yield Field(
                "geom", name, attribute, unit, doc, _at("geom_friction", geom, column), touch, 0.0,
                refusal=smooth or (lower if condim < needed else ""),
            )  # fmt: skip
        yield from self._size(geom, name, kind, shape)
        color = None if mj.geom_matid[geom] < 0 else int(mj.geom_matid[geom])
        yield Field(
            "geom", name, "color", "1", "Red, green, blue and opacity of the shape.",
            lambda mj, _: Color(
                mj.geom_rgba[geom], None if color is None else mj.mat_rgba[color]
            ),
            low=0.0, high=1.0, usual=mj.geom_group[geom] < 3, visual=True,
        )  # fmt: skip
        for attribute, unit, low, doc in (
            (
                "margin",
                "m",
                min(0.0, float(mj.geom_margin[geom])),
                "How far around the shape contacts begin to act.",
            ),
            ("gap", "m", 0.0, "How much further contacts are found without acting."),
            ("solmix", "1", 0.0, "Weight of this shape when the solref of a contact is mixed."),
        ):
            yield Field(
                "geom", name, attribute, unit, doc,
                _at(f"geom_{attribute}", geom, constant=attribute != "solmix"), touch, low,
                usual=attribute == "margin" and bool(mj.geom_margin[geom]), refusal=untouched,
            )  # fmt: skip
        yield from self._solver("geom", name, "", "geom", geom, touch, untouched)
        yield Field(
            "geom", name, "adhesion", "N", "Force with which its contacts hold on.",
            _at("geom_adhesion", geom, constant=True), touch, 0.0,
            usual=bool(mj.geom_adhesion[geom]), refusal=untouched,
        )  # fmt: skip
        yield Field(
            "geom", name, "surfacevel", "1",
            "Velocity of its surface in its own frame, linear [m/s] and angular [rad/s].",
            _at("geom_surfacevel", geom, constant=True), touch,
            usual=bool(mj.geom_surfacevel[geom].any()), refusal=untouched,
        )  # fmt: skip
        yield Field(
            "geom", name, "position", "m", "Place of the shape in the frame of its body.",
            _at("geom_pos", geom, constant=True), shape, usual=False,
        )  # fmt: skip
        yield Field(
            "geom", name, "orientation", "1", "Orientation of the shape in the frame of its body.",
            _turn("geom_quat", geom), shape, -1.0, 1.0, nature="rotation", usual=False,
        )  # fmt: skip
        for attribute in ("contype", "conaffinity", "condim", "type"):
            yield Field(
                "geom", name, attribute, "1", "", None,
                refusal="is a whole number that only another file can change",
            )  # fmt: skip

    def _size(
        self, geom: int, name: str, kind: int, effect: Callable[[], Effect]
    ) -> Iterator[Field]:
        mj = self._mj
        if kind not in _SIZES:
            what = mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower()
            reason = f"is that of a {what}: only another file can change it"
            yield Field("geom", name, "size", "m", "", None, refusal=reason)
            return
        shape, what = _SIZES[kind]
        index = (geom, slice(*shape)) if shape else (geom, 0)
        acts = any(effect())
        yield Field(
            "geom", name, "size", "m",
            f"{what} of the {mujoco.mjtGeom(kind).name.removeprefix('mjGEOM_').lower()}, "
            "as MJCF has it; mass and inertia stay as they are.",
            _at("geom_size", *index, constant=True), effect,
            _least(mj.geom_size[index]), usual=acts, visual=not acts,
        )  # fmt: skip

    def _pair(self, pair: int) -> Iterator[Field]:
        name = self._names["pair"][pair]

        def effect() -> Effect:
            return self._trees.pair(pair)

        off = self._off(_OFF.mjDSBL_CONTACT, "contact")
        yield Field(
            "pair", name, "friction", "1",
            "Friction of the pair: sliding (2), torsional [m] and rolling [m] (2).",
            _at("pair_friction", pair), effect, 0.0, refusal=off,
        )  # fmt: skip
        for attribute, low in (("margin", -_INF), ("gap", 0.0)):
            yield Field(
                "pair", name, attribute, "m", f"The {attribute} of contacts of the pair.",
                _at(f"pair_{attribute}", pair, constant=True), effect, low,
                usual=False, refusal=off,
            )  # fmt: skip
        yield from self._solver("pair", name, "", "pair", pair, effect, off)

    def _site(self, site: int) -> Iterator[Field]:
        name = self._names["site"][site]

        def effect() -> Effect:
            return self._trees.site(site)

        yield Field(
            "site", name, "position", "m", "Place of the site in the frame of its body.",
            _at("site_pos", site, constant=True), effect, usual=False,
        )  # fmt: skip
        yield Field(
            "site", name, "orientation", "1", "Orientation of the site in the frame of its body.",
            _turn("site_quat", site), effect, -1.0, 1.0, nature="rotation", usual=False,
        )  # fmt: skip

    # --- tendons, constraints, actuators -------------------------------------------------------

    def _tendon(self, tendon: int) -> Iterator[Field]:
        mj, name = self._mj, self._names["tendon"][tendon]
        length = tendon_unit(mj, tendon)
        force = {"m": "N", "rad": "N m"}.get(length, "1")
        per = {"m": "N/m", "rad": "N m/rad"}.get(length, "1")
        speed = {"m": "N s/m", "rad": "N m s/rad"}.get(length, "1")
        mass = {"m": "kg", "rad": "kg m^2"}.get(length, "1")
        around = int(mujoco.mjtWrap.mjWRAP_SPHERE), int(mujoco.mjtWrap.mjWRAP_CYLINDER)
        first = int(mj.tendon_adr[tendon])
        path = mj.wrap_type[first : first + int(mj.tendon_num[tendon])]
        wraps = any(kind in around for kind in path)
        active = any(
            getattr(mj, f"tendon_{what}")[tendon]
            for what in ("stiffness", "damping", "frictionloss", "armature")
        )

        def effect() -> Effect:
            return self._trees.tendon(tendon)

        for attribute, unit, flag, doc in (
            ("stiffness", per, _OFF.mjDSBL_SPRING, "Stiffness of the tendon as a spring."),
            ("damping", speed, _OFF.mjDSBL_DAMPER, "Force against changes of length, per speed."),
            ("frictionloss", force, _OFF.mjDSBL_FRICTIONLOSS, "Dry friction along the tendon."),
        ):
            yield Field(
                "tendon", name, attribute, unit, doc,
                _at(f"tendon_{attribute}", tendon, constant=True), effect, 0.0,
                usual=active, refusal=self._off(flag, "it"),
            )  # fmt: skip
        yield Field(
            "tendon", name, "armature", mass, "Inertia that the tendon adds.",
            _at("tendon_armature", tendon, constant=True), effect, 0.0,
            usual=bool(mj.tendon_armature[tendon]),
            refusal="is not possible: the tendon runs around shapes" if wraps else "",
        )  # fmt: skip
        yield Field(
            "tendon", name, "springlength", length, "Lengths between which the spring is at rest.",
            _at("tendon_lengthspring", tendon, constant=True), effect,
            usual=bool(mj.tendon_stiffness[tendon]),
            refusal=self._off(_OFF.mjDSBL_SPRING, "springs"),
        )  # fmt: skip
        unlimited = "" if mj.tendon_limited[tendon] else "is not in force: it has no limits"
        yield Field(
            "tendon", name, "range", length, "Shortest and longest length of the tendon.",
            _at("tendon_range", tendon), effect, usual=False, refusal=unlimited,
        )  # fmt: skip

    def _equality(self, equality: int) -> Iterator[Field]:
        name = self._names["equality"][equality]

        def effect() -> Effect:
            return self._trees.equality(equality)

        yield from self._solver("equality", name, "", "eq", equality, effect)
        if self._mj.eq_type[equality] in (
            int(mujoco.mjtEq.mjEQ_JOINT),
            int(mujoco.mjtEq.mjEQ_TENDON),
        ):
            yield Field(
                "equality", name, "polycoef", "1",
                "Coefficients of the polynomial that gives the first from the second.",
                _at("eq_data", equality, slice(5), constant=True), effect, usual=False,
            )  # fmt: skip

    def _actuator(self, actuator: int) -> Iterator[Field]:
        mj, name = self._mj, self._names["actuator"][actuator]
        first, outputs = int(mj.actuator_outadr[actuator]), int(mj.actuator_outnum[actuator])
        adhesion = mj.actuator_trntype[actuator] == int(_TRN.mjTRN_BODY)

        def effect() -> Effect:
            return self._trees.actuator(actuator)

        off = "" if any(effect()) else "acts on nothing: the actuator is off or moves nothing"
        if outputs == 1 and not adhesion:
            used = _gear_length(mj, actuator)
            index = (first, 0) if used == 1 else (first, slice(used))
            yield Field(
                "actuator", name, "gear", "1", "Factor from the force of the actuator to the joint"
                " or other target, and from its position to that of the actuator.",
                _at("actuator_gear", *index, constant=True), effect, refusal=off,
            )  # fmt: skip
        yield from self._gains(actuator, name, effect, off)
        control = int(mj.actuator_ctrladr[actuator])
        if mj.actuator_ctrlnum[actuator] == 1:
            free = "" if mj.actuator_ctrllimited[control] else "is not in force: it is not limited"
            yield Field(
                "actuator", name, "ctrlrange", "1", "Range to which its control is clipped.",
                _at("actuator_ctrlrange", control), effect, usual=False, refusal=off or free,
            )  # fmt: skip
        free = "" if mj.actuator_forcelimited[actuator] else "is not in force: it is not limited"
        yield Field(
            "actuator", name, "forcerange", "1", "Range to which its force is clipped.",
            _at("actuator_forcerange", actuator), effect, usual=False, refusal=off or free,
        )  # fmt: skip
        for attribute, unit in (("damping", "1"), ("armature", "1")):
            yield Field(
                "actuator", name, attribute, unit,
                f"The {attribute} that the actuator adds to its target.",
                _at(f"actuator_{attribute}", actuator, constant=True), effect, 0.0,
                usual=bool(getattr(mj, f"actuator_{attribute}")[actuator]), refusal=off,
            )  # fmt: skip

    def _gains(
        self, actuator: int, name: str, effect: Callable[[], Effect], off: str
    ) -> Iterator[Field]:
        """Give what makes a control a force: gains of a servo, or whatever the type has."""
        mj = self._mj
        gain, bias = mj.actuator_gainprm[actuator], mj.actuator_biasprm[actuator]
        gains, biases, dynamics = (
            mujoco.mjtGain(int(mj.actuator_gaintype[actuator])),
            mujoco.mjtBias(int(mj.actuator_biastype[actuator])),
            mujoco.mjtDyn(int(mj.actuator_dyntype[actuator])),
        )
        fixed, affine = gains == mujoco.mjtGain.mjGAIN_FIXED, biases == mujoco.mjtBias.mjBIAS_AFFINE

        def servo(
            attribute: str, plus: Sequence[tuple[str, int]], minus: Sequence[tuple[str, int]]
        ) -> Field:
            def slot(mj: mujoco.MjModel, _: Any) -> Slot:
                return Gain(
                    [getattr(mj, array)[actuator, i, ...] for array, i in plus],
                    [getattr(mj, array)[actuator, i, ...] for array, i in minus],
                )

            what = {"kp": "Stiffness", "kv": "Damping"}[attribute]
            return Field(
                "actuator", name, attribute, "1", f"{what} of the servo.",
                slot, effect, 0.0, refusal=off,
            )  # fmt: skip

        def vector(attribute: str, array: str, used: int | slice, doc: str, **rest: Any) -> Field:
            return Field(
                "actuator", name, attribute, rest.pop("unit", "1"), doc,
                _at(array, actuator, used), effect, refusal=off, **rest,
            )  # fmt: skip

        gainprm, biasprm, dynprm = "actuator_gainprm", "actuator_biasprm", "actuator_dynprm"
        position = fixed and affine and bias[0] == 0.0 and gain[0] > 0.0 and bias[1] == -gain[0]
        velocity = fixed and affine and not bias[:2].any() and gain[0] > 0.0 and bias[2] == -gain[0]
        if position and bias[2] <= 0.0:
            yield servo("kp", [(gainprm, 0)], [(biasprm, 1)])
            yield servo("kv", [], [(biasprm, 2)])
        elif velocity:
            yield servo("kv", [(gainprm, 0)], [(biasprm, 2)])
        elif gains == mujoco.mjtGain.mjGAIN_AFFINE and not gain[:2].any() and gain[2] <= 0.0:
            yield servo("kv", [], [(gainprm, 2)])
        elif fixed:
            yield vector("gain", gainprm, 0, "Force for each unit of control.", usual=False)
            if affine:
                yield vector(
                    "bias", biasprm, slice(3),
                    "Force without control: constant, and for each unit of length and velocity.",
                    usual=bool(bias[:3].any()),
                )  # fmt: skip
        else:
            doc = "Parameters of its gain, as MuJoCo numbers them."
            yield vector("gainprm", gainprm, slice(10), doc, usual=False)
            if biases != mujoco.mjtBias.mjBIAS_NONE:
                doc = "Parameters of its bias, as MuJoCo numbers them."
                yield vector("biasprm", biasprm, slice(10), doc, usual=False)
        times = {
            mujoco.mjtDyn.mjDYN_FILTER: 1,
            mujoco.mjtDyn.mjDYN_FILTEREXACT: 1,
            mujoco.mjtDyn.mjDYN_MUSCLE: 2,
        }.get(dynamics, 0)
        if times:
            lengths = mj.actuator_dynprm[actuator, :times]
            yield vector(
                "timeconst", dynprm, 0 if times == 1 else slice(times),
                "Time that the activation takes to follow the control.",
                unit="s", low=_least(lengths),
            )  # fmt: skip

    # --- options -------------------------------------------------------------------------------

    def _options(self) -> Iterator[Field]:
        trees, mj = self._trees, self._mj

        def everything() -> Effect:
            return trees.always(trees.every)

        weightless = self._off(_OFF.mjDSBL_GRAVITY, "gravity")
        yield Field(
            "option", "", "gravity", "m/s^2", "Acceleration that acts on every mass.",
            lambda mj, _: Place(mj.opt.gravity), everything, refusal=weightless,
        )  # fmt: skip
        yield Field(
            "option", "", "timestep", "s",
            "Physics step; a control step has a fixed number of them.",
            lambda mj, _: Option(mj.opt, "timestep"), everything, _least(mj.opt.timestep),
        )  # fmt: skip
        medium = "" if self._fluid else "acts on nothing: density and viscosity are zero"
        yield Field(
            "option", "", "wind", "m/s", "Velocity of the medium.",
            lambda mj, _: Place(mj.opt.wind), everything, refusal=medium,
        )  # fmt: skip
        for attribute, unit in (("density", "kg/m^3"), ("viscosity", "Pa s")):
            yield Field(
                "option", "", attribute, unit, f"The {attribute} of the medium.",
                lambda mj, _, name=attribute: Option(mj.opt, name), everything, 0.0,
                usual=self._fluid,
            )  # fmt: skip
        yield Field(
            "option", "", "impratio", "1", "Stiffness of friction in relation to that of contact.",
            lambda mj, _: Option(mj.opt, "impratio"), lambda: trees.touching(trees.every),
            _least(mj.opt.impratio), usual=False,
        )  # fmt: skip


def _of(data: mujoco.MjData | None) -> mujoco.MjData:
    """Give the data, which holds the places of bodies that are moved from outside."""
    if data is None:
        raise TypeError("this model has mocap bodies: slots() needs the MjData, too")
    return data


def _gear_length(mj: mujoco.MjModel, actuator: int) -> int:
    """Say how many components of the gear are in use."""
    target = int(mj.actuator_trnid[actuator, 0])
    match mujoco.mjtTrn(int(mj.actuator_trntype[actuator])):
        case _TRN.mjTRN_JOINT | _TRN.mjTRN_JOINTINPARENT:
            return {_FREE: 6, _BALL: 3}.get(int(mj.jnt_type[target]), 1)
        case _TRN.mjTRN_SITE:
            return 6
        case _:
            return 1


def tendon_unit(mj: mujoco.MjModel, tendon: int) -> str:
    """Give the unit of the length of a tendon; ``"1"`` where it sums meters and radians."""
    first, count = int(mj.tendon_adr[tendon]), int(mj.tendon_num[tendon])
    if mj.wrap_type[first] != int(mujoco.mjtWrap.mjWRAP_JOINT):
        return "m"
    joints = mj.wrap_objid[first : first + count]
    units = {"m" if mj.jnt_type[joint] == _SLIDE else "rad" for joint in joints}
    return units.pop() if len(units) == 1 else "1"


def table(mj: mujoco.MjModel, *, fluid: bool = False) -> list[Field]:
    """List the parameters of a compiled model, each with its own name.

    Where two elements have the same name and attribute, the usual one keeps the plain name; if
    none or both are usual, both are told apart by their kind: ``"geom:torso.color"``. So is what
    has the name of a state.

    Args:
        mj: The model, which is only read.
        fluid: Whether a medium may be made to act although it does not now.
    """
    fluid = fluid or mj.opt.density > 0.0 or mj.opt.viscosity > 0.0
    names = element_names(mj)
    found = list(Table(mj, names, Couplings(mj, fluid), fluid).fields())
    claims: dict[str, list[Field]] = {}
    for field in found:
        claims.setdefault(field.plain_name, []).append(field)
    states = _state_names(mj, names)
    named = []
    for field in found:
        usual = [rival for rival in claims[field.plain_name] if rival.usual and not rival.refusal]
        alone = len(claims[field.plain_name]) == 1 or (len(usual) == 1 and usual[0] is field)
        plain = alone and field.plain_name not in states
        named.append(
            replace(field, name=field.plain_name if plain else f"{field.kind}:{field.plain_name}")
        )
    return named


def _state_names(mj: mujoco.MjModel, names: Mapping[str, tuple[str, ...]]) -> set[str]:
    """Name the states that have an attribute in common with parameters."""
    found = set()
    for joint, kind in enumerate(mj.jnt_type.tolist()):
        if kind in (_SLIDE, _HINGE):
            found.add(f"{names['joint'][joint]}.position")
        else:
            element = (
                names["body"][mj.jnt_bodyid[joint]] if kind == _FREE else names["joint"][joint]
            )
            found.add(f"{element}.orientation")
    return found


def places(
    mj: mujoco.MjModel, keys: Collection[ParameterKey], data: mujoco.MjData | None = None
) -> dict[ParameterKey, Slot]:
    """Find the places of some parameters in a compiled model; see ``slots``."""
    return {
        field.key: field.slot(mj, data)
        for field in table(mj)
        if field.key in keys and field.slot is not None
    }


def slots(
    mj: mujoco.MjModel, model: Model, data: mujoco.MjData | None = None
) -> dict[ParameterKey, Slot]:
    """Find the place of every parameter of a description in a compiled model.

    What is written there with ``constant`` slots takes effect with ``mj_setConst``.

    Args:
        mj: A copy of what ``compiled(model)`` gives.
        model: Its description.
        data: Where the model is stepped; only models with mocap bodies need it.
    """
    return places(mj, {row.key for row in model.parameters}, data)
