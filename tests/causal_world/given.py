"""What the tests about the predecessor start from."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import gymnasium

import scm_world  # noqa: F401 # registers the environments
from scm_world.world import Simulation

ROOT = Path(__file__).parents[2]
DOCUMENTS = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
ENGINES = ["mujoco"] + (["bullet"] if importlib.util.find_spec("pybullet") else [])
BACKENDS = ["fake", *ENGINES]


def begin(task: Any = "pushing", backend: str = "fake", **options: Any) -> Any:
    """Give a world at the start of an episode."""
    world = Simulation(task, backend=backend, **options)
    world.reset(seed=0)
    return world


def make(task: str = "Pushing", **options: Any) -> Any:
    """Make an environment without Gymnasium's own checker."""
    options.setdefault("backend", "fake")
    return gymnasium.make(f"scm_world/{task}-v0", disable_env_checker=True, **options)
