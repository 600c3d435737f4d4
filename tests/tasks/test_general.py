"""Facts about piles of dropped blocks."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from scm_world._types import Floats
from scm_world.tasks import General
from scm_world.tasks.trifinger.entities.block_world import overlaps
from scm_world.tasks.trifinger.general import MOST, pile
from scm_world.variables import Draw
from scm_world.world import Simulation

ABSENT = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
GRAVITY = np.array([0.0, 0.0, -9.81])


def general(backend: str = "fake", **options: Any) -> Simulation:
    """Give a world at the start of an episode."""
    world = Simulation(General(**options), backend=backend)
    world.reset(seed=0)
    return world


def dropped(places: Any, gravity: Floats = GRAVITY) -> Floats:
    """Drop blocks of five centimeters, shape (n, 7)."""
    positions = np.zeros((MOST, 3))
    positions[: len(places)] = places
    turns, friction = np.zeros((MOST, 3)), (np.array(1.0),) * len(places)
    numbers = (np.array(x) for x in (len(places), 0.05, 0.08))
    return pile(*numbers, positions, turns, gravity, np.array(0.5), *friction)[: len(places)]


def test_goals_are_where_blocks_came_to_lie() -> None:
    """A block that falls flat on the free floor lies below where it was let go."""
    world = general()
    assert world.task.tools == tuple(f"tool_{index}" for index in range(5))
    lone = world["goal_4.cartesian_position"]
    np.testing.assert_allclose(lone, [-0.12, -0.12, 0.025], atol=1e-3)
    assert all(0.02 < world[f"goal_{i}.cartesian_position"][2] < 0.1 for i in range(5))
    np.testing.assert_array_equal(world["pile"][5:], np.tile(ABSENT, (4, 1)))
    assert world.max_episode_length == 1250


def test_blocks_pile_up() -> None:
    """One dropped on another lies on it; one dropped into another, or the floor, does as well."""
    for second in (0.2, 0.025, 0.0):
        found = dropped([(0.0, 0.0, 0.0), (0.0, 0.0, second)])
        np.testing.assert_allclose(found[:, 2], [0.025, 0.075], atol=1e-3)
        np.testing.assert_allclose(found[:, :2], 0.0, atol=1e-3)


@pytest.mark.parametrize("gravity", [(0.0, 0.0, 30.0), (20.0, 0.0, 0.0), (0.0, 0.0, 0.0)])
def test_blocks_that_leave_have_a_place_still(gravity: tuple[float, float, float]) -> None:
    """Wherever gravity points, goals are finite and within bounds."""
    found = dropped([(0.1, 0.1, 0.2), (-0.1, 0.0, 0.2)], np.array(gravity))
    assert np.isfinite(found).all()
    assert (np.abs(found[:, :2]) <= 0.24).all()
    assert (found[:, 2] >= 0.0).all()
    assert (found[:, 2] <= 0.5).all()
    np.testing.assert_allclose(np.linalg.norm(found[:, 3:], axis=1), 1.0)


def test_piles_are_simulated_in_batches() -> None:
    """Leading axes are kept, and each pile is the same as alone."""
    gravity = np.array([[0.0, 0.0, -9.81], [0.0, 0.0, -5.0]])
    found = dropped([(0.0, 0.0, 0.2)] * 2, gravity[0])
    places, turns = np.zeros((2, MOST, 3)), np.zeros((MOST, 3))
    places[:, :2] = (0.0, 0.0, 0.2)
    numbers = (np.array(x) for x in (2, 0.05, 0.08))
    both = pile(*numbers, places, turns, gravity, np.array(0.5), np.array(1.0), np.array(1.0))
    assert both.shape == (2, MOST, 7)
    np.testing.assert_array_equal(both[0, :2], found)


def test_one_seed_gives_one_goal_on_every_engine() -> None:
    """The pile is simulated on one engine, whatever moves the world."""
    goals = []
    for backend in ("fake", "mujoco"):
        world = general(backend)
        world.reset(seed=3, do=world.task.sample_goal("A"))
        goals.append(world["pile"])
    np.testing.assert_array_equal(*goals)


def test_the_pile_has_the_causes_that_falling_has() -> None:
    """Gravity and friction are ancestors of the goal; the robot is not."""
    world = general()
    ancestors = world.model.ancestors("goal_0.cartesian_position")
    assert {"gravity", "floor_friction", "tool_3.friction", "blocks_mass", "drop_positions"} <= (
        ancestors
    )
    assert ancestors.isdisjoint({"finger_friction", "robot_height", "tool_0.mass"})
    before = world["pile"]
    world.do({"finger_friction": 0.7, "robot_height": 0.36})
    np.testing.assert_array_equal(world["pile"], before)
    world.do({"gravity": [0.0, 0.0, -4.0]})
    assert not np.array_equal(world["pile"], before)


def test_all_blocks_are_observed_before_all_goals() -> None:
    """17 numbers for each block, then 11 for each goal."""
    world = general()
    observed = [part.variable for part in world.task.observed()]
    assert 28 + sum(world[name].size for name in observed) == 168
    entities = list(dict.fromkeys(name.partition(".")[0] for name in observed))
    assert entities == [*world.task.tools, *world.task.targets]


@pytest.mark.parametrize("size", [0.02, 0.05, 0.07, 0.1])
def test_no_two_blocks_begin_in_one_place(size: float) -> None:
    """Nine blocks, however large, keep clear of each other, of the ring and of the fingers."""
    world = general(nums_objects=9, tool_block_size=size)
    assert overlaps(world.scene(), tolerance=1e-6) == ()
    bottoms = [world[f"tool_{i}.cartesian_position"][2] - size / 2.0 for i in range(9)]
    np.testing.assert_allclose(bottoms, 0.0, atol=1e-12)


@pytest.mark.parametrize("space", ["A", "B"])
def test_new_goals_are_drawn(space: Any) -> None:
    """Other drops are another pile, of as many blocks as were drawn, and it can be reached."""
    world = general()
    piles = []
    for seed in range(3):
        world.reset(seed=seed, do=world.task.sample_goal(space))
        piles.append(world["pile"])
        for name in world.task.goal_causes:
            assert world.model.declared(name).in_space(world[name], space, world.values())
        assert len(world.task.tools) == world["nums_objects"]
        world.do(world.task.solution(world.values()))
        assert world["success"] == 1
    assert not np.array_equal(piles[0], piles[1])


@pytest.mark.parametrize("backend", ["fake", "mujoco"])
def test_blocks_come_and_go(backend: str) -> None:
    """In mid-episode those that stay stay where they are, and new ones begin."""
    world = general(backend)
    for _ in range(3):
        world.step(np.array(world.task.start))
    before = world["tool_1.cartesian_position"]
    assert world.do({"nums_objects": 7}).came == ("tool_5", "tool_6")
    np.testing.assert_array_equal(world["tool_1.cartesian_position"], before)
    assert world["goal_6.cartesian_position"][2] > 0.0
    world.step(np.array(world.task.start))
    assert world.do({"nums_objects": 2}).went == tuple(f"tool_{index}" for index in range(2, 7))


def test_the_same_goal_with_heavier_blocks() -> None:
    """Mass is a cause of the pile, so the drops are kept and the pile is another."""
    world = general()
    world.do({"drop_positions": Draw("A"), "drop_orientations": Draw("A")})
    drops = world["drop_positions"]
    world.do({"blocks_mass": 0.02})
    np.testing.assert_array_equal(world["drop_positions"], drops)
    assert world["tool_4.mass"] == 0.02
