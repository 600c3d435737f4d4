"""One number for many runs and protocols, by the definitions of rliable.

Written out here because ``rliable.library`` cannot be imported beside pandas 3, and because its
bootstrap draws from numpy's global generator, whatever seed it is given.

Source:
    Agarwal et al., *Deep reinforcement learning at the edge of the statistical precipice*,
    NeurIPS 2021.
"""

from __future__ import annotations

import numpy as np

from scm_world._types import ArrayLike, Floats
from scm_world.errors import UnknownOption
from scm_world.evaluation.statistics.inputs import checked_level
from scm_world.evaluation.statistics.intervals import LEVEL, RESAMPLES, Interval
from scm_world.evaluation.statistics.resampling import percentiles
from scm_world.evaluation.statistics.units import pooled, resampled, units

METRICS = ("mean", "median", "interquartile_mean", "optimality_gap")


def mean(scores: Floats) -> Floats:
    """Average the scores, shape ``(..., units, protocols)``, over the last two axes."""
    return np.asarray(scores.mean(axis=(-2, -1)))


def median(scores: Floats) -> Floats:
    """Take the median protocol's mean score, of scores of shape ``(..., units, protocols)``."""
    return np.asarray(np.median(scores.mean(axis=-2), axis=-1))


def interquartile_mean(scores: Floats) -> Floats:
    """Average the middle half of all scores, of shape ``(..., units, protocols)``.

    The number left out at each end is rounded down.

    Example:
        >>> float(interquartile_mean(np.array([[0.0, 1.0], [2.0, 90.0]])))
        1.5
    """
    flat = scores.reshape(*scores.shape[:-2], -1)
    cut = flat.shape[-1] // 4
    last = flat.shape[-1] - cut
    middle = np.partition(flat, (cut, last - 1), axis=-1)[..., cut:last]
    return np.asarray(middle.mean(axis=-1))


def optimality_gap(scores: Floats, gamma: float = 1.0) -> Floats:
    """Compute by how much scores, of shape ``(..., units, protocols)``, miss ``gamma`` on average.

    Example:
        >>> float(optimality_gap(np.array([[0.5, 2.0]])))
        0.25
    """
    return np.asarray(gamma - np.minimum(scores, gamma).mean(axis=(-2, -1)))


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
            resampled. ``"episodes"``: an episode stands where a run stood; with a single run there
            is nothing else to resample. See ``units``.
        gamma: Score that counts as enough, for the optimality gap.
        level: Confidence.
        resamples: Of the bootstrap.
        seed: Of the bootstrap.

    Returns:
        By the names of ``METRICS``.

    Raises:
        UnknownOption: Scores, level, resamples or ``over`` that are none; or ``over="runs"`` with
            less than two runs.

    Example:
        >>> scores = np.random.default_rng(0).beta(8, 2, size=(5, 12))
        >>> print(aggregate(scores)["interquartile_mean"])
        0.79 [0.76, 0.83]
    """
    groups = units("scores", scores, over)
    level = checked_level(level)
    if not np.isfinite(gamma):
        raise UnknownOption("gamma", gamma, ("a finite number",))
    blocks = [_all(block, gamma) for block in resampled(groups, resamples=resamples, seed=seed)]
    found = _all(pooled(groups), gamma)
    drawn = np.concatenate(blocks, axis=1)  # (metrics, resamples)
    return {
        name: Interval(float(found[k]), *percentiles(drawn[k], level), level, groups.size)
        for k, name in enumerate(METRICS)
    }


def _all(scores: Floats, gamma: float) -> Floats:
    """Compute every metric, in the order of ``METRICS``, shape ``(metrics, ...)``."""
    return np.stack(
        [
            mean(scores),
            median(scores),
            interquartile_mean(scores),
            optimality_gap(scores, gamma),
        ]
    )


__all__ = ["METRICS", "aggregate", "interquartile_mean", "mean", "median", "optimality_gap"]
