"""Fit parameters to recordings, explain deviations, and replay recorded runs counterfactually."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, Self, final

import numpy as np

from scm_world._arguments import whole_number
from scm_world._types import Floats, Integers
from scm_world.errors import InterventionError, ModelError, UnknownOption
from scm_world.fit.design import PRIOR, Experiment, spread_of, suggested
from scm_world.fit.recordings import (
    MeasuredNumber,
    RecordedRun,
    noise_of,
    runs_of,
)
from scm_world.fit.shooting import (
    DELAY,
    SHORT,
    LinearWindow,
    Shooting,
    Target,
    Window,
    segments_of,
    targets_of,
    windows_of,
)
from scm_world.fit.units import check_units
from scm_world.geometry.rotations import aligned
from scm_world.queries.plans import has_times
from scm_world.queries.progress import Progress
from scm_world.queries.twins import twins_of
from scm_world.runs.canvas import PALETTE, blank, styled
from scm_world.tasks.model import ModelTask

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

WINDOW = 50
"""Default number of rows of a window."""

CONFIDENCE = 0.95
DETERMINED = 0.25
"""Largest standard error of a determined combination, in scaled units: a share of the value."""

SEARCHES = 6  # largest number of searches for a minimum
ROUNDS = 4  # of estimating the noise
SETTLED = 0.02  # relative change of the noise in the last round
FLOOR = 1e-6  # least noise, relative to the spread of a column
FEW = 1e-9  # least noise
UNJOINED = 1.5  # least squared residuals, in those of the noise, of segments that do not join
MISFIT = 1.5  # least residual that the noise does not explain, in standard deviations of it
CLEAR = 1.2  # the same where shorter windows explain what usual ones do not
MAIN = 0.3  # least share of a parameter in a combination that is named
STEPS = 30  # largest number of Gauss-Newton steps
TRUST = 1.5  # largest step of a scaled parameter
SHARES = (1.0, 0.3, 0.1, 0.0)  # of a step that are tried, the last one for start states only
PRECISION = 0.02  # of the sum of squared residuals, in variances of the noise
ROUGH = 0.01, 0.001  # the same in windows partly joined, and before the last search, relative
SLOW = 5.0  # a step that leaves more than this, in precisions, is slow; two of them end a search
CLOSED = 1e-4  # largest mean square of the gaps of a start state that another search begins with
HARDLY = 0.05  # share of the predicted descent; a step that leaves less is slow, too
TINY = 1e-30  # squared gap that counts as none
WORSE = 1.3  # relative size of the residuals of a poorly fitted window
DRAWS = 32  # start states that are tried in its place
CLOSEST = 3  # of these are fitted
WIDER = (1.0, 3.0, 10.0, 30.0)  # scales of these draws
ELSEWHERE = 0.05  # least standard deviation of where another search begins, scaled
OTHER = 1.3  # relative change of a noise after which a search is repeated
SAME = 3.0  # largest difference of the loss of equal minima
NEAR = 0.3  # largest distance of their parameters, in standard errors
WIDE = 1e-2  # step of derivatives over which an impact that comes or goes is no longer infinite
LESS = 0.9  # relative size of derivatives over a wide step that tells of an impact
DOUBLINGS = 6  # of an interval, at most
PROFILE = 8  # largest number of steps at the end of an interval
LINEAR = 0.1  # largest deviation from the squares that linearised residuals have there, relative
DRAWN = 8  # columns of a picture


@final
@dataclass(frozen=True, eq=False, repr=False)
class Fit:
    """Parameters that were fitted to a recording.

    Attributes:
        asked: The world, as it was asked; its default values are compared.
        runs: The recorded runs.
        columns: The measured columns.
        targets: The fitted numbers.
        window: Number of rows of a window.
        scaled: The fitted numbers, scaled, shape (p,).
        starts: Start state of each window, shape (w, size).
        noise: Standard deviation of the noise of each column, given or estimated, shape (columns,).
        given: Which of them were given, shape (columns,).
        found: The windows, linearised at the fit.
        spans: What a scaled unit of each free number of a start state stands for, shape (k,).
        reach: How far the intervals reach down and up, scaled, shape (p, 2); None if linearised.
        shortened: Whether the windows are shorter than usual because segments did not join.

    Example:
        >>> from scm_world.queries import World
        >>> world = World.from_mjcf(
        ...     "<mujoco><worldbody><body name='pole'>"
        ...     "<joint name='hinge' axis='0 1 0' damping='0.1'/>"
        ...     "<geom type='sphere' size='0.1' pos='0 0 1'/></body></worldbody></mujoco>"
        ... )
        >>> recorded = world.rollout(do={"hinge.damping": 0.3, "hinge.position": 1.0}, steps=60)
        >>> fit = world.fit(recorded, "hinge.damping")
        >>> fit.table[["parameter", "value", "default"]].round(3).to_dict("records")
        [{'parameter': 'hinge.damping', 'value': 0.3, 'default': 0.1}]
    """

    asked: Any
    runs: tuple[RecordedRun, ...]
    columns: tuple[MeasuredNumber, ...]
    targets: tuple[Target, ...]
    window: int
    scaled: Floats
    starts: Floats
    noise: Floats
    given: Any
    found: tuple[LinearWindow, ...]
    spans: Floats
    reach: Floats | None = None
    shortened: bool = False

    # --- parameters ---------------------------------------------------------------------------

    @property
    def values(self) -> dict[str, float]:
        """The fitted values, by name."""
        pairs = zip(self.targets, self.scaled, strict=True)
        return {target.name: float(target.value(number)) for target, number in pairs}

    @cached_property
    def world(self) -> Any:
        """A world with the fitted values, in every episode.

        A fitted delay is one of each command, in control steps (``motor.control_delay``), so that
        the world replays the recording.

        Raises:
            UnknownOption: A delay was fitted beside commands that have one already.
            ModelError: A delay was fitted to a step function.
        """
        pairs, world = zip(self.targets, self.scaled, strict=True), self.asked
        late = sum(float(u) for t, u in pairs if t.name == DELAY and t.variable not in world.model)
        if late:
            build, (kind, task, options, _), *_ = world.__reduce__()
            if not isinstance(task, ModelTask):
                problem = f"its commands cannot be delayed by {late:.3g} control steps"
                raise ModelError([f"{problem}: delay them in the step function, or before it"])
            world = build(kind, task.delayed(late), options, None)
            world._given = self.asked._given
        return world.given(self._request())

    def _request(self) -> dict[str, Any]:
        found = dict[str, Any]()
        with twins_of(self.asked).twin() as twin:
            twin.reset(seed=0)
            for target, number in zip(self.targets, self.scaled, strict=True):
                if target.variable in twin.model:
                    value = found.setdefault(
                        target.variable, np.array(twin[target.variable], float)
                    )
                    target.write(value, number)
        return found

    @property
    def degrees(self) -> int:
        """Degrees of freedom: measurements minus fitted parameters and start states."""
        return _degrees(self.found)

    @cached_property
    def residual(self) -> Floats:
        """Measured minus fitted by rows and columns, in standard deviations of the noise, (n,)."""
        return np.concatenate([one.residual for one in self.found])

    @cached_property
    def sensitivities(self) -> Floats:
        """Derivatives of the residuals by the scaled parameters, start states following, (n, p)."""
        return np.concatenate([one.projected[1] for one in self.found])

    @cached_property
    def _windows(self) -> Integers:
        """The number of the window of each residual."""
        sizes = [len(one.residual) for one in self.found]
        return np.repeat(np.arange(len(sizes)), sizes)

    @cached_property
    def _pairs(self) -> tuple[Floats, Floats, Integers]:
        """Residuals of one column that follow one another in a window, (n,) each; the column."""
        _, column = _measured(self.runs)
        order = np.argsort(column, kind="stable")
        one, other = order[:-1], order[1:]
        same = (column[one] == column[other]) & (self._windows[one] == self._windows[other])
        residual = self.residual
        return residual[one[same]], residual[other[same]], column[one[same]]

    @cached_property
    def roughness(self) -> Floats:
        """Noise of each column from differences of consecutive residuals, (columns,).

        It is in standard deviations of the noise; NaN where no residuals follow one another. Noise
        is independent in time and an error of the model is not.

        Source:
            von Neumann, *Distribution of the ratio of the mean square successive difference to the
            variance*, Annals of Mathematical Statistics 1941.
        """
        one, other, column = self._pairs
        squares, count = _by_column(column, (other - one) ** 2, len(self.columns))
        return np.sqrt(np.where(count > 0, squares / np.maximum(2 * count, 1), np.nan))

    @cached_property
    def misfit(self) -> dict[str, float]:
        """Root mean square of the residuals of each column, in standard deviations of its noise.

        Noise that was not given is judged by the ``roughness`` of the residuals.
        """
        residual = self.residual
        squares, count = _by_column(_measured(self.runs)[1], residual**2, len(self.columns))
        size = np.sqrt(squares / count * len(residual) / self.degrees)
        own = np.maximum(self.roughness, _least(self.runs) / self.noise)
        size = np.where(self.given | np.isnan(own), size, np.sqrt(squares / count) / own)
        names = (column.name for column in self.columns)
        return dict(zip(names, map(float, size), strict=True))

    @property
    def explains(self) -> bool:
        """Whether the residuals are as small as the noise, so that the model can be true."""
        return max(self.misfit.values()) < MISFIT

    @cached_property
    def discount(self) -> float:
        """Return by which factor correlated and too large residuals increase the variance.

        Consecutive residuals with correlation ρ have as much information as (1 - ρ) / (1 + ρ) times
        as many independent ones.
        """
        worst = max(self.misfit.values(), default=1.0)
        size = max(1.0, self.squares / self.degrees)
        size = max(size, worst**2) if worst >= MISFIT else size
        one, other, _ = self._pairs
        rho = float((one * other).sum()) / self.squares if self.squares else 0.0
        rho = rho if rho > 2.0 / np.sqrt(len(self.residual)) else 0.0
        return size * (1.0 + rho) / max(1.0 - rho, 1e-3)

    @property
    def squares(self) -> float:
        """Sum of the squared residuals, in variances of the noise."""
        return float((self.residual**2).sum())

    @cached_property
    def _directions(self) -> tuple[Floats, Floats]:
        """Return singular values (p,) and directions (p, p) of the scaled sensitivities."""
        along = self.sensitivities
        padded = np.vstack([along, np.zeros((max(0, along.shape[1] - len(along)), along.shape[1]))])
        _, sizes, directions = np.linalg.svd(padded, full_matrices=False)
        return sizes, directions

    @cached_property
    def covariance(self) -> Floats:
        """Covariance of the scaled parameters, shape (p, p), without undetermined directions.

        It is that of linearised least squares, times the discount for correlated residuals.
        """
        sizes, directions = self._directions
        errors = np.sqrt(self.discount) / np.maximum(sizes, 1e-12)
        return np.asarray((directions.T * errors**2) @ directions)

    @property
    def errors(self) -> Floats:
        """Standard errors of the scaled parameters, shape (p,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def linear_reach(self) -> Floats:
        """How far the intervals of linearised least squares reach, scaled, shape (p,)."""
        from scipy.special import stdtrit

        return np.asarray(stdtrit(self.degrees, 0.5 + 0.5 * CONFIDENCE) * self.errors)

    @cached_property
    def table(self) -> pd.DataFrame:
        """The fitted parameters.

        A row has ``parameter``, ``value``, ``low`` and ``high`` of the 95 % interval, ``default``,
        ``deviation`` (value : default - 1; NaN if the default is zero), ``unit``, and whether the
        parameter is ``determined``: its standard error is at most a quarter of its value (of the
        usual size of such a parameter, if its default is zero).
        """
        import pandas as pd

        linear = np.repeat(self.linear_reach[:, None], 2, axis=1)
        reach = linear if self.reach is None else self.reach
        rows = []
        for target, number, error, (down, up) in zip(
            self.targets, self.scaled, self.errors, reach, strict=True
        ):
            value = float(target.value(number))
            ends = np.clip([number - down, number + up], target.low, target.high)
            low, high = sorted(float(target.value(end)) for end in ends)
            deviation = value / target.default - 1.0 if target.default else np.nan
            determined = bool(error <= DETERMINED)
            ends = (value, low, high, target.default, deviation, target.unit, determined)
            rows.append((target.name, *ends))
        names = ("value", "low", "high", "default", "deviation", "unit", "determined")
        return pd.DataFrame(rows, columns=["parameter", *names])

    @cached_property
    def identifiable(self) -> pd.DataFrame:
        """The combinations of parameters, the best determined first.

        A row has the ``singular_value`` of the sensitivities (change of the measurements in
        standard deviations of their noise by a scaled unit), the ``standard_error`` in scaled
        units, whether it is ``determined``, its main ``parameters``, and the ``combination`` in
        words. A scaled unit of a positive parameter is that of its logarithm: 0.1 is 10 %.
        """
        import pandas as pd

        rows = []
        for size, found in zip(*self._directions, strict=True):
            error = float(np.sqrt(self.discount) / max(size, 1e-12))
            direction = found * np.sign(found[np.abs(found).argmax()])
            order = np.argsort(-np.abs(direction), kind="stable")
            main = [i for i in order if abs(direction[i]) >= MAIN]
            names = tuple(self.targets[i].name for i in main)
            words = " ".join(f"{direction[i]:+.2f} {self.targets[i].name}" for i in main)
            rows.append((float(size), error, error <= DETERMINED, names, words.removeprefix("+")))
        columns = ["singular_value", "standard_error", "determined", "parameters", "combination"]
        return pd.DataFrame(rows, columns=columns)

    @property
    def confounded(self) -> tuple[tuple[str, ...], ...]:
        """Groups of parameters that the recording cannot tell apart, or does not determine."""
        rows = self.identifiable
        return tuple(rows.parameters[~rows.determined])

    def __str__(self) -> str:
        table = self.table.to_string(index=False, float_format="{:.4g}".format)
        return "\n".join([table, *self.remarks])

    __repr__ = __str__

    @property
    def read(self) -> str:
        """How much was recorded, in words."""
        rows = sum(len(run.instants) for run in self.runs)
        time = sum(int(run.instants[-1]) for run in self.runs) * self.asked.options.control_period
        runs = "a run" if len(self.runs) == 1 else f"{len(self.runs)} runs"
        lost = 1.0 - len(self.residual) / (rows * len(self.columns))
        rest = f", {100.0 * lost:.2g} % not measured" * (lost > 0.0)
        columns = f"{len(self.columns)} measured column" + "s" * (len(self.columns) > 1)
        return f"{runs} of {rows} rows, {time:.4g} s, {columns}{rest}"

    @property
    def remarks(self) -> tuple[str, ...]:
        """What the recording does not determine, and what the fit does not explain."""
        found = []
        for names in self.confounded:
            alone = len(names) == 1
            said = "is not determined" if alone else "cannot be told apart"
            found.append(
                f"{', '.join(names)} {said} by this recording; suggest(1), or --suggest 1 of the "
                f"command, has an experiment that does it"
            )
        if self.shortened:
            found.append(
                f"windows of {WINDOW} rows do not explain the recording, those of {self.window} "
                f"do: there are impacts or chaos, or something acts that is not modelled"
            )
        for name, size in self.misfit.items():
            if size >= MISFIT:
                said = f"the residuals of {name} are {size:.3g} times as large as its noise"
                shorter = f"; where bodies bump, window={SHORT} may" * (self.window != SHORT)
                found.append(f"{said}: no values that were found explain them{shorter}")
        for target, number in zip(self.targets, self.scaled, strict=True):
            near = 1e-3 * min(1.0, target.high - target.low)
            if min(number - target.low, target.high - number) < near < abs(number):
                found.append(f"{target.name} is at the end of its range")
        return tuple(found)

    # --- questions ----------------------------------------------------------------------------

    def suggest(
        self,
        n: int = 1,
        *,
        steps: int | None = None,
        limits: Mapping[str, Any] | None = None,
        seed: int = 0,
    ) -> tuple[Experiment, ...]:
        """Suggest experiments under which the least determined parameters would show.

        Of sequences of commands, half of them with a start of their own, those are chosen after
        which the parameters would have the least variance. Simulated with the fitted values, they
        stay within all limits.

        Args:
            n: Number of experiments.
            steps: Control steps of an experiment; those of the longest run if None.
            limits: Ranges of commands, states or readouts by patterns of columns, such as
                ``{"elbow.velocity": (-2, 2)}``. The ranges of commands and joints always hold.
            seed: Seed of the sequences.

        Raises:
            UnknownOption: Limits exceed the range of a command, or every sequence leaves them.
            UnknownVariable: A pattern of limits fits no column.
        """
        longest = max(len(run.commands) for run in self.runs)
        count = longest if steps is None else steps
        known = self.sensitivities / np.sqrt(self.discount)
        do = self._request()
        return suggested(self, do, known, n, steps=count, limits=limits, seed=seed)

    def counterfactual(
        self, do: Mapping[str, Any], *, at: int = 0, run: int = 0, draws: int = 32, seed: int = 0
    ) -> pd.DataFrame:
        """Return what would have been measured in a recorded run under an intervention.

        Abduction is the fit: its residuals are the noise of the sensors, and the differences
        between the start state of a window and where the window before it led are what acted on
        the system without being modelled. Both are added again, so that no intervention gives the
        recorded measurements. The interval is that of the parameters, drawn from the covariance of
        the fit (from its prior where the recording determines nothing) with the start states that
        belong to them.

        Args:
            do: The intervention, without times: parameters from then on, states at that instant,
                commands from then on; see ``World.do``.
            at: Its control step.
            run: Number of the run.
            draws: Number of draws of the parameters.
            seed: Seed of the draws.

        Returns:
            A row for each instant and column: ``time`` [s], ``column``, ``measured``,
            ``counterfactual``, ``low`` and ``high`` of the 95 % interval.

        Raises:
            InterventionError: The intervention was refused.
            UnknownOption: The run or the control step does not exist, or the intervention has a
                time.
        """
        import pandas as pd

        recorded = self.runs[whole_number("run", run, least=0, most=len(self.runs) - 1)]
        whole_number("at", at, least=0, most=len(recorded.commands) - 1)
        if has_times(do):
            raise UnknownOption("do", do, ("interventions without a time: at= says when",))
        rng = np.random.default_rng(whole_number("seed", seed, least=0))
        along = self.sensitivities / np.sqrt(self.discount)
        spread = spread_of(along)
        away = rng.multivariate_normal(
            np.zeros(len(self.scaled)), spread, whole_number("draws", draws, least=2)
        )
        low, high = (np.array([getattr(t, end) for t in self.targets]) for end in ("low", "high"))
        scaled = np.vstack([self.scaled, np.clip(self.scaled + away, low, high)])
        windows = windows_of(self.runs, self.window)
        mine = [w for w, one in enumerate(windows) if one.run == run]
        with Shooting(self.asked, self.runs, self.columns, self.targets) as shooting:
            shooting.spans, moved = self.spans, shooting.moved
            starts = [
                [moved(self.starts[w], self.found[w].slopes @ (one - self.scaled)) for w in mine]
                for one in scaled
            ]
            which = [windows[w] for w in mine]
            plain, other = shooting.replay(which, scaled, np.array(starts), do, at)
            plain = aligned(plain, recorded.values, shooting.rotations)
            found = recorded.values + aligned(other, plain, shooting.rotations) - plain
        tails = 0.5 * (1.0 - CONFIDENCE)
        ends = np.quantile(found[1:], (tails, 1.0 - tails), axis=0)
        time = recorded.begin + self.asked.options.control_period * recorded.instants
        parts = [
            pd.DataFrame(
                {
                    "time": time,
                    "column": column.name,
                    "measured": recorded.values[:, i],
                    "counterfactual": found[0, :, i],
                    "low": ends[0, :, i],
                    "high": ends[1, :, i],
                }
            )
            for i, column in enumerate(self.columns)
        ]
        return pd.concat(parts, ignore_index=True)

    # --- residuals ----------------------------------------------------------------------------

    @cached_property
    def residuals(self) -> pd.DataFrame:
        """Each measurement, by columns and instants.

        Columns are ``run``, ``window``, ``time`` [s], ``column``, ``measured``, ``fitted``,
        ``residual`` (measured minus fitted) and ``scaled`` (in standard deviations of the noise).
        """
        import pandas as pd

        dt, (row, column) = self.asked.options.control_period, _measured(self.runs)
        run = np.concatenate([np.full(len(r.instants), i) for i, r in enumerate(self.runs)])
        time = np.concatenate([r.begin + dt * r.instants for r in self.runs])
        measured = np.concatenate([r.values for r in self.runs])[row, column]
        residual = self.residual * self.noise[column]
        names = np.array([one.name for one in self.columns])[column]
        about = {"run": run[row], "window": self._windows, "time": time[row], "column": names}
        kinds = {"measured": measured, "fitted": measured - residual, "residual": residual}
        found = pd.DataFrame({**about, **kinds, "scaled": self.residual})
        return found.iloc[np.argsort(column, kind="stable")].reset_index(drop=True)

    @styled
    def picture(self, run: int | None = None) -> Figure:
        """Draw the measurements of a run, the fit in its windows, and the residuals.

        Without a number of a run they are drawn one after another. Of many columns, these are the
        eight with the largest ``misfit``.
        """
        rows, end = self.residuals.copy(), -np.inf
        if run is not None:
            run = whole_number("run", run, least=0, most=len(self.runs) - 1)
            rows = rows[rows.run == run]
        for _, part in rows.groupby("run"):
            begin = part.time.min()
            shift = end - begin if begin < end else 0.0
            rows.loc[part.index, "time"] += shift
            end = part.time.max() + shift
        worst = sorted(self.misfit, key=self.misfit.__getitem__)[-DRAWN:]
        names = [column.name for column in self.columns if column.name in worst]
        figure = blank(9.0, 0.6 + 2.2 * len(names))
        figure.set_layout_engine("constrained")
        axes = figure.subplots(len(names), 2, squeeze=False, sharex=True)
        drawn = (column for column in self.columns if column.name in names)
        for (left, right), column in zip(axes, drawn, strict=True):
            mine = rows[rows.column == column.name]
            left.plot(mine.time, mine.measured, ".", color=PALETTE[0], markersize=2.5)
            for _, part in mine.groupby("window"):
                left.plot(part.time, part.fitted, color=PALETTE[1], linewidth=1.0)
            right.plot(mine.time, mine.scaled, ".", color=PALETTE[0], markersize=2.5)
            right.axhline(0.0, color=PALETTE[1], linewidth=1.0)
            left.set(title=column.name, ylabel=column.unit, xlabel="time [s]")
            right.set(title="residual", ylabel="standard deviations", xlabel="time [s]")
        return figure


def fit(
    world: Any,
    recording: Any,
    parameters: Any,
    *,
    noise: Any = None,
    window: int | None = None,
    progress: Progress | None = None,
) -> Fit:
    """Fit parameters to a recording; see ``World.fit``."""
    runs, columns, targets = arguments_of(world, recording, parameters, window)
    count, number = len(_measured(runs)[1]), len(targets)
    known = noise_of(noise, columns, runs)
    usual = (WINDOW, SHORT, WINDOW) if window is None else (window,)
    for attempt, rows in enumerate(usual, 1):
        with Fitting(world, runs, columns, targets, known, rows) as problem:
            states = len(problem.shooting.free)
            complete = {c.variable for c in columns} >= {*world.compiled.slices}
            if count < number + (0 if complete else states):
                needed = number + states * len(windows_of(runs, rows))
                allowed = (f"at least {needed} measurements for {number} parameters",)
                raise UnknownOption("recording", f"{count} measurements", allowed)
            first = problem.search(range(number))
            if first.joined or attempt == len(usual):
                found = problem.fit(range(number), first=first, progress=progress)
                if attempt != 2 or max(found.misfit.values()) < CLEAR:
                    break
    return dataclasses.replace(found, shortened=attempt == 2)


def arguments_of(
    world: Any, recording: Any, parameters: Any, window: int | None
) -> tuple[tuple[RecordedRun, ...], tuple[MeasuredNumber, ...], tuple[Target, ...]]:
    """Check and read the arguments of a fit."""
    if window is not None:
        whole_number("window", window, least=2)
    if getattr(world.composition.commands, "_drawn", None):
        problem = "the step function draws noise in each step, which a recording does not contain"
        raise ModelError([f"{problem}: leave noise= out, and the residuals have it"])
    with twins_of(world).twin() as twin:
        twin.reset(seed=0)
        runs, columns = runs_of(twin, recording)
        targets = targets_of(twin, parameters)
    check_units(world, runs, columns)
    return runs, columns, targets


class Minimum(NamedTuple):
    """Least squares of segments, which are joined in windows, linearised there.

    Attributes:
        scaled: All scaled parameters, shape (p,).
        starts: Start state of each segment.
        made: The windows, linearised.
        squares: Squared residuals of each window, shape (w,).
        gaps: Squared gaps of each window, scaled, shape (w,).
        smooth: Whether the linearised residuals have a minimum there.
    """

    scaled: Floats
    starts: list[Floats]
    made: list[LinearWindow]
    squares: Floats
    gaps: Floats
    smooth: bool

    @property
    def errors(self) -> Floats:
        """Standard errors of the fitted parameters, scaled, with their prior."""
        return np.sqrt(np.diag(spread_of(np.concatenate([one.projected[1] for one in self.made]))))


class Result(NamedTuple):
    """A minimum with all segments joined, and how it was found.

    Attributes:
        at: The minimum.
        noise: Standard deviation of the noise of each column, shape (columns,).
        loss: -2 log likelihood but for a constant, with noise that is not given at its best.
        smooth: Whether every search for it ended where the linearised residuals have a minimum.
        joined: Whether joined segments explain the recording if segments on their own do.
        first: The minimum of all segments on their own.
    """

    at: Minimum
    noise: Floats
    loss: float
    smooth: bool
    joined: bool
    first: Minimum

    @property
    def scaled(self) -> Floats:
        """All scaled parameters, shape (p,)."""
        return self.at.scaled

    def like(self, other: Result, active: Sequence[int]) -> bool:
        """Return whether it is the same minimum of the active parameters as another one."""
        far = np.abs(self.scaled - other.scaled)[[*active]] / other.at.errors
        return abs(self.loss - other.loss) < SAME and bool((far < NEAR).all())


@final
class Fitting:
    """A recording, and the batch of twins that simulates it with any of some parameters."""

    def __init__(
        self,
        world: Any,
        runs: tuple[RecordedRun, ...],
        columns: tuple[MeasuredNumber, ...],
        targets: tuple[Target, ...],
        noise: Floats,
        window: int | None,
    ) -> None:
        self._what = world, runs, columns
        self.targets, self._window = targets, window or WINDOW
        self._low, self._high = (
            np.array([getattr(t, e) for t in targets]) for e in ("low", "high")
        )
        self._known, self._least = np.isfinite(noise), _least(runs)
        self.noise = np.where(self._known, noise, np.maximum(_roughness(runs), self._least))
        self._windows = [[window] for window in windows_of(runs, self._window)]
        self.shooting = Shooting(world, runs, columns, targets)
        self._joined = [segments_of(window) for (window,) in self._windows]
        self._segments = [segment for group in self._joined for segment in group]
        self._guess = [*self.shooting.guess(self._segments)]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.shooting.__exit__()

    def know(self, noise: Floats) -> None:
        """Take a noise as given."""
        self.noise, self._known = np.maximum(noise, self._least), np.full(len(noise), True)

    def fit(
        self,
        active: Sequence[int],
        *,
        first: Result | None = None,
        progress: Progress | None = None,
    ) -> Fit:
        """Fit some of the parameters, the others at their defaults.

        Intervals are checked along the profile of the likelihood.

        Args:
            active: Numbers of the parameters.
            first: The first search, if it was made.
            progress: Called after each search.
        """
        best = self.repeated(active, first or self.search(active), progress=progress)
        found = self.described(active, best)
        if len(active):
            found = dataclasses.replace(found, reach=self._profile(best, [*active], found))
        if progress is not None:
            progress(SEARCHES, SEARCHES)
        return found

    def search(
        self,
        active: Sequence[int],
        begin: Result | None = None,
        *,
        values: Any = (),
        thorough: bool = True,
        enough: float = np.inf,
    ) -> Result:
        """Search a minimum from a fit of other parameters, or from the measurements.

        Args:
            active: Numbers of the parameters.
            begin: The fit of other parameters.
            values: Scaled values of the active ones to begin with; those of ``begin`` if empty.
            thorough: Whether poorly fitted windows get other start states, and the minimum is
                precise.
            enough: Squared residuals above which the search is given up. Shorter windows fit
                better, so it would not come below when they are joined.
        """
        scaled, starts = np.zeros(len(self.targets)), self._guess
        if begin is not None:
            scaled, starts = begin.first.scaled.copy(), begin.first.starts
        if len(values):
            scaled[:] = 0.0
            scaled[[*active]] = values
        return self._search([*active], scaled, starts, self.noise, 2, thorough, enough)

    def repeated(
        self,
        active: Sequence[int],
        best: Result,
        *,
        same: bool = False,
        progress: Progress | None = None,
    ) -> Result:
        """Repeat a search from other starts until the best minimum was found twice.

        Where the residuals are smooth, it is not repeated.

        Args:
            active: Numbers of the parameters.
            best: The minimum that was found.
            same: Whether it was found again already.
            progress: Called after each search.
        """
        rng, active = np.random.default_rng(0), [*active]
        changed = np.abs(np.log(best.noise / self.noise)).max() > np.log(OTHER)
        for number in range(1, SEARCHES):
            if progress is not None:
                progress(number, SEARCHES)
            if same or (best.smooth and not changed):
                break
            far, scaled = np.maximum(2.0 * best.first.errors, ELSEWHERE), best.scaled.copy()
            scaled[active] += far * rng.normal(size=len(active))
            starts = self._guess if number % 2 else best.first.starts
            join = 2 + number % 2
            other = self._search(active, self._within(scaled), starts, best.noise, join, True)
            same = other.like(best, active) or (same and other.loss > best.loss)
            best = min(best, other, key=lambda one: one.loss)
        return best

    def descended(self, active: Sequence[int], best: Result, other: Result) -> Result:
        """Return the minimum that is reached from the start states of other parameters' minimum.

        It is not above that minimum if its parameters are among the active ones.
        """
        inside = {*np.flatnonzero(other.scaled).tolist()} <= {*active}
        at = best.at._replace(scaled=(other if inside else best).scaled, starts=other.at.starts)
        return self._settled([*active], best._replace(at=at), 0.0)

    def described(self, active: Sequence[int], best: Result) -> Fit:
        """Return the fit of some parameters at a minimum."""
        world, runs, columns = self._what
        targets = tuple(self.targets[i] for i in active)
        about = (world, runs, columns, targets, self._window, best.scaled[[*active]])
        states = np.array(best.at.starts), best.noise, self._known
        return Fit(*about, *states, tuple(self._certain(best, [*active])), self.shooting.spans)

    def _search(
        self,
        active: list[int],
        scaled: Floats,
        starts: list[Floats],
        noise: Floats,
        join: int,
        restarts: bool,
        enough: float = np.inf,
    ) -> Result:
        """Search a minimum: first of all segments on their own, then of more and more joined."""
        size, usual, smooth, first, alone = 1, None, True, None, 0.0
        while True:
            groups = [g[i : i + size] for g in self._joined for i in range(0, len(g), size)]
            rough = ROUGH[len(groups) == len(self._joined)]
            at = self._minimum(groups, noise, active, scaled, starts, rough)
            better = self._restarted(groups, noise, at, usual) if restarts else None
            if better is not None:
                at = self._minimum(groups, noise, active, at.scaled, better, rough)
            smooth &= at.smooth or size == 1
            if first is None:
                nearer = self._within_segments(at.made, noise)
                if np.abs(np.log(nearer / noise)).max() > np.log(OTHER):
                    noise = nearer
                    at = self._minimum(groups, noise, active, at.scaled, at.starts, rough)
                first, alone = at, float(at.squares.sum()) / _degrees(at.made)
            scaled, starts, squares = at.scaled, at.starts, float(at.squares.sum())
            counts = [len(group) for group in groups]
            usual = np.repeat(at.squares / counts, counts)
            if len(groups) == len(self._joined) or squares > enough:
                break
            size *= join
        joined = alone > UNJOINED or squares / _degrees(at.made) < UNJOINED
        begins = np.cumsum([0, *map(len, self._joined)])[:-1]
        at = at._replace(starts=[starts[i] for i in begins])
        found = Result(at, noise, squares, smooth, joined, first)
        if squares > enough:
            return found
        return self._settled(active, found, 0.0 if restarts else ROUGH[1])

    def _settled(self, active: list[int], found: Result, rough: float) -> Result:
        """Search a minimum of whole windows near another one, and the noise."""
        at, noise, smooth = found.at, found.noise, found.smooth
        column = _measured(self.shooting.runs)[1]
        for _ in range(ROUNDS):
            at = self._minimum(self._windows, noise, active, at.scaled, at.starts, rough)
            smooth &= at.smooth
            residual = np.concatenate([one.residual for one in at.made])
            squares, each = _by_column(column, residual**2, len(noise))
            size_of = noise * np.sqrt(squares / each * len(column) / _degrees(at.made))
            new = np.where(self._known, noise, np.maximum(size_of, self._least))
            if np.all(np.abs(new / noise - 1.0) < SETTLED):
                break
            noise = new
        sizes = np.maximum(squares * noise**2, self._least**2)
        loss = float(np.where(self._known, squares, each * np.log(sizes)).sum())
        return found._replace(at=at, noise=noise, loss=loss, smooth=smooth)

    def _within(self, scaled: Floats) -> Floats:
        return np.asarray(np.clip(scaled, self._low, self._high))

    def _within_segments(self, made: Sequence[LinearWindow], noise: Floats) -> Floats:
        """Return the noise of each column, from the median of its residuals in segments."""
        sizes = []
        for one, segment in zip(made, self._segments, strict=True):
            size = len(one.residual)
            free = size - len(one.fitted[1])
            if free and free >= 0.3 * size:
                column = self.shooting.measured(segment)[1]
                squares, each = _by_column(column, one.residual**2, len(noise))
                with np.errstate(invalid="ignore"):
                    sizes.append(squares / each * size / free)
        if not sizes:
            return noise
        times = np.nan_to_num(np.sqrt(np.nanmedian(sizes, axis=0)), nan=1.0)
        return np.where(self._known, noise, np.maximum(noise * times, self._least))

    # --- least squares ------------------------------------------------------------------------

    def _sizes(
        self,
        groups: Sequence[Sequence[Window]],
        noise: Floats,
        scaled: Floats,
        tried: Sequence[Sequence[Floats]],
    ) -> tuple[Floats, Floats, list[list[Floats]]]:
        """Return squared residuals and gaps of windows, (t, w) each, and the ends of segments.

        They are infinite where the world refuses the parameters.
        """
        segments, shooting = [segment for group in groups for segment in group], self.shooting
        squares, gaps = np.zeros((2, len(tried), len(groups)))
        pairs = [pair for starts in tried for pair in zip(segments, starts, strict=True)]
        try:
            simulated = iter(shooting.simulate([(one, scaled, start) for one, start in pairs]))
        except InterventionError:
            return squares + np.inf, gaps, [[] for _ in tried]
        ends: list[list[Floats]] = [[] for _ in tried]
        for t, starts in enumerate(tried):
            for w, group in enumerate(groups):
                for place, segment in enumerate(group):
                    values, end = next(simulated)
                    part = shooting.residual(segment, values, noise)
                    squares[t, w] += part @ part
                    if place:
                        gap = shooting.gap(ends[t][-1], starts[len(ends[t])])
                        gaps[t, w] += gap @ gap
                    ends[t].append(end)
        return squares, gaps, ends

    def _minimum(
        self,
        groups: Sequence[Sequence[Window]],
        noise: Floats,
        active: list[int],
        scaled: Floats,
        starts: Sequence[Floats],
        rough: float = 0.0,
        most: int = STEPS,
    ) -> Minimum:
        """Take Gauss-Newton steps of parameters and start states, which close the gaps of segments.

        Steps are chosen by the squared residuals and the squared gaps, with a weight that makes
        each step a descent.

        Args:
            groups: The segments of each window.
            noise: Standard deviation of each column, shape (columns,).
            active: Numbers of the parameters that are fitted.
            scaled: Scaled parameters to begin with, shape (p,).
            starts: Start state of each segment.
            rough: Relative precision of squared residuals and gaps, if it is not the last search.
            most: Largest number of steps.

        Source:
            Nocedal and Wright, *Numerical Optimization*, 2006, section 18.3: merit function and
            its weight.
        """
        shooting, segments = self.shooting, [segment for group in groups for segment in group]
        counts = np.array([len(group) for group in groups])
        owner = np.repeat(np.arange(len(groups)), counts)
        low, high, weights = self._low[active], self._high[active], np.zeros(len(groups))
        scaled, starts, made = scaled.copy(), [*starts], list[LinearWindow]()
        (squares,), (gaps,), (ends,) = self._sizes(groups, noise, scaled, [starts])
        slow, smooth = 0, False
        for number in range(most):
            made = shooting.linear(groups, scaled, starts, noise, active)
            parts = [one.projected for one in made]
            residual, along = (np.concatenate(each) for each in zip(*parts, strict=True))
            here = scaled[active]
            step = bounded(residual, along, here, low, high)
            left = np.array([((r + g @ step) ** 2).sum() for r, g in parts])
            least = 2.0 * (left - squares) / np.where(gaps > TINY, gaps, 1.0)
            weights = np.where(gaps > TINY, np.maximum(weights, least), weights)
            before = squares.sum() + weights @ gaps + (here**2).sum() / PRIOR**2
            after = left.sum() + ((here + step) ** 2).sum() / PRIOR**2
            near = max(PRECISION, rough * before)
            closed = bool((gaps <= rough**2 * counts).all())
            smooth = bool(before - after < near) and closed
            if smooth or slow > 1 or number == most - 1:
                break
            for share in SHARES:
                other, tried = scaled.copy(), []
                other[active] += share * step
                kinds = ((1.0, 0.0), (1.0, 1.0), (max(share, 0.1), 0.0))
                for part, damping in kinds[: 2 + (share < 1.0)]:
                    by = share * step / part
                    moves = [part * move for one in made for move in one.moved(by, damping)]
                    tried.append([*map(shooting.moved, starts, moves)])
                if share == 1.0:
                    tried.append(_following(segments, owner, starts, ends))
                all_squares, all_gaps, all_ends = self._sizes(groups, noise, other, tried)
                best = (all_squares + weights * all_gaps).argmin(axis=0)
                new = [each[best, np.arange(len(groups))] for each in (all_squares, all_gaps)]
                merit = new[0].sum() + weights @ new[1] + (other[active] ** 2).sum() / PRIOR**2
                if merit < before - 1e-4 * share * (before - after):
                    little = max(SLOW * near, HARDLY * (before - after))
                    slow = slow + 1 if before - merit < little and closed else 0
                    starts = [tried[best[w]][i] for i, w in enumerate(owner)]
                    ends = [all_ends[best[w]][i] for i, w in enumerate(owner)]
                    scaled, (squares, gaps) = other, new
                    break
            else:
                break
        return Minimum(scaled, starts, made, squares, gaps, smooth)

    def _restarted(
        self,
        groups: Sequence[Sequence[Window]],
        noise: Floats,
        at: Minimum,
        usual: Floats | None,
    ) -> list[Floats] | None:
        """Return start states, better ones where a window was fitted poorly; None if none are.

        Poorly fitted is a window with larger residuals than others have, or than its segments had
        before they were joined (``usual``). Others are drawn from the covariance of its start
        state, and wider.
        """
        shooting, k, made = self.shooting, len(self.shooting.free), at.made
        counts = np.array([max(len(one.residual), 1) for one in made])
        sizes = np.array([len(group) for group in groups])
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
            paths = [[shooting.moved(at.starts[firsts[w]], one)] for one in draws.T]
            squares = np.zeros(DRAWS)
            for segment in groups[w]:
                tasks = [(segment, at.scaled, path[-1]) for path in paths]
                for i, (values, end) in enumerate(shooting.simulate(tasks)):
                    part = shooting.residual(segment, values, noise)
                    squares[i] += part @ part
                    paths[i].append(np.where(np.isfinite(end), end, paths[i][-1]))
            closest = np.argsort(squares, kind="stable")[:CLOSEST]
            begin += [paths[i][:-1] for i in closest]
            owners += [w] * len(closest)
        if not owners:
            return None
        starts = [one for path in begin for one in path]
        tried = [groups[w] for w in owners]
        others = self._minimum(tried, noise, [], at.scaled, starts, ROUGH[0])
        found, best, place = [*at.starts], at.squares.copy(), 0
        for i, w in enumerate(owners):
            if others.squares[i] < best[w] and others.gaps[i] < CLOSED * sizes[w]:
                best[w] = others.squares[i]
                found[firsts[w] : firsts[w + 1]] = others.starts[place : place + sizes[w]]
            place += sizes[w]
        return found if (best < at.squares).any() else None

    def linearised(
        self, best: Result, step: float, *, whole: bool
    ) -> tuple[Floats, Floats, Floats]:
        """Linearise in all parameters at a minimum, with the start states at their best.

        Args:
            best: The minimum.
            step: Step of the differences by parameters, in scaled units.
            whole: Whether whole windows are linearised there; otherwise the segments on their own
                are, near the measurements, with their gaps closed.

        Returns:
            Scaled parameters (p,), residuals (n,) and their derivatives (n, p).
        """
        at, groups = (best.at, self._windows) if whole else (best.first, self._joined)
        about = groups, at.scaled, at.starts, self.noise, range(len(self.targets))
        parts = [one.projected for one in self.shooting.linear(*about, step=step)]
        residual, along = (np.concatenate(each) for each in zip(*parts, strict=True))
        return at.scaled, residual, along

    def _certain(self, best: Result, active: list[int]) -> list[LinearWindow]:
        """Return the linearised windows, or others over wide steps that determine less.

        Where an impact comes or goes within a small step, derivatives would be far too large.
        """
        made, linear = best.at.made, self.shooting.linear
        if best.smooth or not active:
            return made
        what = self._windows, best.at.scaled, best.at.starts, best.noise, active
        found = [made, *(linear(*what, step=one, of_states=one) for one in (WIDE, -WIDE))]
        chosen = []
        for each in zip(*found, strict=True):
            sizes = np.array([np.linalg.norm(one.projected[1]) for one in each])
            one = each[int(sizes.argmin())] if sizes.min() < LESS * sizes[0] else each[0]
            chosen.append(dataclasses.replace(one, residual=each[0].residual))
        return chosen

    def _profile(self, best: Result, active: list[int], found: Fit) -> Floats:
        """Return how far each interval reaches down and up, scaled, shape (p, 2).

        It is where the squared residuals, with all other parameters and the start states at their
        best, exceed those of the fit by as much as linearised ones do at the end of the interval;
        never less than there.

        Source:
            Bates and Watts, *Nonlinear Regression Analysis and Its Applications*, 1988, chapter 6.
        """
        linear, middle = found.linear_reach, best.at.scaled
        reach = np.repeat(linear[:, None], 2, axis=1)
        allowed = (linear / found.errors) ** 2 * found.discount
        for (place, i), side in itertools.product(enumerate(active), (0, 1)):
            if found.errors[place] > DETERMINED:
                continue
            limit = self._high[i] - middle[i] if side else middle[i] - self._low[i]
            along = (2 * side - 1) * found.covariance[:, place] / found.covariance[place, place]
            others = [j for j in active if j != i]
            near, far, ends = 0.0, linear[place], np.inf
            for _ in range(DOUBLINGS):
                if near >= limit:
                    break
                scaled = middle.copy()
                scaled[active] += far * along
                scaled = self._within(scaled)
                moves = [one.moved((scaled - middle)[active], 0.0)[0] for one in found.found]
                starts = [*map(self.shooting.moved, best.at.starts, moves)]
                ratio = 0.0  # of the further squared residuals to those allowed
                for most in (0, PROFILE):  # linear where the first simulation is as predicted
                    if not abs(ratio - 1.0) < LINEAR:
                        what = self._windows, best.noise, others, scaled, starts
                        squares = float(self._minimum(*what, most=most).squares.sum())
                        ratio = max(squares - found.squares, 0.0) / allowed[place]
                if 0.5 <= ratio < 1.5:
                    far /= ratio**0.5
                    break
                if ratio > 1.0:
                    ends = far
                else:
                    near = far
                if ends == linear[place]:
                    break
                far = 2.0 * far if ends == np.inf else 0.5 * (near + ends)
            reach[place, side] = max(far, linear[place])
        return reach


def _degrees(found: Sequence[LinearWindow]) -> int:
    """Return the degrees of freedom: measurements minus fitted parameters and start states."""
    free = [len(one.residual) - len(one.fitted[1]) for one in found]
    return max(sum(free) - int(found[0].parameters.shape[1]), 1)


def _measured(runs: Iterable[RecordedRun]) -> Any:
    """Return the row and the column of each measured number."""
    return np.nonzero(np.isfinite(np.concatenate([run.values for run in runs])))


def _by_column(column: Integers, values: Floats, n: int) -> tuple[Any, Any]:
    """Return the sum of the values of each column, and how many there are."""
    return np.bincount(column, values, minlength=n), np.bincount(column, minlength=n)


def _least(runs: Iterable[RecordedRun]) -> Floats:
    """Return the least noise of each column: rounding, and that of files and finite differences."""
    values = np.concatenate([run.values for run in runs])
    return np.asarray(np.maximum(FLOOR * np.nanstd(values, axis=0), FEW))


def _roughness(runs: Iterable[RecordedRun]) -> Floats:
    """Estimate the noise of each column from third differences, in which smooth motion vanishes."""
    found = list[float]()
    for each in zip(*(run.values.T for run in runs), strict=True):
        steps = np.concatenate([np.diff(one[np.isfinite(one)], n=3) for one in each])
        size = float(np.median(np.abs(steps))) if len(steps) > 3 else 0.0
        found.append(size / 0.6745 / np.sqrt(20.0))
    return np.array(found)


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
