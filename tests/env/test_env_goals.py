"""Goals: random ones, and rewards that are computed from them."""

from __future__ import annotations

import importlib.util
from typing import Any

import gymnasium
import numpy as np
import pytest
from envs import MADE, PUSHING, REACHING, make, roll

from scm_world.env import IDS
from scm_world.tasks import TASKS

SPARSE = {"weights": "sparse"}
NEEDS_SB3 = pytest.mark.skipif(
    importlib.util.find_spec("stable_baselines3") is None, reason="needs stable-baselines3"
)


def goals_only(id_: str) -> dict[str, Any]:
    """Give the options with which only the fractional success counts."""
    dense = len(TASKS[IDS[id_]].default_weights) - 1
    return {"dense_reward_weights": [0.0] * dense, "fractional_reward_weight": 3.0}


def visit(env: Any, steps: int = 6) -> list[tuple[Any, float]]:
    """Begin where the goal is fulfilled and move it away later; give observations and rewards."""
    env.reset(seed=0)
    env.action_space.seed(0)
    world = env.unwrapped.world
    taken = []
    for step in range(steps):
        if step == steps // 2:
            env.unwrapped.do(world.task.sample_goal("A"))
        elif world.task.name == "reaching":
            tips = world["end_effector_positions"].reshape(3, 3)
            names = ("goal_60", "goal_120", "goal_300")
            env.unwrapped.do(
                {f"{n}.cartesian_position": t for n, t in zip(names, tips, strict=True)}
            )
        elif step == 0:
            env.unwrapped.do(world.task.solution(world.values()))
        observation, reward, *_ = env.step(0.02 * env.action_space.sample())
        taken.append((observation, reward))
    return taken


@pytest.mark.parametrize("conventions", ["scm_world", "causal_world"])
@pytest.mark.parametrize("sparse", [True, False])
@pytest.mark.parametrize("id_", [PUSHING, REACHING])
def test_reward_of_goals_is_the_reward_of_the_step(
    id_: str, sparse: bool, conventions: str
) -> None:
    """Where only goals have weights, the computed reward is that of the step, scale included."""
    weights = SPARSE if sparse else goals_only(id_)
    env = make(id_, goal_env=True, task_options=weights, conventions=conventions)
    taken = visit(env)
    compute = env.unwrapped.compute_reward
    for observation, reward in taken:
        found = compute(observation["achieved_goal"], observation["desired_goal"], {})
        assert found == pytest.approx(reward, abs=1e-12)
    assert len({round(reward, 9) for _, reward in taken}) > 1


@pytest.mark.parametrize("id_", MADE)
def test_rewards_are_computed_for_many_goals_at_once(id_: str) -> None:
    """Leading axes are kept: many rewards at once are the single ones."""
    env = make(id_, goal_env=True, task_options=goals_only(id_), random_goal="A")
    seen = [step[0] for step in roll(env, 5)]
    achieved, desired = (
        np.array([observation[key] for observation in seen])
        for key in ("achieved_goal", "desired_goal")
    )
    compute = env.unwrapped.compute_reward
    singles = [float(compute(a, d, {})) for a, d in zip(achieved, desired, strict=True)]
    np.testing.assert_allclose(compute(achieved, desired, [{}] * 6), singles)
    table = compute(achieved.reshape(2, 3, -1), desired.reshape(2, 3, -1), None)
    np.testing.assert_allclose(table, np.reshape(singles, (2, 3)))


@pytest.mark.parametrize("id_", MADE)
def test_spaces_of_goals_have_their_true_shapes(id_: str) -> None:
    """Both goals lie in their spaces, which are as exact as rewards need."""
    env = make(id_, goal_env=True, context="privileged")
    observation, info = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert list(observation) == ["observation", "context", "achieved_goal", "desired_goal"]
    for name in ("achieved_goal", "desired_goal"):
        assert env.observation_space[name].dtype == np.float64
        np.testing.assert_array_equal(observation[name], info[name])


def test_relabelled_goals_are_fulfilled() -> None:
    """In hindsight, with what was achieved as the goal, every step is a success."""
    env = make(goal_env=True, task_options=SPARSE, backend="mujoco")
    achieved = np.array([step[0]["achieved_goal"] for step in roll(env, 20)])
    compute = env.unwrapped.compute_reward
    np.testing.assert_array_equal(compute(achieved, achieved, None), np.ones(21))
    elsewhere = achieved + np.array([0.0, 0.0, 0.0, 0.3, *[0.0] * 6])
    np.testing.assert_array_equal(compute(achieved, elsewhere, None), np.zeros(21))


@pytest.mark.parametrize("id_", MADE)
def test_random_goals_differ_between_episodes_and_not_between_runs(id_: str) -> None:
    """A random goal is another one in the next episode, and the same for the same seed."""
    if not TASKS[IDS[id_]].goal_causes:
        pytest.skip("the task has one goal only")
    runs = []
    for _ in range(2):
        env = make(id_, random_goal="A")
        first = env.reset(seed=3)[1]["desired_goal"]
        runs.append((first, env.reset()[1]["desired_goal"]))
    (one, then), (two, again) = runs
    np.testing.assert_array_equal(one, two)
    np.testing.assert_array_equal(then, again)
    assert one.shape != then.shape or not np.array_equal(one, then)


def test_random_goals_lie_in_the_space() -> None:
    """Goals from A and from B have the radii of these spaces."""
    for space, low, high in (("A", 0.0, 0.11), ("B", 0.11, 0.15)):
        env = make(random_goal=space)
        env.reset(seed=0)
        for _ in range(20):
            env.reset()
            radius = env.unwrapped.world["goal_block.cylindrical_position"][0]
            assert low <= radius <= high


@NEEDS_SB3
@pytest.mark.parametrize("id_", [PUSHING, REACHING])
def test_checker_of_stable_baselines_is_content(id_: str) -> None:
    """The checker of Stable-Baselines3 passes vectors and goals without a warning."""
    from stable_baselines3.common.env_checker import check_env

    for options in ({}, {"goal_env": True, "task_options": SPARSE}):
        check_env(gymnasium.make(id_, **options), skip_render_check=True)


@NEEDS_SB3
def test_hindsight_replay_learns() -> None:
    """SAC with hindsight replay runs, and relabels with the rewards of the environment."""
    import stable_baselines3

    env = make(REACHING, goal_env=True, random_goal="A", task_options=SPARSE, max_episode_length=25)
    model = stable_baselines3.SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=stable_baselines3.HerReplayBuffer,
        learning_starts=60,
        batch_size=32,
        policy_kwargs={"net_arch": [16]},
        seed=0,
        device="cpu",
    )
    model.learn(120)
    buffer: Any = model.replay_buffer
    sample = buffer.sample(64)
    achieved, desired = (
        sample.next_observations[key].numpy() for key in ("achieved_goal", "desired_goal")
    )
    expected = env.unwrapped.compute_reward(achieved, desired, None)
    np.testing.assert_allclose(sample.rewards.numpy().ravel(), expected, atol=1e-6)
    assert sample.rewards.max() == 1.0
