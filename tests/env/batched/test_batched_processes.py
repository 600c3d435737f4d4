"""Environments in processes, which Gymnasium's ``AsyncVectorEnv`` runs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv
from many_envs import check_alike, check_same, make, sync

from scm_world.env import ScmWorldVectorEnv, vector_env
from scm_world.runs.processes import Worker, cores

SEVERAL: Any = AsyncVectorEnv if cores() > 1 else ScmWorldVectorEnv


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_processes_say_what_single_environments_say(mode: str) -> None:
    """Bit for bit, over the ends of episodes, after partial resets and interventions."""
    pytest.importorskip("pybullet")
    options: dict[str, Any] = {"backend": "bullet", "max_episode_length": 3}
    options["autoreset_mode"] = mode
    envs, single = make("turns", 3, workers=2, **options), sync(3, **options)
    for given in ({"do": {"floor_friction": 0.4}}, {"reset_mask": np.arange(3) == 1}):
        both = [one.reset(seed=1, options=dict(given)) for one in (envs, single)]
        check_same(*both, "reset")
        check_alike(envs, single, 4)
    for one in (envs, single):
        one.call("do", {"tool_block.mass": "B"})
    check_same(envs.call("present"), single.call("present"), "present")
    saved = envs.call("snapshot")
    check_alike(envs, single, 1)
    envs.call("restore", saved[0])  # all go on from the first one
    first, *others = envs.call("observe")
    for other in others:
        np.testing.assert_array_equal(first, other)
    envs.close()


@pytest.mark.parametrize(
    ("backend", "number", "workers", "kind"),
    [
        ("mujoco", 2, None, ScmWorldVectorEnv),
        ("fake", 2, None, ScmWorldVectorEnv),
        ("fake", 2, 2, AsyncVectorEnv),
        ("bullet", 2, None, SEVERAL),
        ("bullet", 2, 1, ScmWorldVectorEnv),
        ("bullet", 1, None, ScmWorldVectorEnv),
    ],
)
def test_the_fastest_kind_is_taken(
    backend: str, number: int, workers: int | None, kind: type
) -> None:
    """MuJoCo steps them itself; Bullet takes processes if there are several, and several cores."""
    pytest.importorskip("pybullet")
    envs = make("turns", number, backend=backend, workers=workers)
    assert type(envs) is kind
    envs.close()


def test_in_a_process_of_a_pool_no_process_is_started() -> None:
    """One that ends with its parent may have no children."""
    pytest.importorskip("pybullet")
    worker = Worker(_kind)
    assert worker.ask() == "ScmWorldVectorEnv"
    worker.close()


def _kind() -> str:
    return type(vector_env(2, task="pushing", backend="bullet")).__name__


def test_no_process_is_left_behind() -> None:
    """Neither after ``close`` nor without it; what was seen can be seen after the end."""
    envs = make("turns", 2, workers=2, copy=False)
    observations, _ = envs.reset(seed=0)
    seen = observations.copy()
    processes = envs.processes
    envs.close()
    np.testing.assert_array_equal(observations, seen)
    assert not any(process.is_alive() for process in processes)
    envs = make("turns", 2, workers=2)
    processes = envs.processes
    del envs
    for process in processes:
        process.join(5)
        assert not process.is_alive()
