"""A curriculum at work in an environment."""

from __future__ import annotations

import pickle
from typing import Any

import gymnasium
import numpy as np
import pytest
from curriculum_envs import ENGINES, PUSHING, STILL, along, follow_mass, series, under, value
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import (
    FlattenObservation,
    FrameStackObservation,
    RescaleObservation,
    TimeLimit,
    TransformObservation,
)

from scm_world.curricula import (
    CurriculumEnv,
    at_step,
    during,
    everything,
    follow,
    goals,
    looks,
    make_vec,
    physics,
    poses,
    resample,
    stages,
    timed,
    together,
)
from scm_world.errors import (
    FunctionFailure,
    Infeasible,
    ModelError,
    OutOfBounds,
    UnknownOption,
)
from scm_world.models.scene import TOLERANCE
from scm_world.queries.plans import do
from scm_world.tasks.trifinger.entities.block_world import overlaps
from scm_world.variables import Hard, Reaches
from scm_world.world import Simulation

MASS, POSITION = "tool_block.mass", "tool_block.cartesian_position"


def test_observations_are_those_after_the_intervention() -> None:
    """At a reset and within an episode, observation and info are of the world as it is then."""
    env = under(together(poses("A"), goals("A"), at_step(2, poses("A"))), observation_mode="full")
    observation, _ = env.reset(seed=0)
    np.testing.assert_array_equal(observation, env.unwrapped.observe())
    env.step(STILL)
    before = value(env, POSITION)
    observation, *_ = env.step(STILL)
    assert value(env, POSITION) != before
    np.testing.assert_array_equal(observation, env.unwrapped.observe())


def test_the_goal_dictionary_keeps_its_form() -> None:
    """After an intervention a goal-conditioned view is a dictionary of its space (D44)."""
    env = under(together(goals("A"), timed({"every": 1}, goals("B"))), goal_env=True)
    for number in range(3):
        observation = env.step(STILL)[0] if number else env.reset(seed=0)[0]
        assert env.observation_space.contains(observation)
        desired = env.unwrapped.present()[1]["desired_goal"]
        np.testing.assert_allclose(observation["desired_goal"], np.ravel(desired), atol=1e-6)


def test_pictures_keep_their_form() -> None:
    """After an intervention a picture is a picture, of the other color."""
    blue, red = [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]
    part = together({"floor_color": blue}, at_step(1, {"floor_color": red}))
    env = under(part, observation_mode="pixel", image_size=16)
    first, _ = env.reset(seed=0)
    second = env.step(STILL)[0]
    assert env.observation_space.contains(first)
    assert env.observation_space.contains(second)
    assert (first != second).any()


@pytest.mark.parametrize("backend", ["fake", *ENGINES])
def test_an_intervention_gives_no_reward(backend: str) -> None:
    """A goal that moves to the block is success, and no progress of the robot."""
    still = under({}, backend=backend)
    still.reset(seed=0)
    names = ("cartesian_position", "orientation")
    goal_to_block = {f"goal_block.{name}": value(still, f"tool_block.{name}") for name in names}
    env = under(at_step(1, goal_to_block), backend=backend)
    env.reset(seed=0)
    before, after = still.step(STILL), env.step(STILL)
    assert (after[1], after[4]["reward_terms"]) == (before[1], before[4]["reward_terms"])
    assert (before[4]["is_success"], after[4]["is_success"]) == (False, True)
    terms = env.step(STILL)[4]["reward_terms"]
    assert abs(terms["reward.block_to_goal"]) < 1e-3  # [m], though the goal came 8 cm nearer
    assert terms["fractional_success"] == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("backend", ENGINES)
def test_engines_take_what_is_drawn(backend: str) -> None:
    """On each engine the world is as drawn, apart, and goes on."""
    env = under(
        together(physics("A"), poses("A|B"), goals("A"), looks(), timed({"every": 3}, poses("B"))),
        backend=backend,
    )
    for seed in range(3):
        env.reset(seed=seed)
        assert overlaps(env.unwrapped.world.scene(), tolerance=TOLERANCE) == ()
        for _ in range(6):
            assert np.isfinite(env.step(STILL)[0]).all()
    fake = under(physics("A"))
    names = (MASS, "floor_friction")
    np.testing.assert_allclose(
        [series(under(physics("A"), backend=backend), name, 2) for name in names],
        [series(fake, name, 2) for name in names],
    )


def test_what_the_caller_asks_for_counts_more() -> None:
    """``options['do']`` replaces what the curriculum would set, in any coordinates."""
    env = under(together(everything(besides="joint_positions"), {MASS: 0.02}))
    place = [0.05, 0.02, 0.0325]
    asked = {"tool_block": {"mass": 0.07, "cartesian_position": place}, "block.size": [0.065] * 3}
    for _ in range(5):
        env.reset(options={"do": asked})
        assert value(env, MASS) == 0.07
        np.testing.assert_allclose(value(env, POSITION), place)
    env.reset(options={"do": {MASS: "B"}})
    assert 0.045 < value(env, MASS) <= 0.1


def test_what_was_done_is_known() -> None:
    """The environment lists the interventions of an episode, with their steps."""
    env = under(together({MASS: 0.05}, at_step(2, {"floor_friction": 0.4})))
    env.reset(seed=0)
    for _ in range(3):
        env.step(STILL)
    assert [(step, [*acts]) for step, acts in env.unwrapped.interventions] == [
        (0, [MASS]),
        (2, ["floor_friction"]),
    ]


def test_a_refused_intervention_leaves_the_environment_usable() -> None:
    """The episode goes on, and so do others; a refused reset is no episode."""
    inside = {"tool_block.cartesian_position": [0.0, 0.0, 0.0]}
    env = under(together({MASS: 0.05}, at_step(2, inside)))
    env.reset(seed=0)
    env.step(STILL)
    with pytest.raises(Infeasible):
        env.step(STILL)
    assert value(env, MASS) == 0.05
    assert env.step(STILL)[0].shape == (56,)
    refused = under(
        together(
            lambda situation: {MASS: 0.02 + 0.01 * situation.episode}, during(range(1, 2), inside)
        )
    )
    refused.reset(seed=0)
    for _ in range(2):
        with pytest.raises(Infeasible):
            refused.reset()
        assert refused.state.episode == 1
    assert value(refused, MASS) != 0.03  # all of it or nothing
    assert refused.step(STILL)[0].shape == (56,)


def test_a_curriculum_can_be_held_against_a_space() -> None:
    """What lies outside is refused, at the reset and within the episode."""
    space = {"*.mass": "A"}
    env = under({MASS: 0.09}, variables_space=space)
    with pytest.raises(OutOfBounds):
        env.reset(seed=0)
    later = under(at_step(1, {"floor_friction": 0.4}), variables_space=space)
    later.reset(seed=0)
    with pytest.raises(OutOfBounds, match="not to be set"):
        later.step(STILL)


def test_two_wrappers_act_one_after_the_other() -> None:
    """The outer one counts; both count episodes."""
    inner = under(together({MASS: 0.02}, at_step(1, {"floor_friction": 0.3}), goals("A")))
    env = CurriculumEnv(
        inner, together(during(range(1, 9), {MASS: 0.03}), at_step(1, {MASS: 0.04}))
    )
    found = []
    for _ in range(3):
        observation, _ = env.reset()
        found.append(value(env, MASS))
        np.testing.assert_array_equal(observation, env.unwrapped.observe())
        env.step(STILL)
        assert (value(env, MASS), value(env, "floor_friction")) == (0.04, 0.3)
    assert found == [0.02, 0.03, 0.03]
    assert env.state.episode == inner.state.episode == 2
    env.reset(seed=7)
    assert env.state.episode == inner.state.episode == 3
    assert env.unwrapped.world.episode == 0


def test_an_environment_that_has_begun_goes_on_in_its_noise() -> None:
    """The first reset under a curriculum is the next episode of the same seed."""
    masses = []
    for _ in range(2):
        env = under({})
        env.env.reset(seed=5)
        env = CurriculumEnv(env.env, resample(MASS))
        env.reset()
        masses.append(value(env, MASS))
        assert (env.unwrapped.world.noise.seed, env.unwrapped.world.episode) == (5, 1)
    assert masses[0] == masses[1]


def test_wrappers_may_be_inside_and_outside() -> None:
    """They see what is observed after an intervention."""
    base: Any = gymnasium.make(PUSHING, backend="fake", disable_env_checker=True)
    halved = TransformObservation(base, lambda seen: seen / 2, base.observation_space)
    env: Any = CurriculumEnv(halved, together(poses("A"), at_step(1, poses("B"))))
    np.testing.assert_array_equal(env.reset(seed=0)[0], base.unwrapped.observe() / 2)
    np.testing.assert_array_equal(env.step(STILL)[0], base.unwrapped.observe() / 2)
    flat: Any = FlattenObservation(gymnasium.make(PUSHING, backend="fake", goal_env=True))
    assert CurriculumEnv(flat, goals("A")).reset(seed=0)[0].shape == flat.observation_space.shape
    low = RescaleObservation(base, np.float32(0.0), np.float32(1.0))
    assert low.observation_space.contains(CurriculumEnv(low, poses("A")).reset(seed=0)[0])
    part = together(goals("A"), at_step(1, poses("B")))
    stacked: Any = FrameStackObservation(CurriculumEnv(base, part), 2)
    seen = [stacked.reset(seed=0)[0], stacked.step(STILL)[0]]
    inner = CurriculumEnv(FrameStackObservation(base, 2), part)
    np.testing.assert_array_equal(seen, [inner.reset(seed=0)[0], inner.step(STILL)[0]])
    assert seen[0].shape == (2, 56)


def test_other_environments_are_refused() -> None:
    """A curriculum needs a world with variables."""
    with pytest.raises(UnknownOption, match="ScmWorldEnv"):
        CurriculumEnv(gymnasium.make("CartPole-v1"), goals("A"))


@pytest.mark.filterwarnings("ignore:.*different from the unwrapped version")
def test_gymnasium_accepts_it() -> None:
    """The checker of Gymnasium finds nothing."""
    check_env(under(together(goals(), timed({"every": 7}, physics()))), skip_render_check=True)


def test_episodes_are_counted_when_they_end() -> None:
    """At the end, at a reset in mid-episode, and at one before any step."""
    part = stages({}, {MASS: 0.02}, window=2, up=1.0)
    env = under(part, max_episode_length=2)
    env.reset(seed=0)
    assert env.state.episode == 0
    for _ in range(4):  # truncated after two
        env.step(STILL)
    assert env.state.episode == 1
    env.reset()
    env.step(STILL)
    env.reset()
    assert env.state.episode == 2
    env.reset()
    assert env.state.episode == 3
    (progress,) = env.state.stages.values()
    assert progress.recent == (False, False)  # one without a step tells nothing
    around = TimeLimit(under(part), 1)
    around.reset(seed=0)
    around.step(STILL)
    around.reset()
    assert around.get_wrapper_attr("state").episode == 1


@pytest.mark.parametrize("when", ["before", "between", "within"])
def test_a_state_goes_on_exactly(when: str) -> None:
    """In another environment the next episodes are those that would have come."""
    part = together(
        everything(besides="joint_positions"),
        lambda situation: {"floor_friction": 0.5 + 0.04 * situation.episode},
        stages({}, {"gravity": [0.0, 0.0, -5.0]}, window=2, up=0.01),
        timed({"every": 1}, resample("*.mass")),
    )
    env, other = under(part, max_episode_length=2), under(part, max_episode_length=2)
    if when != "before":
        env.reset(seed=7)
        for _ in range(3):
            env.step(STILL)
            env.step(STILL)
            env.reset()
        env.step(STILL)
    if when == "between":
        env.step(STILL)
    state = env.state.model_dump()
    other.state = state
    assert other.state.model_dump() == state
    env.state = state  # goes on itself, too: the episode that was cut off begins again
    seed = 7 if when == "before" else None
    for episode in range(3):
        one, two = (e.reset(seed=None if episode else seed)[0] for e in (env, other))
        np.testing.assert_array_equal(one, two)
        assert (
            env.unwrapped.world.episode
            == (3 if when == "within" else 4) * (when != "before") + episode
        )
        for _ in range(2):
            np.testing.assert_array_equal(env.step(STILL)[0], other.step(STILL)[0])
        assert env.state.model_dump() == other.state.model_dump()


def test_what_is_no_state_is_refused() -> None:
    """And nothing has changed then."""
    env = under(goals())
    env.reset(seed=0)
    env.step(STILL)
    before = env.state.model_dump()
    for wrong in ({"episode": "x"}, {**before, "noise": 5}, {**before, "noise": [1, -1]}):
        with pytest.raises(ModelError):
            env.state = wrong
    assert env.state.model_dump() == before


def test_errors_of_a_user_are_named() -> None:
    """Of a function, with its name; the cause is the error itself."""

    def fragile(situation: Any) -> dict[str, Any]:
        return {}["mass"]  # type: ignore[no-any-return]

    words = "fragile' of a curriculum raised KeyError: 'mass'"
    with pytest.raises(FunctionFailure, match=words) as refused:
        under(follow(fragile)).reset(seed=0)
    assert isinstance(refused.value.__cause__, KeyError)


@pytest.mark.parametrize("given", [3, [("do", {})]])
def test_options_of_a_reset_are_a_dictionary(given: Any) -> None:
    """With a curriculum as without, in one environment and in many."""
    many = make_vec("scm_world/Pushing-v0", 2, goals(), backend="fake")
    for env in (under(goals()), many):
        with pytest.raises(UnknownOption, match="a dictionary"):
            env.reset(options=given)


def test_functions_see_the_situation() -> None:
    """A function is asked once for each episode: its number, its step, its structure."""
    seen: list[Any] = []

    def watch(situation: Any) -> dict[str, Any]:
        seen.append((situation.episode, situation.step, MASS in situation.model))
        return {MASS: Hard(0.05, at=3)}

    env = under(together({MASS: 0.03}, follow(watch)))
    for _ in range(2):
        env.reset()
        assert along(env, MASS, 4) == [0.03, 0.03, 0.05, 0.05]
    assert seen == [(0, 0, True), (1, 0, True)]
    masses = series(under(follow(follow_mass)), MASS, 2)
    np.testing.assert_allclose(masses, [0.02, 0.03])


def test_a_reset_is_one_transaction_and_one_observation(monkeypatch: pytest.MonkeyPatch) -> None:
    """The curriculum, the caller and the environment's start are one intervention."""
    env = under(physics("A"), start={MASS: 0.03})
    asked: list[set[str]] = []
    do = Simulation.do
    monkeypatch.setattr(
        Simulation,
        "do",
        lambda world, acts, **more: asked.append({*acts}) or do(world, acts, **more),
    )
    looks: list[int] = []
    look = env.unwrapped._look
    monkeypatch.setattr(env.unwrapped, "_look", lambda: looks.append(1) or look())
    env.reset(seed=0, options={"do": {"floor_friction": 0.4}})
    assert len(asked) == len(looks) == 1
    assert {MASS, "floor_friction", "gravity"} <= asked[0]
    assert value(env, "floor_friction") == 0.4


def test_an_event_within_the_episode_is_a_predicate_of_the_plan() -> None:
    """It is waited for anew in every episode, and acts once in each."""
    part = timed({"when": Reaches("control_index", above=1.5)}, {MASS: 0.05})
    env = under(together({MASS: 0.02}, part))
    for _ in range(2):
        env.reset()
        assert along(env, MASS, 4) == [0.02, 0.05, 0.05, 0.05]


def test_a_plan_is_a_part() -> None:
    """Its times are those of every episode, and together with others it counts as any part."""
    plan = do({MASS: (0.03, Hard(0.05, at=2)), "floor_friction": Hard(0.2, at=1)})
    for curriculum in (plan, together({"floor_friction": 0.5}, plan)):
        env = under(curriculum)
        for _ in range(2):
            env.reset()
            assert [value(env, MASS), *along(env, MASS, 3)] == [0.03, 0.03, 0.05, 0.05]
            assert value(env, "floor_friction") == 0.2


@pytest.mark.parametrize("inside", [False, True])
def test_a_snapshot_has_the_plan_and_the_stages(inside: bool) -> None:
    """Also of an episode before the present one, and of two curricula around one another."""
    part = together(
        lambda situation: {MASS: 0.02 + 0.01 * situation.episode},
        at_step(2, resample("floor_friction")),
        timed({"when": Reaches("control_index", above=2.5)}, {"gravity": [0.0, 0.0, -5.0]}),
        stages({}, {"restitution": 0.3}, up=0.01, window=2),
    )
    env = under(part, max_episode_length=4)
    env = CurriculumEnv(env, during(range(1, 99, 2), {"stage_friction": 0.3})) if inside else env
    env.reset(seed=4)
    env.step(STILL)
    saved, state = env.snapshot(), env.state.model_dump()

    def rest() -> list[Any]:
        seen = [env.step(STILL)[0] for _ in range(3)]
        for _ in range(2):
            seen += [env.reset()[0], *(env.step(STILL)[0] for _ in range(4))]
        return [*seen, env.state.model_dump(), env.unwrapped.world.values()]

    first = rest()
    env.restore(saved)
    assert env.state.model_dump() == state
    np.testing.assert_equal(rest(), first)
    env.restore(pickle.loads(pickle.dumps(saved)))  # noqa: S301 # our own
    np.testing.assert_equal(rest(), first)
