"""Parameters of bodies, joints, shapes, declared pairs of shapes, and sites."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

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
    repeated_at,
    solver_rows,
    turn_at,
)
from scm_world.backends.mujoco.slots import color, direction, place, turn
from scm_world.backends.mujoco.trees import NOTHING

_SIMPLE = "is fixed by the compiler; write simple='false' at the body"
_GEOM = mujoco.mjtGeom
_SIZES = {
    int(_GEOM.mjGEOM_SPHERE): (1, "Radius"),
    int(_GEOM.mjGEOM_CAPSULE): (2, "Radius, and half length of the cylinder part,"),
    int(_GEOM.mjGEOM_CYLINDER): (2, "Radius and half length"),
    int(_GEOM.mjGEOM_ELLIPSOID): (3, "Radii along the axes"),
    int(_GEOM.mjGEOM_BOX): (3, "Half edge lengths"),
}
_FRICTIONS = (
    ("friction", 3, "1", "Coefficient of sliding friction; a contact has the larger of two."),
    ("torsional_friction", 4, "m", "Coefficient of friction against turning on a spot."),
    ("rolling_friction", 6, "m", "Coefficient of friction against rolling."),
)
FRICTIONS = tuple(attribute for attribute, *_ in _FRICTIONS)
_SHOWN = 3
"""MuJoCo draws the first groups of shapes unless it is asked for others."""


def bodies(scope: Scope) -> Iterator[Field]:
    """List the fields of all bodies but the world."""
    for body in range(1, scope.mj.nbody):
        yield from _body(scope, body)


def _flexible(scope: Scope, body: int) -> bool:
    """Tell whether a body is but a vertex of a flex."""
    return body in scope.mj.flex_vertbodyid or body in scope.mj.flex_nodebodyid


def _body(scope: Scope, body: int) -> Iterator[Field]:
    """Give the inertia of a body, and its place."""
    mj, trees = scope.mj, scope.trees
    row = scope.rows("body", body, partial(trees.body, body))
    moves, mocap = mj.body_treeid[body] >= 0, int(mj.body_mocapid[body])
    usual = moves and not _flexible(scope, body)
    mass, inertia = mj.body_mass[body], mj.body_inertia[body]
    without = "" if trees.tree(body) >= 0 else "is that of a body that cannot move"
    without = without or ("" if mass > 0.0 else "is zero: the body is a frame without inertia")
    yield row(
        "mass", "kg", "Mass of the body; its inertia stays as it is.",
        at("body_mass", body, constant=True), low=least(mass), usual=usual, refusal=without,
    )  # fmt: skip
    round_ = "" if inertia.all() else "is zero: the body is a point mass"
    if moves and not _turns(mj, body):
        round_ = "acts on nothing: the body never turns"
    yield row(
        "inertia", "kg m^2", "Principal moments of inertia of the body.",
        at("body_inertia", body, constant=True), low=least(inertia), nature="inertia",
        usual=usual, refusal=without or round_,
    )  # fmt: skip
    yield row(
        "center_of_mass", "m", "Center of mass in the frame of the body.",
        at("body_ipos", body, constant=True), usual=False,
        refusal=without or (_SIMPLE if mj.body_simple[body] else ""),
    )  # fmt: skip
    yield row(
        "gravcomp", "1", "Share of the weight of the body that is held up.",
        at("body_gravcomp", body, constant=True), usual=usual and mj.body_gravcomp[body] != 0.0,
        refusal=without or scope.off(OFF.mjDSBL_GRAVITY, "gravity"),
    )  # fmt: skip
    row = scope.rows("body", body, partial(trees.frame, body))
    first = int(mj.body_jntadr[body])
    if mocap >= 0:
        yield row(
            "position", "m", "Place of a body that is moved from outside.",
            lambda _, data: place(data.mocap_pos[mocap]),
        )  # fmt: skip
        yield row(
            "orientation", "1", "Orientation of a body that is moved from outside.",
            lambda _, data: turn(data.mocap_quat[mocap], constant=False),
            low=-1.0, high=1.0, nature="rotation",
        )  # fmt: skip
    elif first >= 0 and mj.jnt_type[first] == FREE:
        reason = f"is a state: set {scope.names['body'][body]}.cartesian_position"
        yield row("position", "m", "", None, usual=False, refusal=reason)
    else:
        yield row(
            "position", "m", "Place of the frame of the body in its parent.",
            at("body_pos", body, constant=True), usual=False,
        )  # fmt: skip
        yield row(
            "orientation", "1", "Orientation of the body in its parent.",
            turn_at("body_quat", body), low=-1.0, high=1.0, nature="rotation", usual=False,
        )  # fmt: skip


def _turns(mj: mujoco.MjModel, body: int) -> bool:
    """Tell whether a joint on the way to a body turns it."""
    while body:
        first = int(mj.body_jntadr[body])
        if any(mj.jnt_type[first : first + int(mj.body_jntnum[body])] != SLIDE):
            return True
        body = int(mj.body_parentid[body])
    return False


def joints(scope: Scope) -> Iterator[Field]:
    """List the fields of all joints."""
    for joint, kind in enumerate(scope.mj.jnt_type.tolist()):
        row = scope.rows("joint", joint, partial(scope.trees.body, int(scope.mj.jnt_bodyid[joint])))
        yield from _resistance(scope, joint, kind, row)
        if kind in (SLIDE, HINGE):
            yield from _scalar(scope, joint, row)


def _resistance(scope: Scope, joint: int, kind: int, row: Callable[..., Field]) -> Iterator[Field]:
    """Give what resists the motion of a joint; a free joint mixes units."""
    mj, dof = scope.mj, int(scope.mj.jnt_dofadr[joint])
    count, column = {FREE: (6, 2), BALL: (3, 0), HINGE: (1, 0), SLIDE: (1, 1)}[kind]
    usual = kind != FREE and not _flexible(scope, int(mj.jnt_bodyid[joint]))
    undamped = scope.off(OFF.mjDSBL_DAMPER, "damping")
    smooth = scope.off(OFF.mjDSBL_FRICTIONLOSS, "friction loss")
    smooth = smooth or scope.off(OFF.mjDSBL_CONSTRAINT, "constraints")
    unsprung = scope.off(OFF.mjDSBL_SPRING, "springs")

    def dofs(array: str, *, constant: bool = False) -> Slots:
        if count == 1:
            return at(array, dof, constant=constant)
        return repeated_at(array, slice(dof, dof + count), constant=constant)

    for attribute, units, slot, present, refusal, doc in (
        ("damping", ("N m s/rad", "N s/m", "1"), dofs("dof_damping"), mj.dof_damping[dof],
         undamped, "Force against the motion, for each unit of velocity."),
        ("armature", ("kg m^2", "kg", "1"), dofs("dof_armature", constant=True),
         mj.dof_armature[dof], "", "Inertia that the joint itself adds."),
        ("frictionloss", ("N m", "N", "1"), dofs("dof_frictionloss"), mj.dof_frictionloss[dof],
         smooth, "Dry friction: the force that motion has to overcome."),
        ("stiffness", ("N m/rad", "N/m", "1"), at("jnt_stiffness", joint),
         mj.jnt_stiffness[joint], unsprung, "Stiffness of a spring that pulls to springref."),
    ):  # fmt: skip
        axes = getattr(mj, f"dof_{attribute}", mj.jnt_stiffness[:1])[dof : dof + count]
        alike = bool((axes == axes[:1]).all())  # else one number could not say what the file says
        yield row(
            attribute, units[column], doc, slot, low=0.0, usual=usual or bool(present),
            refusal=refusal if alike else "is not the same about all axes of the joint",
        )  # fmt: skip


def _scalar(scope: Scope, joint: int, row: Callable[..., Field]) -> Iterator[Field]:
    """Give where a hinge or slide is at rest, where it ends, and its axis."""
    mj, place_ = scope.mj, int(scope.mj.jnt_qposadr[joint])
    slides = mj.jnt_type[joint] == SLIDE
    length, force = ("m", "N") if slides else ("rad", "N m")
    yield row(
        "springref", length, "Position in which the spring is at rest.",
        at("qpos_spring", place_, constant=True), usual=bool(mj.jnt_stiffness[joint]),
        refusal=scope.off(OFF.mjDSBL_SPRING, "springs"),
    )  # fmt: skip
    yield row(
        "ref", length, "Position of the joint in the pose of the file.",
        at("qpos0", place_, constant=True), usual=False,
    )  # fmt: skip
    free = "" if mj.jnt_limited[joint] else "is not in force: the joint has no limits"
    free = free or scope.off(OFF.mjDSBL_LIMIT, "limits")
    yield row(
        "range", length, "Lower and upper limit of the joint.",
        at("jnt_range", joint), usual=False, refusal=free,
    )  # fmt: skip
    yield row(
        "margin", length, "Distance from the limits at which they begin to act.",
        at("jnt_margin", joint), low=0.0, usual=False, refusal=free,
    )  # fmt: skip
    yield from solver_rows(row, mj, "jnt", joint, suffix="limit", usual=False, refusal=free)
    weak = "" if mj.jnt_actfrclimited[joint] else "is not in force: it is not limited"
    yield row(
        "actuatorfrcrange", force, "Range of the force of all its actuators.",
        at("jnt_actfrcrange", joint), usual=False, refusal=weak,
    )  # fmt: skip
    simple = _SIMPLE if mj.body_simple[mj.jnt_bodyid[joint]] else ""
    yield row(
        "axis", "1", "Unit vector of the axis in the frame of the body.",
        lambda mj, _: direction(mj.jnt_axis[joint]), low=-1.0, high=1.0, usual=False,
        refusal=simple,
    )  # fmt: skip
    yield row(
        "anchor", "m", "Point of the body through which the axis goes.",
        at("jnt_pos", joint, constant=True), usual=False,
        refusal="acts on nothing: the joint slides" if slides else simple,
    )  # fmt: skip


def shapes(scope: Scope) -> Iterator[Field]:
    """List the fields of all shapes, pairs and sites."""
    trees = scope.trees
    for geom in range(scope.mj.ngeom):
        yield from _contact(scope, geom)
        yield from _form(scope, geom)
    for pair in range(scope.mj.npair):
        row = scope.rows("pair", pair, partial(trees.pair, pair))
        off = scope.off(OFF.mjDSBL_CONTACT, "contact")
        doc = "Friction of the pair: sliding (2), torsional [m] and rolling [m] (2)."
        yield row("friction", "1", doc, at("pair_friction", pair), low=0.0, refusal=off)
        for attribute in ("margin", "gap"):
            low = min(0.0, float(getattr(scope.mj, f"pair_{attribute}")[pair]))
            yield row(
                attribute, "m", f"The {attribute} of contacts of the pair.",
                at(f"pair_{attribute}", pair, constant=True), low=low, usual=False, refusal=off,
            )  # fmt: skip
        yield from solver_rows(row, scope.mj, "pair", pair, usual=False, refusal=off)
    for site in range(scope.mj.nsite):
        yield from _pose("site", "site", site, scope.rows("site", site, partial(trees.site, site)))


def _pose(kind: str, what: str, index: int, row: Callable[..., Field]) -> Iterator[Field]:
    """Give where a shape or a site is."""
    yield row(
        "position", "m", f"Place of the {what} in the frame of its body.",
        at(f"{kind}_pos", index, constant=True), usual=False,
    )  # fmt: skip
    yield row(
        "orientation", "1", f"Orientation of the {what} in the frame of its body.",
        turn_at(f"{kind}_quat", index), low=-1.0, high=1.0, nature="rotation", usual=False,
    )  # fmt: skip


def _contact(scope: Scope, geom: int) -> Iterator[Field]:
    """Give how a shape behaves in contact."""
    mj, condim = scope.mj, scope.trees.highest_condim(geom)
    row = scope.rows("geom", geom, partial(scope.trees.contact_of, geom))
    alone = "" if condim else "acts on nothing: the shape touches nothing"
    for column, (attribute, needed, unit, doc) in enumerate(_FRICTIONS):
        low = f"acts on nothing: its contacts have a condim below {needed}"
        yield row(
            attribute, unit, doc, at("geom_friction", geom, column), low=0.0,
            refusal=alone or (low if condim < needed else ""),
        )  # fmt: skip
    margin, adhesion = float(mj.geom_margin[geom]), bool(mj.geom_adhesion[geom])
    moving = bool(mj.geom_surfacevel[geom].any())
    for attribute, unit, minimum, usual, doc in (
        ("margin", "m", min(0.0, margin), margin != 0.0, "How far around it contacts act."),
        ("gap", "m", 0.0, False, "How much further contacts are found without acting."),
        ("adhesion", "N", 0.0, adhesion, "Force with which its contacts hold on."),
    ):
        yield row(
            attribute, unit, doc, at(f"geom_{attribute}", geom, constant=True), low=minimum,
            usual=usual, refusal=alone,
        )  # fmt: skip
    yield row(
        "surfacevel", "1", "Velocity of its surface in its frame: linear [m/s], angular [rad/s].",
        at("geom_surfacevel", geom, constant=True), usual=moving, refusal=alone,
    )  # fmt: skip
    yield row(
        "solmix", "1", "Weight of this shape when the solref of a contact is mixed.",
        at("geom_solmix", geom), low=0.0, usual=False, refusal=alone,
    )  # fmt: skip
    yield from solver_rows(row, mj, "geom", geom, usual=False, refusal=alone)


def _form(scope: Scope, geom: int) -> Iterator[Field]:
    """Give the size, color and place of a shape."""
    mj, kind = scope.mj, int(scope.mj.geom_type[geom])
    row = scope.rows("geom", geom, partial(scope.trees.shape, geom))
    word = mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower()
    if kind in _SIZES:
        used, what = _SIZES[kind]
        index = (geom, 0) if used == 1 else (geom, slice(used))
        acts = any(scope.trees.shape(geom))
        yield row(
            "size", "m", f"{what} of the {word}; mass and inertia stay as they are.",
            at("geom_size", *index, constant=True), low=least(mj.geom_size[index]), usual=acts,
            visual=not acts,
        )  # fmt: skip
    else:
        reason = f"is that of a {word}: only another file can change it"
        yield row("size", "m", "", None, refusal=reason)
    material = int(mj.geom_matid[geom])
    yield row(
        "color", "1", "Red, green, blue and opacity of the shape.",
        lambda mj, _: color(mj.geom_rgba[geom], mj.mat_rgba[material] if material >= 0 else None),
        effect=lambda: NOTHING, low=0.0, high=1.0, usual=mj.geom_group[geom] < _SHOWN, visual=True,
    )  # fmt: skip
    yield from _pose("geom", "shape", geom, row)
    for attribute in ("contype", "conaffinity", "condim", "type"):
        reason = "is a whole number that only another file can change"
        yield row(attribute, "1", "", None, refusal=reason)
