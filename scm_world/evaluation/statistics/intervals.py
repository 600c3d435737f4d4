"""Estimates of scores with intervals: means, differences, and aggregates over runs and protocols.

Intervals are percentiles of a bootstrap within each stratum (Efron and Tibshirani, *An Introduction
to the Bootstrap*, 1993). Success rates get intervals of the binomial distribution instead, because
a bootstrap of two hundred successes in a row has no width. Aggregates, profiles and improvement are
those of rliable, which cannot be imported beside pandas 3, and draws from numpy's global generator.

Source:
    Agarwal et al., *Deep reinforcement learning at the edge of the statistical precipice*,
    NeurIPS 2021.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from statistics import NormalDist
from typing import Any, final

import numpy as np

from scm_world._arguments import one_of
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
        strata: To which stratum each belongs, for example its training run, shape ``(n,)``. Every
            resample has as many episodes of each stratum; a Wilson interval has no strata.
        level: Confidence.
        resamples: Of the bootstrap, whose draws come from ``seed`` alone.
        seed: Of the bootstrap.
        proportion: Whether the values are failures and successes, 0 and 1, which get a Wilson
            interval. By default they are if each of them is 0 or 1.

    Returns:
        The mean. Its ends are unknown if no stratum has two numbers, unless these are proportions.

    Raises:
        UnknownOption: No values; values, strata, level or resamples that are none; or a
            proportion of values that are not 0 or 1.

    Source:
        Wilson, *Probable inference*, Journal of the American Statistical Association 22, 1927.

    Example:
        >>> print(mean_interval([1.0] * 200))
        1.00 [0.98, 1.00]
    """
    scores = numbers("values", values)
    members = [scores]
    if strata is not None:
        labels: Any = np.asarray(strata)
        if labels.shape != scores.shape:
            allowed = (f"one for each of the {scores.size} values",)
            raise UnknownOption("strata", f"an array of shape {labels.shape}", allowed)
        members = [scores[labels == label] for label in np.unique(labels)]
    normal_quantile(level)
    if proportion and not is_binary(scores):
        raise UnknownOption("a value of a proportion", "another number", ("0 or 1",))
    if not (is_binary(scores) if proportion is None else proportion):
        return _bootstrapped_mean(scores, members, level, resamples, seed)
    from scipy.stats import binomtest

    found = binomtest(int(scores.sum()), scores.size).proportion_ci(level, method="wilson")
    return _around(scores, found.low, found.high, level)


def difference_interval(
    a: ArrayLike,
    b: ArrayLike,
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
        in which only the second does are added.

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
    z = normal_quantile(level)
    binary = is_binary(first) and is_binary(second)
    if not (binary if proportion is None else proportion):
        return _bootstrapped_mean(difference, [difference], level, resamples, seed)
    n = len(difference) + 2.0
    wins = (np.count_nonzero(difference > 0.0) + 1.0) / n
    losses = (np.count_nonzero(difference < 0.0) + 1.0) / n
    center = wins - losses
    reach = z * math.sqrt((wins + losses - center**2) / n)
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


METRICS = ("mean", "median", "interquartile_mean", "optimality_gap")
OVER = ("runs", "episodes")


def aggregate(
    scores: ArrayLike,
    *,
    over: str = "runs",
    gamma: float = 1.0,
    level: float = LEVEL,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> dict[str, Interval]:
    """Estimate the four aggregates, with stratified bootstrap intervals.

    Args:
        scores: Shape ``(runs, protocols)``, or ``(runs, protocols, episodes)``.
        over: ``"runs"``: a run's score in a protocol is the mean of its episodes, and runs are
            resampled within each protocol; the interval is about other runs of the same training.
            ``"episodes"``: episodes are resampled within each run and protocol; the interval is
            about other episodes of the same runs.
        gamma: Score that counts as enough, for the optimality gap.
        level: Confidence.
        resamples: Of the bootstrap.
        seed: Of the bootstrap.

    Returns:
        By the names of ``METRICS``: the mean; the median protocol's mean; the mean of the middle
        half, of which the number left out at each end is rounded down; and by how much scores miss
        ``gamma`` on average.

    Raises:
        UnknownOption: Scores, level, resamples or ``over`` that are none; or less than two runs,
            or episodes, to resample.

    Example:
        >>> scores = np.random.default_rng(0).beta(8, 2, size=(5, 12))
        >>> print(aggregate(scores)["interquartile_mean"])
        0.79 [0.76, 0.83]
    """
    from scipy.stats import trim_mean

    groups = _groups("scores", scores, over)
    normal_quantile(level)
    if not np.isfinite(gamma):
        raise UnknownOption("gamma", gamma, ("a finite number",))

    def metrics(*strata: Floats, axis: int = -1) -> Any:
        table = _pooled(strata, groups.shape)
        flat = table.reshape(len(table), -1)
        gap = gamma - np.minimum(flat, gamma).mean(axis=-1)
        median = np.median(table.mean(axis=-1), axis=-1)
        return np.stack([flat.mean(axis=-1), median, trim_mean(flat, 0.25, axis=-1), gap])

    found = metrics(*_strata(groups[None]))[:, 0]
    low, high = bootstrap(_strata(groups), metrics, level=level, resamples=resamples, seed=seed)
    return {
        name: Interval(float(found[k]), float(low[k]), float(high[k]), level, groups.size)
        for k, name in enumerate(METRICS)
    }


@final
@dataclass(frozen=True)
class Profile:
    """Share of scores above each threshold, with a band; all arrays have shape ``(t,)``.

    Attributes:
        thresholds: In the unit of the scores.
        share: Of all runs (or episodes) and protocols whose score is higher.
        low: Lower edge of the band, point by point.
        high: Upper edge.
        level: Confidence at each threshold.
        n: How many scores there are.
    """

    thresholds: Floats
    share: Floats
    low: Floats
    high: Floats
    level: float
    n: int


def performance_profile(
    scores: ArrayLike,
    thresholds: ArrayLike | None = None,
    *,
    over: str = "runs",
    level: float = LEVEL,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Profile:
    """Estimate the share of scores above each threshold, shape ``(t,)``.

    Thresholds are 101 from 0 to 1 by default; the other arguments are those of ``aggregate``.

    Raises:
        UnknownOption: As for ``aggregate``, or thresholds that are no numbers.
    """
    groups = _groups("scores", scores, over)
    normal_quantile(level)
    grid = np.linspace(0.0, 1.0, 101) if thresholds is None else numbers("thresholds", thresholds)

    def shares(*strata: Floats, axis: int = -1) -> Any:
        table = _pooled(strata, groups.shape)
        return np.stack([(table > threshold).mean(axis=(1, 2)) for threshold in grid])

    share = shares(*_strata(groups[None]))[:, 0]
    low, high = bootstrap(_strata(groups), shares, level=level, resamples=resamples, seed=seed)
    return Profile(grid, share, low, high, level, groups.size)


def probability_of_improvement(
    x: ArrayLike,
    y: ArrayLike,
    *,
    over: str = "runs",
    level: float = LEVEL,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Interval:
    """Estimate how probable a run of ``x`` scores higher than a run of ``y``.

    Per protocol it is the share of pairs in which x is higher, a tie counting half: the
    statistic of Mann and Whitney over the number of pairs. The protocols are then averaged.
    x and y are scores in the same protocols, shaped as for ``aggregate`` like the other arguments;
    they may have different numbers of runs, and are resampled apart.

    Raises:
        UnknownOption: As for ``aggregate``, or x and y have different numbers of protocols.
    """
    ours, theirs = _groups("x", x, over), _groups("y", y, over)
    normal_quantile(level)
    protocols = ours.shape[1]
    if theirs.shape[1] != protocols:
        allowed = (f"the {protocols} protocols of x",)
        raise UnknownOption("y", f"{theirs.shape[1]} protocols", allowed)
    rng = np.random.default_rng(seed)
    value, drawn = 0.0, np.zeros(draws("resamples", resamples))
    for protocol in range(protocols):
        first, second = ours[:, protocol].ravel(), theirs[:, protocol].ravel()
        higher = 0.5 + 0.5 * np.sign(first[:, None] - second[None, :])  # (x, y)
        of_x, of_y = (_counts(groups, resamples, rng) for groups in (ours, theirs))
        value += float(higher.mean()) / protocols
        drawn += np.einsum("rj,rj->r", of_x @ higher, of_y) / (higher.size * protocols)
    low, high = np.quantile(drawn, [0.5 - 0.5 * level, 0.5 + 0.5 * level])
    return Interval(value, float(low), float(high), level, ours.size + theirs.size)


def _groups(name: str, scores: ArrayLike, over: str) -> Floats:
    """Return scores as groups of runs or of episodes, shape ``(groups, protocols, units)``."""
    one_of("over", over, OVER)
    array = numbers(name, scores, ndim=(2, 3))
    if over == "episodes" and array.ndim == 2:
        given = f"an array of shape {array.shape} over episodes"
        raise UnknownOption(name, given, ("an array of shape (runs, protocols, episodes)",))
    if over == "runs":
        array = (array if array.ndim == 2 else array.mean(axis=2)).T[None]
    if array.shape[2] < 2:
        allowed = ("'runs' with two runs or more", "'episodes' with two episodes or more")
        raise UnknownOption("over", f"{over} of which {name} has one", allowed)
    return array


def _strata(groups: Floats) -> list[Floats]:
    """Part scores of shape ``(..., groups, protocols, units)`` into what is resampled within."""
    return list(np.moveaxis(groups.reshape(*groups.shape[:-3], -1, groups.shape[-1]), -2, 0))


def _pooled(strata: tuple[Floats, ...], shape: tuple[int, ...]) -> Floats:
    """Put resampled strata together, shape ``(resamples, protocols, groups * units)``."""
    groups, protocols, units = shape
    table = np.stack(strata, axis=1).reshape(-1, groups, protocols, units)
    return np.moveaxis(table, 1, 2).reshape(-1, protocols, groups * units)


def _counts(groups: Floats, resamples: int, rng: np.random.Generator) -> Floats:
    """Draw how often each unit of a protocol is in a resample: ``(resamples, groups * units)``."""
    n = groups.shape[2]
    size = (resamples, len(groups))
    return rng.multinomial(n, np.full(n, 1.0 / n), size=size).reshape(resamples, -1).astype(float)
