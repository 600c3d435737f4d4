"""Verification and discovery of step functions and equations: what counts as an effect."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from scm_world import SCM, World, discover, verify
from scm_world.discovery.data import Design, collect
from scm_world.discovery.learners import learn
from scm_world.discovery.metrics import sortability
from scm_world.errors import EngineFailure
from scm_world.queries.experiments.effects import Effects
from scm_world.variables import Box, Derived, Exogenous, Linear, Measured, Normal

K = Exogenous(name="k", default=1.0, bounds=Box(0.0, 2.0))


def small(unit: float, *, bounded: bool, parents: tuple[str, ...]) -> World:
    """Build a world in which b follows a, in a unit of this size."""

    def step(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
        b = 0.5 * state["b"] + unit * state["a"]
        return {"a": 0.9 * state["a"] + parameters["k"], "b": b}

    bounds = {"bounds": Box(0.0, 40.0 * unit)} if bounded else {}
    states = [
        Measured(name="a", default=1.0, parents=("a", "k"), bounds=Box(0.0, 20.0)),
        Measured(name="b", default=unit, parents=parents, **bounds),
    ]
    return World(step, control_dt=0.1, parameters=[K], states=states)


@pytest.mark.parametrize("bounded", [False, True])
@pytest.mark.parametrize("unit", [1.0, 1e-30, 1e14])
def test_an_effect_counts_in_every_unit(unit: float, bounded: bool) -> None:
    """An edge is found, and its absence refuted, whatever the unit of the child."""
    whole = verify(small(unit, bounded=bounded, parents=("b", "a")), probes=8)
    assert whole.outcome == "confirmed"
    cut = verify(small(unit, bounded=bounded, parents=("b",)), probes=8)
    assert [edge.key for edge in cut.undeclared] == [("a", "b", 1)]
    strong = whole.strength["a", "b", 1]
    assert 0.01 < strong < 10.0  # a tenth of the way to another value of a


@pytest.mark.parametrize("weight", [1e-14, 1e-200, 1e14])
def test_equations_have_units_of_any_size(weight: float) -> None:
    """The one edge of q = weight k is confirmed and discovered."""
    q = Derived(name="q", parents=("k",), mechanism=Linear(weights=(weight,)))
    model = SCM([Exogenous(name="k", distribution=Box(0.0, 1.0)), q])
    assert verify(model).outcome == "confirmed"
    found = discover(model, probes=8)
    assert (found.score.shd, found.outcome) == (0, "confirmed")


def test_rounding_is_no_effect() -> None:
    """An effect below the last digits of the child's value does not count: a + 1e-13 k."""
    b = Derived(name="b", parents=("a", "k"), mechanism=Linear(weights=(1.0, 1e-13)))
    roots = [Exogenous(name=name, distribution=Box(1.0, 2.0)) for name in ("a", "k")]
    found = verify(SCM([*roots, b]), probes=8)
    assert found.never_fired == (("k", "b", 0),)


def test_an_unstable_variable_hides_no_effect_on_others() -> None:
    """The noise floor of c is that of c."""
    effects = Effects()
    effects.see_unstable("c", 100.0)
    for effect in ("b", "c"):
        effects.see(("a", effect, 1), np.array(2.0), np.array(1.0))
    assert effects.edges(()) == {("a", "b", 1)}


def test_discovery_and_verification_have_one_verdict() -> None:
    """Both refute equations that draw random numbers of their own, and see the other edges."""
    generator = np.random.default_rng(0)

    def own(a: Any) -> Any:
        return a + generator.normal()

    model = SCM(
        [
            Exogenous(name="a", distribution=Box(0.0, 1.0)),
            Derived(name="b", parents=("a",), mechanism=Linear(weights=(0.01,))),
            Derived(name="c", parents=("a",), mechanism=own),
        ]
    )
    for found in (verify(model, probes=8), discover(model, probes=8)):
        assert found.outcome == "refuted"
        assert [*found.unstable] == ["c"]
        assert ("a", "b", 0) in found.found


def remembering() -> Callable[..., dict[str, Any]]:
    """Make a function that adds what it was given before."""
    hidden = {"z": 0.0}

    def step(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
        hidden["z"] = 0.5 * hidden["z"] + 0.1 * state["a"]
        return {"a": 0.9 * state["a"] + parameters["k"] + hidden["z"]}

    return step


def drawing(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
    """Draw a random number of its own."""
    return {"a": 0.9 * state["a"] + parameters["k"] + np.random.normal()}  # noqa: NPY002 # the fault


def late(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
    """Draw a random number of its own once k was set."""
    own = np.random.normal() if parameters["k"] > 1.0 else 0.0  # noqa: NPY002 # the fault
    return {"a": 0.9 * state["a"] + parameters["k"] + own}


@pytest.mark.parametrize("vectorized", [False, True])
@pytest.mark.parametrize("make", [remembering, lambda: drawing])
def test_memory_and_own_random_numbers_are_refused(
    make: Callable[[], Callable[..., Any]], vectorized: bool
) -> None:
    """The first step that shows them is an error, whatever is asked."""
    states = [Measured(name="a", default=1.0, parents=("a", "k"))]

    def world(**options: Any) -> Any:
        given = {"parameters": [K], "states": states, "vectorized": vectorized, **options}
        return World(make(), control_dt=0.1, **given)

    asked: tuple[Callable[[], Any], ...] = (
        lambda: world().rollout(None, seed=0, steps=1),
        lambda: world().effect("a", do={"k": 1.0}, versus={"k": 0.0}, n=40, steps=2),
        lambda: discover(world(), probes=1),
        lambda: verify(world(), probes=1),
    )
    for ask in asked:
        with pytest.raises(
            EngineFailure, match=r"another 'a' when it is called again.*a memory or"
        ):
            ask()


def test_an_act_that_wakes_random_numbers_is_followed_by_a_check() -> None:
    """Steps after an intervention are checked, too, and the refused step changes nothing."""
    states = [Measured(name="a", default=1.0, parents=("a", "k"))]
    world = World(late, control_dt=0.1, parameters=[K], states=states)
    world.reset(seed=0)
    for _ in range(37):
        world.step([])
    world.do({"k": 1.5})
    before = world.snapshot()
    with pytest.raises(EngineFailure, match="random numbers of its own"):
        world.step([])
    assert world.index == 37
    world.restore(before)
    world.do({"k": 1.0})
    world.step([])
    assert world.index == 38


def test_noise_that_is_given_is_no_memory() -> None:
    """A function whose randomness is its argument is taken as it is, to the last bit."""

    def step(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
        return {"a": 0.9 * state["a"] + parameters["k"] + noise["a"]}

    states = [Measured(name="a", default=1.0, parents=("a", "k"))]
    world = World(step, control_dt=0.1, parameters=[K], states=states, noise={"a": Normal()})
    episode = world.rollout(None, seed=0, steps=20)
    assert episode.counterfactual({}) == episode


@pytest.mark.parametrize("unit", [1.0, 1e-14, 1e-200])
def test_a_function_that_mixes_episodes_is_called_for_each_alone(unit: float) -> None:
    """Also where it gives tiny numbers: the mean of one number is that number."""

    def mean(a: Any) -> Any:
        return unit * np.mean(a)

    model = SCM(
        [
            Exogenous(name="a", distribution=Normal()),
            Derived(name="y", parents=("a",), mechanism=mean),
        ]
    )
    table = collect(model, Design(), 50)
    np.testing.assert_allclose(table["y"], unit * table["a"], rtol=1e-12, atol=0.0)


@pytest.mark.parametrize("unit", [1e-14, 1e14])
def test_learners_and_scores_do_not_depend_on_the_unit(unit: float) -> None:
    """The same rows in another unit have the same correlations, and the same R² sortability."""
    plain = collect(chain(1.0), Design(), 300)
    other = collect(chain(unit), Design(), 300)
    np.testing.assert_allclose(other["y"], unit * plain["y"])
    assert learn("correlation", other).directed == learn("correlation", plain).directed
    assert plain.truth is not None
    scores = [sortability(table, plain.truth)["r2"] for table in (plain, other)]
    assert scores[0] == pytest.approx(scores[1])


def chain(unit: float) -> SCM:
    """Make a → y → z, where y has another unit."""
    y, z = Linear(weights=(unit,)), Linear(weights=(1.0 / unit,))
    return SCM(
        [
            Exogenous(name="a", distribution=Normal()),
            Derived(name="y", parents=("a",), mechanism=y, noise=Normal(0.0, unit)),
            Derived(name="z", parents=("y",), mechanism=z, noise=Normal()),
        ]
    )
