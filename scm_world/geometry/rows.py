"""A compiled function of a few values, applied to every row of a table.

A table is a matrix: each row is a world, and each value stands in some of the columns. Loops over
rows are compiled once for every signature, not for every function, and are kept on disk.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Any, final

import numpy as np
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic, overload

from scm_world._types import Floats, Integers

_types: Any = types  # numba is untyped
_cgutils: Any = cgutils
VECTOR = types.float64[::1]
_MATRIX, _WHERE = types.float64[:, ::1], types.int64[:, ::1]


def _argument(matrix: Any, row: int, first: int, stop: int, like: Any) -> Any:
    """Give one argument out of a row: a vector, or a number."""


@overload(_argument)
def _overloaded_argument(matrix: Any, row: int, first: int, stop: int, like: Any) -> Any:
    def vector(matrix: Any, row: int, first: int, stop: int, like: Any) -> Any:
        return matrix[row, first:stop]

    def number(matrix: Any, row: int, first: int, stop: int, like: Any) -> Any:
        return matrix[row, first]

    return vector if isinstance(like, types.Array) else number


def _arguments(matrix: Any, row: int, where: Any, number: int, likes: Any) -> Any:
    """Give all arguments out of a row, from one on."""


@overload(_arguments)
def _overloaded_arguments(matrix: Any, row: int, where: Any, number: int, likes: Any) -> Any:
    def last(matrix: Any, row: int, where: Any, number: int, likes: Any) -> Any:
        return (_argument(matrix, row, where[number, 0], where[number, 1], likes[0]),)

    def first(matrix: Any, row: int, where: Any, number: int, likes: Any) -> Any:
        here = (_argument(matrix, row, where[number, 0], where[number, 1], likes[0]),)
        return here + _arguments(matrix, row, where, number + 1, likes[1:])  # numba

    return last if len(likes) == 1 else first


def _put(matrix: Any, row: int, first: int, stop: int, value: Any) -> Any:
    """Write a result into a row."""


@overload(_put)
def _overloaded_put(matrix: Any, row: int, first: int, stop: int, value: Any) -> Any:
    def vector(matrix: Any, row: int, first: int, stop: int, value: Any) -> Any:
        matrix[row, first:stop] = value

    def number(matrix: Any, row: int, first: int, stop: int, value: Any) -> Any:
        matrix[row, first] = value

    return vector if isinstance(value, types.Array) else number


def _called(typing: Any, address: Any, arguments: Any, like: Any) -> Any:
    """Call the compiled function at an address; its result is of the type of an example."""
    kinds = arguments.types

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        values = [builder.extract_value(given[1], i) for i in range(len(kinds))]
        calls = context.call_conv
        kind = calls.get_function_type(like, kinds).as_pointer()
        function = builder.inttoptr(given[0], kind)
        status, found = calls.call_function(builder, function, like, kinds, values)
        with _cgutils.if_unlikely(builder, status.is_error):
            calls.return_status_propagate(builder, status)  # an error is one of the loop
        return found

    return like(address, arguments, like), generate


_call: Any = intrinsic(_called)


def _each(
    address: int,
    matrix: Any,
    rows: Any,
    where: Any,
    likes: Any,
    first: int,
    stop: int,
    like: Any,
) -> None:
    for row in rows:
        given = _arguments(matrix, row, where, 0, likes)
        _put(matrix, row, first, stop, _call(address, given, like))


@cache
def _loop(signature: Any) -> Any:
    made = types.void(
        types.int64,
        _MATRIX,
        types.int64[::1],
        _WHERE,
        _types.Tuple(signature.args),
        types.int64,
        types.int64,
        signature.return_type,
    )
    return njit(made, cache=True)(_each)


@final
class Each:
    """A compiled function that is called for rows of a table.

    Args:
        function: A dispatcher of numba; what it raises, the loop raises.
        signature: With which it has been compiled: vectors (``VECTOR``) and numbers to a vector
            or a number.
        where: Columns of each argument.
        place: Columns of the result.
    """

    def __init__(self, function: Any, signature: Any, where: Iterable[slice], place: slice) -> None:
        self._function = function  # the address is that of its code
        compiled = function.get_compile_result(signature)
        name = compiled.fndesc.llvm_func_name
        self._address = compiled.library.get_pointer_to_function(name)
        self._loop = _loop(signature)
        self._where = np.array([(column.start, column.stop) for column in where], dtype=np.int64)
        self._likes = tuple(map(_example, signature.args))
        self._place = (place.start, place.stop, _example(signature.return_type))

    def __call__(self, matrix: Floats, rows: Integers) -> None:
        """Write the results of some rows, shape (m,), into a table, shape (n, w)."""
        self._loop(self._address, matrix, rows, self._where, self._likes, *self._place)


def _example(kind: Any) -> Any:
    """Give a value of a type."""
    if kind == VECTOR:
        return np.empty(0)
    return False if isinstance(kind, types.Boolean) else kind.cast_python_value(0)


@njit(cache=True)
def move_columns(matrix: Any, rows: Any, sources: Any, targets: Any) -> None:
    """Copy some columns of some rows into others: ``matrix[rows, targets]`` of the sources.

    Args:
        matrix: The table, shape (n, w).
        rows: Shape (m,).
        sources: Shape (k,).
        targets: Shape (k,).
    """
    for row in rows:
        for j in range(sources.size):
            matrix[row, targets[j]] = matrix[row, sources[j]]


@njit(cache=True)
def scale_rows(matrix: Any, rows: Any, sources: Any, shifts: Any, scale: Any, out: Any) -> None:
    """Gather numbers of some rows, saturate them at their bounds, and scale them.

    Args:
        matrix: The table, shape (n, w).
        rows: Which are written, shape (m,).
        sources: The column of each number, shape (k,).
        shifts: Added to the numbers before anything else where not 0, shape (k,).
        scale: Lower bounds, upper bounds, gains and offsets, shape (4, k).
        out: Where they are written, shape (n, k), 32-bit.
    """
    for row in rows:
        for j in range(sources.size):
            number = matrix[row, sources[j]]
            if shifts[j] != 0.0:
                number += shifts[j]
            number = min(max(number, scale[0, j]), scale[1, j])
            out[row, j] = number * scale[2, j] + scale[3, j]
