"""Draws of hidden noise that know the evidence: adaptive importance sampling.

Noise is counted in scores, which have the standard normal distribution before anything is observed.
New scores of a unit come from a mixture of normal distributions: the prior, so that no weight is
much larger than the likelihood; a wide one; and in either half of the draws before, which may be
two modes, one with their moments and two that follow the curvature of the log posterior. Where few
of the draws before fit, their weights are tempered, so that new ones come closer to the evidence.

Source:
    Bugallo et al., *Adaptive importance sampling: the past, the present, and the future*, IEEE
    Signal Processing Magazine 2017.
    Hesterberg, *Weighted average importance sampling and defensive mixture distributions*,
    Technometrics 1995.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import special

from scm_world._types import Floats
from scm_world.variables import Box, Continuous, Normal

LARGE = 20
"""Largest number of scores whose curvature is estimated."""

FARTHEST = 37.0
"""Largest score whose probability is a number."""

MANY = 4000
"""Number of draws that are enough for a fit, and of which a share is enough."""

ENOUGH = 0.25
"""Share of the draws that is enough as their effective number."""


def scores_of(source: Normal | Box | Continuous, noise: Floats) -> Floats:
    """Return the scores of noise, shape (n, *shape); not finite where it is not continuous."""
    with np.errstate(divide="ignore", invalid="ignore"):
        if isinstance(source, Normal):
            return np.asarray((noise - source.mean) / source.std)
        frozen = _frozen(source, noise.shape[1:])
        below, above = special.ndtri(frozen.cdf(noise)), -special.ndtri(frozen.sf(noise))
    return np.asarray(np.where(below < 0.0, below, above).clip(-FARTHEST, FARTHEST))


def noise_of(source: Normal | Box | Continuous, scores: Floats) -> Floats:
    """Return the noise of scores, exact in both tails."""
    if isinstance(source, Normal):
        return np.asarray(source.mean + source.std * scores)
    frozen = _frozen(source, scores.shape[1:])
    below, above = frozen.ppf(special.ndtr(scores)), frozen.isf(special.ndtr(-scores))
    return np.asarray(np.where(scores < 0.0, below, above))


def _frozen(source: Box | Continuous, shape: tuple[int, ...]) -> Any:
    if isinstance(source, Continuous):
        return source.frozen
    from scipy import stats  # takes half a second

    low, high = source.bounds(shape, {})
    return stats.uniform(low, np.asarray(high) - low)


def weights_of(logs: Floats) -> Floats:
    """Return weights that sum to 1 along the last axis from their logarithms; 0 if all are."""
    most = logs.max(axis=-1, keepdims=True)
    weights = np.exp(logs - np.where(np.isfinite(most), most, 0.0))
    return np.asarray(weights / np.maximum(weights.sum(axis=-1, keepdims=True), 1e-300))


def nearer(scores: Floats, evidence: Floats, logs: Floats, normal: Floats) -> tuple[Floats, Floats]:
    """Draw scores of a unit again, nearer to the evidence.

    Args:
        scores: The draws before, shape (n, d).
        evidence: Log likelihood of each of them, up to a constant, shape (n,).
        logs: Their log weights, shape (n,).
        normal: Standard normal numbers, shape (n, d).

    Returns:
        Scores, shape (n, d), and ln(prior density / density of the draws) of each, shape (n,).
    """
    n, d = scores.shape
    possible = bool(np.isfinite(logs).any())
    if d > LARGE and possible:
        basis = _directions(scores, evidence, logs)
        found, ratio = nearer(scores @ basis, evidence, logs, normal @ basis)
        return normal + (found - normal @ basis) @ basis.T, ratio
    some = slice(None, None, max(1, n // MANY))
    parts = _nearer(scores[some], evidence[some], logs[some]) if possible else _wider(d)
    shares, means, roots = (np.array(part) for part in zip(*parts, strict=True))
    shares /= shares.sum()
    kind = np.searchsorted(np.cumsum(shares[:-1]), (np.arange(n) + 0.5) / n)
    found = means[kind] + np.einsum("nij,nj->ni", roots[kind], normal)
    densities = []
    for share, centre, spread in zip(shares, means, roots, strict=True):
        far = np.linalg.solve(spread, (found - centre).T)
        log_volume = np.linalg.slogdet(spread)[1]
        densities.append(np.log(share) - log_volume - 0.5 * (far**2).sum(axis=0))
    return found, -0.5 * (found**2).sum(axis=1) - special.logsumexp(densities, axis=0)


Part = tuple[float, Floats, Floats]
"""A component: its share, its mean, and a square root of its covariance."""


def _wider(d: int) -> list[Part]:
    """Return components that go farther than the prior, where no draw fits the evidence."""
    return [(1.0, np.zeros(d), width * np.eye(d)) for width in (1.0, 2.0, 4.0)]


def _nearer(scores: Floats, evidence: Floats, logs: Floats) -> list[Part]:
    """Return components that are nearer to the evidence."""
    (weights, power), d = _tempered(logs), scores.shape[1]
    powers = (1.0, np.sqrt(power)) if power < 1.0 else (1.0,)
    mean, root = _moments(scores, weights)
    points = np.linalg.solve(root, (scores - mean).T).T
    flat = (weights @ points**4) / np.maximum(weights @ points**2, 1e-9) ** 2
    side = points[:, flat.argmin()] > 0.0  # least kurtosis: across two modes, if there are two
    parts = [(0.1, np.zeros(d), np.eye(d)), (0.15, mean, 3.0 * root)]
    for here in (side, ~side):
        mass = (weights * here).sum()
        if mass > 0.0:
            half = weights * here / mass
            mean, root = _moments(scores, half)
            parts.append((0.125, mean, root))
            for to in powers:
                target = to * evidence - 0.5 * (scores**2).sum(axis=1)
                curved = _curved(scores, target, half, mean, root)
                parts.append((0.25 / len(powers), *curved))
    return parts


def _directions(scores: Floats, evidence: Floats, logs: Floats) -> Floats:
    """Return directions that the evidence tells most about, shape (d, ``LARGE``)."""
    weights, _ = _tempered(logs)
    ones = np.ones((len(scores), 1))
    slope = _regression(np.hstack([ones, scores]), evidence, weights)[1:]
    mean, root = _moments(scores, weights)
    unlike = np.argsort(-np.abs(np.log(np.linalg.norm(root, axis=0))))
    basis: Floats = np.linalg.qr(np.column_stack([slope, mean, root[:, unlike[: LARGE - 2]]]))[0]
    return basis


def _tempered(logs: Floats) -> tuple[Floats, float]:
    """Return weights to a power at which enough draws count, and the power."""
    weights, power = weights_of(logs), 1.0
    while 1.0 / (weights**2).sum() < ENOUGH * np.isfinite(logs).sum():
        power *= 0.6
        weights = weights_of(power * logs)
    return weights, power


def _regression(rows: Floats, values: Floats, weights: Floats) -> Floats:
    """Return the coefficients of a weighted regression on the columns of ``rows``."""
    there = weights > 0.0
    rows, weighted = rows[there], rows[there].T * weights[there]
    square = weighted @ rows
    ridge = 1e-10 * np.trace(square) / len(square)
    return np.linalg.solve(square + ridge * np.eye(len(square)), weighted @ values[there])


def _moments(scores: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Return the mean of weighted scores and a square root of their covariance.

    Eigenvalues that 1 may have by chance, of so many draws (Marchenko and Pastur 1967), are 1.
    """
    error = np.sqrt(scores.shape[1] * (weights**2).sum())
    mean = weights @ scores
    apart = scores - mean
    values, axes = np.linalg.eigh((weights * apart.T) @ apart)
    usual = (values >= max(0.0, 1.0 - error) ** 2) & (values <= (1.0 + error) ** 2)
    return mean, axes * np.sqrt(np.where(usual, 1.0, np.maximum(values, 1e-12)))


def _curved(
    scores: Floats, logs: Floats, weights: Floats, mean: Floats, root: Floats
) -> tuple[Floats, Floats]:
    """Find the normal distribution of a log density by regression on squares.

    Args:
        scores: Shape (n, d).
        logs: Log density at the scores, up to a constant.
        weights: Weights of the scores.
        mean: Their mean.
        root: A square root of their covariance.

    Returns:
        The mean, and a square root of the covariance.
    """
    d = len(mean)
    first, second = np.triu_indices(d)
    there = weights > 1e-6 / len(weights)
    if there.sum() < (d + 1) * (d + 2):
        return mean, root
    points = np.linalg.solve(root, (scores[there] - mean).T).T
    rows = np.hstack([np.ones((len(points), 1)), points, points[:, first] * points[:, second]])
    found = _regression(rows, logs[there], weights[there])
    curvature = np.zeros((d, d))
    curvature[first, second] = -found[d + 1 :]
    values, axes = np.linalg.eigh(curvature + curvature.T)
    values = np.maximum(np.abs(values), 0.1)
    step = np.clip((found[1 : d + 1] @ axes) / values, -10.0, 10.0)
    return mean + root @ axes @ step, root @ axes / np.sqrt(values)
