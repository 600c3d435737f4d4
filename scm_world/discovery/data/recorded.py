"""What is written down of the episodes of a world: which columns, and how they are read."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from fnmatch import fnmatchcase

from scm_world._arguments import typed
from scm_world.discovery.data.dataset import Column, columns_of
from scm_world.errors import UnknownOption, UnknownVariable
from scm_world.graph import SCM
from scm_world.queries.equations import Equations, System
from scm_world.queries.outcomes import Outcome, column, usual_outcomes
from scm_world.tasks.model import REWARD
from scm_world.tasks.rewards import SUCCESS
from scm_world.variables import Exogenous, Variable
from scm_world.variables.reserved import ACTUATOR_NOISE, PRESET, SENSOR_NOISE
from scm_world.world import Simulation

NO_CAUSES = ("camera_*", "light_*", "*color", SENSOR_NOISE, ACTUATOR_NOISE, PRESET)
"""What looks, or disturbs the measurement, but moves nothing; patterns of names."""


@typed
def default_causes(world: System | SCM) -> tuple[str, ...]:
    """List the parameters that an experiment varies, if nothing else is asked for.

    They are exogenous and real, can be set, have a space A, and are physical: no cameras, lights,
    noises or settings of the engine, and nothing that decides which bodies there are. The
    colors of the blocks that can be moved are among them: they cause nothing.

    Example:
        >>> from scm_world.queries import World
        >>> found = default_causes(World("pushing", backend="fake"))
        >>> "tool_block.mass" in found, "tool_block.color" in found, "floor_color" in found
        (True, True, False)
    """
    model = world if isinstance(world, SCM) else world.model
    colors, structure = set[str](), set[str]()
    if isinstance(world, Simulation):
        colors = {f"{block}.color" for block in world.compiled.task.goal.tools}
        structure = set(world.structures.head)
    return tuple(
        variable.name
        for variable in map(model.declared, model)
        if isinstance(variable, Exogenous)
        and variable.settable
        and variable.a is not None
        and variable.dtype == "real"
        and variable.name not in structure
        and (variable.name in colors or not _is_like(variable.name, NO_CAUSES))
    )


@typed
def default_outcomes(world: System, *, every_step: bool = False) -> tuple[Outcome, ...]:
    """List what is measured, if nothing else is asked for.

    Of the robot's tasks these are the blocks that move, and success; of any other world all
    states, and what counts in it; of equations all variables but actions.

    Args:
        world: That is measured.
        every_step: Whether it is measured at every instant; then the joints are listed, too, since
            the robot is what moves the blocks.
    """
    if isinstance(world, Equations):
        return tuple(map(Outcome, usual_outcomes(world)))
    observation = world.compiled.task.observation
    names = observation.measured
    if names is None:
        names = (*world.compiled.slices, REWARD, SUCCESS)
    elif every_step:
        names = (*observation.moving, *names)
    return tuple(Outcome(name) for name in names if name in world.model)


def _is_like(name: str, patterns: Iterable[str]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def settable(world: System | SCM, patterns: Iterable[str]) -> tuple[str, ...]:
    """List the variables that can be set and are named like one of the patterns.

    Raises:
        UnknownVariable: A pattern names nothing that can be set.
    """
    model = world if isinstance(world, SCM) else world.model
    actions = world.compiled.commanded if isinstance(world, Simulation) else ()
    names = [n for n in model if model.declared(model.target(n)).settable and n not in actions]
    given = (patterns,) if isinstance(patterns, str) else tuple(patterns)
    for pattern in given:
        if not any(fnmatchcase(name, pattern) for name in names):
            raise UnknownVariable(pattern, names)
    return tuple(name for name in names if _is_like(name, given))


# --- columns ----------------------------------------------------------------------------------


def labelled(columns: Iterable[Column], label: str) -> tuple[Column, ...]:
    """Put a word before the names of columns and of the variable they belong to."""
    lead = f"{label} " if label else ""
    return tuple(replace(c, name=lead + c.name, variable=lead + c.variable) for c in columns)


def first_name(model: SCM, name: str) -> str:
    """Name the beginning of a variable: of a state it is not what its end is.

    Example:
        >>> from scm_world.queries import World
        >>> model = World("pushing", backend="fake").model
        >>> [first_name(model, name) for name in ("tool_block.mass", "joint_positions")]
        ['tool_block.mass', 'first joint_positions']
    """
    return f"first {name}" if is_state(model, name) else name


def is_state(model: SCM, name: str) -> bool:
    """Tell whether a variable, or what it gives the coordinates of, is moved by physics."""
    return model.declared(model.target(name)).role == "state"


def reached(
    model: SCM, names: Iterable[str], columns: Iterable[Column], *, first: bool = False
) -> tuple[str, ...]:
    """Name the variables that interventions set.

    With coordinates the quantity is set, too. It is named where it has a column; otherwise the
    coordinates stand for it.

    Args:
        model: Of the system.
        names: The targets of the interventions.
        columns: Of a row.
        first: Whether a row has the beginning of a state under a name of its own.
    """

    def named(name: str) -> str:
        return first_name(model, name) if first else name

    given, shown = tuple(names), {column.variable for column in columns}
    whole = (target for name in given for target in model.targets(name) if named(target) in shown)
    return tuple(named(name) for name in sorted({*given, *whole}))


def columns_of_outcome(variable: Variable, outcome: Outcome) -> tuple[Column, ...]:
    """List the columns of an outcome; its final value has the plain name of the variable.

    Example:
        >>> from scm_world.variables import Measured
        >>> speed = Measured(name="speed", unit="m/s", shape=(3,))
        >>> [c.name for c in columns_of_outcome(speed, Outcome("speed", "mean", 1))]
        ['mean speed[1]']

    Raises:
        UnknownOption: There is no such component.
    """
    whole = columns_of(variable, outcome.how)
    if outcome.component is not None and not 0 <= outcome.component < len(whole):
        allowed = (f"0 to {len(whole) - 1}",)
        raise UnknownOption(f"component of {outcome.name}", outcome.component, allowed)
    chosen = whole if outcome.component is None else (whole[outcome.component],)
    if outcome.how == "mean":
        chosen = tuple(replace(c, dtype="real") for c in chosen)
    plain = Outcome(outcome.name, outcome.how)
    return labelled(chosen, column(plain).removesuffix(outcome.name).strip())
