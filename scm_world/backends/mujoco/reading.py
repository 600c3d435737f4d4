"""Any model file as a ``Model``: tables of what there is, and of what acts on what."""

from __future__ import annotations

import copy
import hashlib
import math
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import mujoco
import numpy as np

from scm_world._arguments import true_or_false
from scm_world._patterns import fits
from scm_world._types import Floats
from scm_world.backends.mujoco.equalities import with_followers
from scm_world.backends.mujoco.fidelity import measured
from scm_world.backends.mujoco.fields import (
    MEDIUM,
    control_unit,
    element_names,
    numbers,
    servo,
    table,
)
from scm_world.backends.mujoco.readouts import find_readouts
from scm_world.backends.mujoco.scratch import silent
from scm_world.backends.mujoco.sources import (
    keyframes,
    read_source,
    start_of,
    understood,
)
from scm_world.backends.mujoco.trees import Couplings
from scm_world.errors import ModelError, nearest, some
from scm_world.geometry.numbers import njit
from scm_world.models.model import (
    NOT_EXPOSED,
    REPORTED,
    SCALED,
    Model,
    ModelRow,
    Parameter,
    StateRow,
    grouped,
)
from scm_world.models.scene import REVERSED, BodyRow, reversed_ranges

_JNT = mujoco.mjtJoint
_CONTROLS = {
    "position": "Position that the servo goes to.",
    "velocity": "Velocity that the servo keeps to.",
    "damper": "How much the actuator damps.",
    "": "What the actuator makes a force of, with its gain and gear.",
}


SHORTEST, MOST_ITERATIONS = 1e-6, 100_000
"""The shortest physics step [s], and how often solvers may go on: a step has to end."""
_TRIANGLE = np.ones((3, 3)) - (2.0 - 1e-6) * np.eye(3)
"""Takes moments of inertia to numbers that are not negative if none exceeds the sum of others."""


def sensible(mj: mujoco.MjModel) -> bool:
    """Return whether masses, and what MuJoCo derives from them, are those of something that moves.

    They are finite and not negative, and moments of inertia obey the triangle inequality.
    """
    inverse = mj.dof_invweight0, mj.body_invweight0.ravel()
    return bool(_sensible(mj.body_mass, mj.body_inertia, mj.dof_M0, *inverse))


@njit(cache=True)
def _sensible(
    masses: Floats, moments: Floats, diagonal: Floats, inverse: Floats, inverses: Floats
) -> bool:
    valid = True
    for part in (masses, moments.ravel(), diagonal, inverse, inverses):
        for number in part:
            valid &= 0.0 <= number < math.inf
    for number in diagonal:
        valid &= number > 0.0
    for a, b, c in moments:
        valid &= 2.0 * max(a, b, c) - (a + b + c) <= 1e-6 * max(a, b, c)
    return valid


Bindings = Callable[[mujoco.MjModel, mujoco.MjData, Couplings], Iterable[Parameter]]
"""Makes the parameters of a compiled model, in a state, with these kinematic trees."""


def read_model(
    source: Any,
    *,
    name: str | None = None,
    expose: Iterable[str] | str | None = None,
    readouts: Iterable[str] = (),
    fixed_base: bool = True,
    keyframe: str | int | None = None,
    exact: bool = True,
    self_collision: bool = True,
    ground: bool = False,
    drop: Iterable[str] = (),
    follow: bool = False,
    settings: Mapping[str, Any] | None = None,
    reported: Iterable[str] | str = (),
    states: Mapping[str, Sequence[str]] | None = None,
    controls: int | None = None,
    bindings: Bindings | None = None,
    frame: Literal["body", "world"] = "body",
    part_of: Mapping[str, str] | None = None,
) -> Model:
    """Read a model, and describe it by tables.

    Args:
        source: A path to an MJCF or URDF file, XML text, a ``mujoco.MjSpec`` or a
            ``mujoco.MjModel``. It is not changed.
        name: Name of the model; the one in the file if None.
        expose: Patterns of the parameters that can be set: ``"*.mass"``, ``"cube.*"``. A pattern
            that ends in ``*`` means the usual attributes; the others are exposed where they are
            named, as in ``["*", "*.solref"]``. All usual ones if None.
        readouts: Names of quantities computed from the states: ``"tip.position"``,
            ``"tip.orientation"``, ``"tip.linear_velocity"``, ``"tip.angular_velocity"`` of sites,
            bodies and shapes, and ``"imu.value"`` of sensors.
        fixed_base: Whether the root link of a URDF is fixed to the world.
        keyframe: Name or number of a keyframe of the file whose state, controls and mocap poses are
            the defaults; the pose of the file if None.
        exact: Whether trees that do not touch leave one another alone to the last bit. If not, the
            solver, its warm start and the integrator are those of the file; see ``Fidelity``.
        self_collision: Whether bodies of one kinematic tree can touch.
        ground: Whether a plane is added: at z = 0, or as low as the lowest of the shapes that can
            touch it in the start pose.
        drop: Features that are left out, such as ``["armature"]``, so that Bullet can realise the
            model: those of ``sources.DROPPED``. Notes list the elements that had them.
        follow: Whether states follow others by connect, weld and tendon constraints where these are
            set, as joints that mimic others always do; see ``equalities.with_followers``.
        settings: Options of MJCF to be set to something else: ``{"timestep": 0.001}``.
        reported: Patterns of what the engine reports in every step and what cannot be set:
            ``"hinge.actuator_torque"`` [N m] and ``"slide.actuator_force"`` [N], the sum of the
            actuators of a joint.
        states: Names of states, in the order of the state vector, each with the elementary states
            (and reported quantities) that it consists of: ``{"joint_positions":
            ["hip.position", "knee.position"]}``. Each elementary state by itself if None.
        controls: How many actuators are commanded, the first ones of the model; all if None.
        bindings: Makes the parameters in place of the fields of the compiled model, given that
            model and its kinematic trees: each writes one value to any arrays. ``expose`` has no
            effect then.
        frame: ``"world"`` for angular velocities of free bodies in the world, and orientations with
            w >= 0; ``"body"`` for those that MuJoCo has.
        part_of: Bodies that contacts are not listed of, each with the body that they are a part of:
            ``{"fingertip": "lower_link"}``.

    Raises:
        UnreadableFile: There is no such file, or it is not text.
        ModelError: It is not a model, or one that cannot be a causal model; or a pattern or readout
            names nothing; or states are left out.
        UnknownOption: A setting or keyframe does not exist.
    """
    flags = {"exact": exact, "self_collision": self_collision, "ground": ground, "follow": follow}
    for option, value in (flags | {"fixed_base": fixed_base}).items():
        true_or_false(option, value)
    sealed, own_name, where, replaced = read_source(
        source,
        fixed_base=fixed_base,
        options=dict(settings or {}),
        exact=exact,
        keyframe=keyframe,
        self_collision=self_collision,
        ground=ground,
        drop=drop,
    )
    with understood(where):
        mj = sealed.realized
    _check(mj, where)
    start = start_of(mj, keyframe)
    patterns = None if expose is None else [expose] if isinstance(expose, str) else list(expose)
    medium = [p for p in patterns or () if p != "*" and any(fits(one, (p,)) for one in MEDIUM)]
    trees = Couplings(mj, fluid=bool(medium))
    names = element_names(mj)
    elements, commands = _moving(mj, names, trees, start, frame)
    moving = _grouped(elements, states, [reported] if isinstance(reported, str) else [*reported])
    inputs = tuple(commands[:controls])
    with np.errstate(invalid="ignore"):  # infinite values are refused by name
        rows = tuple((bindings or table)(mj, start, trees))
    infinite = [row.name for row in rows if not np.isfinite(row.default).all()]
    if infinite:
        raise ModelError([f"{where}: these are not finite numbers: {', '.join(infinite)}"])
    chosen = {row.name for row in rows} if bindings else _exposed(rows, patterns)
    scales = tuple(row for row in rows if row.name in chosen and row.slot is None)
    parameters = tuple(row for row in rows if row.name in chosen and row.slot is not None)
    moving = with_followers(moving, mj, sealed, start, parameters, loops=follow)
    wrong = reversed_ranges({row.key: row.default for row in parameters})
    if wrong:
        raise ModelError([f"{where}: {'.'.join(key)}: {REVERSED}" for key in wrong])
    touch = mj.nflex > 0 or bool(trees.touches.any())
    staged = touch and int(mj.opt.integrator) == int(mujoco.mjtIntegrator.mjINT_RK4)
    keys = "\0".join(f"{row.name}\0{row.key}" for row in parameters)
    keys += "" if keyframe is None else f"\0{keyframe}"
    keys += "" if states is None else f"\0{[*states.items()]}"
    keys += "\0follow" if follow else ""
    keys += "" if part_of is None else f"\0{[*part_of.items()]}"
    keys += "" if (frame, len(inputs)) == ("body", mj.nu) else f"\0{frame} {len(inputs)}"
    owners = [names["body"][int(body)] for body in mj.geom_bodyid]
    bodies = tuple(
        BodyRow(
            name,
            trees.tree(body) if mj.body_treeid[body] >= 0 else -1,
            tuple(names["geom"][geom] for geom in np.flatnonzero(mj.geom_bodyid == body)),
            tuple(names["joint"][joint] for joint in np.flatnonzero(mj.jnt_bodyid == body)),
        )
        for body, name in enumerate(names["body"])
    )
    owners = [(part_of or {}).get(name, name) for name in owners]
    model = Model(
        name=name or own_name or "model",
        digest=hashlib.sha256(f"{sealed.digest}\0{keys}".encode()).hexdigest(),
        source=sealed,
        timestep=float(mj.opt.timestep),
        parameters=parameters,
        states=moving,
        inputs=inputs,
        scales=scales,
        readouts=tuple(find_readouts(mj, sealed, moving, parameters, tuple(readouts))),
        trees=(
            *(names["body"][root] for root in trees.roots),
            *(f"{names['actuator'][actuator]}.activation" for actuator in trees.inners),
        ),
        refusals=grouped(
            (row.key, row.refusal or NOT_EXPOSED) for row in rows if row.name not in chosen
        ),
        notes=(*replaced, *_odd(rows), *_notes(mj, keyframe, staged)),
        staged=staged,
        bodies=bodies,
        owners=(*owners, *names["flex"]),
        keyframes=keyframes(mj),
        exact=exact,
    )
    if bindings:
        return model
    model = measured(model, start)
    if model.fidelity.far and not sealed.drop:  # that was asked for
        warnings.warn(model.fidelity.notes[-1], stacklevel=3)
    return model


def compiled(model: Model) -> mujoco.MjModel:
    """Compile what a description was read from, with settings under which it is exact.

    There is one in a process, without what only pictures have. Callers copy it before they change
    it.
    """
    realized: mujoco.MjModel = model.source.realized
    return realized


def _check(mj: mujoco.MjModel, where: str) -> None:
    """Refuse elements whose effects no graph could declare."""
    problems = []
    if mj.nv == 0:
        hint = "add a joint, or a freejoint; for a URDF, fixed_base=False lets its root link move"
        problems.append(f"it has no joint, so that nothing in it can move; {hint}")
    if not SHORTEST <= mj.opt.timestep < math.inf:
        problems.append(f"its timestep is {mj.opt.timestep:g} s; give {SHORTEST:g} s or more")
    for name in ("iterations", "ls_iterations", "noslip_iterations", "ccd_iterations"):
        if not 0 <= getattr(mj.opt, name) <= MOST_ITERATIONS:
            what = f"{name} is {getattr(mj.opt, name)}; give 0 to {MOST_ITERATIONS}"
            problems.append(f"its number of {what}")
    users = mujoco.mjtDyn.mjDYN_USER, mujoco.mjtGain.mjGAIN_USER, mujoco.mjtBias.mjBIAS_USER
    for i, name in enumerate(element_names(mj)["actuator"]):
        kinds = mj.actuator_dyntype[i], mj.actuator_gaintype[i], mj.actuator_biastype[i]
        if any(int(kind) == int(user) for kind, user in zip(kinds, users, strict=True)):
            what = "needs a callback of the user; give it one of MuJoCo's own types"
            problems.append(f"the actuator {name!r} {what}")
        if mj.actuator_historyadr[i] >= 0:
            what = "acts with a delay, and its memory is not a state; remove delay and nsample"
            problems.append(f"the actuator {name!r} {what}")
    if getattr(mj, "nplastic", 0):  # since MuJoCo 4
        what = "plastic springs or flexes, whose rest shape is a hidden state"
        problems.append(f"it has {what}; remove springyield and yield")
    if mj.nv:
        problems += _check_inertia(mj)
    if problems:
        raise ModelError([f"{where}: {problem}" for problem in problems])


def _check_inertia(mj: mujoco.MjModel) -> Iterator[str]:
    """List bodies with impossible inertia, or joints that have none to move."""
    model, data = copy.copy(mj), silent(mujoco.MjData(mj))
    mujoco.mj_setConst(model, data)
    if data.warning.number[0] == 1 and sensible(model):
        return
    names = element_names(mj)
    with np.errstate(invalid="ignore"):
        wrong = ~((mj.body_mass >= 0.0) & (mj.body_inertia @ _TRIANGLE >= 0.0).all(axis=1))
    if wrong.any():
        bodies = ", ".join(repr(names["body"][body]) for body in np.flatnonzero(wrong))
        yield f"no body has such a mass, or such moments of inertia, as {bodies}"
        return
    matrix = np.empty((mj.nv, mj.nv))
    mujoco.mj_fullM(model, data, matrix)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(scale[:, None] * matrix * scale)
    weak = np.abs(vectors[:, values < 1e-9]).max(axis=1, initial=0.0) > 1e-6
    joints = dict.fromkeys(names["joint"][int(joint)] for joint in mj.dof_jntid[weak])
    yield (
        f"the joints {', '.join(map(repr, joints))} depend on one another or move no mass, so that "
        "the mass matrix is singular; remove one of them, or give them armature"
    )


def _notes(mj: mujoco.MjModel, keyframe: str | int | None, staged: bool) -> Iterator[str]:
    """List elements that act without having a variable, and elements that are not used."""
    if mj.nflex:
        yield f"{mj.nflex} flex(es) act through their vertices; their material has no variables."
    if staged:
        yield (
            "RK4 looks for contacts in four stages of a physics step; those of the last one are "
            "listed, and an edge by contact may act in an earlier one."
        )
    if mj.nskin:
        yield f"{mj.nskin} skin(s) act on pictures only."
    if mj.nkey and keyframe is None:
        names = keyframes(mj)
        yield (
            f"Keyframes that are not used: {some(names, 9)}. Episodes begin in the pose of the "
            f"file; keyframe={names[0]!r} begins with one."
        )


# --- parameters --------------------------------------------------------------------------------


def _odd(rows: Iterable[Parameter]) -> Iterator[str]:
    """List which values of a file lie beyond the ends that such a quantity has in physics."""
    found = []
    for row in rows:
        least = np.broadcast_to(row.low, row.shape)  # a value below its end is the lower bound
        below = (least < 0.0) & (row.default == least)
        if row.kind != "rotation" and (below | np.greater(row.default, row.high)).any():
            found.append(f"{row.name} ({' '.join(map('{:g}'.format, np.ravel(row.default)))})")
    if found:
        yield (
            f"Outside the range of such quantities are {some(found)}: they hold as in the file, "
            "and bound their variables, so that a pattern that shifts or scales them can be "
            "refused; correct the file."
        )


def _exposed(rows: Sequence[Parameter], patterns: Sequence[str] | None) -> set[str]:
    """Choose the parameters that can be set."""
    can = [row for row in rows if not row.refusal]
    if patterns is None:
        return {row.name for row in can if row.usual}
    found: set[str] = set()
    problems = []
    for pattern in patterns:
        usual = pattern.rpartition(".")[2] == "*"  # by such a pattern no other attributes are meant
        meant = [row for row in rows if fits(row.name, (pattern,))]
        named = {row.name for row in meant if not row.refusal and (row.usual or not usual)}
        found |= named
        refused = next((row for row in meant if row.refusal), None)
        if not named and refused:
            problems.append(f"expose={pattern!r}: {refused.name!r} {refused.refusal}")
        elif not named:
            near = nearest(pattern, (row.name for row in can))
            hint = f"; did you mean {near!r}?" if near else ""
            problems.append(f"expose={pattern!r} names no parameter{hint}")
    if problems:
        raise ModelError(problems)
    scaled = {row.body for row in can if row.name in found and row.slot is None}
    return found | {row.name for row in can if row.body in scaled and row.key[1] in SCALED}


# --- states and inputs -------------------------------------------------------------------------


_COORDINATES = {
    _JNT.mjJNT_FREE: (
        ("qpos", (0, 1, 2), "cartesian_position", "m",
         "Place of the frame of the body in the world."),
        ("qpos", (4, 5, 6, 3), "orientation", "1",
         "Orientation of the body in the world (x, y, z, w)."),
        ("qvel", (0, 1, 2), "linear_velocity", "m/s",
         "Velocity of the origin of the body's frame, in the world."),
        ("qvel", (3, 4, 5), "angular_velocity", "rad/s",
         "Angular velocity of the body, in its own frame."),
    ),
    _JNT.mjJNT_BALL: (
        ("qpos", (1, 2, 3, 0), "orientation", "1",
         "Orientation of the body in its parent (x, y, z, w)."),
        ("qvel", (0, 1, 2), "angular_velocity", "rad/s",
         "Angular velocity in the frame of the body."),
    ),
    _JNT.mjJNT_HINGE: (
        ("qpos", (0,), "position", "rad", "Angle of the joint."),
        ("qvel", (0,), "velocity", "rad/s", "Angular velocity of the joint."),
        (REPORTED, (0,), "actuator_torque", "N m",
         "Sum of the torques of its actuators, in the last step."),
    ),
    _JNT.mjJNT_SLIDE: (
        ("qpos", (0,), "position", "m", "Displacement of the joint."),
        ("qvel", (0,), "velocity", "m/s", "Velocity of the joint."),
        (REPORTED, (0,), "actuator_force", "N",
         "Sum of the forces of its actuators, in the last step."),
    ),
}  # fmt: skip
"""States of each kind of joint: array, places after the first of the joint, name, unit, doc."""
_IN_WORLD = {
    "orientation": "Orientation of the body in the world (x, y, z, w) with w >= 0.",
    "angular_velocity": "Angular velocity of the body, in the world.",
}


def _ends(limited: bool, ends: Floats) -> tuple[float, float]:
    """Return the ends of a range; infinite ones where it is not in force."""
    return (float(ends[0]), float(ends[1])) if limited else (-math.inf, math.inf)


def _moving(
    mj: mujoco.MjModel,
    names: Mapping[str, tuple[str, ...]],
    trees: Couplings,
    data: mujoco.MjData,
    frame: Literal["body", "world"],
) -> tuple[dict[str, StateRow], list[ModelRow]]:
    """Describe the states in MuJoCo's order, the reported values, and the components of a command.

    The data are those of the beginning.
    """
    found, inputs = list[tuple[str, StateRow]](), list[ModelRow]()

    def add(
        kind: str, name: str, array: str, places: list[int], ends: tuple[float, float], **rest: Any
    ) -> None:
        rotation = name.endswith(".orientation")
        default = getattr(data, array)[places if len(places) > 1 else places[0]]
        low, high = min(ends[0], float(np.min(default))), max(ends[1], float(np.max(default)))
        row = StateRow(
            name=name,
            shape=np.shape(default),
            default=numbers(default),
            low=-1.0 if rotation else low,
            high=1.0 if rotation else high,
            kind="rotation" if rotation else "real",
            array=array,
            numbers=tuple(places),
            **rest,
        )
        found.append((kind, row))

    for joint, kind in enumerate(mj.jnt_type.tolist()):
        body = int(mj.jnt_bodyid[joint])
        free, tree = kind == int(_JNT.mjJNT_FREE), trees.tree(body)
        element = names["body"][body] if free else names["joint"][joint]
        (always, contact), own = trees.always([tree]), frozenset([tree])
        for array, places, attribute, unit, doc in _COORDINATES[mujoco.mjtJoint(kind)]:
            first = int((mj.jnt_qposadr if array == "qpos" else mj.jnt_dofadr)[joint])
            limited = attribute == "position" and mj.jnt_limited[joint]
            ends = _ends(limited, mj.jnt_range[joint])
            if array == REPORTED:
                ends = _ends(mj.jnt_actfrclimited[joint], mj.jnt_actfrcrange[joint])
            turned = free and frame == "world" and attribute in _IN_WORLD
            add(
                "joint", f"{element}.{attribute}", array, [first + i for i in places], ends,
                unit=unit, doc=_IN_WORLD[attribute] if turned else doc, always=always,
                contact=contact, trees=own, frame="world" if turned else "body",
            )  # fmt: skip
    for actuator, name in enumerate(names["actuator"]):
        always, contact = trees.actuator(actuator)
        first, count = int(mj.actuator_actadr[actuator]), int(mj.actuator_actnum[actuator])
        if count:  # its inner state belongs to the tree that it moves, if that acts on it
            own = trees.inner(actuator) or frozenset([min(always or contact or {0})])
            always, contact = always | own, contact - own
            ends = _ends(mj.actuator_actlimited[actuator], mj.actuator_actrange[actuator])
            add(
                "actuator", f"{name}.activation", "act", [*range(first, first + count)], ends,
                unit="1", doc="Inner state of the actuator.", always=always,
                contact=contact, trees=own,
            )  # fmt: skip
        effect = {"always": always, "contact": contact}
        first, count = int(mj.actuator_ctrladr[actuator]), int(mj.actuator_ctrlnum[actuator])
        unit, doc = control_unit(mj, actuator), _CONTROLS[servo(mj, actuator)]
        for i in range(first, first + count):
            low, high = _ends(mj.actuator_ctrllimited[i], mj.actuator_ctrlrange[i])
            label = f"{name}.control" if count == 1 else f"{name}.control_{i - first}"
            start = min(max(float(data.ctrl[i]), low), high)
            inputs.append(ModelRow(label, unit, (), start, low, high, doc, **effect))
    found.sort(key=lambda pair: pair[1].reported)
    named = Counter(row.name for _, row in found)
    rows = [
        replace(row, name=f"{kind}:{row.name}") if named[row.name] > 1 else row
        for kind, row in found
    ]
    return {row.name: row for row in rows}, inputs


def _grouped(
    elements: Mapping[str, StateRow],
    states: Mapping[str, Sequence[str]] | None,
    reported: Sequence[str],
) -> tuple[StateRow, ...]:
    """Group elementary states, in the order of the state vector."""
    known = [name for name, row in elements.items() if row.reported]
    asked = {p: [name for name in known if fits(name, (p,))] for p in reported}
    problems = [
        f"reported={pattern!r} names nothing that is reported; there are: {', '.join(known)}"
        for pattern, found in asked.items()
        if not found
    ]
    wanted = {*elements}.difference(known).union(*asked.values())
    used = Counter(part for parts in (states or {}).values() for part in parts)
    if states and (max(used.values()) > 1 or not wanted <= used.keys() <= elements.keys()):
        problems.append(f"states: {', '.join(wanted)} have to stand in one of them each")
    if problems:
        raise ModelError(problems)
    if states is None:
        return tuple(row for name, row in elements.items() if name in wanted)
    found = []
    for name, parts in states.items():
        rows = [elements[part] for part in parts]
        row = replace(rows[0], name=name)
        if len(rows) > 1:
            always = frozenset().union(*(one.always for one in rows))
            values: dict[str, Any] = {}
            for what in ("default", "low", "high"):
                each = (np.broadcast_to(getattr(one, what), one.shape).ravel() for one in rows)
                values[what] = numbers(np.concatenate([*each]))
            row = replace(
                row,
                shape=(sum(len(one.numbers) for one in rows),),
                always=always,
                contact=frozenset().union(*(one.contact for one in rows)) - always,
                trees=frozenset().union(*(one.trees for one in rows)),
                numbers=tuple(number for one in rows for number in one.numbers),
                frame=max(one.frame for one in rows),
                **values,
            )
        found.append(row)
    return tuple(found)
