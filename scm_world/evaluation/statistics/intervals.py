"""Estimates of scores with intervals: means, differences, and aggregates over runs and protocols.

A bootstrap of three or ten numbers is too short, and one of forty successes in a row has no width.
So scores with bounds, and differences of them, have Student's interval of the sample to which one
score at either bound is added: that is what a failure that was not seen yet may do. Numbers without
bounds have Student's interval. Intervals over training runs treat a run with its scores in all
protocols as one unit, those over episodes an episode with its scores in all runs and protocols.
``benchmarks/coverage.py`` measures how often all of them contain the truth,
``benchmarks/intervals.py`` how often other methods do.

Source:
    Agarwal et al., *Deep reinforcement learning at the edge of the statistical precipice*,
    NeurIPS 2021, for the aggregates and profiles.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from statistics import NormalDist
from typing import Any, final

import numpy as np

from scm_world._arguments import one_of, typed
from scm_world._types import ArrayLike, Floats
from scm_world.errors import UnknownOption

LEVEL = 0.95
FEWEST_RUNS = 3
"""An interval over runs needs so many."""


@final
@dataclass(frozen=True)
class Interval:
    """An estimate with its confidence interval.

    Attributes:
        value: The estimate.
        low: Lower end; NaN if the data say nothing about it, as one number alone does; the value
            itself, like ``high``, only where nothing is random.
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

    @typed
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
        if self.width == 0.0:
            return f"{self.value:z.2f}"
        digits = min(max(2, -math.floor(math.log10(self.width))), 4)
        return f"{self.value:z.{digits}f} [{self.low:z.{digits}f}, {self.high:z.{digits}f}]"


@typed
def mean_interval(
    values: ArrayLike, *, level: float = LEVEL, proportion: bool | None = None
) -> Interval:
    """Estimate a mean, with an interval.

    Args:
        values: One number per episode, shape ``(n,)``, independent of one another.
        level: Confidence.
        proportion: Whether the values are rates, which always lie in [0, 1]. By default
            they are if all of them do.

    Returns:
        The mean. That of rates has Student's interval of the values, a 0 and a 1, cut off at 0 and
        1: it holds for rare failures and never has the width 0. That of all other numbers has
        Student's interval, whose ends are unknown where nothing varies; it is too short for few
        numbers of a skewed kind.

    Raises:
        UnknownOption: No values; values or a level that are not numbers; or a proportion of values
            that do not lie in [0, 1].

    Source:
        Agresti and Coull, *Approximate is better than "exact" for interval estimation of binomial
        proportions*, The American Statistician 52, 1998, for scores that are added.

    Example:
        >>> print(mean_interval([1.0] * 200))
        1.00 [0.99, 1.00]
    """
    scores = numbers("values", values)
    return _of_mean(scores, (0.0, 1.0) if _is_rate(scores, proportion) else None, level)


@typed
def difference_interval(
    a: ArrayLike, b: ArrayLike, *, level: float = LEVEL, proportion: bool | None = None
) -> Interval:
    """Estimate how much higher ``a`` is than ``b`` in the same episodes (paired).

    Both have shape ``(n,)``; the other arguments are those of ``mean_interval``.

    Returns:
        The mean of ``a - b``, with Student's interval; that of rates is of the differences, a -1
        and a 1: one episode in which only the first succeeds and one in which only the second does.

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
    is_rate = _is_rate(np.concatenate([first, second]), proportion)
    return _of_mean(first - second, (-1.0, 1.0) if is_rate else None, level)


def unpaired_interval(
    a: ArrayLike, b: ArrayLike, *, level: float = LEVEL, proportion: bool | None = None
) -> Interval:
    """Estimate how much higher ``a`` is than ``b`` in independent episodes.

    Their shapes are ``(m,)`` and ``(n,)``; the other arguments are those of ``mean_interval``.

    Returns:
        The difference of the means. Its ends are recovered from those of the two means.

    Raises:
        UnknownOption: As for ``mean_interval``.

    Source:
        Zou and Donner, *Construction of confidence limits about effect measures*, Statistics in
        Medicine 27, 2008; for proportions it is method 10 of Newcombe, *Interval estimation for
        the difference between independent proportions*, Statistics in Medicine 17, 1998.
    """
    one, other = (mean_interval(x, level=level, proportion=proportion) for x in (a, b))
    value = one.value - other.value
    below = math.hypot(one.value - one.low, other.high - other.value)
    above = math.hypot(one.high - one.value, other.value - other.low)
    return Interval(value, value - below, value + above, one.level, one.n + other.n)


@typed
def crossed_interval(
    values: ArrayLike, *, level: float = LEVEL, bounds: tuple[float, float] | None = None
) -> Interval:
    """Estimate the mean of a table that has a number for each run in each draw.

    Args:
        values: Shape (..., draws): the first axes are those of training runs, of one agent or of
            several; all meet the same draws.
        level: Confidence.
        bounds: Between which the means of draws lie, if there are such numbers; one of each counts
            as two further draws.

    Returns:
        The mean. The variance of its error is the sum of those of the means of each axis, and
        Student's interval has Satterthwaite's degrees of freedom. Runs and draws count as random;
        an axis of a single run does not, and the interval is then about that run. It is a little
        too long: an interaction of run and draw counts once for each axis. Without bounds, the
        ends are unknown where there is one draw, or nothing varies.

    Raises:
        UnknownOption: Values or a level that are not numbers.

    Source:
        Owen, *The pigeonhole bootstrap*, Annals of Applied Statistics 2007, for the variance;
        Satterthwaite, *An approximate distribution of estimates of variance components*,
        Biometrics Bulletin 2, 1946.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> table = rng.normal(size=(5, 1)) + rng.normal(size=(1, 40))  # few runs decide
        >>> print(crossed_interval(table))
        0.04 [-0.49, 0.58]
    """
    from scipy.special import stdtrit

    table = numbers("values", values, ndim=(1, 2, 3))
    normal_quantile(level)  # refuses a wrong level
    every, last = range(table.ndim), table.ndim - 1
    parts = [table.mean(axis=tuple(a for a in every if a != axis)) for axis in every]
    parts = [means for axis, means in enumerate(parts) if axis == last or len(means) > 1]
    value = center = float(table.mean())
    if bounds is not None:
        parts[-1] = np.append(parts[-1], bounds)
        center = float(parts[-1].mean())
    if len(parts[-1]) < 2:
        return Interval(value, math.nan, math.nan, level, table.size)
    shares = np.array([means.var(ddof=1) / len(means) for means in parts])
    total, free = float(shares.sum()), np.array([len(means) - 1.0 for means in parts])
    if not math.sqrt(total) > 1e-15 * float(np.abs(table).max()):
        return Interval(value, math.nan, math.nan, level, table.size)
    reach = float(stdtrit(total**2 / (shares**2 / free).sum(), 0.5 + 0.5 * level)) * total**0.5
    low, high = (-math.inf, math.inf) if bounds is None else bounds
    ends = min(max(center - reach, low), value), max(min(center + reach, high), value)
    return Interval(value, *ends, level, table.size)


def _is_rate(scores: Floats, asked: bool | None) -> bool:
    """Whether scores have the bounds 0 and 1: as asked, else if they lie between them."""
    found = bool(scores.min() >= 0.0 and scores.max() <= 1.0)
    if asked and not found:
        raise UnknownOption("a value of a proportion", "another number", ("in [0, 1]",))
    return found if asked is None else asked


def numbers(name: str, values: ArrayLike, *, ndim: tuple[int, ...] = (1,)) -> Floats:
    """Return an array of finite numbers with one of these numbers of axes."""
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


def normal_quantile(level: float) -> float:
    """Return by how many deviations a normal interval reaches to either side."""
    if not 0.0 < level < 1.0:
        raise UnknownOption("level", level, ("a number between 0 and 1, such as 0.95",))
    return NormalDist().inv_cdf(0.5 + 0.5 * level)


def _of_mean(values: Floats, bounds: tuple[float, float] | None, level: float) -> Interval:
    mean = float(values.mean())
    low, high = (float(end) for end in student(values, bounds, level))
    return Interval(mean, min(low, mean), max(high, mean), level, values.size)


def student(
    values: Floats, bounds: tuple[ArrayLike, ArrayLike] | None, level: float
) -> tuple[Floats, Floats]:
    """Return the ends of Student's intervals of means over the first axis, shape ``(...)``.

    One value at either bound is added, and ends do not leave them. Without bounds the ends are NaN
    where nothing varies but by rounding.
    """
    from scipy.special import stdtrit

    normal_quantile(level)  # refuses a wrong level
    lowest, highest = (-np.inf, np.inf) if bounds is None else bounds
    if bounds is not None:
        added = [np.broadcast_to(bound, values.shape[1:])[None] for bound in bounds]
        values = np.concatenate([values, *added])
    n, center = len(values), values.mean(axis=0)
    error = values.std(axis=0, ddof=1) / math.sqrt(n) if n > 1 else np.zeros_like(center)
    reach = float(stdtrit(max(n - 1, 1), 0.5 + 0.5 * level)) * error
    reach = np.where(error > 1e-15 * np.abs(values).max(axis=0), reach, np.nan)
    return np.maximum(center - reach, lowest), np.minimum(center + reach, highest)


def korn_graubard(
    value: Floats, each: Floats, bounds: tuple[Floats, Floats], level: float
) -> tuple[Floats, Floats]:
    """Return the ends of the intervals of rates over runs, which are about alike.

    A rate is a share of the way from one bound to the other. It gets the interval of Clopper and
    Pearson with as many effective units as give its error, corrected for the degrees of freedom,
    but not fewer than there are runs. The arguments are those of ``_ends``.

    Source:
        Korn and Graubard, *Confidence intervals for proportions with small expected number of
        positive counts estimated from survey data*, Survey Methodology 24, 1998.
    """
    from scipy.special import betaincinv, stdtrit

    n, tail, (least, most) = len(each), 0.5 - 0.5 * level, bounds
    spread = each.std(axis=0, ddof=1) / math.sqrt(n)
    ratio = normal_quantile(level) / float(stdtrit(n - 1.0, 1.0 - tail))
    share, scale = np.clip((value - least) / (most - least), 0.0, 1.0), most - least
    with np.errstate(divide="ignore", invalid="ignore"):
        units = share * (1.0 - share) * np.square(scale * ratio / spread)
    units = np.maximum(np.where(spread > 0.0, units, n), n)
    hits, misses = share * units, (1.0 - share) * units
    low = np.where(hits > 0.0, betaincinv(np.maximum(hits, 1e-300), misses + 1.0, tail), 0.0)
    up = np.where(misses > 0.0, betaincinv(hits + 1.0, np.maximum(misses, 1e-300), 1 - tail), 1.0)
    return least + scale * low, least + scale * up


METRICS = ("mean", "median", "interquartile_mean", "optimality_gap")
OVER = ("runs", "episodes")


@typed
def aggregate(
    scores: ArrayLike, *, over: str = "runs", gamma: float = 1.0, level: float = LEVEL
) -> dict[str, Interval]:
    """Estimate the four aggregates, with intervals.

    Args:
        scores: Shape ``(runs, protocols)``, or ``(runs, protocols, episodes)``.
        over: ``"runs"``: a run's score in a protocol is the mean of its episodes, and runs are
            the units, each with its scores in all protocols; the interval is about other runs of
            the same training. ``"episodes"``: the units are episodes, each with its scores in all
            runs and protocols; the interval is about other episodes of the same runs.
        gamma: Score that counts as enough, for the optimality gap.
        level: Confidence.

    Returns:
        By the names of ``METRICS``: the mean; the median protocol's mean; the mean of the middle
        half, of which the number left out at each end is rounded down; and by how much scores miss
        ``gamma`` on average. The ends of an interval over two runs are unknown. An interval over
        few runs holds where the scores of runs are spread about normally. It is too short where a
        run either learns or fails and all runs at hand did the same.

    Raises:
        UnknownOption: Wrong scores, level or ``over``; or less than two runs, or episodes.

    Example:
        >>> scores = np.random.default_rng(0).beta(8, 2, size=(5, 12))
        >>> print(aggregate(scores)["interquartile_mean"])
        0.79 [0.71, 0.86]
    """
    table = _units("scores", scores, over)
    if not np.isfinite(gamma):
        raise UnknownOption("gamma", gamma, ("a finite number",))
    n = table.shape[2]
    value = metrics_of(table, gamma)
    units = np.arange(n)
    without = np.stack([metrics_of(table[:, :, units != unit], gamma) for unit in units])
    is_rate = bool(table.min() >= 0.0 and table.max() <= 1.0)
    bounds = (np.zeros(4), np.array([1.0, 1.0, 1.0, max(gamma, 1.0)])) if is_rate else None
    low, high = _ends(value, n * value - (n - 1) * without, over, level, bounds)
    return {
        name: Interval(float(value[k]), float(low[k]), float(high[k]), level, table.size)
        for k, name in enumerate(METRICS)
    }


def metrics_of(table: Floats, gamma: float = 1.0) -> Floats:
    """Compute the numbers of ``METRICS``, shape ``(4,)``, of ``(protocols, strata, units)``."""
    from scipy.stats import trim_mean

    gap = gamma - np.minimum(table, gamma).mean()
    median = np.median(table.mean(axis=(1, 2)))
    return np.array([table.mean(), median, trim_mean(table, 0.25, axis=None), gap])


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


@typed
def performance_profile(
    scores: ArrayLike,
    thresholds: ArrayLike | None = None,
    *,
    over: str = "runs",
    level: float = LEVEL,
) -> Profile:
    """Estimate the share of scores above each threshold, shape ``(t,)``.

    Thresholds are 101 from 0 to 1 by default; the other arguments are those of ``aggregate``.

    Raises:
        UnknownOption: As for ``aggregate``, or thresholds that are not numbers.
    """
    table = _units("scores", scores, over)
    grid = np.linspace(0.0, 1.0, 101) if thresholds is None else numbers("thresholds", thresholds)
    each = np.stack([(table > threshold).mean(axis=(0, 1)) for threshold in grid], axis=1)
    share = each.mean(axis=0)
    low, high = _ends(share, each, over, level, (np.zeros(grid.shape), np.ones(grid.shape)))
    return Profile(grid, share, low, high, level, table.size)


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


def _ends(
    value: Floats, each: Floats, over: str, level: float, bounds: tuple[Floats, Floats] | None
) -> tuple[Floats, Floats]:
    """Return the ends of the intervals of estimates, both of shape ``(k,)``.

    ``each``, of shape ``(n, k)``, has pseudo-values of the units, whose means the estimates are:
    each unit's own value, or those of Tukey's jackknife (Efron and Tibshirani, 11).
    """
    normal_quantile(level)  # refuses a wrong level
    if over == "runs" and len(each) < FEWEST_RUNS:
        return np.full(value.shape, np.nan), np.full(value.shape, np.nan)
    if over == "runs" and bounds is not None:
        return korn_graubard(value, each, bounds, level)
    low, high = student(each, bounds, level)
    return np.minimum(low, value), np.maximum(high, value)
