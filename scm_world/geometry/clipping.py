"""Numbers brought into their range, in compiled loops."""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from scm_world._types import Floats, Integers


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
    """Gather numbers of some rows, saturate them at their bounds, and scale them.

    Args:
        matrix: The matrix, shape (n, w).
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
