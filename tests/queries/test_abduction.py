"""Counterfactuals of observed units: abduction, action, prediction."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from scm_world import SCM
from scm_world.errors import ImpossibleObservation, ModelError, UnknownOption, UnknownVariable
from scm_world.variables import (
    Bernoulli,
    Box,
    Categorical,
    Categories,
    Derived,
    Draw,
    Exogenous,
    Integers,
    Laplace,
    Linear,
    Mechanism,
    Normal,
    Parent,
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
                noise=Laplace(),
            ),
            Derived(name="z", parents=("y",), mechanism=cubed, noise=Normal()),
            Derived(name="w", parents=("x",), mechanism=scaled, noise=Normal(0.0, 0.5)),
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


def test_two_noises_of_one_value_are_drawn_by_their_density() -> None:
    """|e| = 1 has two solutions; a normal noise of mean 0.5 has them as e to 1."""
    model = SCM(
        [
            Exogenous(name="x"),
            Derived(name="y", parents=("x",), mechanism=folded, noise=Normal(0.5, 1.0)),
            Derived(name="e", parents=("x",), mechanism=folded, noise=Normal()),
        ]
    )
    found = model.counterfactual({"x": 0.0, "y": 1.0, "e": 0.3}, do={"x": 2.0}, n=4_000)
    assert not found.exact
    assert found["y"] == pytest.approx(3.0, abs=1e-9)
    raised = model.do({"y": Mechanism(cubed, ["x"])})
    seen = raised.counterfactual({"x": 0.0, "y": 1.0, "e": 0.3}, do={"x": 1.0})
    assert seen["y"] == pytest.approx(2.0)


def test_a_table_keeps_the_category_that_is_most_likely_the_same() -> None:
    """Noise lies in the range of the category: Pearl's bounds, for one uniform noise."""
    kind: dict[str, Any] = {"dtype": "categorical", "bounds": Categories(labels=("dry", "wet"))}
    model = SCM(
        [
            Exogenous(name="rain", distribution=Categorical([0.5, 0.5]), **kind),
            Derived(
                name="grass",
                parents=("rain",),
                mechanism=Table([[0.9, 0.1], [0.2, 0.8]]),
                **kind,
            ),
        ]
    )
    found = model.counterfactual({"rain": 0, "grass": 0}, do={"rain": "wet"}, n=20_000)
    assert found["grass"] == pytest.approx(0.7 / 0.9, abs=0.01)
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
            Derived(name="y", parents=("x",), mechanism=added, noise=Normal()),
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


def test_what_cannot_be_is_refused_by_name() -> None:
    """Outside the support, against a function without noise, and what nobody can invert."""
    with pytest.raises(ImpossibleObservation, match="'x'") as problem:
        chain().counterfactual({"x": 2.0}, do={"u": 0.0})
    assert problem.value.variable == "x"
    double = Derived(name="y", parents=("x",), mechanism=Linear(weights=(2.0,)))
    model = SCM([Exogenous(name="x", distribution=Normal()), double])
    with pytest.raises(ImpossibleObservation, match="'y'"):
        model.counterfactual({"x": 1.0, "y": 3.0}, do={"x": 0.0})
    with pytest.raises(ImpossibleObservation, match="observe them"):
        model.counterfactual({"y": 3.0}, do={"x": 0.0})
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
