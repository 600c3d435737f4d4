"""What is asked for: a variable, a summary of one over the episode, or a function of it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Literal, final

import numpy as np

from scm_world._arguments import one_of
from scm_world._types import Floats, Value
from scm_world.errors import UnknownOption, blamed
from scm_world.queries.episodes import Episode
from scm_world.queries.equations import Equations, System
from scm_world.tasks.rewards import FRACTION
from scm_world.variables.spaces import Frozen

ORDERLESS = ("final", "first", "path")
"""The summaries that categories have."""
HOWS = ("final", "mean", "max", "min", "sum", "first", "change", "path")


@final
class Outcome(Frozen):
    """A number that an episode ends with, or a row of them.

    Attributes:
        name: Of the variable.
        how: Over the instants after the first action: its ``"final"`` value, its ``"mean"``,
            ``"max"``, ``"min"`` or ``"sum"``; its ``"first"`` value at the beginning; the
            ``"change"`` from the beginning to the end; or its ``"path"``, the values at all
            instants. Where there is one instant, it counts for all of these.
        component: Which number of it; all of them if None.

    Example:
        >>> Outcome("reward", "sum")
        Outcome(name='reward', how='sum', component=None)
    """

    name: str
    how: Literal["final", "mean", "max", "min", "sum", "first", "change", "path"] = "final"
    component: int | None = None

    def __init__(self, name: str, how: str = "final", component: int | None = None) -> None:
        one_of("outcome", how, HOWS)
        super().__init__(name=name, how=how, component=component)

    def of(self, episode: Episode) -> Floats:
        """Read it off an episode."""
        return np.asarray(self.of_many(np.asarray(episode[self.name])[None])[0])

    def of_many(self, values: Value) -> Floats:
        """Read it off the values in n episodes, shape (n, instants, *shape); shape (n, ...)."""
        values = np.asarray(values, dtype=np.float64)
        n, instants = values.shape[:2]
        if self.component is not None:
            flat = values.reshape(n, instants, -1)
            if not 0 <= self.component < flat.shape[2]:
                allowed = (f"0 to {flat.shape[2] - 1}",)
                raise UnknownOption(f"component of {self.name}", self.component, allowed)
            values = np.ascontiguousarray(flat[..., self.component])
        if not instants:
            raise UnknownOption("outcome", self.name, ("a variable that is there",))
        if self.how in ("mean", "max", "min", "sum"):
            later = np.ascontiguousarray(values[:, 1:] if instants > 1 else values)
            return np.asarray(getattr(later, self.how)(axis=1))
        first, last = values[:, 0], values[:, -1]
        found = {"final": last, "first": first, "change": last - first, "path": values}
        return np.asarray(found[self.how])

    def __str__(self) -> str:
        part = "" if self.component is None else f"[{self.component}]"
        return f"{self.how} {self.name}{part}"


def as_outcome(given: Any) -> Any:
    """Turn the name of a variable into its final value; refuse what is not an outcome."""
    if isinstance(given, str):
        return Outcome(given)
    if isinstance(given, Outcome) or callable(given):
        return given
    allowed = ("the name of a variable", "Outcome(name, how)", "a function of the episode")
    raise UnknownOption("outcome", given, allowed)


def as_outcomes(given: Any) -> list[Any]:
    """Return outcomes, each as ``as_outcome`` does; a single one counts as a list of one."""
    alone = not isinstance(given, Iterable) or isinstance(given, str | Outcome)
    return [as_outcome(outcome) for outcome in ((given,) if alone else given)]


def is_category(system: System, outcome: Any) -> bool:
    """Return whether an outcome has categories, whose numbers have no order or mean."""
    if not isinstance(outcome, Outcome) or outcome.name not in system.model:
        return False
    return system.model.declared(outcome.name).dtype == "categorical"


def refuse_category(system: System, outcome: Any) -> None:
    """Refuse an outcome that has no mean."""
    wanted = as_outcome(outcome)
    if is_category(system, wanted):
        event = f"lambda episode: episode.final({wanted.name!r}) == …"
        allowed = ("a number", f"a function whose mean is a probability, as {event}")
        raise UnknownOption("outcome of an effect", outcome, allowed)


def usual_outcomes(world: System) -> tuple[str, ...]:
    """Return the names of what is read off episodes if nothing else is asked for.

    That is the fractional success of the robot's tasks, and of any other world everything that
    is computed from its states: readouts, outcomes, reward and success; of equations everything.
    """
    if isinstance(world, Equations):
        return tuple(name for name in world.model if name not in world.compiled.actions)
    if FRACTION in world.model:
        return (FRACTION,)
    declaration = world.compiled
    found = tuple(name for name in declaration.computed if name not in declaration.bundles)
    if not found:
        allowed = ("names of variables, such as " + repr(next(iter(world.compiled.slices))),)
        raise UnknownOption("outcomes", None, allowed)
    return found


def read(outcome: Any, episode: Episode) -> Floats:
    """Read an outcome off an episode, as finite numbers."""
    if isinstance(outcome, Outcome):
        return as_numbers(outcome.of(episode), outcome)
    with blamed(f"the outcome {label(outcome)!r}"):
        value = outcome(episode)
    return as_numbers(value, outcome)


def as_numbers(value: Any, outcome: Any) -> Floats:
    """Return the value of an outcome as finite numbers; refuse others, and name the first one."""
    try:
        number = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        number = np.asarray(np.nan)
    if not np.isfinite(number).all():
        wrong = value if np.size(value) < 10 else number[~np.isfinite(number)][0]
        raise UnknownOption(f"value of the outcome {label(outcome)!r}", wrong, ("finite numbers",))
    return number


def column(outcome: Any) -> str:
    """Name the column of an outcome: that of the variable for its final value."""
    return label(outcome).removeprefix("final ")


def label(outcome: Any) -> str:
    """Write an outcome down."""
    return str(outcome) if isinstance(outcome, Outcome) else getattr(outcome, "__name__", "outcome")
