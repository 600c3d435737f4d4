"""Facts about walls, of which all or two levels are given."""

from __future__ import annotations

import numpy as np
import pytest

from scm_world._types import Floats
from scm_world.errors import UnknownOption
from scm_world.tasks import CreativeStackedBlocks, StackedBlocks
from scm_world.tasks.trifinger.entities.block_world import overlaps
from scm_world.tasks.trifinger.walls import MAX_LEVELS, SHAPE, layout
from scm_world.variables import Draw
from scm_world.world import Simulation

DEEP = 1e-6  # [m]
ARENA = 0.15  # [m]
RANDOM = {"wall_pattern": 1, "wall_noise": Draw("A")}
NOISE = np.random.default_rng(0).random((200, MAX_LEVELS, 3))


def begin(
    task: StackedBlocks, *, conventions: str = "scm_world", backend: str = "fake"
) -> Simulation:
    """Give a world at the start of an episode."""
    world = Simulation(task, backend=backend, conventions=conventions)
    world.reset(seed=0)
    return world


def place(world: Simulation, name: str) -> Floats:
    """Give the center of a body [m]."""
    return np.asarray(world[f"{name}.cartesian_position"])


def random_layout(size: float, width: float, noise: Floats, levels: int = 5) -> Floats:
    """Lay one random wall out, or several."""
    numbers = (np.array(x) for x in (levels, size, width, 1))
    return layout(*numbers, noise)


# --- the regular wall ----------------------------------------------------------------------------


def test_the_published_wall() -> None:
    """Five levels of seven cubes, shifted by turns; blocks begin a decimeter off, by turns."""
    world = begin(StackedBlocks())
    assert world.task.plan == (7,) * 5
    for level, (shift, side) in enumerate(((-0.005, -0.1), (0.005, 0.1), (-0.005, -0.1))):
        x = 0.035 * (np.arange(7) - 3.0) + shift
        for num in range(7):
            goal = place(world, f"goal_level_{level}_num_{num}")
            np.testing.assert_allclose(goal, [x[num], 0.0, 0.035 * (level + 0.5)], atol=1e-12)
            tool = place(world, f"tool_level_{level}_num_{num}")
            np.testing.assert_allclose(tool[:2], [x[num], side], atol=1e-12)
    assert world.max_episode_length == 8750
    assert overlaps(world.scene(), tolerance=DEEP) == ()


def test_nothing_begins_in_the_air() -> None:
    """Every other level stands on the one before the last; in the predecessor it falls on it."""
    ours = begin(StackedBlocks())
    theirs = begin(StackedBlocks(), conventions="causal_world")
    for level in range(5):
        name = f"tool_level_{level}_num_3"
        assert place(ours, name)[2] == pytest.approx(0.035 * (level // 2 + 0.5))
        assert place(theirs, name)[2] == pytest.approx(0.035 * (level + 0.5))


def test_the_creative_wall_gives_two_levels() -> None:
    """There are goals for the first and the last of eight levels, three blocks each."""
    task = begin(CreativeStackedBlocks()).task
    assert len(task.tools) == 24
    levels = {name.split("_")[2] for name in task.targets}
    assert levels == {"0", "7"}
    assert len(task.targets) == 6


@pytest.mark.parametrize(
    ("task", "numbers"),
    [(StackedBlocks(), 1008), (CreativeStackedBlocks(), 502)],
    ids=["stacked", "creative"],
)
def test_the_observation_is_the_published_one(task: StackedBlocks, numbers: int) -> None:
    """28 numbers in common, 17 for each block, 11 for each goal, in turns."""
    world = begin(task)
    observed = [part.variable for part in world.task.observed()]
    assert 28 + sum(world[name].size for name in observed) == numbers
    entities = list(dict.fromkeys(name.partition(".")[0] for name in observed))
    assert entities[:2] == ["tool_level_0_num_0", "goal_level_0_num_0"]


def test_achieved_goals_are_those_of_the_given_levels() -> None:
    """Where there are more blocks than goals, each goal is compared with its own block."""
    world = begin(CreativeStackedBlocks(num_of_levels=4))
    achieved, desired = world.task.goal.vectors(world.values())
    assert achieved.shape == desired.shape == (60,)


@pytest.mark.parametrize("task", [StackedBlocks(), CreativeStackedBlocks()], ids=lambda t: t.name)
def test_the_solution_builds_the_whole_wall(task: StackedBlocks) -> None:
    """The levels between the given ones are built, too, so that the wall stands."""
    world = begin(task)
    world.do(world.task.solution(world.values()))
    assert world["fractional_success"] == pytest.approx(1.0)
    middle = place(world, "tool_level_2_num_1")
    assert middle[2] == pytest.approx(0.0875)
    assert abs(middle[1]) < DEEP


# --- random walls --------------------------------------------------------------------------------


@pytest.mark.parametrize(("size", "width"), [(0.035, 0.25), (0.035, 0.12), (0.06, 0.15)])
def test_random_walls_stand(size: float, width: float) -> None:
    """Each block is no narrower than the least, and its middle lies on the level below."""
    halved = 0
    for found in random_layout(size, width, NOISE):
        below = (-ARENA, ARENA)
        for row in (level[level[:, 2] > 0.0] for level in found[:5]):
            assert (row[:, 2] >= size - 1e-12).all()
            left, right = row[:, 0] - row[:, 2] / 2.0, row[:, 0] + row[:, 2] / 2.0
            assert right.max() - left.min() <= width + 1e-9
            assert (row[:, 0] >= below[0] - 1e-9).all()
            assert (row[:, 0] <= below[1] + 1e-9).all()
            np.testing.assert_allclose(right[:-1], left[1:], atol=1e-9)  # side by side
            below = (left.min(), right.max())
            assert max(-below[0], below[1], *np.abs(row[:, 1])) <= ARENA + 1e-9
            halved += len(row) > 1
        assert len(set(found[:5, 0, 1])) == 1  # one wall, one y
    assert halved > 0


@pytest.mark.parametrize(
    "asked", [(10, 0.1, 0.3), (8, 0.065, 0.035), (10, 0.02, 0.3)], ids=["high", "narrow", "fine"]
)
@pytest.mark.parametrize("pattern", [0, 1])
def test_every_wall_fits_into_the_arena(asked: tuple[int, float, float], pattern: int) -> None:
    """It has no more levels than fit, and at least one block in each, however narrow."""
    numbers = (np.array(x) for x in (*asked, pattern))
    found = layout(*numbers, NOISE[0])
    counts = (found[..., 2] > 0.0).sum(axis=-1)
    levels = min(asked[0], int(0.3 / asked[1] + 1e-9))
    assert (counts[:levels] > 0).all()
    assert not counts[levels:].any()
    if asked[2] < asked[1]:
        np.testing.assert_allclose(found[:levels, 0, 2], asked[1])


def test_walls_are_laid_out_in_batches() -> None:
    """Leading axes are kept, and each wall is the same as alone."""
    found = random_layout(0.035, 0.25, NOISE[:6].reshape(2, 3, MAX_LEVELS, 3))
    assert found.shape == (2, 3, *SHAPE)
    np.testing.assert_array_equal(found[1, 2], random_layout(0.035, 0.25, NOISE[5]))


@pytest.mark.parametrize("task", [StackedBlocks(), CreativeStackedBlocks()], ids=lambda t: t.name)
@pytest.mark.parametrize("space", ["A", "B"])
def test_random_walls_can_be_built(task: StackedBlocks, space: str) -> None:
    """No two bodies begin in one place, no block in its goal, and there is room for the wall."""
    world = begin(task)
    for seed in range(10):
        for request in (RANDOM, {**world.task.sample_goal(space)}):
            world.reset(seed=seed, do=request)
            assert overlaps(world.scene(), tolerance=DEEP) == ()
            assert world["fractional_success"] == pytest.approx(0.0, abs=1e-9)
            world.do(world.task.solution(world.values()))
            assert world["success"] == 1


def test_one_noise_is_one_wall() -> None:
    """A wider wall of the same noise begins at the same place; other noise is another wall."""
    world = begin(StackedBlocks())
    world.do(RANDOM)
    first = world["wall.layout"]
    world.do({"max_level_width": 0.2})
    wider = world["wall.layout"]
    np.testing.assert_array_equal(first[:, 0, 1] != 0.0, wider[:, 0, 1] != 0.0)
    low, high = (found[0, found[0, :, 2] > 0.0] for found in (wider, first))
    assert np.average(low[:, 0], weights=low[:, 2]) == pytest.approx(
        np.average(high[:, 0], weights=high[:, 2])
    )
    world.do({"max_level_width": 0.25})
    np.testing.assert_array_equal(world["wall.layout"], first)
    world.reset(seed=1, do=RANDOM)
    assert not np.array_equal(world["wall.layout"], first)


# --- interventions -------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", ["fake", "mujoco"])
def test_levels_come_and_go(backend: str) -> None:
    """In mid-episode, too; the blocks are put where they would begin, the fingers stay."""
    world = begin(StackedBlocks(num_of_levels=2, max_level_width=0.08), backend=backend)
    for _ in range(3):
        world.step(np.array(world.task.start))
    audit = world.do({"stack_levels": 3})
    assert audit.came == ("tool_level_2_num_0", "tool_level_2_num_1")
    fresh = begin(StackedBlocks(num_of_levels=3, max_level_width=0.08))
    for name in fresh.task.tools:
        np.testing.assert_allclose(place(world, name), place(fresh, name), atol=1e-6)
    world.step(np.array(world.task.start))
    assert len(world.do({"stack_levels": 1}).went) == 4


def test_a_reset_brings_the_first_wall_back() -> None:
    """What the variables say and what stands there agree before it and after it."""
    world = begin(StackedBlocks(num_of_levels=2, max_level_width=0.08))
    world.do({"stack_levels": 4, "blocks_min_size": 0.04})
    world.step(np.array(world.task.start))
    world.reset()
    assert (world["stack_levels"], world["blocks_min_size"]) == (2, 0.035)
    assert world.task.plan == (2, 2)
    assert len(world.structure.blocks) == 4


def test_one_seed_is_one_random_wall_on_every_engine() -> None:
    """Layout and starts are a function of seed and intervention, so they can be replayed."""
    found = []
    for backend in ("fake", "mujoco"):
        world = begin(StackedBlocks(num_of_levels=3), backend=backend)
        for _ in range(2):
            world.reset(seed=5, do=RANDOM)
            found.append([world["wall.layout"].tolist(), world.state.positions.tolist()])
    assert all(each == found[0] for each in found)


def test_a_layout_can_be_set() -> None:
    """A wall of one's own: its causes no longer matter, and what follows from it still does."""
    world = begin(StackedBlocks(num_of_levels=2, max_level_width=0.08))
    own = np.zeros(SHAPE)
    own[0, :2], own[1, 0] = [[-0.05, 0.0, 0.05], [0.05, 0.0, 0.05]], [0.0, 0.0, 0.15]
    world.do({"wall.layout": own})
    assert world.task.plan == (2, 1)
    np.testing.assert_allclose(world["goal_level_1_num_0.size"], [0.15, 0.035, 0.035])
    world.do({"blocks_min_size": 0.04})
    np.testing.assert_allclose(world["goal_level_1_num_0.size"], [0.15, 0.04, 0.04])


def test_obstacles_stand_in_the_way_of_creative_walls() -> None:
    """As many as asked for; they come with the wall and without it."""
    world = begin(CreativeStackedBlocks(num_of_levels=3, number_of_obstacles=1))
    assert world.structure.obstacles == ("obstacle_0",)
    world.do({"number_of_obstacles": 3, "stack_levels": 4})
    assert len(world.structure.obstacles) == 3
    assert world.task.plan == ((3, 3, 3, 3), 3)


@pytest.mark.parametrize(
    "options",
    [{"num_of_levels": 0}, {"num_of_levels": 2.5}, {"blocks_min_size": 1.0}],
    ids=lambda options: next(iter(options)),
)
def test_impossible_walls_are_refused(options: dict[str, float]) -> None:
    """The error names the argument."""
    with pytest.raises(UnknownOption, match=next(iter(options))):
        StackedBlocks(**options)  # type: ignore[arg-type]
