"""What is written down of the episodes of a world: which columns, and how they are read."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cached_property
from typing import Any, final

import numpy as np

from scm_world._types import Floats
from scm_world.discovery.data.dataset import Column, columns_of
from scm_world.discovery.data.sensors import Sensors
from scm_world.errors import UnknownOption, UnknownVariable
from scm_world.graph import SCM
from scm_world.queries.episodes import Episode
from scm_world.queries.outcomes import Outcome, column
from scm_world.tasks.model import REWARD
from scm_world.tasks.rewards import SUCCESS
from scm_world.variables import Exogenous, Variable
from scm_world.variables.reserved import ACTUATOR_NOISE, PRESET, SENSOR_NOISE
from scm_world.world import World

NO_CAUSES = ("camera_*", "light_*", "*color", SENSOR_NOISE, ACTUATOR_NOISE, PRESET)
"""What looks, or disturbs the measurement, but moves nothing; patterns of names."""


def default_causes(world: World | SCM) -> tuple[str, ...]:
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
    model = world.model if isinstance(world, World) else world
    colors, structure = set[str](), set[str]()
    if isinstance(world, World):
        colors = {f"{block}.color" for block in world.compiled.task.tools()}
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


def default_outcomes(world: World, *, every_step: bool = False) -> tuple[Outcome, ...]:
    """List what is measured, if nothing else is asked for.

    Of the robot's tasks these are the blocks that move, and success; of any other system all
    states, and what counts in it.

    Args:
        world: That is measured.
        every_step: Whether it is measured at every instant; then the joints are listed, too, since
            the robot is what moves the blocks.
    """
    names = world.compiled.task.measured(every_step=every_step)
    if names is None:
        names = (*world.compiled.slices, REWARD, SUCCESS)
    return tuple(Outcome(name) for name in names if name in world.model)


def _is_like(name: str, patterns: Iterable[str]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def settable(world: World | SCM, patterns: Iterable[str]) -> tuple[str, ...]:
    """List the variables that can be set and are named like one of the patterns.

    Raises:
        UnknownVariable: A pattern names nothing that can be set.
    """
    model = world.model if isinstance(world, World) else world
    actions = world.compiled.commanded if isinstance(world, World) else ()
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


def first_label(model: SCM, name: str) -> str:
    """Name the beginning of a variable: of a state it is not what its end is.

    Example:
        >>> from scm_world.queries import World
        >>> model = World("pushing", backend="fake").model
        >>> [first_label(model, name) for name in ("tool_block.mass", "joint_positions")]
        ['', 'first']
    """
    return "first" if is_state(model, name) else ""


def is_state(model: SCM, name: str) -> bool:
    """Tell whether a variable, or what it gives the coordinates of, is moved by physics."""
    return model.declared(model.target(name)).role == "state"


def reached(model: SCM, names: Iterable[str]) -> tuple[str, ...]:
    """Name the variables that interventions set: with coordinates, the quantity, too."""
    given = tuple(names)
    return tuple(sorted({*given, *(target for name in given for target in model.targets(name))}))


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


# --- one row per episode ----------------------------------------------------------------------


@final
@dataclass(frozen=True)
class Ends:
    """One row per episode: causes as they are at its beginning, and outcomes.

    Args:
        world: That is watched.
        causes: Names of variables.
        outcomes: What is measured.
    """

    world: World
    causes: Sequence[str]
    outcomes: Sequence[Outcome]

    @property
    def columns(self) -> tuple[Column, ...]:
        """What stands in a row."""
        model, declared = self.world.model, self.world.model.declared
        causes = [
            labelled(columns_of(declared(name), "first"), first_label(model, name))
            for name in self.causes
        ]
        outcomes = [columns_of_outcome(declared(o.name), o) for o in self.outcomes]
        return tuple(column for part in (*causes, *outcomes) for column in part)

    @property
    def watched(self) -> tuple[str, ...]:
        """Variables to write down on the way."""
        return tuple(dict.fromkeys((*self.causes, *(o.name for o in self.outcomes))))

    def targets(self, names: Iterable[str], step: int) -> tuple[str, ...]:
        """Name the columns' variables that an intervention at the beginning sets."""
        model = self.world.model
        return tuple(f"{first_label(model, n)} {n}".strip() for n in reached(model, names))

    def rows(self, episode: Episode, sensors: Sensors) -> Floats:
        """Read an episode, shape (1, p)."""
        values = [sensors.read(episode, outcome) for outcome in self._read]
        return np.concatenate([np.ravel(value) for value in values])[None]

    @cached_property
    def _read(self) -> tuple[Outcome, ...]:
        return (*(Outcome(name, "first") for name in self.causes), *self.outcomes)


# --- one row per instant ----------------------------------------------------------------------


@final
@dataclass(frozen=True)
class Instants:
    """One row per control step: everything as it is when the action is chosen, and the action.

    Args:
        world: That is watched.
        names: Of variables.

    Raises:
        UnknownOption: An outcome sums up the episode.
    """

    world: World
    names: Sequence[str]

    @property
    def columns(self) -> tuple[Column, ...]:
        """What stands in a row."""
        declared = self.world.model.declared
        return tuple(c for name in self.watched for c in columns_of(declared(name)))

    @property
    def watched(self) -> tuple[str, ...]:
        """Variables to write down on the way; the actions are always among them."""
        return tuple(dict.fromkeys((*self.names, *self.world.compiled.actions)))

    def targets(self, names: Iterable[str], step: int) -> tuple[str, ...]:
        """Name what is set in the row of a control step: a state is at the first one only."""
        model = self.world.model
        return tuple(n for n in reached(model, names) if step == 0 or not is_state(model, n))

    def rows(self, episode: Episode, sensors: Sensors) -> Floats:
        """Read an episode, shape (steps, p)."""
        parts = [
            # At an instant the world still has the action of the step before.
            np.asarray(episode[name], float)[1:]
            if name in self.world.compiled.commanded
            else sensors.instants(episode, name)[:-1]
            for name in self.watched
        ]
        return np.concatenate([part.reshape(episode.steps, -1) for part in parts], axis=1)


def names_of(outcomes: Iterable[Any]) -> tuple[str, ...]:
    """Name the variables of outcomes, for rows of instants.

    Raises:
        UnknownOption: An outcome is not simply a variable.
    """
    found = []
    for given in outcomes:
        name = given.name if given == Outcome(given.name) else None
        if name is None:
            allowed = ("names of variables with every_step=True",)
            raise UnknownOption("outcome", str(given), allowed)
        found.append(name)
    return tuple(found)
