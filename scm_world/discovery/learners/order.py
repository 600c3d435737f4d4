"""``do_order``: a causal graph from unpaired interventions with known targets.

First the order (see ``causal_order``), then the edges: each variable is regressed on those before
it, over the rows in which it was not intervened on itself. A cause is kept if it explains more
than chance would; over all tests the share of false edges is bounded, as long as effects are what
their causes add up to. Where they are not, a note says so.

Only what was intervened on somewhere can be found to be a cause: what was merely watched is an
effect, never a cause. Nor is it found to be a cause of what was set in all the same rows. Earlier
control steps are causes without that, because time has an order.

What stands still in an episode (a mass) is an effect only of what does so too, at once, and acts on
the rest one step later.

It assumes that effects add up (``features`` gives them curves) and that no unobserved variable acts
on two of those that were intervened on. Scales do not matter: standardised data give the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from scipy.special import chdtrc, ndtri
from scipy.stats import false_discovery_control, rankdata

from scm_world._types import Floats
from scm_world.discovery.data.dataset import Bools, Dataset
from scm_world.discovery.learners.causal_order import EXACT, RIDGE, SPARE, Ints, Rows, before_each
from scm_world.discovery.learners.found import Found
from scm_world.errors import ModelError, UnknownOption

POWERS = (1, 2, 3, 4)
SMALLEST = 1e-300  # where probabilities are cut off, so that their logarithm is a number
SOME = 2000  # rows on which it is looked whether effects add up
CURVED = 1e-4  # how improbable it has to be that they do


def do_order(
    data: Dataset,
    *,
    seed: int = 0,
    q: float = 0.01,
    features: int = 1,
    ranks: bool = False,
    spread: bool = False,
    blocks: bool = True,
) -> Found:
    """Find a graph from rows with known intervention targets.

    Args:
        data: Rows in which nothing is done, or some variables are set at random.
        seed: Not used: nothing is drawn.
        q: Expected share of false edges among those found, at most.
        features: Highest power in which a cause may act: 1 for straight lines.
        ranks: Whether effects are replaced by the normal scores of their ranks, so that outliers do
            not count; for edges, not for the order.
        spread: Whether a cause of the spread of a variable is looked for, too.
        blocks: Whether the numbers of a vector are tested together, as one cause.

    Returns:
        A graph over the columns; ``sureness`` is -log10 of the probability under no edge.

    Raises:
        ModelError: Nothing was intervened on, and there are no earlier control steps.
        UnknownOption: A setting is not allowed.
    """
    del seed
    if not 0.0 < q < 1.0:
        raise UnknownOption("q", q, ("a share between 0 and 1",))
    if not isinstance(features, int) or features not in POWERS:
        raise UnknownOption("features", features, map(str, POWERS))
    rows, still = _rows(data, blocks), _still(data)
    causes = rows.alive & (rows.targeted.any(axis=0) | rows.past)
    if not causes.any():
        raise ModelError(
            [
                "do_order needs interventions: no variable that varies is a target, and there are "
                "no earlier control steps"
            ]
        )
    form = _Form(features, ranks, spread)
    p_values = _tested(rows, ~still & ~rows.past, causes & ~still, form)
    if still.any():  # one row of each episode: the others say the same once more
        _, first = np.unique(data.episode, return_index=True)
        begins = _rows(data.rows(first), blocks)
        p_values[:, still] = _tested(begins, still, causes & still, form)[:, still]
    told = _told(rows)
    p_values[~np.array([told[where].any(axis=0) for where in rows.blocks])] = 2.0
    tested = p_values <= 1.0
    chosen = np.zeros(p_values.shape, bool)
    chosen[tested] = false_discovery_control(p_values[tested], method="by") <= q
    weight = np.where(tested, -np.log10(np.clip(p_values, SMALLEST, 1.0)), 0.0)
    matrix, sure = _columns(rows, chosen), _columns(rows, weight)
    notes = (*_notes(data, rows, causes, told), *_bent(rows, matrix, form))
    settings = {"q": q, "features": features, "ranks": ranks, "spread": spread, "blocks": blocks}
    return Found.of(data.names, matrix, sureness=sure, settings=settings, notes=notes)


@final
@dataclass(frozen=True)
class _Form:
    """In which form causes may act; see ``do_order``."""

    features: int
    ranks: bool
    spread: bool

    @property
    def is_straight(self) -> bool:
        return self.features == 1 and not self.ranks and not self.spread


def _rows(data: Dataset, blocks: bool) -> Rows:
    n = len(data)
    if n < 3:
        raise ModelError([f"do_order needs some rows, got {n}"])
    together = tuple(data.blocks.values()) if blocks else tuple(np.arange(len(data.names))[:, None])
    past = np.array([column.lag > 0 for column in data.columns])
    values = data.standardised().values
    return Rows(values, np.ones(n), data.targeted, together, past)


def _still(data: Dataset) -> Bools:
    """Tell which columns are the same as their own value one control step before."""
    at = {name: i for i, name in enumerate(data.names)}
    earlier = [at.get(f"{name}@-1") for name in data.names]
    return np.array(
        [
            then is not None and np.array_equal(data.values[:, now], data.values[:, then])
            for now, then in enumerate(earlier)
        ]
    )


# --- edges --------------------------------------------------------------------------------------


def _tested(rows: Rows, effects: Bools, causes: Bools, form: _Form) -> Floats:
    """Test every block of causes on every column; 2 where there is no test, shape (blocks, p)."""
    summed = rows.summed()
    before = before_each(summed, effects, causes)
    rows, features = summed if form.is_straight else rows, form.features
    ranks, spread = form.ranks, form.spread
    terms, owner = _features(rows, features)
    found = np.full((len(rows.blocks), rows.x.shape[1]), 2.0)
    for column in np.flatnonzero(before.any(axis=0) & rows.alive).tolist():
        used = before[:, column]
        wanted = np.flatnonzero(used[owner])
        free = ~rows.targeted[:, column]
        answers = _answers(rows.x[free, column], ranks, spread)
        design = np.concatenate([terms[free][:, wanted], rows.one[free, None]], axis=1)
        blocks = {
            b: np.flatnonzero(np.isin(owner[wanted], where)) for b, where in enumerate(rows.blocks)
        }
        for b, p in _tails(design, answers, blocks).items():
            found[b, column] = p
    return found


def _features(rows: Rows, highest: int) -> tuple[Floats, Ints]:
    """Write powers of the columns, as orthogonal polynomials, and which column each is of."""
    size = np.maximum(np.abs(rows.x).max(axis=0), 1e-12)
    scaled = rows.x / size
    powers = [
        np.polynomial.legendre.legval(scaled, [0.0] * d + [1.0]) for d in range(2, highest + 1)
    ]
    p = rows.x.shape[1]
    terms = np.concatenate([rows.x, *(part - part.mean(axis=0) for part in powers)], axis=1)
    return terms, np.tile(np.arange(p), highest)


def _answers(y: Floats, ranks: bool, spread: bool) -> list[Floats]:
    """Write what is to be explained: the column, and how far off its middle it is."""
    scores = normal_scores(y) if ranks else y
    if not spread:
        return [scores]
    # A function of the column alone: residuals would carry the causes that are tested.
    far = (normal_scores(y) if not ranks else scores) ** 2
    return [scores, far - far.mean()]


def _tails(design: Floats, answers: list[Floats], blocks: dict[int, Ints]) -> dict[int, float]:
    """Compute how probable each block's share of the explanation is by chance."""
    sums = design.T @ design
    sums[np.diag_indices_from(sums)] *= 1.0 + RIDGE
    sums[np.diag_indices_from(sums)] += SMALLEST
    inverse = np.linalg.pinv(sums, hermitian=True) if _is_poor(sums) else np.linalg.inv(sums)
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


def _bent(rows: Rows, matrix: Bools, form: _Form) -> tuple[str, ...]:
    """Tell how many effects are not what their causes add up to.

    Source:
        Ramsey, *Tests for specification errors in classical linear least-squares regression
        analysis*, JRSS B 1969: powers of what is foretold explain nothing that is left.
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
        foretold = known @ np.linalg.lstsq(known, y, rcond=None)[0]
        wide = np.concatenate([known, foretold[:, None] ** 2, foretold[:, None] ** 3], axis=1)
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


def _is_poor(sums: Floats) -> bool:
    """Tell whether a matrix is too near to a singular one to be inverted."""
    scale = np.sqrt(np.diag(sums))
    return bool((scale < 1e-9 * math.sqrt(len(sums))).any())


def _columns(rows: Rows, by_block: Any) -> Any:
    """Give every column of a block what was found for the block."""
    p = rows.x.shape[1]
    made = np.zeros((p, p), by_block.dtype)
    for b, where in enumerate(rows.blocks):
        made[where] = by_block[b]
    return made


def _told(rows: Rows) -> Bools:
    """Say where a column was set while another was free, shape (p, p).

    Of two that were only ever set together, no row tells which one acts on the other.
    """
    told = (rows.targeted.T.astype(np.float64) @ ~rows.targeted) > 0.0
    told[rows.past] = True
    return np.asarray(told)


def _notes(data: Dataset, rows: Rows, causes: Bools, told: Bools) -> tuple[str, ...]:
    found = []
    still = [name for name, lives in zip(data.names, rows.alive, strict=True) if not lives]
    if still:
        found.append(f"never varied, no edges: {', '.join(still)}")
    chosen = np.flatnonzero(causes & ~rows.past)
    block = np.zeros(len(causes))
    for number, where in enumerate(rows.blocks):
        block[where] = number
    between = told[np.ix_(chosen, chosen)] | (block[chosen, None] == block[chosen])
    if not between.all():
        together = ", ".join(data.names[i] for i in chosen[~between.all(axis=0)])
        found.append(f"always set where another one is, so some edges are not told: {together}")
    few = int((rows.alive & ((~rows.targeted).sum(axis=0) <= causes.sum() + 1)).sum())
    if few:
        found.append(f"{few} columns have too few rows for {int(causes.sum())} possible causes")
    watched = int((rows.alive & ~causes & ~rows.past).sum())
    if watched:
        found.append(f"{watched} columns were never intervened on: they can be effects only")
    return tuple(found)


def regression_tail(explained: float, left: float, m: int, free: float) -> float:
    """Return the probability that some terms of a regression explain so much by chance.

    Args:
        explained: Sum of squares that m terms explain.
        left: Sum of squares of the residuals, with these terms.
        m: How many terms.
        free: Residual degrees of freedom.

    Source:
        Bartlett, *Further aspects of the theory of multiple regression*, 1938, for one response.

    Example:
        >>> round(regression_tail(4.0, 30.0, 1, 30.0), 3)  # t = 2 with 30 degrees of freedom
        0.055
    """
    if explained <= 0.0 or free <= 0.0:
        return 1.0
    statistic = (free + 0.5 * m - 1.0) * math.log1p(explained / max(left, SMALLEST))
    return float(chdtrc(m, statistic)) if statistic > 0.0 else 1.0


def normal_scores(values: Floats) -> Floats:
    """Return the normal quantiles of the ranks of numbers, shape (n,); equal ones share a rank.

    Source:
        Blom, *Statistical Estimates and Transformed Beta-Variables*, 1958, for the ranks.

    Example:
        >>> [round(float(x), 2) for x in normal_scores(np.array([3.0, 100.0, 1.0]))]
        [0.0, 0.87, -0.87]
    """
    return np.asarray(ndtri((rankdata(values) - 0.375) / (len(values) + 0.25)))
