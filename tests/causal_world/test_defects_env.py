"""Defects of the predecessor that an environment does not have."""

from __future__ import annotations

import copy
import logging
import random
import re
import tomllib
from typing import Any

import numpy as np
import pytest
from given import BACKENDS, DOCUMENTS, ENGINES, ROOT, make
from typer.main import get_command

from scm_world.backends.renderer import camera_pixels
from scm_world.cli.app import app
from scm_world.env import ScmWorldEnv
from scm_world.tasks.trifinger import hardware

TIME = "time_left_for_task"
TIPS = "end_effector_positions"
USE = re.compile(r"(?:^|`|&& )(?:scm-world|python) ([a-z_/]+(?:\.py)?)([^`\n]*)", re.MULTILINE)


def time_at(env: Any, index: int) -> float:
    """Give what is observed of the time after some steps."""
    env.reset(seed=0)
    env.unwrapped.do({"control_index": index})
    return float(env.unwrapped.observe()[env.unwrapped.layout[TIME]][0])


@pytest.mark.parametrize("length", [None, 833, 50])
def test_d01_time_runs_from_one_to_minus_one(length: int | None) -> None:
    """Whether a length is given or not; only the predecessor's conventions mix its units."""
    env = make(frame_skip=3, max_episode_length=length)
    end = env.unwrapped.world.max_episode_length
    assert (time_at(env, 0), time_at(env, end)) == pytest.approx((1.0, -1.0), abs=1e-3)
    theirs = make(frame_skip=3, max_episode_length=length, conventions="causal_world")
    last = -1.0 if length is None else 1.0 - 2.0 * 0.012
    assert time_at(theirs, end) == pytest.approx(last, abs=1e-3)


def test_d04_the_command_is_normalized_once() -> None:
    """What is observed of an action is the action."""
    env = make(include=["action"])
    env.reset(seed=0)
    action = np.linspace(-0.9, 0.7, 9, dtype=np.float32)
    observation = env.step(action)[0]
    np.testing.assert_allclose(observation[env.unwrapped.layout["action"]], action, atol=1e-6)


@pytest.mark.parametrize("backend", ENGINES)
def test_d06_contacts_are_told_for_every_finger(backend: str) -> None:
    """Three tips that press on the floor are three contacts, each with a force of about 7 N."""
    env = make(backend=backend, action_mode=TIPS, normalize_actions=False)
    start = {"robot_height": 0.32, "tool_block.cartesian_position": [0.0, 0.0, 0.0325]}
    env.reset(seed=0, options={"do": start})
    target = env.unwrapped.world[TIPS] * np.tile([0.6, 0.6, 0.0], 3)
    for _ in range(25):
        env.step(target)
    touches = env.unwrapped.world.backend.contacts()
    forces = {frozenset(touch.bodies): float(touch.force) for touch in touches}
    for finger in hardware.FINGERS:
        force = forces[frozenset({"floor", f"robot_finger_{finger}_link_3"})]
        assert 5.0 < force < 9.0  # [N], from 0.36 N m at a leg that is bent
    env.close()


@pytest.mark.parametrize("backend", BACKENDS)
def test_d07_pictures_do_not_move_what_they_show(backend: str) -> None:
    """With pictures and a renderer a pose is set where it was asked for; arrays stay as given."""
    env = make(
        backend=backend, observation_mode="pixel", image_size=16, render_mode="rgb_array"
    ).unwrapped
    env.reset(seed=0)
    place = np.array([0.05, 0.02, 0.1])
    env.do({"tool_block.cartesian_position": place, "goal_block.cartesian_position": place + 0.05})
    env.render()
    np.testing.assert_array_equal(place, [0.05, 0.02, 0.1])
    np.testing.assert_allclose(env.world.backend.read().positions[0], place, atol=1e-12)
    np.testing.assert_array_equal(env.world.scene().state.positions[0], place)
    env.close()


def test_d08_nearer_is_better() -> None:
    """In reaching the reward of a goal falls with the distance, also in hindsight."""
    env = make("Reaching", goal_env=True, task_options={"dense_reward_weights": [0.0] * 4})
    goal = env.reset(seed=0)[0]["desired_goal"]
    errors = np.array([0.0, 0.012, 0.018, 0.025, 0.04])[:, None]
    rewards = env.unwrapped.compute_reward(goal + errors, goal, {})
    np.testing.assert_allclose(rewards, [1.0, 0.9, 0.6, 0.25, 0.0])


def test_d14_d15_nothing_has_to_be_given() -> None:
    """There are a default task, a default length and a default start."""
    env = ScmWorldEnv(backend="fake")
    assert env.world.max_episode_length == 250
    first, _ = env.reset(seed=0)
    nothing: tuple[Any, ...] = (None, {}, {"do": {}}, {"do": None})
    for options in nothing:
        np.testing.assert_array_equal(env.reset(seed=0, options=options)[0], first)


def test_d37_nothing_global_is_touched() -> None:
    """Random generators and loggers are as before, and draws do not depend on them."""
    seen = []
    for seed in (1, 2):
        np.random.seed(seed)  # noqa: NPY002 # this one must not matter
        random.seed(seed)
        log, numpy_state = logging.getLogger(), np.random.get_state
        before = (str(numpy_state()), random.getstate(), log.level, list(log.handlers))
        env = make(random_goal="A", start={"sensor_noise": 0.1, "tool_block.mass": "B"})
        seen.append([env.reset(seed=7)[0], env.step(np.zeros(9, np.float32))[0]])
        after = (str(numpy_state()), random.getstate(), log.level, list(log.handlers))
        assert after == before
    np.testing.assert_array_equal(seen[0], seen[1])


@pytest.mark.parametrize("cameras", [["60"], ["300", "120"], ["60", "120", "300"]])
def test_d40_goals_are_drawn_once(cameras: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """However many bodies a request has and cameras there are, and never by a step."""
    drawn: list[Any] = []

    def counted(*scene: Any, **options: Any) -> None:
        if options.get("goals"):
            drawn.append(scene)
        camera_pixels(*scene, **options)

    monkeypatch.setattr("scm_world.env.pictures.camera_pixels", counted)
    env = make("Stacking2", observation_mode="pixel", cameras=cameras, image_size=16)
    space = env.observation_space
    env.reset(seed=0)
    drawn.clear()
    env.unwrapped.do({"goal_tower.polar": [0.1, 2.0], "block.size": [0.06] * 3})
    for _ in range(3):
        assert env.step(np.zeros(9, np.float32))[0].shape == (2 * len(cameras), 3, 16, 16)
    assert len(drawn) == 1
    assert (space.low.min(), space.high.max()) == (0, 255)


def test_d42_what_is_given_is_left_alone() -> None:
    """Options, starts and requests are as the caller wrote them."""
    given: dict[str, Any] = {
        "start": {"tool_block": {"mass": "B"}, "floor_friction": 0.4},
        "task_options": {"weights": {"reward.orientation": 0.0}, "tool_block_mass": 0.03},
        "include": ["action"],
    }
    request: dict[str, Any] = {"do": {"goal_block": {"polar": [0.05, 1.0]}}}
    before = copy.deepcopy((given, request))
    env = make(**given)
    env.reset(seed=0, options=request)
    env.unwrapped.do(request["do"])
    env.step(np.zeros(9, np.float32))
    assert (given, request) == before
    env.close()
    make(**given).reset(seed=0)  # and can be given again


@pytest.mark.parametrize("index", [0, 2])
def test_d44_an_intervention_keeps_the_form_of_an_observation(index: int) -> None:
    """In the view for goals it is a dictionary before and after, at the start and later."""
    env = make(goal_env=True, context="privileged")
    env.reset(seed=0)
    for _ in range(index):
        env.step(np.zeros(9, np.float32))
    env.unwrapped.do({"goal_block.polar": "B"})
    for observation in (env.unwrapped.observe(), env.step(np.zeros(9, np.float32))[0]):
        assert env.observation_space.contains(observation)
        assert set(observation) == {"observation", "context", "achieved_goal", "desired_goal"}


def test_d47_little_is_required() -> None:
    """No TensorFlow, no old gym, and no tools that only build the documents."""
    lines = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    names = {re.match(r"[A-Za-z0-9_.-]+", line)[0].lower() for line in lines}  # type: ignore[index]
    assert names <= {
        *("numpy", "networkx", "pydantic", "gymnasium", "mujoco", "pybullet", "numba"),
        *("typer", "rich", "matplotlib", "threadpoolctl", "safetensors", "scipy"),
        *("pandas", "pyarrow", "pyyaml"),
    }


def test_d57_options_in_the_documents_exist() -> None:
    """Every option of a command that a document shows is one that the program has."""
    shown = [use for path in DOCUMENTS for use in USE.findall(path.read_text())]
    assert {"discover", "benchmarks/causal_world_actors.py"} <= {name for name, _ in shown}
    commands: Any = get_command(app)
    for name, rest in shown:
        options = set(re.findall(r"--[a-z-]+", rest)) - {"--help"}
        if name.endswith(".py"):
            text = (ROOT / name).read_text()
            assert not [option for option in options if f'"{option}"' not in text]
        else:
            command = commands.commands[name]
            command = getattr(command, "commands", {}).get("".join(rest.split()[:1]), command)
            assert options <= {flag for option in command.params for flag in option.opts}
