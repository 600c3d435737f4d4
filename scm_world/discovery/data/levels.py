"""Grids of interventions: which values each variable takes, and all combinations of them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from scm_world._arguments import whole_number
from scm_world.errors import UnknownOption
from scm_world.graph import SCM
from scm_world.variables import Box, Categories, Either, Integers, Variable
from scm_world.variables.kinds import SPACES

LEVELS = 5
MOST = 100_000  # points: each has its own plan, and a row of the table

Point = Mapping[str, Any]
"""What is done: values as plain numbers or lists, by variable."""


@final
@dataclass(frozen=True)
class Levels:
    """Values of a variable that lie evenly in a space, from one end to the other.

    Attributes:
        space: ``"A"``, ``"B"`` or ``"A|B"`` of the variable, or a ``Box``, ``Integers`` or
            ``Categories``. Of a vector, the values lead from the lower corner to the upper one; of
            categories all are taken.
        count: How many, where there are so many.
    """

    space: Any = "A"
    count: int = LEVELS

    def of(self, variable: Variable) -> tuple[Any, ...]:
        """List the values.

        Raises:
            UnknownOption: There is no such space, or it has no ends.
        """
        count = whole_number(f"levels of {variable.name}", self.count, least=1)
        check_points(count)
        space = self.space
        if isinstance(space, str):
            if space not in SPACES:
                raise UnknownOption(f"levels of {variable.name}", space, (*SPACES, "values"))
            space = variable.space(space)
        if space is None:
            allowed = ("values, as it has no such space",)
            raise UnknownOption(f"levels of {variable.name}", self.space, allowed)
        return tuple(_plain(value) for value in _evenly(variable, space, count))


def _evenly(variable: Variable, space: Any, count: int) -> Sequence[Any]:
    match space:
        case Categories():
            return space.members
        case Integers():
            return sorted({round(x) for x in np.linspace(space.low, space.high, count)})
        case Either():
            first, other = -(-count // 2), count // 2
            rest = _evenly(variable, space.second, other) if other else ()
            return (*_evenly(variable, space.first, first), *rest)
        case Box() if not space.parents():
            low, high = space.bounds(variable.shape, {})
            return [np.asarray(value) for value in np.linspace(low, high, count)]
    allowed = ("a space with ends of its own", "values")
    raise UnknownOption(f"levels of {variable.name}", space, allowed)


def _plain(value: Any) -> Any:
    return np.asarray(value).tolist()


def points_of(over: Mapping[str, Any], model: SCM) -> tuple[Point, ...]:
    """List every combination of the values of some variables, the last one varying fastest.

    Args:
        over: By variable: a list of values, ``Levels``, or a space, which is five levels of it.
        model: Knows the variables.

    Raises:
        UnknownVariable: No variable has this name.
        UnknownOption: A variable has no values, what is given is none, or there are too many
            combinations.

    Example:
        >>> from scm_world.variables import Exogenous
        >>> model = SCM([Exogenous(name="x", a=Box(0.0, 1.0)), Exogenous(name="y")])
        >>> points_of({"x": Levels("A", 2), "y": [5.0]}, model)
        ({'x': 0.0, 'y': 5.0}, {'x': 1.0, 'y': 5.0})
    """
    if not over:
        raise UnknownOption("over", "nothing", ("one variable or more, with values",))
    columns = [_values(name, given, model) for name, given in over.items()]
    check_points(math.prod(map(len, columns)))
    return tuple(dict(zip(over, chosen, strict=True)) for chosen in itertools.product(*columns))


def check_points(count: int) -> None:
    """Refuse a grid with more points than a table can have.

    Raises:
        UnknownOption: It has.
    """
    if count > MOST:
        allowed = (f"at most {MOST}: give fewer values, or several sweeps",)
        raise UnknownOption("points of the grid", count, allowed)


def _values(name: str, given: Any, model: SCM) -> tuple[Any, ...]:
    variable = model.declared(name)
    if isinstance(given, str | Box | Integers | Categories | Either):
        given = Levels(given)
    if isinstance(given, Levels):
        return given.of(variable)
    try:
        found = tuple(np.asarray(value, dtype=float).tolist() for value in given)
    except (TypeError, ValueError):
        found = ()
    if not found or any(found.count(value) > 1 for value in found):
        allowed = ("numbers, each of them once", "Levels(space, count)", "a space")
        raise UnknownOption(f"values of {name}", given, allowed)
    return found
