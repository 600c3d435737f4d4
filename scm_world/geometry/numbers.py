"""Numbers in compiled code: read, brought into their range, gathered."""

from __future__ import annotations

import math
from typing import Any

from numba import njit, types
from numba.extending import overload

from scm_world._types import Floats, Integers


def scalar(value: Any) -> float:
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


@njit(cache=True)
def clip_kernel(values: Floats, low: Floats, high: Floats, out: Floats) -> bool:
    """Clip numbers to an interval each; tell whether all of them were finite."""
    finite = True
    for i in range(values.size):
        finite = finite and math.isfinite(values[i])
        out[i] = min(max(values[i], low[i]), high[i])
    return finite


@njit(cache=True)
def scaled_clip_kernel(
    values: Floats, middle: Floats, half: Floats, low: Floats, high: Floats, out: Floats
) -> bool:
    """Scale numbers, ``middle + half * values``, and clip them; tell whether all were finite."""
    finite = True
    for i in range(out.size):
        finite = finite and math.isfinite(values[i])
        out[i] = min(max(middle[i] + half[i] * values[i], low[i]), high[i])
    return finite


@njit(cache=True)
def scale_rows(
    matrix: Floats, rows: Integers, sources: Integers, shifts: Floats, scale: Floats, out: Any
) -> None:
    """Gather numbers of some rows, saturate them at their bounds, and scale them into 32 bits.

    ``sources`` has the column of each number, ``shifts`` the first summand, ``scale`` the
    lower and upper bounds, gains and offsets, shape (4, k).
    """
    for row in rows:
        for j in range(sources.size):
            number = matrix[row, sources[j]]
            if shifts[j] != 0.0:
                number += shifts[j]
            number = min(max(number, scale[0, j]), scale[1, j])
            out[row, j] = number * scale[2, j] + scale[3, j]
