"""Facts about towers."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from scm_world._types import Floats
from scm_world.errors import SeveralProblems, UnknownOption
from scm_world.tasks import Towers
from scm_world.tasks.trifinger.building import start
from scm_world.tasks.trifinger.entities.block_world import overlaps
from scm_world.variables import Draw
from scm_world.world import Simulation

DEEP = 1e-6  # [m]
COUNTS = (1, 1, 5)
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])


def tower(
    number: tuple[int, int, int] = COUNTS, dims: tuple[float, float, float] = (0.035, 0.035, 0.175)
) -> Simulation:
    """Give a world at the start of an episode, without physics."""
    world = Simulation(Towers(number_of_blocks_in_tower=number, tower_dims=dims), backend="fake")
    world.reset(seed=0)
    return world


def centers(world: Simulation, names: Iterable[str]) -> Floats:
    """Gather the centers of some bodies, shape (n, 3) [m]."""
    return np.array([world[f"{name}.cartesian_position"] for name in names])


def test_the_published_tower() -> None:
    """Five cubes in a column, and five on the diagonal of the floor, four centimeters apart."""
    world = tower()
    assert world.task.tools[:2] == ("tool_level_0_col_0_row_0", "tool_level_1_col_0_row_0")
    height = 0.035 * (np.arange(5) + 0.5)
    goals = centers(world, world.task.targets)
    np.testing.assert_allclose(goals, np.stack([0 * height, 0 * height, height], axis=-1))
    along = -0.12 + 0.04 * np.arange(5)
    expected = np.stack([along, along, np.full(5, 0.0175)], axis=-1)
    np.testing.assert_allclose(centers(world, world.task.tools), expected)
    assert world.max_episode_length == 1250
    assert world["tool_level_4_col_0_row_0.mass"] == 0.08


def test_blocks_are_named_by_level_column_and_row() -> None:
    """Levels go up, columns along y and rows along x, the rows fastest."""
    world = tower((3, 2, 1), (0.12, 0.08, 0.04))
    goals = centers(world, world.task.targets)
    assert next(iter(world.task.targets)) == "goal_level_0_col_0_row_0"
    assert list(world.task.targets)[1] == "goal_level_0_col_0_row_1"
    np.testing.assert_allclose(goals[:3, 0], [-0.04, 0.0, 0.04], atol=1e-12)
    np.testing.assert_allclose(goals[:, 1], [-0.02] * 3 + [0.02] * 3)
    assert (world["tool_level_0_col_1_row_2.size"] == [0.04, 0.04, 0.04]).all()


def test_block_and_goal_alternate_in_the_observation() -> None:
    """Each block is followed by its goal: 28 numbers for each."""
    observed = [part.variable for part in tower().task.observed()]
    entities = list(dict.fromkeys(name.partition(".")[0] for name in observed))
    assert entities[:4] == [
        "tool_level_0_col_0_row_0",
        "goal_level_0_col_0_row_0",
        "tool_level_1_col_0_row_0",
        "goal_level_1_col_0_row_0",
    ]


@pytest.mark.parametrize(
    "number", [(1, 1, 1), (2, 2, 2), (3, 1, 6), (1, 2, 6), (3, 3, 3), (4, 4, 4)]
)
@pytest.mark.parametrize("dims", [(0.08, 0.08, 0.08), (0.2, 0.2, 0.2), (0.2, 0.05, 0.2)])
def test_no_two_bodies_begin_in_one_place(
    number: tuple[int, int, int], dims: tuple[float, float, float]
) -> None:
    """Whatever the tower is cut into, the blocks, the ring and the fingers keep clear."""
    assert overlaps(tower(number, dims).scene(), tolerance=DEEP) == ()


def test_blocks_rise_by_their_height_where_the_floor_is_full() -> None:
    """The tenth of blocks that stand in threes stands on the first."""
    size, number = np.array([0.1, 0.1, 0.03]), np.array([1, 1, 10])
    first, tenth = (
        start(size, UPRIGHT, number, level=level, col=0.0, row=0.0) for level in (0.0, 9.0)
    )
    np.testing.assert_allclose(tenth - first, [0.0, 0.0, 0.03], atol=1e-12)


@pytest.mark.parametrize("backend", ["fake", "mujoco"])
def test_another_tower_begins_again(backend: str) -> None:
    """In mid-episode, too, blocks that change their size are put where they would begin."""
    world = Simulation(Towers(), backend=backend)
    world.reset(seed=0)
    for _ in range(3):
        world.step(np.array(world.task.start))
    audit = world.do({"number_of_blocks_in_tower": [2, 2, 2], "tower_dims": [0.1, 0.1, 0.1]})
    assert (len(audit.came), len(audit.went)) == (6, 3)
    fresh = tower((2, 2, 2), (0.1, 0.1, 0.1))
    assert world.task.tools == fresh.task.tools
    np.testing.assert_allclose(
        centers(world, world.task.tools), centers(fresh, fresh.task.tools), atol=1e-6
    )
    world.step(np.array(world.task.start))
    world.do(world.task.solution(world.values()))
    assert world["fractional_success"] == pytest.approx(1.0)


def test_the_middle_can_be_moved_alone() -> None:
    """The goals follow the center; the blocks stay where they are."""
    world = tower()
    tools, goals = (centers(world, names) for names in (world.task.tools, world.task.targets))
    world.do({"tower_center": [0.04, -0.06]})
    np.testing.assert_array_equal(centers(world, world.task.tools), tools)
    moved = centers(world, world.task.targets) - goals
    np.testing.assert_allclose(moved, np.tile([0.04, -0.06, 0.0], (5, 1)))


def test_masses_have_one_cause() -> None:
    """All follow it, but for a block that is given a mass of its own."""
    world = tower()
    world.do({"tool_level_2_col_0_row_0.mass": 0.03})
    world.do({"blocks_mass": 0.05})
    masses = [float(world[f"{name}.mass"]) for name in world.task.tools]
    assert masses == [0.05, 0.05, 0.03, 0.05, 0.05]


@pytest.mark.parametrize("seed", range(3))
def test_a_new_goal_is_another_tower(seed: int) -> None:
    """It is drawn from A, in whole numbers, and nothing stands in anything."""
    world = tower()
    world.reset(seed=seed, do=world.task.sample_goal("A"))
    for name in world.task.goal_causes:
        assert world.model.declared(name).in_space(world[name], "A", world.values())
    assert len(world.task.tools) == np.prod(world["number_of_blocks_in_tower"])
    assert overlaps(world.scene(), tolerance=DEEP) == ()


def test_blocks_that_are_too_small_are_refused() -> None:
    """Six in three centimeters would be half a centimeter each; the world stays as it was."""
    world = tower()
    with pytest.raises(SeveralProblems, match=r"tool_level_0_col_0_row_0\.size"):
        world.do({"number_of_blocks_in_tower": [6, 1, 1], "tower_dims": [0.029, 0.05, 0.05]})
    assert world.task.plan == COUNTS


def test_numbers_of_blocks_are_whole() -> None:
    """Half a block is refused by the constructor and by an intervention; a draw never has one."""
    with pytest.raises(UnknownOption, match="number_of_blocks_in_tower"):
        Towers(number_of_blocks_in_tower=(1, 1, 0))
    world = tower()
    world.do({"number_of_blocks_in_tower": Draw("A")})
    assert world["number_of_blocks_in_tower"].dtype == np.int64
