"""Means and differences of scores, with intervals.

Intervals are percentiles of a bootstrap within each stratum (Efron and Tibshirani, *An Introduction
to the Bootstrap*, 1993). Success rates get intervals of the binomial distribution instead, because
a bootstrap of two hundred successes in a row has no width.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from statistics import NormalDist
from typing import Any, final

import numpy as np

from scm_world._types import ArrayLike, Floats
from scm_world.errors import UnknownOption

LEVEL = 0.95
RESAMPLES = 2000
BLOCK = 1_000_000  # numbers that are resampled at once, some ten megabytes


@final
@dataclass(frozen=True)
class Interval:
    """An estimate with its confidence interval.

    Attributes:
        value: The estimate.
        low: Lower end; NaN if the data say nothing about it, as one number alone does.
        high: Upper end, or NaN.
        level: Confidence, such as 0.95.
        n: How many numbers it is estimated from.

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

    @property
    def ends(self) -> tuple[float, ...]:
        """The value, and the ends of its interval if they are known."""
        return (self.value,) if math.isnan(self.width) else (self.value, self.low, self.high)

    def excludes(self, number: float) -> bool:
        """Whether a number lies outside; never if the ends are unknown."""
        return self.low > number or self.high < number

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain data, in which an unknown end is None."""
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
        strata: To which stratum each belongs, for example its protocol, shape ``(n,)``. Every
            resample has as many episodes of each stratum.
        level: Confidence.
        resamples: Of the bootstrap, whose draws come from ``seed`` alone.
        seed: Of the bootstrap.
        proportion: Whether the values are failures and successes, 0 and 1, which get a Wilson
            interval. By default they are if each of them is 0 or 1.

    Returns:
        The mean. Its ends are unknown if no stratum has two numbers, unless these are proportions.
        Strata whose rates differ narrow a Wilson interval: see ``_effective_size``.

    Raises:
        UnknownOption: No values; values, strata, level or resamples that are none; or a
            proportion of values that are not 0 or 1.

    Source:
        Wilson, *Probable inference*, Journal of the American Statistical Association 22, 1927;
        with strata as in Korn and Graubard, *Confidence intervals for proportions*, Survey
        Methodology 24, 1998.

    Example:
        >>> print(mean_interval([1.0] * 200))
        1.00 [0.98, 1.00]
    """
    scores = numbers("values", values)
    members = _parted(scores, strata)
    z2 = normal_quantile(level) ** 2
    if proportion and not is_binary(scores):
        raise UnknownOption("a value of a proportion", "another number", ("0 or 1",))
    if not (is_binary(scores) if proportion is None else proportion):
        return _bootstrapped_mean(scores, members, level, resamples, seed)
    n, rate = _effective_size(members, z2), float(scores.mean())
    center = (rate + z2 / (2.0 * n)) / (1.0 + z2 / n)
    reach = math.sqrt(z2 * (rate * (1.0 - rate) + z2 / (4.0 * n)) / n) / (1.0 + z2 / n)
    return _around(scores, max(0.0, center - reach), min(1.0, center + reach), level)


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
    """Estimate how much higher ``a`` is than ``b`` in the same episodes (paired).

    Both have shape ``(n,)``; the other arguments are those of ``mean_interval``.

    Returns:
        The mean of ``a - b``, with a bootstrap of the differences. Where every score is 0 or 1 the
        interval is that of Bonett and Price: one episode in which only the first succeeds and one
        in which only the second does are added, shared among the strata.

    Raises:
        UnknownOption: As for ``mean_interval``, or ``a`` and ``b`` differ in length.

    Source:
        Bonett and Price, *Adjusted Wald confidence interval for a difference of binomial
        proportions based on paired data*, Journal of Educational and Behavioral Statistics 37,
        2012.
    """
    first, second = numbers("a", a), numbers("b", b)
    if first.shape != second.shape:
        raise UnknownOption("b", f"{second.size} scores", (f"one for each of the {first.size} a",))
    difference = first - second
    members, z = _parted(difference, strata), normal_quantile(level)
    binary = is_binary(first) and is_binary(second)
    if not (binary if proportion is None else proportion):
        return _bootstrapped_mean(difference, members, level, resamples, seed)
    added = 1.0 / len(members)
    n = np.array([len(part) + 2.0 * added for part in members])
    wins = np.array([np.count_nonzero(part > 0.0) + added for part in members]) / n
    losses = np.array([np.count_nonzero(part < 0.0) + added for part in members]) / n
    weights = np.array([len(part) for part in members]) / len(difference)
    center = float(weights @ (wins - losses))
    reach = z * math.sqrt(weights**2 @ ((wins + losses - (wins - losses) ** 2) / n))
    return _around(difference, max(-1.0, center - reach), min(1.0, center + reach), level)


def unpaired_interval(a: ArrayLike, b: ArrayLike, **how: Any) -> Interval:
    """Estimate how much higher ``a`` is than ``b`` in independent episodes.

    Their shapes are ``(m,)`` and ``(n,)``; ``how`` are other arguments of ``mean_interval``.

    Returns:
        The difference of the means. Its ends are recovered from those of the two means.

    Raises:
        UnknownOption: As for ``mean_interval``.

    Source:
        Zou and Donner, *Construction of confidence limits about effect measures*, Statistics in
        Medicine 27, 2008; for proportions it is method 10 of Newcombe, *Interval estimation for
        the difference between independent proportions*, Statistics in Medicine 17, 1998.
    """
    one, other = mean_interval(a, **how), mean_interval(b, **how)
    value = one.value - other.value
    below = math.hypot(one.value - one.low, other.high - other.value)
    above = math.hypot(one.high - one.value, other.value - other.low)
    return Interval(value, value - below, value + above, one.level, one.n + other.n)


def is_binary(values: Floats) -> bool:
    """Whether every value is 0 or 1."""
    return bool(np.all((values == 0.0) | (values == 1.0)))


def bootstrap(
    strata: Sequence[Floats],
    statistic: Callable[..., Any],
    *,
    level: float,
    resamples: int,
    seed: int,
) -> tuple[Any, Any]:
    """Compute both ends of the percentile interval of a stratified bootstrap.

    Args:
        strata: Numbers that are resampled within each of them, two or more, each of shape ``(n,)``.
        statistic: Takes resamples of all strata, each of shape ``(resamples, n)``, and ``axis=-1``;
            returns shape ``(..., resamples)``.
        level: Confidence.
        resamples: How many.
        seed: Of the draws.
    """
    from scipy.stats import bootstrap as of_scipy

    found = of_scipy(
        strata, statistic, n_resamples=draws("resamples", resamples), vectorized=True,
        batch=max(1, BLOCK // sum(map(len, strata))), confidence_level=level,
        method="percentile", rng=np.random.default_rng(seed),
    )  # fmt: skip
    return found.confidence_interval.low, found.confidence_interval.high


def numbers(name: str, values: ArrayLike, *, ndim: tuple[int, ...] = (1,)) -> Floats:
    """Return an array of finite numbers with one of these numbers of axes.

    Raises:
        UnknownOption: It has other axes, is empty, or something in it is no finite number.
    """
    wanted = f"one finite number or more, in an array of {' or '.join(map(str, ndim))} axes"
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise UnknownOption(name, "something else than numbers", (wanted,)) from None
    if array.ndim not in ndim or array.size == 0:
        raise UnknownOption(name, f"an array of shape {array.shape}", (wanted,))
    if not np.isfinite(array).all():
        place = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise UnknownOption(name, f"{array[place]} at {place}", (wanted,))
    return array


def draws(name: str, count: int, least: int = 2) -> int:
    """Return a number of resamples or permutations, or raise ``UnknownOption``."""
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < least:
        raise UnknownOption(name, count, (f"a whole number, {least} or more",))
    return int(count)


def normal_quantile(level: float) -> float:
    """Return by how many deviations a normal interval reaches to either side."""
    if not 0.0 < level < 1.0:
        raise UnknownOption("level", level, ("a number between 0 and 1, such as 0.95",))
    return NormalDist().inv_cdf(0.5 + 0.5 * level)


def _parted(values: Floats, strata: ArrayLike | None) -> list[Floats]:
    """Part values by their strata; without strata, they are one."""
    if strata is None:
        return [values]
    labels: Any = np.asarray(strata)
    if labels.shape != values.shape:
        allowed = (f"one for each of the {values.size} values",)
        raise UnknownOption("strata", f"an array of shape {labels.shape}", allowed)
    places: Any = np.unique(labels, return_inverse=True)[1]
    return [values[places == k] for k in range(int(places.max()) + 1)]


def _effective_size(strata: Sequence[Floats], z2: float) -> float:
    """Compute how many episodes of one kind are worth as much as these.

    The variances are those of rates drawn toward one half, as the Wilson interval draws its
    center, so that a stratum in which all succeed is not taken for certain.
    """
    n = np.array([len(part) for part in strata], dtype=np.float64)
    rates = (np.array([part.sum() for part in strata]) + 0.5 * z2) / (n + z2)
    weights = n / n.sum()
    pooled = weights @ rates
    return float(pooled * (1.0 - pooled) / (weights**2 @ (rates * (1.0 - rates) / n)))


def _bootstrapped_mean(
    values: Floats, strata: list[Floats], level: float, resamples: int, seed: int
) -> Interval:
    several = [part for part in strata if len(part) > 1]
    if not several:
        return Interval(float(values.mean()), math.nan, math.nan, level, values.size)
    single = sum(float(part[0]) for part in strata if len(part) == 1)

    def mean(*parts: Floats, axis: int) -> Any:
        return (single + sum(part.sum(axis=axis) for part in parts)) / values.size

    low, high = bootstrap(several, mean, level=level, resamples=resamples, seed=seed)
    return _around(values, float(low), float(high), level)


def _around(values: Floats, low: float, high: float, level: float) -> Interval:
    mean = float(values.mean())
    return Interval(mean, min(low, mean), max(high, mean), level, values.size)
