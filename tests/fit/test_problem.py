"""The problem of a fit on a linear system, which no engine simulates: its solution is a formula."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from scipy.stats import t as student

from scm_world._types import Floats, Integers
from scm_world.errors import InterventionError
from scm_world.fit.fitting import described, fitted
from scm_world.fit.problem import (
    FitProblem,
    LeastSquares,
    Minimum,
    Simulated,
    Simulator,
    Window,
    projected,
)
from scm_world.fit.recordings import MeasuredNumber, Measurements, RecordedRun
from scm_world.fit.search import Minima
from scm_world.fit.targets import Target

A = np.array([[0.9, 0.3], [-0.3, 0.8]])  # from one state to the next
B = np.array([0.5, -1.0])  # of the command, and of each parameter
C = np.array([[1.0, 0.4], [0.2, -0.7]])
SEE = np.array([[1.0, 0.0], [0.5, 1.0], [0.0, 0.3]])  # from states to measurements
NOISE = np.array([0.02, 0.05, 0.1])
TRUE, STATE = np.array([0.3, -0.2]), np.array([1.0, 0.5])
ROWS, WINDOW = 60, 30


class Linear(Simulator):
    """The states s → A s + B u + C θ, measured as S s; larger θ₀ than ``most`` are refused."""

    def __init__(self, commands: Floats, effect: Floats = C, most: float = np.inf) -> None:
        self.commands, self.effect, self.most, self.simulated = commands, effect, most, 0
        self.free, self.spans = np.arange(2), np.ones(2)

    def guess(self, windows: Sequence[Window]) -> Floats:
        """Begin at zero."""
        return np.zeros((len(windows), 2))

    def simulate(self, tasks: Sequence[tuple[Window, Floats, Floats]]) -> list[Simulated]:
        """Follow the formula."""
        self.simulated += len(tasks)
        found = []
        for (_, first, last), scaled, state in tasks:
            self.check(scaled)
            states = [state]
            for row in range(first, min(last, len(self.commands))):
                states.append(A @ states[-1] + B * self.commands[row, 0] + self.effect @ scaled)
            found.append(Simulated(np.array(states[: last - first]) @ SEE.T, states[-1]))
        return found

    def check(self, scaled: Floats) -> None:
        """Refuse what is too large."""
        if scaled[0] > self.most:
            raise InterventionError("a is too large", variable="a", value=scaled[0])


def target(name: str, low: float = -np.inf) -> Target:
    """Return a fitted number whose scaled value is its value."""
    return Target(name, name, 0, "1", 0.0, 1.0, False, low, np.inf)


def problem(
    noise: Floats = NOISE,
    low: float = -np.inf,
    seed: int = 7,
    true: Floats = TRUE,
    effect: Floats = C,
    most: float = np.inf,
    rows: int = ROWS,
    more: Floats | float = 0.0,
) -> FitProblem:
    """Return a recording of the system with noise."""
    rng = np.random.default_rng(seed)
    commands = rng.normal(size=(rows - 1, 1))
    system = Linear(commands, effect)
    ((values, _),) = system.simulate([(Window(0, 0, rows), true, STATE)])
    system.most = most
    values = values + NOISE * rng.normal(size=values.shape) + more
    values[5:9, 1] = np.nan
    names = ("one", "other", "third")
    columns = tuple(MeasuredNumber(name, name, 0, "m") for name in names)
    run = RecordedRun(commands, np.arange(rows), values)
    targets = target("a", low), target("b")
    return FitProblem(system, Measurements((run,), columns, 0.1), targets, noise, WINDOW)


def design(problem: FitProblem) -> tuple[Floats, Floats, Integers]:
    """Return the linear least-squares problem by impulse responses: y, X and the columns.

    The columns of X are the two parameters, and the two start states of each window.
    """
    (run,), system = problem.measured.runs, problem.simulator
    powers = [np.linalg.matrix_power(A, n) for n in range(WINDOW)]
    sums = np.cumsum([np.zeros((2, 2)), *powers[:-1]], axis=0)  # I + A + … of a constant input
    y, x, place = [], [], []
    for w, first in enumerate(range(0, ROWS, WINDOW)):
        for n in range(WINDOW):
            sent = run.commands[first : first + n, 0] if n else np.zeros(0)
            forced = sum((powers[n - 1 - i] @ B * u for i, u in enumerate(sent)), np.zeros(2))
            row = np.zeros((3, 6))
            row[:, :2] = SEE @ sums[n] @ C
            row[:, 2 + 2 * w : 4 + 2 * w] = SEE @ powers[n]
            seen = np.isfinite(run.values[first + n])
            y.append((run.values[first + n] - SEE @ forced)[seen])
            x.append(row[seen])
            place.append(np.flatnonzero(seen))
    assert isinstance(system, Linear)
    return np.concatenate(y), np.concatenate(x), np.concatenate(place)


def solution(problem: FitProblem, noise: Floats = NOISE) -> tuple[Floats, Floats, float]:
    """Return the parameters and start states of least squares, their covariance, and squares."""
    y, x, place = design(problem)
    weighed, seen = x / noise[place, None], y / noise[place]
    best = np.linalg.solve(weighed.T @ weighed, weighed.T @ seen)
    covariance = np.linalg.inv(weighed.T @ weighed)
    return best, covariance[:2, :2], float(((seen - weighed @ best) ** 2).sum())


def test_estimates_covariance_and_intervals_are_those_of_linear_least_squares() -> None:
    """A fit without an engine gives the normal equations' solution, and Student's intervals."""
    asked = problem()
    fit = fitted(Minima(asked), (0, 1))
    best, covariance, squares = solution(asked)
    np.testing.assert_allclose(fit.scaled, best[:2], atol=1e-6)
    np.testing.assert_allclose(fit.starts.ravel(), best[2:], atol=1e-6)
    assert fit.squares == pytest.approx(squares, rel=1e-6)
    assert fit.degrees == 3 * ROWS - 4 - 6
    assert fit.discount == 1.0  # independent noise of the given size
    np.testing.assert_allclose(fit.covariance, covariance, rtol=1e-5)
    reach = student.ppf(0.975, fit.degrees) * np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(fit.linear_reach, reach, rtol=1e-5)
    assert fit.reach is not None
    np.testing.assert_allclose(fit.reach, np.repeat(reach[:, None], 2, axis=1), rtol=0.01)
    np.testing.assert_allclose(fit.table.low, best[:2] - reach, atol=0.01 * reach.max())
    assert fit.explains


def test_residuals_are_linearised_as_the_formula_says() -> None:
    """Finite differences give the impulse responses, and segments are joined without a gap."""
    asked, (y, x, place) = problem(), design(problem())
    starts = [STATE + 0.1 * i for i in range(len(asked.segments))]  # which do not follow
    made = LeastSquares(asked, asked.joined, NOISE, (0, 1)).linear(TRUE, starts)
    assert [len(group) for group in asked.joined] == [3, 3]
    for w, one in enumerate(made):
        mine = np.flatnonzero(np.abs(x[:, 2 + 2 * w : 4 + 2 * w]).sum(axis=1))
        slopes = -x[mine] / NOISE[place[mine], None]
        np.testing.assert_allclose(one.parameters, slopes[:, :2], atol=1e-8)
        np.testing.assert_allclose(one.states, slopes[:, 2 + 2 * w : 4 + 2 * w], atol=1e-8)
        fitted_values = x[mine] @ np.concatenate([TRUE, *[starts[3 * i] for i in range(2)]])
        left = (y[mine] - fitted_values) / NOISE[place[mine]]
        np.testing.assert_allclose(one.residual, left, atol=1e-6)


def gauss_newton_in_ten_lines(
    squares: LeastSquares, scaled: Floats, starts: Sequence[Floats]
) -> Minimum:
    """Take eight whole steps, without any bound."""
    active, moved = [*squares.active], squares.problem.simulator.moved
    for _ in range(8):
        made = squares.linear(scaled, starts)
        residual, along = projected(made)
        step = -np.linalg.lstsq(along, residual, rcond=None)[0]
        starts = [*map(moved, starts, (by for one in made for by in one.moved(step, 0.0)))]
        scaled = scaled + step @ np.eye(len(scaled))[active]
    return squares.minimum(scaled, starts, smooth=True)


def test_another_search_finds_the_same_minimum() -> None:
    """A fit takes any search, and reports what this one found."""
    searched = list[LeastSquares]()

    def search(squares: LeastSquares, scaled: Floats, starts: Sequence[Floats]) -> Minimum:
        searched.append(squares)
        return gauss_newton_in_ten_lines(squares, scaled, starts)

    usual, other = (
        fitted(minima, (0, 1)) for minima in (Minima(problem()), Minima(problem(), search))
    )
    assert {len(one.groups) for one in searched} == {6, 4, 2}  # segments, joined by and by
    np.testing.assert_allclose(other.scaled, usual.scaled, atol=1e-6)
    np.testing.assert_allclose(other.starts, usual.starts, atol=1e-6)
    np.testing.assert_allclose(other.covariance, usual.covariance, rtol=1e-6)
    assert str(other) == str(usual)


def test_noise_is_estimated_from_the_residuals() -> None:
    """Each column has its share of the squares, by the degrees of freedom that are left."""
    asked = problem(noise=np.array([np.nan, 0.05, np.nan]))
    fit, noise = fitted(Minima(asked), (0, 1)), NOISE.copy()
    y, x, place = design(asked)
    for _ in range(30):
        best, *_ = solution(asked, noise)
        sizes = np.bincount(place, (y - x @ best) ** 2) / np.bincount(place)
        sizes *= len(y) / fit.degrees
        noise = np.where([False, True, False], NOISE, np.sqrt(sizes))
    np.testing.assert_allclose(fit.noise, noise, rtol=0.008)
    np.testing.assert_allclose(fit.noise, NOISE, rtol=0.2)
    assert fit.given.tolist() == [False, True, False]
    np.testing.assert_allclose(fit.scaled, best[:2], atol=0.1 * fit.errors.min())


def test_residuals_are_in_the_noise_of_the_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the noise has not settled, a fit has the squares of its own noise."""
    monkeypatch.setattr("scm_world.fit.search.ROUNDS", 1)
    monkeypatch.setattr("scm_world.fit.search.SETTLED", 0.0)
    asked = problem(noise=np.full(3, np.nan))
    fit = fitted(Minima(asked), (0, 1))
    *_, squares = solution(asked, fit.noise)
    assert fit.squares == pytest.approx(squares, rel=1e-6)


def test_a_range_holds_the_estimate() -> None:
    """At the end of a range, the other numbers are those of least squares with it there."""
    asked = problem(low=0.35)
    fit = fitted(Minima(asked), (0, 1))
    y, x, place = design(asked)
    weighed = x / NOISE[place, None]
    rest = weighed[:, 1:]
    left = y / NOISE[place] - 0.35 * weighed[:, 0]
    best = np.linalg.solve(rest.T @ rest, rest.T @ left)
    assert fit.scaled[0] == 0.35
    assert fit.scaled[1] == pytest.approx(best[0], abs=1e-5)
    assert "a is at the end of its range" in fit.remarks


def test_parameters_that_are_not_active_stay_at_their_defaults() -> None:
    """A fit of one of two numbers is least squares of this one alone, and has misfit."""
    asked = problem()
    fit = fitted(Minima(asked), (1,))
    y, x, place = design(asked)
    weighed = x[:, 1:] / NOISE[place, None]
    best = np.linalg.solve(weighed.T @ weighed, weighed.T @ (y / NOISE[place]))
    assert fit.values == pytest.approx({"b": best[0]}, abs=1e-5)
    assert not fit.explains


def test_a_parameter_far_from_its_default_is_that_of_least_squares() -> None:
    """Steps grow, and nothing pulls back to the default: 64 units of a number that is zero."""
    asked = problem(true=np.array([64.0, -0.2]))
    fit = fitted(Minima(asked), (0, 1))
    best, covariance, squares = solution(asked)
    np.testing.assert_allclose(fit.scaled, best[:2], atol=1e-5)
    np.testing.assert_allclose(fit.covariance, covariance, rtol=1e-4)
    assert fit.squares == pytest.approx(squares, rel=1e-5)


def test_what_acts_on_nothing_stays_and_has_no_interval() -> None:
    """The other number is that of least squares without it."""
    blind = C * [[0.0, 1.0], [0.0, 1.0]]
    asked = problem(effect=blind)
    fit = fitted(Minima(asked), (0, 1))
    y, x, place = design(asked)
    weighed = x[:, 1:] / NOISE[place, None]
    best = np.linalg.solve(weighed.T @ weighed, weighed.T @ (y / NOISE[place]))
    assert fit.scaled[0] == 0.0
    assert fit.scaled[1] == pytest.approx(best[0], abs=1e-6)
    rows = fit.table
    assert np.isnan([rows.low[0], rows.high[0]]).all()
    assert rows.determined.tolist() == [False, True]
    assert fit.confounded == (("a",),)


def test_a_search_that_took_all_its_steps_is_said_and_tells_no_noise() -> None:
    """The noise is not estimated from its residuals, and no value is determined."""

    def tired(squares: LeastSquares, scaled: Floats, starts: Sequence[Floats]) -> Minimum:
        return squares.minimum(scaled, starts, smooth=False)._replace(ended=True)

    asked = problem(noise=np.full(3, np.nan))
    fit = fitted(Minima(asked, tired), (0, 1))
    np.testing.assert_array_equal(fit.noise, asked.noise)
    assert not fit.table.determined.any()
    assert "the search took all its steps before it found a minimum" in str(fit)
    assert not fitted(Minima(problem()), (0, 1)).ended


def test_a_refused_trial_is_a_rejected_step() -> None:
    """The world refuses more than 0.28 where 0.3 is best; intervals do not ask for more."""
    fit = fitted(Minima(problem(most=0.28)), (0, 1))
    best, *_ = solution(problem())
    assert 0.27 < fit.scaled[0] <= 0.28 < best[0]
    assert fit.reach is not None
    assert fit.scaled[0] + fit.reach[0, 1] < best[0] + 0.1


def test_the_numbers_of_a_vector_deviate_alone() -> None:
    """The test of two numbers together is Wald's, by the covariance of least squares."""
    from scipy.stats import f as fisher

    for true in (np.array([0.3, 0.0]), np.array([0.0, 0.0])):
        asked = problem(true=true)
        asked.targets = tuple(replace(one, variable="vector") for one in asked.targets)
        fit = fitted(Minima(asked), (0, 1))
        best, covariance, _ = solution(asked)
        wald = float(best[:2] @ np.linalg.solve(covariance, best[:2])) / 2.0
        assert fit.deviates("vector") == (wald > fisher.ppf(0.95, 2, fit.degrees))
        assert fit.deviates("vector") == bool(true.any())


def test_freedom_of_columns_is_that_of_the_hat_matrix() -> None:
    """The fitted numbers take away the traces of X (XᵀX)⁻¹ Xᵀ over the rows of each column."""
    asked = problem()
    fit = fitted(Minima(asked), (0, 1))
    _, x, place = design(asked)
    weighed = x / NOISE[place, None]
    hat = np.diag(weighed @ np.linalg.solve(weighed.T @ weighed, weighed.T))
    np.testing.assert_allclose(fit.freedom, np.bincount(place, 1.0 - hat), rtol=1e-3)
    assert fit.freedom.sum() == pytest.approx(fit.degrees, rel=1e-6)


def test_a_term_that_is_missing_is_found_below_one_and_a_half_times_the_noise() -> None:
    """A wave that no state follows; where the noise was not given, its error may be the cause."""
    wave = np.zeros((ROWS, 3))
    wave[:, 1] = 1.4 * NOISE[1] * np.sin(2.0 * np.arange(ROWS))
    asked = problem(more=wave)
    fit = described(Minima(asked), (0, 1), Minima(asked).found((0, 1)))
    y, x, place = design(asked)
    best, *_ = solution(asked)
    left = ((y - x @ best)[place == 1] / NOISE[1]) ** 2
    assert 1.1 < fit.misfit["other"] < 1.5
    assert chi2.sf(left.sum(), fit.freedom[1]) < 1e-3 / 3
    assert fit.unexplained == ("other",)
    assert not fit.explains
    assert any("residuals of other are" in said for said in fit.remarks)
    assert fit.discount >= fit.misfit["other"] ** 2
    unknown = problem(more=wave, noise=np.full(3, np.nan))
    assert described(Minima(unknown), (0, 1), Minima(unknown).found((0, 1))).explains


def test_residuals_that_follow_one_another_are_no_noise() -> None:
    """A slow wave is found below 1.5 times the estimated noise; permuted rows have less order."""
    wave, unknown = np.zeros((200, 3)), np.full(3, np.nan)
    wave[:, 1] = 1.2 * NOISE[1] * np.sin(0.5 * np.arange(200))
    asked = problem(more=wave, noise=unknown, rows=200)
    fit = described(Minima(asked), (0, 1), Minima(asked).found((0, 1)))
    left, rng = fit.residual[asked.measured.cells[1] == 1], np.random.default_rng(0)
    order = np.array([left] + [rng.permutation(left) for _ in range(3000)])
    order = (np.diff(order, axis=1) ** 2).sum(axis=1)
    assert (order[1:] <= order[0]).mean() < 1e-2 / 3
    assert 1.1 < fit.misfit["other"] < 1.5
    assert fit.unexplained == ("other",)
    alarms = 0
    for seed in range(40):
        asked = problem(seed=seed, noise=unknown)
        alarms += not described(Minima(asked), (0, 1), Minima(asked).found((0, 1))).explains
    assert alarms <= 2  # 0.5 % of 400


@pytest.mark.parametrize("rows", [8, 60])
def test_noise_alone_is_no_misfit(rows: int) -> None:
    """Right fits explain their recordings: 8 rows, of which some have 1.4 times their noise."""
    sizes = list[float]()
    for seed in range(25):
        asked = problem(seed=seed, rows=rows)
        fit = described(Minima(asked), (0, 1), Minima(asked).found((0, 1)))
        sizes.append(max(fit.misfit.values()))
        assert fit.explains
    assert max(sizes) > (1.4 if rows == 8 else 1.1)


def test_a_small_error_of_the_noise_is_no_misfit() -> None:
    """In thousands of rows, χ² rejects residuals of 1.05 times the noise: they are explained."""
    asked = problem(rows=3000, noise=NOISE / 1.06)
    fit = described(Minima(asked), (0, 1), Minima(asked).found((0, 1)))
    squares = np.bincount(asked.measured.cells[1], fit.residual**2)
    assert (chi2.sf(squares, fit.freedom) < 1e-3 / 3).any()
    assert max(fit.misfit.values()) < 1.1
    assert fit.explains
