from __future__ import annotations

import json
import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from scm_world.errors import UnknownOption
from scm_world.evaluation.statistics import (
    METRICS,
    Interval,
    aggregate,
    difference_interval,
    mean_interval,
    performance_profile,
    unpaired_interval,
)

# Reference numbers: rliable 1.2.0 with arch 7.2.0, pandas 2.3.3, numpy 2.4.6 and scipy 1.17.1, on
# x = default_rng(7).random((5, 4)).round(2), then y = (the same generator's random((6, 4)) *
# 1.2).round(1).
_RNG = np.random.default_rng(7)
X = _RNG.random((5, 4)).round(2)
Y = (_RNG.random((6, 4)) * 1.2).round(1)
TAU = np.linspace(0.0, 1.0, 6)
RLIABLE = {
    "x": (X, [0.577, 0.585, 0.589, 0.423]),
    "y": (Y, [0.4875, 0.4666666666666667, 0.45, 0.5208333333333333]),
    "a part of x": (
        X[:3, :3],
        [0.5622222222222222, 0.5766666666666667, 0.596, 0.4377777777777778],
    ),
}


def test_the_reference_matrices_are_those_that_rliable_saw() -> None:
    """The generator still draws the numbers from which the references were made."""
    assert X[0].tolist() == [0.63, 0.9, 0.78, 0.23]
    assert Y[-1].tolist() == [0.3, 1.1, 0.6, 1.0]


@pytest.mark.parametrize("name", RLIABLE)
def test_aggregates_are_those_of_rliable(name: str) -> None:
    """Mean, median, interquartile mean and optimality gap equal the library's."""
    scores, expected = RLIABLE[name]
    found = aggregate(scores)
    np.testing.assert_allclose([found[metric].value for metric in METRICS], expected, rtol=1e-12)


def test_profiles_are_those_of_rliable() -> None:
    """The share of scores above each threshold equals the library's."""
    profile = performance_profile(Y.T[None], TAU, over="episodes")
    shares = [0.875, 2 / 3, 0.5, 0.2916666666666667, 1 / 6, 1 / 12]
    np.testing.assert_allclose(profile.share, shares, rtol=1e-12)
    np.testing.assert_allclose(performance_profile(X, TAU).share, [1.0, 0.95, 0.7, 0.5, 0.25, 0.0])


def test_runs_are_one_unit_in_all_protocols() -> None:
    """The interval of the mean is that of Student's t on the means of whole runs."""
    found, means = aggregate(Y)["mean"], Y.mean(axis=1)
    reach = 2.570582 * means.std(ddof=1) / math.sqrt(6)  # t of 5 degrees of freedom
    assert (found.low, found.high) == pytest.approx((means.mean() - reach, means.mean() + reach))
    same = np.repeat(Y[:, :1], 12, axis=1)  # twelve protocols that say the same
    assert aggregate(same)["mean"].width == pytest.approx(aggregate(Y[:, :1])["mean"].width)


def test_two_runs_are_too_few() -> None:
    """Over two runs ends are unknown; three equal ones may be followed by a worse one."""
    two = aggregate(X[:2])["mean"]
    assert (str(two), two.excludes(0.0)) == (f"{two.value:.2f} [unknown]", False)
    assert np.isnan(performance_profile(X[:2], TAU).low).all()
    three = aggregate(np.ones((3, 12)))["mean"]
    assert (three.low, three.high) == (pytest.approx(0.025 ** (1 / 3)), 1.0)
    assert math.isnan(aggregate(np.full((3, 12), 7.0))["mean"].low)  # no rates: nothing is known


def test_rates_stay_between_their_bounds() -> None:
    """Bands and intervals of rates never leave [0, 1]; those of other scores may."""
    high = np.array([[0.99, 1.0], [0.97, 1.0], [1.0, 0.85]])
    assert 0.0 < aggregate(high)["mean"].low < aggregate(high)["mean"].high <= 1.0
    assert aggregate(10.0 * high)["mean"].high > 10.0
    profile = performance_profile(high, TAU)
    assert profile.low.min() >= 0.0
    assert profile.high.max() <= 1.0


def test_an_aggregate_over_episodes_is_never_certain() -> None:
    """Each episode is a unit; runs that always did the same may fail in the next one."""
    scores = np.repeat([[[0.1]], [[0.9]]], 20, axis=2)  # (2 runs, 1 protocol, 20 episodes)
    for found in aggregate(scores, over="episodes").values():
        assert found.low < found.value < found.high
    profile = performance_profile(np.ones((1, 2, 20)), [0.5], over="episodes")
    assert profile.low[0] < profile.high[0] == 1.0
    noisy = np.random.default_rng(0).random((2, 3, 20))
    mean = aggregate(noisy, over="episodes")["mean"]
    each = mean_interval(noisy.mean(axis=(0, 1)))
    assert (mean.low, mean.high) == pytest.approx((each.low, each.high))
    assert aggregate(noisy * 9.0, over="episodes")["mean"].high > 3.0


@pytest.mark.parametrize("of", [aggregate, performance_profile])
def test_one_run_cannot_be_resampled_over_runs(of: Callable[..., Any]) -> None:
    """With one run the error says to resample episodes."""
    with pytest.raises(UnknownOption, match="'episodes' with two episodes or more"):
        of(np.zeros((1, 12, 200)))
    with pytest.raises(UnknownOption, match=r"\(runs, protocols, episodes\)"):
        of(np.zeros((5, 12)), over="episodes")
    with pytest.raises(UnknownOption, match="runs, episodes"):
        of(np.zeros((5, 12)), over="seeds")


def test_a_mean_has_the_interval_of_its_standard_error() -> None:
    """Many values have mean +- 1.96 standard errors; few have the quantile of Student's t."""
    values = np.random.default_rng(0).random(400)
    for given in (values, 10.0 * values):
        found, error = mean_interval(given), 1.96 * given.std() / math.sqrt(given.size)
        assert found.value == given.mean()
        assert (found.low, found.high) == pytest.approx(
            (found.value - error, found.value + error), abs=0.05 * error
        )
    few = mean_interval([10.0, 12.0, 17.0])
    assert few.high - few.value == pytest.approx(4.3027 * 3.60555 / math.sqrt(3), rel=1e-4)


def test_rates_have_students_interval_with_a_score_at_either_bound() -> None:
    """Also if nothing failed: of forty successes the lower end is 0.93, not 1."""
    scores = np.linspace(0.4, 0.7, 18)
    found, added = mean_interval(scores), np.array([*scores, 0.0, 1.0])
    reach = 2.093024 * added.std(ddof=1) / math.sqrt(20)  # t of 19 degrees of freedom
    ends = added.mean() - reach, added.mean() + reach
    assert found.value == pytest.approx(0.55)
    assert (found.low, found.high) == pytest.approx(ends, rel=1e-6)
    every, none = mean_interval([1.0] * 40), mean_interval([0.0] * 40)
    assert (every.low, every.high) == pytest.approx((0.9281, 1.0), abs=1e-4)
    assert (none.low, none.high) == pytest.approx((0.0, 0.0719), abs=1e-4)
    nearly = mean_interval([1.0] * 39 + [0.95])  # whose bootstrap is [0.996, 1.000]
    assert nearly.low < 0.93


@pytest.mark.parametrize(
    ("n", "rate", "success"), [(20, 0.05, 0.98), (40, 0.1, 0.95), (200, 0.01, 0.98)]
)
def test_an_interval_holds_where_failures_are_rare(n: int, rate: float, success: float) -> None:
    """Cells of ``benchmarks/intervals.json``, in which a bootstrap covers 0.6 to 0.9."""
    rng, truth, hits = np.random.default_rng(3), (1.0 - rate) * success, 0
    for _ in range(1000):
        good = rng.beta(1000.0 * success, 1000.0 * (1.0 - success), n)
        found = mean_interval(np.where(rng.random(n) < rate, 0.0, good))
        hits += found.low <= truth <= found.high
    assert hits >= 930


def test_a_paired_interval_holds_where_failures_are_rare() -> None:
    """One agent fails in a hundredth of the episodes, the other in a twentieth."""
    rng, hits = np.random.default_rng(4), 0
    for _ in range(1000):
        luck = rng.random(40)
        a, b = np.where(luck < 0.01, 0.0, 0.98), np.where(luck < 0.05, 0.0, 0.98)
        found = difference_interval(a, b)
        hits += found.low <= 0.04 * 0.98 <= found.high
    assert hits >= 930


def test_a_return_that_is_always_zero_is_not_a_rate() -> None:
    """On request zeros are no failures, and values outside [0, 1] are no proportion."""
    assert math.isnan(mean_interval([0.0] * 200, proportion=False).low)
    with pytest.raises(UnknownOption, match=r"in \[0, 1\]"):
        mean_interval([0.5, 1.5], proportion=True)


def test_one_value_says_nothing_about_its_interval() -> None:
    """A single number has unknown ends; after a single success a rate can be anything."""
    one = mean_interval([4.0])
    assert (one.value, str(one)) == (4.0, "4.00 [unknown]")
    assert not one.excludes(5.0)
    assert json.loads(json.dumps(one.as_dict(), allow_nan=False))["low"] is None
    assert (mean_interval([1.0]).low, mean_interval([1.0]).high) == (0.0, 1.0)


def test_paired_differences_are_much_more_certain() -> None:
    """Two policies that met the same draws differ by little, and that is seen."""
    rng = np.random.default_rng(0)
    luck = rng.random(200)
    a, b = luck + 0.05 + 0.01 * rng.standard_normal(200), luck
    paired, unpaired = difference_interval(a, b), unpaired_interval(a, b)
    assert paired.value == pytest.approx(unpaired.value)
    assert paired.excludes(0.0)
    assert not unpaired.excludes(0.0)
    assert paired.width < 0.25 * unpaired.width


def test_differences_of_success_rates_have_a_width_where_all_succeed() -> None:
    """Two policies that always succeed may still differ a little."""
    ones = np.ones(200)
    paired, unpaired = difference_interval(ones, ones), unpaired_interval(ones, ones)
    assert (paired.low, paired.high) == pytest.approx((-0.0138, 0.0138), abs=1e-4)
    assert 0.01 < unpaired.high == -unpaired.low < 0.03
    always = difference_interval(ones, 1.0 - ones)
    assert (always.value, always.high) == (1.0, 1.0)
    assert 0.95 < always.low < 1.0


def test_an_unpaired_difference_has_the_ends_of_its_means() -> None:
    """As far as they are from the means, by the rule of Pythagoras (Zou and Donner 2008)."""
    a, b = [1.0] * 56 + [0.0] * 14, [1.0] * 48 + [0.0] * 32
    one, two, found = mean_interval(a), mean_interval(b), unpaired_interval(a, b)
    assert found.value - found.low == pytest.approx(math.hypot(0.8 - one.low, two.high - 0.6))
    assert found.high - found.value == pytest.approx(math.hypot(one.high - 0.8, 0.6 - two.low))


@pytest.mark.parametrize(
    "call",
    [
        lambda: mean_interval([]),
        lambda: mean_interval([0.1, math.nan]),
        lambda: mean_interval(["good", "bad"]),
        lambda: mean_interval([0.1, 0.2], level=95),
        lambda: aggregate(X, level=95),
        lambda: aggregate(X[:2], level=95),
        lambda: difference_interval([0.1, 0.2], [0.1]),
        lambda: aggregate(np.zeros((2, 0))),
        lambda: aggregate(X, gamma=math.nan),
        lambda: performance_profile(X, []),
    ],
)
def test_bad_input_is_refused(call: Callable[[], object]) -> None:
    """Nothing, NaN, text, wrong lengths and impossible options are errors that say so."""
    with pytest.raises(UnknownOption, match=r"cannot be .*; it can be"):
        call()


def test_intervals_print_short() -> None:
    """Two digits where that is enough, more where the interval is narrow, no minus zero."""
    assert str(Interval(0.9312, 0.904, 0.952, 0.95, 200)) == "0.93 [0.90, 0.95]"
    assert str(Interval(0.9312, 0.9301, 0.9322, 0.95, 200)) == "0.931 [0.930, 0.932]"
    assert str(Interval(0.5, 0.5, 0.5, 0.95, 9)) == "0.50"  # nothing is random
    assert str(Interval(-0.001, -0.2, 0.2, 0.95, 9)) == "0.00 [-0.20, 0.20]"


def test_no_statistic_warns_on_constant_scores() -> None:
    """Scores that are all the same are ordinary data."""
    ones = np.ones((3, 2, 4))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert aggregate(ones)["interquartile_mean"].value == 1.0
        assert performance_profile(ones).share[-1] == 0.0
