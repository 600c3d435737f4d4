"""The one kind of array that kernels are compiled for."""

from __future__ import annotations

import numpy as np

from scm_world._types import ArrayLike, Floats


def compact(values: ArrayLike) -> Floats:
    """Copy numbers into a writable C array of floats, so that no kernel is compiled twice."""
    return np.array(values, dtype=np.float64, order="C")


def rows(values: ArrayLike, width: int) -> Floats:
    """Copy rows of numbers, of which there may be none, into a C array of shape (n, width)."""
    return compact(values).reshape(-1, width)
