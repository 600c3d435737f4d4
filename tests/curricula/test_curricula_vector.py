"""A curriculum for many environments at once."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import gymnasium
import numpy as np
import pytest
from curriculum_envs import PUSHING
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from scm_world.curricula import (
    CurriculumEnv,
    CurriculumState,
    at_step,
    during,
    follow,
    make_vec,
    resample,
    stages,
    together,
)
from scm_world.env import ScmWorldEnv
from scm_world.errors import UnknownOption

MODES = list(AutoresetMode)
KINDS = [*((mode, 1) for mode in MODES), (AutoresetMode.SAME_STEP, 2)]
FRICTION, MASS = "floor_friction", "tool_block.mass"
COUNTER = follow(lambda situation: {FRICTION: situation.episode / 100})
"""Shows the number of the episode in hundredths."""


def made(part: Any, mode: AutoresetMode, n: int = 3, workers: int = 1, length: int = 3) -> Any:
    """Make environments without physics whose episodes are short."""
    return make_vec(
        PUSHING,
        n,
        part,
        workers=workers,
        autoreset_mode=mode,
        backend="fake",
        max_episode_length=length,
        observation_mode="custom",
        observe=[FRICTION, MASS],
        normalize_observations=False,
        disable_env_checker=True,
    )


def numbers(observations: Any) -> list[int]:
    """Read the numbers of the episodes from what is observed."""
    return [round(100 * friction) for friction in observations[:, 0].tolist()]


def roll(envs: Any, steps: int, mode: AutoresetMode, seed: int | None = 0) -> list[list[int]]:
    """Give the numbers of the episodes after a reset and after each of some steps."""
    found = [numbers(envs.reset(seed=seed)[0])]
    actions = np.zeros((envs.num_envs, 9), np.float32)
    for _ in range(steps):
        observations, _, terminated, truncated, _ = envs.step(actions)
        ended = terminated | truncated
        if mode is AutoresetMode.DISABLED and ended.any():
            observations, _ = envs.reset(options={"reset_mask": ended})
        found.append(numbers(observations))
    return found


@pytest.mark.parametrize(("mode", "workers"), KINDS)
def test_every_number_is_played_once(mode: AutoresetMode, workers: int) -> None:
    """Member i of n plays the episodes i, i + n, i + 2 n, … of one series."""
    envs = made(COUNTER, mode, workers=workers)
    rows = roll(envs, 8, mode)
    envs.close()
    begun = [rows[0], *(b for a, b in pairwise(rows) if a != b)]
    assert begun == [[0, 1, 2], [3, 4, 5], [6, 7, 8]]


@pytest.mark.parametrize("mode", MODES)
def test_some_may_begin_anew_alone(mode: AutoresetMode) -> None:
    """A reset of some members changes no number of the others."""
    envs = made(COUNTER, mode)
    assert numbers(envs.reset(seed=0)[0]) == [0, 1, 2]
    some = np.array([False, True, False])
    envs.step(np.zeros((3, 9), np.float32))
    observations, _ = envs.reset(options={"reset_mask": some})
    begun = numbers(observations)[1]
    assert begun == 4
    seen: list[list[int]] = []
    for _ in range(12):
        observations, _, terminated, truncated, _ = envs.step(np.zeros((3, 9), np.float32))
        ended = terminated | truncated
        if mode is AutoresetMode.DISABLED and ended.any():
            observations, _ = envs.reset(options={"reset_mask": ended})
        seen.append(numbers(observations))
    for index, column in enumerate(zip(*seen, strict=True)):
        assert {number % 3 for number in column} == {index}
        assert {b - a for a, b in pairwise(column)} == {0, 3}


@pytest.mark.parametrize(("mode", "workers"), KINDS)
def test_each_goes_through_the_stages_by_its_own_successes(
    mode: AutoresetMode, workers: int
) -> None:
    """The next stage holds from the next episode of a member on."""
    solved = at_step(1, {"goal_block.cartesian_position": [0.0, 0.0, 0.0325]})
    solved = together(solved, at_step(1, {"tool_block.cartesian_position": [0.0, 0.0, 0.0325]}))
    part = together(stages({MASS: 0.02}, {MASS: 0.03}, up=1.0, window=1), during(range(3), solved))
    envs = made(part, mode, workers=workers)
    observations, _ = envs.reset(seed=0)
    masses = [sorted({round(mass, 3) for mass in observations[:, 1].tolist()})]
    for _ in range(12):
        observations, _, terminated, truncated, _ = envs.step(np.zeros((3, 9), np.float32))
        ended = terminated | truncated
        if mode is AutoresetMode.DISABLED and ended.any():
            observations, _ = envs.reset(options={"reset_mask": ended})
        masses.append(sorted({round(mass, 3) for mass in observations[:, 1].tolist()}))
    levels = [progress.level for one in envs.get_attr("state") for progress in one.stages.values()]
    envs.close()
    assert levels == [1, 1, 1]
    assert masses[0] == [0.02]
    assert [0.03] in masses[3:5]
    assert masses[-1] == [0.03]


def test_a_single_member_is_like_an_environment() -> None:
    """One member goes through the episodes of a wrapped environment, draw for draw."""
    part = together(COUNTER, resample(MASS), at_step(1, resample(MASS, "B")))
    envs = made(part, AutoresetMode.NEXT_STEP, n=1)
    (options,) = envs.get_attr("made_with")
    alone = CurriculumEnv(ScmWorldEnv(**options), part)
    found = [envs.reset(seed=4)[0][0]]
    action = np.zeros((1, 9), np.float32)
    found += [envs.step(action)[0][0] for _ in range(7)]
    expected = []
    for number in range(2):
        expected.append(alone.reset(seed=None if number else 4)[0])
        expected += [alone.step(action[0])[0] for _ in range(3)]
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("mode", MODES)
def test_a_state_goes_on(mode: AutoresetMode) -> None:
    """Episodes that were cut off begin again in another vector, with the same draws."""
    part = together(COUNTER, resample(MASS), stages({}, {}, window=2))
    envs, others = made(part, mode), made(part, mode)
    roll(envs, 4, mode)
    state = [one.model_dump(mode="json") for one in envs.get_attr("state")]
    others.set_attr("state", state)
    first = numbers(others.reset()[0])
    assert first == [3, 4, 5]
    assert [one.model_dump(mode="json") for one in others.get_attr("state")] == state
    assert [world.noise.seed for world in others.get_attr("world")] == [0, 1, 2]
    if mode is not AutoresetMode.DISABLED:
        for _ in range(3):
            observations, *_ = others.step(np.zeros((3, 9), np.float32))
        if mode is AutoresetMode.NEXT_STEP:
            observations, *_ = others.step(np.zeros((3, 9), np.float32))
        assert numbers(observations) == [6, 7, 8]


def test_wrong_vectors_are_refused() -> None:
    """Numbers that are none."""
    for options in ({"workers": 0}, {"num_envs": 0}):
        with pytest.raises(UnknownOption):
            make_vec(PUSHING, **{"num_envs": 1, "curriculum": {}, **options}, backend="fake")


def test_members_may_be_wrapped_further() -> None:
    """Wrappers around the members change no number."""

    def one() -> Any:
        options = {"backend": "fake", "max_episode_length": 2, "observation_mode": "custom"}
        options |= {"observe": [FRICTION, MASS], "normalize_observations": False}
        env = CurriculumEnv(gymnasium.make(PUSHING, **options), COUNTER)
        return gymnasium.wrappers.RecordEpisodeStatistics(env)

    envs = SyncVectorEnv([one, one])
    envs.set_attr("state", [CurriculumState(episode=index, every=2) for index in range(2)])
    rows = roll(envs, 6, AutoresetMode.NEXT_STEP)
    assert [rows[0], rows[3], rows[6]] == [[0, 1], [2, 3], [4, 5]]
