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
from scm_world.variables.mechanisms import Stacked, Unboxed
from scm_world.world.bound import called, key, positional

_types: Any = types  # numba is untyped

Places = Mapping[str, slice]

Said = dict[str, dict[int, Any]]
"""What functions of Python gave last, by variable and row."""


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
class Copied:
    """A bundle, whose numbers are those of its parts.

    Args:
        sources: Columns of the parts.
        place: Its own columns.
    """

    def __init__(self, sources: list[slice], place: slice) -> None:
        self._sources, self._targets = places(sources), places([place])

    def begin(self, row: int, now: Values) -> None:
        """Need nothing."""

    def compute(self, matrix: Floats, rows: Integers) -> None:
        """Copy the numbers."""
        move_columns(matrix, rows, self._sources, self._targets)


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
        function: What is called.
        parents: What it is given.
        where: Columns of the arguments.
        shapes: Of the arguments.
        place: Columns of the result.
        said: What functions of Python gave, by variable and row: a table of numbers does not have
            its type. The results of this one are added, under ``name``.
        name: Of the variable.
    """

    def __init__(
        self,
        function: Any,
        parents: tuple[Parent, ...],
        where: list[slice],
        shapes: list[tuple[int, ...]],
        place: slice,
        said: Said,
        name: str,
    ) -> None:
        self._function, self._place = function, place
        self._given = tuple(
            (key(parent), columns, shape, said.get(parent.name) if parent.lag == 0 else None)
            for parent, columns, shape in zip(parents, where, shapes, strict=True)
        )
        self._kinds: dict[tuple[int, str], tuple[type, Any]] = {}
        self._found = said.setdefault(name, {})

    def begin(self, row: int, now: Values) -> None:
        """Keep the types of the arguments, which a table of numbers does not have."""
        for name, _, _, _ in self._given:
            value: Any = now[name]
            self._kinds[row, name] = type(value), getattr(value, "dtype", None)

    def compute(self, matrix: Floats, rows: Integers) -> None:
        """Call it for each row."""
        kinds, found = self._kinds, self._found
        for row in rows.tolist():
            given = [
                _typed(matrix[row, columns].reshape(shape), *kinds[row, name])
                if said is None
                else said[row]
                for name, columns, shape, said in self._given
            ]
            value = self._function(*given)
            # Its own: a function may give one array again and again.
            found[row] = value.copy() if isinstance(value, np.ndarray) else value
            matrix[row, self._place] = np.ravel(value)


def _typed(value: Value, kind: type, dtype: Any) -> Any:
    """Give a value the type that it has in a single world."""
    if dtype is None:
        return kind(value.item())
    typed = value.astype(dtype)
    return typed if issubclass(kind, np.ndarray) else typed[()]


def equation(
    model: SCM,
    name: str,
    where: Places,
    earlier: Places,
    more: Columns,
    said: Said,
) -> Equation:
    """Bind the mechanism of a variable to columns.

    Args:
        model: That declares it.
        name: Of the variable.
        where: Columns of present values.
        earlier: Columns of values of one control step ago.
        more: Columns for constants, and for vectors that are put together.
        said: What functions of Python give; what follows from it is called like them.
    """
    variable: Any = model.declared(name)
    parents: tuple[Parent, ...] = tuple(variable.all_parents)
    columns = [where[p.name] if p.lag == 0 else earlier[p.name] for p in parents]
    shapes = [model.declared(p.name).shape for p in parents]
    if not any(p.lag == 0 and p.name in said for p in parents):
        found = _compiled(variable, columns, shapes, where[name], more)
        if found is not None:
            return found
    return Called(called(model, name), parents, columns, shapes, where[name], said, name)


def _compiled(
    variable: Any,
    columns: list[slice],
    shapes: list[tuple[int, ...]],
    place: slice,
    more: Columns,
) -> Equation | None:
    """Bind a mechanism that needs no Python for each row; None if it does."""
    if isinstance(variable.mechanism, Linear):
        return Weighted(variable.mechanism, columns, place)
    if variable.parts:
        return Copied(columns, place)
    function, constants = positional(variable.mechanism.bind(), len(columns))
    if isinstance(function, Unboxed):
        function = function.kernel
    stacked = isinstance(function, Stacked)
    if stacked:
        function, shapes = function.kernel, [(sum(c.stop - c.start for c in columns),)]
    if not shapes or any(len(shape) > 1 for shape in shapes):
        return None
    kinds = [VECTOR if shape else types.float64 for shape in (*shapes, *map(np.shape, constants))]
    signature = _signature(function, kinds, variable)
    if signature is None:
        return None
    whole = [more.take(np.zeros(shapes[0]))] if stacked else columns
    given = [*whole, *map(more.take, constants)]
    compiled = Compiled(Each(function, signature, given, place))
    return Together(compiled, columns, whole[0]) if stacked else compiled


def _signature(function: Any, kinds: list[Any], variable: Variable) -> Any:
    """Find the signature with which a dispatcher is called; None where it is none, or has none."""
    if not is_jitted(function):
        return None
    try:
        function.compile(tuple(kinds))
        made: Any = function.overloads[tuple(kinds)]
    except (NumbaError, KeyError, RuntimeError):
        return None
    result = _types.unliteral(made.signature.return_type)
    one = isinstance(result, types.Float | types.Integer | types.Boolean)
    several = result == VECTOR
    return result(*kinds) if (several if variable.shape else one) else None
