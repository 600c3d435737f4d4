"""What a hostile reader of curricula found, and how it is now."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import DelayObservation, MaxAndSkipObservation

import scm_world  # noqa: F401 # registers the environments
from scm_world.curricula import CurriculumEnv, at_step, resample, timed
from scm_world.errors import UnknownOption, UnknownVariable
from scm_world.variables import Box, Subset

MASS = "tool_block.mass"
STILL = np.zeros(9, np.float32)


def pushing(**options: Any) -> Any:
    """Make an environment without physics."""
    return gymnasium.make("scm_world/Pushing-v0", backend="fake", **options)


def mass(env: Any) -> float:
    """Give the present mass."""
    return float(env.unwrapped.world[MASS])


@pytest.mark.parametrize("name", ["General", "Towers", "StackedBlocks"])
def test_published_numbers_of_bodies_are_those_there_are(name: str) -> None:
    """What is drawn from A|B under the predecessor's conventions decides the bodies itself."""
    options = {"backend": "fake", "conventions": "causal_world"}
    env: Any = gymnasium.make(f"scm_world/{name}-v0", **options)
    what = {"General": "nums_objects", "Towers": "number_of_blocks_in_tower"}.get(name)
    what = what or "stack_levels"
    for seed in range(3):
        env.reset(seed=seed, options={"do": {what: "A|B"}})
        world = env.unwrapped.world
        count = len(world.composition.blocks)
        number = world[what]
        if name == "StackedBlocks":
            levels = {block.split("_")[2] for block in world.composition.blocks}
            assert len(levels) == int(number)
        else:
            assert count == int(np.prod(number))


def test_what_the_caller_does_holds_for_the_whole_episode() -> None:
    """Also against parts that act later."""
    env = CurriculumEnv(pushing(), timed({"every": 2}, resample(MASS)))
    env.reset(seed=0, options={"do": {MASS: 0.09}})
    for _ in range(5):
        env.step(STILL)
    assert mass(env) == 0.09
    env.reset()
    assert mass(env) != 0.09


def test_the_number_of_an_episode_is_that_of_the_curriculum() -> None:
    """However one gets there."""
    env = CurriculumEnv(
        pushing(), lambda situation: {MASS: (0.03, 0.04, 0.05)[situation.episode % 3]}
    )
    for _ in range(2):
        env.reset(seed=0, options={"episode": 2})
        assert mass(env) == 0.05
    env.reset()
    assert mass(env) == 0.03


def test_what_was_due_while_steps_were_skipped_is_done() -> None:
    """After the last of them."""
    env = CurriculumEnv(MaxAndSkipObservation(pushing(), skip=4), at_step(6, {MASS: 0.09}))
    env.reset(seed=0)
    masses = [mass(env) for _ in range(3) if env.step(STILL)]
    assert masses == [0.02, 0.09, 0.09]


def test_wrappers_that_count_may_be_inside() -> None:
    """Nothing is looked at twice: the observation of an instant is one observation."""
    part = at_step(1, {MASS: 0.09})
    inside = CurriculumEnv(DelayObservation(pushing(), delay=2), part)
    outside = DelayObservation(CurriculumEnv(pushing(), part), delay=2)
    for env in (inside, outside):
        env.reset(seed=0)
    for _ in range(5):
        np.testing.assert_array_equal(inside.step(STILL)[0], outside.step(STILL)[0])


def test_a_plain_draw_of_a_curriculum_has_a_noise_of_its_own() -> None:
    """It is not the one of the environment's own start."""
    start, curriculum = pushing(start={MASS: "A"}), CurriculumEnv(pushing(), {MASS: "A"})
    start.reset(seed=3)
    curriculum.reset(seed=3)
    assert mass(start) != mass(curriculum)


def test_boxes_without_ends_are_refused() -> None:
    """One cannot draw from them, nor write them down."""
    with pytest.raises(UnknownOption, match="finite ends"):
        Subset({MASS: Box(0.01, float("inf"))})
    with pytest.raises(UnknownOption, match="finite ends"):
        resample(MASS, Box(float("-inf"), float("inf")))


def test_an_environment_is_not_made_with_a_subset_of_nothing() -> None:
    """A pattern that names no variable is an error."""
    with pytest.raises(UnknownVariable, match=r"tool_block\.mass"):
        pushing(variables_space={"tool_blok.mass": "A"})
