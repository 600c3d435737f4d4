"""Mechanisms bound to the columns of a table: how a variable is computed in many worlds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, final

import numpy as np
from numba import types
from numba.core.errors import NumbaError
from numba.extending import is_jitted

from scm_world._types import Floats, Integers, Value, Values
from scm_world.geometry.gather import places
from scm_world.geometry.rows import VECTOR, Each, move_columns
from scm_world.graph import SCM
from scm_world.variables import Linear, Parent
from scm_world.variables.kinds import Variable
from scm_world.variables.mechanisms import Stacked
from scm_world.world.bound import positional

Places = Mapping[str, slice]


@final
class Columns:
    """Columns at the end of a table, for what is no variable.

    Args:
        first: Number of the first one.

    Attributes:
        values: What stands in them at first.
    """

    def __init__(self, first: int) -> None:
        self._first = first
        self.values: list[float] = []

    def take(self, value: Any) -> slice:
        """Take as many as a number or vector needs."""
        first = self._first + len(self.values)
        self.values.extend(map(float, np.ravel(value)))
        return slice(first, self._first + len(self.values))


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
class Together:
    """A compiled function of one vector, which is put together first.

    Args:
        function: Of the vector.
        sources: Columns of its parts.
        place: Its own columns.
    """

    def __init__(self, function: Compiled, sources: list[slice], place: slice) -> None:
        self._function, self._sources = function, places(sources)
        self._targets = places([place])

    def begin(self, row: int, now: Values) -> None:
        """Need nothing."""

    def compute(self, matrix: Floats, rows: Integers) -> None:
        """Collect the numbers of each row, and call it."""
        move_columns(matrix, rows, self._sources, self._targets)
        self._function.compute(matrix, rows)


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
    """Give a value the type that it had when its row began, if it still fits.

    A function of Python may give a whole number in one step and a fraction in the next.
    """
    if np.dtype(kind).kind in "biu" and not (value == np.rint(value)).all():
        kind = float
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
    more: Columns,
) -> Equation:
    """Bind the mechanism of a variable to columns.

    Args:
        model: That declares it.
        name: Of the variable.
        where: Columns of present values.
        earlier: Columns of values of one control step ago.
        more: Columns for constants, and for vectors that are put together.
    """
    variable: Any = model.declared(name)
    parents: tuple[Parent, ...] = tuple(variable.all_parents)
    columns = [where[p.name] if p.lag == 0 else earlier[p.name] for p in parents]
    shapes = [model.declared(p.name).shape for p in parents]
    place = where[name]
    if isinstance(variable.mechanism, Linear):
        return Weighted(variable.mechanism, columns, place)
    bound = variable.mechanism.bind()
    function, constants = positional(bound, len(parents))
    stacked = isinstance(function, Stacked)
    if stacked:
        function, shapes = function.kernel, [(sum(c.stop - c.start for c in columns),)]
    kinds = [VECTOR if shape else types.float64 for shape in (*shapes, *map(np.shape, constants))]
    signature = None
    if parents and all(len(shape) < 2 for shape in shapes):
        signature = _signature(function, kinds, variable)
    if signature is None:
        shapes = [model.declared(p.name).shape for p in parents]
        return Called(bound, parents, columns, shapes, place)
    sources = columns
    if stacked:
        columns = [more.take(np.zeros(shapes[0]))]
    columns = [*columns, *map(more.take, constants)]
    compiled = Compiled(Each(function, signature, columns, place))
    return Together(compiled, sources, columns[0]) if stacked else compiled


def _signature(function: Any, kinds: list[Any], variable: Variable) -> Any:
    """Find the signature with which a dispatcher is called; None where it is none, or has none."""
    if not is_jitted(function):
        return None
    try:
        function.compile(tuple(kinds))
        made: Any = function.overloads[tuple(kinds)]
    except (NumbaError, KeyError, RuntimeError):
        return None
    result = made.signature.return_type
    one, several = isinstance(result, types.Number | types.Boolean), result == VECTOR
    return result(*kinds) if (several if variable.shape else one) else None
