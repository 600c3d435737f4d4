"""How much each edge of a graph explains, in one measure for all learners of static graphs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.discovery.data.dataset import Dataset


def likelihood_gain(data: Dataset, edges: NDArray[np.bool_]) -> Floats:
    """Compute by how much the likelihood falls if an edge is taken away.

    Each column is regressed on all columns with an edge to it, in the rows where it was not set
    from outside; noise is Gaussian. Taking column i away from the regression of j multiplies its
    sum of squares by 1 + b² / (v s), with b the coefficient of i, s the sum of squares and v the
    entry of i in the inverse of the matrix of the regression.

    Args:
        data: Rows of p columns, none a linear function of others.
        edges: Shape (p, p). An edge without direction stands both ways; the smaller gain counts.

    Returns:
        Differences of the logarithm of the likelihood, shape (p, p); 0 where there is no edge. The
        Bayesian information criterion subtracts the same number, log(n) / 2, for each edge of j.

    Source:
        Seber and Lee, *Linear Regression Analysis*, 2003, chapter 4: the F-test of one coefficient.

    Example:
        >>> x = np.array([-1.5, -0.5, 0.5, 1.5])
        >>> data = Dataset.of(np.stack([x, x + [0.1, -0.1, -0.1, 0.1]], axis=1), ["x", "y"])
        >>> likelihood_gain(data, np.array([[False, True], [False, False]])).round(2).tolist()
        [[0.0, 9.67], [0.0, 0.0]]
    """
    gain = np.zeros(edges.shape)
    for j in range(len(edges)):
        parents = np.flatnonzero(edges[:, j])
        rows = ~data.targeted[:, j]
        if len(parents) and rows.sum() > len(parents) + 1:
            gain[parents, j] = _gains(data.values[rows][:, parents], data.values[rows, j])
    both = edges & edges.T
    smaller: Floats = np.where(both, np.minimum(gain, gain.T), gain)
    return smaller


def _gains(causes: Floats, effect: Floats) -> Floats:
    """Compute it for all causes of one effect, shape (k,)."""
    x, y = causes - causes.mean(axis=0), effect - effect.mean()
    inverse = np.linalg.pinv(x.T @ x)
    weight = inverse @ (x.T @ y)
    tiny = np.finfo(float).tiny
    left = max(float(np.sum((y - x @ weight) ** 2)), 1e-16 * float(y @ y), tiny)
    gains: Floats = 0.5 * len(y) * np.log1p(weight**2 / (np.maximum(np.diag(inverse), tiny) * left))
    return gains
