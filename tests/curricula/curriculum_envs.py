"""Environments and curricula for tests."""

from __future__ import annotations

import importlib.util
from typing import Any

import gymnasium
import numpy as np

import scm_world  # noqa: F401 # registers the environments
from scm_world.curricula import CurriculumEnv, follow

ENGINES = ["mujoco"] + (["bullet"] if importlib.util.find_spec("pybullet") else [])
STILL = np.zeros(9, np.float32)
PUSHING, TOWERS = "scm_world/Pushing-v0", "scm_world/Towers-v0"


def under(curriculum: Any, id_: str = PUSHING, **options: Any) -> Any:
    """Make an environment under a curriculum, on the engine without physics."""
    options.setdefault("backend", "fake")
    return CurriculumEnv(gymnasium.make(id_, disable_env_checker=True, **options), curriculum)


def turns(*of: Any) -> Any:
    """Do one part after another, from episode to episode."""
    return follow(lambda situation: of[situation.episode % len(of)].plan(situation))


def value(env: Any, name: str) -> Any:
    """Give the present value of a variable, as plain data."""
    return env.unwrapped.world[name].tolist()


def series(env: Any, name: str, episodes: int, seed: int = 0) -> list[Any]:
    """Give the value of a variable at the beginning of each of some episodes."""
    found = []
    for number in range(episodes):
        env.reset(seed=seed if number == 0 else None)
        found.append(value(env, name))
    return found


def along(env: Any, name: str, steps: int) -> list[Any]:
    """Give the value of a variable after each of some control steps."""
    found = []
    for _ in range(steps):
        env.step(STILL)
        found.append(value(env, name))
    return found


def follow_mass(situation: Any) -> dict[str, Any] | None:
    """Make the block heavier from episode to episode, and rest in every third."""
    if situation.episode % 3 == 2:
        return None
    return {"tool_block": {"mass": 0.02 + 0.01 * situation.episode}}
