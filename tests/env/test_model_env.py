"""``scm_world/Model-v0``: environments of models, single and many at once."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import SyncVectorEnv
from model_tasks import (
    ANGLE,
    CARTPOLE,
    PLACE,
    Balance,
    Decay,
    Falling,
    Fragile,
    FragileTogether,
    Scored,
    upright,
)
from numba import njit

from scm_world import World
from scm_world.env import MODEL_ID, ScmWorldEnv
from scm_world.errors import (
    ActionError,
    EngineFailure,
    InterventionError,
    ModelError,
    UnknownOption,
    UnreadableFile,
)

MODES = ("NextStep", "SameStep", "Disabled")


def make(model: Any = None, **options: Any) -> Any:
    """Make an environment without Gymnasium's own checker."""
    return gymnasium.make(MODEL_ID, model=model or Balance(), disable_env_checker=True, **options)


def same(one: Any, other: Any) -> bool:
    """Tell whether observations, rewards, flags and infos are the same, bit for bit."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, tuple) or (isinstance(one, np.ndarray) and one.dtype == object):
        return len(one) == len(other) and all(map(same, one, other))
    return bool(np.array_equal(one, other))


def test_options_of_the_model_and_of_the_environment_go_together() -> None:
    """A model is XML, and a reward a function and what it is given."""
    env = make(CARTPOLE, reward=(upright, ANGLE, PLACE), control_dt=0.05, context="observation")
    inner: Any = env.unwrapped
    assert (inner.world.options.control_period, inner.made_with["action_mode"]) == (
        0.05,
        "controls",
    )
    assert env.action_space.shape == (1,)
    assert list(inner.layout)[:4] == [PLACE, "slider.velocity", ANGLE, "hinge.velocity"]
    assert "pole.mass" in inner.layout
    observation, info = env.reset(seed=0)
    assert info == {"reward_terms": {"reward": 1.0}}
    assert observation in env.observation_space
    _, reward, terminated, truncated, _ = env.step([1.0])
    assert reward == upright(inner.world[ANGLE], inner.world[PLACE])
    assert (terminated, truncated) == (False, False)


def test_normalized_actions_fill_the_range_of_the_actuator() -> None:
    """1 is its upper end, -1 its lower one; what has no bounds keeps its unit."""
    env = make()
    env.reset(seed=0)
    for action, control in ((1.0, 1.0), (-1.0, -2.0), (0.0, -0.5), (9.0, 1.0)):
        env.step([action])
        assert env.unwrapped.world["motor.control"] == control
    free = make(Decay(), backend="step")
    assert (free.action_space.low == -np.inf).all()
    free.reset(seed=0)
    free.step([3.0, -5.0])
    np.testing.assert_array_equal(free.unwrapped.world["inflow"], [3.0, -5.0])


def test_relative_controls_add_up() -> None:
    """With ``delta_controls`` an action is added to the last control."""
    env = make(action_mode="delta_controls", delta_scale=0.5)
    env.reset(seed=0)
    controls = []
    for _ in range(4):
        env.step([1.0])
        controls.append(float(env.unwrapped.world["motor.control"]))
    assert controls == [0.75, 1.0, 1.0, 1.0]
    with pytest.raises(UnknownOption, match="delta_controls"):
        make(action_mode="joint_torques")


def test_states_do_not_saturate() -> None:
    """They are scaled by their range; beyond it they go on, as soft limits let them."""
    env = make()
    env.reset(seed=0)
    env.unwrapped.do({PLACE: 1.79, "slider.velocity": 3.0})
    seen = [env.step([1.0])[0][0] for _ in range(5)]
    assert max(seen) > 1.0
    np.testing.assert_allclose(seen[-1], env.unwrapped.world[PLACE] / 1.8, rtol=1e-6)
    raw = make(normalize_observations=False)
    assert (raw.observation_space.low < -1e30).all()


def test_what_the_task_does_not_say_is_not_told() -> None:
    """``info`` has success and its fraction where there are such variables."""
    told = {kind: make(kind()).reset(seed=0)[1] for kind in (Balance, Falling, Scored)}
    assert [*told[Balance]] == ["is_success", "success", "reward_terms"]
    assert [*told[Falling]] == ["reward_terms"]
    assert told[Scored]["fractional_success"] > 0.9
    assert told[Balance]["success"] is True


def test_an_episode_is_terminated_where_the_variable_says_so() -> None:
    """And truncated at its length."""
    env = make(Falling())
    env.reset(seed=0)
    steps, terminated, truncated = 0, False, False
    while not (terminated or truncated):
        _, _, terminated, truncated, _ = env.step([1.0])
        steps += 1
    assert terminated
    assert abs(env.unwrapped.world[PLACE]) > 0.5
    env.reset(seed=0)
    flags = [env.step([1.0 / 3.0])[2:4] for _ in range(30)]  # 0 N
    assert flags[-1] == (False, True)
    assert steps < 30


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("kind", [Balance, Falling, Scored])
def test_many_do_what_single_ones_do(kind: Any, mode: str) -> None:
    """Bit for bit, with compiled rewards and with functions of Python, in all modes of resets."""
    options = {"context": "observation"}
    many = gymnasium.make_vec(MODEL_ID, 3, model=kind(), autoreset_mode=mode, **options)
    single = SyncVectorEnv([lambda: make(kind(), **options)] * 3, autoreset_mode=mode)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (45, 3, 1)).astype(np.float32)
    actions[:, 1] = 1.0  # it drives off
    shown = [envs.reset(seed=5) for envs in (many, single)]
    assert same(*shown)
    do = {1: {"pole.mass": 0.3}}
    many.do(do)  # type: ignore[attr-defined] # not of Gymnasium's kinds
    single.envs[1].unwrapped.do(do[1])
    ended = np.zeros(3, bool)
    for action in actions:
        if mode == "Disabled" and ended.any():
            shown = [envs.reset(options={"reset_mask": ended}) for envs in (many, single)]
            assert same(*shown)
        shown = [envs.step(action) for envs in (many, single)]
        assert same(*shown)
        ended = shown[0][2] | shown[0][3]
    many.close()
    single.close()


@pytest.mark.parametrize("workers", [1, 2])
def test_many_worlds_of_a_function(workers: int) -> None:
    """Also where the physics is a function, and actions have two components."""
    many = gymnasium.make_vec(MODEL_ID, 2, model=Decay(), backend="step", workers=workers)
    one = make(Decay(), backend="step")
    seen, _ = many.reset(seed=0)
    np.testing.assert_array_equal(seen[0], one.reset(seed=0)[0])
    given = np.array([[1.0, 0.0], [2.0, 0.0]])
    for _ in range(3):
        seen, rewards, *_ = many.step(given)
        expected = one.step(given[0])
    np.testing.assert_array_equal(seen[0], expected[0])
    assert rewards[0] == expected[1] < rewards[1]


def test_gymnasiums_checker_has_nothing_to_say() -> None:
    """But that numbers without bounds have none."""
    env = gymnasium.make(MODEL_ID, model=Falling(), normalize_observations=False).unwrapped
    check_env(env, skip_render_check=True)


def test_copies_go_on_bit_for_bit() -> None:
    """Copied and pickled, in the middle of an episode."""
    env: Any = make(Balance(), context="privileged").unwrapped
    env.reset(seed=3)
    env.do({"pole.mass": "B"})
    env.step([0.3])
    others = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]  # noqa: S301 # our own
    expected = env.step([0.5])
    for other in others:
        assert same(expected[0], other.step([0.5])[0])


def test_pictures_are_observed_and_drawn() -> None:
    """From a camera of the file, and from one that follows what moves."""
    cameras = ["side", "automatic"]
    env = make(
        observation_mode="pixel", cameras=cameras, image_size=(24, 32), render_mode="rgb_array"
    )
    first, _ = env.reset(seed=0, options={"do": {ANGLE: 0.0}})
    assert env.observation_space.shape == first.shape == (2, 3, 24, 32)
    env.unwrapped.do({ANGLE: 1.5})
    assert (env.unwrapped.observe() != first).any(axis=(1, 2, 3)).all()
    assert env.render().shape == (480, 640, 3)
    assert env.unwrapped.image("side").names == ("world", "cart", "pole")
    assert env.unwrapped.image().depth.shape == (480, 640)
    with pytest.raises(UnknownOption, match="side"):
        make(observation_mode="pixel", cameras=["front"])
    empty = make(Decay(), backend="step", render_mode="rgb_array")
    empty.reset(seed=0)
    with pytest.raises(ModelError, match="no pictures"):
        empty.render()


@pytest.mark.parametrize(
    ("options", "error", "said"),
    [
        ({"model": CARTPOLE}, ModelError, "has no reward"),
        (
            {"model": "no_such.xml", "reward": (upright, ANGLE, PLACE)},
            UnreadableFile,
            "no_such.xml",
        ),
        ({"model": CARTPOLE, "rewrad": 3}, UnknownOption, "rewrad"),
        ({"model": Balance(), "seconds": 3.0}, UnknownOption, "with a source that is made already"),
        ({"model": Balance(), "goal_env": True}, UnknownOption, "has no goals"),
        ({"model": Balance(), "keypoints": "view"}, UnknownOption, "no blocks"),
        ({"model": Balance(), "preset": "fast"}, UnknownOption, "preset"),
        ({"model": "pushng"}, UnknownOption, "did you mean 'pushing'"),
    ],
)
def test_what_cannot_be_made_is_refused(options: dict[str, Any], error: Any, said: str) -> None:
    """With what was given, and what there is."""
    with pytest.raises(error, match=said):
        gymnasium.make(MODEL_ID, **options)


def test_options_of_a_reset_are_a_dictionary() -> None:
    """Anything else is refused with what is allowed."""
    env = make()
    with pytest.raises(UnknownOption, match="a dictionary"):
        env.reset(options=3)


def test_a_task_brings_its_backend() -> None:
    """A step function needs no name of one, alone or as one of many."""
    env = make(Decay())
    many = gymnasium.make_vec(MODEL_ID, 2, model=Decay())
    assert env.unwrapped.world.backend.name == World(Decay()).backend.name == "step"
    many.reset(seed=0)
    env.reset(seed=0)
    action = np.zeros(many.action_space.shape)
    assert same(many.step(action)[0][0], env.step(action[0])[0])


def test_what_cannot_be_done_is_refused() -> None:
    """Actions of another size, and interventions on what is no variable."""
    env = make()
    env.reset(seed=0)
    with pytest.raises(ActionError, match=r"shape \(1,\), got \(2,\)"):
        env.step([0.0, 0.0])
    with pytest.raises(ActionError, match="a finite number"):
        env.step([np.nan])
    with pytest.raises(InterventionError):
        env.unwrapped.do({"pole.mas": 0.1})


def fails(place: Any) -> Any:
    """Divide by zero where the cart has moved to the right."""
    return 1.0 / 0.0 if place > 0.0 else 1.0


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda place: np.nan if place > 0.0 else 1.0, "'reward' gives nan, not a finite number"),
        (lambda place: None if place > 0.0 else 1.0, "'reward' gives None, not a finite number"),
        (lambda place: "1" if place > 0.0 else 1.0, "'reward' gives '1', not a finite number"),
        (lambda place: np.ones(2) if place > 0.0 else 1.0, r"'reward' gives array\(\[1., 1.\]\)"),
        (fails, "'reward' raised ZeroDivisionError: float division by zero"),
    ],
)
def test_a_reward_function_that_fails_later_is_named(wrong: Any, message: str) -> None:
    """With the control step, and of many environments with the number of the one."""
    task = Balance(reward=(wrong, PLACE))
    env = make(task)
    env.reset(seed=0)
    with pytest.raises(ModelError, match=f"in control step 1, the function of {message}"):
        env.step([1.0])
    many = gymnasium.make_vec(MODEL_ID, 2, model=task)
    many.reset(seed=0)
    with pytest.raises(ModelError, match=rf"(?s)environment 1: .*in control step 1, .*{message}"):
        many.step(np.array([[-1.0], [1.0]]))
    episode = World(task).rollout(np.array([1.0]), steps=3)
    with pytest.raises(ModelError, match=f"in control step 1, the function of {message}"):
        episode["reward"]


def test_a_compiled_reward_that_is_no_number_is_an_error() -> None:
    """Of a single environment, and of one of many, with its number."""
    task = Balance(reward=(njit(lambda place: np.nan if place > 0.0 else 1.0), PLACE))
    env = make(task)
    env.reset(seed=0)
    with pytest.raises(ModelError, match="not a finite number"):
        env.step([1.0])
    many = gymnasium.make_vec(MODEL_ID, 2, model=task)
    many.reset(seed=0)
    with pytest.raises(ModelError, match=r"(?s)environment 1: .*not a finite number"):
        many.step(np.array([[-1.0], [1.0]]))


def test_success_is_0_or_1() -> None:
    """Another number is refused in the step that gives it."""
    env = make(Balance(success=(lambda place: 2 if place > 0.0 else 1, PLACE)))
    env.reset(seed=0)
    with pytest.raises(ModelError, match="in control step 1, the function of 'success' gives 2"):
        env.step([1.0])


def test_a_function_that_cannot_be_compiled_is_named() -> None:
    """With the variable that it is of."""
    task = Balance(reward=(njit(lambda angle: angle.nothing), ANGLE))
    with pytest.raises(ModelError, match="function of 'reward'"):
        make(task).reset(seed=0)


def test_a_model_that_has_no_actuator_can_be_watched() -> None:
    """Its actions have no components."""
    bob = '<mujoco><worldbody><body name="bob"><freejoint/><geom size=".1"/></body></worldbody>'
    env = make(f"{bob}</mujoco>", reward=(lambda place: float(place[2]), "bob.cartesian_position"))
    env.reset(seed=0)
    assert env.action_space.shape == (0,)
    assert env.step(np.zeros(0))[1] < 0.0


def test_the_defaults_of_the_robot_are_what_they_were() -> None:
    """An environment of a task of this package says with which options it was made."""
    made = ScmWorldEnv("pushing", backend="fake").made_with
    wanted = {"action_mode": "joint_positions", "preset": "fast", "frame_skip": 10}
    assert wanted.items() <= made.items()


@pytest.mark.parametrize("task", [Fragile, FragileTogether])
def test_a_function_that_fails_in_one_world_stops_no_other(task: Any) -> None:
    """Its world is as it was, and goes on; the others are one step further."""
    many: Any = gymnasium.make_vec(MODEL_ID, 3, model=task())
    many.reset(seed=[0, 1, 2])
    asked = np.array([[0.5], [0.25], [-0.5]], dtype=np.float32)
    many.step(asked)
    many.do({1: {"size": 0.0}})
    with pytest.raises(EngineFailure, match="full"):
        many.step(asked)
    np.testing.assert_array_equal(many.present()[0].ravel(), [2.0, 1.25, 0.0])
    many.do({1: {"size": 5.0}})
    _, rewards, *_ = many.step(asked)
    np.testing.assert_array_equal(many.present()[0].ravel(), [2.5, 1.5, -0.5])
    np.testing.assert_allclose(rewards, [7.5, 4.0, -5.5])
    many.close()


def test_an_intervention_after_which_the_reward_fails_is_not_done() -> None:
    """The world is as it was, and the environment goes on like one without the intervention."""
    env, other = (make(CARTPOLE, reward=(ratio, PLACE, "pole.mass")) for _ in range(2))
    for one in (env, other):
        one.reset(seed=0)
        one.step(np.array([0.5], np.float32))
        one.unwrapped.do({PLACE: 0.25})
    before = env.unwrapped.world.values()
    with pytest.raises(ModelError, match="ZeroDivisionError"):
        env.unwrapped.do({"pole.mass": 2.0, PLACE: 0.5})
    assert same(env.unwrapped.world.values(), before)
    assert env.unwrapped.interventions == other.unwrapped.interventions
    for one in (env, other):
        one.unwrapped.do({ANGLE: 0.125})
    assert same(env.step(np.array([-0.5], np.float32)), other.step(np.array([-0.5], np.float32)))


def ratio(place: Any, mass: Any) -> float:
    """Give a number, but where the mass is 2."""
    return float(place) / (float(mass) - 2.0)
