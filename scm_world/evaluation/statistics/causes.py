"""Which cause broke the agent: the effect of each varied variable on the score.

A protocol draws its variables at random, each on its own. So nothing but the variable itself can
make the score depend on it, and what is associated with the score in the very episodes of the
evaluation is an effect (Fisher, *The Design of Experiments*, 1935).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np

from scm_world._types import ArrayLike, Floats, Integers, Value
from scm_world.errors import UnknownOption
from scm_world.evaluation.statistics.inputs import checked_draws, checked_level, numbers
from scm_world.evaluation.statistics.intervals import (
    LEVEL,
    RESAMPLES,
    Interval,
    unpaired_interval,
)
from scm_world.evaluation.statistics.shares import (
    basis,
    holm,
    piece_count,
    pieces,
    share_of_variance,
)

PERMUTATIONS = 1000
FEWEST = 12
"""Fewer episodes than these say nothing about a column."""


@final
@dataclass(frozen=True)
class Column:
    """The effect of one component of a variable on the score.

    Attributes:
        name: Such as ``"tool_block.cylindrical_position[0]"``; the variable's own name if it has
            one component.
        contrast: Mean score in the upper third of the drawn values minus that in the lower third;
            of a column with few values, of the highest minus the lowest ones.
        lower: Largest value of the lower third, in the unit of the variable.
        upper: Smallest value of the upper third. The contrast is that of values at or beyond these
            two bounds; its interval takes them as given.
        share: Share of the score's variance that this column alone explains. Its value and its ends
            are in [0, 1].
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
        """Whether the score goes ``"up"`` or ``"down"`` with the value, or that is ``"unclear"``.

        It is also unclear if the score first rises and then falls, whatever the share.
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
        share: Share of the score's variance that its columns explain together, each by itself: what
            only a combination of two of them does is not in it.
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
    columns: tuple[Column, ...]

    @property
    def column(self) -> Column:
        """The component that explains most."""
        return max(self.columns, key=lambda column: column.share.value)


@final
@dataclass(frozen=True)
class Causes:
    """The effects of all varied variables on the score.

    Attributes:
        causes: In the order in which the variables were given.
        left_out: Columns or variables about which the data say nothing, and why.
    """

    causes: tuple[Cause, ...]
    left_out: Mapping[str, str]

    def ranked(self) -> tuple[Cause, ...]:
        """Order the variables, the one that explains most of the score first."""
        return tuple(sorted(self.causes, key=lambda cause: (-cause.share.value, cause.p)))

    def found(self, alpha: float = 0.05) -> tuple[Cause, ...]:
        """Name the variables that do have an effect, strongest first.

        Args:
            alpha: Probability of naming any that has none.
        """
        return tuple(cause for cause in self.ranked() if cause.p_holm <= alpha)

    def __str__(self) -> str:
        head = ("variable", "share of variance", "p (Holm)", "upper - lower third", "of column")
        rows = [
            (
                cause.variable,
                str(cause.share),
                f"{cause.p_holm:.3f}",
                str(cause.column.contrast),
                cause.column.name,
            )
            for cause in self.ranked()
        ]
        widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
        lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in (head, *rows)]
        lines += [f"{name}: left out, {reason}" for name, reason in self.left_out.items()]
        return "\n".join(lines)


def find_causes(
    drawn: Mapping[str, ArrayLike],
    scores: ArrayLike,
    *,
    level: float = LEVEL,
    resamples: int = RESAMPLES,
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
        resamples: Of the bootstrap of the contrasts.
        permutations: Of the tests.
        seed: Of both. What is found about one variable does not depend on which others there are,
            except for Holm's correction.
        proportion: Whether scores are failures and successes; as for ``mean_interval``.

    Returns:
        An effect for each variable. Columns that never change and columns that too few episodes
        varied are in ``left_out``.

    Raises:
        UnknownOption: No scores; values of another shape, or not real numbers; or a level,
            resamples or permutations that are none.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> drawn = {"tool_block.mass": rng.random(200), "floor_friction": rng.random(200)}
        >>> print(find_causes(drawn, (drawn["tool_block.mass"] < 0.6).astype(float)))
        variable         share of variance  p (Holm)  upper - lower third   of column
        tool_block.mass  0.93 [0.90, 0.95]  0.002     -1.00 [-1.00, -0.92]  tool_block.mass
        floor_friction   0.00 [0.00, 0.04]  0.765     0.03 [-0.14, 0.19]    floor_friction
    """
    given = numbers("scores", scores)
    options = _Options(checked_level(level), resamples, permutations, seed, proportion)
    left_out: dict[str, str] = {}
    found = []
    for variable, values in drawn.items():
        names, table = _table(variable, values, given.size)
        left_out |= {
            name: reason
            for name, column in zip(names, table.T, strict=True)
            if (reason := _useless(column))
        }
        kept = [k for k, name in enumerate(names) if name not in left_out]
        if kept:
            cause = _cause(variable, [names[k] for k in kept], table[:, kept], given, options)
            if isinstance(cause, str):
                left_out[variable] = cause
            else:
                found.append(cause)
    return Causes(_corrected(found), left_out)


@dataclass
class _Options:
    """How to resample, and the permutations for each number of episodes, made once."""

    level: float
    resamples: int
    permutations: int
    seed: int
    proportion: bool | None = None
    _made: dict[int, Integers] = field(default_factory=dict)

    def shuffles(self, n: int) -> Integers:
        """Give permutations of n places, shape ``(permutations, n)``."""
        if n not in self._made:
            rows = checked_draws("permutations", self.permutations)
            ordered = np.tile(np.arange(n), (rows, 1))
            self._made[n] = np.random.default_rng(self.seed).permuted(ordered, axis=1)
        return self._made[n]


def _table(variable: str, values: ArrayLike, n: int) -> tuple[list[str], Floats]:
    """Arrange a variable's values as columns with names, shape ``(n, columns)``."""
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


def _useless(column: Floats) -> str:
    """Say why nothing can be learnt from a column; nothing if something can."""
    values = column[~np.isnan(column)]
    if values.size < FEWEST:
        return f"only {values.size} episodes varied it; {FEWEST} are needed"
    if np.ptp(values) == 0.0:
        return f"it was {values[0]:g} in every episode"
    return ""


def _cause(
    variable: str, names: Sequence[str], table: Floats, scores: Floats, options: _Options
) -> Cause | str:
    """Measure one variable, or say why that is impossible."""
    columns = [
        _column(name, values, scores, options) for name, values in zip(names, table.T, strict=True)
    ]
    rows = ~np.isnan(table).any(axis=1)
    together = table[rows]
    if len(names) == 1:
        (only,) = columns
        return Cause(variable, only.share, only.p, only.p, only.n, (only,))
    if len(together) < max(FEWEST, 4 * len(names)) or np.any(np.ptp(together, axis=0) == 0.0):
        return f"only {len(together)} episodes varied all its {len(names)} columns"
    share, p = _share(list(together.T), scores[rows], options)
    return Cause(variable, share, p, p, len(together), tuple(columns))


def _column(name: str, column: Floats, scores: Floats, options: _Options) -> Column:
    rows = ~np.isnan(column)
    values, of = column[rows], scores[rows]
    lower, upper = _thirds(values)
    contrast = unpaired_interval(
        of[values >= upper],
        of[values <= lower],
        level=options.level,
        resamples=options.resamples,
        seed=options.seed,
        proportion=options.proportion,
    )
    share, p = _share([values], of, options)
    return Column(name, contrast, lower, upper, share, p, len(of))


def _thirds(values: Floats) -> tuple[float, float]:
    """Find the largest value of the lower third and the smallest of the upper third."""
    lower, upper = np.quantile(values, [1 / 3, 2 / 3], method="inverted_cdf")
    if lower == upper:  # more than a third of the values are the same: the others are a side
        above = values[values > lower]
        lower, upper = (lower, above.min()) if above.size else (values[values < lower].max(), upper)
    return float(lower), float(upper)


def _share(columns: Sequence[Floats], scores: Floats, options: _Options) -> tuple[Interval, float]:
    """Estimate what columns explain together, and the p-value of none of them mattering."""
    n = len(scores)
    regressors = basis(pieces(column, piece_count(n, len(columns))) for column in columns)
    share = share_of_variance(regressors, scores, options.shuffles(n), options.level)
    return Interval(share.value, share.low, share.high, options.level, n), share.p


def _corrected(causes: Sequence[Cause]) -> tuple[Cause, ...]:
    corrected = holm([cause.p for cause in causes])
    return tuple(replace(cause, p_holm=p) for cause, p in zip(causes, corrected, strict=True))


__all__ = ["FEWEST", "PERMUTATIONS", "Cause", "Causes", "Column", "find_causes"]
