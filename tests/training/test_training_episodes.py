"""Episodes of many worlds: staggered, counted, and played again bit for bit."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from scm_world.curricula import every, make_vec, physics, resample, stages, together
from scm_world.errors import UnreadableFile
from scm_world.training.episodes import Episodes, ScaledRewards

PUSHING = "scm_world/Pushing-v0"
N, LENGTH = 4, 12
CURRICULUM = together(
    resample("tool_block.mass"),
    stages({}, physics("A"), up=0.5, window=2),
    every(5, {"floor_friction": "A"}),
)
"""With a part of every sort: at resets, by successes, and within episodes."""

START = {"goal_block.cartesian_position": [0.0, -0.08, 0.0325], "sensor_noise": 0.01}
"""Blocks begin where they should be, so that there are successes."""


def worlds(staggered: bool = True, backend: str = "fake", mode: str = "loop") -> Episodes:
    """Make some worlds."""
    envs = make_vec(
        PUSHING,
        N,
        CURRICULUM,
        vectorization_mode=mode,
        autoreset_mode=AutoresetMode.SAME_STEP,
        backend=backend,
        max_episode_length=LENGTH,
        start=START,
    )
    return Episodes(envs, LENGTH, staggered=staggered)


def actions(steps: int) -> NDArray[np.float32]:
    """Draw actions."""
    return np.random.default_rng(3).uniform(-1, 1, (steps, N, 9)).astype(np.float32)


def same(one: Any, other: Any) -> None:
    """Assert that two steps are equal, bit for bit."""
    for mine, yours in zip(one[:4], other[:4], strict=True):
        np.testing.assert_array_equal(mine, yours)


def test_first_episodes_are_cut_one_after_another() -> None:
    """World i of n begins anew after a share (i + 1) / n of the time; later ones are whole."""
    envs = worlds()
    envs.reset(seed=0)
    ends: list[list[int]] = [[] for _ in range(N)]
    for step, action in enumerate(actions(40), start=1):
        *_, truncated, infos = envs.step(action)
        for index in np.flatnonzero(truncated):
            ends[index].append(step)
            assert infos["_final_obs"][index]
            assert infos["final_obs"][index].shape == (56,)
    assert ends == [[3, 15, 27, 39], [6, 18, 30], [9, 21, 33], [12, 24, 36]]
    assert len(envs.ended) == 13 - 3  # those that were cut do not count
    envs.close()


def test_a_cut_episode_ends_as_any_other_one() -> None:
    """Its last observation and infos are those of the step; a new one with other noise begins."""
    envs, plain = worlds(), worlds(staggered=False)
    first, other = envs.reset(seed=0)[0], plain.reset(seed=0)[0]
    np.testing.assert_array_equal(first, other)
    for action in actions(3):
        cut, whole = envs.step(action), plain.step(action)
    assert cut[3].tolist() == [True, False, False, False]
    infos = cut[4]
    np.testing.assert_array_equal(infos["final_obs"][0], whole[0][0])
    assert infos["final_info"]["fractional_success"][0] == whole[4]["fractional_success"][0]
    np.testing.assert_array_equal(cut[0][1:], whole[0][1:])
    assert not np.array_equal(cut[0][0], whole[0][0])
    envs.close(), plain.close()


KINDS = [("fake", "loop"), ("bullet", "processes"), ("mujoco", "native")]


@pytest.mark.parametrize(("backend", "mode"), KINDS)
def test_episodes_are_played_again(backend: str, mode: str) -> None:
    """Other worlds go on from plain data as these do, whatever is due, in any process."""
    envs, others = worlds(backend=backend, mode=mode), worlds(backend=backend, mode=mode)
    envs.reset(seed=5)
    for action in actions(19):
        seen = envs.step(action)[0]
    arrays, running = envs.state()
    assert len(arrays["actions"]) == arrays["lengths"].max() < LENGTH
    np.testing.assert_array_equal(others.resume(arrays, json.loads(json.dumps(running))), seen)
    for action in actions(30):
        same(envs.step(action), others.step(action))
    assert envs.state()[1] == others.state()[1]
    if backend == "fake":
        assert [kept["level"] for kept in running["stages"].values()] == [1]
    envs.close(), others.close()


def test_what_was_not_taken_from_such_worlds_is_refused() -> None:
    """Another number of worlds, or no state at all."""
    envs = worlds()
    envs.reset(seed=0)
    arrays, running = envs.state()
    with pytest.raises(UnreadableFile, match="another shape"):
        envs.resume({**arrays, "lengths": np.zeros(3, np.int64)}, running)
    for wrong in ({}, {**running, "memories": []}, {**running, "turns": [1] * N}):
        with pytest.raises(UnreadableFile, match="running"):
            envs.resume(arrays, wrong)
    envs.close()


def test_rewards_are_divided_by_the_spread_of_returns() -> None:
    """The running variance is that of all returns so far, and the rewards go on from it."""
    envs, others = (ScaledRewards(worlds(), gamma=0.5) for _ in range(2))
    raw = worlds()
    for one in (envs, raw):
        one.reset(seed=0)
    returns, seen = np.zeros(N), [np.zeros(0)]
    for action in actions(20):
        *_, rewards, terminated, truncated, _ = (None, *raw.step(action)[1:])
        found = envs.step(action)[1]
        returns = 0.5 * returns + rewards
        seen.append(returns.copy())
        scale = np.sqrt(np.concatenate(seen).var())
        returns[terminated | truncated] = 0.0
    np.testing.assert_allclose(found, np.clip(rewards / scale, -10, 10), rtol=2e-3)
    others.reset(seed=0)
    others.resume(envs.state())
    np.testing.assert_array_equal(others.state()["moments"], envs.state()["moments"])
    with pytest.raises(UnreadableFile, match="another shape"):
        others.resume({"returns": np.zeros(1), "moments": np.zeros(3)})
    for one in (envs, others, raw):
        one.close()
