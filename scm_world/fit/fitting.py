"""Fit parameters to a recording: read it, search the best minimum, and find the intervals."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Sequence

import numpy as np

from scm_world._arguments import typed, whole_number
from scm_world._patterns import as_names
from scm_world._types import Floats
from scm_world.errors import ModelError, UnknownOption
from scm_world.fit.problem import SHORT, WINDOW, FitProblem, LeastSquares, Search, windows_of
from scm_world.fit.recordings import Measurements, Noise, Recording, read_recording
from scm_world.fit.result import DETERMINED, Fit
from scm_world.fit.search import SEARCHES, Minima, Result, gauss_newton
from scm_world.fit.shooting import Shooting
from scm_world.fit.targets import Target, acting, targets_of, twin_of
from scm_world.fit.units import check_units
from scm_world.queries.progress import Progress
from scm_world.queries.world import World

CLEAR = 1.2  # least misfit where shorter windows explain what usual ones do not
DOUBLINGS = 6  # of an interval, at most
PROFILE = 8  # largest number of steps at the end of an interval
LINEAR = 0.1  # largest deviation from the squares that linearised residuals have there, relative


@typed
def fit(
    world: World,
    recording: Recording,
    parameters: Iterable[str],
    *,
    noise: Noise = None,
    window: int | None = None,
    progress: Progress | None = None,
    search: Search = gauss_newton,
) -> Fit:
    """Fit parameters to a recording with any search; see ``World.fit`` and ``Search``."""
    world = world.for_fit(recording)
    measured, targets = arguments_of(world, recording, as_names(parameters), window)
    count, number = len(measured.cells[0]), len(targets)
    known = measured.given(noise)
    usual = (WINDOW, SHORT, WINDOW) if window is None else (window,)
    searched = dict[int, Result]()
    for attempt, rows in enumerate(usual, 1):
        with Shooting(world, measured, targets) as shooting:
            states = len(shooting.free)
            complete = {c.variable for c in measured.columns} >= {*world.compiled.slices}
            if count < number + (0 if complete else states):
                needed = number + states * len(windows_of(measured.runs, rows))
                allowed = (f"at least {needed} measurements for {number} parameters",)
                raise UnknownOption("recording", f"{count} measurements", allowed)
            minima = Minima(FitProblem(shooting, measured, targets, known, rows), search)
            first = searched[rows] = searched.get(rows) or minima.found(range(number))
            if first.joined or attempt == len(usual):
                found = fitted(minima, range(number), first, progress)
                if attempt != 2 or max(found.misfit.values()) < CLEAR:
                    break
    return dataclasses.replace(found, shortened=attempt == 2)


def arguments_of(
    world: World,
    recording: Recording,
    parameters: Iterable[str] | None,
    window: int | None,
) -> tuple[Measurements, tuple[Target, ...]]:
    """Check and read the arguments of a fit; all parameters that act on a measurement if None."""
    if window is not None:
        whole_number("window", window, least=2)
    if getattr(world.composition.commands, "_drawn", None):
        problem = "the step function draws noise in each step, which a recording does not contain"
        raise ModelError([f"{problem}: leave noise= out, and the residuals have it"])
    if late := ", ".join(dict.fromkeys(name for name, _ in world.plan.timed())):
        problem = f"the world is given {late} at a time, and a recording may begin at any"
        raise ModelError([f"{problem}: give values without a time"])
    with twin_of(world) as twin:
        measured = read_recording(twin, recording)
        asked = acting(twin, measured.columns) if parameters is None else parameters
        targets = targets_of(twin, asked)
    check_units(world, measured)
    return measured, targets


def fitted(
    minima: Minima,
    active: Sequence[int],
    first: Result | None = None,
    progress: Progress | None = None,
) -> Fit:
    """Fit some of the parameters of a problem, the others at their defaults.

    Intervals are checked along the profile of the likelihood.

    Args:
        minima: Finds minima of the problem.
        active: Numbers of the parameters.
        first: The first minimum, if it was searched.
        progress: Called after each search.
    """
    best = minima.repeated(active, first or minima.found(active), progress=progress)
    found = described(minima, active, best)
    if len(active):
        found = dataclasses.replace(found, reach=_profile(minima, best, [*active], found))
    if progress is not None:
        progress(SEARCHES, SEARCHES)
    return found


def described(minima: Minima, active: Sequence[int], best: Result) -> Fit:
    """Return the fit of some parameters at a minimum, with linearised intervals."""
    problem, simulator = minima.problem, minima.problem.simulator
    targets = tuple(problem.targets[i] for i in active)
    about = simulator.world, problem.measured, targets, problem.window, best.at.scaled[[*active]]
    states = np.array(best.at.starts), best.noise, problem.known
    return Fit(*about, *states, tuple(minima.certain(best, active)), simulator.spans)


def _profile(minima: Minima, best: Result, active: list[int], found: Fit) -> Floats:
    """Return how far each interval reaches down and up, scaled, shape (p, 2).

    It is where the squared residuals, with all other parameters and the start states at their best,
    exceed those of the fit by as much as linearised ones do at the end of the interval; never less
    than there.

    Source:
        Bates and Watts, *Nonlinear Regression Analysis and Its Applications*, 1988, chapter 6.
    """
    problem, linear, middle = minima.problem, found.linear_reach, best.at.scaled
    reach = np.repeat(linear[:, None], 2, axis=1)
    allowed = (linear / found.errors) ** 2 * found.discount
    for (place, i), side in itertools.product(enumerate(active), (0, 1)):
        if found.errors[place] > DETERMINED:
            continue
        limit = problem.high[i] - middle[i] if side else middle[i] - problem.low[i]
        along = (2 * side - 1) * found.covariance[:, place] / found.covariance[place, place]
        others = [j for j in active if j != i]
        squares = LeastSquares(problem, problem.windows, best.noise, others, most=PROFILE)
        near, far, ends = 0.0, linear[place], np.inf
        for _ in range(DOUBLINGS):
            if near >= limit:
                break
            scaled = middle.copy()
            scaled[active] += far * along
            scaled = problem.within(scaled)
            moves = [one.moved((scaled - middle)[active], 0.0)[0] for one in found.found]
            starts = [*map(problem.simulator.moved, best.at.starts, moves)]
            sizes = squares.sizes(scaled, [starts])[0][0]
            ratio = max(float(sizes.sum()) - found.squares, 0.0) / allowed[place]
            if not abs(ratio - 1.0) < LINEAR:  # the first simulation is not as predicted
                sizes = minima.search(squares, scaled, starts).squares
                ratio = max(float(sizes.sum()) - found.squares, 0.0) / allowed[place]
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
