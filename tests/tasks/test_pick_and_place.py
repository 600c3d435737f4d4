"""Facts about pick and place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from published import (
    OBSERVATIONS,
    Instant,
    angle_left,
    evaluate,
    instants,
    norm,
    speed_change,
    tips_from,
)

from scm_world.env import ScmWorldEnv
from scm_world.errors import Infeasible, InterventionError, OutOfBounds, UnknownOption
from scm_world.tasks import PickAndPlace
from scm_world.tasks.trifinger import hardware
from scm_world.variables import Draw
from scm_world.world import Simulation

BLOCK, GOAL = "tool_block.cartesian_position", "goal_block.cartesian_position"
TURN = "goal_block.orientation"


def crossing(**options: Any) -> Simulation:
    """Give a world without physics."""
    world = Simulation(PickAndPlace(**options), backend="fake")
    world.reset(seed=0)
    return world


def across(now: Instant, at: Instant) -> float:
    """Measure how far the block is from its goal, seen from above."""
    return norm(at[BLOCK][:2] - now[GOAL][:2])


def height(now: Instant, at: Instant) -> float:
    """Measure how far the block is from the height that it should have now."""
    same_side = np.sign(now[BLOCK][1]) == np.sign(now[GOAL][1])
    wanted = now["goal_block.size"][2] / 2.0 if same_side else 0.15
    return abs(at[BLOCK][2] - wanted)


FORMULAS: dict[str, Callable[[Instant, Instant], float]] = {
    "reward.tips_to_block": lambda now, was: tips_from(was) - tips_from(now),
    "reward.block_to_goal": lambda now, was: across(now, was) - across(now, now),
    "reward.block_to_height": lambda now, was: height(now, was) - height(now, now),
    "reward.orientation": lambda now, was: angle_left(was, now[TURN]) - angle_left(now, now[TURN]),
    "reward.smoothness": lambda now, was: -speed_change(now, was),
}


@pytest.mark.parametrize("term", FORMULAS)
def test_terms_follow_the_published_formulas(term: str) -> None:
    """Each term is what its formula says, for any instant and the one before."""
    model = crossing().model
    for seed in range(50):
        now, before = instants(model, term, seed)
        expected = FORMULAS[term](now, before)
        assert evaluate(model, term, now, before) == pytest.approx(expected, abs=1e-7)


def test_weights_are_the_published_ones() -> None:
    """The fraction counts in the published runs only."""
    assert list(PickAndPlace().weights.values()) == [750, 50, 250, 0, 0.005, 0]
    assert PickAndPlace(weights="paper").weights["fractional_success"] == 1.0


def test_the_observation_is_the_published_one() -> None:
    """Under the predecessor's conventions the observation at reset is the published one."""
    env = ScmWorldEnv(task="pick_and_place", backend="fake", conventions="causal_world")
    np.testing.assert_allclose(env.reset(seed=0)[0], OBSERVATIONS["pick_and_place"], atol=2e-6)


def test_the_wall_counts_for_the_predecessor_only() -> None:
    """Ten seconds for the block; the predecessor's episodes have ten more for the wall."""
    lengths = {
        name: Simulation("pick_and_place", backend="fake", conventions=name).max_episode_length
        for name in ("scm_world", "causal_world")
    }
    assert lengths == {"scm_world": 250, "causal_world": 500}


@pytest.mark.parametrize("height_of_wall", [0.02, 0.065, 0.1])
def test_the_wall_stands_on_the_floor(height_of_wall: float) -> None:
    """It neither hovers nor sinks when its height changes."""
    world = crossing()
    world.do({"obstacle.size": [0.5, 0.015, height_of_wall]})
    np.testing.assert_allclose(
        world["obstacle.cartesian_position"], [0.0, 0.0, height_of_wall / 2.0]
    )


def test_the_side_decides_where_both_are() -> None:
    """Exchanging the sides mirrors block and goal at the wall, in the middle of an episode too."""
    world = crossing(tool_block_position=(0.03, -0.09), goal_block_position=(0.02, 0.1))
    np.testing.assert_allclose(world[BLOCK], [0.03, -0.09, 0.0325])
    np.testing.assert_allclose(world[GOAL], [0.02, 0.1, 0.0325], atol=1e-12)
    world.step(world["joint_positions"])
    audit = world.do({"wall_side": 1})
    np.testing.assert_allclose(world[BLOCK], [0.03, 0.09, 0.0325])
    np.testing.assert_allclose(world[GOAL], [0.02, -0.1, 0.0325], atol=1e-12)
    assert {BLOCK, GOAL} <= set(audit.followed)


@pytest.mark.parametrize("space", ["A", "B"])
def test_the_wall_is_always_between_block_and_goal(space: Any) -> None:
    """Wherever block and goal are drawn from, and in whichever coordinates."""
    world, sides, drawn = crossing(joint_positions=hardware.RAISED), set(), 0
    for _ in range(30):
        goal = world.task.sample_goal(space)
        world.reset(do=goal)
        sides.add(int(world["wall_side"]))
        assert world[BLOCK][1] * world[GOAL][1] < 0.0
        for name in ("tool_block", "goal_block"):
            place = f"{name}.cylindrical_position"
            try:
                world.do({place: Draw(space)})
            except Infeasible:  # a corner of A touches the wall
                continue
            drawn += 1
            assert world.model[place].in_space(world[place], space, world.values())
        assert world[BLOCK][1] * world[GOAL][1] < 0.0
    assert sides == {0, 1}
    assert drawn > 50


def test_the_spaces_follow_the_side() -> None:
    """A goal on the side of the block is in no space; on the other side it is."""
    world = crossing()
    near, far = ([0.1, angle, 0.0325] for angle in (-np.pi / 2, np.pi / 2))
    with pytest.raises(OutOfBounds):
        world.do({"goal_block.cylindrical_position": near}, space="A")
    world.do({"goal_block.cylindrical_position": far}, space="A")
    world.reset(do={"wall_side": 1})
    world.do({"goal_block.cylindrical_position": near}, space="A")


def test_a_block_that_is_turned_keeps_its_lowest_point() -> None:
    """In the middle of an episode too, and wherever it was."""
    world = crossing()
    world.step(world["joint_positions"])
    world.do({BLOCK: [0.1, -0.1, 0.0925]})
    world.step(world["joint_positions"])
    world.do({"tool_block.euler_orientation": [np.pi / 4, 0.0, 0.0]})
    np.testing.assert_allclose(world[BLOCK], [0.1, -0.1, 0.06 + 0.0325 * np.sqrt(2.0)])
    world.step(world["joint_positions"])
    world.do({"block.size": [0.07, 0.07, 0.07]})
    np.testing.assert_allclose(world[BLOCK], [0.1, -0.1, 0.06 + 0.035 * np.sqrt(2.0)])


def test_there_are_two_sides() -> None:
    """A third side is refused, and nothing has changed."""
    world = crossing()
    before = world[BLOCK]
    with pytest.raises(InterventionError):
        world.do({"wall_side": 2})
    np.testing.assert_array_equal(world[BLOCK], before)


def test_a_goal_in_the_air_is_refused() -> None:
    """The height of the goal follows from its size: no other one can be asked for."""
    assert PickAndPlace(goal_block_position=(0.0, 0.1, 0.0325)).name == "pick_and_place"
    with pytest.raises(UnknownOption, match="on the floor"):
        PickAndPlace(goal_block_position=(0.0, 0.1, 0.1))
