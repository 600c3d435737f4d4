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
from scm_world.fit.result import MISFIT, Fit, away
from scm_world.fit.search import SAME, TRUST, Minima, Result, bounded, gauss_newton
from scm_world.fit.shooting import Shooting
from scm_world.fit.targets import numbers_of
from scm_world.queries.progress import Progress
from scm_world.queries.world import World

if TYPE_CHECKING:
    import pandas as pd

TIE = 6.0  # largest difference of the BIC of explanations that a recording cannot tell apart
STEPS = STEP, 0.5, -0.5  # scaled steps of slopes; wide ones show a parameter without effect near
KEPT = 0.5  # least predicted gain of a set that is fitted, relative to the largest
SEVERAL = 6  # the first ones, which are fitted for such a gain although another one explains all
MANY = 12  # sets that are tried while none explains the recording: predictions are not certain then
ALIKE = 0.2  # share of what a candidate explains that its place is taken without, at most
ABANDON = 4.0  # times the least squared residuals, above which a search is given up
CLOSE = 1.5  # times the least squared residuals, below which a fit is searched thoroughly
FEW = 3  # sets with parameters that are, at most
TURNS = 3  # largest number of exchanges of start states
SHOWN = 5  # candidates that are listed

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
        untested: Candidates that change no measurement of the recording: nothing tests them.
        stopped: Whether the search was stopped (Ctrl-C); the rest is what was known by then.
    """

    fits: Mapping[Names, Fit]
    screened: Mapping[Names, Screened]
    untested: Names = ()
    stopped: bool = False

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
                    most = int((np.abs(away(fit, 0.0 * fit.scaled)) / fit.errors).argmax())
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
        if self.stopped:
            said = f"stopped before all searches were done; so far: {said}"
        if self.untested:
            names = ", ".join(self.untested[:SHOWN])
            names += f" and {len(self.untested) - SHOWN} more" * (len(self.untested) > SHOWN)
            said += f"\nno measurement of this recording changes with {names}: no test is possible"
        rows = table[: max(SHOWN, len(best))]
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
        first = minima.found((), thorough=False)
        if np.isnan(given).any():  # consecutive residuals differ by noise, little by deviations
            plain = described(minima, (), first)
            rough = np.fmin(problem.noise, plain.noise * plain.roughness)
            problem.know(np.where(np.isnan(given), rough, given))
            first = minima.found((), first, thorough=False)
        return _Comparison(minima, first, most, progress).run()


@final
class _Comparison:
    """The search for the set of candidates that accounts for a deviation.

    Args:
        minima: Finds minima of the recording.
        first: That of the world as it is.
        most: Largest number of candidates in a set.
        progress: Called after each linearisation and each search.
    """

    def __init__(self, minima: Minima, first: Result, most: int, progress: Progress | None) -> None:
        self._most, self._progress, self._done = most, progress, 0
        self._search, self._targets = minima, minima.problem.targets
        self._numbers: dict[str, list[int]] = {}
        for i, target in enumerate(self._targets):
            self._numbers.setdefault(target.variable, []).append(i)
        self._minima: dict[Names, Result] = {}
        self._fits: dict[Names, Fit] = {}
        self._given_up: dict[Names, Screened] = {}
        self._screened: dict[Names, Screened] = {}
        self._acting = np.zeros(len(self._targets), dtype=np.bool_)
        self._keep((), first)
        self._more = np.log(len(self._fits[()].residual))

    def run(self) -> Deviation:
        """Compare the sets; a Ctrl-C ends the search, and what is known by then is returned."""
        try:
            self._compare()
            best = self._found().chosen
            played = self._search.played(self._minima[best].at, self._minima[()].at)
        except KeyboardInterrupt:
            return replace(self._found(), untested=(), stopped=True)
        self._fits[best] = replace(self._fits[best], played=played)
        self._report(0)
        return self._found()

    def _compare(self) -> None:
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

    def _found(self) -> Deviation:
        numbers = self._numbers.items()
        untested = tuple(name for name, which in numbers if not self._acting[which].any())
        return Deviation(dict(self._fits), self._screened | self._given_up, untested)

    def _report(self, ahead: int) -> None:
        """Report that a linearisation or search is done, and how many are ahead for now."""
        self._done += 1
        if self._progress is not None:
            self._progress(self._done, self._done + ahead)

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

    def _slopes(self, names: Names) -> list[tuple[Floats, Floats, Floats]]:
        """Linearise at the minimum of a set, over a small and over wide steps.

        Over a small step, the friction of a joint that sticks has no effect.
        """
        minimum, whole, found = self._minima[names], self._fits[names].explains, []
        for ahead, step in enumerate(STEPS):
            found.append(self._search.linearised(minimum, step, whole=whole))
            self._acting |= found[-1][2].any(axis=0)
            self._report(len(STEPS) - 1 - ahead + min(MANY, len(self._numbers)))
        return found

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
        """Fit sets that may be better than the best one, or cannot be told apart from it.

        All sets are ranked by what is left in the linearisation. The first ones are fitted until
        one of them explains the recording; from then on those whose BIC may be as low, and those
        that take the place of a candidate of ``around`` with little more left.
        """
        done = self._fits.keys() | self._given_up.keys()
        new = [names for names in dict.fromkeys(sets) if names not in done]
        parts = {names: self._set({*around} & {*names}) for names in new}
        predicted = self._predicted(slopes, dict.fromkeys([around, *new, *parts.values()]))
        bic = {names: self._bic(names, size) for names, (size, _) in predicted.items()}
        gains = {names: bic[around] - bic[names] for names in new}
        most = max(gains.values(), default=0.0)
        for names in new:
            self._screened[names] = self._about(names, *predicted[names])
        for place, names in enumerate(sorted(new, key=bic.__getitem__)):
            least = min(fit.squares for fit in self._fits.values())
            lowest = min(self._bic(n, fit.squares) for n, fit in self._fits.items())
            margin = 0.0 if {*around} < {*names} else TIE
            size, scaled = predicted[names]
            open_ = not any(map(_explains, self._fits.values()))
            first = place < (MANY if open_ else SEVERAL)
            left, without = size - predicted[around][0], predicted[parts[names]][0]
            alike = {*around} > {*parts[names]} and left < ALIKE * (without - predicted[around][0])
            likely = bic[names] < lowest + margin or (first and gains[names] >= KEPT * most > 0.0)
            likely = likely or alike
            if not (likely or (open_ and first)):
                continue
            begin, enough = self._minima[around], ABANDON * least
            how: dict[str, Any] = {"thorough": False, "enough": enough}
            minimum = self._search.found(self._active(names), begin, values=scaled, **how)
            if minimum.loss <= enough:
                self._keep(names, minimum)
            else:
                at = minimum.at.scaled[self._active(names)]
                kept = self._given_up if likely else self._screened  # those may be tried again
                kept[names] = self._about(names, minimum.loss, at)
            self._report(max(0, min(MANY, len(new)) - place - 1))

    def _about(self, names: Names, size: float, scaled: Floats) -> Screened:
        """Return what the table has of a set that is not fitted."""
        active, most = self._active(names), int(np.abs(scaled).argmax())
        own = [self._targets[i] for i in active]
        value, target = float(numbers_of(own, scaled)[most]), own[most]
        return size, len(active), target.name, value, target.default

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
                self._report(len(few))
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
