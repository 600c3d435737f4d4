"""What declared models mean: noise, batch axes, categories, and parts of effects."""

from __future__ import annotations

from typing import Any

import networkx as nx
import numpy as np
import pytest
from scipy import stats

from scm_world import SCM, World
from scm_world.errors import InterventionError, ModelError, UnknownOption
from scm_world.graph import NoiseKey, from_json, to_dag, to_json
from scm_world.queries import verify
from scm_world.variables import (
    Action,
    Bernoulli,
    Box,
    Categories,
    Continuous,
    Derived,
    Discrete,
    Draw,
    Exogenous,
    Hard,
    Linear,
    Measured,
    Mechanism,
    Noise,
    Normal,
    Parent,
    Scale,
    Shift,
    Table,
)

N = 20_000


def both(x: Any, noise: Any) -> Any:
    """Add noise twice."""
    return x + 2.0 * noise


def plain(x: Any) -> Any:
    """Leave noise out."""
    return -x


def first(x: Any) -> Any:
    """Look at the last axis, as vectorised functions do."""
    return x[..., 0]


def times(x: Any, m: Any) -> Any:
    """Let two causes interact."""
    return x * m


def two(noise: Any = None) -> SCM:
    """Make x and y = x + noise."""
    return SCM(
        [
            Exogenous(name="x", distribution=Normal()),
            Derived(
                name="y",
                parents=("x",),
                mechanism=Linear(weights=(1.0,)),
                noise=noise or Normal(0.0, 0.5),
            ),
        ]
    )


@pytest.mark.parametrize(
    ("given", "law"),
    [
        (Box(1.0, 3.0), stats.uniform(1.0, 2.0)),
        (Normal(1.0, 2.0), stats.norm(1.0, 2.0)),
        (Continuous("laplace", loc=0.5, scale=2.0), stats.laplace(0.5, 2.0)),
        (Continuous("expon", scale=2.0), stats.expon(scale=2.0)),
        (Continuous("gamma", a=2.0, scale=3.0), stats.gamma(2.0, scale=3.0)),
        (Continuous("t", df=3.0), stats.t(3.0)),
        (Continuous("gumbel_r", loc=1.0, scale=2.0), stats.gumbel_r(1.0, 2.0)),
        (Continuous("beta", a=2.0, b=5.0), stats.beta(2.0, 5.0)),
    ],
    ids=lambda given: given.describe() if hasattr(given, "describe") else "",
)
def test_noises_have_their_distribution(given: Any, law: Any) -> None:
    """By the test of Kolmogorov and Smirnov; and they survive JSON."""
    model = SCM([Exogenous(name="x", distribution=given)])
    assert stats.kstest(model.draw(N, seed=1)["x"], law.cdf).pvalue > 0.01
    again = from_json(to_json(model))
    assert again.draw(5, seed=2)["x"].tobytes() == model.draw(5, seed=2)["x"].tobytes()


@pytest.mark.parametrize(
    ("given", "shares"),
    [
        (Bernoulli(0.3), {0: 0.7, 1: 0.3}),
        (Discrete(range(3), [0.2, 0.5, 0.3]), {0: 0.2, 1: 0.5, 2: 0.3}),
        (Discrete([1.5, 1.5, 4.0]), {1.5: 2 / 3, 4.0: 1 / 3}),
    ],
    ids=lambda given: given.describe() if hasattr(given, "describe") else "",
)
def test_discrete_noises_have_their_shares(given: Any, shares: dict[Any, float]) -> None:
    """Each value as often as it says."""
    drawn = SCM([Exogenous(name="x", distribution=given)]).draw(N, seed=0)["x"]
    found = {value: float((drawn == value).mean()) for value in shares}
    assert found == pytest.approx(shares, abs=0.015)
    assert sum(found.values()) == 1.0


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Continuous("nothing"), "scipy.stats"),
        (lambda: Continuous("gamma", a=-1.0), "not a distribution"),
        (lambda: Continuous("norm", width=1.0), "width"),
        (lambda: Discrete((1, 2), (0.5, 0.6)), "sum to 1.1"),
        (lambda: Discrete((1, 2), (1.0,)), "as many"),
        (lambda: Table([[0.5, 0.6]]), "sums to 1"),
        (lambda: Categories((0, 1), labels=("a", "a")), "different labels"),
    ],
)
def test_what_is_no_distribution_is_refused(make: Any, words: str) -> None:
    """With what is wrong."""
    with pytest.raises(ModelError, match=words):
        make()


def test_a_mechanism_keeps_the_noise_if_it_takes_it() -> None:
    """The same numbers; a function without noise has none; the noise can be another one."""
    model = two()
    seen = model.draw(200, seed=4)
    noise = seen["y"] - seen["x"]
    louder = model.do({"y": Mechanism(both, ["x"])}).draw(200, seed=4)
    np.testing.assert_allclose(louder["y"], seen["x"] + 2.0 * noise)
    silent = model.do({"y": Mechanism(plain, ["x"])}).draw(200, seed=4)
    np.testing.assert_array_equal(silent["y"], -seen["x"])
    wider = model.do({"y": Mechanism(noise=Normal(0.0, 5.0))})
    np.testing.assert_allclose(wider.draw(200, seed=4)["y"], seen["x"] + 10.0 * noise)
    assert wider.parents("y") == ("x",)
    assert from_json(to_json(wider)).draw(3, seed=4)["y"].tobytes() == (
        wider.draw(3, seed=4)["y"].tobytes()
    )
    added = model.do({"y": Mechanism(both, ["x"], noise=Continuous("laplace"))}).draw(N, seed=1)
    assert stats.kstest((added["y"] - added["x"]) / 2.0, stats.laplace.cdf).pvalue > 0.01


@pytest.mark.parametrize(
    ("act", "words"),
    [
        ({"x": Mechanism(noise=Normal())}, "no noise"),
        ({"x": Mechanism(both, ["y"])}, "there is none"),
        ({"y": Mechanism(plain, ["x"], noise=Normal())}, "does not take noise"),
    ],
)
def test_noise_that_is_not_there_is_refused(act: Any, words: str) -> None:
    """With what to declare."""
    with pytest.raises(InterventionError, match=words):
        two().do(act)


def test_values_have_the_axes_of_the_batch() -> None:
    """After an intervention, of constants, and where what is known has an axis."""
    pair = Derived(name="y", parents=("x",), mechanism=first)
    model = SCM([Exogenous(name="x", shape=(2,), default=(1.0, 2.0)), pair])
    lonely = Derived(name="y", parents=("x",), mechanism=lambda x: x.sum(axis=0, keepdims=True) * x)
    assert model.draw(5, seed=0)["y"].shape == (5,)
    assert model.do({"x": [3.0, 4.0]}).draw(5, seed=0)["y"].tolist() == [3.0] * 5
    known = two().do({"x": 1.0}).solve(key=NoiseKey(Noise(0), count=4))
    assert known["x"].shape == known["y"].shape == (4,)
    many = SCM([Exogenous(name="x"), Exogenous(name="z"), lonely])
    assert many.solve({"z": np.zeros(3)})["x"].shape == (3,)


def test_a_root_is_drawn_once_per_episode_or_in_every_step() -> None:
    """A parameter holds, also for the instant that the first step looks back at."""

    def model(**per: Any) -> SCM:
        follow = Derived(name="s", parents=(Parent("k", 1),), mechanism=Linear(weights=(1.0,)))
        return SCM([Exogenous(name="k", distribution=Normal(), **per), follow])

    found = model().draw(50, seed=0, steps=5)
    assert (found["k"] == found["k"][:, :1]).all()
    assert (found["s"] == found["k"]).all()
    assert found["k"][:, 0].std() > 0.5
    episode = model().rollout(seed=0, steps=4)
    assert np.ptp(episode["k"]) == 0.0
    steps = model(per="step").draw(50, seed=0, steps=5)
    assert (steps["s"][:, 1:] == steps["k"][:, :-1]).all()
    assert np.ptp(steps["k"], axis=1).min() > 0.1


def test_categories_have_labels_and_no_order() -> None:
    """Labels are taken, shifts are not, and no function leaves the categories."""
    kind: dict[str, Any] = {"dtype": "categorical", "bounds": Categories((3, 7), ("low", "high"))}
    model = SCM(
        [
            Exogenous(name="c", default=3, distribution=Discrete((3, 7)), **kind),
            Derived(
                name="d",
                parents=("c",),
                mechanism=Table([[1.0, 0.0], [0.25, 0.75]], given=((3, 7),), values=(3, 7)),
                **kind,
            ),
        ]
    )
    high = model.do({"c": "high"})
    assert high.solve()["c"] == 7
    drawn = high.draw(N, seed=0)["d"]
    assert float((drawn == 7).mean()) == pytest.approx(0.75, abs=0.015)
    assert from_json(to_json(high)).draw(9, seed=0)["d"].tobytes() == drawn[:9].tobytes()
    for act in (Shift(1), Scale(2)):
        with pytest.raises(InterventionError, match="no order"):
            model.do({"c": act})
    with pytest.raises(InterventionError, match="'low' or 'high'"):
        model.do({"c": "middle"})
    with pytest.raises(ModelError, match="none of"):
        model.do({"d": Mechanism(lambda c: c + 1, ["c"])}).draw(3, seed=0)


def test_direct_effects_leave_the_mediators_out() -> None:
    """Of y = x m with m = 1 + x + e: 1 natural, m controlled, and x (1 + x) in all."""
    model = SCM(
        [
            Exogenous(name="x"),
            Derived(
                name="m",
                parents=("x",),
                mechanism=Linear(weights=(1.0,), intercept=1.0),
                noise=Normal(0.0, 0.1),
            ),
            Derived(name="y", parents=("x", "m"), mechanism=times),
        ]
    )
    arms: dict[str, Any] = {"do": {"x": 1.0}, "versus": {"x": 0.0}, "n": 400, "seed": 1}
    assert model.effect("y", **arms).mean == pytest.approx(2.0, abs=0.03)
    natural = model.direct_effect("y", mediators=["m"], **arms)
    assert natural.mean == pytest.approx(1.0, abs=0.03)
    assert natural.low < 1.0 < natural.high
    controlled = model.direct_effect("y", mediators={"m": 5.0}, **arms)
    assert controlled.mean == 5.0
    assert "do(x = 1., m = 5.) versus do(x = 0., m = 5.)" in str(controlled)
    assert "nothing varies" in str(controlled)
    assert "[" not in str(controlled).split("under")[0]


def test_effects_of_models_in_time_take_windows() -> None:
    """Times in both arms; the label names them; natural effects are refused."""
    level = Derived(
        name="s", parents=(Parent("s", 1), Parent("k")), mechanism=Linear(weights=(0.5, 1.0))
    )
    model = SCM([Exogenous(name="k", distribution=Normal()), level])
    found = model.effect(
        "s", do={"k": Hard(1.0, at=3)}, versus={"k": Hard(0.0, during=(0, 2))}, n=20, steps=6
    )
    assert "do(k = 1. at 3) versus do(k = 0. from 0 to 2)" in str(found)
    with pytest.raises(UnknownOption, match="controlled effect"):
        model.direct_effect("s", do={"k": 1.0}, mediators=["k"], steps=4)


def test_draws_of_a_model_are_independent_unless_a_stream_is_shared() -> None:
    """An intervention that draws has nothing in common with what nature drew."""
    space = Box(0.0, 1.0)
    model = SCM([Exogenous(name=name, distribution=space, a=space) for name in ("x", "y")])
    seen = model.draw(2_000, seed=0)["x"]
    drawn = model.do({"x": Draw("A")}).draw(2_000, seed=0)
    assert abs(np.corrcoef(seen, drawn["x"])[0, 1]) < 0.08
    assert (drawn["y"] == model.draw(2_000, seed=0)["y"]).all()
    shared = model.do({"x": Draw("A", stream="s")}).draw(50, seed=0)["x"]
    both = model.do({name: Draw(space, stream="s") for name in ("x", "y")}).draw(50, seed=0)
    assert (shared == both["x"]).all()
    assert (both["x"] != both["y"]).all()


def test_each_draw_at_an_instant_of_a_world_is_another_one() -> None:
    """After a reset that draws, too; the same calls give the same numbers, snapshots included."""
    world = World("pushing", backend="fake")

    def numbers(seed: int) -> list[float]:
        world.reset(seed=seed, do={"tool_block.mass": Draw("A")})
        found = [float(world["tool_block.mass"])]
        world.do({"tool_block.mass": Draw("A")})
        found.append(float(world["tool_block.mass"]))
        kept = world.snapshot()
        world.do({"tool_block.mass": Draw("A")})
        found.append(float(world["tool_block.mass"]))
        world.restore(kept)
        world.do({"tool_block.mass": Draw("A")})
        assert float(world["tool_block.mass"]) == found[2]
        return found

    table = np.array([numbers(seed) for seed in range(150)])
    apart = np.corrcoef(table.T) - np.eye(3)
    assert np.abs(apart).max() < 0.25
    assert numbers(7) == table[7].tolist()


def autoregression() -> SCM:
    """Make s of its own value two steps ago, and of k three steps ago."""
    return SCM(
        [
            Exogenous(name="k", distribution=Normal(), per="step"),
            Derived(
                name="s",
                parents=(Parent("s", 2), Parent("k", 3)),
                mechanism=Linear(weights=(0.5, 2.0)),
                noise=Normal(0.0, 0.1),
                start=1.0,
            ),
        ]
    )


@pytest.mark.parametrize(
    "command",
    [
        Hard(0.5),
        Draw(Box(-2.0, 2.0)),
        Mechanism(lambda x: -x, ["x"]),
        Mechanism(lambda x, noise: noise - x, [Parent("x", 1)], noise=Normal()),
    ],
)
def test_draws_and_rollouts_are_the_same_episodes(command: Any) -> None:
    """Commands are drawn with the noise of their step, and clipped, in one convention."""
    model = SCM(
        [
            Action(name="u", bounds=Box(-1.0, 1.0)),
            Exogenous(name="w", distribution=Normal()),
            Derived(name="v", parents=("u",), mechanism=Linear(weights=(2.0,)), noise=Normal()),
            Derived(
                name="x",
                parents=(Parent("x", 1), Parent("u", 1), Parent("v", 2), "w"),
                mechanism=Linear(weights=(0.5, 1.0, 0.3, 1.0)),
                start=0.25,
            ),
        ]
    )
    do = {"u": command, "w": Scale(Draw(0.5, 2.0))}
    found = model.do(do).draw(3, seed=5, first=2, steps=4)
    for number in range(3):
        episode = World(model).rollout(None, seed=5, episode=2 + number, steps=5, do=do)
        for name in model:
            np.testing.assert_array_equal(found[name][number], episode[name][1:5])
    once = SCM([Action(name="u", bounds=Box(-1.0, 1.0))])
    drawn = once.do({"u": Draw(Box(-3.0, 3.0))}).draw(50, seed=0)["u"]
    assert (drawn.min(), drawn.max()) == (-1.0, 1.0)


def test_lags_of_any_order() -> None:
    """Draws, rollouts, counterfactuals, verification and d-separation look as far back."""
    model = autoregression()
    found = model.draw(5, seed=0, steps=8)
    noise = model.do({"s": Mechanism(lambda noise: noise, [])}).draw(5, seed=0, steps=8)["s"]
    s, k = found["s"], found["k"]
    expected = 0.5 * s[:, 1:-2] + 2.0 * k[:, :-3] + noise[:, 3:]
    np.testing.assert_allclose(s[:, 3:], expected, atol=1e-12)
    np.testing.assert_allclose(s[:, 0], 0.5 + noise[:, 0])  # before the first step it is the start
    episode = model.rollout(seed=0, steps=8)
    np.testing.assert_array_equal(episode["s"][1:], s[0])
    assert episode.counterfactual({}, at=4) == episode
    done = model.do({"k": 0.0})
    wanted = done.draw(5, seed=0, steps=8)
    np.testing.assert_allclose(model.counterfactual(found, do={"k": 0.0})["s"], wanted["s"])
    report = verify(model, probes=20)
    assert report.outcome == "confirmed"
    assert {edge.key for edge in report.fired} == {("s", "s", 2), ("k", "s", 3)}
    assert nx.is_d_separator(to_dag(model), {"s@-1"}, {"s"}, set())  # of odd and of even steps
    other = autoregression().do({"s": Mechanism(lambda s: s, [Parent("s", 1)])})
    assert not nx.is_d_separator(to_dag(other), {"s@-1"}, {"s"}, set())
    assert from_json(to_json(model)) == model


def test_worlds_have_lags_of_one_step() -> None:
    """A longer lag in a task is refused, with what to declare instead."""
    far = Derived(name="memory", parents=(Parent("x", 2),), mechanism=Linear(weights=(1.0,)))
    with pytest.raises(ModelError, match="declare a state that remembers"):
        World.from_step(
            lambda parameters, state, action, noise: {"x": state["x"]},
            states=[Measured(name="x", default=1.0, parents=("x",))],
            outcomes=[far],
            control_dt=0.1,
        )


def test_another_noise_leaves_the_start_alone() -> None:
    """Only a replaced function acts at the instant before the first step."""
    model = SCM(
        [
            Derived(
                name="s", parents=(Parent("s", 1),), mechanism=Linear(weights=(0.5,)),
                noise=Normal(), start=4.0,
            )
        ]
    )  # fmt: skip
    noisy = model.do({"s": Mechanism(noise=Normal(3.0, 1e-9))})
    assert noisy.draw(2, seed=0, steps=2)["s"] == pytest.approx(np.array([[5.0, 5.5]] * 2))
    assert noisy.solve(begins=True)["s"] == 4.0


def test_an_intervention_after_the_end_is_refused() -> None:
    """It would never be due, and its effect 0 without a word."""
    model = SCM(
        [
            Derived(
                name="s", parents=(Parent("s", 1),), mechanism=Linear(weights=(0.5,)),
                noise=Normal(),
            )
        ]
    )  # fmt: skip
    for late in (Hard(1.0, at=5), Hard(1.0, during=(7, None))):
        with pytest.raises(UnknownOption, match="before 5, where episodes end"):
            model.effect("s", do={"s": late}, n=4, steps=5)
    assert (
        model.effect(
            "s", do={"s": Hard(1.0, at=4)}, versus={"s": Hard(0.0, at=4)}, n=4, steps=5
        ).mean
        == 1
    )


def test_whole_numbers_stay_whole() -> None:
    """A function of an integer that gives something else is refused, with what it gave."""
    x = Exogenous(name="x", distribution=Normal())
    bent = SCM([x, Derived(name="y", parents=("x",), mechanism=np.cos, dtype="integer")])
    with pytest.raises(ModelError, match=r"'y' gives \[.*\], and the variable is an integer"):
        bent.draw(3, seed=0)
    whole = SCM([x, Derived(name="y", parents=("x",), mechanism=np.rint, dtype="integer")])
    assert set(whole.draw(50, seed=0)["y"].ravel().tolist()) <= {-3, -2, -1, 0, 1, 2, 3}
