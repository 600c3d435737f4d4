"""The least-squares problem of a recording: residuals of windows, linearised, and their noise."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple, final

import numpy as np

from scm_world._types import Floats, Integers
from scm_world.errors import InterventionError
from scm_world.fit.recordings import Measurements, RecordedRun
from scm_world.fit.targets import FAR, Target, ranges_of
from scm_world.geometry.rotations import aligned

WINDOW = 50  # default number of rows of a window
SHORT = 10  # number of rows of a segment
PRIOR = 3.0  # standard deviation of scaled parameters, of which nothing is known
STEP = 1e-4  # of finite differences, in scaled units
ROUNDING = 1e-4  # least effect of a combination of inertias, in that of the best one
HALVINGS = 8  # of a distance to parameters that the world refuses
STEPS = 30  # largest number of steps of a search
LONGEST = 2.0  # largest scaled step of a number of a start state
SEEN = 0.1  # least change of the measurements by a scaled unit of a start state that is fitted
OUTLIER = 8.0  # robust standard deviations of a residual that no noise leaves
MOST_OUTLIERS = 0.05  # largest share of them in a column
BESIDE = 5  # rows in which the usual ones around an outlier are looked for
ALONE = 0.7  # least distance from the line through these, in that to the fit
MOST_RESIDUAL = 1e6  # in place of residuals after a lost state


class Window(NamedTuple):
    """Rows of a run, from the first one to that before the last one, which are simulated."""

    run: int
    first: int
    last: int


class Outlier(NamedTuple):
    """A measurement that was left out: its run, row, column, value, and distance to the fit."""

    run: int
    row: int
    column: int
    value: float
    off: float


class Simulated(NamedTuple):
    """Simulated measurements (rows, columns), NaN after a lost state, and the state after them."""

    values: Floats
    end: Floats


class Simulator(ABC):
    """Simulates windows of some runs, from any start states and under any scaled parameters.

    Attributes:
        world: The simulated world, or None.
        runs: The recorded runs.
        free: Places of the numbers of a state that are fitted, shape (k,).
        spans: Size of a scaled unit of each fitted number of a state, shape (k,).
        turned: Places of each unit quaternion in a state.
        rotations: Places of each measured unit quaternion in the columns.
    """

    world: Any = None
    runs: Sequence[RecordedRun] = ()
    free: Integers
    spans: Floats
    turned: Sequence[slice] = ()
    rotations: Sequence[Integers] = ()

    @abstractmethod
    def guess(self, windows: Sequence[Window]) -> Floats:
        """Guess start states from the measurements, shape (w, size)."""

    @abstractmethod
    def simulate(self, tasks: Sequence[tuple[Window, Floats, Floats]]) -> list[Simulated]:
        """Simulate windows.

        Args:
            tasks: A window, scaled parameters (p,) and start state (size,) of each.

        Raises:
            InterventionError: The world refuses a value of a parameter.
        """

    @abstractmethod
    def check(self, scaled: Floats) -> None:
        """Raise an ``InterventionError`` if the world refuses scaled parameters."""

    def moved(self, vector: Floats, by: Floats) -> Floats:
        """Return a state after a scaled step, shape (size,)."""
        found: Floats = vector.copy()
        found[self.free] += self.spans * np.clip(by, -LONGEST, LONGEST)
        for where in self.turned:
            found[where] /= max(float(np.linalg.norm(found[where])), 1e-9)
        return found

    def gap(self, end: Floats, start: Floats) -> Floats:
        """Return the scaled distance from a start state to where the segment before it ends."""
        gap = (aligned(end, start, self.turned) - start)[self.free] / self.spans
        return np.asarray(np.nan_to_num(gap, nan=FAR, posinf=FAR, neginf=-FAR))


@final
@dataclass(frozen=True, eq=False)
class LinearWindow:
    """Residuals of a window, linearised in its start state and the parameters.

    A window consists of segments, each with its own start state. The start states follow that of
    the first segment and the parameters in such a way that the linearised segments are joined.

    Attributes:
        residual: Measured minus simulated, in standard deviations of the noise, with the gaps
            between segments closed, shape (n,).
        states: Derivatives by the scaled start state, shape (n, k).
        parameters: Derivatives by scaled parameters, shape (n, p).
        moves: How the start state of each segment moves: a constant (k,), its derivatives by the
            first start state (k, k) and by the parameters (k, p).
    """

    residual: Floats
    states: Floats
    parameters: Floats
    moves: list[tuple[Floats, Floats, Floats]]

    @cached_property
    def fitted(self) -> tuple[Floats, Floats, Floats]:
        """Singular vectors and values of the states, without directions that were not seen."""
        left, sizes, right = np.linalg.svd(self.states, full_matrices=False)
        seen = sizes > SEEN
        return left[:, seen], sizes[seen], right[seen]

    @property
    def slopes(self) -> Floats:
        """How the best start state follows the parameters, shape (k, p)."""
        left, sizes, right = self.fitted
        return np.asarray(-right.T @ ((left.T @ self.parameters) / sizes[:, None]))

    @cached_property
    def projected(self) -> tuple[Floats, Floats]:
        """Residuals (n,) and derivatives by parameters (n, p), with the best start state."""
        left = self.fitted[0]
        residual = self.residual - left @ (left.T @ self.residual)
        return residual, self.parameters - left @ (left.T @ self.parameters)

    def moved(self, by: Floats, damping: float) -> list[Floats]:
        """Return the step of the start state of each segment after one of the parameters."""
        near = np.sqrt(damping * (self.states**2).sum(axis=0) + SEEN**2)
        left = np.append(self.residual + self.parameters @ by, np.zeros(len(near)))
        first = -np.linalg.lstsq(np.vstack([self.states, np.diag(near)]), left, rcond=None)[0]
        return [base + state @ first + along @ by for base, state, along in self.moves]


def projected(made: Iterable[LinearWindow]) -> tuple[Floats, Floats]:
    """Return residuals (n,) and derivatives (n, p) of all windows, with the best start states."""
    residual, along = zip(*(one.projected for one in made), strict=True)
    return np.concatenate(residual), np.concatenate(along)


def residuals(made: Iterable[LinearWindow]) -> Floats:
    """Return the residuals of all windows, in standard deviations of the noise, shape (n,)."""
    return np.concatenate([one.residual for one in made])


def degrees(made: Sequence[LinearWindow]) -> int:
    """Return the degrees of freedom: measurements minus fitted parameters and start states."""
    free = [len(one.residual) - len(one.fitted[1]) for one in made]
    return max(sum(free) - int(made[0].parameters.shape[1]), 1)


def by_column(column: Integers, values: Floats, n: int) -> tuple[Floats, Floats]:
    """Return the sum of the values of each of n columns, and how many there are."""
    sums, counts = (np.bincount(column, each, minlength=n) for each in (values, None))
    return np.asarray(sums, float), np.asarray(counts, float)


def spread_of(along: Floats) -> Floats:
    """Return the covariance of scaled parameters from their sensitivities and the prior."""
    return np.asarray(np.linalg.inv(along.T @ along + np.eye(along.shape[1]) / PRIOR**2))


class Minimum(NamedTuple):
    """Least squares of segments, which are joined in windows, linearised there.

    Attributes:
        scaled: All scaled parameters, shape (p,).
        starts: Start state of each segment.
        made: The windows, linearised.
        squares: Squared residuals of each window, shape (w,).
        gaps: Squared gaps of each window, scaled, shape (w,).
        smooth: Whether the linearised residuals have a minimum there.
        ended: Whether the search took all its steps before it found a minimum.
    """

    scaled: Floats
    starts: list[Floats]
    made: list[LinearWindow]
    squares: Floats
    gaps: Floats
    smooth: bool
    ended: bool = False

    @property
    def errors(self) -> Floats:
        """Standard errors of the fitted parameters, scaled, with their prior."""
        return np.sqrt(np.diag(spread_of(projected(self.made)[1])))


@final
class FitProblem:
    """A recording, its simulator, and the fitted numbers.

    Args:
        simulator: Simulates the windows of the recording.
        measured: The recording.
        targets: The fitted numbers.
        noise: Standard deviation of the noise of each column, shape (columns,); NaN where it is
            estimated.
        window: Number of rows of a window.

    Attributes:
        low: Lower ends of the ranges of the numbers, scaled, shape (p,).
        high: Upper ends, scaled, shape (p,).
        windows: The windows, each a group of one segment.
        joined: The segments of each window.
        segments: All segments.
        noise: Standard deviation of each column, given or estimated, shape (columns,).
        given: Columns whose noise was given, shape (columns,).
        known: Those whose noise is not estimated in a search, shape (columns,); see ``know``.
        reached: Where the last linearisation of all parameters and the whole recording was: scaled
            parameters, segments, and their start states.
    """

    def __init__(
        self,
        simulator: Simulator,
        measured: Measurements,
        targets: Sequence[Target],
        noise: Floats,
        window: int | None = None,
    ) -> None:
        self.simulator, self.measured, self.targets = simulator, measured, tuple(targets)
        self.low, self.high = ranges_of(targets)
        self.window = window or WINDOW
        self.windows = [[one] for one in windows_of(measured.runs, self.window)]
        self.joined = [segments_of(one) for (one,) in self.windows]
        self.segments = [segment for group in self.joined for segment in group]
        self.given = self.known = np.isfinite(noise)
        self.noise = np.where(self.known, noise, measured.noise)
        self.reached: tuple[Floats, Sequence[Window], Sequence[Floats]] | None = None
        self._last: dict[tuple[Window, bytes, bytes], Simulated] = {}

    def within(self, scaled: Floats) -> Floats:
        """Return scaled parameters within their ranges."""
        return np.asarray(np.clip(scaled, self.low, self.high))

    def allowed(self, inside: Floats, scaled: Floats) -> Floats:
        """Return scaled parameters that the world accepts, between those inside and others."""
        for _ in range(HALVINGS):
            try:
                self.simulator.check(scaled)
            except InterventionError:
                scaled = 0.5 * (inside + scaled)
            else:
                return scaled
        return inside

    def residual(self, window: Window, values: Floats, noise: Floats) -> Floats:
        """Return measured minus simulated values in standard deviations, where measured, (n,)."""
        seen = self.measured.runs[window.run].values[window.first : window.last]
        found = (seen - aligned(values, seen, self.simulator.rotations)) / noise
        found = found[np.isfinite(seen)]
        return np.asarray(np.where(np.isfinite(found), found, MOST_RESIDUAL))

    def differences(
        self,
        segments: Sequence[Window],
        scaled: Floats,
        starts: Sequence[Floats],
        active: Sequence[int],
        k: int,
        step: float,
        of_states: float,
    ) -> tuple[list[Simulated], Floats]:
        """Simulate segments, and each of them after a step of each parameter and start number.

        Returns:
            The paired simulations, 1 + p + k of each segment, and the steps, shape (p + k,).
        """
        steps, unit, moved = self._steps(scaled, step, active), np.eye(len(scaled)), np.eye(k)
        tasks = list[tuple[Window, Floats, Floats]]()
        for segment, start in zip(segments, starts, strict=True):
            tasks.append((segment, scaled, start))
            tasks += [(segment, scaled + steps[i] * unit[i], start) for i in active]
            around = [self.simulator.moved(start, of_states * one) for one in moved]
            tasks += [(segment, scaled, other) for other in around]
        keys = [(one, by.tobytes(), start.tobytes()) for one, by, start in tasks]
        new = {key: task for key, task in zip(keys, tasks, strict=True) if key not in self._last}
        made = self.simulator.simulate([*new.values()]) if new else []
        known = self._last | dict(zip(new, made, strict=True))
        self._last = {key: known[key] for key in keys}  # the next call asks for many of them
        sizes = np.concatenate([steps[list(active)], np.full(k, of_states)])
        sizes[sizes == 0.0] = step
        return [known[key] for key in keys], sizes

    def _steps(self, scaled: Floats, size: float, active: Sequence[int]) -> Floats:
        """Return the steps of finite differences: down, or small, where a range ends; else none."""
        steps, unit = np.full(len(scaled), size), np.eye(len(scaled))
        for i in active:
            for step in (size, -size, STEP, -STEP):
                steps[i] = step
                try:
                    if self.low[i] <= scaled[i] + step <= self.high[i]:
                        self.simulator.check(scaled + step * unit[i])
                        break
                except InterventionError:
                    pass
                steps[i] = 0.0
        return steps

    def outliers(
        self, windows: Sequence[Window], scaled: Floats, starts: Sequence[Floats]
    ) -> list[Outlier]:
        """Return single rows of a column that are far from the fit and from the line around them.

        Far is ``OUTLIER`` robust standard deviations of the residuals of the column. Of a column
        with many such rows none is an outlier: another model is needed. Where an impact came early
        or late, a row is half as far from the line through the rows around it as from the fit.

        Args:
            windows: All windows or segments.
            scaled: Scaled parameters, shape (p,).
            starts: Their start states.

        Source:
            Rousseeuw and Leroy, *Robust Regression and Outlier Detection*, 1987, chapter 5.
        """
        run = np.concatenate(
            [np.full(len(r.instants), i) for i, r in enumerate(self.simulator.runs)]
        )
        at = np.concatenate([np.arange(len(r.instants)) for r in self.simulator.runs])
        row, column = self.measured.cells
        made = self.simulator.simulate(
            [(w, scaled, s) for w, s in zip(windows, starts, strict=True)]
        )
        plain, found = np.ones(len(self.measured.columns)), list[Outlier]()
        pairs = zip(windows, made, strict=True)
        every = np.concatenate([self.residual(w, one.values, plain) for w, one in pairs])
        for c in range(len(self.measured.recorded)):
            mine, left = row[column == c], every[column == c]
            least = OUTLIER * max(float(np.median(np.abs(left))) / 0.6745, self.measured.least[c])
            far = np.abs(left) > max(least, OUTLIER * self.noise[c] * self.known[c])
            values, usual = self.measured.values[mine, c], np.flatnonzero(~far)
            if not far.any() or far.mean() > MOST_OUTLIERS:
                continue
            for i in np.flatnonzero(far).tolist():
                place = int(np.searchsorted(usual, i))
                close = usual[max(place - 2, 0) : place + 2]
                close = close[(np.abs(close - i) <= BESIDE) & (run[mine[close]] == run[mine[i]])]
                near = close[np.argsort(np.abs(close - i), kind="stable")]
                sides = near[near < i][:1].tolist() + near[near > i][:1].tolist()
                one, other = sides if len(sides) == 2 else [*near[:2].tolist(), i, i][:2]
                if i in (one, other):
                    continue
                share = (mine[i] - mine[one]) / (mine[other] - mine[one])
                straight = values[one] + share * (values[other] - values[one])
                if (values[i] - straight) / left[i] > ALONE:
                    about = int(run[mine[i]]), int(at[mine[i]]), c
                    found.append(Outlier(*about, float(values[i]), float(left[i])))
        return found

    def without(self, outliers: Sequence[Outlier]) -> FitProblem:
        """Return the problem in which some measurements were not made."""
        values = [run.values.copy() for run in self.measured.runs]
        for one in outliers:
            values[one.run][one.row, one.column] = np.nan
        pairs = zip(self.measured.runs, values, strict=True)
        measured = replace(self.measured, runs=tuple(replace(r, values=v) for r, v in pairs))
        self.simulator.runs = measured.runs
        noise = np.where(self.known, self.noise, np.nan)
        return FitProblem(self.simulator, measured, self.targets, noise, self.window)

    def know(self, noise: Floats) -> None:
        """Take a noise as known, although it was not given."""
        self.noise = np.maximum(noise, self.measured.least)
        self.known = np.full(len(noise), True)

    def noise_of_windows(self, made: Sequence[LinearWindow], noise: Floats) -> tuple[Floats, float]:
        """Return the noise of each column, from the residuals of whole windows, and their loss.

        The loss is -2 log likelihood but for a constant, with noise that is not given at its best.
        """
        column, found = self.measured.cells[1], residuals(made)
        squares, each = by_column(column, found**2, len(noise))
        size_of = noise * np.sqrt(squares / each * len(column) / degrees(made))
        sizes = np.maximum(squares * noise**2, self.measured.least**2)
        loss = float(np.where(self.known, squares, each * np.log(sizes)).sum())
        return np.where(self.known, noise, np.maximum(size_of, self.measured.least)), loss

    def noise_of_segments(self, made: Sequence[LinearWindow], noise: Floats) -> Floats:
        """Return the noise of each column, from the median of its residuals in segments."""
        sizes = []
        for one, (run, first, last) in zip(made, self.segments, strict=True):
            size = len(one.residual)
            free = size - len(one.fitted[1])
            if free and free >= 0.3 * size:
                column = np.nonzero(np.isfinite(self.measured.runs[run].values[first:last]))[1]
                squares, each = by_column(column, one.residual**2, len(noise))
                with np.errstate(invalid="ignore"):
                    sizes.append(np.where(self.known, 1.0, squares / each * size / free))
        if not sizes:
            return noise
        times = np.nan_to_num(np.sqrt(np.nanmedian(sizes, axis=0)), nan=1.0)
        return np.where(self.known, noise, np.maximum(noise * times, self.measured.least))


@final
@dataclass(frozen=True, eq=False)
class LeastSquares:
    """Squared residuals of some windows as a function of parameters and start states.

    Attributes:
        problem: The problem of the windows.
        groups: The segments of each window, which a search joins.
        noise: Standard deviation of the noise of each column, shape (columns,).
        active: Numbers of the parameters that are searched; the others stay.
        rough: Relative precision of squared residuals and gaps, if it is not the last search.
        most: Largest number of steps of a search.
    """

    problem: FitProblem
    groups: Sequence[Sequence[Window]]
    noise: Floats
    active: Sequence[int]
    rough: float = 0.0
    most: int = STEPS

    @cached_property
    def segments(self) -> list[Window]:
        """The segments of all windows, in one list."""
        return [segment for group in self.groups for segment in group]

    def sizes(
        self, scaled: Floats, tried: Sequence[Sequence[Floats]]
    ) -> tuple[Floats, Floats, list[list[Floats]]]:
        """Return squared residuals and gaps of windows, (t, w) each, and the ends of segments.

        Squares and gaps are infinite where the world refuses the parameters.

        Args:
            scaled: Scaled parameters, shape (p,).
            tried: t times the start state of each segment.
        """
        problem, simulator = self.problem, self.problem.simulator
        squares, gaps = np.zeros((2, len(tried), len(self.groups)))
        pairs = [pair for starts in tried for pair in zip(self.segments, starts, strict=True)]
        try:
            simulated = iter(simulator.simulate([(one, scaled, start) for one, start in pairs]))
        except InterventionError:
            return squares + np.inf, gaps, [[] for _ in tried]
        ends: list[list[Floats]] = [[] for _ in tried]
        for t, starts in enumerate(tried):
            for w, group in enumerate(self.groups):
                for place, segment in enumerate(group):
                    values, end = next(simulated)
                    part = problem.residual(segment, values, self.noise)
                    squares[t, w] += part @ part
                    if place:
                        gap = simulator.gap(ends[t][-1], starts[len(ends[t])])
                        gaps[t, w] += gap @ gap
                    ends[t].append(end)
        return squares, gaps, ends

    def linear(
        self,
        scaled: Floats,
        starts: Sequence[Floats],
        *,
        follow: bool = True,
        step: float = STEP,
        of_states: float = STEP,
    ) -> list[LinearWindow]:
        """Linearise windows by finite differences of paired rollouts.

        Args:
            scaled: Scaled parameters, shape (p,).
            starts: Start state of each segment.
            follow: Whether start states are fitted, too.
            step: Step of the differences by parameters, in scaled units.
            of_states: Step of those by start states.

        Source:
            Bock and Plitt, *A multiple shooting algorithm for direct solution of optimal control
            problems*, IFAC 1984: segments are joined by the linearised conditions.
        """
        problem, simulator = self.problem, self.problem.simulator
        p, k = len(self.active), len(simulator.free) * follow
        how = self.active, k, step, of_states
        tried, sizes = problem.differences(self.segments, scaled, starts, *how)
        begins = {(one.run, one.first) for one in self.segments}
        if p == len(scaled) and begins >= {(w.run, w.first) for (w,) in problem.windows}:
            problem.reached = scaled.copy(), self.segments, [*starts]
        simulated, found, number = iter(tried), [], 0
        for group in self.groups:
            constant, state, along = np.zeros(k), np.eye(k), np.zeros((k, p))
            parts, moves = [], []
            for place, segment in enumerate(group):
                made = [next(simulated) for _ in range(1 + p + k)]
                base, *rest = (problem.residual(segment, one.values, self.noise) for one in made)
                slope = (np.array(rest).reshape(p + k, -1) - base).T / sizes
                moves.append((constant, state, along))
                by, of = slope[:, :p], slope[:, p:]
                parts.append((base + of @ constant, of @ state, of @ along + by))
                if place + 1 < len(group):
                    ends = [simulator.gap(one.end, starts[number + 1]) for one in made]
                    slope = (np.array(ends[1:]).reshape(p + k, -1) - ends[0]).T / sizes
                    constant = slope[:, p:] @ constant + ends[0]
                    along = slope[:, p:] @ along + slope[:, :p]
                    state = slope[:, p:] @ state
                number += 1
            residual, states, parameters = map(np.concatenate, zip(*parts, strict=True))
            found.append(LinearWindow(residual, states, parameters, moves))
        return found

    def minimum(self, scaled: Floats, starts: Sequence[Floats], *, smooth: bool) -> Minimum:
        """Return where a search ended, linearised there; see ``Minimum``."""
        (squares,), (gaps,), _ = self.sizes(scaled, [starts])
        return Minimum(scaled, [*starts], self.linear(scaled, starts), squares, gaps, smooth)


Search = Callable[[LeastSquares, Floats, Sequence[Floats]], Minimum]
"""A search for a minimum, from scaled parameters (p,) and the start state of each segment."""


def windows_of(runs: Sequence[RecordedRun], window: int | None) -> list[Window]:
    """Cut runs into windows; a short rest belongs to the last one of a run."""
    found = []
    for number, run in enumerate(runs):
        n = len(run.instants)
        firsts = [*range(0, n, window or n)]
        if len(firsts) > 1 and 2 * (n - firsts[-1]) < (window or n):
            del firsts[-1]
        found += [Window(number, first, last) for first, last in pairwise([*firsts, n])]
    return found


def segments_of(window: Window) -> list[Window]:
    """Cut a window into segments of about ten rows, in which residuals are nearly linear."""
    number = max(1, round((window.last - window.first) / SHORT))
    ends = np.linspace(window.first, window.last, number + 1).astype(int).tolist()
    return [Window(window.run, first, last) for first, last in pairwise(ends)]
