"""``do_order``: a causal graph from unpaired interventions with known targets.

First the order. In a set of variables that holds all its ancestors, a variable without effects in
the set follows from the others by its own mechanism, whichever of *them* is intervened on. One with
an effect does not: regressed on all others, its effect among them, its residuals change as soon as
the effect is set. So the variable whose residuals change least between rows with and without an
intervention is taken for the last one, and put aside; and so on. The likelihood of neighboring
orders corrects mistakes of few rows.

Then the edges: each variable is regressed on those before it, over the rows in which it was not
intervened on itself. A cause is kept if it explains more than chance would; over all tests the
share of false edges is bounded, as long as the effects of causes add up. If they do not, a note
says so.

Only targets of interventions can be found to be causes, and not of variables that were set in
all the same rows. Earlier control steps are causes without that, because time has an order. A
variable that is constant in an episode (a mass) is an effect only of other constants, at lag 0,
and acts on all other variables at lag 1.

Columns that vary but were never set may act on others, too, and so on a cause and its effect at
once. With such columns no order can be found: a column is then an effect of a cause if it follows
the values to which the cause was set, with these values as instruments. The graph is the latent
projection: an edge between two variables may pass through columns that were never set, and
these have no effects in it.

It assumes that effects add up, and, unless some columns were never set, that variables without a
column act on at most one of the columns that were intervened on. Scales do not matter: standardised
data give the same.

Source:
    Invariance of a mechanism: Peters, Bühlmann and Meinshausen, *Causal inference by using
    invariant prediction*, JRSS B 2016. Direct effects among hidden causes: Hyttinen, Eberhardt and
    Hoyer, *Learning linear cyclic causal models with latent variables*, JMLR 2012; instruments
    instead of covariances, with the sandwich variance of White, Econometrica 1980.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import typed
from scm_world._types import Floats
from scm_world.discovery.data.dataset import Bools, Dataset
from scm_world.discovery.learners.found import EstimatedGraph
from scm_world.errors import ModelError, UnknownOption

RIDGE = 1e-9  # of the variance: indistinguishable causes get wide intervals, not an error
EXACT = 1e-10  # variance of residuals, in that of the variable: below it, it is rounding
SPARE = 5  # rows that a regression needs beyond its terms
GAIN = 20.0  # twice the log likelihood that a change of the order has to bring
SMALLEST = 1e-300  # where probabilities are cut off, so that their logarithm is a number
SOME = 2000  # rows on which it is looked whether effects add up
CURVED = 1e-4  # how improbable it has to be that they do

Ints = NDArray[np.int64]


@typed
def do_order(data: Dataset, *, seed: int = 0, q: float = 0.01) -> EstimatedGraph:
    """Find a graph from rows with known targets: order by invariance, edges by regression.

    Args:
        data: Rows in which nothing is done, or some variables are set at random. Those in which a
            variable was set that is in no column are left out.
        seed: Not used: nothing is drawn.
        q: Expected share of false edges among those found, at most.

    Returns:
        A graph over the columns; ``edge_scores`` is -log10 of the probability under no edge. The
        numbers of a vector are tested together, as one cause.

    Raises:
        ModelError: Nothing was intervened on, and there are no earlier control steps.
        UnknownOption: A setting is not allowed.
    """
    del seed
    if not 0.0 < q < 1.0:
        raise UnknownOption("q", q, ("a share between 0 and 1",))
    from scipy.stats import false_discovery_control  # takes a third of a second

    hidden_targets = data.hidden_targets
    data = data.rows(~hidden_targets)
    rows = _rows(data)
    causes = rows.alive & (rows.targeted.any(axis=0) | rows.past)
    if not causes.any():
        reason = "no variable that varies is a target, and there are no earlier control steps"
        raise ModelError([f"do_order needs interventions: {reason}"])
    at = {name: i for i, name in enumerate(data.names)}
    earlier = [at.get(f"{name}@-1") for name in data.names]
    still = np.array(  # columns that equal their own value one control step before
        [
            then is not None and np.array_equal(data.values[:, now], data.values[:, then])
            for now, then in enumerate(earlier)
        ]
    )
    # Columns that were never set may act unseen on a cause and its effect, where a cause was free
    # in some row and no order of time says what acts on what. An outcome of an episode does not:
    # it comes after all that was set.
    set_ = rows.targeted.any(axis=0)
    early = np.array([column.how in ("value", "first") for column in data.columns])
    is_open = bool((rows.targeted[:, set_] < 1).any() and set_.any() and not rows.past.any())
    hidden = rows.alive & ~set_ & early & is_open
    if hidden.any():
        p_values = _instrumented(rows, causes)
    else:
        p_values = _tested(rows, ~still & ~rows.past, causes & ~still)
        if still.any():  # one row of each episode: the others say the same once more
            _, first = np.unique(data.episode, return_index=True)
            begins = _rows(data.rows(first))
            p_values[:, still] = _tested(begins, still, causes & still)[:, still]
    # Of two that were only ever set together, no row says which one acts on the other.
    separable = (rows.targeted.T.astype(np.float64) @ ~rows.targeted) > 0.0
    separable[rows.past] = True
    p_values[~np.array([separable[where].any(axis=0) for where in rows.blocks])] = 2.0
    tested = p_values <= 1.0
    chosen = np.zeros(p_values.shape, bool)
    chosen[tested] = false_discovery_control(p_values[tested], method="by") <= q
    weight = np.where(tested, -np.log10(np.clip(p_values, SMALLEST, 1.0)), 0.0)
    matrix, sure = chosen[rows.block_of], weight[rows.block_of]
    notes = [*_notes(data, rows, causes, separable, hidden), *_bent(rows, matrix)]
    if hidden_targets.any():
        count = f"{hidden_targets.sum()} of {len(hidden_targets)} rows were left out"
        notes.append(f"{count}: a variable that is in no column was set in them")
    return EstimatedGraph.of(
        data.names, matrix, edge_scores=sure, settings={"q": q}, notes=tuple(notes)
    )


@final
@dataclass(frozen=True)
class _Rows:
    """Standardised numbers, and from which rows each variable may be learned.

    Attributes:
        x: Shape (n, p): mean 0, variance 1; constant columns are 0.
        one: The constant, shape (n,): 1, or its value in summed rows.
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
        """Whether each column varies, shape (p,)."""
        return np.asarray(self.x.any(axis=0))

    @property
    def block_of(self) -> Ints:
        """The block of each column, shape (p,)."""
        numbers = np.repeat(np.arange(len(self.blocks)), list(map(len, self.blocks)))
        return np.asarray(numbers[np.argsort(np.concatenate(self.blocks))])

    def summed(self) -> _Rows:
        """Return fewer rows with the same sums of products, for each set of targets.

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


def _rows(data: Dataset) -> _Rows:
    n = len(data)
    if n < 3:
        raise ModelError([f"do_order needs some rows, got {n}"])
    together = tuple(data.blocks.values())
    past = np.array([column.lag > 0 for column in data.columns])
    return _Rows(data.standardised().values, np.ones(n), data.targeted, together, past)


# --- the order ------------------------------------------------------------------------------------


def _before(rows: _Rows, effects: Bools, causes: Bools) -> Bools:
    """Return which column may act on which, shape (p, p): causes that come before it."""
    may = np.zeros((len(causes), len(causes)), bool)
    always = causes & (rows.past | (rows.one**2 @ ~rows.targeted < causes.sum() + SPARE))
    left = np.flatnonzero(causes & effects & ~always).tolist()
    base = np.flatnonzero(always)
    may[np.ix_(np.flatnonzero(causes), np.flatnonzero(effects & ~causes))] = True
    orders = _Orders(rows, base)
    order: list[int] = []
    while left:
        order.insert(0, left.pop(orders.last(np.array(left)) if len(left) > 1 else 0))
    for place, column in enumerate(order := orders.improved(order)):
        may[base, column] = True
        may[order[:place], column] = True
    return may


class _Orders:
    """Which order of columns is likely, by sums of products over the rows where each was free.

    Source:
        The profile likelihood of linear Gaussian mechanisms under known interventions: Hauser and
        Bühlmann, *Characterization and greedy learning of interventional Markov equivalence
        classes*, JMLR 2012, section 5.
    """

    def __init__(self, rows: _Rows, base: Ints) -> None:
        self._rows, self._base = rows, base
        self._ones = np.concatenate([rows.x, rows.one[:, None]], axis=1)
        self._all = self._ones.T @ self._ones
        self._free: dict[int, Floats] = {}
        self._costs: dict[tuple[int, frozenset[int]], float] = {}

    def last(self, left: Ints) -> int:
        """Return which column left has the same mechanism whichever other one is set.

        Residuals are compared by twice the log likelihood ratio of two normal distributions, with
        and without an intervention on another column, against one.
        """
        d, x = np.arange(len(left)), self._rows.x[:, left]
        others = np.concatenate([left, self._base, [self._rows.x.shape[1]]])
        sums = np.stack([self._sums(int(j))[np.ix_(others, others)] for j in left])
        along = np.arange(len(others))
        sums[:, along, along] *= 1.0 + RIDGE
        inverse = np.linalg.inv(sums)
        diagonal = inverse[d, d, d]
        weights = -inverse[d, d, :] / diagonal[:, None]
        weights[d, d] = 0.0
        targeted = self._rows.targeted[:, left]
        count = self._rows.one**2 @ ~targeted
        spread = np.sqrt(np.maximum(1.0 / (diagonal * count), EXACT))
        rest = np.where(~targeted, x - self._ones[:, others] @ weights.T, 0.0) / spread
        one, given = ~targeted * self._rows.one[:, None], targeted.T.astype(np.float64)
        powers = one * one, one * rest, rest * rest
        (n1, n), (m1, m), (q1, q) = ((given @ power, power.sum(axis=0)) for power in powers)
        n0, m0, q0 = n - n1, m - m1, q - q1
        separable = (n1 > 1.5) & (n0 > 1.5)
        np.fill_diagonal(separable, False)

        def cost(count: Floats, first: Floats, second: Floats) -> Floats:
            safe = np.where(separable, count, 1.0)
            variance = np.maximum(second / safe - (first / safe) ** 2, EXACT)
            return np.asarray(count * np.log(variance))

        change = cost(n1 + n0, m1 + m0, q1 + q0) - cost(n1, m1, q1) - cost(n0, m0, q0)
        return int(np.argmin(np.where(separable, change, 0.0).max(axis=0)))

    def improved(self, order: list[int]) -> list[int]:
        """Carry columns up and down the order while that makes the rows much more probable."""
        better = True
        while better:
            better = False
            for column in tuple(order):
                best, most = order, GAIN
                for way in (-1, 1):
                    trial, at, gained = list(order), order.index(column), 0.0
                    while 0 <= at + way < len(order):
                        gained += self._gain(trial, min(at, at + way))
                        trial[at], trial[at + way] = trial[at + way], trial[at]
                        at += way
                        if gained > most:
                            best, most = list(trial), gained
                better, order = better or best != order, best
        return order

    def _gain(self, order: list[int], place: int) -> float:
        """Return the gain of exchanging a column with the next one."""
        before, first, second = order[:place], order[place], order[place + 1]
        now = self._cost(first, before) + self._cost(second, [*before, first])
        return now - self._cost(second, before) - self._cost(first, [*before, second])

    def _cost(self, column: int, before: list[int]) -> float:
        """Return the negative log likelihood of a column, given the columns before it."""
        key = column, frozenset(before)
        if key not in self._costs:
            sums = self._sums(column)
            constant = len(sums) - 1
            where = [*before, *self._base.tolist(), constant, column]
            part = sums[np.ix_(where, where)].copy()
            part[np.diag_indices_from(part)] *= 1.0 + RIDGE
            left = float(np.linalg.cholesky(part)[-1, -1]) ** 2  # squares that are not explained
            count = float(sums[constant, constant])
            self._costs[key] = count * math.log(max(left / count, EXACT))
        return self._costs[key]

    def _sums(self, column: int) -> Floats:
        """Return the sums where a column was free, shape (p + 1, p + 1); the last is of ones."""
        if column not in self._free:
            set_ = self._ones[self._rows.targeted[:, column]]
            self._free[column] = self._all - set_.T @ set_
        return self._free[column]


# --- edges ----------------------------------------------------------------------------------------


def _tested(rows: _Rows, effects: Bools, causes: Bools) -> Floats:
    """Test every block of causes on every column; 2 without a test, shape (blocks, p)."""
    rows = rows.summed()
    before = _before(rows, effects, causes)
    found = np.full((len(rows.blocks), rows.x.shape[1]), 2.0)
    for column in np.flatnonzero(before.any(axis=0) & rows.alive).tolist():
        wanted = np.flatnonzero(before[:, column])
        free = ~rows.targeted[:, column]
        design = np.concatenate([rows.x[free][:, wanted], rows.one[free, None]], axis=1)
        sums = design.T @ design
        sums[np.diag_indices_from(sums)] *= 1.0 + RIDGE
        sums[np.diag_indices_from(sums)] += SMALLEST
        poor = bool((np.sqrt(np.diag(sums)) < 1e-9 * math.sqrt(len(sums))).any())
        inverse = np.linalg.pinv(sums, hermitian=True) if poor else np.linalg.inv(sums)
        count, y = float(design[:, -1] @ design[:, -1]), rows.x[free, column]
        weights = inverse @ (design.T @ y)
        left = max(float(np.sum((y - design @ weights) ** 2)), EXACT * count)
        for b, block in enumerate(rows.blocks):
            where = np.flatnonzero(np.isin(wanted, block))
            if len(where):
                part = weights[where]
                explained = float(part @ np.linalg.pinv(inverse[np.ix_(where, where)]) @ part)
                rest = count - design.shape[1]
                found[b, column] = min(1.0, regression_tail(explained, left, len(where), rest))
    return found


def _instrumented(rows: _Rows, causes: Bools) -> Floats:
    """Test every block of causes with the values that were set as instruments, (blocks, p)."""
    from scipy.special import fdtrc

    found = np.full((len(rows.blocks), rows.x.shape[1]), 2.0)
    for column in np.flatnonzero(rows.alive).tolist():
        free = ~rows.targeted[:, column]
        used = causes & (rows.targeted[free].sum(axis=0) > 1)
        used[column] = False
        wanted = np.flatnonzero(used)
        design, given = rows.x[free][:, wanted], rows.targeted[free][:, wanted]
        alone = np.where(given, 0.0, design).sum(axis=0) / np.maximum((~given).sum(axis=0), 1)
        tools = np.where(given, design - alone, 0.0)  # what the design says about a cause
        one = np.ones((int(free.sum()), 1))
        design, tools = (np.hstack([part, one]) for part in (design, tools))
        rest = len(one) - design.shape[1]
        if not len(wanted) or rest < 1:
            continue
        inverse, y = np.linalg.pinv(tools.T @ design), rows.x[free, column]
        weights = inverse @ (tools.T @ y)
        scores = tools * (y - design @ weights)[:, None]
        variance = inverse @ (scores.T @ scores) @ inverse.T * (len(one) / rest)
        for b, block in enumerate(rows.blocks):
            mine = np.flatnonzero(np.isin(wanted, block))
            if len(mine):
                spread = variance[np.ix_(mine, mine)] + EXACT / len(one) * np.eye(len(mine))
                ratio = float(weights[mine] @ np.linalg.pinv(spread) @ weights[mine]) / len(mine)
                found[b, column] = min(1.0, float(fdtrc(len(mine), rest, ratio)))
    return found


def _bent(rows: _Rows, matrix: Bools) -> list[str]:
    """Note in how many effects the causes do not add up.

    Source:
        Ramsey, *Tests for specification errors in classical linear least-squares regression
        analysis*, JRSS B 1969: powers of the prediction explain nothing that is left.
    """
    n = len(rows.x)
    some = np.linspace(0, n - 1, min(n, SOME)).astype(np.int64)
    effects = np.flatnonzero(matrix.any(axis=0)).tolist()
    bent = 0
    for column in effects:
        free = some[~rows.targeted[some, column]]
        design, y = rows.x[free][:, matrix[:, column]], rows.x[free, column]
        known = np.concatenate([design, np.ones((len(free), 1))], axis=1)
        if len(free) < 2 * known.shape[1] + SPARE:
            continue
        predicted = known @ np.linalg.lstsq(known, y, rcond=None)[0]
        wide = np.concatenate([known, predicted[:, None] ** 2, predicted[:, None] ** 3], axis=1)
        before, after = (
            float(np.sum((y - part @ np.linalg.lstsq(part, y, rcond=None)[0]) ** 2))
            for part in (known, wide)
        )
        tail = regression_tail(before - after, after, 2, len(free) - wide.shape[1])
        bent += before > EXACT * len(free) and tail < CURVED / len(effects)
    if not bent:
        return []
    what = f"{bent} of {len(effects)} effects are not what their causes add up to"
    return [f"{what}: the share of false edges is not bounded by q"]


def _notes(data: Dataset, rows: _Rows, causes: Bools, separable: Bools, hidden: Bools) -> list[str]:
    found = []
    still = [name for name, varies in zip(data.names, rows.alive, strict=True) if not varies]
    if still:
        found.append(f"never varied, no edges: {', '.join(still)}")
    chosen = np.flatnonzero(causes & ~rows.past)
    block = rows.block_of[chosen]
    between = separable[np.ix_(chosen, chosen)] | (block[:, None] == block)
    if not between.all():
        together = ", ".join(data.names[i] for i in chosen[~between.all(axis=0)])
        found.append(
            f"always set where another one is, so some edges are not identified: {together}"
        )
    few = int((rows.alive & ((~rows.targeted).sum(axis=0) <= causes.sum() + 1)).sum())
    if few:
        found.append(f"{few} columns have too few rows for {int(causes.sum())} possible causes")
    never = int((rows.alive & ~causes & ~rows.past).sum())
    if hidden.any():
        found.append(
            f"{never} columns were never intervened on: edges are those of the latent projection, "
            "in which they have no effects"
        )
    elif never:
        found.append(f"{never} columns were never intervened on: they can be effects only")
    return found


def regression_tail(explained: float, left: float, m: int, free: float) -> float:
    """Return the probability that m terms of a regression explain so much by chance.

    Args:
        explained: Sum of squares that the terms explain.
        left: Sum of squares of the residuals, with these terms.
        m: How many terms.
        free: Residual degrees of freedom.

    Source:
        Bartlett, *Further aspects of the theory of multiple regression*, 1938, for one response.
    """
    if explained <= 0.0 or free <= 0.0:
        return 1.0
    from scipy.special import chdtrc

    statistic = (free + 0.5 * m - 1.0) * math.log1p(explained / max(left, SMALLEST))
    return float(chdtrc(m, statistic)) if statistic > 0.0 else 1.0
