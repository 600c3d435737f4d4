"""Environments for tests."""

from __future__ import annotations

import importlib.util
from typing import Any

import gymnasium
import numpy as np

import scm_world  # noqa: F401 # registers the environments
from scm_world.env import IDS
from scm_world.tasks import TASKS

BACKENDS = ["fake", "mujoco"] + (["bullet"] if importlib.util.find_spec("pybullet") else [])
MADE = [name for name, task in IDS.items() if task in TASKS]
PUSHING, REACHING = "scm_world/Pushing-v0", "scm_world/Reaching-v0"
ABSOLUTE = ["joint_positions", "joint_torques", "end_effector_positions"]
RELATIVE = [f"delta_{mode}" for mode in ABSOLUTE]


def make(id_: str = PUSHING, **options: Any) -> Any:
    """Make an environment without Gymnasium's own checker."""
    options.setdefault("backend", "fake")
    return gymnasium.make(id_, disable_env_checker=True, **options)


def roll(env: Any, steps: int, seed: int = 0) -> list[tuple[Any, ...]]:
    """Take random actions and collect what comes back."""
    actions = np.random.default_rng(seed)
    first = env.reset(seed=seed)
    taken = [env.step(actions.uniform(-1, 1, 9).astype(np.float32)) for _ in range(steps)]
    return [(first[0], 0.0, False, False, first[1]), *taken]
