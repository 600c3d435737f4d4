"""Which variables a word or a pattern stands for."""

from __future__ import annotations

from collections.abc import Iterable
from fnmatch import fnmatchcase
from typing import Any

from scm_world.errors import UnknownVariable
from scm_world.variables import Exogenous, Variable
from scm_world.variables.reserved import PRESET
from scm_world.world.compiled_task import CompiledTask

LOOKS = ("*color", "light_*", "camera_*")
"""What is seen and moves nothing."""
PLACES = ("obstacle_places", "drop_*", "number_of_*", "nums_objects", "stack_levels", "wall_side")
"""What decides where things are, or how many."""

QUANTITIES = ("color", "cylindrical_position", "euler_orientation", "mass", "size")
"""What the predecessor draws of a body."""
OURS = (
    "*gains",
    "*noise",
    "camera_*",
    "drop_*",
    "finger_friction",
    "gravity",
    "joint_*",
    "light_*",
    "obstacle_places",
    "restitution",
    "robot_height",
    "safety_damping",
    "spinning_friction",
    "torque_limit",
)
"""What it does not have."""

POSE = ("cylindrical_position", "euler_orientation")
"""The coordinates in which the spaces of poses are declared."""


def matching(declaration: CompiledTask, patterns: Iterable[str]) -> tuple[str, ...]:
    """List the variables that can be set and that patterns or groups name.

    A group is a word after ``@``: ``@everything``, ``@goals``, ``@joints``, ``@looks``,
    ``@physics``, ``@poses``, ``@published``. Where a quantity has several names, groups take the
    one that has spaces.

    Args:
        declaration: Of the structure that there is.
        patterns: With ``*`` and ``?`` for any letters, or groups.

    Raises:
        UnknownVariable: A pattern or a group names nothing that can be set.
    """
    found: dict[str, None] = {}
    names = settable(declaration)
    for pattern in patterns:
        if pattern.startswith("@"):
            if pattern[1:] not in GROUPS:
                raise UnknownVariable(pattern, [f"@{group}" for group in GROUPS])
            found.update(dict.fromkeys(grouped(declaration, pattern[1:])))
            continue
        fits = [name for name in names if fnmatchcase(name, pattern)]
        if not fits:
            raise UnknownVariable(pattern, names)
        found.update(dict.fromkeys(fits))
    return tuple(found)


def settable(declaration: CompiledTask) -> tuple[str, ...]:
    """List what ``do`` accepts in a structure, without the actions."""
    model, actions = declaration.model, declaration.commanded
    return tuple(n for n in model if model.declared(model.target(n)).settable and n not in actions)


def _spaced(declaration: CompiledTask) -> Iterable[Variable]:
    """List roots and states that have a space, under one name each; bundles, not their parts."""
    model = declaration.model
    for name in settable(declaration):
        if name in declaration.parts:
            continue
        variable: Any = model.declared(name)
        quantity = model.declared(model.target(name))
        is_root = isinstance(quantity, Exogenous) or quantity.role == "state"
        has_space = variable.a is not None or variable.b is not None
        if (
            is_root
            and has_space
            and (name == quantity.name or variable.parts or quantity.a is None)
        ):
            yield variable


def _like(name: str, patterns: Iterable[str]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def grouped(declaration: CompiledTask, group: str) -> list[str]:
    """List the variables that a group stands for.

    ``physics`` changes how bodies move, and neither where they begin nor how large they are.
    ``published`` is what the predecessor's random actor draws: never the joints. There a size that
    follows another variable is drawn through that one, so that block and goal stay alike; so are
    masses. Where variables decide how many blocks there are, the blocks begin where the task puts
    them: dozens of them are never drawn apart.

    Args:
        declaration: Of the structure that there is.
        group: One of ``GROUPS``.
    """
    model, task = declaration.model, declaration.task
    spaced = [v for v in _spaced(declaration) if v.name != PRESET]
    bodies = declaration.composition.movers()
    looks = [v.name for v in spaced if _like(v.name, LOOKS)]
    poses = [
        v.name
        for v in spaced
        if v.name.partition(".")[0] in bodies and v.name.partition(".")[2] in POSE
    ]
    goals = [name for name in task.goal.causes if name in model]
    match group:
        case "everything":
            return [v.name for v in spaced]
        case "goals":
            return goals
        case "joints":
            return ["joint_positions"]
        case "looks":
            return looks
        case "poses":
            return poses
        case "physics":
            others = {*looks, *poses, *goals, "joint_positions"}
            return [
                v.name
                for v in spaced
                if v.name not in others
                and v.dtype == "real"
                and model.declared(model.target(v.name)).role == "parameter"
                and (v.unit != "m" or v.name.endswith("friction"))
                and not _like(v.name, (*PLACES, "*euler_orientation", "goal_*", "sensor_noise"))
            ] + [name for name in ("blocks_mass",) if name in model]
    found = []
    placed = poses if task.decided_by else ()
    for v in spaced:
        entity, _, quantity = v.name.rpartition(".")
        is_ours = v.name in placed or _like(v.name, OURS) or (entity == "" and v.role == "state")
        if not is_ours and (quantity in QUANTITIES or not entity):
            found.append(v.name)
    desired = [n for n in settable(declaration) if _like(n, ("goal_*.cylindrical_position",))]
    return list(dict.fromkeys(found + [n for n in desired if model.declared(n).a]))


GROUPS = ("everything", "goals", "joints", "looks", "physics", "poses", "published")
"""The words that stand for variables."""
