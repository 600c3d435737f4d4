"""Bootstrap resamples of many units at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from scm_world._types import Floats
from scm_world.evaluation.statistics.inputs import checked_draws

BLOCK = 1_000_000
"""How many numbers are drawn in one go, so that memory stays within some ten megabytes."""


def batches(resamples: int, size: int) -> Iterator[slice]:
    """Part resamples of ``size`` numbers each into blocks that fit into memory.

    Raises:
        UnknownOption: ``resamples`` is not a positive whole number.

    Example:
        >>> list(batches(5, 400_000))
        [slice(0, 2, None), slice(2, 4, None), slice(4, 5, None)]
    """
    resamples = checked_draws("resamples", resamples)
    rows = max(1, BLOCK // size)
    for start in range(0, resamples, rows):
        yield slice(start, min(start + rows, resamples))


def resampled_mean(
    values: Floats, strata: Sequence[Floats], *, resamples: int, seed: int
) -> Floats:
    """Draw the mean again and again, with replacement within each stratum.

    Args:
        values: All of them, shape ``(n,)``.
        strata: The same, parted.
        resamples: How often.
        seed: Of the draws.

    Returns:
        Shape ``(resamples,)``.
    """
    rng = np.random.default_rng(seed)
    total = np.zeros(checked_draws("resamples", resamples))
    for members in strata:
        n = len(members)
        for rows in batches(resamples, n):
            drawn = rng.integers(n, size=(rows.stop - rows.start, n))
            total[rows] += members[drawn].sum(axis=1)
    return total / values.size


def drawn_counts(n: int, *, resamples: int, rng: np.random.Generator) -> Floats:
    """Draw how often each of n units is in a resample.

    Returns:
        Shape ``(resamples, n)``; each row sums to n. A statistic that weighs units is then a matrix
        product for all resamples together.
    """
    drawn = rng.integers(n, size=(checked_draws("resamples", resamples), n))
    drawn += n * np.arange(resamples)[:, None]
    counts = np.bincount(drawn.ravel(), minlength=resamples * n)
    return counts.reshape(resamples, n).astype(np.float64)


def percentiles(drawn: Floats, level: float) -> tuple[float, float]:
    """Give the ends between which the middle of the resamples lies.

    Args:
        drawn: One number per resample, shape ``(resamples,)``.
        level: How much the middle is, such as 0.95.
    """
    low, high = np.quantile(drawn, [0.5 - 0.5 * level, 0.5 + 0.5 * level])
    return float(low), float(high)


__all__ = ["BLOCK", "batches", "drawn_counts", "percentiles", "resampled_mean"]
