"""The same questions to a causal model without a backend, and to a world of the same equations."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world import (
    SCM,
    Action,
    Box,
    Derived,
    Draw,
    Exogenous,
    Linear,
    Mechanism,
    Outcome,
    Parent,
    Scale,
    Shift,
    World,
    discover,
    graph,
    verify,
)
from scm_world.discovery.data import Design, collect
from scm_world.errors import (
    InterventionError,
    ModelError,
    ScmWorldError,
    SnapshotMismatch,
    UnknownOption,
)
from scm_world.graph import from_json, to_json
from scm_world.policies import as_agent
from scm_world.queries import (
    Effect,
    Episode,
    Laboratory,
    Samples,
    Verification,
    but_for,
    compare,
    consequences,
    identify,
    load_episode,
    nature_graph,
    save_episode,
)
from scm_world.tasks import StepTask
from scm_world.variables import Bernoulli, Categories, Hard, Measured, Normal, Reaches, Table

RATE = Exogenous(name="rate", default=0.3, bounds=Box(0.0, 2.0), a=Box(0.2, 0.4))
PUSH = Action(name="push", bounds=Box(-1.0, 1.0))
CAUSES = ("rate", "prey", "predator", "push")


def prey(rate: Any, prey: Any, predator: Any, push: Any) -> Any:
    """Grow, and be eaten."""
    return prey + rate * prey * (1.0 - prey) - 0.2 * prey * predator + 0.1 * push


def predator(prey: Any, predator: Any) -> Any:
    """Eat, and die."""
    return predator * (0.9 + 0.2 * prey)


def total(prey: Any, predator: Any) -> Any:
    """Count all."""
    return prey + predator


def equations() -> SCM:
    """Declare them as mechanisms."""
    lagged = [Parent(name, 1) for name in CAUSES]
    return SCM(
        [
            RATE,
            PUSH,
            Derived(name="prey", parents=lagged, mechanism=prey, start=0.5),
            Derived(
                name="predator",
                parents=(Parent("prey", 1), Parent("predator", 1)),
                mechanism=predator,
                start=0.4,
            ),
            Derived(name="total", parents=("prey", "predator"), mechanism=total),
        ]
    )


def stepped(
    parameters: dict[str, Any], state: dict[str, Any], action: dict[str, Any], noise: Any
) -> dict[str, Any]:
    """Take one step of all equations."""
    return {
        "prey": prey(parameters["rate"], state["prey"], state["predator"], action["push"]),
        "predator": predator(state["prey"], state["predator"]),
    }


def world() -> World:
    """Declare them as a step function."""
    return World(
        stepped,
        parameters=[RATE],
        actions=[PUSH],
        states=[
            Measured(name="prey", default=0.5, parents=CAUSES),
            Measured(name="predator", default=0.4, parents=("prey", "predator")),
        ],
        outcomes=[Derived(name="total", parents=("prey", "predator"), mechanism=total)],
    )


NAMES = ("rate", "prey", "predator", "total")
PLANS: tuple[dict[str, Any], ...] = (
    {},
    {"rate": 1.5},
    {"rate": Scale(2.0)},
    {"rate": Hard(1.5, at=3)},
    {"rate": Hard(1.5, during=(2, 5))},
    {"rate": Hard(0.0, when=Reaches("prey", above=0.55))},
    {"rate": (Hard(1.0, at=2), Shift(0.5, at=4))},
    {"push": 1.0},
    {"push": Mechanism(np.negative, parents=("prey",), at=2)},
)


@pytest.fixture(params=[equations, world], ids=["SCM", "World"])
def system(request: pytest.FixtureRequest) -> Any:
    """Ask each of them."""
    return request.param()


def alike(one: Episode, other: Episode) -> bool:
    """Tell whether two episodes have the same values, bit for bit."""
    return all(one[name].tobytes() == other[name].tobytes() for name in NAMES)


@pytest.mark.parametrize("plan", PLANS, ids=repr)
@pytest.mark.parametrize("policy", [None, "random", [0.5]], ids=str)
def test_episodes_are_the_same_with_and_without_a_backend(plan: Any, policy: Any) -> None:
    """A rollout and its counterfactual agree bit for bit."""
    one, other = (
        asked.rollout(policy, seed=3, episode=2, steps=8, do=plan)
        for asked in (equations(), world())
    )
    assert len(one) == len(other) == 8
    np.testing.assert_array_equal(one.actions, other.actions)
    assert alike(one, other)
    assert one.events == other.events
    wish = {"rate": 0.9}
    assert alike(one.counterfactual(wish, at=4), other.counterfactual(wish, at=4))


def test_a_question_has_one_form_and_one_answer(system: Any) -> None:
    """Every question is taken by both, and gives the result of the other one."""
    reference = equations()
    episode = system.rollout("random", seed=1, steps=6)
    assert isinstance(episode, Episode)
    assert episode.counterfactual({}) == episode
    assert alike(episode, reference.rollout("random", seed=1, steps=6))
    replay: dict[str, Any] = {"policy": "random", "seed": 1, "steps": 6}
    branch = system.rollout(**replay).counterfactual({"rate": 1.0}, at=2)
    assert alike(branch, episode.counterfactual({"rate": 1.0}, at=2))
    assert branch["prey"][:3].tobytes() == episode["prey"][:3].tobytes()
    assert branch.final("prey") != episode.final("prey")
    several = episode.worlds([{}, {"rate": 1.0}], at=2)
    assert several[0] == episode
    assert alike(several[1], branch)
    outcomes = ["prey", Outcome("total", "mean"), Outcome("total", "path")]
    how: dict[str, Any] = {"seed": 5, "steps": 6, "policy": "random", "outcomes": outcomes}
    seen, done = system.sample(7, **how), system.sample(7, {"rate": 1.0}, **how)
    assert isinstance(seen, Samples)
    assert seen["path total"].shape == (7, 7)
    for name, values in reference.sample(7, {"rate": 1.0}, **how).items():
        assert values.tobytes() == done[name].tobytes()
    assert system.see(7, **how)["prey"].tobytes() == seen["prey"].tobytes()
    asked: dict[str, Any] = {"n": 5, "seed": 2, "steps": 6, "policy": "random"}
    effect = system.effect("prey", do={"rate": 1.0}, **asked)
    assert isinstance(effect, Effect)
    assert effect.mean == reference.effect("prey", do={"rate": 1.0}, **asked).mean
    curve = system.effect_over("prey", name="rate", values=[0.1, 0.5, 1.0], **asked)
    assert [e.mean for e in curve] == [
        e.mean for e in reference.effect_over("prey", name="rate", values=[0.1, 0.5, 1.0], **asked)
    ]
    groups = system.effect_by("prey", do={"rate": 1.0}, by="predator", bins=2, **asked)
    assert sum(found.n for _, found in groups) == 5
    with system.given({"rate": 1.0}) as faster:
        assert alike(
            faster.rollout(seed=1, steps=3), system.rollout(seed=1, steps=3, do={"rate": 1.0})
        )
    assert set(system.graph) >= set(NAMES)


def test_both_are_verified_and_discovered(system: Any) -> None:
    """Their edges are those that were declared, with the results of the same types."""
    found = verify(system, probes=20)
    assert isinstance(found, Verification)
    assert found.outcome == "confirmed"
    assert {("prey", "predator", 1), ("prey", "total", 0)} <= set(found.declared)
    assert discover(system, probes=8).score.shd == 0


def test_a_callable_policy_looks_at_the_equations() -> None:
    """It is given something to read present values from, as in a world."""

    def policy(now: Any) -> Any:
        return [1.0 - 2.0 * now["prey"]]

    one, other = (asked.rollout(policy, seed=0, steps=6) for asked in (equations(), world()))
    np.testing.assert_array_equal(one.actions, other.actions)
    assert alike(one, other)


def chain() -> SCM:
    """Declare a model without time."""
    return SCM(
        [
            Exogenous(name="x", distribution=Normal(), a=Box(1.0, 2.0)),
            Derived(name="y", parents=("x",), mechanism=Linear(weights=(2.0,)), noise=Normal()),
            Derived(name="z", parents=("x", "y"), mechanism=np.add),
        ]
    )


def test_a_model_without_lags_has_episodes_of_one_instant() -> None:
    """Their values are those that are drawn from the model."""
    model, drawn = chain(), chain().draw(50, seed=4)
    found = model.sample(50, seed=4)
    (row,) = (line.split() for line in str(found).splitlines() if line.startswith("z "))
    assert row[1:3] == [f"{found['z'].mean():.4g}", f"{found['z'].std(ddof=1):.4g}"]
    for name in model:
        np.testing.assert_array_equal(found[name], drawn[name])
    episode = model.rollout(seed=4, episode=17)
    assert len(episode) == 0
    assert episode["z"].tolist() == [drawn["z"][17]]
    assert model.sample(1, seed=4, first=17)["z"] == drawn["z"][17]
    with pytest.raises(UnknownOption, match="no lagged edges"):
        model.rollout(steps=3)


@pytest.mark.parametrize(
    ("act", "push"),
    [
        (0.5, 0.5),
        (Shift(0.25), 0.25),
        (Shift(3.0), 1.0),
        (Mechanism(np.negative, parents=("x",)), -0.75),
    ],
    ids=repr,
)
def test_actions_of_a_model_without_lags_are_intervened_on(act: Any, push: float) -> None:
    """Within their range; alone, among other units, and in a counterfactual."""
    model = SCM(
        [
            Exogenous(name="x", default=0.75),
            PUSH,
            Derived(name="y", parents=("push", "x"), mechanism=Linear(weights=(2.0, 1.0))),
        ]
    )
    found = model.rollout(do={"push": act})
    assert (found.final("push"), found.final("y")) == (push, 2.0 * push + 0.75)
    assert model.rollout().counterfactual({"push": act}) == found
    assert model.sample(3, {"push": act})["y"].tolist() == [found.final("y")] * 3


def test_counterfactuals_of_a_model_keep_its_noise() -> None:
    """What is not intervened on answers with the noise that it had."""
    episode = chain().rollout(seed=0)
    x, y, z = (float(episode.final(name)) for name in "xyz")
    moved = episode.counterfactual({"x": x + 1.0})
    assert float(moved.final("y")) == pytest.approx(y + 2.0, abs=1e-12)
    assert float(moved.final("z")) == pytest.approx(z + 3.0, abs=1e-12)
    assert episode.counterfactual({"y": 5.0}).final("x") == x
    assert set(moved.audits[0].targets) == {"x"}
    assert set(moved.audits[0].followed) == {"y", "z"}


def test_effects_of_a_linear_model_are_its_weights() -> None:
    """Paired units have the total effect without any error of sampling."""
    found = chain().effect("z", do={"x": 1.0}, versus={"x": 0.0}, n=20)
    assert float(found.mean) == pytest.approx(3.0, abs=1e-12)
    assert np.isnan(found.high)  # all units differ by the same: there is nothing to infer from
    assert found.caution == "nothing varies in 20 units, so there is no interval"
    assert found.excludes_zero
    assert json.loads(found.to_json())["low"] is None
    assert chain().effect("x", do={"z": 1.0}, n=20).mean == 0.0


def test_categories_have_no_mean_in_effects() -> None:
    """Codes are not averaged, in any effect or summary; a function asks for a probability."""
    kind: dict[str, Any] = {"dtype": "categorical", "bounds": Categories((3, 7, 9), tuple("rgb"))}
    table = Table([[0.8, 0.1, 0.1], [0.1, 0.8, 0.1]], values=(3, 7, 9))
    model = SCM(
        [
            Exogenous(name="t", distribution=Bernoulli(0.5), dtype="integer"),
            Derived(name="c", parents=("t",), mechanism=table, **kind),
        ]
    )
    arms: dict[str, Any] = {"do": {"t": 1}, "versus": {"t": 0}}
    asks = (
        lambda: model.effect("c", **arms),
        lambda: model.effect(Outcome("c", "path"), **arms),
        lambda: model.direct_effect("c", **arms, mediators={"t": 0}),
        lambda: model.direct_effect("c", **arms, mediators=["t"]),
        lambda: model.effect_over("c", name="t", values=[0, 1]),
        lambda: model.effect_by("c", **arms, by="t"),
    )
    for ask in asks:
        with pytest.raises(UnknownOption, match=r"lambda episode: episode.final\('c'\) == "):
            ask()
    for how in ("mean", "sum", "max", "change"):
        with pytest.raises(UnknownOption, match="there are: final, first, path"):
            model.sample(3, outcomes=[Outcome("c", how)])
    with pytest.raises(UnknownOption, match="3 or more: categories have no order"):
        model.effect_by("t", do={"t": 1}, by="c", bins=2)
    assert set(model.sample(50)["c"]) == {3.0, 7.0, 9.0}
    found = model.effect(lambda episode: episode.final("c") == 3, **arms, n=400)
    assert found.mean == pytest.approx(-0.7, abs=0.1)
    one = model.rollout(seed=0, do={"t": 0})
    others = (one.counterfactual({"c": label}) for label in (3, 7, 9))
    apart = [compare(one, other).variables.largest.get("c", 0.0) for other in others]
    assert sorted(apart) == [0.0, 1.0, 1.0]
    moved = {consequences(model, {"t": 1}, seed=k).variables.difference["c"] for k in range(9)}
    assert moved == {0.0, 1.0}


def pair() -> SCM:
    """Give a cause and its effect."""
    line = Derived(name="y", parents=("x",), mechanism=Linear(weights=(2.0,)), noise=Normal())
    return SCM([Exogenous(name="x", distribution=Normal()), line])


@pytest.mark.parametrize(
    "ask",
    [
        *(lambda m, do=do: m.effect("y", do=do, n=3) for do in (True, [1, 2], "x", np.zeros(3))),
        *(lambda m, do=do: m.rollout(do=do) for do in (1.5, ["x"], len)),
        *(lambda m, do=do: m.counterfactual({"x": 1.0}, do=do) for do in (1, "x", [["x", 1.0]])),
        lambda m: m.counterfactual({"x": 1.0}, do={"x": 2.0})["z"],
        lambda m: m.sample(3, {"x": 1.0}, zzz=1),
        lambda m: m.sample(3, nature=np.zeros(3)),
        lambda m: m.sample(3, outcomes=5),
        lambda m: m.sample(3, first="x"),
        lambda m: m.sample(3, steps=np.zeros(2)),
        lambda m: m.effect(lambda episode: 1 / 0, do={"x": 1.0}, n=3),
        lambda m: m.effect(lambda episode: episode["x"][7], do={"x": 1.0}, n=3),
        lambda m: m.effect_over("y", name=["x"], values=[0.0, 1.0]),
        lambda m: m.effect_over("y", name="x", values=None),
        lambda m: m.effect_over("y", name="x", values=1.0),
        lambda m: m.parents(["x"]),
        lambda m: m.do({("x",): 1.0}),
        lambda m: m.solve([1.0]),
        lambda m: m.evaluate("zzz", {"x": 1.0}),
        lambda m: m.rollout().worlds(None),
        lambda m: m.rollout().scene(0),
        lambda m: compare(m.rollout(), m.rollout(), tolerance="x"),
        lambda m: compare(m.rollout(), m.rollout(), names=1),
        lambda m: but_for(m, "y"),
        lambda m: but_for(m.rollout(do={"x": 1.0}), "y", most=None),
        lambda m: consequences("model.json", {"x": 1.0}),
        lambda m: consequences(m, {"x": 1.0}, space=np.zeros(2)),
        lambda m: nature_graph("x", {}, ["y"]),
        lambda m: nature_graph(m, {}, None),
        lambda m: Laboratory("model.json"),  # type: ignore[arg-type] # that is the point
        lambda m: graph.to_dag({"x": []}),
        lambda m: graph.unrolled(m, 1.5),
        lambda m: graph.episode_outcome(None, ["y"]),
        lambda m: to_json("x"),
        lambda m: Outcome("x", np.zeros(2)),
        lambda m: Reaches("x", above={}),
        lambda m: identify(m.graph, "x", "zzz"),
        lambda m: identify(m, "x", ["y"]),
    ],
)
def test_a_wrong_argument_is_named(ask: Any) -> None:
    """By an error of this package, whatever is wrong with it."""
    with pytest.raises(ScmWorldError):
        ask(pair())


def test_nan_of_a_function_names_its_variable() -> None:
    """Where it came from, and not where it was seen."""
    model = SCM(
        [
            Exogenous(name="x", distribution=Normal()),
            Derived(name="root", parents=("x",), mechanism=np.sqrt),
            Derived(name="end", parents=("root",), mechanism=lambda root: root + 1.0),
        ]
    )
    with np.errstate(invalid="ignore"):
        for ask in (
            lambda: model.draw(50, seed=0),
            lambda: model.sample(50, outcomes=["end"]),
            lambda: model.effect("end", do={"x": -1.0}, n=3),
            lambda: model.counterfactual({"x": 1.0}, do={"x": -1.0}),
            lambda: model.do({"end": Mechanism(np.sqrt, "x")}).draw(50, seed=0),
        ):
            with pytest.raises(ModelError, match=r"the function of '(root|end)' gives NaN"):
                ask()


def test_a_number_that_is_not_finite_names_its_outcome() -> None:
    """In the error of a function of the episode."""

    def odd(episode: Episode) -> float:
        return float("nan") * float(episode.final("x"))

    with pytest.raises(UnknownOption, match="value of the outcome 'odd'"):
        pair().sample(2, outcomes=[odd])


def test_a_lagged_model_needs_a_number_of_steps() -> None:
    """Every question asks for it in the same words."""
    model = SCM(
        [
            Derived(
                name="z",
                parents=(Parent("z", 1),),
                mechanism=Linear(weights=(0.5,)),
                noise=Normal(),
            )
        ]
    )
    for ask in (
        model.rollout,
        lambda: model.sample(3),
        lambda: model.effect("z", do={"z": 1.0}, n=3),
        lambda: model.effect("z", do={"z": 1.0}, n=3, steps=None),
        lambda: World(model).effect("z", do={"z": 1.0}, n=3),
    ):
        with pytest.raises(ModelError, match="say how many steps"):
            ask()


def test_an_intervention_counts_from_the_beginning() -> None:
    """The first step of a model sees the value that was set, not the start that was declared."""
    done = equations().do({"prey": 2.0})
    assert done.rollout(steps=2)["predator"].tolist()[:2] == [0.4, 0.4 * (0.9 + 0.2 * 2.0)]
    assert done.rollout(steps=2)["prey"].tolist() == [2.0, 2.0, 2.0]
    paths = noisy().do({"x": Draw(Normal())}).draw(3, seed=0, steps=4)
    found = noisy().do({"x": Draw(Normal())}).sample(3, outcomes=[Outcome("y", "path")], steps=4)
    np.testing.assert_array_equal(found["path y"][:, 1:], paths["y"])


def noisy() -> SCM:
    """Declare a process with noise."""
    return SCM(
        [
            Derived(
                name="x",
                parents=(Parent("x", 1),),
                mechanism=Linear(weights=(0.5,)),
                noise=Normal(),
            ),
            Derived(
                name="y",
                parents=(Parent("x", 1),),
                mechanism=Linear(weights=(1.0,)),
                noise=Normal(),
            ),
        ]
    )


def test_a_later_intervention_leaves_the_noise_as_it_is() -> None:
    """Before it everything is the same, after it all that does not follow."""
    episode = noisy().rollout(seed=3, steps=30)
    branch = episode.counterfactual({"x": Hard(9.0, at=20)}, at=12)
    assert branch["y"][:21].tobytes() == episode["y"][:21].tobytes()
    shifted = (branch["y"] - branch["x"][[0, *range(30)]]) - (
        episode["y"] - episode["x"][[0, *range(30)]]
    )
    assert np.abs(shifted).max() < 1e-12
    assert (branch["x"][20:] == 9.0).all()
    assert branch.counterfactual({}, at=25) == branch


@pytest.mark.parametrize("how", ["mean", "sum", "max", "change", "final", "path"])
def test_a_unit_alone_has_the_bits_that_it_has_among_others(how: str) -> None:
    """Outcomes of many units are those of each one."""
    model, outcome = noisy(), Outcome("y", how)
    many = model.sample(9, outcomes=[outcome], steps=37, seed=1)[
        str(outcome).removeprefix("final ")
    ]
    for number in range(9):
        episode = model.rollout(seed=1, episode=number, steps=37)
        assert outcome.of(episode).tobytes() == many[number].tobytes()


def test_functions_that_take_one_value_are_called_for_each_unit() -> None:
    """A mechanism with a branch gives the same as its vectorised form."""

    def larger(a: Any, b: Any) -> Any:
        return a if a > b else b

    def model(function: Any) -> SCM:
        roots = [Exogenous(name=name, distribution=Normal()) for name in "ab"]
        return SCM([*roots, Derived(name="c", parents=("a", "b"), mechanism=function)])

    one, other = (model(f).sample(8, seed=0)["c"] for f in (larger, np.maximum))
    np.testing.assert_array_equal(one, other)


def broken(x: Any) -> Any:
    """Fail for some units."""
    if np.any(x > 1.0):
        raise ValueError("too large")
    return x


def test_errors_of_a_model_are_those_of_its_unit() -> None:
    """Refusals name the variable, and what a function raises comes through."""
    with pytest.raises(InterventionError, match="rate"):
        equations().rollout(steps=2, do={"rate": 7.0})
    with pytest.raises(ModelError, match="how many steps"):
        equations().rollout()
    model = SCM(
        [
            Exogenous(name="x", distribution=Normal()),
            Derived(name="y", parents=("x",), mechanism=broken),
        ]
    )
    with pytest.raises(ValueError, match="too large"):
        model.sample(100, seed=0)
    with pytest.raises(ScmWorldError, match="component of y"):
        noisy().rollout(steps=2, do={"x": Hard(1.0, when=Reaches("y", above=0.0, component=4))})


def copied(model: SCM) -> Any:
    """Send a model through a pickle."""
    return pickle.loads(pickle.dumps(model))  # noqa: S301 # it is ours


def test_a_model_that_can_be_asked_is_a_model() -> None:
    """It compares, pickles, intervenes and is written like any other one."""
    model = chain().do({"x": 1.0})
    assert isinstance(model, SCM)
    assert copied(model) == model
    assert SCM(graph.SCM(chain().variables)).do({"x": 1.0}) == model
    assert SCM(from_json(to_json(chain()), trusted=("numpy",))) == chain()
    assert SCM(model) == model
    model.sample(3)
    assert copied(model).sample(3)["z"].tolist() == model.sample(3)["z"].tolist()


def test_a_parent_that_a_mechanism_ignores_never_fires() -> None:
    """The report names the edge, and does not pass."""
    model = SCM(
        [
            Exogenous(name="a", distribution=Normal()),
            Exogenous(name="b", distribution=Normal()),
            Derived(name="c", parents=("a", "b"), mechanism=Linear(weights=(1.0, 0.0))),
        ]
    )
    found = verify(model, probes=20)
    assert found.never_fired == (("b", "c", 0),)
    assert found.undeclared == ()
    assert found.outcome == "not refuted"


@pytest.mark.parametrize("plan", PLANS, ids=repr)
def test_an_episode_of_equations_is_saved(plan: Any, tmp_path: Path) -> None:
    """Its table and its counterfactuals have the same bits after reading."""
    episode = equations().rollout("random", seed=3, episode=2, steps=8, do=plan)
    saved = save_episode(episode, tmp_path / "episode")
    trusted = (__name__, "numpy")
    for found in (
        load_episode(saved, trusted=trusted),
        load_episode(saved, world=equations(), trusted=trusted),
    ):
        assert found == episode
        assert alike(found, episode)
        wish = {"rate": 0.9}
        assert alike(found.counterfactual(wish, at=4), episode.counterfactual(wish, at=4))


def test_an_episode_without_lags_is_saved(tmp_path: Path) -> None:
    """With the interventions that its model holds; a function needs trust."""
    model = chain().do({"x": Shift(1.0)})
    episode = model.rollout(seed=5).counterfactual({"y": 2.0})
    saved = save_episode(episode, tmp_path / "episode")
    with pytest.raises(ModelError, match="trusted"):
        load_episode(saved)
    found = load_episode(saved, trusted=("numpy",))
    assert found == episode
    assert found.final("z").tobytes() == episode.final("z").tobytes()
    assert found.counterfactual({"x": 0.0}) == episode.counterfactual({"x": 0.0})


def test_a_file_of_equations_refuses_another_model(tmp_path: Path) -> None:
    """Also a world, and the file of a world refuses equations."""
    saved = save_episode(chain().rollout(seed=5), tmp_path / "equations")
    for other in (chain().do({"y": 1.0}), equations(), world()):
        with pytest.raises(SnapshotMismatch, match="another system"):
            load_episode(saved, world=other)
    saved = save_episode(world().rollout(steps=2), tmp_path / "world")
    with pytest.raises(SnapshotMismatch, match="another system"):
        load_episode(saved, world=equations())


def test_equations_without_a_name_are_given_on_reading(tmp_path: Path) -> None:
    """The error says how; a model with other functions is refused by their names."""

    def model(factor: float) -> SCM:
        double = Derived(name="y", parents=("x",), mechanism=lambda x: factor * x)
        return SCM([Exogenous(name="x", distribution=Normal()), double])

    episode = model(2.0).rollout(seed=1)
    saved = save_episode(episode, tmp_path / "episode")
    with pytest.raises(ModelError, match="world=model"):
        load_episode(saved)
    found = load_episode(saved, world=model(2.0))
    assert found == episode
    assert found.counterfactual({"x": 1.0}).final("y") == 2.0
    with pytest.raises(SnapshotMismatch, match="mechanism of 'y' differ"):
        load_episode(saved, world=model(3.0))


def test_an_episode_of_equations_is_no_policy(tmp_path: Path) -> None:
    """Its actions are: an array is."""
    episode = equations().rollout("random", steps=2)
    saved = save_episode(SCM([RATE]).rollout(), tmp_path / "episode")
    for policy in (episode, saved):
        with pytest.raises(UnknownOption, match="an array of actions"):
            as_agent(policy)


def test_the_world_is_one_of_a_step_function() -> None:
    """Both sides of the comparison are what they are said to be."""
    assert isinstance(world().task, StepTask)


def test_equations_are_a_world() -> None:
    """They are reset, stepped, intervened on and asked; what is given leaves the first as it is."""
    model = equations()
    with World(model) as world:
        assert world.action_space.shape == (world.compiled.n_actions,)
        assert {*world.observation_space} == {*model}
        world.reset(seed=3)
        audit = world.do({"rate": 1.0})
        assert {*audit.targets} == {"rate"}
        kept = world.snapshot()
        other = world.given({"rate": 2.0})
        assert (world["rate"], other["rate"]) == (1.0, 1.0)  # what was done lies above
        other.reset(seed=3)
        assert (world["rate"], other["rate"]) == (1.0, 2.0)
        for _ in range(4):
            world.step(world.idle())
        lived = model.rollout(seed=3, do={"rate": 1.0}, steps=4)
        assert all(np.array_equal(lived.final(name), world[name]) for name in model)
        assert world.rollout(seed=3, do={"rate": 1.0}, steps=4) == lived
        world.restore(kept)
        assert world.index == 0
        assert world.reset(do={"rate": 0.0}) is not None
        assert (world.noise.seed, world.episode) == (3, 1)
        with pytest.raises(SnapshotMismatch):
            world.restore(SCM([]))


def test_equations_of_a_world_are_verified_identified_collected_and_discovered() -> None:
    """As those of their model are."""
    world = World(pair())
    assert world.verify(probes=10).outcome == "confirmed"
    assert world.identify("x", "y").backdoor == ()
    design = Design("single", ("x",), Box(0.0, 1.0))
    assert collect(world, design, 4)["y"].shape == (4,)
    assert discover(world, probes=8).score.shd == 0
