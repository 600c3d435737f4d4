"""How probable it is that one policy scores higher than another."""

from __future__ import annotations

import numpy as np

from scm_world._types import ArrayLike, Floats
from scm_world.errors import UnknownOption
from scm_world.evaluation.statistics.inputs import checked_draws, checked_level
from scm_world.evaluation.statistics.intervals import LEVEL, RESAMPLES, Interval
from scm_world.evaluation.statistics.resampling import percentiles
from scm_world.evaluation.statistics.units import pooled, pooled_counts, units


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

    Args:
        x: Scores, shape ``(runs, protocols)`` or ``(runs, protocols, episodes)``.
        y: Scores of another policy in the same protocols; it may have another number of runs.
        over: ``"runs"`` or ``"episodes"``: what is compared and resampled, see ``units``.
        level: Confidence.
        resamples: Of the bootstrap; x and y are resampled apart, within each protocol.
        seed: Of the bootstrap.

    Raises:
        UnknownOption: As for ``aggregate``, or x and y have different numbers of protocols.

    Source:
        Agarwal et al., *Deep reinforcement learning at the edge of the statistical precipice*,
        NeurIPS 2021; Mann and Whitney, Annals of Mathematical Statistics 18, 1947.

    Example:
        >>> probability_of_improvement([[0.9], [0.7]], [[0.7], [0.2]]).value
        0.875
    """
    ours, theirs = units("x", x, over), units("y", y, over)
    level = checked_level(level)
    protocols = ours.shape[-1]
    if theirs.shape[-1] != protocols:
        raise UnknownOption(
            "y", f"{theirs.shape[-1]} protocols", (f"the {protocols} protocols of x",)
        )
    rng = np.random.default_rng(seed)
    value, drawn = 0.0, np.zeros(checked_draws("resamples", resamples))
    for protocol in range(protocols):
        pairs = _higher(pooled(ours)[:, protocol], pooled(theirs)[:, protocol])
        of_x = pooled_counts(ours, resamples=resamples, rng=rng)
        of_y = pooled_counts(theirs, resamples=resamples, rng=rng)
        value += float(pairs.mean()) / protocols
        drawn += np.einsum("rj,rj->r", of_x @ pairs, of_y) / (pairs.size * protocols)
    n = ours.size + theirs.size
    return Interval(value, *percentiles(drawn, level), level, n)


def _higher(x: Floats, y: Floats) -> Floats:
    """Compare every pair: 1 where x is higher, 0.5 where they are equal, shape ``(x, y)``."""
    return 0.5 + 0.5 * np.sign(x[:, None] - y[None, :])


__all__ = ["probability_of_improvement"]
