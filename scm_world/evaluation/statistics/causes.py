"""Which cause broke the agent: the effect of each varied variable on the score.

A protocol draws its variables at random, each on its own. So nothing but the variable itself can
make the score depend on it, and variables associated with the score in the very episodes of the
evaluation is an effect (Fisher, *The Design of Experiments*, 1935). Where variables depend on one
another in the episodes at hand, because draws were refused or the user drew them together, this
does not hold: such pairs are found and listed. Variables that act in combination only, each without
an effect on average over the others, are not found.

A column's values are parted into pieces, with a line in each of them; its share is R² of that
regression: the first-order Sobol index, or correlation ratio, of the column. The share of several
columns is what the sum of such functions explains. Both are corrected for what so many coefficients
explain by chance.

Source:
    Sobol, *Sensitivity estimates for nonlinear mathematical models*, 1993; Kelley, *An unbiased
    correlation ratio measure*, Proceedings of the National Academy of Sciences 21, 1935.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import final

import numpy as np

from scm_world._arguments import real_number, typed, whole_number
from scm_world._types import ArrayLike, Floats, Value
from scm_world.errors import UnknownOption
from scm_world.evaluation.statistics.intervals import (
    LEVEL,
    Interval,
    normal_quantile,
    numbers,
    unpaired_interval,
)

PERMUTATIONS = 1000
FEWEST = 12
"""Fewer episodes than these say nothing about a column."""
PIECES = 5
DEPENDENT = 0.01
"""Below this corrected p-value two variables count as dependent."""


@final
@dataclass(frozen=True)
class ColumnEffect:
    """The effect of one component of a variable on the score.

    Attributes:
        name: Such as ``"tool_block.cylindrical_position[0]"``; the variable's own name if it has
            one component.
        contrast: Mean score in the upper third of the drawn values minus that in the lower third;
            of a column with few values, of the highest minus the lowest ones.
        lower: Largest value of the lower third, in the unit of the variable.
        upper: Smallest value of the upper third. The interval of the contrast takes both as given.
        share: Share of the score's variance that this column alone explains, in [0, 1].
        p: Probability of such a share if the column had no effect, by permutation.
        n: Episodes that varied it.
    """

    name: str
    contrast: Interval
    lower: float
    upper: float
    share: Interval
    p: float
    n: int

    @property
    def direction(self) -> str:
        """``"up"`` or ``"down"``, as the score goes with the value, or ``"unclear"``.

        It is also unclear if the score first rises and then falls, for any share.
        """
        if not self.contrast.excludes(0.0):
            return "unclear"
        return "up" if self.contrast.value > 0.0 else "down"


@final
@dataclass(frozen=True)
class Cause:
    """The effect of one varied variable on the score.

    Attributes:
        variable: Its name.
        share: Share of the score's variance that its columns explain together, each by itself,
            without what only a combination of two of them does.
        p: Probability of such a share if the variable had no effect, by permutation.
        p_holm: The same, corrected for the number of variables.
        n: Episodes that varied it.
        columns: Its components.
    """

    variable: str
    share: Interval
    p: float
    p_holm: float
    n: int
    columns: tuple[ColumnEffect, ...]

    @property
    def column(self) -> ColumnEffect:
        """The component that explains most."""
        return max(self.columns, key=lambda column: column.share.value)


@final
@dataclass(frozen=True)
class Causes:
    """The effects of all varied variables on the score.

    Attributes:
        causes: In the order in which the variables were given.
        left_out: Why the data say nothing about a column or variable, by its name.
        dependent: Pairs of variables that were not drawn independently, with the probability of
            such a dependence in independent data, corrected for all pairs.
        verdicts: Whether the agent infers each variable, of ``Inferred.verdicts``, if known.
    """

    causes: tuple[Cause, ...]
    left_out: Mapping[str, str]
    dependent: Mapping[tuple[str, str], float] = field(default_factory=dict)
    verdicts: Mapping[str, str] = field(default_factory=dict)

    def ranked(self) -> tuple[Cause, ...]:
        """Return the variables, the one that explains most of the score first."""
        return tuple(sorted(self.causes, key=lambda cause: (-cause.share.value, cause.p)))

    def found(self, alpha: float = 0.05) -> tuple[Cause, ...]:
        """Return the variables that do have an effect at level ``alpha``, strongest first."""
        level = real_number("alpha", alpha, least=0.0, most=1.0)
        return tuple(cause for cause in self.ranked() if cause.p_holm <= level)

    def __str__(self) -> str:
        head = ["variable", "share of variance", "p (Holm)", "upper - lower third", "of column"]
        head += ["inferred by the agent"] if self.verdicts else []
        rows = [
            (
                cause.variable,
                str(cause.share),
                f"{cause.p_holm:.3f}",
                str(cause.column.contrast),
                cause.column.name,
                *((self.verdicts.get(cause.variable, "not probed"),) if self.verdicts else ()),
            )
            for cause in self.ranked()
        ]
        lines = aligned(head, rows) if rows else []
        lines += missing(self.verdicts, [cause.variable for cause in self.found()])
        lines += [f"{name}: left out, {reason}" for name, reason in self.left_out.items()]
        lines += [
            f"{one} and {other} depend on one another (p = {p:.2g}): their shares of the "
            "variance cannot be separated"
            for (one, other), p in self.dependent.items()
        ]
        return "\n".join(lines)


def aligned(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in (head, *rows)]


def missing(verdicts: Mapping[str, str], names: Sequence[str]) -> list[str]:
    """Return a line for each of the causes that decide a score and are not inferred."""
    wanting = [name for name in names if verdicts.get(name, "inferred") != "inferred"]
    return [f"{one} matters, and the agent does not infer it ({verdicts[one]})" for one in wanting]


@typed
def find_causes(
    drawn: Mapping[str, ArrayLike],
    scores: ArrayLike,
    *,
    level: float = LEVEL,
    permutations: int = PERMUTATIONS,
    seed: int = 0,
    proportion: bool | None = None,
) -> Causes:
    """Estimate the effect of each varied variable on the score.

    Args:
        drawn: Values of each varied variable, shape ``(n,)`` or ``(n, columns)``. They must have
            been drawn at random, each variable on its own. A row with NaN is an episode that did
            not vary the variable; it is left out for this variable, or column, alone.
        scores: One per episode, shape ``(n,)``.
        level: Confidence of the intervals.
        permutations: Number of permutations of a test.
        seed: Seed of the tests. The result for one variable does not depend on which others there
            are, except for Holm's correction.
        proportion: Whether scores are failures and successes; as for ``mean_interval``.

    Returns:
        An effect for each variable. Columns that never change and columns that too few episodes
        varied are in ``left_out``, variables that depend on one another in ``dependent``.

    Raises:
        UnknownOption: No scores; values of another shape, or not real numbers; or a level or
            permutations out of range.
    """
    given = numbers("scores", scores)
    normal_quantile(level)
    permutations = whole_number("permutations", permutations, least=1)
    left_out: dict[str, str] = {}
    found: list[Cause] = []
    tables: dict[str, Floats] = {}
    for variable, values in drawn.items():
        names, table = _table(variable, values, given.size)
        left_out |= {
            name: reason
            for name, column in zip(names, table.T, strict=True)
            if (reason := useless(column))
        }
        kept = [k for k, name in enumerate(names) if name not in left_out]
        table = table[:, kept]
        if kept:
            tables[variable] = table
        columns = []
        for name, column in zip((names[k] for k in kept), table.T, strict=True):
            rows = ~np.isnan(column)
            one, scored = column[rows], given[rows]
            lower, upper = _thirds(one)
            contrast = unpaired_interval(
                scored[one >= upper], scored[one <= lower], level=level, proportion=proportion
            )
            share, p = _share([one], scored, level, permutations, seed)
            columns.append(ColumnEffect(name, contrast, lower, upper, share, p, scored.size))
        if len(columns) == 1:
            only = columns[0]
            found.append(Cause(variable, only.share, only.p, only.p, only.n, (only,)))
        elif columns:
            rows = ~np.isnan(table).any(axis=1)
            n, together = int(rows.sum()), table[rows]
            if n < max(FEWEST, 4 * len(kept)) or np.any(np.ptp(together, axis=0) == 0.0):
                left_out[variable] = f"only {n} episodes varied all its {len(kept)} columns"
                continue
            share, p = _share(list(together.T), given[rows], level, permutations, seed)
            found.append(Cause(variable, share, p, p, n, tuple(columns)))
    corrected = holm([cause.p for cause in found])
    causes = (replace(cause, p_holm=p) for cause, p in zip(found, corrected, strict=True))
    return Causes(tuple(causes), left_out, _dependent(tables))


def _dependent(tables: Mapping[str, Floats]) -> dict[tuple[str, str], float]:
    """List the pairs of variables of which one explains a part of the other.

    Each column of one is regressed on the pieces of the other, with an F test; p-values are
    corrected for the columns by Bonferroni's rule, and for the pairs by Holm's.
    """
    from scipy.stats import f

    found = {}
    for one, other in combinations(tables, 2):
        rows = ~np.isnan(np.hstack([tables[one], tables[other]])).any(axis=1)
        sides = [list(tables[name][rows].T) for name in (one, other)]
        n, p = int(rows.sum()), 1.0
        for causes, effects in (sides, sides[::-1]) if n >= FEWEST else ():
            regressors = _regressors(causes, n)
            r, rest = regressors.shape[1], n - regressors.shape[1] - 1
            for column in effects:
                centered = column - column.mean()
                total = float(np.square(centered).sum())
                if total <= 0.0 or rest < 1 or r == 0:
                    continue
                explained = float(np.square(regressors.T @ centered).sum()) / n
                left = max(total - explained, 1e-12 * total)
                p = min(p, float(f.sf((total - left) / r / (left / rest), r, rest)))
        found[one, other] = min(1.0, p * sum(map(len, sides)))
    corrected = zip(found, holm([*found.values()]), strict=True)
    return {pair: p for pair, p in corrected if p < DEPENDENT}


def _regressors(columns: Sequence[Floats], n: int) -> Floats:
    """Span the functions of columns, uncorrelated, of mean 0 and variance 1, shape (n, r)."""
    count = max(1, min(round(math.cbrt(n)), 1 + n // (20 * len(columns)), PIECES))
    spanned = np.concatenate([_pieces(column, count) for column in columns], axis=1)
    left, sizes, _ = np.linalg.svd(spanned - spanned.mean(axis=0), full_matrices=False)
    r = int(np.count_nonzero(sizes > 1e-9 * sizes[0]))
    found: Floats = left[:, :r] * math.sqrt(n)
    return found


def _table(variable: str, values: ArrayLike, n: int) -> tuple[list[str], Floats]:
    """Return a variable's values as columns with names, shape ``(n, columns)``."""
    wanted = f"real numbers or NaN of shape ({n},) or ({n}, columns): a row for each score"
    array: Value = np.asarray(values)
    if array.dtype.kind not in "biuf" or array.ndim not in (1, 2) or len(array) != n:
        given = f"an array of {array.dtype} of shape {array.shape}"
        raise UnknownOption(f"drawn[{variable!r}]", given, (wanted,))
    if np.isinf(array).any():
        raise UnknownOption(f"drawn[{variable!r}]", "infinite", (wanted,))
    if array.ndim == 1 or array.shape[1] == 1:
        return [variable], array.reshape(n, 1).astype(np.float64)
    return [f"{variable}[{k}]" for k in range(array.shape[1])], array.astype(np.float64)


def useless(column: Floats) -> str:
    """Return why a column says nothing; empty if it can be used."""
    values = column[~np.isnan(column)]
    if values.size < FEWEST:
        return f"only {values.size} episodes varied it; {FEWEST} are needed"
    if np.ptp(values) == 0.0:
        return f"it was {values[0]:g} in every episode"
    return ""


def _thirds(values: Floats) -> tuple[float, float]:
    """Find the largest value of the lower third and the smallest of the upper third."""
    lower, upper = np.quantile(values, [1 / 3, 2 / 3], method="inverted_cdf")
    if lower == upper:  # more than a third of the values are the same: the others are a side
        above = values[values > lower]
        lower, upper = (lower, above.min()) if above.size else (values[values < lower].max(), upper)
    return float(lower), float(upper)


def _share(
    columns: Sequence[Floats], scores: Floats, level: float, permutations: int, seed: int
) -> tuple[Interval, float]:
    """Estimate how much of the scores' variance columns explain together, and the p-value.

    Each column is parted into the cube root of n pieces, but no more than five, nor more than a
    twentieth of n for all columns together. More pieces add noise; fewer hide more. Five hide
    nothing of a line and next to nothing of a parabola, but some 7 % of what a step explains, and
    10 % of a band: the share of a cause with sharp limits is too low by as much. The variance of
    the estimate is that of the influence function, and the remainder where that vanishes.

    Source:
        Ezekiel, *Methods of correlation analysis*, 1930, for the correction; Williamson et al.,
        *Nonparametric variable importance assessment*, Biometrics 77, 2021, for the influence
        function; Phipson and Smyth, *Permutation p-values should never be zero*, Statistical
        Applications in Genetics and Molecular Biology 9, 2010.
    """
    n = scores.size
    centered = scores - scores.mean()
    variance = float(np.square(centered).mean())
    if variance <= 1e-24 * max(1.0, float(np.square(scores).max())):  # nothing but rounding
        return Interval(0.0, math.nan, math.nan, level, n), 1.0
    regressors = _regressors(columns, n)
    r = regressors.shape[1]
    fitted = regressors @ (regressors.T @ centered) / n
    raw = float(np.square(fitted).mean()) / variance

    rng = np.random.default_rng(whole_number("seed", seed, least=0))
    places = np.tile(np.arange(n), (permutations, 1))
    shuffled = centered[rng.permuted(places, axis=1)]
    by_chance = np.square(shuffled @ regressors / n).sum(axis=1) / variance
    p = (1 + int(np.count_nonzero(by_chance >= raw - 1e-12))) / (1 + permutations)

    influence = (2.0 * centered * fitted - fitted**2 - raw * centered**2) / variance
    at_zero = 2.0 * r * ((1.0 - raw) / n) ** 2
    reach = normal_quantile(level) * math.sqrt(float(np.square(influence).mean()) / n + at_zero)
    value = 1.0 - (1.0 - raw) * (n - 1.0) / (n - r - 1.0)
    value, low, high = (min(max(x, 0.0), 1.0) for x in (value, value - reach, value + reach))
    if (1 + permutations) * (1.0 - level) >= 1.0:  # the exact test decides whether 0 is inside
        low = 0.0 if p > 1.0 - level else max(low, math.ulp(0.0))
    return Interval(max(value, low), low, max(high, low), level, n), p


def _pieces(values: Floats, count: int) -> Floats:
    """Span the functions of a column, shape ``(n,)``, that are straight in each of its pieces.

    There are ``count`` pieces with about as many values in each. Values so few that twenty fall
    on each, or no more than there are pieces, are the pieces themselves; an order or a
    distance between them then means nothing.

    Returns:
        An indicator of each piece and, within it, the value from its middle; shape ``(n, k)``.
    """
    levels, places = np.unique(values, return_inverse=True)
    if len(levels) <= max(count, len(values) // 20):
        return np.asarray(places[:, None] == np.arange(len(levels)), dtype=np.float64)
    edges = np.unique(np.quantile(values, np.arange(1, count) / count))
    places = np.searchsorted(edges, values, side="left")
    within = np.asarray(places[:, None] == np.unique(places), dtype=np.float64)
    middles = within @ ((values @ within) / within.sum(axis=0))
    slopes = within * ((values - middles) / np.abs(values - middles).max())[:, None]
    return np.concatenate([within, slopes[:, np.any(slopes != 0.0, axis=0)]], axis=1)


def holm(p: Sequence[float]) -> list[float]:
    """Correct p-values for how many questions were asked; they stay in their order.

    Source:
        Holm, *A simple sequentially rejective multiple test procedure*, Scandinavian Journal of
        Statistics 6, 1979.
    """
    values = np.asarray(p, dtype=np.float64)
    order = np.argsort(values, kind="stable")
    steps = np.maximum.accumulate(values[order] * np.arange(len(values), 0, -1))
    corrected = np.empty_like(values)
    corrected[order] = np.minimum(steps, 1.0)
    return [float(value) for value in corrected]
