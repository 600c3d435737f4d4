"""Trivial baselines: graphs without data, or from correlations.

A learner is worth the distance to these baselines, which are simple on purpose.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.discovery.data.dataset import Dataset
from scm_world.discovery.learners.found import EstimatedGraph
from scm_world.graph.ancestral import CIRCLE

Bools = NDArray[np.bool_]
LEVEL = 0.01
"""Of a test, divided by how many tests there are (Bonferroni)."""
LEAST = 10  # rows of a test
ENTERED = ("exogenous", "action")  # kinds of variables that have no causes in a world


def empty(data: Dataset, *, seed: int = 0) -> Floats:
    """Find no edge; use no data."""
    return np.zeros((len(data.names),) * 2)


def complete(data: Dataset, *, seed: int = 0) -> EstimatedGraph:
    """Join every pair by o-o, which says nothing; use no data."""
    return EstimatedGraph.of_marks(data.names, CIRCLE * (1 - np.eye(len(data.names), dtype=int)))


def bipartite(data: Dataset, *, seed: int = 0) -> Bools:
    """Return edges from every cause to every outcome; use no data.

    Causes are columns that were set in some row, have no causes by their kind, or are of an earlier
    instant; all others are outcomes. Where this leaves no outcome or no cause, every column acts on
    all that stand to the right of it.
    """
    causes = _causes(data)
    if not 0 < causes.sum() < len(causes):
        return np.triu(np.ones((len(causes),) * 2, dtype=bool), 1)
    return causes[:, None] & ~causes


def roles(data: Dataset, *, seed: int = 0) -> Bools:
    """Return the edges of ``bipartite``, but none from colors and categories; use no data."""
    acts = ["color" not in c.name and c.dtype != "categorical" for c in data.columns]
    return np.asarray(bipartite(data) & np.array(acts)[:, None])


def all_or_nothing(data: Dataset, *, seed: int = 0) -> EstimatedGraph:
    """Return edges from a cause to every outcome if it is correlated with one of them."""
    possible = bipartite(data)
    strength = np.where(possible, _correlated(data)[0], 0.0)
    acts = strength.max(axis=1, initial=0.0) > -np.log(LEVEL / max(possible.sum(), 1))
    return EstimatedGraph.of(
        data.names,
        possible & acts[:, None],
        edge_scores=possible * strength.max(axis=1, initial=0.0)[:, None],
    )


def correlation(data: Dataset, *, seed: int = 0) -> EstimatedGraph:
    """Join correlated columns, in rows in which the cause was set if there are such.

    An edge leads from cause to outcome, as in ``bipartite``. Where all are both, rows in which one
    was set tell the direction: it acts on the other if they show the correlation. How many rows
    there are decides whether an edge is seen, not where it points: it has no direction where the
    rows of both show it, where neither was set, and where only other rows show it.
    """
    possible, (strength, own) = bipartite(data), _correlated(data)
    is_split = 0 < _causes(data).sum() < len(data.names)
    if not is_split:
        possible = ~np.eye(len(possible), dtype=bool)
    strength = np.where(possible, strength, 0.0)
    found = strength > -np.log(LEVEL / max(possible.sum(), 1))
    if not is_split:
        alone = own[:, None] & ~own  # only the first one was set
        found = (found | (alone & found.T)) & ~(alone & found).T
        strength = np.where(found & found.T, np.maximum(strength, strength.T), strength)
    return EstimatedGraph.of(data.names, found, edge_scores=strength)


def sort_regress(data: Dataset, *, seed: int = 0) -> EstimatedGraph:
    """Sort the columns by variance, then regress each one on those before it.

    Rows without interventions are used if there are enough; a column of an earlier instant comes
    before all others. The original selects edges by the lasso; here they are tested.

    Source:
        Reisach, Seiler and Weichwald, *Beware of the simulated DAG!*, NeurIPS 2021, section 4.
    """
    from scipy.special import log_ndtr

    free = ~data.intervened
    rows = data.values[free if free.sum() > len(data.names) + LEAST else slice(None)]
    n, p = rows.shape
    centered, spread = rows - rows.mean(axis=0), rows.std(axis=0)
    varies = np.flatnonzero(spread > 0.0)
    lags = np.array([column.lag for column in data.columns])
    order = [int(j) for j in sorted(varies, key=lambda j: (-lags[j], spread[j]))]
    strength = np.zeros((p, p))
    for place, j in enumerate(order):
        causes = order[:place]
        left = n - 1 - len(causes)
        if lags[j] or not causes or left < 1:
            continue
        x, y = centered[:, causes] / spread[causes], centered[:, j] / spread[j]
        inverse = np.linalg.pinv(x.T @ x, hermitian=True)
        weights = inverse @ (x.T @ y)
        noise = max(float(np.square(y - x @ weights).sum()) / left, 1e-300)
        t = weights / np.sqrt(np.maximum(noise * np.diag(inverse), 1e-300))
        strength[causes, j] = -log_ndtr(-np.abs(t)) - np.log(2.0)
    found = strength > -np.log(LEVEL / max(p * (p - 1) // 2, 1))
    return EstimatedGraph.of(data.names, found, edge_scores=np.maximum(strength, 0.0))


def _causes(data: Dataset) -> Bools:
    kinds = [column.kind in ENTERED or column.lag > 0 for column in data.columns]
    found: Bools = data.targeted.any(axis=0) | np.array(kinds)
    return found


def _correlated(data: Dataset) -> tuple[Floats, Bools]:
    """Return minus the logarithm of the p-value of each correlation, shape (p, p).

    Of cause i: over the rows in which i was set, with those in which nothing was if it was always
    set to one value; over all rows if there are too few of them. Also which causes have enough rows
    of their own, shape (p,).

    Source:
        Fisher, *On the probable error of a coefficient of correlation*, Metron 1921.
    """
    from scipy.special import log_ndtr

    values, targeted = data.values, data.targeted
    free = ~data.intervened
    strength, own = np.zeros((values.shape[1],) * 2), np.zeros(values.shape[1], dtype=bool)
    for i in range(values.shape[1]):
        mine = targeted[:, i]
        if mine.any() and not np.ptp(values[mine, i]) > 0.0:
            mine = mine | free
        own[i] = targeted[:, i].any() and mine.sum() >= LEAST
        rows = values[mine] if own[i] else values
        x, largest = rows - rows.mean(axis=0), np.abs(rows).max(axis=0)
        size = np.abs(x).max(axis=0)
        varies = size > 1e-12 * largest  # in any unit
        x = np.ldexp(x, -np.frexp(size)[1])  # so that no square overflows or vanishes
        norm = np.sqrt(np.square(x).sum(axis=0))
        known = varies & varies[i]
        r = np.clip((x[:, i] @ x)[known] / (norm[known] * norm[i]), -1 + 1e-15, 1 - 1e-15)
        if known[i] and len(rows) > 3:
            z = np.abs(np.arctanh(r)) * np.sqrt(len(rows) - 3)
            strength[i, known] = np.maximum(-log_ndtr(-z) - np.log(2.0), 0.0)
    np.fill_diagonal(strength, 0.0)
    return strength, own
