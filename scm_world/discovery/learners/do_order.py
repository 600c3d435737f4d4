"""``do_order``: a causal graph from unpaired interventions with known targets.

First the order. In a set of variables that holds all its ancestors, a variable without effects in
the set follows from the others by its own mechanism, whichever of *them* is intervened on. One with
an effect does not: regressed on all others, its effect among them, its residuals change as soon as
the effect is set. So the variable whose residuals change least between rows with and without an
intervention is taken for the last one, and put aside; and so on. What few rows got wrong is mended
by the likelihood of the orders around.

Then the edges: each variable is regressed on those before it, over the rows in which it was not
intervened on itself. A cause is kept if it explains more than chance would; over all tests the
share of false edges is bounded, as long as effects are what their causes add up to. Where they are
not, a note says so.

Only what was intervened on somewhere can be found to be a cause, and not of what was set in all the
same rows. Earlier control steps are causes without that, because time has an order. A variable
that is constant in an episode (a mass) is an effect only of other constants, at lag 0, and acts on
all other variables at lag 1.

Columns that vary but were never set may act on others, too, and so on a cause and its effect at
once. Where there are such columns, there is no order to be found: an effect of a cause is then what
follows the values to which the cause was set, with these values as instruments. The graph is the
latent projection: an edge between two variables may pass through columns that were never set, and
these have no effects in it.

It assumes that effects add up (``features`` gives them curves) and that variables that are no
columns act on no two of those that were intervened on, unless there are columns that were never
set. Scales do not matter: standardised data give the same.

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

Ints = NDArray[np.int64]


@final
@dataclass(frozen=True)
class SampledRows:
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
        """Whether each column varies, shape (p,)."""
        return np.asarray(self.x.any(axis=0))

    @property
    def block_of(self) -> Ints:
        """The block of each column, shape (p,)."""
        numbers = np.repeat(np.arange(len(self.blocks)), list(map(len, self.blocks)))
        return np.asarray(numbers[np.argsort(np.concatenate(self.blocks))])

    def summed(self) -> SampledRows:
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


def before_each(rows: SampledRows, effects: Bools, causes: Bools) -> Bools:
    """Return which column may act on which, shape (p, p): causes that come before it."""
    may = np.zeros((len(causes), len(causes)), bool)
    always = causes & (rows.past | (rows.one**2 @ ~rows.targeted < causes.sum() + SPARE))
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
    """Negative log likelihood of the rows of a column, given the columns before it.

    Source:
        The profile likelihood of linear Gaussian mechanisms under known interventions: Hauser and
        Bühlmann, *Characterization and greedy learning of interventional Markov equivalence
        classes*, JMLR 2012, section 5.
    """

    def __init__(self, moments: _Moments, base: Ints) -> None:
        self._moments, self._base = moments, base.tolist()
        self._known: dict[tuple[int, frozenset[int]], float] = {}

    def of_swap(self, order: list[int], place: int) -> float:
        """Return what is gained by exchanging a column with the next one."""
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


class _Moments:
    """Sums of products over the rows in which a column was not intervened on."""

    def __init__(self, rows: SampledRows) -> None:
        self.x, self.one, self.targeted = rows.x, rows.one, rows.targeted
        self.ones = np.concatenate([rows.x, rows.one[:, None]], axis=1)
        self._all = self.ones.T @ self.ones
        self._of: dict[int, Floats] = {}

    def of(self, column: int) -> Floats:
        """Return the sums for one column, shape (p + 1, p + 1); the last one is of ones."""
        if column not in self._of:
            set_ = self.ones[self.targeted[:, column]]
            self._of[column] = self._all - set_.T @ set_
        return self._of[column]

    def precisions(self, base: Ints, left: Ints) -> Floats:
        """Return the inverse sums of some columns, a matrix for each of those left."""
        where = np.concatenate([left, base, [self.x.shape[1]]])
        sums = np.stack([self.of(int(j))[np.ix_(where, where)] for j in left])
        sums[:, np.arange(len(where)), np.arange(len(where))] *= 1.0 + RIDGE
        return np.asarray(np.linalg.inv(sums))


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
    others = np.concatenate([left, base, [moments.x.shape[1]]])
    rest = moments.x[:, left] - moments.ones[:, others] @ weights.T
    rest = np.where(free, rest, 0.0) / spread
    ratio = _changes(rest, free * moments.one[:, None], moments.targeted[:, left])
    return int(np.argmin(ratio.max(axis=0)))


def _changes(rest: Floats, one: Floats, targeted: Bools) -> Floats:
    """Return how residuals change when a column is intervened on, shape (k, k).

    That is twice the log likelihood ratio of two normal distributions against one, of the residuals
    of column j with and without an intervention on column i. ``rest`` and ``one`` are residuals and
    the constant, 0 where a column was not free, shape (n, k).
    """
    given = targeted.T.astype(np.float64)
    sums = [(given @ power, power.sum(axis=0)) for power in (one * one, one * rest, rest * rest)]
    (n1, n), (m1, m), (q1, q) = sums
    n0, m0, q0 = n - n1, m - m1, q - q1
    separable = (n1 > 1.5) & (n0 > 1.5)
    np.fill_diagonal(separable, False)

    def cost(count: Floats, first: Floats, second: Floats) -> Floats:
        safe = np.where(separable, count, 1.0)
        variance = np.maximum(second / safe - (first / safe) ** 2, EXACT)
        return np.asarray(count * np.log(variance))

    whole = cost(n1 + n0, m1 + m0, q1 + q0)
    return np.where(separable, whole - cost(n1, m1, q1) - cost(n0, m0, q0), 0.0)


POWERS = (1, 2, 3, 4)
SMALLEST = 1e-300  # where probabilities are cut off, so that their logarithm is a number
SOME = 2000  # rows on which it is looked whether effects add up
CURVED = 1e-4  # how improbable it has to be that they do


@typed
def do_order(
    data: Dataset,
    *,
    seed: int = 0,
    q: float = 0.01,
    features: int = 1,
    ranks: bool = False,
    spread: bool = False,
    blocks: bool = True,
) -> EstimatedGraph:
    """Find a graph from rows with known intervention targets.

    Args:
        data: Rows in which nothing is done, or some variables are set at random. Those in which a
            variable was set that is in no column are left out.
        seed: Not used: nothing is drawn.
        q: Expected share of false edges among those found, at most; not with ``ranks``.
        features: Highest power in which a cause may act: 1 for straight lines.
        ranks: Whether effects are replaced by the normal scores of their ranks, so that outliers do
            not count; for edges, not for the order.
        spread: Whether a cause of the spread of a variable is looked for, too.
        blocks: Whether the numbers of a vector are tested together, as one cause.

    Returns:
        A graph over the columns; ``edge_scores`` is -log10 of the probability under no edge.

    Raises:
        ModelError: Nothing was intervened on, and there are no earlier control steps.
        UnknownOption: A setting is not allowed.
    """
    del seed
    if not 0.0 < q < 1.0:
        raise UnknownOption("q", q, ("a share between 0 and 1",))
    if not isinstance(features, int) or features not in POWERS:
        raise UnknownOption("features", features, map(str, POWERS))
    hidden_targets = data.hidden_targets
    data = data.rows(~hidden_targets)
    rows, still = _rows(data, blocks), _still(data)
    hidden = _hidden(rows, data)
    causes = rows.alive & (rows.targeted.any(axis=0) | rows.past)
    if not causes.any():
        raise ModelError(
            [
                "do_order needs interventions: no variable that varies is a target, and there are "
                "no earlier control steps"
            ]
        )
    from scipy.stats import false_discovery_control  # takes a third of a second

    form = _Form(features, ranks, spread)
    if hidden.any():
        p_values = _instrumented(rows, causes, form)
    else:
        p_values = _tested(rows, ~still & ~rows.past, causes & ~still, form)
    if (
        still.any() and not hidden.any()
    ):  # one row of each episode: the others say the same once more
        _, first = np.unique(data.episode, return_index=True)
        begins = _rows(data.rows(first), blocks)
        p_values[:, still] = _tested(begins, still, causes & still, form)[:, still]
    separable = _separable(rows)
    p_values[~np.array([separable[where].any(axis=0) for where in rows.blocks])] = 2.0
    tested = p_values <= 1.0
    chosen = np.zeros(p_values.shape, bool)
    chosen[tested] = false_discovery_control(p_values[tested], method="by") <= q
    weight = np.where(tested, -np.log10(np.clip(p_values, SMALLEST, 1.0)), 0.0)
    matrix, sure = chosen[rows.block_of], weight[rows.block_of]
    notes = (*_notes(data, rows, causes, separable, hidden), *_bent(rows, matrix, form))
    if hidden_targets.any():
        count = f"{hidden_targets.sum()} of {len(hidden_targets)} rows were left out"
        notes = (*notes, f"{count}: a variable that is in no column was set in them")
    if ranks:
        notes = (*notes, "of ranks: the share of false edges is not bounded by q")
    settings = {"q": q, "features": features, "ranks": ranks, "spread": spread, "blocks": blocks}
    return EstimatedGraph.of(data.names, matrix, edge_scores=sure, settings=settings, notes=notes)


@final
@dataclass(frozen=True)
class _Form:
    """In which form causes may act; see ``do_order``."""

    features: int
    ranks: bool
    spread: bool


def _rows(data: Dataset, blocks: bool) -> SampledRows:
    n = len(data)
    if n < 3:
        raise ModelError([f"do_order needs some rows, got {n}"])
    together = tuple(data.blocks.values()) if blocks else tuple(np.arange(len(data.names))[:, None])
    past = np.array([column.lag > 0 for column in data.columns])
    values = data.standardised().values
    return SampledRows(values, np.ones(n), data.targeted, together, past)


def _still(data: Dataset) -> Bools:
    """Return which columns equal their own value one control step before."""
    at = {name: i for i, name in enumerate(data.names)}
    earlier = [at.get(f"{name}@-1") for name in data.names]
    return np.array(
        [
            then is not None and np.array_equal(data.values[:, now], data.values[:, then])
            for now, then in enumerate(earlier)
        ]
    )


# --- edges --------------------------------------------------------------------------------------


def _tested(rows: SampledRows, effects: Bools, causes: Bools, form: _Form) -> Floats:
    """Test every block of causes on every column; 2 where there is no test, shape (blocks, p)."""
    summed = rows.summed()
    before = before_each(summed, effects, causes)
    straight = form.features == 1 and not form.ranks and not form.spread
    rows = summed if straight else rows
    terms, owner = _features(rows, form.features)
    found = np.full((len(rows.blocks), rows.x.shape[1]), 2.0)
    for column in np.flatnonzero(before.any(axis=0) & rows.alive).tolist():
        used = before[:, column]
        wanted = np.flatnonzero(used[owner])
        free = ~rows.targeted[:, column]
        answers = _answers(rows.x[free, column], form.ranks, form.spread)
        design = np.concatenate([terms[free][:, wanted], rows.one[free, None]], axis=1)
        blocks = {
            b: np.flatnonzero(np.isin(owner[wanted], where)) for b, where in enumerate(rows.blocks)
        }
        for b, p in _tails(design, answers, blocks).items():
            found[b, column] = p
    return found


def _hidden(rows: SampledRows, data: Dataset) -> Bools:
    """Return which columns may act unseen on a cause and its effect, shape (p,).

    These are the columns that were never set, where a cause was free in some row and there are no
    earlier control steps, whose order says what acts on what. An outcome of an episode is none: it
    comes after all that was set.
    """
    set_ = rows.targeted.any(axis=0)
    free = bool((rows.targeted[:, set_] < 1).any())
    early = np.array([column.how in ("value", "first") for column in data.columns])
    is_open = free and bool(set_.any()) and not rows.past.any()
    return np.asarray(rows.alive & ~set_ & early & is_open)


def _instrumented(rows: SampledRows, causes: Bools, form: _Form) -> Floats:
    """Test every block of causes with the values that were set as instruments, (blocks, p)."""
    terms, owner = _features(rows, form.features)
    found = np.full((len(rows.blocks), rows.x.shape[1]), 2.0)
    for column in np.flatnonzero(rows.alive).tolist():
        free = ~rows.targeted[:, column]
        used = causes & (rows.targeted[free].sum(axis=0) > 1)
        used[column] = False
        wanted = np.flatnonzero(used[owner])
        design, given = terms[free][:, wanted], rows.targeted[free][:, owner[wanted]]
        alone = np.where(given, 0.0, design).sum(axis=0) / np.maximum((~given).sum(axis=0), 1)
        tools = np.where(given, design - alone, 0.0)  # what the design says about a cause
        most = np.where(given, design, -np.inf).max(axis=0, initial=-np.inf)
        least = np.where(given, design, np.inf).min(axis=0, initial=np.inf)
        keep = (most - least > 1e-9) | (wanted < rows.x.shape[1])  # powers of one value say nothing
        one = np.ones((int(free.sum()), 1))
        design, tools = (np.hstack([part[:, keep], one]) for part in (design, tools))
        wanted, rest = wanted[keep], len(one) - design.shape[1]
        if not len(wanted) or rest < 1:
            continue
        inverse = np.linalg.pinv(tools.T @ design)
        answers = _answers(rows.x[free, column], form.ranks, form.spread)
        for y in answers:
            weights = inverse @ (tools.T @ y)
            scores = tools * (y - design @ weights)[:, None]
            variance = inverse @ (scores.T @ scores) @ inverse.T * (len(one) / rest)
            for b, where in enumerate(rows.blocks):
                mine = np.flatnonzero(np.isin(owner[wanted], where))
                if not len(mine):
                    continue
                spread = variance[np.ix_(mine, mine)] + EXACT / len(one) * np.eye(len(mine))
                ratio = float(weights[mine] @ np.linalg.pinv(spread) @ weights[mine]) / len(mine)
                p = len(answers) * _f_tail(ratio, len(mine), rest)
                found[b, column] = min(found[b, column], 1.0, p)
    return found


def _f_tail(ratio: float, m: int, free: int) -> float:
    """Return the probability of a larger F ratio."""
    from scipy.special import fdtrc

    return float(fdtrc(m, free, ratio))


def _features(rows: SampledRows, highest: int) -> tuple[Floats, Ints]:
    """Return powers of the columns, as orthogonal polynomials, and the column each is of."""
    size = np.maximum(np.abs(rows.x).max(axis=0), 1e-12)
    scaled = rows.x / size
    powers = [
        np.polynomial.legendre.legval(scaled, [0.0] * d + [1.0]) for d in range(2, highest + 1)
    ]
    p = rows.x.shape[1]
    terms = np.concatenate([rows.x, *(part - part.mean(axis=0) for part in powers)], axis=1)
    return terms, np.tile(np.arange(p), highest)


def _answers(y: Floats, ranks: bool, spread: bool) -> list[Floats]:
    """Return what is to be explained: the column, and how far off its middle it is."""
    scores = normal_scores(y) if ranks else y
    if not spread:
        return [scores]
    # A function of the column alone: residuals would carry the causes that are tested.
    far = (normal_scores(y) if not ranks else scores) ** 2
    return [scores, far - far.mean()]


def _tails(design: Floats, answers: list[Floats], blocks: dict[int, Ints]) -> dict[int, float]:
    """Return how probable each block's share of the explanation is by chance."""
    sums = design.T @ design
    sums[np.diag_indices_from(sums)] *= 1.0 + RIDGE
    sums[np.diag_indices_from(sums)] += SMALLEST
    poor = bool((np.sqrt(np.diag(sums)) < 1e-9 * math.sqrt(len(sums))).any())
    inverse = np.linalg.pinv(sums, hermitian=True) if poor else np.linalg.inv(sums)
    count = float(design[:, -1] @ design[:, -1])
    free = count - design.shape[1]
    found = {b: 1.0 for b, where in blocks.items() if len(where)}
    for y in answers:
        weights = inverse @ (design.T @ y)
        left = max(float(np.sum((y - design @ weights) ** 2)), EXACT * count)
        for b in found:
            where = blocks[b]
            part = weights[where]
            explained = float(part @ np.linalg.pinv(inverse[np.ix_(where, where)]) @ part)
            p = regression_tail(explained, left, len(where), free)
            found[b] = min(found[b], len(answers) * p)
    return found


def _bent(rows: SampledRows, matrix: Bools, form: _Form) -> tuple[str, ...]:
    """Note how many effects are not what their causes add up to.

    Source:
        Ramsey, *Tests for specification errors in classical linear least-squares regression
        analysis*, JRSS B 1969: powers of what is predicted explain nothing that is left.
    """
    terms, owner = _features(rows, form.features)
    some = np.linspace(0, len(terms) - 1, min(len(terms), SOME)).astype(np.int64)
    effects = np.flatnonzero(matrix.any(axis=0)).tolist()
    bent = 0
    for column in effects:
        free = some[~rows.targeted[some, column]]
        design = terms[free][:, matrix[owner, column]]
        y = _answers(rows.x[free, column], form.ranks, spread=False)[0]
        known = np.concatenate([design, np.ones((len(free), 1))], axis=1)
        if len(free) < 2 * known.shape[1] + SPARE:
            continue
        predicted = known @ np.linalg.lstsq(known, y, rcond=None)[0]
        wide = np.concatenate([known, predicted[:, None] ** 2, predicted[:, None] ** 3], axis=1)
        before, after = (
            float(np.sum((y - part @ np.linalg.lstsq(part, y, rcond=None)[0]) ** 2))
            for part in (known, wide)
        )
        rest = len(free) - wide.shape[1]
        exact = before <= EXACT * len(free)
        bent += not exact and regression_tail(before - after, after, 2, rest) < CURVED / len(
            effects
        )
    if not bent:
        return ()
    return (
        f"{bent} of {len(effects)} effects are not what their causes add up to: the share of false "
        "edges is not bounded by q",
    )


def _separable(rows: SampledRows) -> Bools:
    """Return where a column was set while another was free, shape (p, p).

    Of two that were only ever set together, no row says which one acts on the other.
    """
    separable = (rows.targeted.T.astype(np.float64) @ ~rows.targeted) > 0.0
    separable[rows.past] = True
    return np.asarray(separable)


def _notes(
    data: Dataset, rows: SampledRows, causes: Bools, separable: Bools, hidden: Bools
) -> tuple[str, ...]:
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
    return tuple(found)


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


def normal_scores(values: Floats) -> Floats:
    """Return the normal quantiles of the ranks of numbers, shape (n,); equal ones share a rank.

    Source:
        Blom, *Statistical Estimates and Transformed Beta-Variables*, 1958, for the ranks.
    """
    from scipy.special import ndtri
    from scipy.stats import rankdata

    return np.asarray(ndtri((rankdata(values) - 0.375) / (len(values) + 0.25)))
