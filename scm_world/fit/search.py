"""Searches: Gauss-Newton steps to the next minimum, and the best minimum of a problem."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple, final

import numpy as np

from scm_world._types import Floats, Integers
from scm_world.fit.problem import (
    PRIOR,
    ROUNDING,
    STEP,
    FitProblem,
    LeastSquares,
    LinearWindow,
    Minimum,
    Search,
    Window,
    by_column,
    degrees,
    projected,
    windows_of,
)
from scm_world.fit.targets import blocks_of

SEARCHES = 6  # largest number of searches for the best minimum
SAME = 3.0  # largest difference of the loss of equal minima
NEAR = 0.3  # largest distance of their parameters, in standard errors
ROUNDS = 4  # of estimating the noise
SETTLED = 0.02  # relative change of the noise in the last round
UNJOINED = 1.5  # least squared residuals, in those of the noise, of segments that do not join
ROUGH = 0.01, 0.001  # precision in windows partly joined, and before the last search, relative
CLOSED = 1e-4  # largest mean square of the gaps of a start state that another search begins with
WORSE = 1.3  # relative size of the residuals of a poorly fitted window
DRAWS = 32  # start states that are tried in its place
CLOSEST = 3  # of these are fitted
WIDER = (1.0, 3.0, 10.0, 30.0)  # scales of these draws
ELSEWHERE = 0.05  # least standard deviation of where another search begins, scaled
FARTHER = 0.5  # the same where the residuals of a column are not explained
OTHER = 1.3  # relative change of a noise after which a search is repeated
WIDE = 1e-2  # step of derivatives over which an impact that comes or goes is no longer infinite
LESS = 0.9  # relative size of derivatives over a wide step that tells of an impact

TRUST = 1.5  # largest first step of a scaled parameter
EASY = 0.7  # share of the predicted descent with which no other start states are tried
SHARES = ((1.0, EASY), (1.0, 1e-4), (0.3, 1e-4), (0.1, 1e-4), (0.0, 1e-4))
# shares of a step that are tried, the last one for start states only, and their least descent
PRECISION = 0.02  # of the sum of squared residuals, in variances of the noise
SLOW = 5.0  # a step that leaves more than this, in precisions, is slow; two of them end a search
HARDLY = 0.05  # share of the predicted descent; a step that leaves less is slow, too
TINY = 1e-30  # squared gap that counts as none


def gauss_newton(squares: LeastSquares, scaled: Floats, starts: Sequence[Floats]) -> Minimum:
    """Take Gauss-Newton steps of parameters and start states, which close the gaps of segments.

    Steps are chosen by the squared residuals and the squared gaps, with a weight that makes each
    step a descent. They may grow: the next one is at most twice as long as the last one.

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
    rounding = ROUNDING * bool(blocks_of(problem.targets))
    (sizes,), (gaps,), (ends,) = squares.sizes(scaled, [starts])
    slow, smooth, trust = 0, False, TRUST
    for number in range(squares.most):
        made = squares.linear(scaled, starts)
        residual, along = projected(made)
        here = scaled[active]
        step = bounded(residual, along, low - here, high - here, trust, rounding)
        left = np.array([((r + g @ step) ** 2).sum() for r, g in (one.projected for one in made)])
        least = 2.0 * (left - sizes) / np.where(gaps > TINY, gaps, 1.0)
        weights = np.where(gaps > TINY, np.maximum(weights, least), weights)
        before, after = sizes.sum() + weights @ gaps, left.sum()
        near = max(PRECISION, squares.rough * before)
        closed = bool((gaps <= squares.rough**2 * counts).all())
        smooth = bool(before - after < near) and closed
        if smooth or slow > 1 or number == squares.most - 1:
            break
        for share, least in SHARES:
            other, tried = scaled.copy(), []
            other[active] += share * step
            kinds = ((1.0, 0.0), (1.0, 1.0), (max(share, 0.1), 0.0))
            several = 2 + (share < 1.0) if least < EASY else 1
            for part, damping in kinds[:several]:
                by = share * step / part
                moves = [part * move for one in made for move in one.moved(by, damping)]
                tried.append([*map(moved, starts, moves)])
            if share == 1.0 and several > 1:
                tried.append(_following(squares.segments, owner, starts, ends))
            all_sizes, all_gaps, all_ends = squares.sizes(other, tried)
            best = (all_sizes + weights * all_gaps).argmin(axis=0)
            new = [each[best, np.arange(len(groups))] for each in (all_sizes, all_gaps)]
            merit = new[0].sum() + weights @ new[1]
            if merit < before - least * share * (before - after):
                little = max(SLOW * near, HARDLY * (before - after))
                slow = slow + 1 if before - merit < little and closed else 0
                starts = [tried[best[w]][i] for i, w in enumerate(owner)]
                ends = [all_ends[best[w]][i] for i, w in enumerate(owner)]
                scaled, (sizes, gaps) = other, new
                trust = max(TRUST, 2.0 * share * trust)
                break
        else:
            break
    ended = not smooth and slow <= 1 and number == squares.most - 1
    return Minimum(scaled, starts, made, sizes, gaps, smooth, ended)


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


def bounded(
    residual: Floats,
    along: Floats,
    low: Floats,
    high: Floats,
    trust: float = np.inf,
    rounding: float = 0.0,
) -> Floats:
    """Return the step of scaled parameters, between ends, that leaves the least squares.

    Where the residuals do not change, the step is none: its length has a small weight, which is
    not less than the errors of derivatives in their size (``rounding``).

    Source:
        Rockafellar, *Monotone operators and the proximal point algorithm*, SIAM Journal on Control
        and Optimization 1976: the weight of the step does not move the minimum.
    """
    from scipy.optimize import lsq_linear

    p = len(low)
    weight = max(1.0 / PRIOR, rounding * float(np.linalg.norm(along))) if p else 0.0
    stacked = np.vstack([along, weight * np.eye(p)])
    small = np.linalg.qr(np.column_stack([stacked, -np.append(residual, np.zeros(p))])).R
    ends = np.maximum(low, -trust), np.minimum(high, trust)
    step = np.linalg.lstsq(small[:p, :p], small[:p, p], rcond=None)[0]
    if (step < ends[0]).any() or (step > ends[1]).any():
        step = lsq_linear(small[:p, :p], small[:p, p], bounds=ends, method="bvls").x
    return np.asarray(np.clip(step, *ends))


class Result(NamedTuple):
    """A minimum with all segments joined, and how it was found.

    Attributes:
        at: The minimum.
        noise: Standard deviation of the noise of each column, shape (columns,).
        loss: -2 log likelihood but for a constant, with noise that is not given at its best.
        smooth: Whether every search for it ended where the linearised residuals have a minimum.
        joined: Whether joined segments explain the recording if segments on their own do.
        first: The minimum of all segments on their own.
        others: Scaled parameters of other minima that are as good.
    """

    at: Minimum
    noise: Floats
    loss: float
    smooth: bool
    joined: bool
    first: Minimum
    others: tuple[Floats, ...] = ()

    def like(self, other: Result, active: Sequence[int], discount: float = 1.0) -> bool:
        """Return whether it is the same minimum of the active parameters as another one.

        Correlated residuals increase the variance by a discount.
        """
        errors = other.at.errors * discount**0.5
        far = np.abs(self.at.scaled - other.at.scaled)[[*active]] / errors
        return abs(self.loss - other.loss) < SAME * discount and bool((far < NEAR).all())


@final
class Minima:
    """Finds minima of a problem.

    Args:
        problem: The problem.
        search: Searches a minimum near given parameters and start states.
        tell: Called after each search.
    """

    def __init__(
        self,
        problem: FitProblem,
        search: Search = gauss_newton,
        tell: Callable[[], None] = lambda: None,
    ) -> None:
        self.problem, self._search, self._tell = problem, search, tell
        self.best: Result | None = None  # of all parameters
        self._guess = [*problem.simulator.guess(problem.segments)]
        self._unfitted: Floats | None = None

    def search(self, squares: LeastSquares, scaled: Floats, starts: Sequence[Floats]) -> Minimum:
        """Search a minimum, and tell that it was searched; see ``Search``."""
        at = self._search(squares, scaled, starts)
        self._tell()
        return at

    def reached(self) -> Result | None:
        """Return where an interrupted search of all parameters was; None if it had not begun."""
        problem, every = self.problem, range(len(self.problem.targets))
        if problem.reached is None:
            return None
        scaled, segments, states = problem.reached
        begun = {(one.run, one.first): s for one, s in zip(segments, states, strict=True)}
        starts = [begun[one.run, one.first] for (one,) in problem.windows]
        squares = LeastSquares(problem, problem.windows, problem.noise, every)
        at = squares.minimum(scaled, starts, smooth=False)
        noise, loss = problem.noise_of_windows(at.made, problem.noise)
        return Result(at, noise, loss, False, False, at)

    def found(
        self,
        active: Sequence[int],
        begin: Result | None = None,
        *,
        values: Sequence[float] | Floats = (),
        thorough: bool = True,
        enough: float = np.inf,
    ) -> Result:
        """Search a minimum from a fit of other parameters, or from the measurements.

        Where joined segments do not explain what segments on their own do, a thorough search is
        repeated from other values: sticking friction has many minima.

        Args:
            active: Numbers of the parameters.
            begin: The fit of other parameters.
            values: Scaled values of the active ones to begin with; those of ``begin`` if empty.
            thorough: Whether poorly fitted windows get other start states, and the minimum is
                precise.
            enough: Squared residuals above which the search is given up. Shorter windows fit
                better, so joining them would not reduce the residuals below.
        """
        scaled, starts = np.zeros(len(self.problem.targets)), self._guess
        if begin is not None:
            scaled, starts = begin.first.scaled.copy(), begin.first.starts
        if len(values):
            scaled[:] = 0.0
            scaled[[*active]] = values
            scaled = self.problem.allowed(np.zeros(len(scaled)), scaled)
        active, rng, tries = [*active], np.random.default_rng(0), SEARCHES if thorough else 1
        found = self._joined(active, scaled, starts, self.problem.noise, 2, thorough, enough)
        for number in range(1, tries if len(active) else 1):
            if found.joined:
                break
            scaled = self._elsewhere(active, found, rng, ELSEWHERE)
            least = UNJOINED * degrees(found.at.made)  # above, segments do not join there, either
            other = self._beside(active, found, scaled, found.noise, number, least)
            found = other if other.joined else found
        return found

    def _elsewhere(
        self, active: list[int], best: Result, rng: np.random.Generator, least: float
    ) -> Floats:
        """Draw scaled parameters around a minimum, with a least standard deviation.

        Directions in which the residuals do not change are left by little.
        """
        problem, scaled, along = self.problem, best.at.scaled.copy(), projected(best.first.made)[1]
        sizes, directions = np.linalg.svd(along.T @ along)[1:]
        far = np.where(sizes > PRIOR**-2, 2.0 / np.sqrt(np.maximum(sizes, TINY)), 0.0)
        scaled[active] += (np.maximum(far, least) * rng.normal(size=len(active))) @ directions
        return problem.allowed(best.at.scaled, problem.within(scaled))

    def _beside(
        self,
        active: list[int],
        best: Result,
        scaled: Floats,
        noise: Floats,
        number: int,
        enough: float = np.inf,
    ) -> Result:
        """Search a minimum from other parameters; each second time from measured start states."""
        starts = self._guess if number % 2 else best.first.starts
        return self._joined(active, scaled, starts, noise, 2 + number % 2, True, enough)

    def played(self, at: Minimum, unfitted: Minimum | None = None) -> Floats:
        """Return how far runs that are played from their first row are from the measurements.

        Their start states are those of their first windows, as each world fits them best. It is
        the root mean square of each column, at a minimum and without a fit, shape (2, columns).

        Args:
            at: The minimum of whole windows.
            unfitted: That of the world as it is, if it was searched.
        """
        problem, plain = self.problem, np.ones(len(self.problem.measured.columns))
        runs, column = problem.measured.runs, problem.measured.cells[1]
        usual = windows_of(runs, problem.window)
        first = [[one] for one in usual if not one.first]
        pairs = zip(problem.segments, self._guess, strict=True)
        guess = [start for segment, start in pairs if not segment.first]
        squares = LeastSquares(problem, first, problem.noise, ())
        windows = windows_of(runs, None)

        def sizes(numbers: Floats, near: Minimum | None) -> Floats:
            begun = zip(usual, near.starts, strict=True) if near else ()
            begin = [start for one, start in begun if not one.first] or guess
            starts = gauss_newton(squares, numbers, begin).starts
            tasks = [(one, numbers, start) for one, start in zip(windows, starts, strict=True)]
            made = zip(windows, problem.simulator.simulate(tasks), strict=True)
            left = np.concatenate([problem.residual(one, it.values, plain) for one, it in made])
            return np.sqrt(np.divide(*by_column(column, left**2, len(plain))))

        if self._unfitted is None:
            self._unfitted = sizes(np.zeros(len(at.scaled)), unfitted)
        return np.array([sizes(at.scaled, at), self._unfitted])

    def repeated(
        self,
        active: Sequence[int],
        best: Result,
        *,
        same: bool = False,
        misfit: bool = False,
        discount: float = 1.0,
    ) -> Result:
        """Repeat a search from other starts until the best minimum was found twice.

        Where the residuals are smooth, and explained, it is not repeated.

        Args:
            active: Numbers of the parameters.
            best: The minimum that was found.
            same: Whether it was found again already.
            misfit: Whether a column has residuals that the noise does not explain: the searches
                begin farther away.
            discount: By how much correlated residuals increase the variance.
        """
        rng, active = np.random.default_rng(0), [*active]
        changed = np.abs(np.log(best.noise / self.problem.noise)).max() > np.log(OTHER)
        every = [best]
        for number in range(1, SEARCHES):
            if not misfit and (same or (best.smooth and not changed)):
                break
            scaled = self._elsewhere(
                active, best, rng, FARTHER if misfit and number % 2 else ELSEWHERE
            )
            other = self._beside(active, best, scaled, best.noise, number)
            every.append(other)
            same = other.like(best, active, discount) or (same and other.loss > best.loss)
            best = min(best, other, key=lambda one: one.loss)
        good = [one for one in every if one.loss < best.loss + SAME * discount]
        apart = (one.at.scaled for one in good if not one.like(best, active, discount))
        return best._replace(others=tuple(apart))

    def continued(self, active: Sequence[int], best: Result) -> Result:
        """Search a minimum from that of almost the same recording, in whole windows if it can."""
        if not best.joined:
            return self.found(active, best)
        return self._settled([*active], best, 0.0)

    def descended(self, active: Sequence[int], best: Result, other: Minimum) -> Result:
        """Return the minimum that is reached from the start states of other parameters' minimum.

        It is not above that minimum if its parameters are among the active ones.
        """
        inside = {*np.flatnonzero(other.scaled).tolist()} <= {*active}
        scaled = (other if inside else best.at).scaled
        at = best.at._replace(scaled=scaled, starts=other.starts)
        return self._settled([*active], best._replace(at=at), 0.0)

    def linearised(
        self, best: Result, step: float, *, whole: bool
    ) -> tuple[Floats, Floats, Floats]:
        """Linearise in all parameters at a minimum, with the start states at their best.

        Args:
            best: The minimum.
            step: Step of the differences by parameters, in scaled units.
            whole: Whether to linearise whole windows; otherwise separate segments are, near
                measurements and with their gaps closed.

        Returns:
            Scaled parameters (p,), residuals (n,) and their derivatives (n, p).
        """
        problem, at = self.problem, best.at if whole else best.first
        groups, every = problem.windows if whole else problem.joined, range(len(at.scaled))
        squares = LeastSquares(problem, groups, problem.noise, every)
        return at.scaled, *projected(squares.linear(at.scaled, at.starts, step=step))

    def certain(self, best: Result, active: Sequence[int]) -> list[LinearWindow]:
        """Return the linearised windows, or others over wide steps that determine less.

        Where an impact comes or goes within a small step, derivatives would be far too large. Of an
        inertia some combinations never act, which differences to both sides show.
        """
        at = best.at
        linear = LeastSquares(self.problem, self.problem.windows, best.noise, active).linear
        made = at.made
        if blocks_of(self.problem.targets) and active:
            back = linear(at.scaled, at.starts, step=-STEP, of_states=-STEP)
            made = [
                dataclasses.replace(
                    one,
                    states=0.5 * (one.states + other.states),
                    parameters=0.5 * (one.parameters + other.parameters),
                )
                for one, other in zip(made, back, strict=True)
            ]
        if best.smooth or not active:
            return made
        wide = (linear(at.scaled, at.starts, step=one, of_states=one) for one in (WIDE, -WIDE))
        chosen = []
        for each in zip(made, *wide, strict=True):
            sizes = np.array([np.linalg.norm(one.projected[1]) for one in each])
            one = each[int(sizes.argmin())] if sizes.min() < LESS * sizes[0] else each[0]
            chosen.append(dataclasses.replace(one, residual=each[0].residual))
        return chosen

    def _joined(
        self,
        active: list[int],
        scaled: Floats,
        starts: Sequence[Floats],
        noise: Floats,
        join: int,
        restarts: bool,
        enough: float = np.inf,
    ) -> Result:
        """Search a minimum: first of all segments on their own, then of more and more joined."""
        problem, search = self.problem, self.search
        size, usual, smooth, first, alone = 1, None, True, None, 0.0
        while True:
            groups = [g[i : i + size] for g in problem.joined for i in range(0, len(g), size)]
            whole = len(groups) == len(problem.joined)
            squares = LeastSquares(problem, groups, noise, active, ROUGH[whole])
            at = search(squares, scaled, starts)
            better = self._restarted(squares, at, usual) if restarts else None
            if better is not None:
                at = search(squares, at.scaled, better)
            smooth &= at.smooth or size == 1
            if first is None:
                nearer = noise if at.ended else problem.noise_of_segments(at.made, noise)
                if np.abs(np.log(nearer / noise)).max() > np.log(OTHER):
                    noise = nearer
                    squares = dataclasses.replace(squares, noise=noise)
                    at = search(squares, at.scaled, at.starts)
                first, alone = at, float(at.squares.sum()) / degrees(at.made)
            scaled, starts, left = at.scaled, at.starts, float(at.squares.sum())
            counts = [len(group) for group in groups]
            usual = np.repeat(at.squares / counts, counts)
            if whole or left > enough:
                break
            size *= join
        joined = alone > UNJOINED or left / degrees(at.made) < UNJOINED
        begins = np.cumsum([0, *map(len, problem.joined)])[:-1]
        at = at._replace(starts=[starts[i] for i in begins])
        found = Result(at, noise, left, smooth, joined, first)
        if left > enough:
            return found
        return self._settled(active, found, 0.0 if restarts else ROUGH[1])

    def _settled(self, active: list[int], found: Result, rough: float) -> Result:
        """Search a minimum of whole windows near another one, and the noise.

        Residuals where a search took all its steps tell nothing of the noise: it is continued.
        """
        problem, at, noise, smooth = self.problem, found.at, found.noise, found.smooth
        for number in range(ROUNDS):
            squares = LeastSquares(problem, problem.windows, noise, active, rough)
            at = self.search(squares, at.scaled, at.starts)
            smooth &= at.smooth
            new, loss = problem.noise_of_windows(at.made, noise)
            settled = not at.ended and np.all(np.abs(new / noise - 1.0) < SETTLED)
            if number == ROUNDS - 1 or settled:
                break
            noise = noise if at.ended else new
        result = found._replace(at=at, noise=noise, loss=loss, smooth=smooth)
        if len(active) == len(at.scaled) and (self.best is None or loss < self.best.loss):
            self.best = result
        return result

    def _restarted(
        self, squares: LeastSquares, at: Minimum, usual: Floats | None
    ) -> list[Floats] | None:
        """Return start states, better ones where a window was fitted poorly; else None.

        A poorly fitted window has larger residuals than other windows, or than its segments had
        before they were joined (``usual``). Other start states are drawn from the covariance of
        its start state, and from a wider one.
        """
        groups, simulator, made = squares.groups, self.problem.simulator, at.made
        k, sizes = len(simulator.free), np.array([len(group) for group in groups])
        counts = np.array([max(len(one.residual), 1) for one in made])
        if usual is None:
            expected = np.median(at.squares / counts) * counts
        else:
            expected = np.bincount(np.repeat(np.arange(len(groups)), sizes), usual)
            expected = expected * (1.0 + (sizes - 1) * k / counts)
        poor = (at.squares > WORSE * expected) & (at.squares > 0.5 * counts)
        rng, firsts = np.random.default_rng(0), np.cumsum([0, *sizes])
        begin, owners = list[list[Floats]](), list[int]()
        for w in np.flatnonzero(poor).tolist():
            size = np.sqrt(at.squares[w] / counts[w])
            _, certain, along = np.linalg.svd(made[w].states / size, full_matrices=counts[w] < k)
            errors = np.ones(k)
            errors[: len(certain)] /= np.sqrt(1.0 + certain**2)
            draws = along.T @ (errors[:, None] * rng.normal(size=(k, DRAWS)))
            draws *= np.resize(WIDER, DRAWS)
            paths = [[simulator.moved(at.starts[firsts[w]], one)] for one in draws.T]
            left = np.zeros(DRAWS)
            for segment in groups[w]:
                tasks = [(segment, at.scaled, path[-1]) for path in paths]
                for i, (values, end) in enumerate(simulator.simulate(tasks)):
                    part = self.problem.residual(segment, values, squares.noise)
                    left[i] += part @ part
                    paths[i].append(np.where(np.isfinite(end), end, paths[i][-1]))
            closest = np.argsort(left, kind="stable")[:CLOSEST]
            begin += [paths[i][:-1] for i in closest]
            owners += [w] * len(closest)
        if not owners:
            return None
        tried: list[Sequence[Window]] = [groups[w] for w in owners]
        others = self.search(
            LeastSquares(self.problem, tried, squares.noise, [], ROUGH[0]),
            at.scaled,
            [one for path in begin for one in path],
        )
        found, best, place = [*at.starts], at.squares.copy(), 0
        for i, w in enumerate(owners):
            if others.squares[i] < best[w] and others.gaps[i] < CLOSED * sizes[w]:
                best[w] = others.squares[i]
                found[firsts[w] : firsts[w + 1]] = others.starts[place : place + sizes[w]]
            place += sizes[w]
        return found if (best < at.squares).any() else None
