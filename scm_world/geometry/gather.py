"""Collecting numbers from one vector into another, compiled because every control step needs it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scm_world._types import Floats, Integers


def places(slices: Iterable[slice]) -> Integers:
    """List the indices that slices stand for, one after another, shape (n,)."""
    parts = [np.arange(where.start, where.stop) for where in slices]
    return np.concatenate([np.empty(0, dtype=np.int64), *parts]).astype(np.int64)


@njit(cache=True)
def gather_into(vector: Floats, sources: Integers, targets: Integers, out: Floats) -> None:
    """Copy ``out[targets] = vector[sources]``."""
    for i in range(sources.size):
        out[targets[i]] = vector[sources[i]]


@njit(cache=True)
def gather_copied(
    vector: Floats, sources: Integers, targets: Integers, numbers: Floats, out: Floats
) -> None:
    """Copy ``numbers[targets] = vector[sources]``, and then all numbers into ``out``."""
    for i in range(sources.size):
        numbers[targets[i]] = vector[sources[i]]
    for i in range(numbers.size):
        out[i] = numbers[i]


@njit(cache=True)
def gather_scaled(
    vector: Floats,
    sources: Integers,
    targets: Integers,
    raw: Floats,
    scale: Floats,
    out: NDArray[np.float32],
) -> None:
    """Copy into raw numbers, saturate them at their bounds, and scale them.

    Args:
        vector: Where some of the numbers come from.
        sources: Their places in it, shape (k,).
        targets: Their places in the raw numbers, shape (k,).
        raw: All numbers; those that come from elsewhere are there already, shape (n,).
        scale: Lower bounds, upper bounds, gains and offsets, shape (4, n).
        out: ``gain * clip(raw) + offset``, shape (n,).
    """
    for i in range(sources.size):
        raw[targets[i]] = vector[sources[i]]
    for i in range(raw.size):
        held = min(max(raw[i], scale[0, i]), scale[1, i])
        out[i] = scale[2, i] * held + scale[3, i]
