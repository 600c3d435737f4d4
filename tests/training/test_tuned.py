"""Facts about the recipes that were found to work."""

from __future__ import annotations

import itertools
from typing import Any

import gymnasium
import numpy as np
import pytest

import scm_world  # noqa: F401 # registers the environments
from scm_world.env import IDS
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
