"""Means and differences of scores, with intervals.

The intervals are percentiles of a bootstrap that resamples within each stratum (Efron and
Tibshirani, *An Introduction to the Bootstrap*, 1993). Where every score is 0 or 1 they are those of
``proportions``, because a bootstrap of two hundred successes in a row has no width.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, final

import numpy as np

from scm_world._types import ArrayLike, Floats
from scm_world.errors import UnknownOption
from scm_world.evaluation.statistics.inputs import checked_level, numbers, strata_of
from scm_world.evaluation.statistics.proportions import (
    is_binary,
    paired_bounds,
    proportion_bounds,
)
from scm_world.evaluation.statistics.resampling import percentiles, resampled_mean

LEVEL = 0.95
RESAMPLES = 2000


@final
@dataclass(frozen=True)
class Interval:
    """A number, and where it may as well be.

    Attributes:
        value: The estimate.
        low: Lower end; NaN if the data say nothing about it, as one number alone does.
        high: Upper end, or NaN.
        level: Confidence, such as 0.95.
        n: From how many numbers.

    Example:
        >>> print(Interval(0.931, 0.904, 0.952, level=0.95, n=200))
        0.93 [0.90, 0.95]
    """

    value: float
    low: float
    high: float
    level: float
    n: int

    @property
    def width(self) -> float:
        """Length of the interval."""
        return self.high - self.low

    def excludes(self, number: float) -> bool:
        """Whether a number lies outside; never if the ends are unknown."""
        return self.low > number or self.high < number

    def as_dict(self) -> dict[str, Any]:
        """Write it as plain data, in which an unknown end is None."""
        found = asdict(self)
        return found | {end: None for end in ("low", "high") if math.isnan(found[end])}

    def __str__(self) -> str:
        if math.isnan(self.width):
            return f"{self.value:z.2f} [unknown]"
        digits = min(max(2, -math.floor(math.log10(self.width or 1.0))), 4)
        return f"{self.value:z.{digits}f} [{self.low:z.{digits}f}, {self.high:z.{digits}f}]"


def mean_interval(
    values: ArrayLike,
    strata: ArrayLike | None = None,
    *,
    level: float = LEVEL,
    resamples: int = RESAMPLES,
    seed: int = 0,
    proportion: bool | None = None,
) -> Interval:
    """Estimate a mean, with an interval.

    Args:
        values: One number per episode, shape ``(n,)``.
        strata: To which stratum each belongs, for example its protocol, shape ``(n,)``. How many
            episodes a stratum has was chosen, not found, so it is the same in every resample.
        level: Confidence.
        resamples: Of the bootstrap.
        seed: Of the bootstrap.
        proportion: Whether the values are failures and successes, 0 and 1, which get a Wilson
            interval. By default they are if each of them is 0 or 1.

    Returns:
        The mean. Its ends are unknown if no stratum has two numbers, unless these are proportions.
        A stratum of a single number adds nothing to the width.

    Raises:
        UnknownOption: No values; values, strata, level or resamples that are none; or a
            proportion of values that are not 0 or 1.

    Example:
        >>> print(mean_interval([1.0] * 200))
        1.00 [0.98, 1.00]
    """
    scores = numbers("values", values)
    members = strata_of(scores, strata)
    level = checked_level(level)
    if proportion and not is_binary(scores):
        raise UnknownOption("a value of a proportion", "another number", ("0 or 1",))
    if is_binary(scores) if proportion is None else proportion:
        return _around(scores, proportion_bounds(scores, members, level), level)
    return _bootstrapped(scores, members, level, resamples, seed)


def difference_interval(
    a: ArrayLike,
    b: ArrayLike,
    strata: ArrayLike | None = None,
    *,
    level: float = LEVEL,
    resamples: int = RESAMPLES,
    seed: int = 0,
    proportion: bool | None = None,
) -> Interval:
    """Estimate how much higher ``a`` is than ``b``, where both met the same draws.

    Args:
        a: Scores of one policy, shape ``(n,)``.
        b: Scores of another in the same episodes, shape ``(n,)``.
        strata: To which stratum each episode belongs, shape ``(n,)``.
        level: Confidence.
        resamples: Of the bootstrap.
        seed: Of the bootstrap.
        proportion: Whether they are failures and successes; as for ``mean_interval``.

    Returns:
        The mean of ``a - b``. Where every score is 0 or 1 the interval is that of Bonett and
        Price, see ``proportions``; else a bootstrap of the differences.

    Raises:
        UnknownOption: As for ``mean_interval``, or ``a`` and ``b`` differ in length.

    Example:
        >>> a = np.random.default_rng(0).random(100)
        >>> print(difference_interval(a + 0.1, a))
        0.1000 [0.1000, 0.1000]
    """
    first, second = numbers("a", a), numbers("b", b)
    if first.shape != second.shape:
        raise UnknownOption("b", f"{second.size} scores", (f"one for each of the {first.size} a",))
    difference = first - second
    members = strata_of(difference, strata)
    level = checked_level(level)
    binary = is_binary(first) and is_binary(second)
    if binary if proportion is None else proportion:
        return _around(difference, paired_bounds(difference, members, level), level)
    return _bootstrapped(difference, members, level, resamples, seed)


def unpaired_interval(
    a: ArrayLike,
    b: ArrayLike,
    *,
    level: float = LEVEL,
    resamples: int = RESAMPLES,
    seed: int = 0,
    proportion: bool | None = None,
) -> Interval:
    """Estimate how much higher ``a`` is than ``b``, if the episodes have nothing in common.

    Args:
        a: Scores, shape ``(m,)``.
        b: Other scores, shape ``(n,)``.
        level: Confidence.
        resamples: Of the bootstrap of each mean.
        seed: Of the bootstrap.
        proportion: Whether they are failures and successes; as for ``mean_interval``.

    Returns:
        The difference of the means. Its ends are recovered from those of the two means.

    Raises:
        UnknownOption: As for ``mean_interval``.

    Source:
        Zou and Donner, *Construction of confidence limits about effect measures*, Statistics in
        Medicine 27, 2008; for proportions it is method 10 of Newcombe, *Interval estimation for
        the difference between independent proportions*, Statistics in Medicine 17, 1998.

    Example:
        >>> print(unpaired_interval([1.0] * 56 + [0.0] * 14, [1.0] * 48 + [0.0] * 32))
        0.20 [0.05, 0.33]
    """
    how: Any = {"level": level, "resamples": resamples, "seed": seed, "proportion": proportion}
    one, other = (mean_interval(x, **how) for x in (a, b))
    value = one.value - other.value
    below = math.hypot(one.value - one.low, other.high - other.value)
    above = math.hypot(one.high - one.value, other.value - other.low)
    return Interval(value, value - below, value + above, level, one.n + other.n)


def pairing_gain(a: ArrayLike, b: ArrayLike) -> float:
    """Compute how many times fewer episodes a paired difference needs.

    Args:
        a: Scores of one policy, shape ``(n,)``, n at least 2.
        b: Scores of another in the same episodes, shape ``(n,)``.

    Returns:
        Variance of an unpaired difference over that of a paired one. 1 if neither policy's score
        ever varies, infinite if only the difference never does.

    Raises:
        UnknownOption: ``a`` and ``b`` differ in length, or have less than two scores.

    Example:
        >>> pairing_gain([0.0, 1.0, 0.0, 1.0], [0.0, 1.0, 1.0, 0.0])
        1.0
    """
    first, second = numbers("a", a), numbers("b", b)
    if first.shape != second.shape or first.size < 2:
        raise UnknownOption(
            "a and b",
            f"{first.size} and {second.size} scores",
            ("two scores or more, the same number",),
        )
    apart, together = first.var() + second.var(), (first - second).var()
    # Differences that are equal on paper differ by rounding.
    if together <= 1e-20 * max(apart, np.square(first).mean()):
        return 1.0 if apart <= together else math.inf
    return float(apart / together)


def _around(values: Floats, ends: tuple[float, float], level: float) -> Interval:
    mean = float(values.mean())
    return Interval(mean, min(ends[0], mean), max(ends[1], mean), level, values.size)


def _bootstrapped(
    values: Floats, strata: list[Floats], level: float, resamples: int, seed: int
) -> Interval:
    if max(len(members) for members in strata) < 2:
        return Interval(float(values.mean()), math.nan, math.nan, level, values.size)
    return _around(
        values,
        percentiles(resampled_mean(values, strata, resamples=resamples, seed=seed), level),
        level,
    )


__all__ = [
    "LEVEL",
    "RESAMPLES",
    "Interval",
    "difference_interval",
    "mean_interval",
    "pairing_gain",
    "unpaired_interval",
]
