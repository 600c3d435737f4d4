"""Many environments for tests, and what it means that two of them say the same."""

from __future__ import annotations

import functools
from typing import Any

import gymnasium
import numpy as np

import scm_world  # noqa: F401 # registers the environments

PUSHING, REACHING = "scm_world/Pushing-v0", "scm_world/Reaching-v0"
LENGTH = 5  # of episodes of those that are kept
SIZE = 4


KINDS: dict[str, dict[str, Any]] = {
    "native": {"backend": "mujoco", "threads": 2},
    "turns": {"backend": "fake"},
}
"""All kinds, each with the quickest backend that it can have."""


def make(kind: str = "turns", n: int = SIZE, id_: str = PUSHING, **options: Any) -> Any:
    """Make many environments of a kind."""
    return gymnasium.make_vec(id_, n, **{**KINDS[kind], **options})


def engine(kind: str) -> str:
    """Name the backend of a kind."""
    backend: str = KINDS[kind]["backend"]
    return backend


@functools.cache
def kept(kind: str, backend: str | None = None) -> Any:
    """Make some that are not closed, which tests share."""
    given = {"backend": backend or engine(kind), "render_mode": "rgb_array"}
    return make(kind, max_episode_length=LENGTH, **given)


def sync(
    n: int = SIZE, id_: str = PUSHING, *, autoreset_mode: Any = "NextStep", **options: Any
) -> Any:
    """Make as many of Gymnasium's own kind."""
    options.setdefault("backend", "fake")
    how = {"autoreset_mode": autoreset_mode}
    return gymnasium.make_vec(id_, n, vectorization_mode="sync", vector_kwargs=how, **options)


def actions(steps: int, n: int = SIZE, seed: int = 0) -> Any:
    """Draw actions, shape (steps, n, 9)."""
    return np.random.default_rng(seed).uniform(-1, 1, (steps, n, 9)).astype(np.float32)


def check_same(mine: Any, other: Any, where: str = "") -> None:
    """Assert that two things are of one type and equal, bit for bit, all the way down."""
    assert type(mine) is type(other), f"{where}: {type(mine)} is not {type(other)}"
    if isinstance(mine, dict):
        assert mine.keys() == other.keys(), where
        for name in mine:
            check_same(mine[name], other[name], f"{where}.{name}")
    elif isinstance(mine, tuple | list):
        assert len(mine) == len(other), where
        for i, (one, two) in enumerate(zip(mine, other, strict=True)):
            check_same(one, two, f"{where}[{i}]")
    elif isinstance(mine, np.ndarray) and mine.dtype == object:
        check_same(list(mine), list(other), where)
    elif isinstance(mine, np.ndarray):
        assert (mine.dtype, mine.shape) == (other.dtype, other.shape), where
        np.testing.assert_array_equal(mine, other, where)
    else:
        assert mine == other, where


def check_alike(mine: Any, other: Any, steps: int, seed: int = 0) -> None:
    """Assert that two batches say the same from here on."""
    for t, action in enumerate(actions(steps, mine.num_envs, seed)):
        check_same(mine.step(action), other.step(action), f"step {t}")
