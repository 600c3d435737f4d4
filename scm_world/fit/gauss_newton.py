"""Gauss-Newton steps of parameters and start states: the usual search for a minimum."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scm_world._types import Floats, Integers
from scm_world.fit.problem import (
    PRIOR,
    LeastSquares,
    LinearWindow,
    Minimum,
    Window,
    projected,
)

TRUST = 1.5  # largest step of a scaled parameter
SHARES = (1.0, 0.3, 0.1, 0.0)  # of a step that are tried, the last one for start states only
PRECISION = 0.02  # of the sum of squared residuals, in variances of the noise
SLOW = 5.0  # a step that leaves more than this, in precisions, is slow; two of them end a search
HARDLY = 0.05  # share of the predicted descent; a step that leaves less is slow, too
TINY = 1e-30  # squared gap that counts as none


def gauss_newton(squares: LeastSquares, scaled: Floats, starts: Sequence[Floats]) -> Minimum:
    """Take Gauss-Newton steps of parameters and start states, which close the gaps of segments.

    Steps are chosen by the squared residuals and the squared gaps, with a weight that makes each
    step a descent.

    Args:
        squares: The squared residuals.
        scaled: Scaled parameters to begin with, shape (p,).
        starts: Start state of each segment.

    Source:
        Nocedal and Wright, *Numerical Optimization*, 2006, section 18.3: merit function and its
        weight.
    """
    groups, active, problem = squares.groups, [*squares.active], squares.problem
    moved, counts = problem.simulator.moved, np.array([len(group) for group in groups])
    owner = np.repeat(np.arange(len(groups)), counts)
    low, high, weights = problem.low[active], problem.high[active], np.zeros(len(groups))
    scaled, starts, made = scaled.copy(), [*starts], list[LinearWindow]()
    (sizes,), (gaps,), (ends,) = squares.sizes(scaled, [starts])
    slow, smooth = 0, False
    for number in range(squares.most):
        made = squares.linear(scaled, starts)
        residual, along = projected(made)
        here = scaled[active]
        step = bounded(residual, along, here, low, high)
        left = np.array([((r + g @ step) ** 2).sum() for r, g in (one.projected for one in made)])
        least = 2.0 * (left - sizes) / np.where(gaps > TINY, gaps, 1.0)
        weights = np.where(gaps > TINY, np.maximum(weights, least), weights)
        before = sizes.sum() + weights @ gaps + (here**2).sum() / PRIOR**2
        after = left.sum() + ((here + step) ** 2).sum() / PRIOR**2
        near = max(PRECISION, squares.rough * before)
        closed = bool((gaps <= squares.rough**2 * counts).all())
        smooth = bool(before - after < near) and closed
        if smooth or slow > 1 or number == squares.most - 1:
            break
        for share in SHARES:
            other, tried = scaled.copy(), []
            other[active] += share * step
            kinds = ((1.0, 0.0), (1.0, 1.0), (max(share, 0.1), 0.0))
            for part, damping in kinds[: 2 + (share < 1.0)]:
                by = share * step / part
                moves = [part * move for one in made for move in one.moved(by, damping)]
                tried.append([*map(moved, starts, moves)])
            if share == 1.0:
                tried.append(_following(squares.segments, owner, starts, ends))
            all_sizes, all_gaps, all_ends = squares.sizes(other, tried)
            best = (all_sizes + weights * all_gaps).argmin(axis=0)
            new = [each[best, np.arange(len(groups))] for each in (all_sizes, all_gaps)]
            merit = new[0].sum() + weights @ new[1] + (other[active] ** 2).sum() / PRIOR**2
            if merit < before - 1e-4 * share * (before - after):
                little = max(SLOW * near, HARDLY * (before - after))
                slow = slow + 1 if before - merit < little and closed else 0
                starts = [tried[best[w]][i] for i, w in enumerate(owner)]
                ends = [all_ends[best[w]][i] for i, w in enumerate(owner)]
                scaled, (sizes, gaps) = other, new
                break
        else:
            break
    return Minimum(scaled, starts, made, sizes, gaps, smooth)


def _following(
    segments: Sequence[Window], owner: Integers, starts: Sequence[Floats], ends: Sequence[Floats]
) -> list[Floats]:
    """Return start states, those of windows where the one before it ends."""
    found = [*starts]
    for i in range(1, len(found)):
        before, here = segments[i - 1 : i + 1]
        same = (before.run, before.last) == (here.run, here.first)
        if same and owner[i] != owner[i - 1] and np.isfinite(ends[i - 1]).all():
            found[i] = ends[i - 1]
    return found


def bounded(residual: Floats, along: Floats, here: Floats, low: Floats, high: Floats) -> Floats:
    """Return the step of scaled parameters that leaves the least squares, with their prior."""
    from scipy.optimize import lsq_linear

    p = len(here)
    stacked = np.vstack([along, np.eye(p) / PRIOR])
    small = np.linalg.qr(np.column_stack([stacked, -np.append(residual, here / PRIOR)])).R
    ends = np.maximum(low - here, -TRUST), np.minimum(high - here, TRUST)
    step = np.linalg.lstsq(small[:p, :p], small[:p, p], rcond=None)[0]
    if (step < ends[0]).any() or (step > ends[1]).any():
        step = lsq_linear(small[:p, :p], small[:p, p], bounds=ends, method="bvls").x
    return np.asarray(np.clip(step, *ends))
