"""The Gymnasium face."""

from __future__ import annotations

import itertools
import runpy
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from envs import ABSOLUTE, BACKENDS, MADE, PUSHING, REACHING, RELATIVE, make, roll
from gymnasium.utils.env_checker import check_env

from scm_world.env import IDS, ScmWorldEnv
from scm_world.errors import ActionError, InterventionError, UnknownOption
from scm_world.tasks import TASKS


def test_there_is_an_environment_for_every_task() -> None:
    """Every registered task has one environment, named after it."""
    assert sorted(IDS.values()) == sorted(TASKS)
    assert "scm_world/CreativeStackedBlocks-v0" in IDS


@pytest.mark.parametrize(
    ("id_", "backend", "mode"),
    [
        *itertools.product(MADE, BACKENDS, ABSOLUTE[:1]),
        *itertools.product([PUSHING], BACKENDS, ABSOLUTE[1:]),
    ],
)
def test_checker_has_nothing_to_say(id_: str, backend: str, mode: str) -> None:
    """Gymnasium's checker passes every environment on every engine, with every kind of action."""
    check(make(id_, backend=backend, action_mode=mode))


PADS = {"scm_world/General-v0": {"nums_objects": 5}}
"""Where a random goal draws how many blocks there are."""


@pytest.mark.parametrize("id_", [REACHING, PUSHING, "scm_world/General-v0"])
@pytest.mark.parametrize(
    "options",
    [
        *({"action_mode": mode} for mode in RELATIVE),
        {"observation_mode": "full"},
        {"observation_mode": "full", "normalize_observations": False},
        {"observation_mode": "pixel", "cameras": ["60"], "image_size": 16},
        {"observation_mode": "custom", "observe": ["joint_torques", "gravity", "success"]},
        {"include": ["joint_torques"], "context": "observation"},
        {"context": "privileged"},
        {"goal_env": True, "context": "privileged"},
        {"start": {"sensor_noise": 0.05}, "random_goal": "A"},
    ],
    ids=str,
)
def test_checker_has_nothing_to_say_about_options(id_: str, options: dict[str, Any]) -> None:
    """Nor about what can be observed, done and told."""
    if options.get("random_goal") is not None and id_ in PADS:
        options = {**options, "pad": PADS[id_]}
    check(make(id_, **options), skip_render_check=True)


def test_checker_renders_all_that_needs_no_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    """The checker's pictures pass too."""
    monkeypatch.setattr("scm_world.env.environment.has_screen", lambda: False)
    check(make(render_mode="rgb_array"), skip_render_check=False)


def check(env: Any, *, skip_render_check: bool = True) -> None:
    """Let the checker look for faults, with warnings as errors."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=skip_render_check)


def test_raw_actions_bring_the_one_documented_warning() -> None:
    """With actions in SI units the checker only recommends a symmetric space."""
    env = make(normalize_actions=False, normalize_observations=False)
    with pytest.warns(UserWarning, match="symmetric and normalized"):
        check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.parametrize("backend", BACKENDS)
def test_observation_stays_in_its_space(backend: str) -> None:
    """No number leaves its bounds, under random torques and violent interventions."""
    env = make(backend=backend, action_mode="joint_torques", normalize_observations=False)
    roll(env, 5)
    env.unwrapped.do({"tool_block.linear_velocity": [3.0, 2.0, 4.0]})
    env.unwrapped.do({"tool_block.angular_velocity": [90.0, -90.0, 40.0]})
    for _ in range(60):
        observation = env.step(env.action_space.sample())[0]
        assert env.observation_space.contains(observation)


@pytest.mark.parametrize("id_", [PUSHING, REACHING])
def test_layout_is_the_published_one(id_: str) -> None:
    """The observation has the published length, and its parts stand where they should."""
    env = make(id_, normalize_observations=False)
    observation, _ = env.reset(seed=0)
    world = env.unwrapped.world
    assert observation.shape == ({"Pushing": 56, "Reaching": 37}[id_[10:-3]],)
    np.testing.assert_allclose(observation[1:10], world["joint_positions"], rtol=1e-6)
    np.testing.assert_allclose(observation[19:28], world["end_effector_positions"], rtol=1e-5)
    if "Pushing" in id_:
        np.testing.assert_allclose(observation[32:35], [0, -0.08, 0.0325], atol=1e-8)
        np.testing.assert_allclose(
            observation[45:56], [20, *[0.065] * 3, 0, 0.08, 0.0325, 0, 0, 0, 1], atol=1e-8
        )
    else:
        np.testing.assert_allclose(
            observation[28:37], [0, 0, 0.1, 0, 0, 0.13, 0, 0, 0.16], atol=1e-8
        )


GOLDEN_HEAD = [1.0, *[0.22179, 0.433501, -0.261799] * 3, *[0.0] * 9]
GOLDEN_TIPS = [
    -0.1189,
    0.317274,
    -0.776549,
    0.334217,
    -0.055666,
    -0.776549,
    -0.215317,
    -0.261608,
    -0.776549,
]
GOLDEN = {
    PUSHING: [
        *GOLDEN_HEAD,
        *GOLDEN_TIPS,
        *[1.0, 0.0, 0.0, 0.0, 0.0, -0.16, -0.87, 0.0, 0.0, 0.0, 0.1, *[0.0] * 6],
        *[20.0, 0.0, 0.0, 0.0, 0.0, 0.16, -0.87, 0.0, 0.0, 0.0, 0.1],
    ],
    REACHING: [*GOLDEN_HEAD, *GOLDEN_TIPS, 0.0, 0.0, -0.6, 0.0, 0.0, -0.48, 0.0, 0.0, -0.36],
}


@pytest.mark.parametrize("id_", [PUSHING, REACHING])
def test_conventions_reproduce_the_published_observation(id_: str) -> None:
    """Under the predecessor's conventions the observation at reset is the published one."""
    env = make(id_, backend="mujoco", conventions="causal_world")
    np.testing.assert_allclose(env.reset(seed=0)[0], GOLDEN[id_], atol=2e-6)


@pytest.mark.parametrize(("id_", "steps"), [(PUSHING, 250), (REACHING, 125)])
def test_episode_is_truncated_at_its_length(id_: str, steps: int) -> None:
    """An episode ends after exactly its length, by truncation and never by termination."""
    taken = roll(make(id_), steps)[1:]
    assert [t[3] for t in taken] == [False] * (steps - 1) + [True]
    assert not any(t[2] for t in taken)


def test_lengths_count_control_steps() -> None:
    """The frame skip shortens a control step, and the episode keeps its ten seconds."""
    assert make(frame_skip=3).unwrapped.world.max_episode_length == 833
    taken = roll(make(max_episode_length=4), 4)
    assert taken[-1][3]
    extra = roll(make(max_episode_length=4, conventions="causal_world"), 5)
    assert [t[3] for t in extra[1:]] == [False] * 4 + [True]


@pytest.mark.parametrize("backend", BACKENDS)
def test_same_seed_same_episode(backend: str) -> None:
    """Two environments with one seed and the same actions agree bit for bit."""
    one, two = (roll(make(backend=backend), 20, seed=5) for _ in range(2))
    for a, b in zip(one, two, strict=True):
        assert np.array_equal(a[0], b[0])
        assert a[1] == b[1]


def test_info_has_the_same_keys_everywhere() -> None:
    """Info has the same keys, shapes and types at reset and at every step."""
    shapes = [
        {key: (type(value), np.shape(value)) for key, value in step[4].items()}
        for step in roll(make(), 3)
    ]
    assert all(shape == shapes[0] for shape in shapes)
    assert set(shapes[0]) == {
        "is_success",
        "success",
        "fractional_success",
        "achieved_goal",
        "desired_goal",
        "reward_terms",
    }


@pytest.mark.parametrize("id_", [PUSHING, REACHING])
def test_reward_is_the_weighted_sum_of_its_terms(id_: str) -> None:
    """The reward is the weighted sum of the terms in info."""
    env = make(id_, backend="mujoco")
    weights = env.unwrapped.world.task.weights
    for _, reward, _, _, info in roll(env, 10)[1:]:
        total = sum(weights[name] * value for name, value in info["reward_terms"].items())
        assert reward == pytest.approx(total, abs=1e-9)


def test_the_predecessors_reward_is_scaled_by_the_period() -> None:
    """Under its conventions the reward is multiplied by the control period."""
    env = make(conventions="causal_world")
    _, reward, _, _, info = roll(env, 1)[1]
    weights = env.unwrapped.world.task.weights
    total = sum(weights[name] * value for name, value in info["reward_terms"].items())
    assert reward == pytest.approx(0.04 * total)


def test_success_is_noticed() -> None:
    """A block in its goal is a success, and the info says so."""
    env = make()
    env.reset(seed=0)
    world = env.unwrapped.world
    env.unwrapped.do(world.task.solution(world.values()))
    info = env.step(np.zeros(9, np.float32))[4]
    assert info["is_success"]
    assert info["fractional_success"] == pytest.approx(1.0)


def test_reset_takes_interventions() -> None:
    """An intervention in the reset's options holds for the episode and no longer."""
    env = make()
    env.reset(seed=0, options={"do": {"tool_block": {"mass": 0.04}}})
    env.step(env.action_space.sample())
    assert env.unwrapped.world["tool_block.mass"] == 0.04
    env.reset()
    assert env.unwrapped.world["tool_block.mass"] == 0.02


def test_observation_follows_an_intervention() -> None:
    """After an intervention the observation of the present shows it."""
    env = make(normalize_observations=False)
    before, _ = env.reset(seed=0)
    env.unwrapped.do({"block.size": [0.08, 0.08, 0.08]})
    changed = np.flatnonzero(env.unwrapped.observe() != before)
    assert changed.tolist() == [29, 30, 31, 34, 46, 47, 48, 51]


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"backend": "havok"}, UnknownOption),
        ({"preset": "slow"}, UnknownOption),
        ({"action_mode": "telepathy"}, UnknownOption),
        ({"conventions": "other"}, UnknownOption),
        ({"render_mode": "hologram"}, UnknownOption),
        ({"observation_mode": "radar"}, UnknownOption),
        ({"observation_mode": "custom"}, UnknownOption),
        ({"observe": ["gravity"]}, UnknownOption),
        ({"observation_mode": "custom", "observe": ["gravitas"]}, InterventionError),
        ({"observation_mode": "pixel", "keypoints": "view"}, UnknownOption),
        ({"observation_mode": "pixel", "cameras": ["61"]}, UnknownOption),
        ({"observation_mode": "pixel", "cameras": []}, UnknownOption),
        ({"observation_mode": "pixel", "image_size": 0}, UnknownOption),
        ({"cameras": ["60"]}, UnknownOption),
        ({"context": "visible"}, UnknownOption),
        ({"task": "reaching", "keypoints": "view"}, UnknownOption),
        ({"random_goal": "C"}, UnknownOption),
        ({"task_options": {"weights": "sparser"}}, UnknownOption),
        ({"frame_skip": 0}, UnknownOption),
        ({"max_episode_length": -3}, UnknownOption),
    ],
)
def test_unknown_options_are_refused(options: dict[str, Any], error: type[Exception]) -> None:
    """An option that does not exist is refused when the environment is made."""
    with pytest.raises(error):
        ScmWorldEnv(**{"backend": "fake", **options})


def test_bad_input_is_refused() -> None:
    """Wrong reset options, actions and interventions raise typed errors."""
    env = make().unwrapped
    env.reset(seed=0)
    with pytest.raises(UnknownOption, match="reset option"):
        env.reset(options={"d0": {}})
    refused = {"do": {"tool_block.mass": -1.0}}
    with pytest.raises(InterventionError):
        env.reset(options=refused)
    env.reset(seed=0)
    for action in (np.zeros(8), np.full(9, np.nan), np.full(9, np.inf)):
        with pytest.raises(ActionError):
            env.step(action)


def test_render_shows_the_scene() -> None:
    """A picture has the declared size, and is none without a render mode."""
    env = make(render_mode="rgb_array").unwrapped
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (480, 640, 3)
    assert picture.std() > 10
    plain = make().unwrapped
    plain.reset(seed=0)
    assert plain.render() is None


def test_control_period_is_the_same_in_both_presets() -> None:
    """Both presets take control steps of 40 ms: a free block falls the same time."""
    heights = []
    for preset in ("fast", "precise"):
        env = make(backend="mujoco", preset=preset).unwrapped
        env.reset(seed=0, options={"do": {"tool_block.cartesian_position": [0.0, 0.0, 0.2]}})
        for _ in range(3):
            env.step(np.zeros(9))
        heights.append(float(env.world["tool_block.cartesian_position"][2]))
    np.testing.assert_allclose(heights, 0.2 - 0.5 * 9.81 * 0.12**2, atol=4e-3)


def test_the_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    """The example tells which observations notice a mass and a color."""
    path = Path(__file__).parents[2] / "examples" / "environments.py"
    runpy.run_path(str(path))["main"]("fake")
    lines = capsys.readouterr().out.splitlines()
    seen = [(" mass seen: True" in f" {line}", "color seen: True" in line) for line in lines[:3]]
    assert seen == [(False, False), (True, True), (False, True)]
