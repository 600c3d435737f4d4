"""Tails of distributions, and how many discoveries may be false."""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats

_NORMAL = NormalDist()

SMALLEST = 1e-300
"""Where probabilities are cut off, so that their logarithm is a number."""


def chi_square_tail(x: float, m: int) -> float:
    """Compute the probability that a chi-square variable exceeds a value.

    Args:
        x: The value.
        m: Degrees of freedom, a whole number.

    Source:
        Abramowitz and Stegun, *Handbook of Mathematical Functions*, 26.4.4 and 26.4.5.

    Example:
        >>> round(chi_square_tail(3.841, 1), 4), round(chi_square_tail(5.991, 2), 4)
        (0.05, 0.05)
        >>> round(chi_square_tail(7.815, 3), 4)
        0.05
    """
    if x <= 0.0:
        return 1.0
    half = 0.5 * x
    if m % 2 == 0:
        term, total = 1.0, 1.0
        for k in range(1, m // 2):
            term *= half / k
            total += term
        return math.exp(-half) * total
    tail = math.erfc(math.sqrt(half))
    term = math.exp(-half) * math.sqrt(half) / math.gamma(1.5)
    for k in range(1, (m - 1) // 2 + 1):
        tail += term
        term *= half / (k + 0.5)
    return tail


def regression_tail(explained: float, left: float, m: int, free: float) -> float:
    """Compute how probable it is that some terms of a regression explain so much by chance.

    Args:
        explained: Sum of squares that m terms explain.
        left: Sum of squares of the residuals, with these terms.
        m: How many terms.
        free: Residual degrees of freedom.

    Source:
        Bartlett, *Further aspects of the theory of multiple regression*, 1938, for one response.

    Example:
        >>> round(regression_tail(4.0, 30.0, 1, 30.0), 3)  # t = 2 with 30 degrees of freedom
        0.055
    """
    if explained <= 0.0 or free <= 0.0:
        return 1.0
    statistic = (free + 0.5 * m - 1.0) * math.log1p(explained / max(left, SMALLEST))
    return chi_square_tail(statistic, m)


def discoveries(p: Floats, q: float, *, dependent: bool = True) -> NDArray[np.bool_]:
    """Choose hypotheses to reject, such that few of them are true.

    Args:
        p: Probabilities, shape (m,).
        q: Expected share of false ones among the rejected ones, at most.
        dependent: Whether the tests may depend on one another in any way.

    Returns:
        Which are rejected, shape (m,).

    Source:
        Benjamini and Yekutieli, *The control of the false discovery rate in multiple testing under
        dependency*, 2001; Benjamini and Hochberg 1995 for independent tests.

    Example:
        >>> discoveries(np.array([0.001, 0.02, 0.9]), 0.05).tolist()
        [True, False, False]
        >>> discoveries(np.array([0.001, 0.02, 0.9]), 0.05, dependent=False).tolist()
        [True, True, False]
    """
    m = len(p)
    if m == 0:
        return np.zeros(0, bool)
    ranks = np.arange(1, m + 1)
    price = float(np.sum(1.0 / ranks)) if dependent else 1.0
    small = np.sort(p) <= q * ranks / (m * price)
    if not small.any():
        return np.zeros(m, bool)
    return np.asarray(p <= np.sort(p)[np.flatnonzero(small)[-1]])


def normal_scores(values: Floats) -> Floats:
    """Replace numbers by the normal quantiles of their ranks; equal ones share a rank.

    Args:
        values: Shape (n,).

    Source:
        Blom, *Statistical Estimates and Transformed Beta-Variables*, 1958, for the ranks.

    Example:
        >>> [round(float(x), 2) for x in normal_scores(np.array([3.0, 100.0, 1.0]))]
        [0.0, 0.87, -0.87]
    """
    known, place, count = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(count)
    mean_rank = last - 0.5 * (count - 1)
    share = (mean_rank - 0.375) / (len(values) + 0.25)
    scores = np.array([_NORMAL.inv_cdf(float(x)) for x in share])
    return np.asarray(scores[place]) if len(known) > 1 else np.zeros(len(values))
