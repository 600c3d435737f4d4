"""Facts about compiled functions that are called without a look at the types."""

from __future__ import annotations

import numpy as np
from numba import njit

from scm_world.geometry.direct import direct


@njit
def _total(values: np.ndarray, weight: float) -> float:
    found = 0.0
    for value in values.flat:
        found += weight * value
    return found


def test_every_type_has_an_entry_of_its_own() -> None:
    """Other numbers, strides and rights to write have other entries, and right sums."""
    numbers = np.arange(12.0).reshape(3, 4)
    still = numbers.copy()
    still.flags.writeable = False
    kinds = [numbers, numbers.T, numbers[:, ::2], numbers.astype(np.float32), still, numbers[0]]
    entries = [direct(_total, kind, 2.0) for kind in kinds]
    for kind, entry in zip(kinds, entries, strict=True):
        assert entry(kind, 2.0) == 2.0 * kind.sum()
    assert len({id(entry) for entry in entries}) == len(kinds)
    assert len({id(direct(_total, numbers, weight)) for weight in (2, 2.0, True)}) == 3


def test_what_is_asked_again_is_given_again() -> None:
    """One look at the types is enough; what is not compiled is given back."""
    one, other = np.zeros(3), np.ones(3)
    assert direct(_total, one, 1.0) is direct(_total, other, 5.0)
    assert direct(max, one, 1.0) is max
