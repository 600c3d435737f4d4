from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from scm_world._types import Floats
from scm_world.curricula import resample, together
from scm_world.errors import UnknownOption
from scm_world.evaluation import Protocol, evaluate
from scm_world.evaluation.statistics import Cause, Causes, find_causes
from scm_world.evaluation.statistics.causes import FEWEST, holm
from scm_world.policies import WorldPolicy
from scm_world.variables import Mechanism

N = 200
NOISE = 0.3
VARIANCES = {"line": 1 / 12, "weak": 0.25 / 12, "parabola": 4 / 45, "pose": 0.25 * 2 / 12}
TOTAL = sum(VARIANCES.values()) + NOISE**2
SHARES = {name: part / TOTAL for name, part in VARIANCES.items()} | {"nothing": 0.0, "null": 0.0}


def episodes(seed: int, n: int = N) -> tuple[dict[str, Floats], Floats]:
    """Draw variables of which the effects on the score are known: those of ``SHARES``."""
    rng = np.random.default_rng(seed)
    drawn = {
        "line": rng.random(n),
        "weak": rng.random(n),
        "parabola": rng.uniform(-1.0, 1.0, n),
        "pose": rng.random((n, 2)),
        "nothing": rng.random(n),
        "null": rng.random((n, 3)),
    }
    score = drawn["weak"] / 2 - drawn["line"] + drawn["parabola"] ** 2
    return drawn, score + drawn["pose"].sum(axis=1) / 2 + NOISE * rng.standard_normal(n)


def expected_contrast(name: str, lower: float, upper: float) -> float:
    """Compute the mean effect of values from ``upper`` on minus that of values up to ``lower``."""
    if name == "parabola":
        return (1.0 + upper + upper**2 - (1.0 - lower + lower**2)) / 3.0
    return {"line": -1.0, "weak": 0.5}[name] * (1.0 + upper - lower) / 2.0


def by_name(causes: Causes) -> Mapping[str, Cause]:
    """Find causes by the variables' names."""
    return {cause.variable: cause for cause in causes.causes}


def test_known_effects_are_recovered() -> None:
    """With many episodes, shares and contrasts are those that were put in."""
    drawn, scores = episodes(0, n=8_000)
    found = by_name(find_causes(drawn, scores, permutations=40))
    for name, share in SHARES.items():
        assert found[name].share.value == pytest.approx(share, abs=0.02), name
    assert found["line"].column.contrast.value == pytest.approx(-2 / 3, abs=0.03)
    assert found["weak"].column.contrast.value == pytest.approx(1 / 3, abs=0.03)
    assert found["parabola"].column.contrast.value == pytest.approx(0.0, abs=0.03)
    directions = [found[name].column.direction for name in ("line", "weak", "parabola")]
    assert directions == ["down", "up", "unclear"]


def test_two_hundred_episodes_name_the_causes_and_no_other() -> None:
    """Strong causes are found in twenty protocols of twenty; others hardly ever are."""
    mistakes = 0
    for seed in range(20):
        found = find_causes(*episodes(seed))
        assert {cause.variable for cause in found.found()} >= {"line", "parabola"}
        assert found.ranked()[0].variable in ("line", "parabola")
        mistakes += not {cause.variable for cause in found.found()} <= set(VARIANCES)
    assert mistakes <= 4  # at most one is expected; more than four have probability 0.003


def test_the_column_that_matters_is_named() -> None:
    """Of a variable with three components, the one that breaks the agent is shown."""
    rng = np.random.default_rng(0)
    position = rng.random((N, 3))
    position[:, 2] = 0.0325
    found = find_causes({"tool_block.position": position}, (position[:, 1] < 0.5).astype(float))
    (cause,) = found.causes
    assert cause.column.name == "tool_block.position[1]"
    assert [column.name for column in cause.columns] == [
        "tool_block.position[0]",
        "tool_block.position[1]",
    ]
    assert found.left_out == {"tool_block.position[2]": "it was 0.0325 in every episode"}
    assert "tool_block.position[2]: left out, it was 0.0325 in every episode" in str(found)


def test_an_effect_on_failures_at_both_ends_is_found() -> None:
    """A variable that breaks the agent when small and when large has no contrast but a share."""
    size = np.random.default_rng(0).permutation(np.linspace(0.0, 1.0, N))
    (cause,) = find_causes({"size": size}, (np.abs(size - 0.5) < 0.3).astype(float)).causes
    assert cause.share.low > 0.5
    assert not cause.column.contrast.excludes(0.0)


def test_an_agent_that_always_succeeds_was_not_broken() -> None:
    """A constant score has no causes: share 0, how sure is unknown, p = 1, and no warning."""
    drawn, _ = episodes(2)
    for score in (0.0, 1.0, 0.3):
        for cause in find_causes(drawn, np.full(N, score)).causes:
            assert (str(cause.share), cause.p, cause.p_holm) == ("0.00 [unknown]", 1, 1)
            assert cause.column.contrast.value == pytest.approx(0.0, abs=1e-12)
            assert not cause.column.contrast.excludes(0.0)


def test_episodes_that_did_not_vary_a_variable_are_left_out_for_it_alone() -> None:
    """NaN rows change nothing for the others, and are no evidence for their own."""
    drawn, scores = episodes(3)
    coin = np.random.default_rng(9).random(N) < 0.5
    alone = by_name(find_causes({"line": drawn["line"][coin]}, scores[coin]))["line"]
    drawn["line"][~coin] = np.nan
    found = by_name(find_causes(drawn, scores))
    assert found["line"].n == coin.sum()
    assert found["line"].share == alone.share
    assert found["line"].column == alone.column
    assert found["weak"].n == N


def test_columns_that_were_varied_in_other_episodes_are_compared_apart() -> None:
    """Two columns never varied together have no joint effect, and that is said."""
    values = np.full((N, 2), np.nan)
    values[: N // 2, 0] = values[N // 2 :, 1] = np.arange(N // 2)
    found = find_causes({"pose": values}, np.arange(N) % 7)
    assert found.causes == ()
    assert found.left_out == {"pose": "only 0 episodes varied all its 2 columns"}


def test_few_episodes_say_nothing() -> None:
    """A column with less than the fewest episodes is left out, and the reason is given."""
    few = np.linspace(0.0, 1.0, FEWEST - 1)
    found = find_causes({"mass": few}, few)
    assert found.causes == ()
    assert found.left_out == {"mass": f"only {FEWEST - 1} episodes varied it; {FEWEST} are needed"}
    enough = np.linspace(0.0, 1.0, FEWEST)
    assert find_causes({"mass": enough}, enough).causes[0].share.value == pytest.approx(1.0)


def test_categories_are_their_own_bins() -> None:
    """A category of which only the middle one fails explains all of the score."""
    color = np.random.default_rng(0).integers(3, size=N)
    (cause,) = find_causes({"color": color}, (color != 1).astype(float)).causes
    assert cause.share.value == pytest.approx(1.0)
    rare = (np.arange(N) % 10 == 0).astype(int)
    (cause,) = find_causes({"rare": rare}, rare.astype(float)).causes
    assert cause.column.contrast.value == 1.0
    assert (cause.column.lower, cause.column.upper) == (0.0, 1.0)
    (cause,) = find_causes({"often": 1 - rare}, rare.astype(float)).causes
    assert cause.column.contrast.value == -1.0


def test_one_variable_does_not_change_another() -> None:
    """Except for the correction, a variable's effect is the same alone and among others."""
    drawn, scores = episodes(4)
    among, alone = (
        by_name(find_causes(given, scores))["pose"] for given in (drawn, {"pose": drawn["pose"]})
    )
    assert among.share == alone.share
    assert among.columns == alone.columns
    assert (among.p, alone.p_holm) == (alone.p, alone.p)
    assert among.p_holm >= alone.p_holm


def test_the_same_seed_finds_the_same() -> None:
    """Bootstrap and permutations come from the seed."""
    drawn, scores = episodes(5)
    assert find_causes(drawn, scores) == find_causes(drawn, scores)
    assert find_causes(drawn, scores, seed=1) != find_causes(drawn, scores)


def test_the_correction_of_holm() -> None:
    """It is that of statsmodels 0.15, ``multipletests(p, method="holm")``, in any order."""
    p, expected = [0.02, 0.01, 0.5, 0.013, 0.04, 0.0004], [0.06, 0.05, 0.5, 0.052, 0.08, 0.0024]
    assert holm(p) == pytest.approx(expected, rel=1e-12)
    assert holm(p[::-1]) == pytest.approx(expected[::-1], rel=1e-12)
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []


@pytest.mark.parametrize("n", [12, 15, 60, 200, 1000])
def test_a_line_is_explained_wholly_even_where_values_are_tied(n: int) -> None:
    """A score that is a weighted sum of the columns has a share of one, for any n."""
    table = np.random.default_rng(n).random((n, 3))
    table[: n * 9 // 10, 2] = 2.0  # nine of ten at the upper end
    (cause,) = find_causes({"x": table}, table @ [1.0, 2.0, 3.0], permutations=9).causes
    assert cause.share.value == pytest.approx(1.0)


def test_shares_are_right_on_average_and_their_intervals_as_wide_as_they_vary() -> None:
    """Over 150 small data sets, chance is taken off and the width is 2 x 1.96 deviations."""
    found = []
    for seed in range(150):
        rng = np.random.default_rng(seed)
        cause = rng.random((60, 2))
        scores = cause.sum(axis=1) + np.sqrt(1 / 6) * rng.standard_normal(60)
        (one,) = find_causes({"x": cause}, scores, permutations=1).causes
        found.append(one.share)
    values, low, high = np.array([(share.value, share.low, share.high) for share in found]).T
    assert values.mean() == pytest.approx(0.5, abs=4 * values.std() / np.sqrt(150))
    assert np.mean(high - low) == pytest.approx(3.92 * values.std(), rel=0.12)


@pytest.mark.parametrize(
    "given",
    [
        {"drawn": {"mass": np.zeros(3)}},
        {"drawn": {"mass": np.array(["a"] * N)}},
        {"drawn": {"mass": np.full(N, np.inf)}},
        {"drawn": {"mass": np.zeros((N, 2, 2))}},
        {"scores": np.full(N, np.nan)},
        {"scores": []},
        {"level": 1.0},
        {"permutations": 0},
    ],
)
def test_bad_input_is_refused(given: dict[str, Any]) -> None:
    """Values of another shape, no numbers, and impossible options are errors that say so."""
    values = np.random.default_rng(0).random(N)
    with pytest.raises(UnknownOption, match=r"cannot be .*; it can be"):
        find_causes(**({"drawn": {"mass": values}, "scores": values} | given))


def test_null_variables_are_rarely_called_causes() -> None:
    """Over 200 data sets, p-values of variables without effect are uniform."""
    p = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        wins = (rng.random(60) < 0.7).astype(float)
        drawn = {"one": rng.random(60), "three": rng.random((60, 3))}
        found = find_causes(drawn, wins, permutations=99, seed=seed)
        p += [cause.p for cause in found.causes]
    # Four standard errors of 400 draws from a uniform distribution.
    for level in (0.05, 0.2, 0.5):
        error = 4.0 * np.sqrt(level * (1.0 - level) / len(p))
        assert np.mean(np.array(p) <= level) == pytest.approx(level, abs=error)


@pytest.mark.slow
def test_intervals_of_effects_cover_what_they_should() -> None:
    """Over 400 protocols, intervals contain the truth in 90 to 99 % of the cases."""
    shares = dict.fromkeys(VARIANCES, 0)
    contrasts = {"line": 0, "weak": 0, "parabola": 0}
    for seed in range(400):
        found = by_name(find_causes(*episodes(seed), permutations=1, seed=seed))
        for name in shares:
            share = found[name].share
            shares[name] += share.low <= SHARES[name] <= share.high
        for name in contrasts:
            column = found[name].column
            truth = expected_contrast(name, column.lower, column.upper)
            contrasts[name] += column.contrast.low <= truth <= column.contrast.high
    assert all(360 <= n <= 396 for n in shares.values()), shares
    assert all(360 <= n <= 396 for n in contrasts.values()), contrasts


@pytest.mark.slow
def test_a_family_of_null_variables_is_rarely_called_a_cause() -> None:
    """After Holm's correction, five of a hundred protocols name any of ten null variables."""
    named = 0
    for seed in range(400):
        rng = np.random.default_rng(seed)
        drawn = {f"v{k}": rng.random((N, 1 + k % 3)) for k in range(10)}
        scores = rng.beta(4, 1, N)
        found = find_causes(drawn, scores, permutations=999, seed=seed)
        named += bool(found.found())
    assert 5 <= named <= 38  # 20 expected; four standard errors


def test_variables_that_depend_on_one_another_are_listed() -> None:
    """With the share of the variance that may be the effect of either."""
    rng = np.random.default_rng(0)
    mass, color = rng.random((2, 300))
    size = mass + 0.3 * rng.random(300)
    found = find_causes({"mass": mass, "size": size, "color": color}, mass + 0.1 * rng.random(300))
    assert [*found.dependent] == [("mass", "size")]
    assert "mass and size depend on one another" in str(found)
    curved = find_causes({"x": mass, "y": (mass - 0.5) ** 2}, color)
    assert [*curved.dependent] == [("x", "y")]


def test_independent_draws_are_rarely_called_dependent() -> None:
    """At most one set of six independent variables in twenty is."""
    wrong = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        drawn = {f"v{k}": rng.random((100, 1 + k % 2)) for k in range(6)}
        wrong += bool(find_causes(drawn, rng.random(100), permutations=1).dependent)
    assert wrong <= 3


def test_the_interval_of_a_share_and_its_test_say_the_same() -> None:
    """Zero is in the interval where p is above 5 %, and not in it elsewhere."""
    rng = np.random.default_rng(4)
    for strength in np.linspace(0.0, 0.6, 40):
        values = rng.normal(size=60)
        cause = find_causes({"x": values}, strength * values + rng.normal(size=60)).causes[0]
        assert cause.share.excludes(0.0) == (cause.p <= 0.05)
        assert cause.share.low <= cause.share.value <= cause.share.high


def test_variables_that_were_never_varied_together_are_no_pair() -> None:
    """Half of the episodes vary one of them, the other half the other one."""
    values = np.random.default_rng(5).normal(size=(2, 40))
    values[0, :20], values[1, 20:] = np.nan, np.nan
    found = find_causes({"x": values[0], "y": values[1]}, np.arange(40.0))
    assert not found.dependent


def test_what_has_no_path_to_score_or_observation_is_not_tested() -> None:
    """The mass of a link that stands still, and a color; but not for pictures."""
    asked: dict[str, Any] = {"task": "pushing", "n": 12, "backend": "fake"}
    part = together(
        resample("robot_finger_60_link_0.mass", "A"),
        resample("tool_block.color", "A"),
        resample("tool_block.mass", "A"),
    )
    looks = Protocol("looks", act=part)
    short = {"max_episode_length": 3}
    found = evaluate({"lazy": "random"}, looks, env=short, **asked).causes("looks")
    said = {name for name, why in found.left_out.items() if why.startswith("no directed path")}
    assert said == {"robot_finger_60_link_0.mass", "tool_block.color"}
    assert [cause.variable for cause in found.causes] == ["tool_block.mass"]

    def lazy(observation: Any) -> Any:
        return np.zeros(9)

    seen = evaluate({"lazy": lazy}, looks, env={**short, "observation_mode": "pixel"}, **asked)
    assert len(seen.causes("looks").causes) == 3


def test_a_function_of_the_world_may_read_anything() -> None:
    """So nothing is left out for it."""
    part = resample("tool_block.color", "A")

    @WorldPolicy
    def lazy(world: Any) -> Any:
        return 0.5 * (world.action_low + world.action_high)

    found = evaluate(
        {"lazy": lazy},
        Protocol("looks", act=part),
        task="pushing",
        n=12,
        backend="fake",
        env={"max_episode_length": 3},
    )
    assert [cause.variable for cause in found.causes("looks").causes] == ["tool_block.color"]


def tie(color: Any) -> Any:
    """Let a friction follow a color."""
    return 0.1 + color[..., 0]


def test_a_mechanism_of_a_protocol_is_a_path_to_the_score() -> None:
    """A color does nothing, unless the protocol lets a friction follow it."""
    drawn = resample("floor_color", "A")
    act = {"floor_friction": Mechanism(tie, ["floor_color"], at=1)}
    for part, silent in ((drawn, {"floor_color"}), (together(drawn, act), set())):
        asked: dict[str, Any] = {"n": 12, "backend": "fake", "env": {"max_episode_length": 3}}
        found = evaluate("random", Protocol("looks", act=part), task="pushing", **asked)
        left_out = found.causes("looks").left_out
        assert {n for n, why in left_out.items() if why.startswith("no directed path")} == silent


def test_pure_interactions_are_not_seen() -> None:
    """A product of two variables with mean 0 is as rare a finding as chance; a sum never fails."""
    found = {"product": 0, "sum": 0}
    for seed in range(40):
        rng = np.random.default_rng(seed)
        a, b = rng.uniform(-1.0, 1.0, (2, 100))
        for name, score in (("product", a * b), ("sum", a + b)):
            scores = score + rng.normal(0.0, 0.1, 100)
            causes = find_causes({"a": a, "b": b}, scores, permutations=100)
            found[name] += len(causes.found()) > 0
    assert found["sum"] == 40
    assert found["product"] <= 8
