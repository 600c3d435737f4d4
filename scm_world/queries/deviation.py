"""Explain the deviation of a recording: which parameters account for it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, final

import numpy as np

from scm_world._arguments import whole_number
from scm_world.queries.fitting import WINDOW, Fit, Problem, arguments_of
from scm_world.queries.progress import Progress
from scm_world.queries.recordings import MeasuredNumber, noise_of
from scm_world.queries.shooting import DELAY, can_be_fitted, targets_of
from scm_world.queries.twins import twins_of
from scm_world.world import Simulation

if TYPE_CHECKING:
    import pandas as pd

KEPT = 0.5  # least predicted gain of a candidate that is fitted, relative to the largest
FEWEST = 2  # candidates that are fitted at least
TIE = 6.0
"""Largest difference of the BIC between explanations that a recording cannot tell apart."""

TIMESTEP = "timestep"


@final
@dataclass(frozen=True, eq=False, repr=False)
class Deviation:
    """Which parameters account for the deviation of a recording from the world.

    Attributes:
        fits: The fit of each candidate, by the names of its parameters; ``()`` is the world as it
            is.
        screened: Candidates that were not fitted: squared residuals, and value and default of the
            first number, that a linearisation predicts. By that they gain less than half as much as
            the best candidate.
    """

    fits: Mapping[tuple[str, ...], Fit]
    screened: Mapping[tuple[str, ...], tuple[float, int, float, float]]

    @cached_property
    def bic(self) -> dict[tuple[str, ...], float]:
        """The BIC of each candidate; residuals that none explains count as further noise."""
        fits = self.fits.items()
        scale = max(1.0, min(fit.squares / fit.degrees for _, fit in fits))
        more = np.log(len(self.fits[()].residual))
        found = {names: fit.squares / scale + len(fit.targets) * more for names, fit in fits}
        rest = self.screened.items()
        return found | {names: size / scale + n * more for names, (size, n, *_) in rest}

    @cached_property
    def table(self) -> pd.DataFrame:
        """A row for each candidate, the best first.

        Columns are its ``parameters`` (``none`` for the world as it is), ``value`` and
        ``deviation`` of the first number, the ``explained`` share of the squared residuals that the
        noise does not explain (NaN if it explains all of them), ``bic`` as the difference from the
        best, whether it is ``tied`` with the best, and whether it was ``fitted``: a candidate that
        was not has the predictions of a linearisation.

        Source:
            Schwarz, *Estimating the dimension of a model*, Annals of Statistics 1978; a difference
            of 6 is strong evidence (Kass and Raftery, *Bayes factors*, JASA 1995).
        """
        import pandas as pd

        bic, none = self.bic, self.fits[()]
        free, rows = 0.0 if none.explains else none.squares - none.degrees, []
        for names in sorted(bic, key=lambda each: bic[each]):
            fitted = names in self.fits
            if fitted:
                fit = self.fits[names]
                size, value = fit.squares, next(iter(fit.values.values()), np.nan)
                default = fit.targets[0].default if names else 0.0
            else:
                size, _, value, default = self.screened[names]
            deviation = value / default - 1.0 if default else np.nan
            explained = min((none.squares - size) / free, 1.0) if free > 0.0 else np.nan
            more = bic[names] - min(bic.values())
            words = " + ".join(names) or "none"
            tied = bool(more < TIE) and fitted
            rows.append((words, value, deviation, explained, more, tied, fitted))
        columns = "parameters value deviation explained bic tied fitted"
        return pd.DataFrame(rows, columns=columns.split())

    @property
    def best(self) -> tuple[str, ...]:
        """The best candidates: one, or several that the recording cannot tell apart.

        It is ``("none",)`` if nothing deviates.
        """
        return tuple(self.table.parameters[self.table.tied])

    @property
    def fit(self) -> Fit:
        """The fit of the best candidate."""
        return self.fits[min(self.fits, key=lambda names: self.bic[names])]

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
        if self.screened:
            rest += f"\n{len(self.screened)} of {len(table)} candidates were only screened"
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
    """Fit candidates to a recording, and compare them; see ``World.explain``."""
    whole_number("most", most, least=1)
    runs, columns, _ = arguments_of(world, recording, (), window)
    with twins_of(world).twin() as twin:
        twin.reset(seed=0)
        asked = _acting(twin, columns) if candidates is None else candidates
        targets = targets_of(twin, asked)
    by_name: dict[str, list[int]] = {}
    for i, target in enumerate(targets):
        by_name.setdefault(target.variable, []).append(i)
    given, none = noise_of(noise, columns, runs), tuple[str, ...]()
    with Problem(world, runs, columns, targets, given, window) as problem:
        plain = problem.fit((), thorough=False)
        if np.isnan(given).any():  # consecutive residuals differ by noise, little by deviations
            rough = np.fmin(problem.noise, plain.noise * plain.roughness)
            problem.know(np.where(np.isnan(given), rough, given))
        fits = {none: problem.fit((), begin=problem.last, thorough=False)}
        results, screened = {none: problem.last}, dict[Any, Any]()
        best = none
        for number in range(most):
            chosen = [i for name in best for i in by_name[name]]
            rest = [name for name in by_name if name not in best]
            predicted = problem.screened(results[best], chosen, [by_name[name] for name in rest])
            without, sizes = predicted[0][0], dict(zip(rest, predicted[1:], strict=True))
            order = sorted(rest, key=lambda name: sizes[name][0])
            most_gained = without - sizes[order[0]][0] if order else 0.0
            for place, name in enumerate(order):
                size, scaled = sizes[name]
                names, which = (*best, name), [*chosen, *by_name[name]]
                least = min(fit.squares for fit in fits.values())
                likely = without - size >= KEPT * most_gained or size < least + TIE
                if place < FEWEST or likely:
                    fits[names] = problem.fit(which, begin=results[best], thorough=False)
                    results[names] = problem.last
                else:
                    first = targets[which[0]]
                    value = float(first.value(scaled[0]))
                    screened[names] = (size, len(which), value, first.default)
                if progress is not None:
                    progress(number * len(by_name) + place + 1, len(by_name) * most)
            bic = Deviation(fits, {}).bic
            first_names = min(bic, key=lambda names: bic[names])
            if first_names == best:
                break
            best = first_names
    return Deviation(fits, screened)


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
