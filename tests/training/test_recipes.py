"""Recipes: values that say how an agent is trained."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import scm_world  # noqa: F401 # registers the environments
from scm_world.curricula import goals, physics, together
from scm_world.curricula.curriculum import as_curriculum
from scm_world.env import IDS
from scm_world.errors import ScmWorldError, UnknownOption, UnreadableFile
from scm_world.evaluation import protocols_of
from scm_world.tasks import TASKS
from scm_world.training.recipe import Recipe, recipe
from scm_world.training.settings import ALGORITHMS, Hindsight, Sac


@pytest.mark.parametrize(("task", "algo"), [(t, a) for t in TASKS for a in ALGORITHMS])
def test_there_is_a_recipe_for_every_task(task: str, algo: str) -> None:
    """It goes to JSON and back, and says what it is of."""
    made = recipe(task, algo)
    assert Recipe.from_dict(json.loads(made.to_json())) == made
    assert (made.task, made.algo, made.name) == (task, algo, "tuned")


@pytest.mark.parametrize("task", TASKS)
def test_environments_of_recipes_exist(task: str) -> None:
    """Their reward has the terms that they name."""
    options: Any = {**recipe(task).trained_in, "backend": "fake"}
    (name,) = (id_ for id_, of in IDS.items() if of == task)
    env: Any = gymnasium.make(name, **options)
    env.reset(seed=0)
    *_, info = env.step(np.full(9, 0.5, np.float32))
    given = options.get("task_options", {})
    assert set(given.get("terms", ())) <= set(info.get("reward_terms", ()))


def test_episodes_are_shorter_while_it_is_trained_only() -> None:
    """Evaluations and policy files do not know of it."""
    made = recipe("pushing", episode_length=50)
    assert made.trained_in["max_episode_length"] == 50
    assert "max_episode_length" not in made.options
    assert recipe("pushing", episode_length=None).trained_in == made.options


def test_changes_reach_every_field() -> None:
    """Fields, settings by their own name, and parts of fields with a dot."""
    made: Any = recipe(
        "pushing",
        n_steps=32,
        env={"frame_skip": 5},
        steps=20_000,
        **{"rate.initial": 1e-4, "network.hidden": [64]},
    )
    before: Any = recipe("pushing")
    assert made.settings == before.settings.model_copy(update={"n_steps": 32})
    assert made.env["frame_skip"] == 5
    assert made.env["action_mode"] == "delta_joint_positions"
    assert (made.rate.initial, made.network.hidden, made.steps) == (1e-4, (64,), 20_000)
    assert made.but(n_steps=16, steps=None).steps == 20_000


def test_hindsight_brings_goals_and_sparse_rewards() -> None:
    """And rewards of one step, which is all that goals decide."""
    made: Any = recipe("pushing", "sac", hindsight=True)
    assert made.hindsight == Hindsight()
    assert made.options["goal_env"]
    assert made.options["task_options"] == {"weights": "sparse"}
    assert made.settings.n_steps == 1
    assert isinstance(made.settings, Sac)
    part: Any = recipe("pushing", "sac", **{"hindsight.n_sampled_goal": 2})
    assert (part.hindsight.n_sampled_goal, part.settings.n_steps) == (2, 1)
    assert part.but(hindsight=False).hindsight is None


def test_hindsight_leaves_the_task_as_it_is() -> None:
    """Only what says what the reward is makes place for sparse rewards."""
    env = {"task_options": {"tool_block_mass": 0.5, "fractional_reward_weight": 2.0}}
    made = recipe("pushing", "sac", hindsight=True, env=env)
    assert made.options["task_options"] == {"tool_block_mass": 0.5, "weights": "sparse"}


def test_privileged_observations_have_every_parameter() -> None:
    """They are appended to what is observed."""
    assert recipe("pushing", observations="privileged").options["context"] == "observation"


def test_curricula_are_numbers_files_and_values(tmp_path: Path) -> None:
    """All of them become the same plain data."""
    own = together(goals("A"), physics("B"))
    path = tmp_path / "own.json"
    path.write_text(own.to_json())
    for given in (own, path, str(path), own.as_dict()):
        assert recipe("pushing", curriculum=given).curriculum == own.as_dict()
    assert recipe("pushing", curriculum=1) == recipe("pushing", curriculum="1")
    assert recipe("pushing", curriculum=0).curriculum == as_curriculum(None).as_dict()


def test_a_protocol_is_a_curriculum() -> None:
    """What varies in it varies in training; a recipe that is changed knows its name, too."""
    for protocol in protocols_of("pick_and_place"):
        wanted = protocol.curriculum().as_dict()
        assert recipe("pick_and_place", curriculum=protocol.name).curriculum == wanted
    assert recipe("pushing").but(curriculum="P10") == recipe("pushing", curriculum="P10")


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"task": "pulling"}, "pushing"),
    ({"algo": "pp"}, "ppo"),
    ({"algo": "sac", "network": {"log_std_end": -2.0}}, "log_std_end with sac"),
    ({"curriculum": 3}, "curriculum cannot be 3"),
    ({"curriculum": "none.json"}, "none.json"),
    ({"curriculum": 1.5}, "curriculum cannot be 1.5"),
    ({"curriculum": "P12"}, "curriculum cannot be 'P12'.*P10, P11"),
    ({"n_stepz": 3}, "n_steps"),
    ({"n_steps": 0}, "settings.n_steps|n_steps"),
    ({"n_steps": "many"}, "many"),
    ({"steps": 0}, "steps"),
    ({"steps": -5}, "steps"),
    ({"steps": "many"}, "steps"),
    ({"steps": 100, "worlds": 64, "n_steps": 64}, "at least 4,096"),
    ({"steps": float("nan")}, "steps"),
    ({"worlds": 0}, "worlds"),
    ({"hindsight": True}, "hindsight with PPO"),
    ({"algo": "sac", "hindsight": True, "n_steps": 3}, "n_steps with hindsight"),
    ({"algo": "sac", "scale_rewards": True}, "scale_rewards"),
    ({"algo": "td3", "rate": {"schedule": "adaptive"}}, "adaptive"),
    ({"rate": {"schedule": "cosine"}}, "schedule"),
    ({"observations": "all"}, "observations"),
    ({"env": {"backend": "bullet"}}, "backend"),
    ({"env": {"colour": "red"}}, "colour"),
    ({"env": {"observe": {1, 2}}}, "plain data"),
    ({"trials": {"protocols": ["P99"]}}, "P99"),
    ({"network": {"hidden": []}}, "hidden"),
    ({"network": {"log_std": float("nan")}}, "log_std of a recipe cannot be nan.*finite"),
    ({"rate": {"initial": float("inf")}}, "rate.initial of a recipe cannot be inf.*finite"),
    ({"rate": {"lowest": 0.1, "highest": 0.01}}, "lowest learning rate"),
    ({"rate": {"speed": 1}}, "rate.speed of a recipe .*this field is unknown"),
    ({"env": {"observation_mode": "pixel"}}, "observation_mode of a recipe"),
    ({"worlds": 1, "n_steps": 1}, "n_steps of PPO in 1 world"),
    ({"algo": "sac", "gradient_steps": 0}, "gradient_steps"),
    ({"algo": "sac", "ent_coef": "auto_0"}, "ent_coef"),
    ({"algo": "sac", "target_entropy": float("nan")}, "target_entropy"),
]


@pytest.mark.parametrize(("given", "said"), WRONG)
def test_what_is_wrong_is_said(given: dict[str, Any], said: str) -> None:
    """Unknown names, impossible numbers, and what does not go together."""
    with pytest.raises(ScmWorldError, match=said):
        recipe(**{"task": "pushing", **given})


def test_files_that_are_no_recipe(tmp_path: Path) -> None:
    """Missing, damaged, or of another kind; and one that is."""
    path = tmp_path / "recipe.json"
    for text in (None, "{", "[]", '{"format": "other"}', "[" * 100_000):
        if text is not None:
            path.write_text(text)
        with pytest.raises(UnreadableFile, match=r"recipe\.json"):
            Recipe.load(path)
    made = recipe("reaching", "td3")
    path.write_text(made.to_json())
    assert Recipe.load(path) == made
    with pytest.raises(UnknownOption, match="format"):
        Recipe.from_dict({})
