"""Scores of learned representations against true factors: MCC, R² and DCI."""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment
from scipy.stats import entropy, rankdata

from scm_world._arguments import load, real_numbers, whole_number
from scm_world._types import Floats
from scm_world.errors import UnknownOption

__all__ = ["DCI", "dci", "mcc", "r2"]

RIDGE = 1e-3
"""The penalty of the linear regression, for standardized codes."""


class DCI(NamedTuple):
    """How a representation divides the factors among its codes; each at most 1, the best.

    Attributes:
        disentanglement: How far each code tells of one factor only, in [0, 1].
        completeness: How far each factor is explained by one code only, in [0, 1].
        informativeness: R² of the factors that were predicted, of rows not fitted; see ``r2``.
    """

    disentanglement: float
    completeness: float
    informativeness: float


def mcc(codes: ArrayLike, factors: ArrayLike) -> float:
    """Compute the mean rank correlation of each factor with a code of its own.

    Args:
        codes: The representation, shape (n, d) with d at least k.
        factors: The truth, shape (n, k), one column for each number.

    Returns:
        The mean of Spearman's absolute correlations in [0, 1], for the best assignment of codes to
        factors. A monotone function of a factor counts as the factor.

    Raises:
        UnknownOption: Shapes do not fit.

    Source:
        Hyvärinen and Morioka, *Unsupervised feature extraction by time-contrastive learning and
        nonlinear ICA*, NeurIPS 2016.

    Example:
        >>> z = np.random.default_rng(0).normal(size=(500, 2))
        >>> round(mcc(np.stack([z[:, 1] ** 3, -z[:, 0]], axis=1), z), 3)
        1.0
    """
    z, truth = _checked(codes, factors)
    if z.shape[1] < truth.shape[1]:
        raise UnknownOption("codes", z.shape, (f"{truth.shape[1]} columns or more",))
    z, truth = rankdata(z, axis=0), rankdata(truth, axis=0)
    strength = np.abs(_standard(z, z).T @ _standard(truth, truth)) / len(z)  # (d, k)
    rows, columns = linear_sum_assignment(-strength)
    return float(strength[rows, columns].mean())


def r2(codes: ArrayLike, factors: ArrayLike) -> float:
    """Compute the share of the factors' variance that a linear function of the codes explains.

    The function is fitted to the first half of the rows, and scored on the second.

    Arguments and errors are those of ``mcc``, with any number of codes.

    Returns:
        The coefficient of determination, the mean over factors; at most 1, below 0 where the
        function is worse than the mean. Factors that have one value in a half of the rows do not
        count, with a warning that lists them; NaN if none is left.

    Example:
        >>> z = np.random.default_rng(0).normal(size=(500, 2))
        >>> round(r2(z @ [[1.0, 2.0], [0.0, 1.0]], z), 3)
        1.0
    """
    z, truth = _checked(codes, factors)
    half = len(z) // 2
    z, mean = _standard(z, z[:half]), truth[:half].mean(axis=0)
    gram = z[:half].T @ z[:half] + RIDGE * half * np.eye(z.shape[1])
    weights = np.linalg.solve(gram, z[:half].T @ (truth[:half] - mean))
    return _determination(mean + z[half:] @ weights, truth)


def dci(codes: ArrayLike, factors: ArrayLike, *, trees: int = 50, seed: int = 0) -> DCI:
    """Compute disentanglement, completeness and informativeness, with random forests.

    Forests are fitted to the first half of the rows, and scored on the second. Other arguments and
    errors are those of ``mcc``, with any number of codes.

    Args:
        codes: The representation, shape (n, d).
        factors: The truth, shape (n, k).
        trees: Of each forest.
        seed: Seed of the forests.

    Raises:
        MissingExtra: scikit-learn is not installed.

    Source:
        Eastwood and Williams, *A framework for the quantitative evaluation of disentangled
        representations*, ICLR 2018.
    """
    count, number = whole_number("trees", trees, least=1), whole_number("seed", seed, least=0)
    ensemble = load("sklearn.ensemble", "scikit-learn", "learn")
    z, truth = _checked(codes, factors)
    half = len(z) // 2
    importances, predicted = [], []
    for factor in truth.T:
        forest = ensemble.RandomForestRegressor(count, random_state=number % 2**32)
        forest.fit(z[:half], factor[:half])
        importances.append(forest.feature_importances_)
        predicted.append(forest.predict(z[half:]))
    weights = np.stack(importances, axis=1)  # (d, k)
    return DCI(
        _concentration(weights),
        _concentration(weights.T),
        _determination(np.stack(predicted, axis=1), truth),
    )


def _concentration(weights: Floats) -> float:
    """Average 1 minus the normalized entropy of the rows, each by its share of the whole."""
    if weights.shape[1] == 1:
        return 1.0
    totals = weights.sum(axis=1)
    used = totals > 0.0
    if not used.any():
        return float("nan")
    entropies = entropy(weights[used], base=weights.shape[1], axis=1)
    return float(np.average(1.0 - entropies, weights=totals[used]))


def _determination(predicted: Floats, truth: Floats) -> float:
    """Return the mean R² of the factors that vary in both halves, of predictions of the second."""
    halves = np.split(truth, [len(truth) // 2])
    varies = np.all([np.ptp(half, axis=0) > 0.0 for half in halves], axis=0)
    if not varies.all():
        columns = ", ".join(map(str, np.flatnonzero(~varies)))
        text = f"factors have one value in a half of the rows, and do not count: columns {columns}"
        warnings.warn(f"{text}; shuffle the rows", stacklevel=3)
    if not varies.any():
        return float("nan")
    wrong = ((halves[1] - predicted) ** 2).mean(axis=0)[varies]
    return float(np.mean(1.0 - wrong / halves[1][:, varies].var(axis=0)))


def _standard(values: Floats, by: Floats) -> Floats:
    """Return columns with mean 0 and standard deviation 1 by some rows; constant ones are 0."""
    spread = np.where(np.ptp(by, axis=0) > 0.0, by.std(axis=0), np.inf)
    return np.asarray((values - by.mean(axis=0)) / spread)


def _checked(codes: ArrayLike, factors: ArrayLike) -> tuple[Floats, Floats]:
    found = []
    for name, given in (("codes", codes), ("factors", factors)):
        try:
            values = real_numbers(given)
        except (TypeError, ValueError):
            values = np.empty(0)
        found.append(values)
        if values.ndim != 2 or len(values) < 4 or not np.isfinite(values).all():
            allowed = ("finite numbers of shape (n, columns), with 4 rows or more",)
            raise UnknownOption(name, f"an array of shape {np.shape(given)}", allowed)
    z, truth = found
    if len(z) != len(truth):
        raise UnknownOption("factors", f"{len(truth)} rows", (f"{len(z)}, as codes have",))
    if not (np.ptp(truth, axis=0) > 0.0).all():
        raise UnknownOption("factors", "a constant column", ("columns that vary",))
    return z, truth
