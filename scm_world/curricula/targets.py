"""The variables that patterns and groups name, and where each of them is drawn from."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from scm_world._patterns import fits
from scm_world.errors import InterventionError, UnknownVariable
from scm_world.variables import (
    Box,
    Continuous,
    Cylinder,
    Discrete,
    Distribution,
    Normal,
    Subset,
    Variable,
)
from scm_world.variables.checks import check_draw, check_region
from scm_world.variables.kinds import SpaceName
from scm_world.variables.reserved import PRESET
from scm_world.world.compiled_task import CompiledTask

LOOKS = ("*color", "light_*", "camera_*")
"""Variables that change pictures, and no motion."""


def matching(
    compiled: CompiledTask, patterns: Iterable[str], among: Collection[str] | None = None
) -> tuple[str, ...]:
    """Return the settable variables that patterns or groups name.

    A group is a word after ``@``: ``@everything``, ``@goals``, ``@looks``, ``@physics``, and those
    of the task, such as ``@poses``. Where a quantity has several names, groups take the one that
    has spaces.

    Args:
        compiled: The structure.
        patterns: With ``*`` and ``?`` for any letters, or groups.
        among: The only variables that count; then a pattern may fit nothing.

    Raises:
        UnknownVariable: A pattern or a group names nothing that can be set.
    """
    found: dict[str, None] = {}
    names = settable(compiled)
    groups = grouped(compiled) if any(p.startswith("@") for p in patterns) else {}
    for pattern in patterns:
        named = groups.get(pattern[1:]) if pattern.startswith("@") else None
        if named is None:
            named = [name for name in names if fits(name, (pattern,))]
            if not named and among is None:
                known = [f"@{group}" for group in groups] if pattern.startswith("@") else names
                raise UnknownVariable(pattern, known)
        found.update(dict.fromkeys(named))
    return tuple(name for name in found if among is None or name in among)


def regions(
    compiled: CompiledTask,
    what: Iterable[str],
    space: SpaceName | Subset | Distribution = "A",
    besides: Iterable[str] = (),
    among: Collection[str] | None = None,
) -> dict[str, SpaceName | Distribution]:
    """Return the variables that ``resample`` draws, each with its region; see ``matching``.

    A variable that a pattern fits has to have the region; a group leaves out those without.

    Raises:
        InterventionError: A variable does not have the space, or the region is impossible.
    """
    left_out = set(matching(compiled, besides, among))
    found: dict[str, SpaceName | Distribution] = {}
    for pattern in what:
        for name in matching(compiled, (pattern,), among):
            variable = compiled.model.declared(name)
            region = space.region(name) if isinstance(space, Subset) else space
            missing = isinstance(region, str) and variable.space(region) is None
            if name in left_out or region is None or (missing and pattern.startswith("@")):
                continue
            _check(variable, region)
            found[name] = region
    return found


def _check(variable: Variable, region: SpaceName | Distribution) -> None:
    """Refuse a region in which a variable cannot lie."""
    if variable.dtype != "real" and isinstance(region, Box | Cylinder | Normal | Continuous):
        raise InterventionError(
            f"{variable.name!r} is a whole number, and {region!r} has others; draw it from "
            "Integers(low, high), Categories([…]) or a declared space",
            variable=variable.name,
            value=region,
        )
    if isinstance(region, Normal | Cylinder | Continuous | Discrete):
        check_draw(variable, region)
    else:
        check_region(variable, region)


def settable(compiled: CompiledTask) -> tuple[str, ...]:
    """Return the variables of a structure that ``do`` sets, without the actions."""
    model, actions = compiled.model, compiled.commanded
    return tuple(n for n in model if model.declared(model.target(n)).settable and n not in actions)


def grouped(compiled: CompiledTask) -> dict[str, list[str]]:
    """Return the variables of each group.

    ``physics`` changes how bodies move, and neither where they begin nor how large they are.
    """
    model, task = compiled.model, compiled.task
    spaced = [v for v in _spaced(compiled) if v.name != PRESET]
    own = task.groups(model, spaced, compiled.movers)
    looks = [v.name for v in spaced if fits(v.name, LOOKS)]
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
        variable = model.declared(name)
        quantity = model.declared(model.target(name))
        is_root = quantity.is_root or quantity.role == "state"
        has_space = variable.a is not None or variable.b is not None
        is_own_name = name == quantity.name or variable.parts or quantity.a is None
        if name not in compiled.parts and is_root and has_space and is_own_name:
            yield variable
