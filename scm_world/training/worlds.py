"""The worlds of a recipe, whatever library learns in them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode

from scm_world._arguments import load, one_of
from scm_world._types import Floats
from scm_world.curricula import make_vec
from scm_world.curricula.curriculum import as_curriculum
from scm_world.env import IDS
from scm_world.errors import UnknownOption
from scm_world.training.recipe import Recipe

SUCCESS = "is_success"

SEEDS = 1_000_003
"""Between the noises of two seeds, which have one for each world; evaluations have those below."""

SCALES: Mapping[str, float] = {
    "cartesian_position": 10.0,  # one for 0.1 m, the radius of where blocks and goals are
    "end_effector_positions": 10.0,
    "joint_positions": 2.0,
    "joint_velocities": 10.0,  # one for 5 rad/s
    "linear_velocity": 20.0,  # one for 0.5 m/s
    "angular_velocity": 10.0,  # one for 10 rad/s
    "orientation": 2.0,
}
"""Factor of a normalized number, by its quantity, so that it varies by about one."""


def level_seed(seed: int) -> int:
    """Return the seed of the noise of the levels of a training."""
    return (seed + 1) * SEEDS


def make_envs(recipe: Recipe, *, backend: str, threads: int | None = None, seed: int = 0) -> Any:
    """Make the environments of a recipe, in which the next episode begins in the same step.

    A backend that steps many worlds in one call has ``threads``, another one as many processes.
    The seed is that of the training: it decides its levels, if there are some.

    Raises:
        UnknownOption: Actions are choices, which policies of files do not have.
    """
    several = "workers" if backend == "bullet" else "threads"
    ids = {task: name for name, task in IDS.items()}
    envs: Any = make_vec(
        ids.get(recipe.task, ids["general"]),  # the task decides, not the id
        recipe.worlds,
        as_curriculum(recipe.curriculum),
        autoreset_mode=AutoresetMode.SAME_STEP,
        levels=recipe.levels,
        level_seed=level_seed(seed),
        backend=backend,
        task=recipe.task,
        **{several: threads},
        **{"on_failure": "truncate", **recipe.trained_in},
    )
    if not isinstance(envs.single_action_space, Box):
        envs.close()
        allowed = ("a Box of numbers: of choices, learn with make_sb3 and the library itself",)
        raise UnknownOption("actions of a policy", envs.single_action_space, allowed)
    return envs


def scales(layout: Mapping[str, Any], space: Any, env: Mapping[str, Any]) -> Floats:
    """Return the scale of each number of an observation, in the order that networks get.

    Args:
        layout: Where each variable is in the vector.
        space: Space of the observations of one environment.
        env: Options of the environment.

    Raises:
        UnknownOption: Observations are not normalized.
    """
    if env.get("normalize_observations") is False:
        raise UnknownOption("normalize_observations with network.scaled", False, ("True",))
    found = []
    for key, part in getattr(space, "spaces", {"observation": space}).items():
        scale = np.ones(int(np.prod(part.shape)))
        for name, where in layout.items() if key == "observation" else ():
            scale[where] = SCALES.get(name.partition("@")[0].rpartition(".")[2], 1.0)
        found.append(scale)
    return np.concatenate(found)


def actor_columns(recipe: Recipe, layout: Mapping[str, Any], appended: Any) -> Any:
    """Return the numbers of a vector that an actor observes: not what the critic alone does.

    Args:
        recipe: How it is trained.
        layout: Where each variable is in the vector.
        appended: The names of the parameters among them that were added for the critic.

    Returns:
        Shape (n,); ``slice(None)`` where it observes the same as the critic.
    """
    if recipe.observations != "critic":
        return slice(None)
    hidden = {*appended}
    there = [at for name, at in layout.items() if name.partition("@")[0] not in hidden]
    return np.concatenate([np.arange(at.start, at.stop) for at in there])


def device_for(recipe: Recipe, device: str) -> str:
    """Choose where networks are computed; those of PPO are too small to gain from a GPU."""
    one_of("device", device, ("auto", "cpu", "cuda"))
    small = "ppo", "recurrent_ppo"
    has_gpu = device != "cpu" and load("torch", "torch", "train").cuda.is_available()
    if device == "cuda" and not has_gpu:
        raise UnknownOption("device", device, ("cpu: torch finds no GPU here",))
    return "cuda" if has_gpu and (device == "cuda" or recipe.algo not in small) else "cpu"
