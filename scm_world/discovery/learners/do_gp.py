"""``do_gp``: a causal graph for nonlinear mechanisms, from unpaired interventions or observations.

Each variable is a Gaussian process of its causes plus Gaussian noise. The score of a graph is the
marginal likelihood, variable by variable, over the rows in which the variable was not set; the mean
of a mechanism is the same in all regimes. A direction that is wrong has to explain rows with and
without an intervention by one function, which it cannot. The graph is climbed by adding, removing
and reversing edges: first with functions that add up over causes, then with interactions, too.

The marginal likelihood weighs fit against complexity by itself, so it can be used with few rows.
An edge must also bring the logarithm of the number of columns, for the number of graphs.

Source:
    Friedman and Nachman, *Gaussian process networks*, UAI 2000, for the score; Hauser and Bühlmann,
    *Characterization and greedy learning of interventional Markov equivalence classes*, JMLR 2012,
    for rows under interventions; Solin and Särkkä, *Hilbert space methods for reduced-rank Gaussian
    process regression*, Statistics and Computing 2020, for the functions of one cause; Rahimi and
    Recht, *Random features for large-scale kernel machines*, NeurIPS 2007, for those of several.
"""

from __future__ import annotations

import math
from typing import Any, final

import numpy as np

from scm_world._types import Floats
from scm_world.discovery.data.dataset import Bools, Dataset
from scm_world.discovery.learners.libraries import library
from scm_world.graph.equivalence import reaches

WAVES = 24  # functions of one cause, beside the straight line
EDGE, CLIP = 4.2, 3.8  # standard deviations: where the functions end, and where columns are cut off
LENGTHS = (100.0, 1.5, 0.6, 0.25)
"""Standard deviations, over which functions change; 100: lines only."""
SIGNALS = 10.0 ** np.arange(-4, 6)  # variance of the functions, in that of the noise
JOINT = 64  # random functions of several causes
JOINT_LENGTH = 1.0  # standard deviations
SMALL = 1e-4  # weight of a function below which it is left out
EXACT = 1e-10  # variance of residuals, in that of the variable: below it, it is rounding
FEW = 10  # rows for each column below which a note warns


@library("do_gp", done=True, least=1)
def do_gp(data: Dataset, *, seed: int = 0) -> Any:
    """Find a graph of curves: the best score of Gaussian processes, one for all regimes.

    Args:
        data: Rows under any regime, with known targets.
        seed: Seed of the random functions of several causes.

    Returns:
        A graph over the columns; ``edge_scores`` is by how much the logarithm of the marginal
        likelihood falls without the edge.

    Raises:
        ModelError: There are not more rows than columns that vary.
    """
    p, past = len(data.names), np.array([column.lag > 0 for column in data.columns], dtype=bool)
    measure, scores = _Evidence(data, seed), np.zeros((p, p))
    edges = _climbed(measure, np.zeros((p, p), bool), past)
    measure.joint = True
    edges = _climbed(measure, edges, past)
    for i, j in np.argwhere(edges).tolist():
        causes = frozenset(np.flatnonzero(edges[:, j]).tolist())
        scores[i, j] = measure.of(j, causes) - measure.of(j, causes - {i})
    notes = []
    never = int((~data.targeted.any(axis=0) & ~past).sum())
    if never:
        notes.append(f"{never} columns were never set: only curvature shows their directions")
    if len(data) < FEW * p:
        notes.append(f"{len(data)} rows are few for {p} columns: many edges may be missed")
    return edges, np.maximum(scores, 0.0), notes


@final
class _Evidence:
    """Logarithm of the marginal likelihood of a column given its causes."""

    def __init__(self, table: Dataset, seed: int) -> None:
        self.x, self.targeted, self.joint = table.values, table.targeted, False
        n, p = self.x.shape
        self._waves = np.pi * np.arange(1, WAVES + 1) / (2.0 * EDGE)
        inside = np.clip(self.x, -CLIP, CLIP)[:, :, None] + EDGE
        curves = np.sin(self._waves * inside) / math.sqrt(EDGE)
        self._terms = np.concatenate([self.x[:, :, None], curves], axis=2).reshape(n, -1)
        self._terms = np.concatenate([self._terms, np.ones((n, 1))], axis=1)
        self._sums = self._terms.T @ self._terms
        rng = np.random.default_rng(seed)
        self._directions = rng.normal(size=(p, JOINT)) / JOINT_LENGTH
        self._phases = rng.uniform(0.0, 2.0 * np.pi, JOINT)
        self._known: dict[tuple[int, frozenset[int], bool], tuple[float, float]] = {}

    def of(self, column: int, causes: frozenset[int]) -> float:
        """Return it, up to a constant of the column."""
        return self._of(column, causes, self.joint and len(causes) > 1)[0]

    def _of(self, column: int, causes: frozenset[int], joint: bool) -> tuple[float, float]:
        """Return it, and the length over which functions change."""
        key = column, causes, joint
        if key not in self._known:
            self._known[key] = self._computed(column, sorted(causes), joint)
        return self._known[key]

    def _computed(self, column: int, causes: list[int], joint: bool) -> tuple[float, float]:
        each, last = WAVES + 1, self._terms.shape[1] - 1
        where = [i * each + k for i in causes for k in range(each)] + [column * each, last]
        set_ = self._terms[self.targeted[:, column]][:, where]
        sums = self._sums[np.ix_(where, where)] - set_.T @ set_
        n = float(sums[-1, -1])
        if n < 2.0:
            return 0.0, LENGTHS[0]
        sums = sums[:-1, :-1] - np.outer(sums[:-1, -1], sums[-1, :-1]) / n
        squares = max(float(sums[-1, -1]), EXACT * n)
        best = -0.5 * n * math.log(squares / n), LENGTHS[0]
        lengths: tuple[float, ...] = LENGTHS
        together = np.zeros((0, 0))
        if joint:  # over the length that is best for the causes one by one
            lengths = (self._of(column, frozenset(causes), joint=False)[1],)
            free = ~self.targeted[:, column]
            angles = self.x[free][:, causes] @ self._directions[causes] + self._phases
            waves = math.sqrt(2.0 / JOINT) * np.cos(angles)
            waves -= waves.mean(axis=0)
            together = waves.T @ np.concatenate([self._terms[free][:, where[:-1]], waves], axis=1)
        for length in lengths if causes else ():
            spectrum = np.exp(-0.25 * (self._waves * length) ** 2) * (2.0 * np.pi) ** 0.25
            weights = np.tile(np.concatenate([[1.0], spectrum * math.sqrt(length)]), len(causes))
            kept = np.flatnonzero(weights > SMALL)
            w = weights[kept]
            matrix = w[:, None] * sums[np.ix_(kept, kept)] * w
            product = w * sums[kept, -1]
            if joint:
                cross = together[:, kept] * w
                own, answer = together[:, len(weights) + 1 :], together[:, len(weights)]
                matrix = np.block([[matrix, cross.T], [cross, own]])
                product = np.concatenate([product, answer])
            found = _largest(matrix, product, squares, n)
            best = max(best, (found, length))
        return best


def _largest(matrix: Floats, product: Floats, squares: float, n: float) -> float:
    """Return the logarithm of the marginal likelihood, for the best variances.

    That is of y ~ N(0, s (I + c F F')), at the best s for each c of ``SIGNALS``; ``matrix`` is
    F'F, ``product`` F'y and ``squares`` y'y.
    """
    values, vectors = np.linalg.eigh(matrix)
    values = np.maximum(values, 0.0)[:, None]
    explained = ((vectors.T @ product) ** 2)[:, None] * SIGNALS / (1.0 + SIGNALS * values)
    left = np.maximum(squares - explained.sum(axis=0), EXACT * squares)
    spread = np.log1p(SIGNALS * values).sum(axis=0)
    return float(np.max(-0.5 * n * np.log(left / n) - 0.5 * spread))


def _climbed(measure: _Evidence, edges: Bools, past: Bools) -> Bools:
    """Add, remove and reverse edges, each time the one that brings most, until none does."""
    edges = edges.copy()
    p = len(edges)
    cost = math.log(p)

    def gain(effect: int, *, more: tuple[int, ...] = (), less: tuple[int, ...] = ()) -> float:
        now = frozenset(np.flatnonzero(edges[:, effect]).tolist())
        return measure.of(effect, (now | set(more)) - set(less)) - measure.of(effect, now)

    while True:
        paths = reaches(edges)
        best: tuple[float, int, int, bool, bool] = (1e-6, 0, 0, False, False)
        for j in np.flatnonzero(~past).tolist():
            for i in range(p):
                if edges[i, j]:
                    without = gain(j, less=(i,))
                    best = max(best, (without + cost, i, j, False, False))
                    onward = edges[i] & (np.arange(p) != j)
                    if not past[i] and not paths[onward, j].any() and not onward[j]:
                        best = max(best, (without + gain(i, more=(j,)), i, j, False, True))
                elif i != j and not paths[j, i]:
                    best = max(best, (gain(j, more=(i,)) - cost, i, j, True, False))
        gained, i, j, edges_ij, edges_ji = best
        if gained <= 1e-6:
            return edges
        edges[i, j], edges[j, i] = edges_ij, edges_ji
