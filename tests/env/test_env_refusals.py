"""Facts about options and calls that make no sense: typed errors that say what does."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from envs import BACKENDS, PUSHING, make
from gymnasium.envs.registration import EnvSpec
from model_tasks import CARTPOLE

from scm_world.errors import (
    ActionError,
    Infeasible,
    ModelError,
    NotReset,
    SnapshotMismatch,
    UnknownOption,
    UnknownVariable,
)
from scm_world.models.camera import Camera
from scm_world.tasks.rewards import term
from scm_world.tasks.trifinger.cameras import OVERVIEW

COMPLEX = np.zeros(9, complex)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"pad": {"number_of_obstacles": 1}, "keypoints": "view"}, "pad"),
        ({"observation_mode": "custom", "observe": 3}, "names of variables"),
        ({"include": 3}, "names of variables"),
        ({"image_size": 64}, "image_size cannot be 64"),
        ({"cameras": ["60"]}, "cameras cannot be"),
        ({"observation_mode": "pixel", "cameras": []}, "one or more"),
        ({"observation_mode": "pixel", "cameras": "60"}, "one or more"),
        ({"observation_mode": "pixel", "cameras": [{"eye": 1}]}, "field_of_view"),
        ({"observation_mode": "pixel", "image_size": (10.5, 4)}, "height, width"),
        ({"observation_mode": "pixel", "image_size": (10, 4, 3)}, "height, width"),
        ({"observation_mode": "pixel", "image_size": 0}, "positive"),
        ({"start": [("tool_block.mass", 0.1)]}, "dictionary"),
    ],
)
def test_options_that_do_not_go_together(options: dict[str, Any], words: str) -> None:
    """The error names the option, and what it can be."""
    with pytest.raises(UnknownOption, match=words):
        make(**options)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda env: env.reset(options={"do": 5}), UnknownOption, "dictionary"),
        (lambda env: env.do([1]), UnknownOption, "dictionary"),
        (lambda env: env.step("abc"), ActionError, "9 finite numbers"),
        (lambda env: env.step([[1], [2, 3]]), ActionError, "9 finite numbers"),
        (lambda env: env.do({"gravity": [0, 0, -9]}, space="a"), UnknownOption, "A, B, A"),
        (lambda env: env.do({"gravity": [0, 0, -9]}, space=""), UnknownOption, "A, B, A"),
        (lambda env: env.image("6"), UnknownOption, "did you mean '60'"),
        (lambda env: env.do({"gravty": 1}), UnknownVariable, "gravity"),
        (lambda env: env.step(COMPLEX), ActionError, "9 finite numbers"),
        (lambda env: env.step(["0.1"] * 9), ActionError, "9 finite numbers"),
        (lambda env: env.world.step(COMPLEX), ActionError, "9 finite numbers"),
        (lambda env: env.as_action([1, 2]), ActionError, r"shape \(9,\), got \(2,\)"),
        (lambda env: env.as_action(COMPLEX), ActionError, "9 finite numbers"),
        (lambda env: env.restore(3), SnapshotMismatch, "3 is not a snapshot"),
        (lambda env: env.world.restore(3), SnapshotMismatch, "3 is not a snapshot"),
        (lambda env: env.reset(options=3), UnknownOption, "a dictionary, do, episode"),
        (lambda env: env.observe_values({}), UnknownOption, "joint_positions"),
        (lambda env: env.observe_values(3), UnknownOption, "joint_positions"),
    ],
)
def test_calls_that_make_no_sense(
    call: Callable[[Any], Any], error: type[Exception], words: str
) -> None:
    """Nothing happens but the error."""
    env = make().unwrapped
    before = env.reset(seed=0)[0]
    with pytest.raises(error, match=words):
        call(env)
    np.testing.assert_array_equal(env.observe(), before)


@pytest.mark.parametrize("backend", BACKENDS)
def test_there_is_nothing_before_the_first_episode_and_after_the_end(backend: str) -> None:
    """Steps and observations need an episode; a closed environment has none."""
    env = make(backend=backend).unwrapped
    for _ in range(2):
        for call in (lambda: env.step(np.zeros(9)), env.observe, env.world.values):
            with pytest.raises(NotReset):
                call()
        env.reset(seed=0)
        env.close()


def test_after_the_end_it_says_that_it_was_closed() -> None:
    """Not that it was never reset; a reset begins another episode."""
    for env in (make().unwrapped, gymnasium.make_vec(PUSHING, num_envs=2, backend="fake")):
        with pytest.raises(NotReset, match="no episode yet"):
            env.step(env.action_space.sample())
        env.reset(seed=0)
        env.close()
        with pytest.raises(NotReset, match="was closed") as refused:
            env.step(env.action_space.sample())
        assert refused.value.closed


@pytest.mark.parametrize(
    ("achieved", "desired", "words"),
    [
        (np.zeros(9), np.zeros(10), r"achieved goal .*\(\.\.\., 10\)"),
        (np.zeros(10), np.zeros(3), r"desired goal .*\(\.\.\., 10\)"),
        (np.zeros((2, 10)), np.zeros((3, 10)), r"\(3, 10\); it can be: \(2, 10\)"),
        ("much", np.zeros(10), "achieved goal"),
        (np.full(10, np.nan), np.zeros(10), "finite numbers"),
        (np.zeros(10, complex), np.zeros(10), "finite numbers"),
    ],
)
def test_goals_of_other_shapes_get_no_reward(achieved: Any, desired: Any, words: str) -> None:
    """They are refused, with the shape that goals have."""
    env = make(goal_env=True, task_options={"weights": "sparse"})
    env.reset(seed=0)
    with pytest.raises(UnknownOption, match=words):
        env.unwrapped.compute_reward(achieved, desired, {})


@pytest.mark.parametrize(
    ("id_", "options", "words"),
    [
        ("Pushing", {"tool_block_position": [5, 0.1]}, "tool_block.cartesian_position"),
        ("Pushing", {"tool_block_position": [0.1, 0.1, 9]}, "0.5"),
        ("Pushing", {"joint_positions": [9] * 9}, "joint_positions"),
        ("Pushing", {"tool_block_position": [0.24, 0.24, 0.0325]}, "deep in 'stage'"),
        ("Stacking2", {"tool_block_2_position": [0, 0]}, "deep in 'tool_block_2'"),
    ],
)
def test_a_world_that_cannot_begin_is_refused(id_: str, options: Any, words: str) -> None:
    """When it is made, not after the blocks have flown apart."""
    with pytest.raises(ModelError, match=words):
        make(f"scm_world/{id_}-v0", task_options=options)


def test_an_overlap_is_the_fault_of_a_place_not_of_a_velocity() -> None:
    """Whatever is named first."""
    env = make().unwrapped
    env.reset(seed=0)
    place = "tool_block.cartesian_position"
    with pytest.raises(Infeasible) as refused:
        env.do({"tool_block.linear_velocity": [0, 0, 0], place: [0, 0, 0.01]})
    assert refused.value.variable == place
    env.do({place: refused.value.nearest})


def test_a_camera_survives_being_written_down() -> None:
    """``EnvSpec`` makes a dictionary of it."""
    made = make(observation_mode="pixel", cameras=[OVERVIEW, "60"], image_size=16)
    again: Any = gymnasium.make(EnvSpec.from_json(made.spec.to_json()))
    np.testing.assert_array_equal(made.reset(seed=0)[0], again.reset(seed=0)[0])


def test_ones_own_camera_may_have_the_name_of_another() -> None:
    """What is asked for by name follows its variables; what is given stays."""
    mine = Camera("60", eye=(0.0, 0.0, 2.0), target=(0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))
    env = make(observation_mode="pixel", cameras=["60", mine], image_size=16)
    first, second = env.reset(seed=0)[0][:2]
    assert not np.array_equal(first, second)


def test_cameras_measure_by_name() -> None:
    """The robot's cameras where they are now, and the one that overlooks all."""
    env = make().unwrapped
    env.reset(seed=0)
    assert env.image("60").depth.shape == env.image("120").segmentation.shape == (128, 128)
    np.testing.assert_array_equal(env.image("overview").depth, env.image().depth)


def test_compute_reward_warns_of_dense_terms() -> None:
    """Once, and only where steps have them."""
    env = make(goal_env=True)
    observation, info = env.reset(seed=0)
    goals = observation["achieved_goal"], observation["desired_goal"]
    with pytest.warns(UserWarning, match="leaves out 'reward"):
        env.unwrapped.compute_reward(*goals, info)
    env.unwrapped.compute_reward(*goals, info)
    sparse = make(goal_env=True, task_options={"weights": "sparse"})
    sparse.reset(seed=0)
    sparse.unwrapped.compute_reward(*goals, info)


def test_a_term_that_is_no_number_is_refused() -> None:
    """At the reset, and where it becomes none in mid-episode, with its name."""
    for function in (np.cumsum, lambda _: float("nan")):
        own = term("reward.x", function, ("goal_block.polar",), "x")
        env = make(task_options={"terms": [own], "weights": {"reward.x": 1.0}})
        with pytest.raises(ModelError, match=r"reward\.x"):
            env.reset(seed=0)
    late = term("reward.x", lambda t: np.log(0.05 - float(t)), ("control_index",), "x")
    env = make(task_options={"terms": [late], "weights": {"reward.x": 1.0}})
    env.reset(seed=0)
    with pytest.raises(ModelError, match=r"reward\.x"), np.errstate(invalid="ignore"):
        env.step(np.zeros(9, np.float32))


@pytest.mark.parametrize("steps", [0, 3])
@pytest.mark.parametrize("backend", ["mujoco", "bullet"])
def test_an_intervention_after_which_the_reward_fails_is_undone(backend: str, steps: int) -> None:
    """Bit for bit, at the start of an episode and later."""

    def fails(mass: Any) -> float:
        return float("nan") if mass > 0.05 else float(mass)

    own = term("reward.x", fails, ("tool_block.mass",), "x")
    options = {"terms": [own], "weights": {"reward.x": 1.0}}
    env, twin = (make(task_options=options, backend=backend) for _ in range(2))
    for each in (env, twin):
        each.reset(seed=0)
        each.unwrapped.do({"tool_block.mass": 0.03})
        for _ in range(steps):
            each.step(np.zeros(9, np.float32))
    with pytest.raises(ModelError, match=r"reward\.x"):
        env.unwrapped.do({"tool_block.mass": 0.08, "control_index": 7})
    assert env.unwrapped.interventions == twin.unwrapped.interventions
    for _ in range(2):
        for name, value in twin.unwrapped.world.values().items():
            assert np.array_equal(env.unwrapped.world[name], value), name
        env.step(np.zeros(9, np.float32))
        twin.step(np.zeros(9, np.float32))


def test_relative_actions_are_listed_too() -> None:
    """Where an action mode is unknown."""
    with pytest.raises(UnknownOption, match="delta_joint_positions"):
        make(action_mode="torque")


@pytest.mark.parametrize("make_one", [gymnasium.make, gymnasium.make_vec])
@pytest.mark.parametrize("id_", ["scm_world/Pushing-v0", "scm_world/Model-v0"])
def test_a_misspelled_option_is_refused_with_the_nearest_one(
    make_one: Callable[..., Any], id_: str
) -> None:
    """Of single environments, of many, and of models."""
    model = {"model": CARTPOLE} if id_.endswith("Model-v0") else {}
    with pytest.raises(UnknownOption, match="'actionmode'; did you mean 'action_mode'"):
        make_one(id_, actionmode="joint_torques", **model)
    if make_one is gymnasium.make_vec:
        with pytest.raises(UnknownOption, match="'worker'; did you mean 'workers'"):
            make_one(id_, worker=2, **model)


@pytest.mark.parametrize("backend", ["fake", "mujoco"])
def test_a_time_limit_is_that_of_gymnasium(backend: str) -> None:
    """Many environments are truncated where single ones are, and observe the same."""
    options: Any = {"backend": backend, "max_episode_length": 9, "max_episode_steps": 3}
    envs = gymnasium.make_vec("scm_world/Pushing-v0", 2, **options)
    others = gymnasium.make_vec("scm_world/Pushing-v0", 2, vectorization_mode="sync", **options)
    np.testing.assert_array_equal(envs.reset(seed=0)[0], others.reset(seed=0)[0])
    for _ in range(5):
        one, other = (each.step(np.zeros((2, 9), np.float32)) for each in (envs, others))
        for mine, its in zip(one[:4], other[:4], strict=True):
            np.testing.assert_array_equal(mine, its)
    env = gymnasium.make("scm_world/Pushing-v0", backend=backend, max_episode_length=9)
    lengths = [each.spec.max_episode_steps for each in (env, env.unwrapped)]
    assert lengths == [9, 9]
    assert gymnasium.make(env.spec).spec.max_episode_steps == 9
    assert gymnasium.make("scm_world/Reaching-v0", backend=backend).spec.max_episode_steps == 125
    with pytest.raises(UnknownOption, match="max_episode_steps"):
        gymnasium.make_vec("scm_world/Pushing-v0", 2, backend=backend, max_episode_steps=0)
    for each in (envs, others, env):
        each.close()
