"""Probes: how much of a cause can be read off some numbers, in episodes that were not fitted.

Both are ridge regressions with an intercept: a linear one, and one of Gaussian kernels, whose width
is the median distance. Each fold of episodes is predicted from the others; the penalty of a fold is
the one with the smallest error of leaving one out among the others.

Source:
    Alain and Bengio, *Understanding intermediate layers using linear classifier probes*, 2016;
    Hewitt and Liang, *Designing and interpreting probes with control tasks*, EMNLP 2019; Hastie,
    Tibshirani and Friedman, *The elements of statistical learning*, 2009, sections 5.8 and 7.10.
"""

from __future__ import annotations

import numpy as np

from scm_world._types import Floats, Integers
from scm_world.evaluation.statistics.intervals import LEVEL, Interval

PROBES = ("linear", "kernel")
FOLDS = 5
RESAMPLES = 2000
SHUFFLES = 50
PENALTIES = np.logspace(-6.0, 3.0, 19)
"""In units of the mean eigenvalue of the kernel matrix."""

Scores = dict[str, Interval]
"""R² of a cause in held-out episodes, by the name of the probe."""


def probe(features: Floats, causes: Floats, *, seed: int = 0) -> list[tuple[Scores, Scores]]:
    """Compute how much of each cause the probes predict in held-out episodes.

    Args:
        features: A row for each episode, shape ``(n, k)``.
        causes: Shape ``(n, m)``; none of the columns is constant.
        seed: Seed of the folds, of the resampled episodes and of the shuffles.

    Returns:
        For each cause the scores, R² with its interval over episodes (a percentile bootstrap of
        the held-out errors), and those of the same values given to other episodes: their mean, and
        the interval in which 95 % of ``SHUFFLES`` shuffles lie.
    """
    (n, m), tail = causes.shape, 0.5 - 0.5 * LEVEL
    rng = np.random.default_rng(seed)
    folds = rng.permutation(n) % FOLDS
    counts = rng.multinomial(n, np.full(n, 1.0 / n), size=RESAMPLES).astype(np.float64)
    shuffled = [causes[rng.permutation(n)] for _ in range(SHUFFLES)]
    targets = np.concatenate([causes, *shuffled], axis=1)
    found: list[tuple[Scores, Scores]] = [({}, {}) for _ in range(m)]
    for name in PROBES:
        errors, spread = _held_out(features, targets, folds, name)
        scores = (1.0 - errors.sum(axis=0) / spread.sum(axis=0)).reshape(1 + SHUFFLES, m)
        again = 1.0 - counts @ errors[:, :m] / (counts @ spread[:, :m])
        ends = np.quantile(again, [tail, 1.0 - tail], axis=0)
        by_chance = np.quantile(scores[1:], [tail, 1.0 - tail], axis=0)
        for column, (own, control) in enumerate(found):
            value, chance = float(scores[0, column]), float(scores[1:, column].mean())
            low, high = ends[:, column].tolist()
            own[name] = Interval(value, low, high, LEVEL, n)
            low, high = by_chance[:, column].tolist()
            control[name] = Interval(chance, low, high, LEVEL, SHUFFLES)
    return found


def _held_out(
    features: Floats, targets: Floats, folds: Integers, name: str
) -> tuple[Floats, Floats]:
    """Return the squared errors of held-out predictions, and those of the mean, shape (n, m)."""
    errors, spread = np.empty_like(targets), np.empty_like(targets)
    for fold in range(FOLDS):
        held, rest = folds == fold, folds != fold
        center = targets[rest].mean(axis=0)
        kernel = _kernel(features, rest, name)
        sizes, axes = np.linalg.eigh(kernel[rest])
        sizes = np.maximum(sizes, 0.0)
        rotated = axes.T @ (targets[rest] - center)
        penalties = PENALTIES * (sizes.mean() or 1.0)
        missed = []
        for penalty in penalties:
            kept = sizes / (sizes + penalty)
            leverage = np.square(axes) @ kept + 1.0 / len(axes)
            left = targets[rest] - center - axes @ (kept[:, None] * rotated)
            left /= np.maximum(1.0 - leverage, 1e-6)[:, None]  # the error of leaving one out
            missed.append(np.square(left).sum(axis=0))
        chosen = penalties[np.argmin(missed, axis=0)]
        predicted = center + kernel[held] @ (axes @ (rotated / (sizes[:, None] + chosen)))
        errors[held] = np.square(targets[held] - predicted)
        spread[held] = np.square(targets[held] - center)
    return errors, spread


def _kernel(features: Floats, rest: Integers, name: str) -> Floats:
    """Return the centered kernel of all rows with those that are fitted, shape (n, fitted)."""
    mean, deviation = features[rest].mean(axis=0), features[rest].std(axis=0)
    varied = deviation > 1e-9 * np.abs(features[rest]).max(axis=0, initial=0.0)
    x = (features[:, varied] - mean[varied]) / deviation[varied]
    found = x @ x[rest].T
    if name == "kernel":
        square = np.square(x).sum(axis=1)
        distances = np.maximum(square[:, None] + square[rest] - 2.0 * found, 0.0)
        found = np.exp(-distances / (np.median(distances[rest]) or 1.0))
    found = found - found[rest].mean(axis=0)
    centered: Floats = found - found.mean(axis=1, keepdims=True)
    return centered
