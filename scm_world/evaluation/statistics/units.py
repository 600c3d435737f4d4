"""What an aggregate counts and resamples: training runs, or episodes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from scm_world._types import ArrayLike, Floats
from scm_world.errors import UnknownOption
from scm_world.evaluation.statistics.inputs import numbers
from scm_world.evaluation.statistics.resampling import batches, drawn_counts

OVER = ("runs", "episodes")


def units(name: str, scores: ArrayLike, over: str) -> Floats:
    """Arrange scores as groups of units that may stand for one another.

    Args:
        name: What the scores are called, for the message.
        scores: Shape ``(runs, protocols)`` or ``(runs, protocols, episodes)``.
        over: ``"runs"``: a unit is a run, and its score is the mean of its episodes; the interval
            is about other runs of the same training. ``"episodes"``: a unit is an episode; the
            interval is about other episodes of the same runs.

    Returns:
        Shape ``(groups, units, protocols)``: one group of runs, or a group of episodes per run.

    Raises:
        UnknownOption: Another ``over``; runs of which there is one; episodes of which there is one,
            or that were averaged before.

    Example:
        >>> units("scores", np.zeros((5, 12, 200)), "runs").shape
        (1, 5, 12)
        >>> units("scores", np.zeros((5, 12, 200)), "episodes").shape
        (5, 200, 12)
    """
    if over not in OVER:
        raise UnknownOption("over", over, OVER)
    array = numbers(name, scores, ndim=(2, 3))
    if over == "runs":
        found = (array if array.ndim == 2 else array.mean(axis=2))[None]
    elif array.ndim == 3:
        found = array.transpose(0, 2, 1)
    else:
        raise UnknownOption(
            name,
            f"an array of shape {array.shape} over episodes",
            ("an array of shape (runs, protocols, episodes)",),
        )
    if found.shape[1] < 2:
        raise UnknownOption(
            "over",
            f"{over} of which {name} has one",
            ("'runs' with two runs or more", "'episodes' with two episodes or more"),
        )
    return found


def pooled(groups: Floats) -> Floats:
    """Put the units of all groups into one row, shape ``(..., groups * units, protocols)``."""
    return groups.reshape(*groups.shape[:-3], -1, groups.shape[-1])


def resampled(groups: Floats, *, resamples: int, seed: int) -> Iterator[Floats]:
    """Draw units with replacement, in each group and protocol on its own.

    Yields:
        Blocks of resamples, each of shape ``(some, groups * units, protocols)``.

    Source:
        Agarwal et al., *Deep reinforcement learning at the edge of the statistical precipice*,
        NeurIPS 2021, "stratified bootstrap".
    """
    rng = np.random.default_rng(seed)
    for rows in batches(resamples, groups.size):
        drawn = rng.integers(groups.shape[1], size=(rows.stop - rows.start, *groups.shape))
        yield pooled(np.take_along_axis(groups[None], drawn, axis=2))


def pooled_counts(groups: Floats, *, resamples: int, rng: np.random.Generator) -> Floats:
    """Draw how often each unit of one protocol is in a resample.

    Returns:
        Shape ``(resamples, groups * units)``.
    """
    n = groups.shape[1]
    drawn = [drawn_counts(n, resamples=resamples, rng=rng) for _ in range(len(groups))]
    return np.concatenate(drawn, axis=1)


__all__ = ["OVER", "pooled", "pooled_counts", "resampled", "units"]
