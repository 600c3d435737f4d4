"""The four tasks that are compared with Gymnasium's are the same ones."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest

from scm_world.env import MODEL_ID

sys.path.insert(0, str(Path(__file__).parents[2]))  # the scripts are no part of the package

from benchmarks.models.gymnasium_tasks import PAIRS  # from there
from benchmarks.models.speed import RAW, compare


@pytest.mark.parametrize("name", PAIRS)
def test_both_do_the_same(name: str) -> None:
    """From one state, with the same actions: states, rewards, ends, and what is observed.

    Gymnasium's places of bodies are one physics step old, so rewards that look at them differ.
    """
    pair = PAIRS[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # half_cheetah.xml has a deprecated setting
        theirs: Any = gymnasium.make(pair.id, **pair.options).unwrapped
        ours: Any = gymnasium.make(MODEL_ID, model=pair.make(), **RAW).unwrapped
    ours.reset(seed=0)
    theirs.reset(seed=0)
    assert ours.observation_space.shape == theirs.observation_space.shape
    scene, data = ours.world.backend.realization, theirs.data
    data.qpos[:], data.qvel[:] = scene.data.qpos, scene.data.qvel
    mujoco.mj_forward(theirs.model, data)
    random = np.random.default_rng(0)
    late = {"reacher": 1e-4, "pusher": 0.02, "ant": 0.2}.get(name, 1e-9)
    for _ in range(10):
        action = random.uniform(theirs.action_space.low, theirs.action_space.high)
        seen, reward, *flags, _ = ours.step(action)
        expected = theirs.step(action)
        np.testing.assert_allclose(scene.data.qpos, data.qpos, rtol=0.0, atol=1e-10)
        assert reward == pytest.approx(expected[1], abs=late)
        assert flags == [*expected[2:4]]
        if name != "ant":  # its quaternion has another order
            np.testing.assert_allclose(seen, expected[0], atol=max(late, 1e-5))


@pytest.mark.slow
def test_the_benchmark_runs() -> None:
    """With all its numbers, of which none is zero."""
    found = compare(PAIRS["reacher"], steps=64, rounds=1)
    assert all(number > 0.0 for number in found.values())
    assert found.keys() >= {"single", "per core", "on the clock"}
