"""Counterfactuals of observed units: abduction, action, prediction."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from scm_world import SCM
from scm_world.discovery.data import Dataset, Design, as_frame, collect
from scm_world.errors import (
    FunctionFailure,
    ImpossibleObservation,
    ModelError,
    UnknownOption,
    UnknownVariable,
)
from scm_world.queries import Counterfactuals
from scm_world.variables import (
    Action,
    Bernoulli,
    Box,
    Categories,
    Continuous,
    Derived,
    Discrete,
    Draw,
    Either,
    Exogenous,
    Hard,
    Integers,
    Linear,
    Mechanism,
    Natural,
    Normal,
    Parent,
    Scale,
    Shift,
    Table,
)


def cubed(x: Any, noise: Any) -> Any:
    """A mechanism that is monotone in its noise."""
    return x + noise**3 + 0.1 * noise


def scaled(x: Any, noise: Any) -> Any:
    """One whose noise is multiplied."""
    return x * np.exp(noise)


def folded(x: Any, noise: Any) -> Any:
    """One in which two noises give one value."""
    return x + np.abs(noise)


def alone(x: float, noise: float) -> float:
    """One that takes a single unit."""
    return math.sinh(float(noise)) + float(x)


def turned(x: Any, noise: Any) -> Any:
    """One whose noise has two numbers."""
    return x + noise[..., 0] - noise[..., 1]


def flipped(x: Any, noise: Any) -> Any:
    """One of bits."""
    return (np.asarray(x) + np.asarray(noise)) % 2


def chain() -> SCM:
    """A model whose noise follows from the values."""
    return SCM(
        [
            Exogenous(name="u", distribution=Normal()),
            Exogenous(name="x", distribution=Box(0.0, 1.0)),
            Derived(
                name="y",
                parents=("x", "u"),
                mechanism=Linear(weights=(2.0, 1.0)),
                noise=Continuous("laplace"),
            ),
            Derived(
                name="z",
                parents=("y",),
                mechanism=cubed,
                noise=Normal(),
                inverse_noise="monotone",
            ),
            Derived(
                name="w",
                parents=("x",),
                mechanism=scaled,
                noise=Normal(0.0, 0.5),
                inverse_noise="monotone",
            ),
        ]
    )


def test_what_was_observed_whole_is_answered_exactly() -> None:
    """The units are those of the seed, so the answer is the model's under the intervention."""
    model = chain()
    seen, wanted = (m.draw(50, seed=3) for m in (model, model.do({"x": 0.3})))
    found = model.counterfactual(seen, do={"x": 0.3})
    assert found.exact
    assert found.weights.shape == (50, 1)
    for name in model:
        np.testing.assert_allclose(found[name], wanted[name], rtol=0.0, atol=1e-9)
    one = model.counterfactual({name: values[7] for name, values in seen.items()}, do={"x": 0.3})
    assert one["z"] == pytest.approx(wanted["z"][7], abs=1e-9)
    assert one.difference("u") == 0.0
    assert str(one) == "counterfactuals of 1 observed unit (exact)"


def test_nothing_done_changes_nothing() -> None:
    """Consistency: under no intervention the unit is what it was, to the last bit."""
    model = chain()
    seen = model.draw(20, seed=1)
    found = model.counterfactual(seen, do={})
    assert all(found[name].tobytes() == seen[name].tobytes() for name in model)


def test_a_hidden_cause_has_its_posterior() -> None:
    """Of a linear model with normal noise, in closed form."""
    model = SCM(
        [
            Exogenous(name="u", distribution=Normal()),
            Derived(name="x", parents=("u",), mechanism=Linear(weights=(1.0,)), noise=Normal()),
            Derived(
                name="y",
                parents=("x", "u"),
                mechanism=Linear(weights=(1.0, 2.0)),
                noise=Normal(0.0, 0.5),
            ),
        ]
    )
    found = model.counterfactual({"x": 1.0, "y": 2.0}, do={"x": 0.0}, n=20_000, seed=1)
    precision = 1.0 + 1.0 + 4.0 / 0.25
    mean, spread = (1.0 + 2.0 / 0.25) / precision, precision**-0.5
    assert found["u"] == pytest.approx(mean, abs=0.02)
    low, high = found.interval("u")
    assert (low, high) == pytest.approx((mean - 1.96 * spread, mean + 1.96 * spread), abs=0.03)
    assert found["y"] == pytest.approx(1.0)  # whatever u is
    assert 1_000 < found.effective[0] < 20_000
    again = model.counterfactual({"x": 1.0, "y": 2.0}, do={"x": 0.0}, n=20_000, seed=1)
    assert again["u"].tobytes() == found["u"].tobytes()


def test_bits_are_enumerated() -> None:
    """A noise that follows is exact; one that does not has the probability of Bayes."""
    bit: dict[str, Any] = {"dtype": "integer", "bounds": Integers(0, 1)}
    model = SCM(
        [
            Exogenous(name="x", distribution=Bernoulli(0.3), **bit),
            Derived(name="y", parents=("x",), mechanism=flipped, noise=Bernoulli(0.1), **bit),
        ]
    )
    sure = model.counterfactual({"x": 1, "y": 0}, do={"x": 0})
    assert (sure.exact, sure["y"]) == (True, 1.0)
    found = model.counterfactual({"y": [0, 1]}, do={"x": 0}, n=40_000)
    assert found["x"].tolist() == [0.0, 0.0]
    posterior = (found.weights * found.factual["x"]).sum(axis=1)
    wanted = (0.3 * 0.1 / (0.3 * 0.1 + 0.7 * 0.9), 0.3 * 0.9 / (0.3 * 0.9 + 0.7 * 0.1))
    np.testing.assert_allclose(posterior, wanted, atol=0.01)


@pytest.mark.filterwarnings("ignore:few draws fit")
def test_a_function_that_declares_nothing_is_sampled() -> None:
    """|e| = 1 has two solutions: draws within the tolerance count, and say how many there are."""
    model = SCM(
        [
            Exogenous(name="x"),
            Derived(name="y", parents=("x",), mechanism=folded, noise=Normal(0.5, 1.0)),
        ]
    )
    seen: dict[str, Any] = {"observed": {"x": 0.0, "y": 1.0}, "do": {"x": 2.0}}
    with pytest.raises(ModelError, match=r"none of 1000 draws.*declare inverse_noise, draw more"):
        model.counterfactual(**seen)
    assert model.counterfactual(**seen, tolerance=0.02).weights.shape == (1, 1000)
    found = model.counterfactual(**seen, n=20_000, tolerance=0.02)
    assert not found.exact
    assert found["y"] == pytest.approx(3.0, abs=0.02)
    assert found.effective[0] > 1_000  # draws are adapted: 4 % of the first ones are near
    back = found.factual["y"][0][found.weights[0] > 0.0]
    np.testing.assert_allclose(back, 1.0, atol=0.04)


def test_a_table_keeps_the_category_that_is_most_likely_the_same() -> None:
    """Noise lies in the range of the category: Pearl's bounds, for one uniform noise."""
    kind: dict[str, Any] = {"dtype": "categorical", "bounds": Categories(labels=("dry", "wet"))}
    model = SCM(
        [
            Exogenous(name="rain", distribution=Discrete((0, 1)), **kind),
            Derived(
                name="grass",
                parents=("rain",),
                mechanism=Table([[0.9, 0.1], [0.2, 0.8]]),
                **kind,
            ),
        ]
    )
    found = model.counterfactual({"rain": 0, "grass": 0}, do={"rain": "wet"}, n=20_000)
    assert found.probability("grass", "wet") == pytest.approx(0.7 / 0.9, abs=0.01)
    kept = model.counterfactual({"rain": 0, "grass": 1}, do={"rain": "wet"})
    assert (kept.counterfactual["grass"] == 1).all()


@pytest.mark.parametrize("together", [True, False])
def test_functions_of_one_unit_and_several_rows(together: bool) -> None:
    """Functions that take one unit at a time give what others give."""
    mechanism = np.sinh if together else alone

    def added(x: Any, noise: Any) -> Any:
        return x + mechanism(noise) if together else alone(x, noise)

    model = SCM(
        [
            Exogenous(name="x", distribution=Normal()),
            Derived(
                name="y",
                parents=("x",),
                mechanism=added,
                noise=Normal(),
                inverse_noise="monotone",
            ),
        ]
    )
    found = model.counterfactual({"x": [1.0, 2.0], "y": [0.5, 4.0]}, do={"x": Shift(1.0)})
    np.testing.assert_allclose(found["y"], [1.5, 5.0], atol=1e-9)


def test_an_episode_is_abducted_step_by_step() -> None:
    """What is drawn once per episode is found, or drawn; noise of every step follows."""
    model = SCM(
        [
            Exogenous(name="k", distribution=Normal()),
            Derived(
                name="s",
                parents=(Parent("s", 1), Parent("k")),
                mechanism=Linear(weights=(0.9, 1.0)),
                noise=Normal(0.0, 0.1),
            ),
        ]
    )
    seen, wanted = (m.draw(4, seed=3, steps=6) for m in (model, model.do({"k": 1.0})))
    found = model.counterfactual(seen, do={"k": 1.0})
    assert found.exact
    np.testing.assert_allclose(found["s"], wanted["s"], atol=1e-9)
    hidden = model.counterfactual({"s": seen["s"]}, do={"k": 1.0}, n=4_000)
    believed = (hidden.weights * hidden.factual["k"][..., 0]).sum(axis=1)
    np.testing.assert_allclose(believed, seen["k"][:, 0], atol=0.15)
    one = model.counterfactual({n: v[0] for n, v in seen.items()}, do={"k": 1.0})
    np.testing.assert_allclose(one["s"], wanted["s"][0], atol=1e-9)


def test_gaps_are_drawn() -> None:
    """NaN stands for what was not observed, row by row."""
    model = chain()
    seen = model.draw(3, seed=5)
    seen["y"] = np.array(seen["y"])
    seen["y"][1] = np.nan
    found = model.counterfactual(seen, do={"x": 0.5}, n=20_000)
    wanted = model.do({"x": 0.5}).draw(3, seed=5)
    np.testing.assert_allclose(found["y"][[0, 2]], wanted["y"][[0, 2]], atol=1e-9)
    n = np.linspace(-6.0, 6.0, 20_001)
    y = seen["z"][1] - n**3 - 0.1 * n
    density = np.exp(-0.5 * n**2 - abs(y - 2.0 * seen["x"][1] - seen["u"][1]))
    believed = (found.weights * found.factual["y"]).sum(axis=1)
    assert believed[1] == pytest.approx((density * y).sum() / density.sum(), abs=0.1)


def test_a_draw_has_noise_of_its_own() -> None:
    """An intervention that draws has nothing in common with what was observed."""
    model = chain()
    seen = model.draw(400, seed=2)
    found = model.counterfactual(seen, do={"x": Draw(Box(0.0, 1.0))})
    assert abs(np.corrcoef(seen["x"], found["x"])[0, 1]) < 0.15


def test_observed_under_an_intervention() -> None:
    """A shift that held when the unit was observed is taken off before the noise is found."""
    model = chain().do({"y": Shift(10.0)})
    seen, wanted = (m.draw(5, seed=8) for m in (model, model.do({"x": 0.1})))
    found = model.counterfactual(seen, do={"x": 0.1})
    np.testing.assert_allclose(found["z"], wanted["z"], atol=1e-6)


@pytest.mark.parametrize("together", [True, False])
@pytest.mark.parametrize(
    "mechanism",
    [
        lambda x, noise: 2.0 * x + noise,
        lambda x, noise: x - 3.0 * noise,
        lambda x, noise: 2.0 * x + (1.0 + x**2) * noise,
        lambda x, noise: x + np.exp(noise),
        lambda x, noise: x + np.sinh(noise),
        lambda x, noise: x + noise**3,
    ],
    ids=["added", "negative", "scaled", "exp", "sinh", "cubed"],
)
def test_a_rare_value_is_inverted_as_any_other(mechanism: Any, together: bool) -> None:
    """Nine and forty standard deviations from the mean, for functions of rows or of one unit."""

    def function(x: Any, noise: Any) -> Any:
        return mechanism(x, noise) if together else mechanism(alone(x, 0.0), float(noise))

    model = SCM(
        [
            Exogenous(name="x", distribution=Normal()),
            Derived(
                name="y",
                parents=("x",),
                mechanism=function,
                noise=Normal(),
                inverse_noise="monotone",
            ),
        ]
    )
    noise = np.array([-3.0, 0.5, 9.0, 20.0])
    seen = {"x": np.full(4, 0.5), "y": mechanism(0.5, noise)}
    found = model.counterfactual(seen, do={"x": 1.5})
    assert found.exact
    np.testing.assert_allclose(found["y"], mechanism(1.5, noise), rtol=1e-5, atol=1e-9)


def test_a_value_beyond_bounded_noise_stays_impossible() -> None:
    """However far one looks; its ends are possible."""
    noise = Box(-1.0, 1.0)
    scaled = Derived(
        name="y",
        parents=("x",),
        mechanism=lambda x, noise: x + np.exp(noise),
        noise=noise,
        inverse_noise="monotone",
    )
    model = SCM([Exogenous(name="x", distribution=Normal()), scaled])
    end = math.exp(1.0)
    assert model.counterfactual({"x": 0.0, "y": end}, do={"x": 1.0})["y"] == pytest.approx(1 + end)
    with pytest.raises(ImpossibleObservation, match="no value of its noise"):
        model.counterfactual({"x": 0.0, "y": end + 0.01}, do={"x": 1.0})


def test_what_cannot_be_is_refused_by_name() -> None:
    """Outside the support, against a function without noise, and what nobody can invert."""
    with pytest.raises(ImpossibleObservation, match="'x'") as problem:
        chain().counterfactual({"x": 2.0}, do={"u": 0.0})
    assert problem.value.variable == "x"
    double = Derived(name="y", parents=("x",), mechanism=Linear(weights=(2.0,)))
    model = SCM([Exogenous(name="x", distribution=Normal()), double])
    with pytest.raises(ImpossibleObservation, match="'y'"):
        model.counterfactual({"x": 1.0, "y": 3.0}, do={"x": 0.0})
    with pytest.raises(ModelError, match="observe its causes"):  # where it follows from x alone
        model.counterfactual({"y": 3.0}, do={})
    pair = Derived(name="z", parents=("x",), mechanism=lambda x: np.stack([x, x], -1), shape=(2,))
    with pytest.raises(ModelError, match="observe its causes") as unmet:
        SCM([Exogenous(name="x", distribution=Normal()), pair]).counterfactual(
            {"z": [0.1, 0.1]}, do={}
        )
    assert not isinstance(unmet.value, ImpossibleObservation)
    two = Derived(name="y", parents=("x",), mechanism=turned, noise=Normal(), noise_shape=(2,))
    hard = SCM([Exogenous(name="x"), two])
    assert hard.draw(4, seed=0)["y"].shape == (4,)
    with pytest.raises(ModelError, match="inverse_noise"):
        hard.counterfactual({"x": 0.0, "y": 1.0}, do={"x": 1.0})


@pytest.mark.parametrize(
    ("observed", "error", "words"),
    [
        ({"q": 1.0}, UnknownVariable, "q"),
        ({"x": [0.1, 0.2], "y": 1.0}, ModelError, "same rows"),
        ({}, ModelError, "at least one"),
        ({"x": []}, ModelError, "at least one"),
        ({"x": np.zeros((2, 2))}, ModelError, "shape"),
        (3.0, UnknownOption, "values by name"),
        ({"x": np.inf}, ImpossibleObservation, "finite"),
    ],
)
def test_bad_observations_say_what_is_wrong(
    observed: Any, error: type[Exception], words: str
) -> None:
    """The name, the shape, or what is allowed."""
    with pytest.raises(error, match=words):
        chain().counterfactual(observed, do={"x": 0.5})


def test_replay_and_abduction_are_told_apart() -> None:
    """An intervention in the place of observations is refused with both remedies."""
    with pytest.raises(UnknownOption, match="rollout"):
        chain().counterfactual({"x": 0.5})
    with pytest.raises(ModelError, match="counterfactual"):
        chain().solve({"y": 1.0})


def test_a_declared_inverse_is_used() -> None:
    """Where the noise has another shape than the value."""

    def back(y: Any, x: Any) -> Any:
        return np.stack([np.asarray(y) - x, np.zeros_like(y)], axis=-1)

    two = Derived(
        name="y",
        parents=("x",),
        mechanism=turned,
        noise=Normal(),
        noise_shape=(2,),
        inverse_noise=back,
    )
    model = SCM([Exogenous(name="x"), two])
    found = model.counterfactual({"x": 0.0, "y": 1.0}, do={"x": 5.0})
    assert (found.exact, found["y"]) == (True, 6.0)


# --- closed forms that an examiner would try -----------------------------------------------------

ONE = Linear(weights=(1.0,))


def believed(found: Counterfactuals, name: str) -> Any:
    """Give the mean of what a variable was, shape (rows, ...)."""
    weights = found.weights.reshape(found.weights.shape + (1,) * (found.factual[name].ndim - 2))
    return (weights * found.factual[name]).sum(axis=1)


def line(*, weight: float = 2.0, mechanism: Any = None, **more: Any) -> SCM:
    """A root, and an effect with normal noise."""
    made = Linear(weights=(weight,)) if mechanism is None else mechanism
    y = Derived(name="y", parents=("x",), mechanism=made, noise=Normal(), **more)
    return SCM([Exogenous(name="x", distribution=Normal()), y])


@pytest.mark.parametrize("unit", [1e-14, 1.0, 1e14])
def test_a_range_of_noise_is_one_in_every_unit(unit: float) -> None:
    """Rounding to whole units tells that the noise lies between 0.5 and 1.5 units, no more."""
    y = Derived(
        name="y",
        parents=("x",),
        mechanism=lambda x, noise: unit * np.rint((x + noise) / unit),
        noise=Normal(0.0, unit),
        inverse_noise="monotone",
    )
    model = SCM([Exogenous(name="x", distribution=Normal(0.0, unit)), y])
    found = model.counterfactual({"x": 0.0, "y": unit}, do={"x": 0.3 * unit}, n=20_000)
    above = (0.933193 - 0.884930) / (0.933193 - 0.691462)  # P(noise > 1.2) of a normal in there
    assert found["y"] / unit == pytest.approx(1.0 + above, abs=0.02)


def test_a_value_that_many_noises_give_has_their_range() -> None:
    """A floor at 0, a sign, a whole number far out: truncated normal distributions."""
    e = np.linspace(-9.0, 9.0, 400_001)
    density = np.exp(-0.5 * e**2)

    def wanted(told: Any, then: Any) -> float:
        weight = density * told
        return float((weight * then).sum() / weight.sum())

    known: Any = {"inverse_noise": "monotone"}
    floor = line(mechanism=lambda x, noise: np.maximum(x + noise, 0.0), **known)
    found = floor.counterfactual({"x": [0.0, 0.0], "y": [0.0, 0.7]}, do={"x": 1.0}, n=20_000)
    assert found["y"] == pytest.approx([wanted(e <= 0.0, np.maximum(1.0 + e, 0.0)), 1.7], abs=0.02)
    hidden = floor.counterfactual({"y": 0.0}, do={"x": 1.0}, n=40_000)
    assert believed(hidden, "x")[0] == pytest.approx(-1.0 / math.sqrt(math.pi), abs=0.03)
    sign = line(mechanism=lambda x, noise: np.sign(x + noise) * 1.0, **known)
    found = sign.counterfactual({"x": 0.5, "y": 1.0}, do={"x": -1.0}, n=20_000)
    assert found["y"] == pytest.approx(wanted(e > -0.5, np.sign(e - 1.0)), abs=0.03)
    whole = line(mechanism=lambda x, noise: np.rint(x + noise), dtype="integer", **known)
    found = whole.counterfactual({"x": [0.0, 0.0], "y": [1, 6]}, do={"x": 0.3}, n=20_000)
    for row, seen in enumerate((1, 6)):
        there = np.abs(e - seen) < 0.5
        assert found["y"][row] == pytest.approx(wanted(there, np.rint(0.3 + e)), abs=0.03)


def test_categories_have_probabilities_and_no_mean() -> None:
    """A mean, a difference and an interval are refused unless all draws agree; labels are known."""
    codes = (3, 7, 9)
    kind: dict[str, Any] = {"dtype": "categorical", "bounds": Categories(codes, tuple("rgb"))}
    table = Table([[0.8, 0.1, 0.1], [0.1, 0.8, 0.1]], values=codes)
    model = SCM(
        [
            Exogenous(name="t", distribution=Bernoulli(0.5), dtype="integer"),
            Derived(name="c", parents=("t",), mechanism=table, **kind),
        ]
    )
    found = model.counterfactual({"t": 0, "c": "r"}, do={"t": 1}, n=500)
    for ask in (found.__getitem__, found.difference, found.interval):
        with pytest.raises(UnknownOption, match="probability"):
            ask("c")
    assert float(found.probability("c", "g")) == found.probability("c", 7) > 0.5
    assert model.counterfactual({"t": 0, "c": "r"}, do={}, n=500)["c"] == 3.0
    for name, value in (("c", "z"), ("c", 4), ("c", None), ("t", "r"), ("t", 0.5), ("t", [1, 1])):
        with pytest.raises(UnknownOption, match=f"value of {name}"):
            found.probability(name, value)
    with pytest.raises(UnknownVariable):
        found.probability("nobody", 1)


def test_labels_and_their_probabilities() -> None:
    """Three categories with a hidden one: posterior and counterfactual by enumeration."""
    kind: dict[str, Any] = {"dtype": "categorical", "bounds": Categories(labels=("a", "b", "c"))}
    prior = np.array([0.5, 0.3, 0.2])
    table = np.array([[0.7, 0.2, 0.1], [0.1, 0.8, 0.1], [0.2, 0.3, 0.5]])
    model = SCM(
        [
            Exogenous(name="c", distribution=Discrete(range(len(prior)), prior), **kind),
            Derived(name="g", parents=("c",), mechanism=Table(table), **kind),
        ]
    )
    found = model.counterfactual({"g": "b"}, do={"c": "c"}, n=40_000)
    posterior = prior * table[:, 1] / (prior @ table[:, 1])
    told = [(found.weights * (found.factual["c"] == k)).sum() for k in range(3)]
    np.testing.assert_allclose(told, posterior, atol=0.01)
    ends = np.hstack([np.zeros((3, 1)), np.cumsum(table, axis=1)])
    both = np.array(
        [
            [
                max(0.0, min(ends[c, 2], ends[2, k + 1]) - max(ends[c, 1], ends[2, k]))
                for k in range(3)
            ]
            for c in range(3)
        ]
    )
    wanted = (posterior / table[:, 1]) @ both
    np.testing.assert_allclose([found.probability("g", k) for k in "abc"], wanted, atol=0.01)
    rows = model.counterfactual({"c": ["a", "c"], "g": ["b", "c"]}, do={})
    assert [*rows["c"], *rows["g"]] == pytest.approx([0.0, 2.0, 1.0, 2.0])
    with pytest.raises(ImpossibleObservation, match="labels are a, b, c") as problem:
        model.counterfactual({"c": "d"}, do={"g": "a"})
    assert problem.value.variable == "c"
    arms: dict[str, Any] = {"do": {"c": "b"}, "versus": {"c": "a"}}
    effect = model.effect(lambda episode: episode.final("g") == 1, **arms, n=2000)
    assert effect.mean == pytest.approx(0.8 - 0.2, abs=0.05)


def test_tables_of_this_package_are_observed() -> None:
    """A dataset, its frame with the columns in any order, and rows of control steps."""
    model = SCM(
        [
            Exogenous(name="v", shape=(2, 2), default=np.zeros((2, 2)), distribution=Normal()),
            Derived(
                name="s",
                parents=("v",),
                mechanism=lambda v, noise: np.asarray(v).sum(axis=(-1, -2)) + noise,
                noise=Normal(),
                inverse_noise="additive",
            ),
        ]
    )
    table = collect(model, Design(), 5)
    wanted = model.counterfactual(model.draw(5, seed=0), do={"v": np.ones((2, 2))})
    frame = as_frame(table)
    for given in (table, frame, frame[frame.columns[::-1]]):
        found = model.counterfactual(given, do={"v": np.ones((2, 2))})
        assert found["s"].tobytes() == wanted["s"].tobytes()
    with pytest.raises(ModelError, match="'v' was observed in part"):
        model.counterfactual(frame.drop(columns="v[3]"), do={"s": 0.0})
    partly = model.draw(2, seed=0)["v"].copy()
    partly[1, 0, 1] = np.nan
    with pytest.raises(ModelError, match="observed in part"):
        model.counterfactual({"v": partly}, do={"s": 0.0})
    done = collect(model, Design("single", ("v",), {"v": Normal()}, 0.5), 6)
    with pytest.raises(ModelError, match=r"table\.observational"):
        model.counterfactual(done, do={"s": 0.0})
    assert len(model.counterfactual(done.observational, do={"s": 0.0})["s"]) == 3
    series = SCM(
        [Derived(name="a", parents=(Parent("a", 2),), mechanism=ONE, noise=Normal(), start=1.0)]
    )
    steps, plain = collect(series, Design(), 3, steps=4), series.draw(3, seed=0, steps=4)
    for given in (steps, as_frame(steps).sample(frac=1.0, random_state=0), plain):
        found = series.counterfactual(given, do={"a": Shift(1.0)})
        np.testing.assert_allclose(
            found["a"], series.do({"a": Shift(1.0)}).draw(3, seed=0, steps=4)["a"]
        )
    with pytest.raises(ModelError, match="different lengths"):
        series.counterfactual(steps.rows(slice(0, 7)), do={"a": 0.0})


def lagged() -> SCM:
    """A model with memory, lags of two steps, and a constant of each episode."""
    weights = Linear(weights=(0.5, 1.0))
    return SCM(
        [
            Exogenous(name="k", distribution=Normal()),
            Derived(name="a", parents=(Parent("a", 1), Parent("k")), mechanism=weights,
                    noise=Normal(), start=1.0),
            Derived(name="b", parents=(Parent("b", 1), Parent("a", 2)), mechanism=weights,
                    noise=Normal()),
        ]
    )  # fmt: skip


@pytest.mark.parametrize(
    ("do", "replayed"),
    [
        ({"a": Hard(5.0, at=2)}, {"a": Hard(5.0, at=3)}),
        ({"a": Hard(5.0, during=(2, 4))}, {"a": Hard(5.0, during=(3, 5))}),
        ({"a": Shift(1.0, during=(2, 4))}, {"a": Shift(1.0, during=(3, 5))}),
        ({"k": Hard(2.0, during=(3, 5))}, {"k": Hard(2.0, during=(4, 6))}),
        ({"a": (Hard(0.0, at=1), Hard(3.0, at=4))}, {"a": (Hard(0.0, at=2), Hard(3.0, at=5))}),
    ],
)
def test_interventions_with_times_are_those_of_a_replay(do: Any, replayed: Any) -> None:
    """The instant that a replay begins with comes before the first observed control step."""
    model = lagged()
    found = model.counterfactual(model.draw(2, seed=0, steps=8), do=do)
    assert found.exact
    for episode in range(2):
        other = model.rollout(seed=0, episode=episode, steps=8, do=replayed)
        for name in model:
            np.testing.assert_allclose(found[name][episode], other[name][1:], atol=1e-12)
    with pytest.raises(UnknownOption, match="from control step 0 to 7"):
        model.counterfactual(model.draw(2, seed=0, steps=8), do={"a": Hard(1.0, at=8)})


@pytest.mark.filterwarnings("ignore:few draws fit")
def test_a_hidden_series_has_the_posterior_of_the_smoother() -> None:
    """Linear and normal: the smoothing distribution; forty steps do not end in one draw."""
    model = SCM(
        [
            Derived(name="x", parents=(Parent("x", 1),), mechanism=Linear(weights=(0.8,)),
                    noise=Normal()),
            Derived(name="y", parents=("x",), mechanism=ONE, noise=Normal(0.0, 0.7)),
        ]
    )  # fmt: skip
    for steps, n, close in ((5, 20_000, 0.03), (40, 4_000, 0.5)):
        seen = model.draw(1, seed=3, steps=steps)["y"][0]
        memory = np.linalg.inv(np.eye(steps) - 0.8 * np.eye(steps, k=-1))
        prior = memory @ memory.T
        gain = prior @ np.linalg.inv(prior + 0.49 * np.eye(steps))
        found = model.counterfactual({"y": seen}, do={"y": 0.0}, n=n)
        np.testing.assert_allclose(believed(found, "x")[0], gain @ seen, atol=close)
        assert found.effective[0] > 5.0
        again = model.counterfactual({"y": seen}, do={"y": 0.0}, n=n)
        assert again.factual["x"].tobytes() == found.factual["x"].tobytes()


def test_what_was_set_tells_nothing_of_its_causes() -> None:
    """Observed under interventions: a value that was set, one that was drawn, and their release."""
    model = line()
    found = model.do({"y": 1.0}).counterfactual({"y": 1.0}, do={"x": 3.0}, n=20_000)
    assert believed(found, "x")[0] == pytest.approx(0.0, abs=0.03)
    drawn = model.do({"y": Draw(Box(5.0, 6.0))})
    found = drawn.counterfactual({"x": 1.0}, do={"x": 3.0}, n=20_000)
    assert found["y"] == pytest.approx(5.5, abs=0.02)
    with pytest.raises(ImpossibleObservation, match="'y'"):
        drawn.counterfactual({"x": 1.0, "y": 7.0}, do={"x": 3.0})
    seen = {"x": [1.0] * 50, "y": [1.0] * 50}
    for released, wanted in ((Natural(), 2.0), (Shift(1.0), 3.0)):
        found = model.do({"y": 1.0}).counterfactual(seen, do={"y": released})
        assert not found.exact
        assert found["y"].mean() == pytest.approx(wanted, abs=0.03)
        assert np.std(found.counterfactual["y"]) == pytest.approx(1.0, abs=0.05)
    with pytest.raises(ModelError, match=r"Scale\(0\)"):
        model.do({"y": Scale(0.0)}).counterfactual({"x": 1.0, "y": 0.0}, do={"x": 2.0})


def test_another_noise_is_drawn_and_not_the_one_that_was_found() -> None:
    """An intervention on the noise alone, one on the mechanism alone, and a drawn value."""
    model, seen = line(), {"x": [1.0, 2.0], "y": [3.0, 2.0]}
    other = model.counterfactual(seen, do={"y": Mechanism(noise=Normal(5.0, 0.1))})
    assert not other.exact
    assert other["y"] == pytest.approx([7.0, 9.0], abs=0.02)
    same = model.counterfactual(seen, do={"y": Mechanism(lambda x, noise: 10 * x + noise, ["x"])})
    assert (same.exact, same["y"].tolist()) == (True, [11.0, 18.0])
    cubic = model.do({"y": Mechanism(cubed, ["x"], inverse_noise="monotone")})
    under = cubic.counterfactual({"x": 1.0, "y": 1.0 + 0.5**3 + 0.05}, do={"x": 2.0})
    assert (under.exact, under["y"]) == (True, pytest.approx(2.175))
    noisier = model.do({"y": Mechanism(noise=Normal(0.0, 9.0))}).counterfactual(seen, do={"x": 0.0})
    assert (noisier.exact, noisier["y"].tolist()) == (True, [1.0, -2.0])
    drawn = model.counterfactual(seen, do={"x": Draw(Normal(10.0, 1.0))})
    assert not drawn.exact
    assert drawn["y"] == pytest.approx([21.0, 18.0], abs=0.3)


def test_vectors_that_are_roots_or_have_lags() -> None:
    """Their components have a density each; before the first step stand their starts."""
    model = SCM(
        [
            Exogenous(name="w", shape=(2,), default=(0.0, 0.0), distribution=Normal()),
            Derived(name="a", shape=(2,), parents=(Parent("a", 2), Parent("w")),
                    mechanism=lambda a, w, noise: 0.5 * np.asarray(a) + w + noise, noise=Normal(),
                    inverse_noise="additive", start=(1.0, 2.0)),
        ]
    )  # fmt: skip
    for done in ({"w": (0.0, 1.0)}, {"a": (1.0, -1.0)}):
        seen, wanted = (m.draw(3, seed=4, steps=5) for m in (model, model.do(done)))
        found = model.counterfactual(seen, do=done)
        assert found.exact
        np.testing.assert_allclose(found["a"], wanted["a"], atol=1e-12)


def test_too_many_draws_are_refused() -> None:
    """Before memory ends, with what to do; a smaller n goes."""
    seen = {"y": np.zeros(30_000)}
    with pytest.raises(ModelError, match="fewer rows at once, or a smaller n"):
        line().counterfactual(seen, do={"x": 0.0})
    assert line().counterfactual(seen, do={"x": 0.0}, n=2)["y"].shape == (30_000,)


def test_effects_by_a_covariate_do_not_split_its_values() -> None:
    """A bit has two groups, and the effect of each is exact; other groups have equal sizes."""
    bit: dict[str, Any] = {"dtype": "integer", "bounds": Integers(0, 1)}

    def product(x: Any, z: Any, noise: Any) -> Any:
        return x * (1 + 3 * z) + noise

    model = SCM(
        [
            Exogenous(name="z", distribution=Bernoulli(0.3), **bit),
            Exogenous(name="x", distribution=Normal()),
            Derived(name="y", parents=("x", "z"), mechanism=product, noise=Normal()),
        ]
    )
    asked: dict[str, Any] = {"do": {"x": 1.0}, "versus": {"x": 0.0}, "n": 400}
    for bins in (2, 4):
        groups = model.effect_by("y", by="z", bins=bins, **asked)
        assert [ends for ends, _ in groups] == [(0.0, 0.0), (1.0, 1.0)]
        assert [round(float(effect.mean), 9) for _, effect in groups] == [1.0, 4.0]
        assert sum(effect.n for _, effect in groups) == 400
    quarters = model.effect_by("y", by="x", bins=4, **asked | {"do": {"z": 1}, "versus": {"z": 0}})
    assert [effect.n for _, effect in quarters] == [100] * 4
    assert [ends[1] for ends, _ in quarters] == sorted(ends[1] for ends, _ in quarters)


def test_hidden_categories_have_their_posterior() -> None:
    """Two roots and a table that nobody saw, one of them rare: draws meet every value."""
    bit: dict[str, Any] = {"dtype": "integer", "bounds": Integers(0, 1)}
    kind: dict[str, Any] = {"dtype": "categorical", "bounds": Categories(labels=("a", "b", "c"))}
    table = np.array([[[0.99, 0.01], [0.5, 0.5], [0.2, 0.8]], [[0.1, 0.9], [0.3, 0.7], [0.0, 1.0]]])
    prior = {"d": (0.999, 0.001), "c": (0.5, 0.49, 0.01)}

    def told(d: Any, c: Any, e: Any, noise: Any = 0.0) -> Any:
        return 3 * np.asarray(d) + np.asarray(c) - 2 * np.asarray(e) + noise

    model = SCM(
        [
            Exogenous(name="d", distribution=Bernoulli(0.001), **bit),
            Exogenous(name="c", distribution=Discrete(range(len(prior["c"])), prior["c"]), **kind),
            Derived(name="e", parents=("d", "c"), mechanism=Table(table), **bit),
            Derived(
                name="y",
                parents=("d", "c", "e"),
                mechanism=told,
                noise=Normal(0.0, 0.5),
                inverse_noise="additive",
            ),
        ]
    )
    each = list(np.ndindex(2, 3, 2))
    mass = np.array([prior["d"][d] * prior["c"][c] * table[d, c, e] for d, c, e in each])
    mass *= np.exp(-0.5 * ((3.3 - np.array([told(*k) for k in each])) / 0.5) ** 2)
    mass /= mass.sum()
    found = model.counterfactual({"y": 3.3}, do={"e": 0}, n=20_000)
    assert found.effective[0] > 1_000
    for place, name in enumerate(("d", "c", "e")):
        wanted = mass @ [k[place] for k in each]
        assert believed(found, name)[0] == pytest.approx(wanted, rel=0.05)
    assert found["y"] == pytest.approx(mass @ [3.3 + 2 * e for *_, e in each], rel=0.01)
    lines = Linear(weights=(1.0,))
    rare = [Exogenous(name="d", distribution=Bernoulli(1e-6), **bit)]
    seen = SCM([*rare, Derived(name="t", parents=("d",), mechanism=lines, **bit)])
    assert believed(seen.counterfactual({"t": [1, 0]}, do={"d": 0}), "d") == pytest.approx(
        [1.0, 0.0]
    )


def test_what_was_not_observed_is_not_that_of_the_seed() -> None:
    """Data of a seed and draws of the same seed have nothing in common."""
    model = line()
    seen = model.draw(2000, seed=0)
    found = model.counterfactual({"y": seen["y"]}, do={"x": 0.0}, n=1, seed=0)
    assert abs(np.corrcoef(found.factual["x"][:, 0], seen["x"])[0, 1]) < 0.1


def test_actions_that_were_observed() -> None:
    """They are given, and may be done otherwise; what is done holds before the first step, too."""
    model = SCM(
        [
            Action(name="u", bounds=Box(-1.0, 1.0)),
            Derived(name="s", parents=(Parent("s", 1), Parent("u", 1)),
                    mechanism=Linear(weights=(0.5, 1.0)), noise=Normal()),
        ]
    )  # fmt: skip
    found = model.counterfactual({"u": [0.0, 0.5, 0.2], "s": [0.1, 0.2, 0.8]}, do={"u": 1.0})
    assert found.exact
    assert found["s"] == pytest.approx([0.1 + 1.0, 0.2 + 0.5 + 1.0, 0.8 + 0.75 + 0.5])


def test_a_tolerance_is_a_distance() -> None:
    """Rounded values of a function without noise need one; less than 0 is refused."""
    x = Exogenous(name="x", distribution=Normal())
    model = SCM([x, Derived(name="y", parents=("x",), mechanism=np.exp)])
    seen = {name: values.round(3) for name, values in model.draw(50, seed=0).items()}
    with pytest.raises(ImpossibleObservation, match=r"'y'.*it has no noise"):
        model.counterfactual(seen, do={"x": 0.0})
    assert model.counterfactual(seen, do={"x": 0.0}, tolerance=0.01)["y"] == pytest.approx(1.0)
    with pytest.raises(UnknownOption, match="tolerance"):
        model.counterfactual(seen, do={"x": 0.0}, tolerance=-1.0)


def test_a_constant_of_an_episode_may_be_seen_once() -> None:
    """At any control step; what contradicts it elsewhere is refused."""
    model = lagged()
    seen = model.draw(2, seed=1, steps=5)
    whole = model.counterfactual(seen, do={"a": 0.0})
    once = {**seen, "k": np.array(seen["k"])}
    once["k"][:, [0, 1, 2, 4]] = np.nan
    found = model.counterfactual(once, do={"a": 0.0})
    assert found.exact
    np.testing.assert_allclose(found["b"], whole["b"], atol=1e-12)
    once["k"][0, 1] = 9.0
    with pytest.raises(ImpossibleObservation, match="'k'"):
        model.counterfactual(once, do={"a": 0.0})


@pytest.mark.parametrize("do", [{"a": Shift(1.0)}, {"k": 0.0}, {"k": Shift(1.0)}])
def test_a_constant_of_an_episode_acts_from_before_its_first_step(do: Any) -> None:
    """What the first step looks back at has the constant that was observed, not another one."""
    model = SCM(
        [
            Exogenous(name="k", distribution=Normal()),
            Derived(name="a", parents=(Parent("a", 1), Parent("k", 1)),
                    mechanism=Linear(weights=(0.5, 1.0)), noise=Normal(), start=1.0),
        ]
    )  # fmt: skip
    seen, wanted = (m.draw(3, seed=0, steps=4) for m in (model, model.do(do)))
    found = model.counterfactual(seen, do=do)
    assert found.exact
    np.testing.assert_allclose(found["a"], wanted["a"], atol=1e-12)


def test_what_was_observed_is_shifted() -> None:
    """A root without a distribution, an action, and a root that was observed under a shift."""
    alone = SCM([Exogenous(name="x"), *line().variables[1:]])
    assert alone.counterfactual({"x": 3.0, "y": 6.5}, do={"x": Shift(1.0)})["y"] == 8.5
    shifted = line().do({"x": Shift(1.0)})
    for done, wanted in (({"x": Shift(2.0)}, 8.5), ({"x": Natural()}, 4.5), ({"x": 0.0}, 0.5)):
        found = shifted.counterfactual({"x": 3.0, "y": 6.5}, do=done)
        assert (found.exact, found["y"]) == (True, pytest.approx(wanted))
    acted = SCM(
        [
            Action(name="u", bounds=Box(-1.0, 1.0)),
            Derived(name="s", parents=("u",), mechanism=Linear(weights=(2.0,)), noise=Normal()),
        ]
    )
    assert acted.counterfactual({"u": 0.5, "s": 1.5}, do={"u": Scale(-1.0)})["s"] == -0.5


@pytest.mark.parametrize("wrong", [[[1.0], [1.0, 2.0]], {"y": 1.0}, 1j, object(), "much"])
def test_what_is_not_a_number_is_refused_by_name(wrong: Any) -> None:
    """Ragged lists, nested dictionaries, complex numbers and words."""
    with pytest.raises(ImpossibleObservation, match="'x': observations are numbers"):
        line().counterfactual({"x": wrong, "y": 1.0}, do={"x": 1.0})


def test_a_hidden_constant_acts_from_before_the_first_step() -> None:
    """Its posterior counts what it did to the first observation: normal, in closed form."""
    model = SCM(
        [
            Exogenous(name="k", distribution=Normal()),
            Derived(name="a", parents=(Parent("k", 1),), mechanism=ONE, noise=Normal()),
        ]
    )
    found = model.counterfactual({"a": [3.0, 1.0]}, do={"k": 0.0}, n=20_000)
    assert believed(found, "k")[0, 0] == pytest.approx(4.0 / 3.0, abs=0.03)
    assert found["a"] == pytest.approx([3.0 - 4.0 / 3.0, 1.0 - 4.0 / 3.0], abs=0.03)


@pytest.mark.parametrize("back", [None, "function"])
def test_one_noise_of_a_vector(back: str | None) -> None:
    """Noise without components of its own moves all numbers of a variable."""

    def both(x: Any, noise: Any) -> Any:
        return np.stack([x + noise, x - noise], axis=-1)

    inverse = None if back is None else lambda v, x: 0.5 * (v[..., 0] - v[..., 1])
    v = Derived(name="v", shape=(2,), parents=("x",), mechanism=both, noise=Normal(),
                noise_shape=(), inverse_noise=inverse)  # fmt: skip
    model = SCM([Exogenous(name="x", distribution=Normal()), v])
    seen, wanted = (m.draw(3, seed=0) for m in (model, model.do({"x": 0.0})))
    found = model.counterfactual(seen, do={"x": 0.0}, tolerance=1e-6 if back else 0.2)
    assert found.exact == (back is not None)
    np.testing.assert_allclose(found["v"], wanted["v"], atol=1e-9 if back else 0.3)


def random_model(rng: np.random.Generator) -> SCM:
    """A few roots and lines of any lags, some with noise, some without."""
    names = "abcde"[: rng.integers(3, 6)]
    found: list[Any] = []
    for place, name in enumerate(names):
        if place == 0 or rng.random() < 0.2:
            source = [Normal(), Continuous("laplace"), None][rng.integers(0, 3)]
            found.append(Exogenous(name=name, distribution=source, default=1.0))
            continue
        lags = {other: 0 for other in names[:place] if rng.random() < 0.5}
        lags |= {other: int(rng.integers(1, 3)) for other in names if rng.random() < 0.2}
        parents = [Parent(other, lag) for other, lag in lags.items()]
        weights = Linear(weights=tuple(rng.normal(size=len(parents)).tolist()))
        noise = [Normal(), Box(-1.0, 1.0), None][rng.integers(0, 3)]
        found.append(Derived(name=name, parents=parents, mechanism=weights, noise=noise, start=0.5))
    return SCM(found)


def random_request(rng: np.random.Generator, model: SCM, *kinds: Any) -> dict[str, Any]:
    """Interventions of some kinds, none of which draws, on some variables."""
    return {
        name: kinds[rng.integers(0, len(kinds))](float(rng.uniform(0.5, 2.0)))
        for name in model
        if rng.random() < 0.4
    }


@pytest.mark.parametrize("seed", range(40))
def test_what_was_observed_whole_is_that_of_the_seed(seed: int) -> None:
    """Of any model, observed under shifts and scales, under any other intervention."""
    rng = np.random.default_rng(seed)
    model = random_model(rng)
    observed = model.do(random_request(rng, model, Shift, Scale))
    do = random_request(rng, model, float, Shift, Scale, lambda _: Natural())
    steps = {"steps": 4} if observed.is_temporal else {}
    if observed.do(do).is_temporal != observed.is_temporal:
        pytest.skip("the intervention takes the last lagged edge away")
    seen, wanted = (m.draw(3, seed=seed, **steps) for m in (observed, observed.do(do)))
    found = observed.counterfactual(seen, do=do)
    assert found.exact
    for name in model:
        np.testing.assert_allclose(found[name], wanted[name], atol=1e-9)


def test_what_is_drawn_before_the_first_step_is_not_exact() -> None:
    """A mechanism with noise replaces the start too, and nobody observed that draw."""
    model = lagged()
    seen = model.draw(2, seed=0, steps=3)
    found = model.counterfactual(seen, do={"a": Mechanism(lambda noise: 2.0 * noise, [])})
    assert not found.exact
    assert found.effective == pytest.approx([1000.0, 1000.0])
    assert model.counterfactual(seen, do={"b": Mechanism(lambda noise: noise, [])}).exact


@pytest.mark.parametrize("was", [{}, {"c": Shift(0.5)}, {"c": Scale(2.0)}])
@pytest.mark.parametrize("do", [{"c": 1.0}, {"c": Shift(1.0)}, {"x": Shift(1.0)}, {"c": Natural()}])
def test_other_coordinates_of_what_was_observed(was: Any, do: Any) -> None:
    """They may be shifted, when the unit was observed and afterwards."""
    model = SCM(
        [
            Exogenous(name="x", distribution=Normal(3.0, 0.1)),
            Derived(name="c", parents=("x",), mechanism=np.log, inverse=np.exp),
            Derived(name="y", parents=("x",), mechanism=ONE, noise=Normal()),
        ]
    ).do(was)
    found, wanted = model.counterfactual(model.draw(3, seed=0), do=do), model.do(do)
    assert found.exact
    for name, values in wanted.draw(3, seed=0).items():
        np.testing.assert_allclose(found[name], values, rtol=1e-9)


@pytest.mark.parametrize(
    ("back", "match"),
    [
        (lambda v, x: {}["none"], "raised KeyError"),
        (lambda v, x: np.zeros(7), "raised ValueError"),
        (lambda v, x: v, "no value of its noise"),
    ],
)
def test_a_wrong_inverse_is_named(back: Any, match: str) -> None:
    """One that raises, has another shape, or is not the inverse."""
    with pytest.raises((FunctionFailure, ImpossibleObservation), match=f"'y'.*{match}"):
        line(mechanism=lambda x, noise: x + noise, inverse_noise=back).counterfactual(
            {"x": 1.0, "y": 2.0}, do={"x": 0.0}
        )


@pytest.mark.parametrize("space", [Either(Box(0.0, 1.0), Box(2.0, 3.0)), Box(1.0, 1.0)])
def test_what_lies_outside_a_space_is_impossible(space: Any) -> None:
    """Whatever its density is."""
    model = SCM([Exogenous(name="x", distribution=space), *line().variables[1:]])
    assert model.counterfactual({"x": 1.0, "y": 2.0}, do={"x": 0.5})["y"] == 1.0
    with pytest.raises(ImpossibleObservation, match="'x'"):
        model.counterfactual({"x": 1.5, "y": 2.0}, do={"x": 0.5})


@pytest.mark.filterwarnings("ignore:few draws fit")
@pytest.mark.parametrize(
    "act",
    [
        {"x": Mechanism(Linear(weights=(0.5,)), [Parent("y", 1)], noise=Normal())},
        {"x": Mechanism(Linear(weights=()), [], noise=Normal())},
        {"x": Draw(Normal(3.0, 1.0))},
        {"y": Draw(Normal())},
        {"y": Scale(2.0)},
    ],
)
def test_noise_under_an_intervention_lasts_as_it_is_drawn(act: dict[str, Any]) -> None:
    """Of an episode or of a step: a unit of another mechanism is the one that a draw gives."""
    two = Linear(weights=(1.0, 0.5))
    model = SCM(
        [
            Exogenous(name="x", distribution=Normal()),
            Derived(name="y", parents=("x", Parent("y", 1)), mechanism=two, noise=Normal()),
            Derived(name="z", parents=("y", Parent("z", 1)), mechanism=two, noise=Normal()),
        ]
    ).do(act)
    seen = model.draw(20, seed=0, steps=5)
    found = model.counterfactual(seen, do={"z": 1.0})
    wanted = model.do({"z": 1.0}).draw(20, seed=0, steps=5)
    for name in model:
        assert np.allclose(found[name], wanted[name])
    follows = isinstance(act.get("x"), Mechanism)
    part = {"x": [seen["x"][0, 0], *[np.nan] * 4], "y": seen["y"][0]}
    again = model.counterfactual(part, do={"z": 1.0}, n=50)["x"]
    assert bool(np.ptp(again) > 0.1) is follows


@pytest.mark.parametrize(
    "given",
    [
        pd.to_timedelta([1.0, 2.0], unit="s"),
        pd.to_datetime(["2024-01-01", "2024-01-02"]),
        [np.timedelta64(1, "s"), None],
        np.array([np.datetime64("2024-01-01"), np.datetime64("2024-01-02")], dtype=object),
        np.array([pd.Timedelta(1, "s"), None], dtype=object),
        pd.Series(["2020", "2021"]).astype("period[Y]"),
        ["1.0", "2.0"],
        [b"1", b"2"],
        pd.Series(["1", pd.NA], dtype="string"),
        [1.0, "2"],
        [1.0, 2.0 + 1.0j],
    ],
    ids=lambda given: type(given).__name__,
)
def test_dates_durations_and_text_are_not_numbers(given: Any) -> None:
    """They are refused alike in a table, a frame and as observations: one second is not 1e6."""
    model = SCM([Exogenous(name="wait", unit="s", distribution=Normal(0.0, 10.0))])
    for observed in ({"wait": given}, pd.DataFrame({"wait": given})):
        with pytest.raises(ImpossibleObservation, match=r"'wait': .*, not real numbers"):
            model.counterfactual(observed, do={})
        with pytest.raises(ModelError, match=r"'wait': .*, not real numbers"):
            Dataset.of(observed, ["wait"])


@pytest.mark.parametrize("given", [[3, pd.NA], pd.Series([3, pd.NA], dtype="Int64"), [3.0, None]])
def test_what_is_missing_is_missing_everywhere(given: Any) -> None:
    """``pandas.NA`` is not observed in one unit, and no number of a table."""
    model = SCM([Exogenous(name="x", distribution=Normal())])
    for observed in ({"x": given}, pd.DataFrame({"x": given})):
        found = model.counterfactual(observed, do={}, n=50).counterfactual["x"]
        assert (found[0] == 3.0).all()
        assert found[1].std() > 0.5
        with pytest.raises(ModelError, match="row 1 of 'x' is not finite"):
            Dataset.of(observed, ["x"])


def test_a_file_of_rows_without_intervention_is_observed(tmp_path: Path) -> None:
    """Empty targets of a CSV file are none; steps that are text, or no component, are refused."""
    series = SCM(
        [Derived(name="a", parents=(Parent("a", 1),), mechanism=ONE, noise=Normal(), start=1.0)]
    )
    steps = as_frame(collect(series, Design(), 2, steps=12))
    steps.to_csv(tmp_path / "a.csv", index=False)
    frame = pd.read_csv(tmp_path / "a.csv").sample(frac=1.0, random_state=0)
    found, wanted = (series.counterfactual(f, do={"a": Shift(1.0)}) for f in (frame, steps))
    np.testing.assert_allclose(found["a"], wanted["a"], rtol=1e-12)
    with pytest.raises(ModelError, match=r"'step'.*whole numbers"):
        series.counterfactual(frame.astype({"step": str}), do={"a": 0.0})
    frame["intervention_targets"] = "a"
    with pytest.raises(ModelError, match=r"table\.observational"):
        series.counterfactual(frame, do={"a": 0.0})
    twice = pd.DataFrame([[1.0, 2.0]], columns=["x", "x"])
    with pytest.raises(ModelError, match="have one name"):
        line().counterfactual(twice, do={"x": 0.0})
    vector = SCM([Exogenous(name="v", shape=(2,), default=(0.0, 0.0), distribution=Normal())])
    with pytest.raises(UnknownVariable, match=r"v\[2\]"):
        vector.counterfactual({"v[0]": 1.0, "v[1]": 1.0, "v[2]": 1.0}, do={})


@pytest.mark.parametrize("dtype", ["string[python]", "object", "category"])
def test_missing_labels_of_pandas_are_not_observed(dtype: str) -> None:
    """The first unit has its label; the second, pandas.NA, is drawn: about half of them are wet."""
    rain = Categories(labels=("no", "yes"))
    root = Exogenous(name="rain", dtype="categorical", bounds=rain, distribution=Bernoulli(0.5))
    frame = pd.DataFrame({"rain": pd.Series(["no", pd.NA], dtype=dtype)})
    found = SCM([root]).counterfactual(frame, do={}, n=400)
    dry, open_ = found.probability("rain", "no")
    assert dry == pytest.approx(1.0)
    assert open_ == pytest.approx(0.5, abs=0.1)


def covered(
    found: Counterfactuals, name: str, grid: np.ndarray, log_density: np.ndarray
) -> tuple[float, float]:
    """Give the mass of a posterior in the 95 % interval of a cause, and its mean, from a grid."""
    mass = np.cumsum(np.exp(log_density - log_density.max()))
    low, high = (np.interp(end, grid, mass / mass[-1]) for end in found.interval(name))
    density = np.diff(mass, prepend=0.0)
    return float(high - low), float((density * grid).sum() / density.sum())


def add(function: Any, noise: Any) -> SCM:
    """A hidden normal cause, a function of it, and noise that is added."""
    y = Derived(name="y", parents=("x",), mechanism=lambda x, noise: function(x) + noise,
                noise=noise, inverse_noise="additive")  # fmt: skip
    return SCM([Exogenous(name="x", distribution=Normal()), y])


GRID = np.linspace(-12.0, 12.0, 240_001)


@pytest.mark.parametrize("far", range(7))
@pytest.mark.parametrize(
    ("function", "noise", "log_noise", "at"),
    [
        (lambda x: x, Normal(), stats.norm.logpdf, lambda far: far * math.sqrt(2.0)),
        (lambda x: x + x**3 / 3.0, Normal(), stats.norm.logpdf, lambda far: far + far**3 / 3.0),
        (np.square, Normal(), stats.norm.logpdf, lambda far: far**2),  # two modes
        (np.sinh, Continuous("laplace"), stats.laplace.logpdf, lambda far: 1.7 * far),
        (lambda x: x, Box(-1.0, 1.0), stats.uniform(-1.0, 2.0).logpdf, lambda far: 1.15 * far),
    ],
    ids=["line", "cubic", "square", "laplace", "box"],
)
def test_an_interval_covers_however_far_the_evidence_is(
    function: Any, noise: Any, log_noise: Any, at: Any, far: int
) -> None:
    """Up to six standard deviations: the mass is 95 % and the mean right, against a dense grid."""
    seen = float(at(far))
    for seed in range(3):
        found = add(function, noise).counterfactual({"y": seen}, do={}, seed=seed)
        with np.errstate(divide="ignore"):
            log_density = stats.norm.logpdf(GRID) + log_noise(seen - function(GRID))
        mass, mean = covered(found, "x", GRID, log_density)
        assert mass == pytest.approx(0.95, abs=0.05)
        spread = np.diff(found.interval("x"))[0]
        assert believed(found, "x")[0] == pytest.approx(mean, abs=0.1 * spread)
        assert found.effective[0] > 100.0


def test_far_evidence_has_the_posterior_of_the_closed_form() -> None:
    """Twenty hidden causes, two sums of them and three units: normal, with all covariances."""
    rng = np.random.default_rng(0)
    weights, names = rng.normal(size=(2, 20)), tuple(f"x{i}" for i in range(20))
    model = SCM(
        [
            *(Exogenous(name=name, distribution=Normal()) for name in names),
            *(
                Derived(name=name, parents=names, mechanism=Linear(weights=tuple(row)),
                        noise=Normal())
                for name, row in zip("yz", weights.tolist(), strict=True)
            ),
        ]
    )  # fmt: skip
    prior = weights @ weights.T + np.eye(2)
    for far in (3.0, 6.0):
        seen = far * np.sqrt(np.diag(prior)) * np.array([[1.0, 1.0], [1.0, -1.0], [0.0, 1.0]])
        found = model.counterfactual(dict(zip("yz", seen.T, strict=True)), do={}, seed=1)
        wanted = seen @ np.linalg.solve(prior, weights)
        spread = np.sqrt(1.0 - (weights * np.linalg.solve(prior, weights)).sum(axis=0))
        masses = []
        for place, name in enumerate(names):
            close = {"atol": 0.3 * spread[place]}
            np.testing.assert_allclose(believed(found, name), wanted[:, place], **close)
            ends = (np.array(found.interval(name)) - wanted[:, place]) / spread[place]
            masses.append(np.diff(stats.norm.cdf(ends), axis=0))
        assert np.mean(masses) == pytest.approx(0.95, abs=0.01)


def test_what_cannot_be_adapted_warns() -> None:
    """A hidden cause of six values and five factors of unknown size: few draws, and it is said."""
    factors = tuple("abcdef")

    def product(*given: Any, noise: Any) -> Any:
        return np.prod(np.stack(given), axis=0) + noise

    y = Derived(name="y", parents=factors, noise=Normal(0.0, 1e-4), inverse_noise="additive",
                mechanism=product)  # fmt: skip
    model = SCM([*(Exogenous(name=name, distribution=Normal()) for name in factors), y])
    with pytest.warns(UserWarning, match=r"few draws fit the observations of row 1.*below 100"):
        found = model.counterfactual({"y": [0.0, 3000.0]}, do={})
    assert found.effective[1] < 100.0


def test_evidence_beyond_all_draws_is_reached() -> None:
    """Bounded noise: no draw of N(0, 1) comes within 1 of 8, and yet the cause is found."""
    found = add(lambda x: x, Box(-1.0, 1.0)).counterfactual({"y": [0.0, 8.0]}, do={}, seed=0)
    wanted = stats.truncnorm(7.0, 9.0)
    assert believed(found, "x")[1] == pytest.approx(wanted.mean(), abs=0.02)
    assert found.interval("x")[1][1] == pytest.approx(wanted.ppf(0.975), abs=0.1)
    with pytest.raises(ModelError, match=r"'y': in row 1, none of 1000 draws"):
        add(np.tanh, Box(-1.0, 1.0)).counterfactual({"y": [0.0, 3.0]}, do={})


def test_discrete_noise_that_is_not_inverted_has_its_probabilities() -> None:
    """One of two rare bits is set: both with probability 0.01 / 0.19, not one of three ways."""
    y = Derived(name="y", parents=("x",), noise=Bernoulli(0.1), noise_shape=(2,),
                mechanism=lambda x, noise: x * noise.max(axis=-1))  # fmt: skip
    model = SCM([Exogenous(name="x", default=1.0), y])
    both = Mechanism(lambda x, noise: x * noise.min(axis=-1), ["x"])
    found = model.counterfactual({"x": 1.0, "y": 1.0}, do={"y": both}, n=20_000)
    assert found["y"] == pytest.approx(0.01 / 0.19, abs=0.005)
