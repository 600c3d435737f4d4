"""How many scores are above each threshold: performance profiles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from scm_world._types import ArrayLike, Floats
from scm_world.evaluation.statistics.inputs import checked_level, numbers
from scm_world.evaluation.statistics.intervals import LEVEL, RESAMPLES
from scm_world.evaluation.statistics.units import pooled, resampled, units


@final
@dataclass(frozen=True)
class Profile:
    """Share of scores above each threshold, with a band.

    Attributes:
        thresholds: Shape ``(t,)``.
        share: Of all units and protocols whose score is higher, shape ``(t,)``.
        low: Lower edge of the band, point by point, shape ``(t,)``.
        high: Upper edge, shape ``(t,)``.
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
    """Estimate the share of scores above each threshold.

    Args:
        scores: Shape ``(runs, protocols)``, or ``(runs, protocols, episodes)``.
        thresholds: Shape ``(t,)``; by default 101 from 0 to 1.
        over: ``"runs"`` or ``"episodes"``: what has a score and is resampled, see ``units``.
        level: Confidence.
        resamples: Of the bootstrap.
        seed: Of the bootstrap.

    Raises:
        UnknownOption: As for ``aggregate``, or thresholds that are no numbers.

    Source:
        Agarwal et al., *Deep reinforcement learning at the edge of the statistical precipice*,
        NeurIPS 2021, "score distributions".

    Example:
        >>> performance_profile([[0.1, 0.6], [0.4, 0.9]], [0.0, 0.5, 1.0]).share.tolist()
        [1.0, 0.5, 0.0]
    """
    groups = units("scores", scores, over)
    grid = np.linspace(0.0, 1.0, 101) if thresholds is None else numbers("thresholds", thresholds)
    level = checked_level(level)
    blocks = [_above(block, grid) for block in resampled(groups, resamples=resamples, seed=seed)]
    low, high = np.quantile(np.concatenate(blocks), [0.5 - 0.5 * level, 0.5 + 0.5 * level], axis=0)
    return Profile(grid, _above(pooled(groups), grid), low, high, level, groups.size)


def _above(scores: Floats, thresholds: Floats) -> Floats:
    """Count, shape ``(..., units, protocols)`` to ``(..., t)``."""
    shares = [(scores > threshold).mean(axis=(-2, -1)) for threshold in thresholds]
    return np.stack(shares, axis=-1)


__all__ = ["Profile", "performance_profile"]
