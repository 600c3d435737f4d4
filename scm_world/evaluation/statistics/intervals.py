"""Estimates of scores with intervals: means, differences, and aggregates over runs and protocols.

A bootstrap of three or ten numbers is too short, and one of two hundred successes in a row has no
width. So means have intervals of Student's t, and rates those of binomial distributions. Intervals
over training runs treat a run with its scores in all protocols as one unit. Aggregates over
episodes are resampled within each run (Efron and Tibshirani, *An Introduction to the Bootstrap*,
1993). ``benchmarks/coverage.py`` measures how often all of them contain the truth.

Source:
    Agarwal et al., *Deep reinforcement learning at the edge of the statistical precipice*,
    NeurIPS 2021, for the aggregates, profiles and the probability of improvement.
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
FEWEST_RUNS = 3
"""With fewer runs there is no interval over runs."""
BLOCK = 1_000_000  # numbers that are resampled together, some ten megabytes


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
    proportion: bool | None = None,
) -> Interval:
    """Estimate a mean, with an interval.

    Args:
        values: One number per episode, shape ``(n,)``.
        strata: To which stratum each belongs, for example its training run, shape ``(n,)``. The
            interval is about other episodes of the same strata; those of failures and successes,
            and of strata of which one has a single number, leave the strata out and are wider.
        level: Confidence.
        proportion: Whether the values are rates, which always lie in [0, 1]. By default
            they are if all of them do.

    Returns:
        The mean. Failures and successes, 0 and 1, have the interval of Wilson, other rates that of
        ``interval_of``, all other numbers that of Student's t with the degrees of freedom of
        Welch and Satterthwaite, whose ends are unknown where nothing varies within strata.

    Raises:
        UnknownOption: No values; values, strata or a level that are none; or a proportion of
            values that do not lie in [0, 1].

    Source:
        Wilson, *Probable inference*, Journal of the American Statistical Association 22, 1927.
        Satterthwaite, *An approximate distribution of estimates of variance components*,
        Biometrics Bulletin 2, 1946.

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
    is_rate = bool(scores.min() >= 0.0 and scores.max() <= 1.0)
    if proportion and not is_rate:
        raise UnknownOption("a value of a proportion", "another number", ("in [0, 1]",))
    if not (is_rate if proportion is None else proportion):
        return _of_mean(scores, members, level, None)
    if not is_binary(scores):
        return _of_mean(scores, members, level, (0.0, 1.0))
    from scipy.stats import binomtest

    found = binomtest(int(scores.sum()), scores.size).proportion_ci(level, method="wilson")
    mean = float(scores.mean())
    low, high = min(float(found.low), mean), max(float(found.high), mean)
    return Interval(mean, low, high, level, scores.size)


def difference_interval(
    a: ArrayLike, b: ArrayLike, *, level: float = LEVEL, proportion: bool | None = None
) -> Interval:
    """Estimate how much higher ``a`` is than ``b`` in the same episodes (paired).

    Both have shape ``(n,)``; the other arguments are those of ``mean_interval``.

    Returns:
        The mean of ``a - b``, with the interval of Student's t; its ends are unknown where all
        differences are the same. Where every score is 0 or 1 the interval is that of Bonett and
        Price: one episode in which only the first succeeds and one in which only the second does
        are added.

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
    difference, both = first - second, np.concatenate([first, second])
    z = normal_quantile(level)
    if proportion is False or not is_binary(both):
        return _of_mean(difference, [difference], level, None)
    n = len(difference) + 2.0
    wins = (np.count_nonzero(difference > 0.0) + 1.0) / n
    losses = (np.count_nonzero(difference < 0.0) + 1.0) / n
    center, mean = wins - losses, float(difference.mean())
    reach = z * math.sqrt((wins + losses - center**2) / n)
    low, high = max(-1.0, center - reach), min(1.0, center + reach)
    return Interval(mean, min(low, mean), max(high, mean), level, difference.size)


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


def _of_mean(
    values: Floats, strata: list[Floats], level: float, bounds: tuple[float, float] | None
) -> Interval:
    """Give the mean of numbers with its interval; numbers with bounds lie between them."""
    mean, n = float(values.mean()), values.size
    parts = strata if min(map(len, strata)) > 1 else [values]
    if n == 1:
        return Interval(mean, math.nan, math.nan, level, n)
    shares = np.array([len(part) * part.var(ddof=1) for part in parts]) / n**2
    spent = np.array([1.0 / (len(part) - 1) for part in parts])
    variance = float(shares.sum())
    if variance <= (1e-15 * float(np.abs(values).max())) ** 2:  # nothing varies but by rounding
        variance, degrees = 0.0, n - 1.0
    else:
        degrees = variance**2 / float((shares**2 * spent).sum())
    low, high = interval_of(mean, math.sqrt(variance), degrees, n, level, bounds)
    return Interval(mean, float(low), float(high), level, n)


def interval_of(
    value: ArrayLike,
    error: ArrayLike,
    degrees: float,
    n: int,
    level: float,
    bounds: tuple[ArrayLike, ArrayLike] | None,
) -> tuple[Floats, Floats]:
    """Return the ends of the intervals of estimates, each of the shape of ``value``.

    Args:
        value: The estimates.
        error: Their standard errors.
        degrees: Of freedom, from which the errors are known.
        n: How many independent units there are.
        level: Confidence.
        bounds: Between which values lie, so that an estimate is a share of the way from one to the
            other. It gets the interval of Clopper and Pearson with as many effective units as give
            its error, corrected for the degrees of freedom, but not fewer than ``n``. None: the
            interval of Student's t, whose ends are NaN where the error is 0.

    Source:
        Korn and Graubard, *Confidence intervals for proportions with small expected number of
        positive counts estimated from survey data*, Survey Methodology 24, 1998.
    """
    from scipy.special import betaincinv, stdtrit

    center, spread = np.asarray(value, dtype=np.float64), np.asarray(error, dtype=np.float64)
    tail, z = 0.5 - 0.5 * level, normal_quantile(level)
    t = float(stdtrit(degrees, 1.0 - tail))
    if bounds is None:
        reach = np.where(spread > 0.0, t * spread, np.nan)
        return center - reach, center + reach
    least, most = (np.asarray(bound, dtype=np.float64) for bound in bounds)
    share, scale = np.clip((center - least) / (most - least), 0.0, 1.0), most - least
    with np.errstate(divide="ignore", invalid="ignore"):
        units = share * (1.0 - share) * np.square(scale * z / (t * spread))
    units = np.maximum(np.where(spread > 0.0, units, n), n)
    hits, misses = share * units, (1.0 - share) * units
    low = np.where(hits > 0.0, betaincinv(np.maximum(hits, 1e-300), misses + 1.0, tail), 0.0)
    up = np.where(misses > 0.0, betaincinv(hits + 1.0, np.maximum(misses, 1e-300), 1 - tail), 1.0)
    return least + scale * low, least + scale * up


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
    """Estimate the four aggregates, with intervals.

    Args:
        scores: Shape ``(runs, protocols)``, or ``(runs, protocols, episodes)``.
        over: ``"runs"``: a run's score in a protocol is the mean of its episodes, and runs are
            the units, each with its scores in all protocols; the interval is about other runs of
            the same training. ``"episodes"``: episodes are resampled within each run and
            protocol; the interval is about other episodes of the same runs.
        gamma: Score that counts as enough, for the optimality gap.
        level: Confidence.
        resamples: Of the bootstrap over episodes.
        seed: Of the bootstrap over episodes.

    Returns:
        By the names of ``METRICS``: the mean; the median protocol's mean; the mean of the middle
        half, of which the number left out at each end is rounded down; and by how much scores miss
        ``gamma`` on average. The ends of an interval over two runs are unknown. An interval over
        few runs holds where the scores of runs are spread about normally. It is too short where a
        run either learns or fails and all runs at hand did the same.

    Raises:
        UnknownOption: Scores, level, resamples or ``over`` that are none; or less than two runs,
            or episodes.

    Example:
        >>> scores = np.random.default_rng(0).beta(8, 2, size=(5, 12))
        >>> print(aggregate(scores)["interquartile_mean"])
        0.79 [0.71, 0.86]
    """
    from scipy.stats import trim_mean

    table = _units("scores", scores, over)
    normal_quantile(level)
    if not np.isfinite(gamma):
        raise UnknownOption("gamma", gamma, ("a finite number",))

    def metrics(table: Floats) -> Floats:
        flat = table.reshape(*table.shape[:-2], -1)
        median = np.median(table.mean(axis=-1), axis=-1)
        gap = gamma - np.minimum(flat, gamma).mean(axis=-1)
        return np.stack([flat.mean(axis=-1), median, trim_mean(flat, 0.25, axis=-1), gap])

    most = np.array([1.0, 1.0, 1.0, max(gamma, 1.0)])
    how: Any = {"over": over, "level": level, "resamples": resamples, "seed": seed}
    found, low, high = _interval(table, metrics, most, **how)
    return {
        name: Interval(float(found[k]), float(low[k]), float(high[k]), level, table.size)
        for k, name in enumerate(METRICS)
    }


@final
@dataclass(frozen=True)
class Profile:
    """Share of scores above each threshold, with a band; all arrays have shape ``(t,)``.

    Attributes:
        thresholds: In the unit of the scores.
        share: Of all runs (or episodes) and protocols whose score is higher.
        low: Lower edge of the band, point by point; NaN over two runs.
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
    table = _units("scores", scores, over)
    normal_quantile(level)
    grid = np.linspace(0.0, 1.0, 101) if thresholds is None else numbers("thresholds", thresholds)

    def shares(table: Floats) -> Floats:
        return np.stack([(table > threshold).mean(axis=(-2, -1)) for threshold in grid])

    how: Any = {"over": over, "level": level, "resamples": resamples, "seed": seed}
    share, low, high = _interval(table, shares, np.ones(grid.shape), is_share=True, **how)
    return Profile(grid, share, low, high, level, table.size)


def probability_of_improvement(
    x: ArrayLike, y: ArrayLike, *, over: str = "runs", level: float = LEVEL
) -> Interval:
    """Estimate how probable a run of ``x`` scores higher than a run of ``y``.

    Per protocol it is the share of pairs in which x is higher, a tie counting half: the
    statistic of Mann and Whitney over the number of pairs. The protocols are then averaged.
    x and y are scores in the same protocols, shaped as for ``aggregate`` like the other arguments;
    they may have different numbers of runs.

    Returns:
        The probability, with the interval of a single protocol. It is not too short where the same
        runs play all protocols, and longer than it need be where protocols differ much.

    Raises:
        UnknownOption: As for ``aggregate``, or x and y have different numbers of protocols.

    Source:
        Newcombe, *Confidence intervals for an effect size measure based on the Mann-Whitney
        statistic, part 2*, Statistics in Medicine 25, 2006, method 5.
    """
    from scipy.optimize import brentq

    ours, theirs = _units("x", x, over), _units("y", y, over)
    z = normal_quantile(level)
    if len(theirs) != len(ours):
        allowed = (f"the {len(ours)} protocols of x",)
        raise UnknownOption("y", f"{len(theirs)} protocols", allowed)
    pairs = zip(ours, theirs, strict=True)
    higher = [np.sign(a.ravel()[:, None] - b.ravel()).mean() for a, b in pairs]
    value = 0.5 + 0.5 * float(np.mean(higher))
    m, n = ours[0].size, theirs[0].size
    more = 0.5 * (m + n) - 1.0

    def outside(p: float) -> Any:
        """Compare the distance from the estimate with what is within the interval."""
        spread = 1.0 + more * (1.0 - p) / (2.0 - p) + more * p / (1.0 + p)
        return (value - p) ** 2 - z * z * p * (1.0 - p) * spread / (m * n)

    tiny = 1e-12
    low = brentq(outside, 0.0, min(value, 1.0 - tiny)) if value > 0.0 else 0.0
    high = brentq(outside, max(value, tiny), 1.0) if value < 1.0 else 1.0
    return Interval(value, low, high, level, ours.size + theirs.size)


def _units(name: str, scores: ArrayLike, over: str) -> Floats:
    """Return scores as ``(protocols, strata, units)``: runs, or episodes within each run."""
    one_of("over", over, OVER)
    array = numbers(name, scores, ndim=(2, 3))
    if over == "episodes" and array.ndim == 2:
        given = f"an array of shape {array.shape} over episodes"
        raise UnknownOption(name, given, ("an array of shape (runs, protocols, episodes)",))
    if over == "runs":
        array = (array if array.ndim == 2 else array.mean(axis=2))[None]
        array = np.moveaxis(array, 1, 2)
    if array.shape[2] < 2:
        allowed = ("'runs' with two runs or more", "'episodes' with two episodes or more")
        raise UnknownOption("over", f"{over} of which {name} has one", allowed)
    return np.moveaxis(array, 0, 1)


def _interval(
    table: Floats,
    statistic: Callable[[Floats], Floats],
    most: Floats,
    *,
    over: str,
    level: float,
    resamples: int,
    seed: int,
    is_share: bool = False,
) -> tuple[Floats, Floats, Floats]:
    """Estimate numbers with their intervals, each of shape ``(k,)``.

    Args:
        table: Shape ``(protocols, strata, units)``.
        statistic: Takes shape ``(..., protocols, scores)``, returns ``(k, ...)``.
        most: What the numbers cannot exceed where scores lie between 0 and 1, shape ``(k,)``.
        over: Whether units are runs, in one stratum, or episodes.
        level: Confidence.
        resamples: Of the bootstrap within strata.
        seed: Of the bootstrap.
        is_share: Whether the numbers lie between 0 and ``most`` for all scores.

    Source:
        Tukey's jackknife: Efron and Tibshirani, 11.
    """
    protocols, strata, n = table.shape
    value = statistic(table.reshape(protocols, -1))
    if over == "episodes":

        def of_resamples(*parts: Floats, axis: int = -1) -> Any:
            drawn = np.stack(parts, axis=1)  # (resamples, protocols * strata, units)
            return statistic(drawn.reshape(len(drawn), protocols, strata * n))

        parts = list(table.reshape(-1, n))
        low, high = bootstrap(parts, of_resamples, level=level, resamples=resamples, seed=seed)
        return value, low, high
    if n < FEWEST_RUNS:
        return value, np.full(value.shape, np.nan), np.full(value.shape, np.nan)
    runs = table[:, 0]
    without = np.stack([statistic(np.delete(runs, run, axis=1)) for run in range(n)])
    error = np.sqrt((n - 1) / n * np.square(without - without.mean(axis=0)).sum(axis=0))
    is_bounded = is_share or bool(runs.min() >= 0.0 and runs.max() <= 1.0)
    bounds = (np.zeros_like(most), most) if is_bounded else None
    return value, *interval_of(value, error, n - 1.0, n, level, bounds)
