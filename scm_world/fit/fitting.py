"""Fit parameters to a recording: read it, search the best minimum, and find the intervals."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import typed, whole_number
from scm_world._patterns import as_names
from scm_world._types import Floats
from scm_world.errors import ModelError, UnknownOption
from scm_world.fit.prediction import parted
from scm_world.fit.problem import (
    PRIOR,
    SHORT,
    STEP,
    WINDOW,
    FitProblem,
    LeastSquares,
    Minimum,
    Outlier,
    Search,
    spread_of,
    windows_of,
)
from scm_world.fit.recordings import (
    Begins,
    Measurements,
    Noise,
    Reading,
    Recording,
    begun,
    read_recording,
)
from scm_world.fit.result import CONFIDENCE, DETERMINED, Fit, away
from scm_world.fit.search import SAME, TINY, Minima, Result, gauss_newton
from scm_world.fit.shooting import Shooting
from scm_world.fit.targets import Target, acting, blocks_of, targets_of, twin_of
from scm_world.fit.thinning import thinned
from scm_world.fit.units import check_units, reading_of
from scm_world.queries.progress import Progress
from scm_world.queries.world import World

CLEAR = 1.2  # least misfit where shorter windows explain what usual ones do not
SEARCHED = 16  # searches before those of intervals, about
BLOCKS = 10  # of windows that follow one another, at most
APART = 2.0  # errors of another minimum, from which on an interval contains it
BETTER = 3  # minima that are found along a profile, at most
TRIALS = 12  # of an end of an interval, at most
NEARLY = 0.25  # of a distance with its squares, from which the end of an interval can be determined
RIDGE = 30.0  # times the error with all others known, of a parameter that others can replace
PEELS = 3  # times that outliers are left out
END = 0.1  # largest deviation of the root of the squares at an end of an interval, relative
ROUGHLY = 5, 0.3, 3  # trials, deviation and steps where the model is wrong; see ``covering``
OPEN = 300.0  # scaled distance up to which an end is searched
ALMOST = 0.01  # precision of the squares along a profile, in those at the end of an interval
PROFILE = 8  # largest number of steps at the end of an interval
MOVING = 0.1  # least share of what is known of a parameter in columns that move
LINEAR = 0.1  # largest deviation from the squares that linearised residuals have there, relative


@typed
def fit(
    world: World,
    recording: Recording,
    parameters: Iterable[str],
    *,
    noise: Noise = None,
    window: int | None = None,
    begins: Begins = None,
    held_out: float | None = None,
    setups: Sequence[Mapping[str, object]] | None = None,
    columns: Mapping[str, str] | None = None,
    ignore: Iterable[str] = (),
    symmetric: bool = False,
    thin: int | None = None,
    progress: Progress | None = None,
    search: Search = gauss_newton,
) -> Fit:
    """Fit parameters to a recording with any search; see ``World.fit`` and ``Search``."""
    world = world.for_fit(recording)
    how = window, begins, Reading(setups, columns, ignore), symmetric, thin
    measured, targets = arguments_of(world, recording, as_names(parameters), *how)
    measured, later = (measured, None) if held_out is None else parted(measured, held_out)
    count, number = len(measured.cells[0]), len(targets)
    known = measured.given(noise)
    usual = (WINDOW, SHORT, WINDOW) if window is None else (window,)
    searched, outliers, reports = dict[int, Result](), list[Outlier](), itertools.count(1)
    planned = SEARCHED + 2 * number

    def tell() -> None:
        if progress is not None:
            done = next(reports)
            progress(done, max(planned, done + 1))

    for attempt, rows in enumerate(usual, 1):
        with Shooting(world, measured, targets) as shooting:
            states = len(shooting.free)
            complete = {c.variable for c in measured.recorded} >= {*world.compiled.slices}
            if count < number + (0 if complete else states):
                needed = number + states * len(windows_of(measured.runs, rows))
                allowed = (f"at least {needed} measurements for {number} parameters",)
                raise UnknownOption("recording", f"{count} measurements", allowed)
            minima = Minima(FitProblem(shooting, measured, targets, known, rows), search, tell)
            try:
                first = searched.get(rows) or minima.found(range(number))
                for _ in range(0 if searched else PEELS):  # outliers hide others
                    problem, at = minima.problem, first.at if first.joined else first.first
                    windows = [*itertools.chain(*problem.windows)]
                    windows = windows if first.joined else problem.segments
                    new = problem.outliers(windows, at.scaled, at.starts)
                    if not new:
                        break
                    outliers += new
                    minima = Minima(minima.problem.without(new), search, tell)
                    first = minima.continued(range(number), first)
                    measured = minima.problem.measured
                searched[rows] = first
                if first.joined or attempt == len(usual):
                    found = fitted(minima, range(number), first)
                    if attempt != 2 or max(found.misfit.values()) < CLEAR:
                        others = [one.first for one in searched.values()]
                        others += [one.at for rest, one in searched.items() if rest != rows]
                        if attempt == 2 or not found.explains:
                            found = covering(minima, found, others)
                        break
            except KeyboardInterrupt:
                best = minima.best or minima.reached()
                if best is None:
                    raise
                found = described(minima, range(number), best._replace(smooth=True))
                found = dataclasses.replace(found, interrupted=True)
                break
    if progress is not None:
        done = next(reports)
        progress(done, done)
    more = "" if found.explains or found.interrupted else reading_of(world, measured)
    about: dict[str, Any] = {"later": later, "outliers": tuple(outliers), "reading": more}
    return dataclasses.replace(found, shortened=attempt == 2, **about)


def arguments_of(
    world: World,
    recording: Recording,
    parameters: Iterable[str] | None,
    window: int | None,
    begins: Begins = None,
    reading: Reading | None = None,
    symmetric: bool = False,
    thin: int | None = None,
) -> tuple[Measurements, tuple[Target, ...]]:
    """Check and read the arguments of a fit; all parameters that act on a measurement if None."""
    if window is not None:
        whole_number("window", window, least=2)
    if thin is not None:
        whole_number("thin", thin, least=1)
    if getattr(world.composition.commands, "_drawn", None):
        problem = "the step function draws noise in each step, which a recording does not contain"
        raise ModelError([f"{problem}: leave noise= out, and the residuals have it"])
    if late := ", ".join(dict.fromkeys(name for name, _ in world.plan.timed())):
        problem = f"the world is given {late} at a time, and a recording may begin at any"
        raise ModelError([f"{problem}: give values without a time"])
    with twin_of(world) as twin:
        measured = read_recording(twin, recording, reading)
        asked = acting(twin, measured.columns) if parameters is None else parameters
        targets = targets_of(twin, asked, symmetric=symmetric)
        check_units(world, measured)
        measured = begun(twin, thinned(measured, thin), begins)
    if any(target.values is not None and not target.values.any() for target in targets):
        with Shooting(world, measured, targets) as shooting:
            targets = shooting.seen(windows_of(measured.runs, SHORT))
    return measured, targets


def fitted(minima: Minima, active: Sequence[int], first: Result | None = None) -> Fit:
    """Fit some of the parameters of a problem, the others at their defaults.

    Intervals are checked along the profile of the likelihood.

    Args:
        minima: Finds minima of the problem.
        active: Numbers of the parameters.
        first: The first minimum, if it was searched.
    """
    problem = minima.problem
    best = first or minima.found(active)
    found = described(minima, active, best)
    about: dict[str, Any] = {"misfit": not found.explains or found.correlated}
    about["discount"] = found.discount
    for _ in range(BETTER):
        best = minima.repeated(active, best, **about)
        found = described(minima, active, best)
        reach, lower = _profile(minima, best, [*active], found)
        if lower is None:
            break
        best = minima.descended(active, best, lower)
    for other in best.others:  # as good as the best one
        distance = away(found, other[[*active]])
        margin = np.minimum(found.linear_reach, reach.max(axis=1))[:, None]
        reach = np.maximum(reach, np.array([-distance, distance]).T + margin)
    still, each = found.still[problem.measured.cells[1]], found.sensitivities**2
    shown = each[~still].sum(axis=0) >= MOVING * each.sum(axis=0)
    if not shown.all() and _usual(minima, best, active, found, shown):
        reach[~shown] = np.inf
    return dataclasses.replace(found, reach=reach, played=minima.played(best.at))


def _usual(
    minima: Minima, best: Result, active: Sequence[int], found: Fit, shown: NDArray[np.bool_]
) -> bool:
    """Return whether defaults of what no motion shows explain as much as the fit, by the BIC.

    Two more parameters count for the oscillations of which a search finds the nearest in noise.
    """
    scaled, others = best.at.scaled.copy(), np.array(active)[shown]
    scaled[np.array(active)[~shown]] = 0.0
    squares = LeastSquares(minima.problem, minima.problem.windows, best.noise, others.tolist())
    more = minima.search(squares, scaled, best.at.starts).squares.sum() - found.squares
    penalty = (np.count_nonzero(~shown) + 2) * np.log(len(found.residual))
    return bool(more < penalty * found.discount)


def covering(minima: Minima, found: Fit, others: Sequence[Minimum]) -> Fit:
    """Return a fit that leaves more than noise, with intervals of what parts of the recording say.

    They are not less than those of the sandwich estimator, by blocks in time. They contain the
    minima of both halves, and of windows of other lengths, that are farther away than their errors.

    Args:
        minima: Finds minima of the problem.
        found: The fit of all parameters.
        others: Minima of shorter or longer windows.

    Source:
        White, *Maximum likelihood estimation of misspecified models*, Econometrica 1982, and Liang
        and Zeger, *Longitudinal data analysis using generalized linear models*, Biometrika 1986:
        the sandwich estimator by blocks; Hausman, *Specification tests in econometrics*,
        Econometrica 1978: another estimate that is farther away than its error shows a wrong model.
    """
    from scipy.special import stdtrit

    problem, p, windows = minima.problem, len(found.scaled), len(found.found)
    reach, blocks = np.array(found.reach), np.array_split(np.arange(windows), min(BLOCKS, windows))
    if windows > 1:
        scores = np.array([along.T @ left for left, along in (w.projected for w in found.found)])
        sums = np.array([scores[one].sum(axis=0) for one in blocks]) @ found.into
        within = sums @ spread_of(found.reported)
        errors = np.sqrt((within**2).sum(axis=0) * len(blocks) / (len(blocks) - 1))
        far = stdtrit(len(blocks) - 1, 0.5 + 0.5 * CONFIDENCE) * errors
        reach = np.maximum(reach, far[:, None])
        for part in np.array_split(np.arange(windows), 2):
            groups, starts = [problem.windows[w] for w in part], [found.starts[w] for w in part]
            squares = LeastSquares(problem, groups, found.noise, range(p))
            others = [*others, minima.search(squares, found.scaled, starts)]
    for other in others:
        apart = np.abs(other.scaled - found.scaled) > APART * other.errors * found.discount**0.5
        for _, own in blocks_of(found.targets):
            apart[own] = apart[own].any()
        distance = away(found, other.scaled)
        reach = np.maximum(reach, np.array([-distance, distance]).T * apart[:, None])
    return dataclasses.replace(found, reach=reach)


def described(minima: Minima, active: Sequence[int], best: Result) -> Fit:
    """Return the fit of some parameters at a minimum, with linearised intervals."""
    problem, simulator = minima.problem, minima.problem.simulator
    targets = tuple(problem.targets[i] for i in active)
    about = simulator.world, problem.measured, targets, problem.window, best.at.scaled[[*active]]
    states = np.array(best.at.starts), best.noise, problem.given, problem.known
    found = tuple(minima.certain(best, active))
    return Fit(*about, *states, found, simulator.spans, ended=best.at.ended)


def _profile(
    minima: Minima, best: Result, active: list[int], found: Fit
) -> tuple[Floats, Minimum | None]:
    """Return how far each interval reaches down and up, scaled, shape (p, 2), or a better minimum.

    It is where the squared residuals, with all other parameters and the start states at their best,
    exceed those of the fit by as much as linearised ones do at the end of a linearised interval. It
    is infinite where they do not, up to the end of the range. Where impacts make the residuals
    rough, it is not less than the linearised one; that of parameters which cannot be distinguished
    is the linearised one, and so is that of an inertia, which is reported in other numbers.

    Source:
        Bates and Watts, *Nonlinear Regression Analysis and Its Applications*, 1988, chapter 6.
    """
    problem, linear, middle = minima.problem, found.linear_reach, best.at.scaled
    reach = np.repeat(np.where(linear < OPEN, linear, np.inf)[:, None], 2, axis=1)
    spread, alone = spread_of(found.sensitivities), np.linalg.norm(found.sensitivities, axis=0)
    trials, end, most = (TRIALS, END, PROFILE) if found.explains else ROUGHLY
    ridge = (found.errors > DETERMINED) & (found.errors * alone > RIDGE * found.discount**0.5)
    for (place, i), side in itertools.product(enumerate(active), (0, 1)):
        if ridge[place] or problem.targets[i].block is not None:
            continue
        limit = problem.high[i] - middle[i] if side else middle[i] - problem.low[i]
        along = (2 * side - 1) * spread[:, place] / spread[place, place]
        others = [j for j in active if j != i]
        allowed = (linear[place] / found.errors[place]) ** 2 * found.discount
        rough = ALMOST * allowed / max(found.squares, TINY)
        squares = LeastSquares(problem, problem.windows, best.noise, others, rough, most)
        least = 0.0 if best.smooth or found.errors[place] > DETERMINED else linear[place]
        far = min(max(linear[place], STEP), PRIOR)
        near, below, ends, above = 0.0, 0.0, np.inf, np.inf  # distances, and roots of the squares
        held = middle.copy(), best.at.starts  # at the nearer end
        for _ in range(trials):
            far = min(far, limit)
            scaled = middle.copy()
            scaled[active] += far * along
            scaled = problem.within(scaled)
            moves = [one.moved((scaled - middle)[active], 0.0)[0] for one in found.found]
            starts = [*map(problem.simulator.moved, best.at.starts, moves)]
            size = float(squares.sizes(scaled, [starts])[0].sum())
            more = size - found.squares
            if more > 0.5 * allowed and abs(more / allowed - 1.0) > LINEAR:  # not as predicted
                held[0][i] = scaled[i]
                other = float(squares.sizes(held[0], [held[1]])[0].sum())
                begin = held if other < size else (scaled, starts)
                size = min(size, other)
                if size < np.inf:
                    at = minima.search(squares, *begin)
                    scaled, starts, size = at.scaled, at.starts, float(at.squares.sum())
                    if size < found.squares - SAME:
                        return reach, at
            root = (max(size - found.squares, 0.0) / allowed) ** 0.5
            if root > 1.0:
                ends, above = far, root
                straight = near + (ends - near) * (1.0 - below) / (above - below)
            else:
                near, below, held = far, root, (scaled.copy(), starts)
                straight = near / max(root, NEARLY)
                if ends < np.inf:
                    straight = near + (ends - near) * (1.0 - below) / (above - below)
            if abs(root - 1.0) < end:
                ends = straight
                break
            if ends <= least or (root < 1.0 and far >= min(limit, OPEN)):
                break
            middling = (max(near, NEARLY * ends) * ends) ** 0.5
            far = straight if ends == np.inf or above * NEARLY < 1.0 else middling
        reach[place, side] = max(ends, least)
    return reach, None
