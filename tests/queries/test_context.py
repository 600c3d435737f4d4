"""A context below what is asked: given, start, nature and curricula, and refusals in it."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import gymnasium
import numpy as np
import pytest

from scm_world import SCM, Derived, Exogenous, Linear, Mechanism, Parent, World
from scm_world.curricula import CurriculumEnv, make_vec, resample, together
from scm_world.discovery.data import Design, collect
from scm_world.errors import ActionError, InterventionError, UnknownOption
from scm_world.graph import from_json, to_json
from scm_world.queries import Outcome
from scm_world.variables import Draw, Hard, Natural, Normal, Scale, Shift

MASS, FRICTION = "tool_block.mass", "floor_friction"
FROM_A: dict[str, Any] = {"nature": {MASS: "A"}, "steps": 3, "policy": None}


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    """One world for all tests; none of them changes it."""
    with World("pushing", backend="fake") as made:
        yield made


def test_a_shift_of_what_nature_drew_has_exactly_its_size(world: World) -> None:
    """Each unit keeps its own mass, plus the shift; a scale by one, a shift by zero do nothing."""
    seen, shifted = (
        world.sample(20, do, outcomes=[MASS], **FROM_A)[MASS] for do in (None, {MASS: Shift(0.01)})
    )
    assert np.ptp(seen) > 0.01
    np.testing.assert_array_equal(shifted, seen + 0.01)
    for act in (Scale(1.0), Shift(0.0)):
        assert world.effect(MASS, do={MASS: act}, n=20, **FROM_A).mean == 0.0
        assert world.effect(MASS, do={"tool_*.mass": act}, n=20, **FROM_A).mean == 0.0
    over = world.effect_over(MASS, name=MASS, values=[Scale(1.0), Scale(2.0)], n=20, **FROM_A)
    assert over[0].mean == pytest.approx(seen.mean(), rel=1e-12)


def test_a_shift_of_a_cause_moves_its_effect_by_the_coefficient() -> None:
    """Of +1 on y = 2a under a ~ N(50, 1) it is exactly 2 up to rounding, with no variance."""
    y = Derived(name="y", parents=("a",), mechanism=Linear(weights=(2.0,)))
    model = SCM([Exogenous(name="a"), y])
    asked: dict[str, Any] = {"do": {"a": Shift(1.0)}, "n": 50}
    effects = (
        model.effect("y", nature={"a": Draw(Normal(50.0, 1.0))}, **asked),
        model.given({"a": Draw(Normal(50.0, 1.0))}).effect("y", **asked),
        World(model).given({"a": Draw(Normal(50.0, 1.0))}).effect("y", **asked),
    )
    for effect in effects:
        assert effect.mean == pytest.approx(2.0, abs=1e-12)


def test_a_given_mechanism_stays_under_a_shift(world: World) -> None:
    """The shifted friction follows the mass of each unit."""
    follows = {MASS: "A", FRICTION: Mechanism(Linear(weights=(10.0,)), [MASS])}
    how: dict[str, Any] = {**FROM_A, "nature": follows, "outcomes": [MASS, FRICTION]}
    found = world.sample(5, {FRICTION: Shift(0.1)}, **how)
    np.testing.assert_allclose(found[FRICTION], 10.0 * found[MASS] + 0.1, rtol=1e-14)


def test_windows_end_in_the_value_of_the_unit(world: World) -> None:
    """After a window, and after a release, a variable is what its context says, in every unit."""
    path = Outcome(MASS, "path")
    own = world.sample(2, outcomes=[MASS], **FROM_A)[MASS]
    window = {MASS: Hard(0.05, during=(1, 2))}
    found = world.sample(2, window, outcomes=[path], **FROM_A)["path tool_block.mass"]
    wanted = [[mass, 0.05, mass, mass] for mass in own]
    np.testing.assert_array_equal(found, wanted)
    with world.given({MASS: 0.03}) as heavy:
        both = {MASS: (Hard(0.05), Natural(at=2))}
        assert heavy.rollout(None, steps=3, do=both)[MASS].tolist() == [0.05, 0.05, 0.03, 0.03]


def test_a_later_act_changes_no_instant_before_it(world: World) -> None:
    """Under ``given``, under ``start`` and in a model the past is that of the context."""
    later = {MASS: Hard(0.05, at=2)}
    with world.given({MASS: 0.03}) as given:
        assert given.rollout(None, steps=3, do=later)[MASS].tolist() == [0.03, 0.03, 0.05, 0.05]
        first = Outcome(MASS, "first")
        assert given.effect(first, do=later, n=3, steps=3, policy=None).mean == 0.0
    env: Any = gymnasium.make("scm_world/Pushing-v0", backend="fake", start={MASS: 0.03})
    env.reset(seed=0, options={"do": later})
    masses = []
    for _ in range(4):
        masses.append(float(env.unwrapped.world[MASS]))
        env.step(env.action_space.sample())
    assert masses == [0.03, 0.03, 0.05, 0.05]


def test_a_plan_and_a_counterfactual_agree(world: World) -> None:
    """What takes the place of a window within it stays when the window ends."""
    window = Hard(0.05, during=(1, 4))
    one = world.rollout(None, steps=5, do={MASS: (window, Hard(0.09, at=2))})
    two = world.rollout(None, steps=5, do={MASS: window}).counterfactual({MASS: 0.09}, at=2)
    assert one[MASS].tolist() == two[MASS].tolist() == [0.02, 0.05, 0.09, 0.09, 0.09, 0.09]
    held = world.rollout(None, steps=5, do={MASS: (0.03, Hard(0.05, during=(2, 4)))})
    assert held[MASS].tolist() == [0.03, 0.03, 0.05, 0.05, 0.03, 0.03]


def test_curricula_compose() -> None:
    """A scale acts on what a part before it draws; what is asked lies above, in vectors, too."""
    part = together(resample(MASS, "A"), {MASS: Scale(2.0)})
    plain, scaled = (
        CurriculumEnv(gymnasium.make("scm_world/Pushing-v0", backend="fake"), one)
        for one in (resample(MASS, "A"), part)
    )
    masses = []
    for env, options in ((plain, {}), (scaled, {}), (scaled, {"do": {MASS: Shift(0.001)}})):
        env.reset(seed=5, options=options)
        masses.append(float(env.unwrapped.world[MASS]))
    assert masses[1:] == [2.0 * masses[0], 2.0 * masses[0] + 0.001]
    envs: Any = make_vec("scm_world/Pushing-v0", 2, part, backend="fake")
    envs.reset(seed=[5, 5], options={"do": {1: {MASS: Shift(0.001)}}})
    assert [float(one[MASS]) for one in envs.get_attr("world")] == masses[1:]
    envs.close()


def test_rows_of_a_dataset_vary_as_their_context_does(world: World) -> None:
    """Interventional rows of a shift are the observational ones of the same units, shifted."""
    design = Design("single", (MASS,), values=Shift(0.01), observational_fraction=0.0)
    how: dict[str, Any] = {"steps": 2, "nature": {MASS: "A"}}
    table, seen = collect(world, design, 4, **how), collect(world, Design(), 4, **how)
    np.testing.assert_array_equal(table[MASS], seen[MASS] + 0.01)


def test_what_is_refused_leaves_the_context() -> None:
    """After a refused reset the episode has begun in its context; a refused step did nothing."""
    later = {MASS: Hard(-1.0, at=1)}
    with World("pushing", backend="fake").given({FRICTION: 0.9}) as given:
        for wrong in ({MASS: -1.0}, {"no.such.name": 1.0}, {MASS: (Hard(-1.0), Hard(0.03, at=1))}):
            given.reset(seed=1, do={MASS: 0.05})
            given.step(given["joint_positions"])
            with pytest.raises(InterventionError):
                given.reset(seed=4, do=wrong)
            assert (given.index, float(given[MASS]), float(given[FRICTION])) == (0, 0.02, 0.9)
        given.reset(seed=4, do=later)
        given.step(given["joint_positions"])
        with pytest.raises(InterventionError):
            given.step(given["joint_positions"])
        assert (given.index, float(given[MASS])) == (1, 0.02)
        given.reset(seed=4, do={MASS: Hard(0.04, at=1)})
        given.step(given["joint_positions"])
        with pytest.raises(ActionError):
            given.step([1.0])
        assert float(given[MASS]) == 0.02
        given.step(given["joint_positions"])
        assert float(given[MASS]) == 0.04


def test_a_do_by_hand_counts_where_a_plan_acts(world: World) -> None:
    """It lies above the context, and takes the place of what is due at this instant."""
    with World("pushing", backend="fake") as one:
        one.reset(seed=0, do={MASS: Hard(0.04, at=1), FRICTION: Hard(0.3, at=1)})
        one.step(one["joint_positions"])
        one.do({MASS: 0.06})
        one.step(one["joint_positions"])
        assert (float(one[MASS]), float(one[FRICTION])) == (0.06, 0.3)
    with world.given({MASS: Scale(2.0)}) as given:
        given.reset(seed=0)
        given.do({MASS: Shift(0.01)})
        assert float(given[MASS]) == 0.04 + 0.01
        given.do({MASS: Shift(0.02)})  # the last one counts
        assert float(given[MASS]) == 0.04 + 0.02
        given.do({MASS: Natural()})
        assert float(given[MASS]) == 0.04


def test_a_world_of_equations_is_given_times_and_lagged_variables() -> None:
    """A level that holds although it follows itself, and rain that ends."""
    level = Derived(
        name="level",
        parents=(Parent("level", 1), "rain"),
        mechanism=Linear(weights=(0.9, 0.1)),
        start=1.0,
    )
    world = World(SCM([Exogenous(name="rain", default=1.0), level]))
    held = world.given({"level": 2.0, "rain": Hard(0.0, at=2)})
    episode = held.rollout(None, steps=3)
    assert episode["level"].tolist() == [2.0] * 4
    assert episode["rain"].tolist() == [1.0, 1.0, 0.0, 0.0]
    assert [*held.plan] == ["level", "rain"]
    held.reset(seed=0)
    for _ in range(3):
        held.step([])
    assert (float(held["level"]), float(held["rain"])) == (2.0, 0.0)
    back = held.given({"level": Natural()}).rollout(None, steps=1, do={"rain": Shift(1.0)})
    assert back["level"].tolist() == pytest.approx([1.0, 0.9 + 0.2])


def test_what_layers_draw_is_independent() -> None:
    """The variances of drawn shifts of one variable add up: of given, nature and what is asked."""
    shift = Shift(Draw(Normal(0.0, 1.0)))
    model = SCM([Exogenous(name="a", default=0.0)]).given({"a": shift})
    both = model.do({"a": shift}).draw(5000, seed=0)["a"]
    assert both.var() == pytest.approx(2.0, abs=0.15)
    found = World(model).sample(2000, {"a": shift}, outcomes=["a"], nature={"a": shift})["a"]
    assert found.var() == pytest.approx(3.0, abs=0.3)


@pytest.mark.parametrize(
    ("act", "wanted"),
    [
        (3.0, lambda below: 0.0 * below + 3.0),
        (Shift(1.0), lambda below: below + 1.0),
        (Scale(2.0), lambda below: below * 2.0),
        (Natural(), lambda below: below),
    ],
)
def test_what_is_done_to_a_model_lies_above_nature(act: Any, wanted: Any, world: World) -> None:
    """Asked of a model under ``do``, of its world, or as a query, of equations and of physics."""
    model, nature = SCM([Exogenous(name="a")]), {"a": Draw(Normal(50.0, 1.0))}
    below = model.sample(5, outcomes=["a"], nature=nature)["a"]
    done = model.do({"a": act})
    for system, do in ((done, None), (World(done), None), (model, {"a": act})):
        found = system.sample(5, do, outcomes=["a"], nature=nature)["a"]
        np.testing.assert_array_equal(found, wanted(below))
    # What is asked is of the same layer, where the last one counts.
    found = done.sample(5, {"a": Natural()}, outcomes=["a"], nature=nature)["a"]
    np.testing.assert_array_equal(found, below)
    masses = [
        world.sample(5, do, outcomes=[MASS], **FROM_A)[MASS]
        for do in (None, {MASS: 0.03 if act == 3.0 else act})
    ]
    expected = masses[0] * 0.0 + 0.03 if act == 3.0 else wanted(masses[0])
    np.testing.assert_array_equal(masses[1], expected)


def test_small_refusals_and_ratios() -> None:
    """The outcome is no mediator, episodes have 64 bits, and rounding is no variance."""
    y = Derived(name="y", parents=("x", "m"), mechanism=Linear(weights=(1.0, 1.0)))
    m = Derived(name="m", parents=("x",), mechanism=Linear(weights=(2.0,)), noise=Normal())
    model = SCM([Exogenous(name="x", distribution=Normal()), m, y])
    asked: dict[str, Any] = {"do": {"x": 1.0}, "versus": {"x": 0.0}, "n": 50}
    with pytest.raises(UnknownOption, match="other than the outcome"):
        model.direct_effect("y", mediators=["m", "y"], **asked)
    found = model.direct_effect("y", mediators=["m"], **asked)
    assert found.mean == pytest.approx(1.0, abs=1e-12)
    assert found.variance_ratio == np.inf
    with pytest.raises(UnknownOption, match="first"):
        model.draw(2, seed=0, first=2**64)


def test_data_of_a_given_world_of_equations_hold_its_interventions() -> None:
    """``collect`` of a given world has the rows and the truth of the mutilated model."""
    model = SCM(
        [
            Exogenous(name="x", distribution=Normal()),
            Derived(name="y", parents=("x",), mechanism=Linear(weights=(2.0,))),
        ]
    )
    table = collect(World(model).given({"x": 3.0}), Design(), 3)
    assert table["x"].tolist() == [3.0] * 3
    assert table["y"].tolist() == [6.0] * 3
    acting = collect(World(model).given({"y": 1.0}), Design(), 3).truth
    assert not acting.edges
    assert not collect(model.given({"y": 1.0}), Design(), 3).truth.edges


ACTS: tuple[Any, ...] = (
    None,
    Scale(3.0),
    Shift(1.0),
    Hard(2.0),
    Draw(Normal()),
    Shift(Draw(Normal())),
)


def chain() -> SCM:
    """A chain of three with a random root."""
    return SCM(
        [
            Exogenous(name="a", distribution=Normal(1.0, 1.0)),
            Derived(name="y", parents=("a",), mechanism=Linear(weights=(2.0,)), noise=Normal()),
            Derived(name="z", parents=("y",), mechanism=Linear(weights=(1.0,))),
        ]
    )


@pytest.mark.parametrize("below", ACTS, ids=repr)
def test_a_file_of_a_model_keeps_its_layers(below: Any) -> None:
    """Values and layers are those of the model that was written, bit for bit."""
    for name, other, act in product("ay", "ay", ACTS):
        model = chain() if below is None else chain().given({name: below})
        model = model if act is None else model.do({other: act})
        again = SCM(from_json(to_json(model)))
        assert again.context == model.context
        assert again.interventions == model.interventions
        for one in "ayz":
            np.testing.assert_array_equal(again.draw(9, seed=0)[one], model.draw(9, seed=0)[one])


def test_a_given_of_a_running_world_leaves_the_context_of_its_model_alone() -> None:
    """What the model was given counts once, and what was done by hand stays."""
    world = World(chain().given({"a": Scale(3.0)}))
    world.reset(seed=0)
    before = float(world["a"])
    assert float(world.given({"z": 1.0})["a"]) == before
    world.do({"y": 7.0})
    other = world.given({"a": Shift(1.0)})
    assert float(other["a"]) == before + 1.0
    assert float(other["y"]) == 7.0
