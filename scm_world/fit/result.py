"""The result of a fit: values with intervals, residuals, remarks, and questions to it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import typed, whole_number
from scm_world._patterns import as_names
from scm_world._types import Floats, Integers
from scm_world.errors import ModelError, UnknownOption
from scm_world.fit.design import PROBES, Experiment, suggested, unseen
from scm_world.fit.diagnosis import Diagnosing, Diagnosis
from scm_world.fit.inertia import LOGS
from scm_world.fit.prediction import Prediction, predicted
from scm_world.fit.problem import (
    PRIOR,
    ROUNDING,
    SHORT,
    STEP,
    WINDOW,
    LinearWindow,
    Outlier,
    by_column,
    degrees,
    projected,
    residuals,
    spread_of,
    windows_of,
)
from scm_world.fit.recordings import (
    Limits,
    MeasuredNumber,
    Measurements,
    Reading,
    RecordedRun,
    at_rest,
    columns_of,
    read_recording,
)
from scm_world.fit.saving import saved
from scm_world.fit.shooting import Shooting
from scm_world.fit.targets import (
    FAR,
    Target,
    blocks_of,
    delays_of,
    drawn_of,
    free_states,
    numbers_of,
    posterior_of,
    ranges_of,
    twin_of,
    values_of,
)
from scm_world.fit.units import check_units
from scm_world.geometry.rotations import aligned
from scm_world.queries.progress import Progress
from scm_world.queries.world import World
from scm_world.runs.canvas import PALETTE, blank, styled
from scm_world.tasks.model import ModelTask
from scm_world.variables.interventions import Mechanism, has_times

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

CONFIDENCE = 0.95

DETERMINED = 0.25  # largest standard error of a determined combination: a share of the value
MISFIT = 1.5  # least residual that estimated noise does not explain, in standard deviations of it
EXCESS = 1.1  # the same of given noise, if it is significant
ALARM = 1e-3  # chance that given noise alone is significant in any column
SERIAL = 1e-2  # chance that independent noise has a significant correlation in any column
CORRELATED = 2.0  # standard errors of a correlation of residuals that is none of noise
AWAY = 0.5  # of the spread of a state in the recording, at which it is far from rest
WORSE = 1.1  # times the error of the unfitted world, with which a fit replays worse than it
LEFT = 0.5  # share of the variance within windows that a fit leaves which does not follow them
SHOWN = 5  # outliers that are named
SHARE = 0.01  # least one of an undetermined combination in a number without an interval
MAIN = 0.3  # least share of a parameter in a combination that is named
DRAWN = 8  # columns of a picture


@final
@dataclass(frozen=True, eq=False, repr=False)
class Fit:
    """Parameters that were fitted to a recording.

    Attributes:
        asked: The world that was fitted; fitted values are compared with its values.
        measured: The recording.
        targets: The fitted numbers.
        window: Number of rows of a window.
        scaled: The fitted numbers, scaled, shape (p,).
        starts: Start state of each window, shape (w, size).
        noise: Standard deviation of the noise of each column, given or estimated, shape (columns,).
        given: Columns whose noise was given, shape (columns,).
        known: Columns whose noise was known before the search, given or not, shape (columns,).
        found: The windows, linearised at the fit.
        spans: Size of a scaled unit of each free number of a start state, shape (k,).
        reach: How far the intervals reach down and up, scaled, those of an inertia in the numbers
            that are reported, shape (p, 2); None if linearised.
        shortened: Whether the windows are shorter than usual because segments did not join.
        ended: Whether the search took all its steps before it found a minimum.
        interrupted: Whether Ctrl-C ended the search; intervals are linearised, none is determined.
        played: See ``replay``, of the fit and the unfitted world, (2, columns).
        later: The rows that were held out.
        outliers: Measurements that were left out: no noise of the others leaves them.
        reading: Another reading of one column that the world follows far better, in words.

    Example:
        >>> from scm_world.queries import World
        >>> world = World(
        ...     "<mujoco><worldbody><body name='pole'>"
        ...     "<joint name='hinge' axis='0 1 0' damping='0.1'/>"
        ...     "<geom type='sphere' size='0.1' pos='0 0 1'/></body></worldbody></mujoco>"
        ... )
        >>> recorded = world.rollout(do={"hinge.damping": 0.3, "hinge.position": 1.0}, steps=60)
        >>> fit = world.fit(recorded, "hinge.damping")
        >>> fit.table[["parameter", "value", "default"]].round(3).to_dict("records")
        [{'parameter': 'hinge.damping', 'value': 0.3, 'default': 0.1}]
    """

    asked: World
    measured: Measurements
    targets: tuple[Target, ...]
    window: int
    scaled: Floats
    starts: Floats
    noise: Floats
    given: NDArray[np.bool_]
    known: NDArray[np.bool_]
    found: tuple[LinearWindow, ...]
    spans: Floats
    reach: Floats | None = None
    shortened: bool = False
    ended: bool = False
    interrupted: bool = False
    played: Floats | None = None
    later: Measurements | None = None
    outliers: tuple[Outlier, ...] = ()
    reading: str = ""

    @property
    def runs(self) -> tuple[RecordedRun, ...]:
        """The recorded runs."""
        return self.measured.runs

    @property
    def columns(self) -> tuple[MeasuredNumber, ...]:
        """The measured columns."""
        return self.measured.columns

    @property
    def values(self) -> dict[str, float]:
        """The fitted values, by name."""
        found = numbers_of(self.targets, self.scaled).tolist()
        return dict(zip((target.name for target in self.targets), found, strict=True))

    @cached_property
    def world(self) -> World:
        """A world with the fitted values, in every episode.

        A fitted delay becomes a delay of each command, in control steps
        (``motor.control_delay``), so that the world replays the recording.

        Raises:
            ModelError: A delay was fitted to a step function.
        """
        world, late = self.asked, delays_of(self.asked, self.targets, self.scaled)
        if late.any():
            build, (kind, task, options, _), *_ = world.__reduce__()
            if not isinstance(task, ModelTask):
                problem = f"its commands cannot be delayed by {late.max():.3g} control steps"
                raise ModelError([f"{problem}: delay them in the step function, or before it"])
            each = {n: late[at].max() for n, at in world.compiled.actions.items()}
            world = build(kind, task.delayed(each), options, None)
            world._given = self.asked._given
        return world.given(values_of(self.targets, self.scaled))

    @property
    def degrees(self) -> int:
        """Degrees of freedom: measurements minus fitted parameters and start states."""
        return degrees(self.found)

    @cached_property
    def residual(self) -> Floats:
        """Measured minus fitted by rows and columns, in standard deviations of the noise, (n,)."""
        return residuals(self.found)

    @cached_property
    def sensitivities(self) -> Floats:
        """Derivatives of the residuals by the scaled parameters, start states following, (n, p)."""
        return projected(self.found)[1]

    @cached_property
    def _windows(self) -> Integers:
        """The number of the window of each residual."""
        sizes = [len(one.residual) for one in self.found]
        return np.repeat(np.arange(len(sizes)), sizes)

    @cached_property
    def _pairs(self) -> tuple[Floats, Floats, Integers]:
        """Residuals of one column that follow one another in a window, (n,) each; the column."""
        _, column = self.measured.cells
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
        squares, count = by_column(column, (other - one) ** 2, len(self.columns))
        return np.sqrt(np.where(count > 0, squares / np.maximum(2 * count, 1), np.nan))

    @cached_property
    def misfit(self) -> dict[str, float]:
        """Root mean square of the residuals of each column, in standard deviations of its noise.

        Noise that was not known is judged by the ``roughness`` of the residuals.
        """
        residual = self.residual
        squares, count = by_column(self.measured.cells[1], residual**2, len(self.columns))
        size = np.sqrt(squares / count * len(residual) / self.degrees)
        own = np.maximum(self.roughness, self.measured.least / self.noise)
        size = np.where(self.known | np.isnan(own), size, np.sqrt(squares / count) / own)
        names = (column.name for column in self.columns)
        return dict(zip(names, map(float, size), strict=True))

    @cached_property
    def freedom(self) -> Floats:
        """Effective degrees of freedom: measurements of each column minus leverages, (columns,).

        Source:
            Hoaglin and Welsch, *The hat matrix in regression and ANOVA*, American Statistician
            1978: the leverages of linearised least squares; they sum to the fitted numbers.
        """
        left, sizes, _ = np.linalg.svd(self.sensitivities, full_matrices=False)
        each = (left[:, sizes > 1.0 / PRIOR] ** 2).sum(axis=1)
        each += np.concatenate([(one.fitted[0] ** 2).sum(axis=1) for one in self.found])
        return by_column(self.measured.cells[1], 1.0 - each, len(self.columns))[0]

    @cached_property
    def unexplained(self) -> tuple[str, ...]:
        """Columns whose residuals the noise does not explain.

        Residuals of given noise are too large if two facts hold. Their squares exceed the quantile
        of χ² which noise alone exceeds in one of a thousand fits, whatever the number of columns:
        few rows are no misfit by chance. And they are more than 1.1 times the noise: in thousands
        of rows χ² also rejects the rounding of an engine, a noise that is given 1 % too small, and
        every real machine. Noise that was not given is the root mean square of the residuals, which
        contains an error of the model. There residuals are too large if they are more than 1.1
        times their ``roughness``, and follow one another as those of independent noise do in one of
        a hundred fits; or if they are at least 1.5 times as large.
        """
        from scipy.special import chdtri, ndtri

        count = len(self.columns)
        squares = by_column(self.measured.cells[1], self.residual**2, count)[0]
        most = chdtri(np.maximum(self.freedom, 1.0), ALARM / count)
        size = np.array([*self.misfit.values()])
        alike = (self._correlation > -ndtri(SERIAL / count)) & (size > EXCESS)
        far = np.where(self.given, (squares > most) & (size > EXCESS), alike | (size >= MISFIT))
        return tuple(one.name for one, wrong in zip(self.columns, far, strict=True) if wrong)

    @property
    def explains(self) -> bool:
        """Whether no column is ``unexplained``, so that the model can be true."""
        return not self.unexplained

    @cached_property
    def _correlation(self) -> Floats:
        """Correlation of consecutive residuals of each column, in standard errors, (columns,).

        Source:
            von Neumann, see ``roughness``: of n pairs, the ratio has a standard deviation of about
            1 : √n.
        """
        squares, count = by_column(self.measured.cells[1], self.residual**2, len(self.columns))
        ratio = self.roughness**2 / np.maximum(squares / count, 1e-300)
        pairs = np.bincount(self._pairs[2], minlength=len(self.columns))
        return np.asarray((1.0 - ratio) * np.sqrt(pairs))

    @property
    def correlated(self) -> bool:
        """Whether consecutive residuals of a column are correlated, which noise is not."""
        return bool((self._correlation > CORRELATED).any())

    @cached_property
    def discount(self) -> float:
        """Return the factor by which correlated and too large residuals increase the variance.

        Consecutive residuals with correlation ρ have as much information as (1 - ρ) / (1 + ρ) times
        as many independent ones.
        """
        worst = max((self.misfit[name] for name in self.unexplained), default=1.0)
        size = max(1.0, self.squares / self.degrees, worst**2)
        one, other, _ = self._pairs
        rho = float((one * other).sum()) / self.squares if self.squares else 0.0
        rho = rho if rho > 2.0 / np.sqrt(len(self.residual)) else 0.0
        return size * (1.0 + rho) / max(1.0 - rho, 1e-3)

    @property
    def squares(self) -> float:
        """Sum of the squared residuals, in variances of the noise."""
        return float((self.residual**2).sum())

    def _directions(self, along: Floats) -> tuple[Floats, Floats]:
        """Return singular values (p,) and directions (p, p) of sensitivities, shape (n, p)."""
        padded = np.vstack([along, np.zeros((max(0, along.shape[1] - len(along)), along.shape[1]))])
        _, sizes, directions = np.linalg.svd(padded, full_matrices=False)
        return sizes, directions

    @cached_property
    def covariance(self) -> Floats:
        """Covariance of the reported numbers, shape (p, p), without undetermined directions.

        It is that of linearised least squares, times the discount for correlated residuals. Of an
        inertia some directions always are undetermined: the error of these is that of the prior.
        """
        sizes, directions = self._directions(self.reported)
        errors = np.sqrt(self.discount) / np.maximum(sizes, 1e-12)
        errors[self._open(sizes)] = PRIOR
        return np.asarray((directions.T * errors**2) @ directions)

    def _open(self, sizes: Floats) -> NDArray[np.bool_]:
        """Return which directions no measurement shows, if there are inertias, shape (p,).

        Their differences have errors, which noise does not hide where it is little.
        """
        least = max(np.sqrt(self.discount) / PRIOR, ROUNDING * sizes.max(initial=0.0))
        return np.asarray((sizes < least) & bool(blocks_of(self.targets)))

    @cached_property
    def units(self) -> Floats:
        """Sizes of the numbers of an inertia, see ``InertiaBlock.units``, and 1 of others, (p,)."""
        found = np.ones(len(self.scaled))
        for block, own in blocks_of(self.targets):
            found[own] = block.units(self.scaled[own])
        return found

    @cached_property
    def into(self) -> Floats:
        """Derivatives of the scaled numbers by those that are reported, shape (p, p).

        Reported are the ten parameters of an inertia in ``InertiaBlock.units``; others are as
        scaled. The differences are those of the sensitivities, so that both have one error.
        """
        found = np.eye(len(self.scaled))
        for block, own in blocks_of(self.targets):
            at, both = self.scaled[own], STEP * np.eye(10)
            steps = [block.numbers(at + one) - block.numbers(at - one) for one in both]
            slopes = np.array(steps).T / (2.0 * STEP * self.units[own, None])
            found[own, own] = np.linalg.inv(slopes)
        return found

    @cached_property
    def reported(self) -> Floats:
        """Derivatives of the residuals by the numbers that are reported, shape (n, p)."""
        return np.asarray(self.sensitivities @ self.into)

    @property
    def errors(self) -> Floats:
        """Standard errors of the numbers that are reported, scaled, shape (p,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def linear_reach(self) -> Floats:
        """How far the intervals of linearised least squares reach, scaled, shape (p,).

        Those of an inertia are of the reported numbers: motion is almost linear in these. They are
        infinite where an undetermined combination has a share.

        Source:
            Atkeson, An and Hollerbach, *Estimation of inertial parameters of manipulator loads and
            links*, International Journal of Robotics Research 1986: linear, and partly unseen.
        """
        from scipy.special import stdtrit

        found = stdtrit(self.degrees, 0.5 + 0.5 * CONFIDENCE) * self.errors
        sizes, directions = self._directions(self.reported)
        shares = np.linalg.norm(directions[self._open(sizes)], axis=0)
        inner = np.array([target.block is not None for target in self.targets], bool)
        return np.where(inner & (shares > SHARE), np.inf, found)

    @cached_property
    def table(self) -> pd.DataFrame:
        """The fitted parameters.

        A row has ``parameter``, ``value``, ``low`` and ``high`` of the 95 % interval, ``default``,
        ``deviation`` (value : default - 1; NaN if the default is zero), ``unit``, and whether the
        parameter is ``determined``: the width of its interval is at most its value or its scale
        (that of a positive parameter, a factor of e; that of an inertial one, see
        ``InertiaBlock.units``), or, where the fit explains the recording, the interval begins at
        the end of the range and is below the default: at most this. ``low`` and ``high`` are NaN
        where there is no interval: where it would be the whole range.
        """
        import pandas as pd

        linear = np.repeat(self.linear_reach[:, None], 2, axis=1)
        reach, rows = linear if self.reach is None else self.reach, []
        unsure = self.ended or self.interrupted or self.worse or self.aimless
        about = zip(self.targets, self.scaled, reach, self.values.values(), strict=True)
        for i, (target, number, (down, up), value) in enumerate(about):
            ends = np.array([number - down, number + up])
            open_ends = bool(ends[0] <= target.low), bool(ends[1] >= target.high)
            low, high = target.value(np.clip(ends, target.low, target.high))
            if target.log:
                low, high = 0.0 if ends[0] <= -FAR else low, np.inf if ends[1] >= FAR else high
                width, most = down + up, 1.0
            else:
                low, high = sorted((float(low), float(high)))
                width, most = (high - low) / target.scale, max(abs(value) / target.scale, 1.0)
            at_most = open_ends[0] and high <= target.default and self.explains
            determined = bool((width <= most or at_most) and not unsure)
            if target.block is not None:
                low, high = value - down * self.units[i], value + up * self.units[i]
                low = max(low, 0.0) if target.component in LOGS else low
                determined = bool(down + up <= 1.0 and not unsure)
                open_ends = (max(down, up) == np.inf,) * 2
            if all(open_ends):
                low, high, determined = np.nan, np.nan, False
            deviation = value / target.default - 1.0 if target.default else np.nan
            ends_of_it = (value, float(low), float(high), target.default)
            rows.append((target.name, *ends_of_it, deviation, target.unit, determined))
        names = ("value", "low", "high", "default", "deviation", "unit", "determined")
        return pd.DataFrame(rows, columns=["parameter", *names])

    @cached_property
    def identifiable(self) -> pd.DataFrame:
        """The combinations of parameters, the best determined first.

        A row has the ``singular_value`` of the sensitivities (change of the measurements in
        standard deviations of their noise by a scaled unit), the ``standard_error`` in scaled
        units, whether it is ``determined``, its main ``parameters``, and the ``combination`` in
        words. A scaled unit of a positive parameter is that of its logarithm: 0.1 is 10 %. That of
        another one is its value or its scale, whichever is larger; that of an inertial parameter
        is its size in ``InertiaBlock.units``.
        """
        import pandas as pd

        plain = [t.log or t.block is not None for t in self.targets]
        units = np.where(plain, 1.0, np.maximum(np.abs(self._sizes), 1.0))
        sizes, directions = self._directions(self.reported * units)
        rows, seen = [], ~self._open(sizes)
        for size, found, shown in zip(sizes, directions, seen, strict=True):
            error = float(np.sqrt(self.discount) / max(size, 1e-12))
            direction = found * np.sign(found[np.abs(found).argmax()])
            order = np.argsort(-np.abs(direction), kind="stable")
            main = [i for i in order if abs(direction[i]) >= MAIN]
            names = tuple(self.targets[i].name for i in main)
            words = " ".join(f"{direction[i]:+.2f} {self.targets[i].name}" for i in main)
            sure = bool(shown and error <= DETERMINED)
            rows.append((float(size), error, sure, names, words.removeprefix("+")))
        columns = ["singular_value", "standard_error", "determined", "parameters", "combination"]
        return pd.DataFrame(rows, columns=columns)

    @property
    def confounded(self) -> tuple[tuple[str, ...], ...]:
        """Groups of parameters that the recording cannot tell apart, or does not determine.

        They are the undetermined ones of each undetermined combination, and the others alone, in
        the order of the table.
        """
        rows, table = self.identifiable, self.table
        left = [*table.parameter[~table.determined]]
        groups = [
            tuple(n for n in left if n in names) for names in rows.parameters[~rows.determined]
        ]
        alone = ((name,) for name in left if not any(name in names for names in groups))
        return tuple(dict.fromkeys((*filter(None, groups), *alone)))

    @cached_property
    def unseen(self) -> tuple[str, ...]:
        """Parameters that change no measurement: here, and in other experiments that are tried."""
        names = [t.name for t, along in zip(self.targets, self._seen, strict=True) if not along]
        return unseen(self, names) if names else ()

    @property
    def _seen(self) -> NDArray[np.bool_]:
        """Whether each parameter changes a measurement of the recording, shape (p,)."""
        seen = np.any([np.abs(one.parameters).max(axis=0) for one in self.found], axis=0)
        for _, own in blocks_of(self.targets):
            seen[own] = seen[own].any()
        return np.asarray(seen)

    @property
    def _sizes(self) -> Floats:
        """Values of the fitted numbers in their scales, shape (p,)."""
        values = zip(self.values.values(), self.targets, strict=True)
        return np.array([value / target.scale for value, target in values])

    @typed
    def deviates(self, name: str) -> bool:
        """Return whether a test of all numbers of a parameter excludes its default.

        Raises:
            UnknownOption: It was not fitted.

        Source:
            Wald, *Tests of statistical hypotheses concerning several parameters when the number of
            observations is large*, Transactions of the American Mathematical Society 1943.
        """
        from scipy.special import fdtri

        known = [target.variable for target in self.targets]
        if name not in known:
            raise UnknownOption("fitted parameter", name, dict.fromkeys(known))
        mine = np.array([variable == name for variable in known])
        along, rest = self.sensitivities[:, mine], self.sensitivities[:, ~mine]
        if rest.shape[1]:
            along = along - rest @ np.linalg.lstsq(rest, along, rcond=None)[0]
        rank, moved = int(np.linalg.matrix_rank(along)), along @ self.scaled[mine]
        if not rank:
            return False
        ratio = float(moved @ moved) / self.discount / rank
        return ratio > float(fdtri(rank, self.degrees, CONFIDENCE))

    @cached_property
    def replay(self) -> pd.DataFrame:
        """Runs that are played from their first row, without measurements on the way.

        A row for each measured column, with its ``unit`` and the root mean square of measured
        minus played, by the ``fit``, by the ``unfitted`` world, and by a ``constant``, the mean of
        the column. Each begins with the start state with which it fits the first window best.
        """
        import pandas as pd

        columns = self.measured.recorded
        n = len(columns)
        mean = np.nanstd(self.measured.values, axis=0)[:n]
        fit, unfitted = np.full((2, n), np.nan) if self.played is None else self.played[:, :n]
        about = {"column": [c.name for c in columns], "unit": [c.unit for c in columns]}
        return pd.DataFrame({**about, "fit": fit, "unfitted": unfitted, "constant": mean})

    @property
    def _replayed(self) -> tuple[float, float]:
        """The errors of the replay of the fit and the unfitted world, in those of a constant.

        A column that no run has twice, such as a known start, shows no motion: it does not count.
        """
        seen = np.max([np.isfinite(run.values).sum(axis=0) for run in self.runs], axis=0)
        often = seen[: len(self.replay)] > 1
        often |= not often.any()
        size = np.maximum(self.replay.constant, self.measured.least[: len(self.replay)])[often]
        one, other = (
            ((self.replay[kind][often] / size) ** 2).mean() for kind in ("fit", "unfitted")
        )
        return float(one) ** 0.5, float(other) ** 0.5

    @property
    def worse(self) -> bool:
        """Whether the unfitted world replays the recording better than the fit and a constant."""
        fit, unfitted = self._replayed
        return unfitted < min(1.0, fit / WORSE)

    @cached_property
    def aimless(self) -> bool:
        """Whether a constant replays the recording better, and windows do not follow it either.

        The fit leaves half of the variance of the measurements around their mean in each window,
        from which start states of their own keep chaos and impacts away.
        """
        if not self._replayed[0] > WORSE:
            return False
        left, whole, _ = self._around
        return bool(np.mean(np.minimum(left / np.maximum(whole, 1e-300), 1.0)) > LEFT)

    @property
    def _around(self) -> tuple[Floats, Floats, Integers]:
        """Squares of each column that the fit leaves, and that means do, (columns,).

        The means are those of each column in each window; the third is how many each has.
        """
        (row, column), n = self.measured.cells, len(self.columns)
        values, where = self.measured.values[row, column], self._windows * n + column
        count = np.bincount(where)
        away = (values - (np.bincount(where, values) / np.maximum(count, 1))[where]) ** 2
        left, whole = (
            by_column(column, squares, n)[0]
            for squares in ((self.residual * self.noise[column]) ** 2, away)
        )
        means = np.bincount(np.flatnonzero(count) % n, minlength=n)
        return left, whole, means

    @property
    def still(self) -> NDArray[np.bool_]:
        """Columns that a constant in each window explains as well as the fit, shape (columns,).

        Source:
            Schwarz, *Estimating the dimension of a model*, Annals of Statistics 1978: each
            parameter more must reduce -2 log likelihood by the logarithm of the measurements. The
            fit has its parameters more, and a velocity at the start of each window.
        """
        left, whole, means = self._around
        count = by_column(self.measured.cells[1], self.residual, len(self.columns))[1]
        least = count * self.measured.least**2
        gain = count * np.log(np.maximum(whole, least) / np.maximum(left, least))
        more = len(self.scaled) + means
        return np.asarray((count > 0) & (gain < more * np.log(np.maximum(count, 2.0))))

    @typed
    def predict(
        self,
        recording: object,
        *,
        ahead: float | None = None,
        columns: Mapping[str, str] | None = None,
        ignore: Iterable[str] = (),
    ) -> Prediction:
        """Predict another recording, beside the world that was asked and a constant.

        It is cut into windows that do not overlap. The fitted and the unfitted world each begin
        where the first ten rows of a window show, and predict the others.

        Args:
            recording: The recording, of the kinds of ``World.fit``.
            ahead: How far to predict [s]; 40 rows if None, or as a window of the fit.
            columns: See ``World.fit``.
            ignore: See ``World.fit``.

        Raises:
            UnknownOption: No window has a row to predict.
            ModelError: The recording has faults, or is in degrees.
        """
        with twin_of(self.asked) as twin:
            how = Reading(None, columns, ignore)
            measured = read_recording(twin, recording, how)
        check_units(self.asked, measured)
        return predicted(self, measured, ahead)

    @property
    def spread(self) -> Floats:
        """Covariance of the scaled parameters, with a wide prior where nothing is known, (p, p)."""
        return spread_of(self.sensitivities / np.sqrt(self.discount))

    def posterior(self) -> dict[str, Mechanism]:
        """Return what the recording leaves open as an intervention that draws the parameters.

        They are drawn together, from the normal distribution of the scaled parameters that
        ``counterfactual`` uses, within their ranges: ``start=fit.posterior()`` of an environment
        randomises by what was not determined. A delay is not among them. Of an inertia the
        logarithms of the mass and of second moments, the center, and a turn of the axes are drawn.
        """
        targets, scaled, into = drawn_of(self.targets, self.scaled)
        along = self.sensitivities @ into / np.sqrt(self.discount)
        return posterior_of(targets, scaled, spread_of(along))

    @typed
    def diagnose(
        self, terms: str | Sequence[str] = "*", *, progress: Progress | None = None
    ) -> Diagnosis:
        """Find out what kind of error of the model leaves the residuals.

        Standard terms are added to the world one at a time, and fitted together with the
        parameters: gain, offset and lag of each sensor, delay of each command, Coulomb friction,
        one that falls with speed or grows with the torque, viscous damping, a spring, a torque
        offset, saturation, backlash and a flexible joint. The extended BIC compares them. They are
        tried in about 1000 rows, in windows that are spread over the recording.

        Args:
            terms: Names or patterns of the terms, such as ``"*friction*"``; all by default.
            progress: Called after each term. After Ctrl-C, the terms that were tried are returned.

        Raises:
            UnknownOption: No term of this world fits a pattern.
        """
        return Diagnosing(self, as_names(terms), progress).run()

    @typed
    def save(self, path: str | Path) -> None:
        """Write the fit to a file, as its ending says.

        ``.xml`` and ``.urdf`` are the file that the world was made from, with the fitted numbers;
        all else of it stays, comments too. It is read again before it is written, and all
        parameters are compared. A delay is no part of it. ``.yaml`` has the values with their
        intervals, the remarks and the replay. ``.html`` is a page with tables and
        traces.

        Raises:
            UnknownOption: The file has another ending.
            ModelError: The world was not made from a file, or a parameter is defined elsewhere than
                in its own element, so that it cannot be written there; nothing is written.
        """
        saved(self, Path(path))

    @cached_property
    def held_out(self) -> Prediction | None:
        """The prediction of the rows that were held out, if there are such rows."""
        return None if self.later is None else predicted(self, self.later, None)

    def __str__(self) -> str:
        table = self.table.to_string(index=False, float_format="{:.4g}".format, na_rep="none")
        parts = [table, *self.remarks]
        if self.played is not None:
            replay = self.replay.to_string(index=False, float_format="{:.4g}".format)
            parts.append(f"played from the first row, root mean square of the error:\n{replay}")
        if self.held_out is not None:
            parts.append(f"held out: {self.held_out}")
        return "\n".join(parts)

    __repr__ = __str__

    @property
    def read(self) -> str:
        """How much was recorded, in words."""
        rows = sum(len(run.instants) for run in self.runs)
        time = sum(int(run.instants[-1]) for run in self.runs) * self.measured.control_dt
        runs = "a run" if len(self.runs) == 1 else f"{len(self.runs)} runs"
        recorded = self.measured.recorded
        seen = np.isfinite(self.measured.values[:, : len(recorded)])
        lost = 1.0 - float(seen.mean())
        rest = f", {100.0 * lost:.2g} % not measured" * (lost > 0.0)
        columns = f"{len(recorded)} measured column" + "s" * (len(recorded) > 1)
        return f"{runs} of {rows} rows, {time:.4g} s, {columns}{rest}"

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences on undetermined parameters and on unexplained residuals."""
        found = self._about_search
        tried = f"no measurement of this recording, nor of {PROBES} experiments that were tried"
        found += [
            f"no experiment of this model seems to determine {name}: it changes {tried}"
            for name in self.unseen
        ]
        for run, row, column, value, off in sorted(self.outliers, key=lambda o: -abs(o.off))[
            :SHOWN
        ]:
            time = self.runs[run].begin + self.measured.control_dt * self.runs[run].instants[row]
            place = (
                f"row {row} ({time:.4g} s)"
                if self.measured.every == 1
                else f"the row at {time:.4g} s"
            )
            where = place + f" of run {run}" * (len(self.runs) > 1)
            found.append(
                f"{self.columns[column].name} = {value:.4g} in {where} is {off:.3g} from "
                f"the fit, {abs(off) / self.noise[column]:.3g} times the noise: it was left out"
            )
        if len(self.outliers) > SHOWN:
            found.append(f"{len(self.outliers)} measurements were left out; fit.outliers has all")
        found += [self.reading] * bool(self.reading)
        groups = [tuple(n for n in names if n not in self.unseen) for names in self.confounded]
        groups = [] if self.interrupted or self.worse or self.aimless else groups
        found += self._played
        for names in filter(None, groups):
            alone = len(names) == 1
            said = "is not determined" if alone else "cannot be told apart"
            found.append(
                f"{', '.join(names)} {said} by this recording; suggest(1), or --suggest 1 of the "
                f"command, has an experiment that does it"
            )
        if self.asked is not None and self.asked.substeps == 1:
            found += [
                f"{target.name}: a control step has one physics step, in which a delay that ends "
                "there is the mean of two commands"
                for target in self.targets
                if target.values is None
            ]
        ends = self.table[["low", "high"]].to_numpy(float)
        sure = self.table.determined.to_numpy(bool)
        about = zip(self.targets, self.scaled, ends, sure, strict=True)
        found += self._about_residuals + self._far_starts
        for target, number, (low, high), determined in about:
            positive = target.block is None
            if determined and positive and low <= target.value(target.low) < target.value(number):
                unit = f" {target.unit}" * (target.unit not in ("", "1"))
                found.append(f"{target.name} is at most {high:.3g}{unit}")
            near = 1e-3 * min(1.0, target.high - target.low)
            if min(number - target.low, target.high - number) < near < abs(number):
                found.append(f"{target.name} is at the end of its range")
        return tuple(found)

    @property
    def _about_search(self) -> list[str]:
        """Sentences on how the search ended, and on which rows."""
        found = list[str]()
        if self.ended:
            found.append("the search took all its steps before it found a minimum: others are left")
        if (every := self.measured.every) > 1:
            found.append(
                f"1 of {every} rows is used: lines between these show the motion (thin=1 uses all)"
            )
        if self.interrupted:
            found.append("interrupted: intervals are linearised, and no value is determined")
        return found

    @property
    def _about_residuals(self) -> list[str]:
        """Sentences on what the model does not explain."""
        found = list[str]()
        found += self._before
        for name in self.unexplained:
            size = self.misfit[name]
            said = f"the residuals of {name} are {size:.3g} times as large as its noise"
            shorter = f"; where bodies bump, window={SHORT} may" * (self.window != SHORT)
            began = "; or it did not begin as begins= says" * bool(self.measured.begins)
            found.append(f"{said}: no values that were found explain them{shorter}{began}")
        if self.reach is not None and (self.shortened or not self.explains):
            found.append(
                "the model leaves more than noise: intervals contain what each half of the "
                "recording and windows of other lengths say"
            )
        return found

    @property
    def _played(self) -> list[str]:
        """A sentence on a replay that is worse than that of the unfitted world or a constant."""
        none = "none of these values is determined"
        nearer = "is nearer to the recording than the fit"
        words = ""
        if self.interrupted:
            return []
        if self.worse:
            words = f"the unfitted world {nearer}: {none}"
        elif self.aimless:
            words = f"a constant {nearer}, and windows do not follow it either: {none}"
        elif self._replayed[0] > WORSE:
            words = f"a constant {nearer}, which does not predict that far ahead"
        return [f"played from the first row, {words}"] if words else []

    @property
    def _before(self) -> list[str]:
        """Sentences on commands before the first row, and on windows that are shorter for them."""
        late, found = 0.0, list[str]()
        if self.asked is not None:
            late = delays_of(self.asked, self.targets, self.scaled).max(initial=0.0)
        if late > 0.0 and any(run.before is None for run in self.runs):
            found.append(
                "what was sent before the first row is not known, and the first command is "
                f"assumed: if another one acted in the first {self.measured.control_dt * late:.3g} "
                "s of a run, leave its measurements empty there"
            )
        if self.shortened:
            found.append(
                f"windows of {WINDOW} rows do not explain the recording, those of {self.window} "
                f"do: there are impacts or chaos, or something acts that is not modelled"
                + ", such as commands before the first row"
                * bool(found)
            )
        return found

    @property
    def _far_starts(self) -> list[str]:
        """Sentences on runs that begin far from rest in what was not measured."""
        if self.asked is None:
            return []
        known, places = {c.variable for c in self.columns}, columns_of(self.asked)
        spans, found = np.full(self.starts.shape[1], np.inf), list[str]()
        spans[free_states(self.asked)] = self.spans
        for start, window in zip(self.starts, windows_of(self.runs, self.window), strict=True):
            run = self.runs[window.run]
            for name, rest in at_rest(self.asked, run).items() if not window.first else ():
                _, variable, component, unit = places[name]
                place = self.asked.compiled.where[variable].start + component
                if (
                    run.whole
                    and variable not in known
                    and abs(start[place] - rest) > AWAY * spans[place]
                ):
                    found.append(
                        f"run {window.run} begins at {name} = {start[place]:.3g} {unit}, which was "
                        f"not measured: if it was at rest, say so, begins='rest'"
                    )
        return found

    def suggest(
        self,
        n: int = 1,
        *,
        steps: int | None = None,
        limits: Limits | None = None,
        seed: int = 0,
        setups: Sequence[Mapping[str, object]] = (),
    ) -> tuple[Experiment, ...]:
        """Suggest experiments that determine the least determined parameters.

        Sequences of commands are drawn, half of them with their own start. The sequences after
        which the parameters would have the least variance are chosen. Simulated with the fitted
        values, they stay within all limits.

        Args:
            n: Number of experiments.
            steps: Control steps of an experiment; those of the longest run if None.
            limits: Ranges of commands, states or readouts by patterns of columns, such as
                ``{"elbow.velocity": (-2, 2)}``. The ranges of commands and joints always hold.
            seed: Seed of the sequences.
            setups: Set-ups that the machine may have, besides its own: values of parameters,
                ``[{"weight.mass": 1.0}]``. An experiment in one of them says so (``do``).

        Raises:
            UnknownOption: Limits exceed the range of a command, or every sequence leaves them.
            InterventionError: A set-up is refused.
            UnknownVariable: A pattern of limits fits no column.
        """
        longest = max(len(run.commands) for run in self.runs)
        count = longest if steps is None else steps
        known = self.reported / np.sqrt(self.discount)
        how: dict[str, Any] = {"steps": count, "limits": limits, "seed": seed, "setups": setups}
        return suggested(self, known, n, **how)

    def counterfactual(
        self, do: Mapping[str, object], *, at: int = 0, run: int = 0, draws: int = 40, seed: int = 0
    ) -> pd.DataFrame:
        """Return the measurements of a recorded run as they would be under an intervention.

        Abduction is the fit: its residuals are the noise of the sensors, and the differences
        between the start state of a window and the end of the window before come from causes that
        are not modelled. Both are added again, so that no intervention gives the recorded
        measurements. The interval is that of the parameters, which are drawn from
        the covariance of the fit (from its prior where the recording determines nothing), and of
        the start states, which are drawn given these. Ends are quantiles k : (n + 1) of n draws.

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
        away = rng.multivariate_normal(
            np.zeros(len(self.scaled)), self.spread, whole_number("draws", draws, least=2)
        )
        size = np.sqrt(self.degrees / rng.chisquare(self.degrees, (draws, 1)))  # Student's t
        away = self.scaled + size * away
        scaled = np.vstack([self.scaled, np.clip(away, *ranges_of(self.targets))])
        windows = windows_of(self.runs, self.window)
        mine = [w for w, one in enumerate(windows) if one.run == run]
        errors = dict[int, Floats]()  # of start states, given the parameters
        for w in mine:
            _, sizes, right = self.found[w].fitted
            free = size * rng.normal(size=(draws, len(sizes))) * np.sqrt(self.discount) / sizes
            errors[w] = np.vstack([np.zeros(right.shape[1]), free @ right])
        with Shooting(self.asked, self.measured, self.targets) as shooting:
            shooting.spans, moved = self.spans, shooting.moved
            starts = [
                [
                    moved(self.starts[w], self.found[w].slopes @ (one - self.scaled) + errors[w][i])
                    for w in mine
                ]
                for i, one in enumerate(scaled)
            ]
            which = [windows[w] for w in mine]
            plain, other = shooting.replay(which, scaled, np.array(starts), do, at)
            plain = aligned(plain, recorded.values, shooting.rotations)
            found = recorded.values + aligned(other, plain, shooting.rotations) - plain
        tails = 0.5 * (1.0 - CONFIDENCE)
        ends = np.quantile(found[1:], (tails, 1.0 - tails), axis=0, method="weibull")
        time = recorded.begin + self.measured.control_dt * recorded.instants
        names = [column.name for column in self.measured.recorded]
        about = {"time": np.tile(time, len(names)), "column": np.repeat(names, len(time))}
        kinds = {"measured": recorded.values, "counterfactual": found[0]}
        kinds |= {"low": ends[0], "high": ends[1]}
        values = {kind: kinds[kind][:, : len(names)].T.ravel() for kind in kinds}
        return pd.DataFrame({**about, **values})

    @cached_property
    def residuals(self) -> pd.DataFrame:
        """Each measurement, by columns and instants.

        Columns are ``run``, ``window``, ``time`` [s], ``column``, ``measured``, ``fitted``,
        ``residual`` (measured minus fitted) and ``scaled`` (in standard deviations of the noise).
        """
        import pandas as pd

        dt, (row, column) = self.measured.control_dt, self.measured.cells
        run = np.concatenate([np.full(len(r.instants), i) for i, r in enumerate(self.runs)])
        time = np.concatenate([r.begin + dt * r.instants for r in self.runs])
        measured = self.measured.values[row, column]
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
        names = [c.name for c in self.measured.recorded if c.name in worst]
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


def away(fit: Fit, other: Floats) -> Floats:
    """Return how far other scaled numbers are from those of a fit, in the numbers reported."""
    found = other - fit.scaled
    for block, own in blocks_of(fit.targets):
        found[own] = block.numbers(other[own]) - block.numbers(fit.scaled[own])
    return found / fit.units
