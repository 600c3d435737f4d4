"""Numbers brought into their range, in compiled loops."""

from __future__ import annotations

import math

from numba import njit

from scm_world._types import Floats


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
