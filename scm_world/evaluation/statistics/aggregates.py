"""Many runs and protocols at once: aggregates, profiles and improvement, as rliable defines them.

``rliable.library`` itself cannot be imported beside pandas 3, and its bootstrap draws from numpy's
global generator.

Source:
    Agarwal et al., *Deep reinforcement learning at the edge of the statistical precipice*,
    NeurIPS 2021.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np

from scm_world._types import ArrayLike, Floats
from scm_world.errors import UnknownOption
from scm_world.evaluation.statistics.intervals import (
    LEVEL,
    RESAMPLES,
    Interval,
    bootstrap,
    draws,
    normal_quantile,
    numbers,
)

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
    if over not in OVER:
        raise UnknownOption("over", over, OVER)
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
