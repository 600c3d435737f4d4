"""Compiled code, and numbers in it: read, brought into their range, gathered."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar

import numba
import numpy as np
from numba import types
from numba.extending import overload
from numpy.typing import NDArray

from scm_world._types import Floats, Value

F = TypeVar("F", bound=Callable[..., Any])
UNCACHED: set[str] = set()
"""Names of compiled functions for which no folder can keep the code."""


def njit(*signature: Any, **options: Any) -> Callable[[F], F]:
    """Compile a function as ``numba.njit`` does, also where no folder can keep the code."""

    def compiled(function: F) -> F:
        try:
            made: F = numba.njit(*signature, **options)(function)
        except RuntimeError as error:
            if not (options.get("cache") and "cannot cache" in str(error)):
                raise
            UNCACHED.add(function.__qualname__)
            made = numba.njit(*signature, **{**options, "cache": False})(function)
        return made

    return compiled


def scalar(value: Value | float) -> float:
    """Return a number as a float, also one that comes as an array of shape ().

    Compiled code may call it, where ``float`` refuses arrays.
    """
    return float(value)


@overload(scalar)
def _scalar(value: Any) -> Any:
    def of_array(value: Any) -> Any:
        return float(value[()])

    def of_number(value: Any) -> Any:
        return float(value)

    return of_array if isinstance(value, types.Array) else of_number


@njit(
    [
        f"b1(Array({kind}, 1, 'A', readonly=True), f8[:, ::1], f8[::1])"  # of any memory layout
        for kind in ("f4", "f8")
    ],
    cache=True,
)
def scale_and_clip(values: Value, scale: Floats, out: Floats) -> bool:
    """Scale numbers and clip them; return whether all are finite, else nothing is written.

    ``scale`` has for each number a summand, a factor, and the lower and upper end, shape (4, n);
    the values of several rows, shape (m * n,), come one row after another.
    """
    for i in range(values.size):
        if not math.isfinite(values[i]):
            return False
    n = scale.shape[1]
    for i in range(values.size):
        j, value = i % n, float(values[i])
        out[i] = min(max(scale[0, j] + scale[1, j] * value, scale[2, j]), scale[3, j])
    return True


@njit(cache=True)
def scale_rows(matrix: Floats, scale: Floats, out: NDArray[np.float32]) -> None:
    """Gather numbers of every row, saturate them at their bounds, and scale them into 32 bits.

    They are written one row after another, shape (m * k,). ``scale`` has for each number the lower
    and upper bound, gain, offset, the summand that comes first, and its column, shape (6, k).
    """
    k = scale.shape[1]
    for row in range(matrix.shape[0]):
        for j in range(k):
            number = matrix[row, int(scale[5, j])]
            if scale[4, j] != 0.0:
                number += scale[4, j]
            number = min(max(number, scale[0, j]), scale[1, j])
            out[row * k + j] = number * scale[2, j] + scale[3, j]
