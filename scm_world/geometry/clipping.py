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
    """Gather numbers of some rows, saturate them at their bounds, and scale them into 32 bits.

    ``sources`` has the column of each number, ``shifts`` what is added to it first, ``scale`` the
    lower and upper bounds, gains and offsets, shape (4, k).
    """
    for row in rows:
        for j in range(sources.size):
            number = matrix[row, sources[j]]
            if shifts[j] != 0.0:
                number += shifts[j]
            number = min(max(number, scale[0, j]), scale[1, j])
            out[row, j] = number * scale[2, j] + scale[3, j]
