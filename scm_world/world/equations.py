"""Mechanisms bound to the columns of a table: how a variable is computed in many worlds."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from functools import partial
from typing import Any, Protocol, final

import numpy as np
from numba import types
from numba.core.errors import NumbaError
from numba.extending import is_jitted

from scm_world._types import Floats, Integers, Value, Values
from scm_world.geometry.rows import VECTOR, Each
from scm_world.graph import SCM
from scm_world.variables import Linear, Parent
from scm_world.variables.kinds import Variable

Places = Mapping[str, slice]


class Equation(Protocol):
    """How one variable follows from others, in rows of a table."""

    def begin(self, row: int, now: Values) -> None:
        """Look at the values of a world that begins its row."""

    def compute(self, matrix: Floats, rows: Integers) -> None:
        """Write the variable into its columns of some rows."""


@final
class Compiled:
    """A compiled function, called in a compiled loop.

    Args:
        each: The loop.
    """

    def __init__(self, each: Each) -> None:
        self._each = each

    def begin(self, row: int, now: Values) -> None:
        """Need nothing."""

    def compute(self, matrix: Floats, rows: Integers) -> None:
        """Call it for each row."""
        self._each(matrix, rows)


@final
class Weighted:
    """A weighted sum of numbers, added up in the order of ``Linear``.

    Args:
        mechanism: With the weights.
        where: Columns of the numbers.
        place: Column of the sum.
    """

    def __init__(self, mechanism: Linear, where: list[slice], place: slice) -> None:
        self._weights = tuple(
            (weight, column.start) for weight, column in zip(mechanism.weights, where, strict=True)
        )
        self._intercept, self._place = mechanism.intercept, place.start

    def begin(self, row: int, now: Values) -> None:
        """Need nothing."""

    def compute(self, matrix: Floats, rows: Integers) -> None:
        """Add up."""
        total = np.full(len(rows), 0.0 + self._intercept)
        for weight, column in self._weights:
            total += weight * matrix[rows, column]
        matrix[rows, self._place] = total


@final
class Called:
    """A function of Python, called for one row after another.

    Args:
        function: With its constants bound.
        parents: Names and whether they are of one control step ago.
        where: Columns of the arguments.
        shapes: Of the arguments.
        place: Columns of the result.
    """

    def __init__(
        self,
        function: Any,
        parents: tuple[Parent, ...],
        where: list[slice],
        shapes: list[tuple[int, ...]],
        place: slice,
    ) -> None:
        self._function, self._place = function, place
        self._arguments = tuple(zip(parents, where, shapes, strict=True))
        self._kinds: dict[tuple[int, str], Any] = {}

    def begin(self, row: int, now: Values) -> None:
        """Keep the types of the arguments, which a table of numbers does not have."""
        for parent, _, _ in self._arguments:
            value: Any = now.get(parent.name)
            self._kinds[row, parent.name] = getattr(value, "dtype", None) or type(value)

    def compute(self, matrix: Floats, rows: Integers) -> None:
        """Call it for each row."""
        for row in rows.tolist():
            given = [
                _typed(matrix[row, place].reshape(shape), self._kinds[row, parent.name], parent.lag)
                for parent, place, shape in self._arguments
            ]
            matrix[row, self._place] = np.ravel(self._function(*given))


def _typed(value: Value, kind: Any, lag: int) -> Any:
    """Give a value the type that it has in a single world."""
    if isinstance(kind, np.dtype):
        return value.astype(kind)
    if lag:
        return np.array(kind(value.item()))
    return kind(value.item()) if value.ndim == 0 else value.copy()


def equation(
    model: SCM,
    name: str,
    where: Places,
    earlier: Places,
    constants: list[float],
    width: int,
) -> Equation:
    """Bind the mechanism of a variable to columns.

    Args:
        model: That declares it.
        name: Of the variable.
        where: Columns of present values.
        earlier: Columns of values of one control step ago.
        constants: Values of columns that follow the others; those of this mechanism are added.
        width: How many columns there are before them.
    """
    variable: Any = model.declared(name)
    parents: tuple[Parent, ...] = tuple(variable.all_parents)
    columns = [where[p.name] if p.lag == 0 else earlier[p.name] for p in parents]
    shapes = [model.declared(p.name).shape for p in parents]
    place = where[name]
    if isinstance(variable.mechanism, Linear):
        return Weighted(variable.mechanism, columns, place)
    function = variable.mechanism.bind()
    found = _compiled(function, shapes, variable, len(constants) + width)
    if found is None:
        return Called(function, parents, columns, shapes, place)
    signature, more, values = found
    constants.extend(values)
    return Compiled(Each(_inner(function), signature, columns + more, place))


def _inner(function: Any) -> Any:
    return function.func if isinstance(function, partial) else function


def _compiled(
    function: Any, shapes: list[tuple[int, ...]], variable: Variable, width: int
) -> tuple[Any, list[slice], list[float]] | None:
    """Find the signature with which a dispatcher is called; None where it is none, or has none.

    Returns:
        The signature, the columns of the constants, and their values.
    """
    inner = _inner(function)
    if not is_jitted(inner) or not shapes or any(len(shape) > 1 for shape in shapes):
        return None
    kinds = [VECTOR if shape else types.float64 for shape in shapes]
    slices: list[slice] = []
    values: list[float] = []
    for value in _constants(function, len(shapes)):
        numbers = np.ravel(value).tolist()
        first = width + len(values)
        slices.append(slice(first, first + len(numbers)))
        values.extend(map(float, numbers))
        kinds.append(VECTOR if np.ndim(value) else types.float64)
    try:
        inner.compile(tuple(kinds))
        made: Any = inner.overloads[tuple(kinds)]
        result = made.signature.return_type
    except (NumbaError, KeyError, RuntimeError):
        return None
    one, several = isinstance(result, types.Number | types.Boolean), result == VECTOR
    if not (several if variable.shape else one):
        return None
    return result(*kinds), slices, values


def _constants(function: Any, count: int) -> list[Any]:
    """Give the constants of a function in the order of its parameters, after the parents."""
    if not isinstance(function, partial):
        return []
    inner: Any = function.func
    names = list(inspect.signature(inner.py_func).parameters)[count:]
    return [function.keywords[name] for name in names if name in function.keywords]
