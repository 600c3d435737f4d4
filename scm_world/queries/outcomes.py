"""Outcomes of episodes: a variable, a summary of one over the episode, or a function."""

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
"""The summaries that are defined for categories."""
HOWS = ("final", "mean", "max", "min", "sum", "first", "change", "path")


@final
class Outcome(Frozen):
    """A number, or an array of numbers, computed from a variable of an episode.

    Attributes:
        name: Name of the variable.
        how: Summary over the instants after the first action: the ``"final"`` value, ``"mean"``,
            ``"max"``, ``"min"`` or ``"sum"``; or the ``"first"`` value at the beginning, the
            ``"change"`` from the beginning to the end, or the ``"path"``: the values at all
            instants. In episodes of one instant, all summaries use that instant.
        component: Index of a component; all components if None.

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
        """Compute the outcome of an episode."""
        return np.asarray(self.of_many(np.asarray(episode[self.name])[None])[0])

    def of_many(self, values: Value) -> Floats:
        """Compute the outcome from values of shape (n, instants, *shape); return shape (n, ...)."""
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
    """Return an outcome; the name of a variable stands for its final value."""
    if isinstance(given, str):
        return Outcome(given)
    if isinstance(given, Outcome) or callable(given):
        return given
    allowed = ("the name of a variable", "Outcome(name, how)", "a function of the episode")
    raise UnknownOption("outcome", given, allowed)


def as_outcomes(given: Any) -> list[Any]:
    """Return a list of outcomes, also for a single one; see ``as_outcome``."""
    alone = not isinstance(given, Iterable) or isinstance(given, str | Outcome)
    return [as_outcome(outcome) for outcome in ((given,) if alone else given)]


def is_category(system: System, outcome: Any) -> bool:
    """Return whether an outcome has categories, whose numbers have no order or mean."""
    if not isinstance(outcome, Outcome) or outcome.name not in system.model:
        return False
    return system.model.declared(outcome.name).dtype == "categorical"


def usual_outcomes(world: System) -> tuple[str, ...]:
    """Return the names of the default outcomes.

    These are the fractional success for the robot's tasks; for other worlds all variables that are
    computed from states: readouts, outcomes, reward and success; for equations all variables.
    """
    if isinstance(world, Equations):
        return tuple(name for name in world.model if name not in world.compiled.actions)
    if FRACTION in world.model:
        return (FRACTION,)
    compiled = world.compiled
    found = tuple(name for name in compiled.computed if name not in compiled.bundles)
    if not found:
        allowed = ("names of variables, such as " + repr(next(iter(compiled.slices))),)
        raise UnknownOption("outcomes", None, allowed)
    return found


def read(outcome: Any, episode: Episode) -> Floats:
    """Compute an outcome of an episode, as finite numbers."""
    if isinstance(outcome, Outcome):
        return as_numbers(outcome.of(episode), outcome)
    with blamed(f"the outcome {label(outcome)!r}"):
        value = outcome(episode)
    return as_numbers(value, outcome)


def as_numbers(value: Any, outcome: Any) -> Floats:
    """Return the value of an outcome as finite numbers; refuse other values."""
    try:
        number = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        number = np.asarray(np.nan)
    if not np.isfinite(number).all():
        wrong = value if np.size(value) < 10 else number[~np.isfinite(number)][0]
        raise UnknownOption(f"value of the outcome {label(outcome)!r}", wrong, ("finite numbers",))
    return number


def column(outcome: Any) -> str:
    """Return the name of an outcome's column; the variable's name for its final value."""
    return label(outcome).removeprefix("final ")


def label(outcome: Any) -> str:
    """Return a short text for an outcome."""
    return str(outcome) if isinstance(outcome, Outcome) else getattr(outcome, "__name__", "outcome")
