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


def matching(compiled: CompiledTask, patterns: Iterable[str]) -> tuple[str, ...]:
    """List the variables that can be set and that patterns or groups name.

    A group is a word after ``@``: ``@everything``, ``@goals``, ``@looks``, ``@physics``, and those
    of the task, such as ``@poses``. Where a quantity has several names, groups take the one that
    has spaces.

    Args:
        compiled: The structure.
        patterns: With ``*`` and ``?`` for any letters, or groups.

    Raises:
        UnknownVariable: A pattern or a group names nothing that can be set.
    """
    found: dict[str, None] = {}
    names = settable(compiled)
    groups = grouped(compiled) if any(p.startswith("@") for p in patterns) else {}
    for pattern in patterns:
        fits = groups.get(pattern[1:]) if pattern.startswith("@") else None
        if fits is None:
            fits = [name for name in names if fnmatchcase(name, pattern)]
            if not fits:
                known = [f"@{group}" for group in groups] if pattern.startswith("@") else names
                raise UnknownVariable(pattern, known)
        found.update(dict.fromkeys(fits))
    return tuple(found)


def settable(compiled: CompiledTask) -> tuple[str, ...]:
    """List what ``do`` accepts in a structure, without the actions."""
    model, actions = compiled.model, compiled.commanded
    return tuple(n for n in model if model.declared(model.target(n)).settable and n not in actions)


def grouped(compiled: CompiledTask) -> dict[str, list[str]]:
    """List the variables of each group.

    ``physics`` changes how bodies move, and neither where they begin nor how large they are.

    Args:
        compiled: The structure.
    """
    model, task = compiled.model, compiled.task
    spaced = [v for v in _spaced(compiled) if v.name != PRESET]
    own = task.groups(model, spaced, compiled.composition.movers())
    looks = [v.name for v in spaced if any(fnmatchcase(v.name, one) for one in LOOKS)]
    goals = [name for name in task.goal.causes if name in model]
    others = {*looks, *own.get("poses", ()), *goals, *own.pop("unphysical", ())}
    physics = [
        v.name
        for v in spaced
        if v.name not in others
        and v.dtype == "real"
        and model.declared(model.target(v.name)).role == "parameter"
        and (v.unit != "m" or v.name.endswith("friction"))
    ]
    physics += [name for name in ("blocks_mass",) if name in model]
    everything = [v.name for v in spaced]
    return {**own, "everything": everything, "goals": goals, "looks": looks, "physics": physics}


def _spaced(compiled: CompiledTask) -> Iterable[Variable]:
    """List roots and states that have a space, under one name each; bundles, not their parts."""
    model = compiled.model
    for name in settable(compiled):
        if name in compiled.parts:
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
