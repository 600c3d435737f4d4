"""A compiled function of a few values, applied to every row of a table.

A table is a matrix: each row is a world, and each value stands in some of the columns. Loops over
rows are compiled once for every signature, not for every function, and are kept on disk.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import overload

_types: Any = types  # numba is untyped
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
        return here + _arguments(matrix, row, where, number + 1, likes[1:])  # noqa: RUF005 # numba

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


def _each(
    function: Any, matrix: Any, rows: Any, where: Any, likes: Any, first: int, stop: int
) -> None:
    for row in rows:
        _put(matrix, row, first, stop, function(*_arguments(matrix, row, where, 0, likes)))


@cache
def each(signature: Any) -> Any:
    """Give the loop that calls a compiled function of this signature for rows of a table.

    Args:
        signature: Of the function: vectors (``VECTOR``) and numbers to a vector or a number.

    Returns:
        A function of the function, the matrix, shape (n, w), the rows, shape (m,), the columns of
        the arguments, shape (k, 2): first and one past the last, examples of the arguments, and
        both ends of the columns of the result.
    """
    made = types.void(
        types.FunctionType(signature),
        _MATRIX,
        types.int64[::1],
        _WHERE,
        _types.Tuple(signature.args),
        types.int64,
        types.int64,
    )
    return njit(made, cache=True)(_each)


def examples(signature: Any) -> tuple[Any, ...]:
    """Give a value of the type of each argument."""
    empty = np.empty(0)
    return tuple(empty if kind == VECTOR else 0.0 for kind in signature.args)


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
