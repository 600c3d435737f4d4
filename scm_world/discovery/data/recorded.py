"""The columns of a table: which variables of a system it has, and under which names."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from scm_world._arguments import typed
from scm_world._patterns import fits, fitting
from scm_world.discovery.data.dataset import Column
from scm_world.errors import UnknownOption
from scm_world.graph import SCM
from scm_world.queries.samples import Outcome
from scm_world.variables import Variable
from scm_world.variables.reserved import ACTUATOR_NOISE, PRESET, SENSOR_NOISE
from scm_world.world import CausalSystem

NO_CAUSES = ("camera_*", "light_*", "*color", SENSOR_NOISE, ACTUATOR_NOISE, PRESET)
"""Patterns of parameters that move nothing: looks, and disturbances of the measurement."""


@typed
def default_causes(world: CausalSystem | SCM) -> tuple[str, ...]:
    """List the parameters that an experiment varies, if nothing else is asked for.

    They are exogenous and real, can be set, have a space A, and are physical: no cameras, lights,
    noises or settings of the backend, and nothing that decides which bodies there are. The
    colors of the blocks that can be moved are among them: they cause nothing.

    Example:
        >>> from scm_world.queries import World
        >>> found = default_causes(World("pushing", backend="fake"))
        >>> "tool_block.mass" in found, "tool_block.color" in found, "floor_color" in found
        (True, True, False)
    """
    model = world if isinstance(world, SCM) else world.model
    colors, structure = set[str](), set[str]()
    if not isinstance(world, SCM):
        colors, structure = {f"{block}.color" for block in world.tools}, set(world.deciding)
    return tuple(
        variable.name
        for variable in map(model.declared, model)
        if variable.is_root
        and variable.settable
        and variable.a is not None
        and variable.dtype == "real"
        and variable.name not in structure
        and (variable.name in colors or not fits(variable.name, NO_CAUSES))
    )


@typed
def default_outcomes(world: CausalSystem, *, every_step: bool = False) -> tuple[Outcome, ...]:
    """List the usual outcomes.

    For the robot's tasks these are the blocks that move, and success, with ``every_step`` also the
    joints, since the robot moves the blocks; for any other world all states, reward and success;
    for equations all variables but actions.
    """
    return tuple(map(Outcome, world.usual_columns(every_step=every_step)))


def settable(world: CausalSystem | SCM, patterns: Iterable[str]) -> tuple[str, ...]:
    """List the variables that can be set and are named like one of the patterns."""
    model = world if isinstance(world, SCM) else world.model
    free = isinstance(world, SCM) or world.backend is None
    actions = () if free else world.compiled.commanded  # type: ignore[union-attr] # a world
    names = [n for n in model if model.declared(model.target(n)).settable and n not in actions]
    return fitting(patterns, names)


def is_state(model: SCM, name: str) -> bool:
    """Return whether a variable, or the quantity that it describes, is moved by physics."""
    return model.declared(model.target(name)).role == "state"


def first_name(model: SCM, name: str) -> str:
    """Return the name of the beginning of a variable; that of a state differs from its end."""
    return f"first {name}" if is_state(model, name) else name


def reached(
    model: SCM, names: Iterable[str], columns: Iterable[Column], *, first: bool = False
) -> tuple[str, ...]:
    """Return the names of the variables that interventions set.

    Coordinates that are set are a target, and so is the quantity that they describe, if it has a
    column. With ``first`` a row has the beginning of a state under a name of its own.
    """
    given, shown = tuple(names), {column.variable for column in columns}
    named = {n: first_name(model, n) if first else n for g in given for n in (g, *model.targets(g))}
    whole = (target for name in given for target in model.targets(name) if named[target] in shown)
    return tuple(named[name] for name in sorted({*given, *whole}))


def columns_of(variable: Any, how: str = "value", label: str = "") -> tuple[Column, ...]:
    """Return the columns of a variable, with a word before their names if one is given."""
    name = f"{label} {variable.name}" if label else variable.name
    about = variable.unit, variable.kind, str(variable.role), variable.dtype
    if variable.shape == ():
        return (Column(name, name, None, *about, how=how),)
    numbers = range(int(np.prod(variable.shape)))
    return tuple(Column(f"{name}[{i}]", name, i, *about, how=how) for i in numbers)


def columns_of_outcome(variable: Variable, outcome: Outcome) -> tuple[Column, ...]:
    """Return the columns of an outcome; its final value has the plain name of the variable."""
    found = columns_of(variable, outcome.how, "" if outcome.how == "final" else outcome.how)
    if outcome.component is not None:
        if not 0 <= outcome.component < len(found):
            allowed = (f"0 to {len(found) - 1}",)
            raise UnknownOption(f"component of {outcome.name}", outcome.component, allowed)
        found = (found[outcome.component],)
    return tuple(replace(c, dtype="real") for c in found) if outcome.how == "mean" else found
