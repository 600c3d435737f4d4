"""Facts about the recipes that were found to work."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import scm_world  # noqa: F401 # registers the environments
from scm_world.env import IDS
from scm_world.errors import UnknownOption
from scm_world.evaluation.policies.weights import load_policy
from scm_world.tasks import TASKS
from scm_world.training.recipe import Recipe, recipe
from scm_world.training.settings import ALGORITHMS


@pytest.mark.parametrize(("task", "algo"), [*itertools.product(TASKS, ALGORITHMS)])
def test_there_is_a_recipe_for_every_task(task: str, algo: str) -> None:
    """And it is plain data."""
    made = recipe(task, algo)
    assert Recipe.from_dict(made.as_dict()) == made


@pytest.mark.parametrize("task", ["reaching", "pushing"])
def test_its_reward_has_the_terms_it_names(task: str) -> None:
    """By name, since a recipe is plain data; each of them has a weight."""
    options: Any = {**recipe(task).trained_in, "backend": "fake"}
    (name,) = (id_ for id_, of in IDS.items() if of == task)
    env: Any = gymnasium.make(name, **options)
    env.reset(seed=0)
    *_, info = env.step(np.full(9, 0.5, np.float32))
    asked = options["task_options"]["terms"]
    assert set(asked) <= set(info["reward_terms"])
    assert all(options["task_options"]["weights"][name] for name in asked)


def test_episodes_are_shorter_while_it_is_trained_only() -> None:
    """Evaluations and policy files do not know of it."""
    made = recipe("pushing", episode_length=50)
    assert made.trained_in["max_episode_length"] == 50
    assert "max_episode_length" not in made.options
    assert recipe("pushing", episode_length=None).trained_in == made.options


def test_the_ceiling_of_the_noise_falls(tmp_path: Path) -> None:
    """At the end of a training no standard deviation is above what was asked for."""
    pytest.importorskip("stable_baselines3")
    from scm_world.training.loop import train

    small: dict[str, Any] = {"worlds": 2, "steps": 16, "n_steps": 4, "batch_size": 4}
    network = {"hidden": [8], "log_std_end": -3.0}
    made = recipe("pushing", **small, network=network, trials={"protocols": []})
    done = train(made, out=tmp_path / "run", backend="fake")
    found = load_policy(done.policy).log_std
    assert found is not None
    assert found.max() <= -3.0


def test_only_ppo_has_such_a_ceiling() -> None:
    """SAC learns its noise, and TD3 has none."""
    with pytest.raises(UnknownOption, match="log_std_end with sac"):
        recipe("pushing", "sac", network={"log_std_end": -2.0})
