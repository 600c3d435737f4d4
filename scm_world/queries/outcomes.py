"""What is asked for: a variable, a summary of one over the episode, or a function of it."""

from __future__ import annotations

from typing import Any, Literal, final

import numpy as np

from scm_world._types import Floats
from scm_world.errors import UnknownOption
from scm_world.queries.episodes import Episode
from scm_world.tasks.rewards import FRACTION
from scm_world.variables.spaces import Frozen
from scm_world.world import World

HOWS = ("final", "mean", "max", "min", "sum", "first", "change")
Given = "str | Outcome | Callable[[Episode], Any]"


@final
class Outcome(Frozen):
    """A number that an episode ends with, or a row of them.

    Attributes:
        name: Of the variable.
        how: Over the instants after the first action: its ``"final"`` value, its ``"mean"``,
            ``"max"``, ``"min"`` or ``"sum"``; its ``"first"`` value at the beginning; or the
            ``"change"`` from the beginning to the end.
        component: Which number of it; all of them if None.

    Example:
        >>> Outcome("reward", "sum")
        Outcome(name='reward', how='sum', component=None)
    """

    name: str
    how: Literal["final", "mean", "max", "min", "sum", "first", "change"] = "final"
    component: int | None = None

    def __init__(self, name: str, how: str = "final", component: int | None = None) -> None:
        if how not in HOWS:
            raise UnknownOption("outcome", how, HOWS)
        super().__init__(name=name, how=how, component=component)  # type: ignore[call-arg]

    def of(self, episode: Episode) -> Floats:
        """Read it off an episode."""
        values = np.asarray(episode[self.name], dtype=np.float64)
        if self.component is not None:
            flat = values.reshape(len(values), -1)
            if not 0 <= self.component < flat.shape[1]:
                allowed = (f"0 to {flat.shape[1] - 1}",)
                raise UnknownOption(f"component of {self.name}", self.component, allowed)
            values = flat[:, self.component]
        if not len(values):
            raise UnknownOption("outcome", self.name, ("a variable that is there",))
        match self.how:
            case "final":
                return np.asarray(values[-1])
            case "first":
                return np.asarray(values[0])
            case "change":
                return np.asarray(values[-1] - values[0])
        return np.asarray(getattr(values[1:], self.how)(axis=0))

    def __str__(self) -> str:
        part = "" if self.component is None else f"[{self.component}]"
        return f"{self.how} {self.name}{part}"


def as_outcome(given: Any) -> Any:
    """Turn the name of a variable into its final value.

    Raises:
        UnknownOption: It is neither a name, nor an ``Outcome``, nor a function.
    """
    if isinstance(given, str):
        return Outcome(given)
    if isinstance(given, Outcome) or callable(given):
        return given
    raise UnknownOption(
        "outcome",
        given,
        ("the name of a variable", "Outcome(name, how)", "a function of the episode"),
    )


def usual_outcomes(world: World) -> tuple[str, ...]:
    """Name what is read off episodes if nothing else is asked for.

    That is the fractional success of the robot's tasks, and of any other system everything that
    is computed from its states: readouts, outcomes, reward and success.

    Raises:
        UnknownOption: Nothing is computed from the states.
    """
    if FRACTION in world.model:
        return (FRACTION,)
    declaration = world.declaration
    found = tuple(name for name in declaration.computed if name not in declaration.bundles)
    if not found:
        allowed = ("names of variables, such as " + repr(next(iter(world.declaration.slices))),)
        raise UnknownOption("outcomes", None, allowed)
    return found


def watched(outcome: Any) -> tuple[str, ...]:
    """Name the variables that have to be written down for an outcome."""
    return (outcome.name,) if isinstance(outcome, Outcome) else ()


def read(outcome: Any, episode: Episode) -> Floats:
    """Read an outcome off an episode, as numbers.

    Raises:
        UnknownOption: A function gave no finite numbers.
    """
    value = outcome.of(episode) if isinstance(outcome, Outcome) else outcome(episode)
    try:
        number = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        number = np.asarray(np.nan)
    if not np.isfinite(number).all():
        raise UnknownOption("value of the outcome", value, ("finite numbers",))
    return number


def column(outcome: Any) -> str:
    """Name the column of an outcome: that of the variable for its final value."""
    return label(outcome).removeprefix("final ")


def label(outcome: Any) -> str:
    """Write an outcome down."""
    return str(outcome) if isinstance(outcome, Outcome) else getattr(outcome, "__name__", "outcome")
