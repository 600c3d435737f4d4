"""How much of a score's variance a cause explains.

A column's values are parted into pieces, with a line in each of them; the share is R² of that
regression: the first-order Sobol index, or correlation ratio, of the column. The share of several
columns is what the sum of such functions explains. Both are corrected for what so many coefficients
explain by chance.

Source:
    Sobol, *Sensitivity estimates for nonlinear mathematical models*, 1993; Kelley, *An unbiased
    correlation ratio measure*, Proceedings of the National Academy of Sciences 21, 1935.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import final

import numpy as np

from scm_world._types import Floats, Integers

MOST_PIECES = 5


def piece_count(n: int, columns: int) -> int:
    """Choose into how many pieces each column is parted.

    The cube root of n, but no more than five, nor more than a twentieth of n for all columns of a
    variable together. More pieces add noise; fewer hide more. Five pieces hide nothing of a line
    and next to nothing of a parabola, but some 7 % of what a step explains, and 10 % of a band. So
    the share of a cause with sharp limits is too low by as much, and so are its ends.

    Example:
        >>> piece_count(200, 1), piece_count(200, 3), piece_count(12, 1)
        (5, 4, 1)
    """
    return max(1, min(round(math.cbrt(n)), 1 + n // (20 * columns), MOST_PIECES))


def pieces(values: Floats, count: int) -> Floats:
    """Span the functions of a column that are straight in each of its pieces.

    Args:
        values: Shape ``(n,)``, not all the same.
        count: How many pieces, with about as many values in each. Values so few that twenty fall
            on each, or no more than there are pieces, are the pieces themselves; an order or a
            distance between them then means nothing.

    Returns:
        An indicator of each piece and, within it, the value from its middle; shape ``(n, k)``.

    Example:
        >>> pieces(np.array([0.0, 1.0, 1.0]), 2).tolist()
        [[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]]
        >>> pieces(np.array([0.0, 2.0, 4.0]), 1).tolist()
        [[1.0, -1.0], [1.0, 0.0], [1.0, 1.0]]
    """
    levels, places = np.unique(values, return_inverse=True)
    if len(levels) <= max(count, len(values) // 20):
        return _indicators(places)
    edges = np.unique(np.quantile(values, np.arange(1, count) / count))
    within = _indicators(np.searchsorted(edges, values, side="left"))
    middles = within @ ((values @ within) / within.sum(axis=0))
    scaled = (values - middles) / np.abs(values - middles).max()
    slopes = within * scaled[:, None]
    return np.concatenate([within, slopes[:, np.any(slopes != 0.0, axis=0)]], axis=1)


def _indicators(places: Integers) -> Floats:
    return np.asarray(places[:, None] == np.unique(places), dtype=np.float64)


def basis(columns: Iterable[Floats]) -> Floats:
    """Span the sums of functions of several columns, without their mean.

    Args:
        columns: What ``pieces`` gives for each, each of shape ``(n, k)``.

    Returns:
        Uncorrelated columns of mean 0 and variance 1, shape ``(n, r)``.
    """
    spanned = np.concatenate(list(columns), axis=1)
    left, sizes, _ = np.linalg.svd(spanned - spanned.mean(axis=0), full_matrices=False)
    rank = int(np.count_nonzero(sizes > 1e-9 * sizes[0]))
    return np.asarray(left[:, :rank] * np.sqrt(len(left)))


@final
@dataclass(frozen=True)
class Share:
    """A share of variance.

    Attributes:
        value: Corrected for chance; in [0, 1], and so are its ends.
        low: Lower end of its interval.
        high: Upper end.
        p: Probability of so high a share if nothing had an effect.
    """

    value: float
    low: float
    high: float
    p: float


def share_of_variance(
    regressors: Floats, scores: Floats, shuffles: Integers, level: float
) -> Share:
    """Estimate how much of the scores' variance regressors explain.

    Args:
        regressors: From ``basis``, shape ``(n, r)`` with r less than n - 1.
        scores: Shape ``(n,)``.
        shuffles: Permutations of the n places, shape ``(permutations, n)``.
        level: Confidence of the interval.

    Returns:
        The share; 0 with p = 1 where the scores are all the same. The variance of its estimate is
        that of the influence function, which vanishes where the share does, and what is left there.

    Source:
        Ezekiel, *Methods of correlation analysis*, 1930, for the correction; Williamson et al.,
        *Nonparametric variable importance assessment*, Biometrics 77, 2021, for the influence
        function; Phipson and Smyth, *Permutation p-values should never be zero*, Statistical
        Applications in Genetics and Molecular Biology 9, 2010.
    """
    n, r = regressors.shape
    centered = scores - scores.mean()
    variance = float(np.square(centered).mean())
    if variance <= 1e-24 * max(1.0, float(np.square(scores).max())):  # nothing but rounding
        return Share(0.0, 0.0, 0.0, 1.0)
    fitted = regressors @ (regressors.T @ centered) / n
    raw = float(np.square(fitted).mean()) / variance
    by_chance = np.square(centered[shuffles] @ regressors / n).sum(axis=1) / variance
    p = (1 + int(np.count_nonzero(by_chance >= raw - 1e-12))) / (1 + len(shuffles))
    influence = (2.0 * centered * fitted - fitted**2 - raw * centered**2) / variance
    at_zero = 2.0 * r * ((1.0 - raw) / n) ** 2
    reach = math.sqrt(float(np.square(influence).mean()) / n + at_zero)
    reach *= NormalDist().inv_cdf(0.5 + 0.5 * level)
    value = 1.0 - (1.0 - raw) * (n - 1.0) / (n - r - 1.0)
    value, low, high = (min(max(x, 0.0), 1.0) for x in (value, value - reach, value + reach))
    return Share(value, low, high, p)


def holm(p: Sequence[float]) -> list[float]:
    """Correct p-values for how many questions were asked.

    Returns:
        In the same order. The chance that any true null hypothesis is below a bound is at most
        that bound.

    Source:
        Holm, *A simple sequentially rejective multiple test procedure*, Scandinavian Journal of
        Statistics 6, 1979.

    Example:
        >>> holm([0.01, 0.04, 0.03])
        [0.03, 0.06, 0.06]
    """
    values = np.asarray(p, dtype=np.float64)
    order = np.argsort(values, kind="stable")
    steps = np.maximum.accumulate(values[order] * np.arange(len(values), 0, -1))
    corrected = np.empty_like(values)
    corrected[order] = np.minimum(steps, 1.0)
    return [float(value) for value in corrected]


__all__ = [
    "MOST_PIECES",
    "Share",
    "basis",
    "holm",
    "piece_count",
    "pieces",
    "share_of_variance",
]
