"""Parameters from recordings: what they are, what explains a deviation, what would have been."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, final

import numpy as np

from scm_world._arguments import whole_number
from scm_world._types import Floats, Integers
from scm_world.errors import InterventionError, ModelError, UnknownOption
from scm_world.queries.designs import PRIOR, Experiment, suggested
from scm_world.queries.plans import has_times
from scm_world.queries.progress import Progress
from scm_world.queries.recordings import (
    MeasuredNumber,
    RecordedRun,
    aligned,
    noise_of,
    runs_of,
)
from scm_world.queries.shooting import (
    DELAY,
    STEP,
    WIDE,
    Derivatives,
    Shooting,
    Target,
    can_be_fitted,
    targets_of,
)
from scm_world.queries.twins import twins_of
from scm_world.runs.canvas import PALETTE, blank, styled
from scm_world.world import Simulation

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

WINDOW = 50
"""Default number of rows of a window."""

CONFIDENCE = 0.95
DETERMINED = 0.25
"""Largest standard error of a determined combination, in scaled units: a share of the value."""

SHORT = 10
"""Number of rows of short windows, or a little more."""

INSIDE = 0.05  # least distance of the beginning from the ends of the range, scaled
ROUNDS = 4  # of estimating the noise
SETTLED = 0.02  # relative change of the noise in the last round
FLOOR = 1e-6  # least noise, relative to the spread of a column
FEW = 1e-9  # least noise
MISFIT = 1.5  # least residual that the noise does not explain, in standard deviations of it
MAIN = 0.3  # least share of a parameter in a combination that is named
SETTLING = 6  # largest number of steps of the start states before parameters are fitted
CALLS = 60  # largest number of evaluations of one fit
PRECISION = 0.02  # of the sum of squared residuals, in variances of the noise
LESS = 0.9  # relative size of derivatives over a wide step that tells of an impact
ROUGH = 1e-3  # the same for the fit that another one begins with, relative
IMPROVING = 0.9  # a step of the start states that leaves more of the squares is the last one
TIE = 6.0
"""Largest difference of the BIC between explanations that a recording cannot tell apart."""

TIMESTEP = "timestep"
DRAWN = 8  # columns of a picture


@final
@dataclass(frozen=True, eq=False, repr=False)
class Fit:
    """Parameters that were fitted to a recording.

    Attributes:
        asked: The world, as it was asked; its default values are compared.
        runs: The recorded runs.
        columns: What was measured.
        targets: The fitted numbers.
        window: Number of rows of a window; None for whole runs.
        scaled: The fitted numbers, scaled, shape (p,).
        starts: Start state of each window, shape (w, size).
        noise: Standard deviation of the noise of each column, given or estimated, shape (columns,).
        given: Which of them were given, shape (columns,).
        found: Residuals and derivatives at the fit.

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
    window: int | None
    scaled: Floats
    starts: Floats
    noise: Floats
    given: Any
    found: Derivatives

    # --- parameters ---------------------------------------------------------------------------

    @property
    def values(self) -> dict[str, float]:
        """The fitted values, by name."""
        pairs = zip(self.targets, self.scaled, strict=True)
        return {target.name: float(target.value(number)) for target, number in pairs}

    @cached_property
    def world(self) -> Any:
        """A world with the fitted values, in every episode. A fitted delay is not part of it."""
        return self.asked.given(self._request())

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
    def _windows(self) -> Integers:
        """The number of the window of each residual."""
        sizes = list(map(len, self.found.states))
        return np.repeat(np.arange(len(sizes)), sizes)

    @cached_property
    def _pairs(self) -> tuple[Floats, Floats, Integers]:
        """Residuals of one column that follow one another in a window, (n,) each; the column."""
        _, column = _measured(self.runs)
        order = np.argsort(column, kind="stable")
        one, other = order[:-1], order[1:]
        same = (column[one] == column[other]) & (self._windows[one] == self._windows[other])
        residual = self.found.residual
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
        residual = self.found.residual
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
    def _discount(self) -> float:
        """Return by which factor correlated and too large residuals increase the variance.

        Consecutive residuals with correlation ρ have as much information as (1 - ρ) / (1 + ρ) times
        as many independent ones.
        """
        worst = max(self.misfit.values(), default=1.0)
        size = max(1.0, float((self.found.residual**2).sum()) / self.degrees)
        size = max(size, worst**2) if worst >= MISFIT else size
        one, other, _ = self._pairs
        total = float((self.found.residual**2).sum())
        rho = float((one * other).sum()) / total if total else 0.0
        rho = rho if rho > 2.0 / np.sqrt(len(self.found.residual)) else 0.0
        return size * (1.0 + rho) / max(1.0 - rho, 1e-3)

    @cached_property
    def _directions(self) -> tuple[Floats, Floats]:
        """Return singular values (p,) and directions (p, p) of the scaled sensitivities."""
        along = self.found.parameters
        padded = np.vstack([along, np.zeros((max(0, along.shape[1] - len(along)), along.shape[1]))])
        _, sizes, directions = np.linalg.svd(padded, full_matrices=False)
        return sizes, directions

    @cached_property
    def covariance(self) -> Floats:
        """Covariance of the scaled parameters, shape (p, p), without what is not determined at all.

        It is that of linearised least squares, times the discount for correlated residuals.
        """
        sizes, directions = self._directions
        errors = np.sqrt(self._discount) / np.maximum(sizes, 1e-12)
        return np.asarray((directions.T * errors**2) @ directions)

    @property
    def errors(self) -> Floats:
        """Standard errors of the scaled parameters, shape (p,)."""
        return np.sqrt(np.diag(self.covariance))

    @cached_property
    def table(self) -> pd.DataFrame:
        """The fitted parameters.

        A row has ``parameter``, ``value``, ``low`` and ``high`` of the 95 % interval, ``default``,
        ``deviation`` (value : default - 1; NaN if the default is zero), ``unit``, and whether the
        parameter is ``determined``: its standard error is at most a quarter of its value (of the
        usual size of such a parameter, if its default is zero).
        """
        import pandas as pd
        from scipy.special import stdtrit

        reach = float(stdtrit(self.degrees, 0.5 + 0.5 * CONFIDENCE)) * self.errors
        rows = []
        for target, number, error, far in zip(
            self.targets, self.scaled, self.errors, reach, strict=True
        ):
            value = float(target.value(number))
            ends = np.clip([number - far, number + far], target.low, target.high)
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
            error = float(np.sqrt(self._discount) / max(size, 1e-12))
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
        lost = 1.0 - len(self.found.residual) / (rows * len(self.columns))
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
        for name, size in self.misfit.items():
            if size >= MISFIT:
                said = f"the residuals of {name} are {size:.3g} times as large as its noise"
                found.append(f"{said}: no values of these parameters explain them")
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
        known = self.found.parameters / np.sqrt(self._discount)
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

        if whole_number("run", run, least=0) >= len(self.runs):
            raise UnknownOption("run", run, (f"0 to {len(self.runs) - 1}",))
        recorded = self.runs[run]
        if whole_number("at", at, least=0) >= len(recorded.commands):
            raise UnknownOption("at", at, (f"0 to {len(recorded.commands) - 1}",))
        if has_times(do):
            raise UnknownOption("do", do, ("interventions without a time: at= says when",))
        rng = np.random.default_rng(seed)
        along = self.found.parameters / np.sqrt(self._discount)
        spread = np.linalg.inv(along.T @ along + np.eye(len(self.scaled)) / PRIOR**2)
        away = rng.multivariate_normal(
            np.zeros(len(self.scaled)), spread, whole_number("draws", draws, least=2)
        )
        low, high = (np.array([getattr(t, end) for t in self.targets]) for end in ("low", "high"))
        scaled = np.vstack([self.scaled, np.clip(self.scaled + away, low, high)])
        moves = np.einsum("wkp,np->nwk", self.found.slopes, scaled - self.scaled)
        what = (self.asked, self.runs, self.columns, self.targets, self.window)
        with Shooting(*what) as shooting:
            shooting.starts = self.starts
            plain, other = shooting.replay(run, scaled, moves, do, at)
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
        residual = self.found.residual * self.noise[column]
        names = np.array([one.name for one in self.columns])[column]
        about = {"run": run[row], "window": self._windows, "time": time[row], "column": names}
        kinds = {"measured": measured, "fitted": measured - residual, "residual": residual}
        found = pd.DataFrame({**about, **kinds, "scaled": self.found.residual})
        return found.iloc[np.argsort(column, kind="stable")].reset_index(drop=True)

    @styled
    def picture(self, run: int | None = None) -> Figure:
        """Draw the measurements of a run, the fit in its windows, and the residuals.

        Without a number of a run they are drawn one after another. Of many columns, these are the
        eight with the largest ``misfit``.
        """
        rows, end = self.residuals.copy(), -np.inf
        rows = rows if run is None else rows[rows.run == run]
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
    window: int | None = WINDOW,
    progress: Progress | None = None,
) -> Fit:
    """Fit parameters to a recording; see ``World.fit``."""
    runs, columns, targets = _asked(world, recording, parameters, window)
    return _fit(world, runs, columns, targets, noise_of(noise, columns, runs), window, progress)


def _asked(
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
    return runs, columns, targets


def _fit(
    world: Any,
    runs: tuple[RecordedRun, ...],
    columns: tuple[MeasuredNumber, ...],
    targets: tuple[Target, ...],
    noise: Floats,
    window: int | None,
    progress: Progress | None = None,
) -> Fit:
    """Fit parameters and the start states of all windows, and estimate noise that is not known."""
    known = np.isfinite(noise)
    least, scaled = _least(runs), np.zeros(len(targets))
    now = np.where(known, noise, np.maximum(_roughness(runs), least))
    what = (world, runs, columns, targets)
    with Shooting(*what, window) as shooting:
        _, column = _measured(runs)
        count = len(column)
        needed = len(targets) + len(shooting.free) * len(shooting.windows)
        measured = {c.variable for c in columns}
        if count < len(targets) + (
            0 if measured >= {*world.compiled.slices} else len(shooting.free)
        ):
            allowed = (f"at least {needed} measurements for {len(targets)} parameters",)
            raise UnknownOption("recording", f"{count} measurements", allowed)
        starts = np.zeros((len(shooting.windows), len(shooting.free)))
        if short := _part(window):
            with Shooting(*what, short) as first:
                begin = np.zeros((len(first.windows), len(first.free)))
                scaled, begin = _Solver(first, now, begin).solve(scaled, rough=True)
                shooting.adopt(first, begin)
        left = np.inf
        for number in range(ROUNDS):
            solver = _Solver(shooting, now, starts)
            scaled, starts = solver.solve(scaled, settle=number == 0)
            residual = np.concatenate(shooting.residuals(scaled, starts, now))
            degrees = _degrees(solver.near)
            squares, each = _by_column(column, residual**2, len(columns))
            size = np.sqrt(squares / each * count / degrees)
            new = np.where(known, now, np.maximum(now * size, least))
            if progress is not None:
                progress(number + 1, ROUNDS)
            before, left = left, float(residual @ residual)
            improving = left < IMPROVING * before and bool((size[known] >= MISFIT).any())
            if not improving and np.all(np.abs(new / now - 1.0) < SETTLED):
                break
            now = new
        found = _least_certain(
            [shooting.derivatives(scaled, starts, now, step=step) for step in (STEP, WIDE, -WIDE)]
        )
        vectors = np.array([shooting.start(w, one) for w, one in enumerate(starts)])
    return Fit(world, runs, columns, targets, window, scaled, vectors, now, known, found)


def _least_certain(found: Sequence[Derivatives]) -> Derivatives:
    """Return the first derivatives, or in a window others that determine the parameters less.

    Where an impact comes or goes within a small step, the first ones would be far too large.
    """
    ends = np.cumsum([len(part) for part in found[0].states])[:-1]
    parts = [np.split(one.parameters, ends) for one in found]
    sizes = np.array([[np.linalg.norm(part) for part in one] for one in parts])
    best = np.where(sizes.min(axis=0) < LESS * sizes[0], sizes.argmin(axis=0), 0).tolist()
    return Derivatives(
        found[0].residual,
        np.concatenate([parts[one][w] for w, one in enumerate(best)]),
        np.array([found[one].slopes[w] for w, one in enumerate(best)]),
        [found[one].states[w] for w, one in enumerate(best)],
    )


def _degrees(found: Derivatives) -> int:
    """Return the degrees of freedom: measurements minus fitted parameters and start states."""
    ranks = (np.linalg.matrix_rank(part) for part in found.states if len(part))
    free = int(found.parameters.shape[1]) + sum(map(int, ranks))
    return max(len(found.residual) - free, 1)


def _part(window: int | None) -> int:
    """Return the length of shorter windows, in which the residuals are nearly linear; 0 if none.

    Windows of this length divide the others. The fit of long windows begins with their fit.
    """
    parts = [n for n in range(SHORT, 2 * SHORT) if window is None or window % n == 0]
    return parts[0] if parts and (window is None or window > parts[0]) else 0


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


@final
class _Solver:
    """Least squares over parameters, with the start states of all windows at their best."""

    def __init__(self, shooting: Shooting, noise: Floats, starts: Floats) -> None:
        self._shooting, self._noise = shooting, noise
        self._tried = {b"": starts}
        self.near: Any = None

    def solve(
        self, scaled: Floats, *, settle: bool = True, rough: bool = False
    ) -> tuple[Floats, Floats]:
        """Return scaled parameters and start states of the least squares.

        With ``settle`` start states are fitted first, with the parameters as they are; with
        ``rough`` it ends early.
        """
        from scipy.optimize import least_squares

        ends = ("low", "high")
        low, high = (np.array([getattr(t, end) for t in self._shooting.targets]) for end in ends)
        begin = np.clip(scaled, low + INSIDE, high - INSIDE)
        size, self._tried[begin.tobytes()] = np.inf, self._tried[b""]
        for _ in range(SETTLING if settle or not len(scaled) else 1):
            self._derive(begin)
            self._first = self.residual(begin)
            before, size = size, float(self._first @ self._first)
            if not size < IMPROVING * before:
                break
        if len(scaled):
            near = PRECISION / len(self._first)  # the sum of squares is of this order
            near = max(near, ROUGH) if rough else near
            limits: Any = {"ftol": near, "xtol": 0.1 * near, "gtol": None, "max_nfev": CALLS}
            found = least_squares(
                self._again, begin, self._derivative, bounds=(low, high), **limits
            )
            begin = found.x
        return begin, self._tried[begin.tobytes()]

    def _again(self, scaled: Floats) -> Floats:
        """Return residuals, those of the beginning only once."""
        first, self._first = self._first, np.empty(0)
        return first if len(first) else self.residual(scaled)

    def residual(self, scaled: Floats) -> Floats:
        """Return the residuals, with the prior; infinite where the world cannot be simulated."""
        near = self.near
        starts = self._starts + np.einsum("wkp,p->wk", near.slopes, scaled - self._at)
        try:
            starts, parts = self._shooting.improved(scaled, starts, self._noise, near.states)
        except InterventionError:
            return np.full(len(near.residual) + len(scaled), np.inf)
        self._tried[scaled.tobytes()] = starts
        found = np.concatenate([*parts, scaled / PRIOR])
        return np.where(np.isfinite(found), found, np.inf)

    def _derive(self, scaled: Floats) -> None:
        self._at, self._starts = scaled.copy(), self._tried[scaled.tobytes()]
        self.near = self._shooting.derivatives(scaled, self._starts, self._noise)

    def _derivative(self, scaled: Floats) -> Floats:
        """Return the derivatives of the residuals; parameters are those of the last residuals."""
        if not np.array_equal(scaled, self._at):
            self._derive(scaled)
        return np.vstack([self.near.parameters, np.eye(len(scaled)) / PRIOR])


# --- explanations ---------------------------------------------------------------------------------


@final
@dataclass(frozen=True, eq=False, repr=False)
class Deviation:
    """Which parameters account for the deviation of a recording from the world.

    Attributes:
        fits: The fit of each candidate, by the names of its parameters; ``()`` is the world as it
            is.
    """

    fits: Mapping[tuple[str, ...], Fit]

    @cached_property
    def bic(self) -> dict[tuple[str, ...], float]:
        """The BIC of each candidate; residuals that none explains count as further noise."""
        sizes = {names: float((fit.found.residual**2).sum()) for names, fit in self.fits.items()}
        scale = max(1.0, min(size / self.fits[names].degrees for names, size in sizes.items()))
        return {
            names: sizes[names] / scale + len(fit.targets) * np.log(len(fit.found.residual))
            for names, fit in self.fits.items()
        }

    @cached_property
    def table(self) -> pd.DataFrame:
        """A row for each candidate, the best first.

        Columns are its ``parameters`` (``none`` for the world as it is), ``value`` and
        ``deviation`` of the first number, the ``explained`` share of the squared residuals that the
        noise does not explain (NaN if it explains all of them), ``bic`` as the difference from the
        best, and whether it is ``tied`` with the best.

        Source:
            Schwarz, *Estimating the dimension of a model*, Annals of Statistics 1978; a difference
            of 6 is strong evidence (Kass and Raftery, *Bayes factors*, JASA 1995).
        """
        import pandas as pd

        bic, none = self.bic, self.fits[()]
        sizes = {names: float((fit.found.residual**2).sum()) for names, fit in self.fits.items()}
        free, rows = 0.0 if none.explains else sizes[()] - none.degrees, []
        for names in sorted(self.fits, key=lambda each: bic[each]):
            targets, scaled = self.fits[names].targets, self.fits[names].scaled
            value = float(targets[0].value(scaled[0])) if targets else np.nan
            default = targets[0].default if targets else 0.0
            deviation = value / default - 1.0 if default else np.nan
            explained = min((sizes[()] - sizes[names]) / free, 1.0) if free > 0.0 else np.nan
            more = bic[names] - min(bic.values())
            words = " + ".join(names) or "none"
            rows.append((words, value, deviation, explained, more, bool(more < TIE)))
        columns = ["parameters", "value", "deviation", "explained", "bic", "tied"]
        return pd.DataFrame(rows, columns=columns)

    @property
    def best(self) -> tuple[str, ...]:
        """The best candidates: one, or several that the recording cannot tell apart.

        It is ``("none",)`` if nothing deviates.
        """
        return tuple(self.table.parameters[self.table.tied])

    @property
    def fit(self) -> Fit:
        """The fit of the best candidate."""
        words = self.table.parameters[0]
        return next(
            fit for names, fit in self.fits.items() if (" + ".join(names) or "none") == words
        )

    def __str__(self) -> str:
        best, table = self.best, self.table
        if "none" in best:
            said = "no parameter is needed: the world explains the recording as it is"
        elif len(best) > 1:
            said = f"the recording cannot tell apart {', '.join(best)}"
        else:
            said = f"{best[0]} accounts for {100.0 * table.explained[0]:.3g} % of the deviation"
        rows = table[: max(5, len(best))]
        rest = f"\n{len(table) - len(rows)} more candidates" * (len(rows) < len(table))
        return f"{said}\n{rows.to_string(index=False, float_format='{:.4g}'.format)}{rest}"

    __repr__ = __str__


def explain(
    world: Any,
    recording: Any,
    candidates: Any = None,
    *,
    most: int = 1,
    noise: Any = None,
    window: int | None = WINDOW,
    progress: Progress | None = None,
) -> Deviation:
    """Fit each candidate to a recording, and compare them; see ``World.explain``."""
    whole_number("most", most, least=1)
    runs, columns, _ = _asked(world, recording, (), window)
    with twins_of(world).twin() as twin:
        twin.reset(seed=0)
        asked = _acting(twin, columns) if candidates is None else candidates
        by_name: dict[str, list[Target]] = {}
        for target in targets_of(twin, asked):
            by_name.setdefault(target.variable, []).append(target)
    given, no_names = noise_of(noise, columns, runs), tuple[str, ...]()
    plain = _fit(world, runs, columns, (), given, window)
    now = plain.noise
    if np.isnan(given).any():  # consecutive residuals differ by noise, and little by deviations
        rough = np.fmin(_roughness(runs), plain.noise * plain.roughness)
        now = np.where(np.isnan(given), np.maximum(rough, _least(runs)), given)
    fits = {no_names: _fit(world, runs, columns, (), now, window)}
    best, done, total = no_names, 0, len(by_name) * most
    for _ in range(most):
        for name, targets in by_name.items():
            names = (*best, name)
            done += 1
            if name not in best:
                chosen = (target for one in best for target in by_name[one])
                fits[names] = _fit(world, runs, columns, (*chosen, *targets), now, window)
            if progress is not None:
                progress(done, total)
        bic = Deviation(fits).bic
        first = min(bic, key=lambda names: bic[names])
        if first == best:
            break
        best = first
    return Deviation(fits)


def _acting(world: Simulation, columns: Iterable[MeasuredNumber]) -> list[str]:
    """Return the parameters that act on a measured variable, and the delay of commands."""
    graph, measured = world.model, {column.variable for column in columns}
    found = [
        name
        for name in world.compiled.static_names
        if name != TIMESTEP and can_be_fitted(world, name)
        if not measured.isdisjoint(graph.descendants(name))
    ]
    return [*found, *((DELAY,) if world.compiled.n_actions else ())]
