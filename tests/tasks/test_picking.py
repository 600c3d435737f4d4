"""Facts about picking."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from published import (
    OBSERVATIONS,
    Instant,
    evaluate,
    instants,
    norm,
    speed_change,
    tips_from,
)

from scm_world.env import ScmWorldEnv
from scm_world.errors import UnknownOption
from scm_world.tasks import Picking
from scm_world.variables import Draw
from scm_world.world import Simulation

BLOCK, GOAL, SIZE = (
    "tool_block.cartesian_position",
    "goal_block.cartesian_position",
    "tool_block.size",
)


def picking(convention: str = "scm_world", **options: Any) -> Simulation:
    """Give a world without physics."""
    world = Simulation(Picking(**options), backend="fake", conventions=convention)
    world.reset(seed=0)
    return world


def height(now: Instant, at: Instant) -> float:
    """Measure how far the block is from the height of the goal."""
    return abs(at[BLOCK][2] - now[GOAL][2])


def grasp(now: Instant) -> float:
    """Add up the two smallest mean distances of tips, inside the block's size zero."""
    gaps = np.abs(now["end_effector_positions"].reshape(3, 3) - now[BLOCK])
    gaps[gaps < now[SIZE]] = 0.0
    return float(np.sort(gaps.mean(axis=1))[:2].sum())


FORMULAS: dict[str, Callable[[Instant, Instant], float]] = {
    "reward.block_to_height": lambda now, was: height(now, was) - height(now, now),
    "reward.height_error": lambda now, was: -height(now, now),
    "reward.block_to_center": lambda now, was: norm(was[BLOCK][:2]) - norm(now[BLOCK][:2]),
    "reward.center_distance": lambda now, was: -norm(now[BLOCK][:2]),
    "reward.tips_to_block": lambda now, was: tips_from(was) - tips_from(now),
    "reward.tips_distance": lambda now, was: -tips_from(now),
    "reward.grasp": lambda now, was: -grasp(now),
    "reward.smoothness": lambda now, was: -speed_change(now, was),
}


@pytest.mark.parametrize("term", FORMULAS)
def test_terms_follow_the_published_formulas(term: str) -> None:
    """Each term is what its formula says, for any instant and the one before."""
    model = picking().model
    for seed in range(50):
        now, before = instants(model, term, seed)
        expected = FORMULAS[term](now, before)
        assert evaluate(model, term, now, before) == pytest.approx(expected, abs=1e-12)


def test_weights_are_the_published_ones() -> None:
    """The dense weights stand in the published order."""
    assert list(Picking.default_weights) == [*FORMULAS, "fractional_success"]
    assert list(Picking().weights.values()) == [250, 0, 125, 0, 750, 0, 0, 0.005, 1]


def test_the_observation_is_the_published_one() -> None:
    """Under the predecessor's conventions the observation at reset is the published one."""
    env = ScmWorldEnv(task="picking", backend="fake", conventions="causal_world")
    np.testing.assert_allclose(env.reset(seed=0)[0], OBSERVATIONS["picking"], atol=2e-6)
    assert env.world.max_episode_length == 250


@pytest.mark.parametrize(("space", "low", "high"), [("A", 0.08, 0.2), ("B", 0.2, 0.25)])
def test_goals_are_drawn_above_the_middle(space: Any, low: float, high: float) -> None:
    """A new goal has another height only, and in every coordinate it lies in the space."""
    world, heights = picking(), []
    for _ in range(20):
        world.reset(do=world.task.sample_goal(space))
        x, y, z = world[GOAL]
        assert (x, y) == (0.0, 0.0)
        variable = world.model["goal_block.cylindrical_position"]
        assert variable.in_space(world[variable.name], space, world.values())
        heights.append(z)
    assert low <= min(heights) < max(heights) <= high


@pytest.mark.parametrize("act", [Draw("A"), Draw("B"), [0.1, 1.0, 0.15]])
def test_the_predecessor_puts_goals_above_the_center(act: Any) -> None:
    """Under its conventions the height of a cylindrical position counts, drawn or set."""
    world = picking("causal_world")
    audit = world.do({"goal_block.cylindrical_position": act})
    x, y, z = world[GOAL]
    assert (x, y) == (0.0, 0.0)
    assert 0.08 <= z <= 0.25
    assert audit
    world.do({GOAL: [0.1, 0.05, 0.15]})
    np.testing.assert_array_equal(world[GOAL], [0.1, 0.05, 0.15])


@pytest.mark.parametrize("space", ["A", "B"])
def test_the_predecessors_goals_are_drawn_from_its_spaces(space: Any) -> None:
    """A space holds what was drawn from it, before the radius and the angle are left out."""
    world = picking("causal_world")
    world.do({"goal_block.cylindrical_position": Draw(space)}, space=space)
    np.testing.assert_array_equal(world[GOAL][:2], 0.0)


def test_a_larger_block_does_not_move_its_goal() -> None:
    """Block and goal share their size, and only the block stands on the floor."""
    world = picking()
    world.do({"block.size": [0.07, 0.07, 0.08]})
    np.testing.assert_array_equal(world["goal_block.size"], world[SIZE])
    np.testing.assert_allclose(world[BLOCK], [0.0, 0.0, 0.04])
    np.testing.assert_allclose(world[GOAL], [0.0, 0.0, 0.15])


def test_blocks_begin_on_the_floor_or_as_published_in_the_air() -> None:
    """In ours both spaces lie at half the height of the block; the predecessor's reach up."""
    for convention, tops in (("scm_world", (0.0325, 0.0325)), ("causal_world", (0.15, 0.3))):
        world = picking(convention)
        variable = world.model["tool_block.cylindrical_position"]
        for space, top in zip((variable.a, variable.b), tops, strict=True):
            low, high = space.bounds((3,), world.values())
            assert (low[2], high[2]) == pytest.approx((0.0325, top))


def test_the_start_can_be_chosen() -> None:
    """Place and orientation of the block are options; the goal is above that place."""
    turn = (0.0, np.sin(0.3), 0.0, np.cos(0.3))
    world = picking(
        tool_block_position=(0.05, -0.02), tool_block_orientation=turn, goal_height=0.12
    )
    lowest = 0.0325 * (np.sin(0.6) + np.cos(0.6))  # of a cube that is tilted by 0.6 rad
    np.testing.assert_allclose(world[BLOCK], [0.05, -0.02, lowest])
    np.testing.assert_allclose(world["tool_block.orientation"], turn)
    np.testing.assert_allclose(world[GOAL], [0.05, -0.02, 0.12])
    world.do({"goal_block.cylindrical_position": Draw("A")})
    np.testing.assert_allclose(world[GOAL][:2], [0.05, -0.02])
    np.testing.assert_allclose(picking(tool_block_position=(0.0, 0.0, 0.1))[BLOCK][2], 0.1)


@pytest.mark.parametrize(
    "options",
    [
        {"goal_height": 0.9},
        {"tool_block_mass": -1.0},
        {"tool_block_position": (0.0, 0.0, 0.01)},
        {"tool_block_position": (0.0,)},
        {"tool_block_position": (0.0, np.nan)},
        {"tool_block_orientation": (0.0, 0.0, 0.0, 0.0)},
    ],
)
def test_impossible_starts_are_refused(options: dict[str, Any]) -> None:
    """What is impossible is refused when the task is made, by the name of the option."""
    with pytest.raises(UnknownOption, match=next(iter(options))):
        Picking(**options)
