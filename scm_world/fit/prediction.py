"""Predictions of recordings that a fit has not seen, beside those of the unfitted world."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, final

import numpy as np

from scm_world._arguments import real_number
from scm_world._types import Floats
from scm_world.errors import UnknownOption
from scm_world.fit.problem import SHORT, FitProblem, LeastSquares, by_column, windows_of
from scm_world.fit.recordings import Measurements
from scm_world.fit.search import gauss_newton
from scm_world.fit.shooting import Shooting
from scm_world.fit.thinning import thinned

if TYPE_CHECKING:
    import pandas as pd

    from scm_world.fit.result import Fit

DRAWS = 2000  # of windows, for the interval of a skill
ALL = "all"  # the row of all columns, each in its spread
FEWEST = 3  # windows of an interval


@final
@dataclass(frozen=True, eq=False, repr=False)
class Prediction:
    """Predicted measurements of windows that do not overlap, from their first ten rows.

    Attributes:
        ahead: How far the predictions reach [s].
        windows: A row for each window and column: ``run``, ``time`` [s] of its first predicted row,
            ``column``, ``rows``, and the root mean square of measured minus predicted by the
            ``fit``, by the ``unfitted`` world, and by a ``constant``, the last known row.
        units: The unit of each column.
        spread: Standard deviation of each column in the recording.
    """

    ahead: float
    windows: pd.DataFrame
    units: dict[str, str]
    spread: dict[str, float]

    @cached_property
    def table(self) -> pd.DataFrame:
        """A row for each column, and one for all of them, in their spread.

        It has root mean squares of measured minus predicted, of the ``fit``, the ``unfitted`` world
        and a ``constant``, and the ``skill`` (the share of the squares of the unfitted world that
        the fit does not leave) with ``low`` and ``high`` of its 95 % interval, by a bootstrap of
        windows. These are NaN for fewer than three windows.

        Source:
            Murphy, *Skill scores based on the mean square error and their relationships to the
            correlation coefficient*, Monthly Weather Review 1988.
        """
        import pandas as pd

        kinds, rng, found = ["fit", "unfitted", "constant"], np.random.default_rng(0), []
        rows = self.windows.copy()
        rows[kinds] = rows[kinds] ** 2
        whole = rows.assign(column=ALL)
        whole[kinds] = whole[kinds].div(rows.column.map(self.spread) ** 2, axis=0)
        for name, part in pd.concat([rows, whole]).groupby("column", sort=False):
            weighed = part[kinds].mul(part.rows, axis=0).assign(rows=part.rows)
            sums = weighed.groupby([part.run, part.time]).sum().to_numpy(float)
            drawn = sums[rng.integers(len(sums), size=(DRAWS, len(sums)))].sum(axis=1)
            sizes, ends = sums.sum(axis=0), [np.nan, np.nan]
            if len(sums) >= FEWEST:
                ends = np.quantile(1.0 - drawn[:, 0] / drawn[:, 1], (0.025, 0.975)).tolist()
            rms, skill = np.sqrt(sizes[:3] / sizes[3]), 1.0 - sizes[0] / sizes[1]
            found.append((name, self.units.get(str(name), "1"), *rms, skill, *ends))
        return pd.DataFrame(found, columns=["column", "unit", *kinds, "skill", "low", "high"])

    @property
    def better(self) -> bool:
        """Whether the fit predicts better than the unfitted world, beyond chance."""
        return bool(self.table.low.iloc[-1] > 0.0)

    def __str__(self) -> str:
        count = len(self.windows.drop_duplicates(["run", "time"]))
        said = "a window" if count == 1 else f"{count} windows that do not overlap"
        said += f", predicted up to {self.ahead:.3g} s ahead: "
        skill, low, high = self.table[["skill", "low", "high"]].iloc[-1]
        interval = f" [{low:.3g}, {high:.3g}]" * bool(np.isfinite(low))
        said += f"skill {skill:.3g}{interval}"
        if not self.better:
            few = f"fewer than {FEWEST} windows do not show whether it is better than"
            said += f", {'no better than' if interval else few} the unfitted world"
        table = self.table.to_string(index=False, float_format="{:.4g}".format, na_rep="none")
        return f"{said}\n{table}"

    __repr__ = __str__


def predicted(fit: Fit, measured: Measurements, ahead: float | None) -> Prediction:
    """Predict a recording in windows, from start states that are fitted to their first ten rows.

    Raises:
        UnknownOption: The recording has no window with a row to predict.
    """
    import pandas as pd

    rows = max(fit.window, 5 * SHORT) - SHORT
    measured = thinned(measured, max(1, round(_period(fit.measured) / _period(measured))))
    period = _period(measured)
    if ahead is not None:
        rows = round(real_number("ahead", ahead) / period)
    windows = [w for w in windows_of(measured.runs, SHORT + rows) if w.last - w.first > SHORT]
    if rows < 1 or not windows:
        allowed = (f"runs of more than {SHORT} rows: the first {SHORT} show where each begins",)
        raise UnknownOption("ahead", f"{rows} rows of {period:.4g} s", allowed)
    windows = [w._replace(last=min(w.last, w.first + SHORT + rows)) for w in windows]
    begun = [w._replace(last=w.first + SHORT) for w in windows]
    known = dict(zip((c.name for c in fit.columns), fit.noise, strict=True))
    noise = np.array([known.get(c.name, np.nan) for c in measured.columns])
    kinds, found = dict[str, list[Floats]](), list[pd.DataFrame]()
    with Shooting(fit.asked, measured, fit.targets) as shooting:
        problem = FitProblem(shooting, measured, fit.targets, noise)
        guess, plain = [*shooting.guess(begun)], np.ones(len(noise))
        squares = LeastSquares(problem, [[one] for one in begun], problem.noise, ())
        for kind, scaled in (("fit", fit.scaled), ("unfitted", np.zeros(len(fit.scaled)))):
            starts = gauss_newton(squares, scaled, guess).starts
            tasks = [(w, scaled, start) for w, start in zip(windows, starts, strict=True)]
            made = zip(windows, shooting.simulate(tasks), strict=True)
            kinds[kind] = [problem.residual(w, one.values, plain) for w, one in made]
        last = [
            np.tile(measured.runs[w.run].filled[w.first + SHORT - 1], (w.last - w.first, 1))
            for w in windows
        ]
        both = zip(windows, last, strict=True)
        kinds["constant"] = [problem.residual(w, values, plain) for w, values in both]
    for w, window in enumerate(windows):
        run = measured.runs[window.run]
        row, column = np.nonzero(np.isfinite(run.values[window.first : window.last]))
        later = row >= SHORT
        sums = [by_column(column[later], one[w][later] ** 2, len(noise)) for one in kinds.values()]
        count = sums[0][1]
        sizes = {
            k: np.sqrt(s / np.maximum(count, 1)) for k, (s, _) in zip(kinds, sums, strict=True)
        }
        time = run.begin + measured.control_dt * float(run.instants[window.first + SHORT])
        about = {"run": window.run, "time": time, "column": [c.name for c in measured.columns]}
        frame = pd.DataFrame({**about, "rows": count.astype(int), **sizes})
        found.append(frame[frame.rows > 0])
    units = {c.name: c.unit for c in measured.columns}
    spread = np.maximum(np.nanstd(measured.values, axis=0), measured.least)
    every = pd.concat(found, ignore_index=True)
    return Prediction(
        rows * period, every, units, dict(zip(units, map(float, spread), strict=True))
    )


def _period(measured: Measurements) -> float:
    """Return the usual distance of rows [s]."""
    steps = [int(run.instants[-1]) / max(len(run.instants) - 1, 1) for run in measured.runs]
    return measured.control_dt * max(float(np.median(steps)), 1.0)


def parted(measured: Measurements, share: float) -> tuple[Measurements, Measurements]:
    """Return the first rows of each run, and a share of the last ones.

    Raises:
        UnknownOption: The share is not between 0 and 1, or leaves too few rows.
    """
    parts, dt = [], measured.control_dt
    for run in measured.runs:
        cut = round((1.0 - share) * len(run.instants))
        if not 0.0 < share < 1.0 or cut < 2 or len(run.instants) - cut <= SHORT:
            allowed = (f"a share between 0 and 1 that leaves more than {SHORT} rows of each run",)
            raise UnknownOption("held_out", f"{share:g} of {len(run.instants)} rows", allowed)
        parts.append((run.part(0, cut, dt), run.part(cut, len(run.instants), dt)))
    first, last = zip(*parts, strict=True)
    size = len(measured.recorded)
    last = tuple(replace(run, values=run.values[:, :size]) for run in last)
    return replace(measured, runs=first), Measurements(last, measured.recorded, dt)
