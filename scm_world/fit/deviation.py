"""Explain the deviation of a recording: which parameters account for it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, final

import numpy as np

from scm_world._arguments import typed, whole_number
from scm_world._types import Floats
from scm_world.fit.fitting import arguments_of, described
from scm_world.fit.problem import STEP, FitProblem, Search
from scm_world.fit.recordings import Begins, Noise, Reading, Recording
from scm_world.fit.result import MISFIT, Fit
from scm_world.fit.search import SAME, TRUST, Minima, Result, bounded, gauss_newton
from scm_world.fit.shooting import Shooting
from scm_world.queries.progress import Progress
from scm_world.queries.world import World

if TYPE_CHECKING:
    import pandas as pd

TIE = 6.0  # largest difference of the BIC of explanations that a recording cannot tell apart
BROAD = 0.5  # scaled step of slopes that show a parameter without effect at its default
KEPT = 0.5  # least predicted gain of a set that is fitted, relative to the largest
FEWEST = 2  # sets that are fitted at least
MANY = 12  # the same while no fit explains the recording, so that predictions are not to be trusted
ABANDON = 4.0  # times the least squared residuals, above which a search is given up
CLOSE = 1.5  # times the least squared residuals, below which a fit is searched thoroughly
FEW = 3  # sets with parameters that are, at most
TURNS = 3  # largest number of exchanges of start states

Names = tuple[str, ...]
"""The parameters of a set of candidates; none of them for the world as it is."""

Screened = tuple[float, int, str, float, float]
"""Squared residuals, how many numbers; name, value and default of the one that deviates most."""


@final
@dataclass(frozen=True, eq=False, repr=False)
class Deviation:
    """Which parameters account for the deviation of a recording from the world.

    Attributes:
        fits: The fit of each candidate, by the names of its parameters; ``()`` is the world as it
            is.
        screened: Other candidates: squared residuals, how many numbers they have, and name, value
            and default of the one that deviates most. A linearisation predicts them, or the search
            was given up there, as they were far larger than the least ones although windows were
            cut into shorter ones.
    """

    fits: Mapping[Names, Fit]
    screened: Mapping[Names, Screened]

    @cached_property
    def bic(self) -> dict[Names, float]:
        """The BIC of each candidate; unexplained residuals count as further noise."""
        scale = min(self.fits.values(), key=lambda fit: fit.squares).discount
        more = np.log(len(self.fits[()].residual))
        fits = self.fits.items()
        found = {names: fit.squares / scale + len(fit.targets) * more for names, fit in fits}
        rest = self.screened.items()
        return found | {names: size / scale + n * more for names, (size, n, *_) in rest}

    @cached_property
    def determined(self) -> dict[Names, bool]:
        """Whether each parameter of a fitted candidate deviates: its default is excluded."""
        fits = self.fits.items()
        return {names: all(fit.deviates(name) for name in names) for names, fit in fits}

    @property
    def chosen(self) -> Names:
        """The determined candidate with the least BIC; ``()`` for the world as it is."""
        sure = (names for names, determined in self.determined.items() if determined)
        return min(sure, key=self.bic.__getitem__)

    @cached_property
    def table(self) -> pd.DataFrame:
        """A row for each candidate, the best first.

        Columns are its ``parameters`` (``none`` for the world as it is), the ``number`` of them
        that deviates most clearly, its ``value`` and ``deviation``, the ``explained`` share of the
        squared residuals that the noise does not explain (NaN if it explains all of them), ``bic``
        as the difference from the best, whether it is ``tied`` with the best, whether it is
        ``determined`` (a test of all numbers of each parameter excludes its default; others are
        never the best), and whether it was ``fitted``: others have the predictions of a
        linearisation, or residuals at which the search was given up.
        Where the best one leaves more than the noise, other minima may be missed, and all that
        leave less than four times as much are tied.

        Source:
            Schwarz, *Estimating the dimension of a model*, Annals of Statistics 1978; a difference
            of 6 is strong evidence (Kass and Raftery, *Bayes factors*, JASA 1995).
        """
        import pandas as pd

        bic, none, chosen = self.bic, self.fits[()], self.chosen
        explained_all = not chosen or _explains(self.fit)
        free, rows = 0.0 if none.explains else none.squares - none.degrees, []
        for names in sorted(bic, key=lambda each: (each != chosen, bic[each])):
            fitted, determined = names in self.fits, self.determined.get(names, False)
            if fitted:
                fit = self.fits[names]
                number, value, default, size = "", np.nan, 0.0, fit.squares
                if names:
                    most = int((np.abs(fit.scaled) / fit.errors).argmax())
                    target = fit.targets[most]
                    number, value, default = target.name, fit.values[target.name], target.default
            else:
                size, _, number, value, default = self.screened[names]
            deviation = value / default - 1.0 if default else np.nan
            explained = min((none.squares - size) / free, 1.0) if free > 0.0 else np.nan
            more = bic[names] - bic[chosen]
            close = not explained_all and determined and size < ABANDON * self.fit.squares
            tied = fitted and (more < (TIE if determined else 0.0) or close)
            words = " + ".join(names) or "none"
            rows.append(
                (words, number, value, deviation, explained, more, tied, determined, fitted)
            )
        columns = "parameters number value deviation explained bic tied determined fitted"
        return pd.DataFrame(rows, columns=columns.split())

    @property
    def best(self) -> tuple[str, ...]:
        """The best candidates: one, or several that the recording cannot tell apart.

        It is ``("none",)`` if nothing deviates, or if no candidate is determined.
        """
        return tuple(self.table.parameters[self.table.tied])

    @property
    def fit(self) -> Fit:
        """The fit of the best candidate."""
        return self.fits[self.chosen]

    def __str__(self) -> str:
        best, table, none = self.best, self.table, self.fits[()]
        if len(best) > 1:
            said = f"the recording cannot tell apart {', '.join(best)}"
        elif not self.chosen and none.explains:
            said = "no parameter is needed: the world explains the recording as it is"
        elif not self.chosen:
            said = "no candidate accounts for the deviation"
        elif none.explains:
            said = f"{best[0]} fits better than the world, which nearly explains the recording"
        else:
            said = f"{best[0]} accounts for {100.0 * table.explained[0]:.3g} % of the deviation"
        if self.chosen and not _explains(self.fit):
            said += (
                "; more than noise is left: something else deviates, too, or a minimum was missed"
            )
        rows = table[: max(5, len(best))]
        rest = f"\n{len(table) - len(rows)} more candidates" * (len(rows) < len(table))
        if self.screened:
            rest += f"\n{len(self.screened)} of {len(table)} candidates were not fitted"
        return f"{said}\n{rows.to_string(index=False, float_format='{:.4g}'.format)}{rest}"

    __repr__ = __str__


@typed
def explain(
    world: World,
    recording: Recording,
    candidates: Iterable[str] | None = None,
    *,
    most: int = 1,
    noise: Noise = None,
    window: int | None = None,
    begins: Begins = None,
    setups: Sequence[Mapping[str, object]] | None = None,
    columns: Mapping[str, str] | None = None,
    ignore: Iterable[str] = (),
    thin: int | None = None,
    progress: Progress | None = None,
    search: Search = gauss_newton,
) -> Deviation:
    """Fit candidates to a recording, and compare them; see ``World.explain`` and ``Search``."""
    most, world = whole_number("most", most, least=1), world.for_fit(recording)
    how = window, begins, Reading(setups, columns, ignore)
    measured, targets = arguments_of(world, recording, candidates, *how, thin=thin)
    given = measured.given(noise)
    with Shooting(world, measured, targets) as shooting:
        problem = FitProblem(shooting, measured, targets, given, window)
        minima = Minima(problem, search)
        if np.isnan(given).any():  # consecutive residuals differ by noise, little by deviations
            plain = described(minima, (), minima.found((), thorough=False))
            rough = np.fmin(problem.noise, plain.noise * plain.roughness)
            problem.know(np.where(np.isnan(given), rough, given))
        return _Comparison(minima, most, progress).run()


@final
class _Comparison:
    """The search for the set of candidates that accounts for a deviation.

    Args:
        minima: Finds minima of the recording.
        most: Largest number of candidates in a set.
        progress: Called after each fit.
    """

    def __init__(self, minima: Minima, most: int, progress: Progress | None) -> None:
        self._most, self._progress = most, progress
        self._search, self._targets = minima, minima.problem.targets
        self._numbers: dict[str, list[int]] = {}
        for i, target in enumerate(self._targets):
            self._numbers.setdefault(target.variable, []).append(i)
        self._minima: dict[Names, Result] = {}
        self._fits: dict[Names, Fit] = {}
        self._given_up: dict[Names, Screened] = {}
        self._screened: dict[Names, Screened] = {}
        self._keep((), minima.found((), thorough=False))
        self._more = np.log(len(self._fits[()].residual))

    def run(self) -> Deviation:
        """Fit sets that may be the best, and those that differ from the best in one candidate."""
        singles, seen = [(name,) for name in self._numbers], set[Names]()
        slopes, path = self._slopes(()), Names()
        for _ in range(self._most):  # the best set of one linearisation
            longer = [self._set({*path, *one}) for one in singles if one[0] not in path]
            predicted = self._predicted(slopes, [path, *longer])
            best = min(predicted, key=lambda names: self._bic(names, predicted[names][0]))
            if best == path:
                break
            path = best
        self._consider((), slopes, [*singles, path])
        while (best := self._found().chosen) not in seen:
            seen.add(best)
            if best:
                without = [{*best}, *({*best} - {name} for name in best)]
                near = [self._set({*one, *more}) for one in without for more in ((), *singles)]
                fewer = [names for names in near if 0 < len(names) <= self._most]
                self._consider(best, self._slopes(best), fewer)
            if self._found().chosen == best:
                self._search_thoroughly(best)
        best = self._found().chosen
        played = self._search.played(self._minima[best].at.scaled)
        self._fits[best] = replace(self._fits[best], played=played)
        return self._found()

    def _found(self) -> Deviation:
        return Deviation(dict(self._fits), self._screened | self._given_up)

    def _set(self, names: Iterable[str]) -> Names:
        """Return the set of some candidates, in the order of all of them."""
        return tuple(name for name in self._numbers if name in names)

    def _active(self, names: Names) -> list[int]:
        return [i for name in names for i in self._numbers[name]]

    def _bic(self, names: Names, squares: float) -> float:
        return squares + float(self._more) * len(self._active(names))

    def _keep(self, names: Names, minimum: Result) -> None:
        """Keep the minimum of a set."""
        self._minima[names] = minimum
        self._fits[names] = described(self._search, self._active(names), minimum)
        self._screened.pop(names, None)
        if self._progress is not None:
            done, most = len(self._fits), len(self._numbers) * self._most
            self._progress(min(done, most), most)

    def _slopes(self, names: Names) -> list[tuple[Floats, Floats, Floats]]:
        """Linearise at the minimum of a set, over a small and over wide steps.

        Over a small step, the friction of a joint that sticks has no effect.
        """
        minimum, whole = self._minima[names], self._fits[names].explains
        steps, linearised = (STEP, BROAD, -BROAD), self._search.linearised
        return [linearised(minimum, step, whole=whole) for step in steps]

    def _predicted(
        self, slopes: Sequence[tuple[Floats, Floats, Floats]], sets: Iterable[Names]
    ) -> dict[Names, tuple[float, Floats]]:
        """Predict squared residuals and scaled parameters of sets, those of the best slopes.

        Source:
            Rao, *Large sample tests of statistical hypotheses concerning several parameters*,
            Proceedings of the Cambridge Philosophical Society 1948: the score test.
        """
        problem, found = self._search.problem, dict[Names, tuple[float, Floats]]()
        for scaled, residual, along in slopes:
            for names in sets:
                which = self._active(names)
                out = [i for i in np.flatnonzero(scaled) if i not in which]
                begin = residual - along[:, out] @ scaled[out]
                here, columns = scaled[which], along[:, which]
                ends = problem.low[which] - here, problem.high[which] - here
                step = bounded(begin, columns, *ends, TRUST)
                left = begin + columns @ step
                size = float(left @ left)
                if names not in found or size < found[names][0]:
                    found[names] = size, here + step
        return found

    def _consider(
        self, around: Names, slopes: Sequence[tuple[Floats, Floats, Floats]], sets: Iterable[Names]
    ) -> None:
        """Fit sets that may be better than the best one, or cannot be told apart from it."""
        done = self._fits.keys() | self._given_up.keys()
        new = [names for names in dict.fromkeys(sets) if names not in done]
        predicted = self._predicted(slopes, [around, *new])
        bic = {names: self._bic(names, size) for names, (size, _) in predicted.items()}
        gains = {names: bic[around] - bic[names] for names in new}
        most = max(gains.values(), default=0.0)
        for place, names in enumerate(sorted(new, key=bic.__getitem__)):
            least = min(fit.squares for fit in self._fits.values())
            lowest = min(self._bic(n, fit.squares) for n, fit in self._fits.items())
            margin = 0.0 if {*around} < {*names} else TIE
            likely = bic[names] < lowest + margin or gains[names] >= KEPT * most > 0.0
            active, (size, scaled) = self._active(names), predicted[names]
            explained = any(map(_explains, self._fits.values()))
            if likely or place < (0 if around else FEWEST) or (place < MANY and not explained):
                begin, enough = self._minima[around], ABANDON * least
                how: dict[str, Any] = {"thorough": False, "enough": enough}
                minimum = self._search.found(active, begin, values=scaled, **how)
                if minimum.loss <= enough:
                    self._keep(names, minimum)
                    continue
                size, scaled = minimum.loss, minimum.at.scaled[active]
            most = int(np.abs(scaled).argmax())
            target = self._targets[active[most]]
            value = float(target.value(scaled[most]))
            about = size, len(active), target.name, value, target.default
            (self._given_up if likely else self._screened)[names] = about

    def _search_thoroughly(self, best: Names) -> None:
        """Repeat the searches of the best and of the empty set, with each other's start states.

        So a set is never better than a larger one, or another one, by its start states alone.
        """
        least = CLOSE * self._fits[best].squares
        close = [names for names, fit in self._fits.items() if names and fit.squares < least]
        few = sorted(close, key=lambda n: self._bic(n, self._fits[n].squares))[:FEW]
        few += [()] * (self._fits[()].squares < least)
        if len(few) < 2 and _explains(self._fits[best]):
            return  # no other set is near
        fresh = {*few}
        for turn in range(TURNS):
            improved = set[Names]()
            for names in few:
                active, before, same = self._active(names), self._minima[names], False
                minimum = before
                for other in (one for one in few if one in fresh and one != names):
                    start = self._minima[other]
                    above = {*other} <= {*names} and start.loss < minimum.loss - SAME
                    if before.smooth and not above:
                        continue
                    found = self._search.descended(active, minimum, start.at)
                    same = found.like(minimum, active) or (same and found.loss > minimum.loss)
                    minimum = min(minimum, found, key=lambda one: one.loss)
                if not turn:
                    minimum = self._search.repeated(active, minimum, same=same)
                if minimum is not before:
                    self._keep(names, minimum)
                if minimum.loss < before.loss - SAME:
                    improved.add(names)
            fresh = improved
            if not improved:
                break


def _explains(fit: Fit) -> bool:
    """Return whether the residuals of all columns together are about as large as the noise."""
    return fit.squares < MISFIT**2 * fit.degrees
