"""Curricula that decide which bodies there are."""

from __future__ import annotations

import numpy as np
import pytest
from curriculum_envs import ENGINES, STILL, TOWERS, series, under, value

from scm_world.curricula import (
    during,
    everything,
    follow,
    goals,
    physics,
    resample,
    together,
)
from scm_world.env import IDS
from scm_world.errors import InterventionError, OutOfBounds, UnknownVariable
from scm_world.variables import Hard, Integers

NUMBER, FEW = "number_of_blocks_in_tower", Integers(1, 2)
LATE = "tool_level_5_col_0_row_0"


@pytest.mark.parametrize("backend", ["fake", *ENGINES])
def test_names_of_bodies_that_are_drawn_can_be_used(backend: str) -> None:
    """A tower of six levels is asked for, with the mass of its sixth block."""
    env = under(
        together({f"{LATE}.color": [1.0, 0.0, 0.0]}, {NUMBER: [1, 1, 6]}), TOWERS, backend=backend
    )
    observation, info = env.reset(seed=0)
    assert value(env, f"{LATE}.color") == [1.0, 0.0, 0.0]
    assert env.observation_space.contains(observation)
    assert info["achieved_goal"].size == 6 * 10
    assert env.step(STILL)[0].shape == observation.shape


def test_patterns_mean_the_bodies_that_are_there_afterwards() -> None:
    """Numbers are drawn first; then a pattern fits as many blocks as were drawn."""
    env = under(together(resample("tool_*.color", "B"), resample(NUMBER, FEW)), TOWERS)
    counts = set()
    for number in range(4):
        env.reset(seed=0 if number == 0 else None)
        world = env.unwrapped.world
        counts.add(tuple(world[NUMBER]))
        blocks = world.composition.blocks
        assert len(blocks) == np.prod(world[NUMBER])
        assert all((world[f"{block}.color"] >= 0.5).all() for block in blocks)
    assert len(counts) > 1


def test_numbers_are_the_same_whatever_else_is_drawn() -> None:
    """Another part changes no number of blocks."""
    alone = series(under(resample(NUMBER, FEW), TOWERS), NUMBER, 3)
    more = together(physics(), resample(NUMBER, FEW), resample("tool_*.color"))
    assert series(under(more, TOWERS), NUMBER, 3) == alone


def test_what_is_refused_in_the_second_half_takes_the_first_back() -> None:
    """If the bodies cannot be as asked, they do not come either."""
    wrong = {NUMBER: Hard([1, 1, 2], at=1), "tool_level_1_col_0_row_0.mass": Hard(-1.0, at=1)}
    env = under(together({NUMBER: [1, 1, 6]}, follow(lambda _: wrong)), TOWERS)
    env.reset(seed=0)
    before = env.unwrapped.world.values()
    with pytest.raises(OutOfBounds):
        env.step(STILL)
    assert value(env, NUMBER) == [1, 1, 6]
    after = env.unwrapped.world.values()
    assert after.keys() == before.keys()
    assert [step for step, _ in env.unwrapped.interventions] == [0]
    assert env.step(STILL)[0].shape == env.observation_space.shape


def test_a_name_that_never_comes_is_refused_at_the_reset() -> None:
    """Where bodies come and go, a name is looked up when it is used."""
    env = under(together({NUMBER: [1, 1, 2]}, {f"{LATE}.color": [0.0, 0.0, 0.0]}), TOWERS)
    with pytest.raises(UnknownVariable, match=LATE):
        env.reset(seed=0)
    assert value(env, NUMBER) != [1, 1, 2]
    fixed = under({f"{LATE}.color": [0.0, 0.0, 0.0]}, TOWERS, start={NUMBER: [1, 1, 6]})
    fixed.reset(seed=0)
    assert value(fixed, f"{LATE}.color") == [0.0, 0.0, 0.0]
    with pytest.raises(UnknownVariable, match="tol_"):
        under({"tol_level.color": [0.0, 0.0, 0.0]}, TOWERS).reset(seed=0)


def test_the_caller_decides_how_many_bodies_there_are() -> None:
    """Numbers in the options count more, and the rest of the curriculum fits them."""
    env = under(together(resample(NUMBER, "B"), resample("tool_*.color", "B")), TOWERS)
    env.reset(seed=0, options={"do": {NUMBER: [1, 1, 3]}})
    assert value(env, NUMBER) == [1, 1, 3]
    assert min(value(env, "tool_level_2_col_0_row_0.color")) >= 0.5


def test_a_curriculum_may_build_higher_from_episode_to_episode() -> None:
    """Numbers of a function, and turns, work with the observations of each structure."""
    part = together(
        follow(lambda situation: {NUMBER: [1, 1, 1 + situation.episode]}),
        during(range(1, 9, 2), resample("goal_*.color")),
    )
    env = under(part, TOWERS)
    sizes = [env.reset()[0].size for _ in range(4)]
    assert sizes == sorted(set(sizes))


@pytest.mark.parametrize("id_", IDS)
def test_every_task_can_be_drawn_wholly(id_: str) -> None:
    """Goals and looks of every task are drawn at resets and within episodes; numbers, too."""
    env = under(together(goals("A|B"), everything(besides=["@poses", "@joints"])), id_)
    for seed in range(2):
        observation, _ = env.reset(seed=seed)
        assert env.observation_space.contains(observation)
        assert env.step(STILL)[0].shape == observation.shape


def test_an_impossible_number_is_refused() -> None:
    """And the environment stays usable."""
    with pytest.raises(InterventionError):
        under({NUMBER: [1, 1, 99]}, TOWERS).reset(seed=0)
    env = under(follow(lambda situation: {NUMBER: [1, 1, 99 if situation.episode else 2]}), TOWERS)
    env.reset(seed=0)
    with pytest.raises(OutOfBounds):
        env.reset()
    assert env.step(STILL)[0].size
