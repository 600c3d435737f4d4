"""The one kind of array that kernels are compiled for, and how a kernel copies it."""

from __future__ import annotations

import numpy as np
from numba import njit

from scm_world._types import ArrayLike, Floats


def compact(values: ArrayLike) -> Floats:
    """Copy numbers into a writable C array of floats, so that no kernel is compiled twice."""
    return np.array(values, dtype=np.float64, order="C")


def rows(values: ArrayLike, width: int) -> Floats:
    """Copy rows of numbers, of which there may be none, into a C array of shape (n, width)."""
    return compact(values).reshape(-1, width)


@njit(cache=True)
def copy_rows(values: Floats, out: Floats) -> None:
    """Copy rows of numbers in a kernel: numba compiles an assignment of slices for seconds.

    Args:
        values: Shape (n, width).
        out: Where to write, shape (at least n, width).
    """
    for n in range(values.shape[0]):
        for k in range(values.shape[1]):
            out[n, k] = values[n, k]
