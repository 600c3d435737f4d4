"""Parameters of bodies and joints."""

from __future__ import annotations

from collections.abc import Callable, Iterator

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
from scm_world.backends.mujoco.slots import Direction, Place, Turn

_SIMPLE = "is fixed by the compiler; write simple='false' at the body"


def bodies(scope: Scope) -> Iterator[Field]:
    """List the fields of all bodies but the world."""
    for body in range(1, scope.mj.nbody):
        yield from _inertia(scope, body)
        yield from _pose(scope, body)


def _flexible(scope: Scope, body: int) -> bool:
    """Tell whether a body is but a vertex of a flex."""
    return body in scope.mj.flex_vertbodyid or body in scope.mj.flex_nodebodyid


def _inertia(scope: Scope, body: int) -> Iterator[Field]:
    mj, trees = scope.mj, scope.trees
    row = scope.rows("body", body, lambda: trees.body(body))
    moves = mj.body_treeid[body] >= 0
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


def _turns(mj: mujoco.MjModel, body: int) -> bool:
    """Tell whether a joint on the way to a body turns it."""
    while body:
        first = int(mj.body_jntadr[body])
        if any(mj.jnt_type[first : first + int(mj.body_jntnum[body])] != SLIDE):
            return True
        body = int(mj.body_parentid[body])
    return False


def _pose(scope: Scope, body: int) -> Iterator[Field]:
    mj, mocap = scope.mj, int(scope.mj.body_mocapid[body])
    row = scope.rows("body", body, lambda: scope.trees.frame(body))
    first = int(mj.body_jntadr[body])
    if mocap >= 0:
        yield row(
            "position", "m", "Place of a body that is moved from outside.",
            lambda _, data: Place(_held(data).mocap_pos[mocap]),
        )  # fmt: skip
        yield row(
            "orientation", "1", "Orientation of a body that is moved from outside.",
            lambda _, data: Turn(_held(data).mocap_quat[mocap]), low=-1.0, high=1.0,
            nature="rotation",
        )  # fmt: skip
    elif first >= 0 and mj.jnt_type[first] == FREE:
        name = scope.names["body"][body]
        reason = f"is a state: set {name}.cartesian_position"
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


def _held(data: mujoco.MjData | None) -> mujoco.MjData:
    """Give the data, which holds the places of bodies that are moved from outside."""
    if data is None:
        raise TypeError("this model has mocap bodies: slots() needs the MjData, too")
    return data


def joints(scope: Scope) -> Iterator[Field]:
    """List the fields of all joints."""
    mj = scope.mj
    for joint, kind in enumerate(mj.jnt_type.tolist()):
        row = scope.rows("joint", joint, _effect(scope, int(mj.jnt_bodyid[joint])))
        yield from _resistance(scope, joint, kind, row)
        if kind in (SLIDE, HINGE):
            yield from _limits(scope, joint, row)
            yield from _axis(scope, joint, row)


def _effect(scope: Scope, body: int) -> Callable[[], tuple[frozenset[int], frozenset[int]]]:
    return lambda: scope.trees.body(body)


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
        return repeated_at(array, dof, count, constant=constant)

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


def _limits(scope: Scope, joint: int, row: Callable[..., Field]) -> Iterator[Field]:
    """Give where a hinge or slide is at rest, and where it ends."""
    mj, place = scope.mj, int(scope.mj.jnt_qposadr[joint])
    turns = mj.jnt_type[joint] == HINGE
    angle, force = ("rad", "N m") if turns else ("m", "N")
    yield row(
        "springref", angle, "Position in which the spring is at rest.",
        at("qpos_spring", place, constant=True), usual=bool(mj.jnt_stiffness[joint]),
        refusal=scope.off(OFF.mjDSBL_SPRING, "springs"),
    )  # fmt: skip
    yield row(
        "ref", angle, "Position of the joint in the pose of the file.",
        at("qpos0", place, constant=True), usual=False,
    )  # fmt: skip
    free = "" if mj.jnt_limited[joint] else "is not in force: the joint has no limits"
    free = free or scope.off(OFF.mjDSBL_LIMIT, "limits")
    yield row(
        "range", angle, "Lower and upper limit of the joint.",
        at("jnt_range", joint), usual=False, refusal=free,
    )  # fmt: skip
    yield row(
        "margin", angle, "Distance from the limits at which they begin to act.",
        at("jnt_margin", joint), low=0.0, usual=False, refusal=free,
    )  # fmt: skip
    yield from solver_rows(row, mj, "jnt", joint, suffix="limit", usual=False, refusal=free)
    weak = "" if mj.jnt_actfrclimited[joint] else "is not in force: it is not limited"
    yield row(
        "actuatorfrcrange", force, "Range of the force of all its actuators.",
        at("jnt_actfrcrange", joint), usual=False, refusal=weak,
    )  # fmt: skip


def _axis(scope: Scope, joint: int, row: Callable[..., Field]) -> Iterator[Field]:
    mj = scope.mj
    simple = _SIMPLE if mj.body_simple[mj.jnt_bodyid[joint]] else ""
    yield row(
        "axis", "1", "Unit vector of the axis in the frame of the body.",
        lambda mj, _: Direction(mj.jnt_axis[joint]), low=-1.0, high=1.0, usual=False,
        refusal=simple,
    )  # fmt: skip
    slides = mj.jnt_type[joint] == SLIDE
    yield row(
        "anchor", "m", "Point of the body through which the axis goes.",
        at("jnt_pos", joint, constant=True), usual=False,
        refusal="acts on nothing: the joint slides" if slides else simple,
    )  # fmt: skip
