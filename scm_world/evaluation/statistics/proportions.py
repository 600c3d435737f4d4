"""Intervals of success rates, which know something even where all succeed.

A bootstrap of scores that are all 1 returns 1 always. These intervals do not: they follow from the
binomial distribution.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist

import numpy as np

from scm_world._types import Floats


def is_binary(values: Floats) -> bool:
    """Whether every value is 0 or 1."""
    return bool(np.all((values == 0.0) | (values == 1.0)))


def proportion_bounds(
    values: Floats, strata: Sequence[Floats], level: float
) -> tuple[float, float]:
    """Compute the Wilson interval of a success rate.

    Strata whose rates differ make the pooled rate more certain than as many episodes of one kind:
    ``effective_size`` says how many of one kind they are worth.

    Args:
        values: Zeros and ones, shape ``(n,)``.
        strata: The same, parted.
        level: Confidence.

    Source:
        Wilson, *Probable inference*, Journal of the American Statistical Association 22, 1927;
        Brown, Cai and DasGupta, *Interval estimation for a binomial proportion*, Statistical
        Science 16, 2001. With an effective number of episodes as in Korn and Graubard, *Confidence
        intervals for proportions*, Survey Methodology 24, 1998.

    Example:
        >>> ten = np.ones(10)
        >>> [round(end, 3) for end in proportion_bounds(ten, [ten], 0.95)]
        [0.722, 1.0]
    """
    z2 = _quantile(level) ** 2
    n, rate = effective_size(strata, level), float(values.mean())
    center = (rate + z2 / (2.0 * n)) / (1.0 + z2 / n)
    reach = np.sqrt(z2 * (rate * (1.0 - rate) + z2 / (4.0 * n)) / n) / (1.0 + z2 / n)
    return float(max(0.0, center - reach)), float(min(1.0, center + reach))


def effective_size(strata: Sequence[Floats], level: float) -> float:
    """Compute how many episodes of one kind are worth as much as these.

    The variances are those of rates that were drawn toward one half, as the Wilson interval draws
    its center, so that a stratum in which all succeed is not taken for certain.

    Example:
        >>> even = np.tile([0.0, 1.0], 50)
        >>> round(effective_size([even, even], 0.95))
        200
        >>> round(effective_size([np.zeros(100), np.ones(100)], 0.95))
        2754
    """
    z2 = _quantile(level) ** 2
    n = np.array([len(members) for members in strata], dtype=np.float64)
    rates = (np.array([members.sum() for members in strata]) + 0.5 * z2) / (n + z2)
    weights = n / n.sum()
    pooled = weights @ rates
    return float(pooled * (1.0 - pooled) / (weights**2 @ (rates * (1.0 - rates) / n)))


def paired_bounds(
    differences: Floats, strata: Sequence[Floats], level: float
) -> tuple[float, float]:
    """Compute the interval of a difference of two success rates in the same episodes.

    One episode in which only the first succeeds and one in which only the second does are added
    to the data, shared among the strata.

    Args:
        differences: -1, 0 or 1 for each episode, shape ``(n,)``.
        strata: The same, parted.
        level: Confidence.

    Source:
        Bonett and Price, *Adjusted Wald confidence interval for a difference of binomial
        proportions based on paired data*, Journal of Educational and Behavioral Statistics 37,
        2012.

    Example:
        >>> same = np.zeros(98)
        >>> [round(end, 4) for end in paired_bounds(same, [same], 0.95)]
        [-0.0277, 0.0277]
    """
    added = 1.0 / len(strata)
    center = variance = 0.0
    for members in strata:
        n = len(members) + 2.0 * added
        wins = (np.count_nonzero(members > 0.0) + added) / n
        losses = (np.count_nonzero(members < 0.0) + added) / n
        weight = len(members) / len(differences)
        center += weight * (wins - losses)
        variance += weight**2 * (wins + losses - (wins - losses) ** 2) / n
    reach = _quantile(level) * math.sqrt(variance)
    return float(max(-1.0, center - reach)), float(min(1.0, center + reach))


def _quantile(level: float) -> float:
    return NormalDist().inv_cdf(0.5 + 0.5 * level)


__all__ = ["effective_size", "is_binary", "paired_bounds", "proportion_bounds"]
