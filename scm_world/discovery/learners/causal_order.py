"""The causal order of variables, from rows with known intervention targets.

In a set of variables that holds all its ancestors, a variable without effects in the set follows
from the others by its own mechanism, whichever of *them* is intervened on. One with an effect
does not: regressed on all others, its effect among them, its residuals change as soon as the
effect is set from outside. So the variable whose residuals change least between rows with and
without an intervention is taken for the last one, and put aside; and so on. What few rows got
wrong is mended by the likelihood of the orders around.

Source:
    Invariance of a mechanism: Peters, Bühlmann and Meinshausen, *Causal inference by using
    invariant prediction*, JRSS B 2016.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.discovery.data.dataset import Bools

RIDGE = 1e-9  # of the variance: what cannot be told apart gets wide intervals, not an error
EXACT = 1e-10  # variance of residuals, in that of the variable: below it, it is rounding
SPARE = 5  # rows that a regression needs beyond its terms
GAIN = 20.0  # twice the log likelihood that a change of the order has to bring

Ints = NDArray[np.int64]


@final
@dataclass(frozen=True)
class Rows:
    """Standardised numbers, and from which rows each variable may be learned.

    Attributes:
        x: Shape (n, p): mean 0, variance 1; constant columns are 0.
        one: The constant, shape (n,): 1, or what summed rows have in its place.
        targeted: Shape (n, p).
        blocks: Numbers of the columns that are tested together.
        past: Which columns are of earlier control steps, shape (p,).
    """

    x: Floats
    one: Floats
    targeted: Bools
    blocks: tuple[Ints, ...]
    past: Bools

    @property
    def alive(self) -> Bools:
        """Which columns vary, shape (p,)."""
        return np.asarray(self.x.any(axis=0))

    def summed(self) -> Rows:
        """Give fewer rows with the same sums of products, for each set of targets.

        Many rows with the same targets become as many as there are columns, and one more.

        Source:
            The triangular factor R of a matrix X = QR has R'R = X'X.
        """
        whole = np.concatenate([self.x, self.one[:, None]], axis=1)
        kinds, of = np.unique(self.targeted, axis=0, return_inverse=True)
        parts, masks = [], []
        for number, kind in enumerate(kinds):
            part = whole[of.ravel() == number]
            if len(part) > whole.shape[1]:
                part = np.linalg.qr(part, mode="r")
            parts.append(part)
            masks.append(np.repeat(kind[None], len(part), axis=0))
        table = np.concatenate(parts)
        return replace(self, x=table[:, :-1], one=table[:, -1], targeted=np.concatenate(masks))


def before_each(rows: Rows, effects: Bools, causes: Bools) -> Bools:
    """Say which column may act on which, shape (p, p): causes that come before it.

    Args:
        rows: Standardised.
        effects: The columns that are asked about, shape (p,).
        causes: What may act on them, shape (p,).
    """
    may = np.zeros((len(causes), len(causes)), bool)
    always = causes & (rows.past | (_free(rows) < causes.sum() + SPARE))
    left = np.flatnonzero(causes & effects & ~always).tolist()
    base = np.flatnonzero(always)
    may[np.ix_(np.flatnonzero(causes), np.flatnonzero(effects & ~causes))] = True
    moments = _Moments(rows)
    order: list[int] = []
    while left:
        last = left[_last(moments, base, np.array(left))] if len(left) > 1 else left[0]
        left.remove(last)
        order.insert(0, last)
    order = _improved(moments, base, order)
    for place, column in enumerate(order):
        may[base, column] = True
        may[order[:place], column] = True
    return may


def _improved(moments: _Moments, base: Ints, order: list[int]) -> list[int]:
    """Move columns to other places while that makes the rows much more probable."""
    cost = _Cost(moments, base)
    better = True
    while better:
        better = False
        for column in tuple(order):
            moved = _best_place(cost, order, column)
            better, order = better or moved != order, moved
    return order


def _best_place(cost: _Cost, order: list[int], column: int) -> list[int]:
    """Carry a column up and down the order, and leave it where it fits best."""
    best, most = order, GAIN
    for way in (-1, 1):
        trial, at, gained = list(order), order.index(column), 0.0
        while 0 <= at + way < len(order):
            gain = cost.of_swap(trial, min(at, at + way))
            trial[at], trial[at + way] = trial[at + way], trial[at]
            at, gained = at + way, gained + gain
            if gained > most:
                best, most = list(trial), gained
    return best


class _Cost:
    """How improbable the rows of a column are, given the columns before it.

    Source:
        The profile likelihood of linear Gaussian mechanisms under known interventions: Hauser and
        Bühlmann, *Characterization and greedy learning of interventional Markov equivalence
        classes*, JMLR 2012, section 5.
    """

    def __init__(self, moments: _Moments, base: Ints) -> None:
        self._moments, self._base = moments, base.tolist()
        self._known: dict[tuple[int, frozenset[int]], float] = {}

    def of_swap(self, order: list[int], place: int) -> float:
        """Say what is gained by exchanging a column with the next one."""
        before, first, second = order[:place], order[place], order[place + 1]
        now = self._of(first, before) + self._of(second, [*before, first])
        return now - self._of(second, before) - self._of(first, [*before, second])

    def _of(self, column: int, before: list[int]) -> float:
        key = column, frozenset(before)
        if key not in self._known:
            sums = self._moments.of(column)
            constant = len(sums) - 1
            where = [*before, *self._base, constant, column]
            part = sums[np.ix_(where, where)].copy()
            part[np.diag_indices_from(part)] *= 1.0 + RIDGE
            left = float(np.linalg.cholesky(part)[-1, -1]) ** 2  # squares that are not explained
            count = float(sums[constant, constant])
            self._known[key] = count * math.log(max(left / count, EXACT))
        return self._known[key]


def _free(rows: Rows) -> Floats:
    """Count the rows in which each column was not intervened on."""
    return np.asarray(rows.one**2 @ ~rows.targeted)


class _Moments:
    """Sums of products over the rows in which a column was not intervened on."""

    def __init__(self, rows: Rows) -> None:
        self.x, self.one, self.targeted = rows.x, rows.one, rows.targeted
        self._one = np.concatenate([rows.x, rows.one[:, None]], axis=1)
        self._all = self._one.T @ self._one
        self._of: dict[int, Floats] = {}

    def of(self, column: int) -> Floats:
        """Give the sums for one column, shape (p + 1, p + 1); the last one is of ones."""
        if column not in self._of:
            set_ = self._one[self.targeted[:, column]]
            self._of[column] = self._all - set_.T @ set_
        return self._of[column]

    def precisions(self, base: Ints, left: Ints) -> Floats:
        """Invert the sums of some columns, one matrix for each of those that are left."""
        where = np.concatenate([left, base, [self.x.shape[1]]])
        sums = np.stack([self.of(int(j))[np.ix_(where, where)] for j in left])
        sums[:, np.arange(len(where)), np.arange(len(where))] *= 1.0 + RIDGE
        return np.asarray(np.linalg.inv(sums))

    def with_ones(self, columns: Ints) -> Floats:
        """Give columns and, last, the constant."""
        return self._one[:, np.concatenate([columns, [self.x.shape[1]]])]


def _last(moments: _Moments, base: Ints, left: Ints) -> int:
    """Find the column whose mechanism is the same whichever other one is intervened on."""
    k = len(left)
    inverse = moments.precisions(base, left)
    d = np.arange(k)
    diagonal = inverse[d, d, d]
    weights = -inverse[d, d, :] / diagonal[:, None]
    weights[d, d] = 0.0
    free = ~moments.targeted[:, left]
    count = moments.one**2 @ free
    spread = np.sqrt(np.maximum(1.0 / (diagonal * count), EXACT))
    rest = moments.x[:, left] - moments.with_ones(np.concatenate([left, base])) @ weights.T
    rest = np.where(free, rest, 0.0) / spread
    ratio = _changes(rest, free * moments.one[:, None], moments.targeted[:, left])
    return int(np.argmin(ratio.max(axis=0)))


def _changes(rest: Floats, one: Floats, targeted: Bools) -> Floats:
    """Measure how residuals change when a column is intervened on.

    Args:
        rest: Residuals of each column, 0 where it was not free, shape (n, k).
        one: The constant, 0 where a column was not free, shape (n, k).
        targeted: Shape (n, k).

    Returns:
        Twice the log likelihood ratio of two normal distributions against one, shape (k, k): of
        the residuals of column j with and without an intervention on column i.
    """
    given = targeted.T.astype(np.float64)
    sums = [(given @ power, power.sum(axis=0)) for power in (one * one, one * rest, rest * rest)]
    (n1, n), (m1, m), (q1, q) = sums
    n0, m0, q0 = n - n1, m - m1, q - q1
    told = (n1 > 1.5) & (n0 > 1.5)
    np.fill_diagonal(told, False)

    def cost(count: Floats, first: Floats, second: Floats) -> Floats:
        safe = np.where(told, count, 1.0)
        variance = np.maximum(second / safe - (first / safe) ** 2, EXACT)
        return np.asarray(count * np.log(variance))

    whole = cost(n1 + n0, m1 + m0, q1 + q0)
    return np.where(told, whole - cost(n1, m1, q1) - cost(n0, m0, q0), 0.0)
