"""Facts about stacking."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from published import OBSERVATIONS, Instant, evaluate, instants, norm, speed_change, tips_from

from scm_world.env import ScmWorldEnv
from scm_world.geometry.rotations import angle_between
from scm_world.tasks import Stacking2
from scm_world.variables import Draw
from scm_world.world import Simulation

FIRST, SECOND, GOAL, TOP = (
    f"{name}.cartesian_position"
    for name in ("tool_block_1", "tool_block_2", "goal_block_1", "goal_block_2")
)
TOWER = "goal_tower.cylindrical_position"


def stacking(**options: Any) -> Simulation:
    """Give a world without physics."""
    world = Simulation(Stacking2(**options), backend="fake")
    world.reset(seed=0)
    return world


def placed(now: Instant) -> bool:
    """Tell whether the first block is at its goal."""
    return norm(now[FIRST] - now[GOAL]) < 0.02


def tips_progress(now: Instant, was: Instant) -> float:
    """Measure the progress towards the block whose turn it is."""
    block = "tool_block_2" if placed(now) else "tool_block_1"
    return tips_from(was, block) - tips_from(now, block)


def placing(now: Instant, was: Instant) -> float:
    """Measure the progress of the first block."""
    return 0.0 if placed(now) else norm(was[FIRST] - now[GOAL]) - norm(now[FIRST] - now[GOAL])


def apart(at: Instant) -> float:
    """Measure the distance of the blocks, seen from above."""
    return norm(at[FIRST][:2] - at[SECOND][:2])


def lifting(now: Instant, was: Instant) -> float:
    """Measure the progress of the second block in height."""
    if not placed(now) or apart(now) < 0.005:
        return 0.0
    return abs(was[SECOND][2] - now[TOP][2]) - abs(now[SECOND][2] - now[TOP][2])


def joining(now: Instant, was: Instant) -> float:
    """Measure how much nearer the blocks came, once the second one is high enough."""
    high = now[SECOND][2] > now[TOP][2]
    return apart(was) - apart(now) if placed(now) and high else 0.0


FORMULAS: dict[str, Callable[[Instant, Instant], float]] = {
    "reward.tips_to_block": tips_progress,
    "reward.block_to_goal": placing,
    "reward.block_to_height": lifting,
    "reward.block_to_block": joining,
    "reward.smoothness": lambda now, was: -speed_change(now, was),
}


@pytest.mark.parametrize("term", FORMULAS)
def test_terms_follow_the_published_formulas(term: str) -> None:
    """Each term is what its formula says, before and after the first block is placed."""
    model, phases = stacking().model, set()
    for seed in range(200):
        now, before = instants(model, term, seed, spread=0.02)
        if term != "reward.smoothness":
            phases.add(placed(now))
        if seed % 20 == 0 and SECOND in now and FIRST in now:
            now[SECOND][:2] = now[FIRST][:2] + 0.002
        expected = FORMULAS[term](now, before)
        assert evaluate(model, term, now, before) == pytest.approx(expected, abs=1e-12)
    assert phases == (set() if term == "reward.smoothness" else {True, False})


def test_weights_are_the_published_ones() -> None:
    """The dense weights stand in the published order."""
    assert list(Stacking2().weights.values()) == [750, 250, 250, 125, 0.005, 1]


def test_the_observation_is_the_published_one() -> None:
    """Under the predecessor's conventions the observation at reset is the published one."""
    env = ScmWorldEnv(task="stacking2", backend="fake", conventions="causal_world")
    np.testing.assert_allclose(env.reset(seed=0)[0], OBSERVATIONS["stacking2"], atol=2e-6)
    assert env.world.max_episode_length == 500


def test_the_tower_can_be_moved_and_turned_at_once() -> None:
    """Both goals take over position and orientation, and what was set is read back."""
    world, place = stacking(), [0.1, 1.2, 0.065]
    world.do({TOWER: place, "goal_tower.euler_orientation": [0.0, 0.0, 0.9]})
    np.testing.assert_allclose(world[TOWER], place)
    np.testing.assert_allclose(world["goal_tower.euler_orientation"], [0.0, 0.0, 0.9])
    x, y = 0.1 * np.cos(1.2), 0.1 * np.sin(1.2)
    np.testing.assert_allclose(world[GOAL], [x, y, 0.0325])
    np.testing.assert_allclose(world[TOP], [x, y, 0.0975])
    for name in ("goal_block_1", "goal_block_2"):
        np.testing.assert_allclose(world[f"{name}.euler_orientation"], [0.0, 0.0, 0.9])
    before = world.values()
    world.do({name: world[name] for name in (TOWER, "goal_tower.euler_orientation")})
    np.testing.assert_allclose(world[TOP], before[TOP], atol=1e-15)


def test_the_tower_moves_and_turns_as_one() -> None:
    """The goals stay stacked; a tower on its side has them side by side on the floor."""
    world = stacking()
    world.do({TOWER: [0.05, 0.0, 0.08]})
    assert (world[GOAL][2], world[TOP][2]) == pytest.approx((0.0475, 0.1125))
    world = stacking()
    world.do({"goal_tower.euler_orientation": [np.pi / 2, 0.0, 0.0]})
    assert (world[GOAL][2], world[TOP][2]) == pytest.approx((0.0325, 0.0325))
    np.testing.assert_allclose(world[TOP] - world[GOAL], [0.0, -0.065, 0.0], atol=1e-12)


def test_one_size_for_all() -> None:
    """Blocks and goals grow together: all stand on the floor or on one another."""
    world = stacking()
    world.do({"block.size": [0.06, 0.06, 0.07]})
    heights = [world[name][2] for name in (FIRST, SECOND, GOAL, TOP)]
    assert heights == pytest.approx([0.035, 0.035, 0.035, 0.105])
    np.testing.assert_allclose(world["goal_block_2.size"], world["tool_block_1.size"])


def test_the_default_size_is_an_option() -> None:
    """It is that of blocks and goals."""
    world = stacking(tool_block_size=0.05)
    np.testing.assert_allclose(world["tool_block_2.size"], [0.05] * 3)
    assert world[TOP][2] == pytest.approx(0.075)


@pytest.mark.parametrize("space", ["A", "B"])
def test_blocks_of_any_size_begin_apart(space: Any) -> None:
    """No size from A or B is refused at the start, and the blocks do not touch."""
    world = stacking()
    for _ in range(20):
        world.reset(do={"block.size": Draw(space)})
        gap = np.abs(world[FIRST] - world[SECOND])[:2] - world["block.size"][:2]
        assert gap.max() >= 0.005 - 1e-9


@pytest.mark.parametrize("space", ["A", "B"])
def test_new_goals_are_towers(space: Any) -> None:
    """A new goal is a tower elsewhere, turned about the vertical."""
    world, yaws, upright = stacking(), [], np.array([0.0, 0.0, 0.0, 1.0])
    for _ in range(10):
        world.reset(do=world.task.sample_goal(space))
        tower = world.model[TOWER]
        assert tower.in_space(world[TOWER], space, world.values())
        np.testing.assert_allclose(world[TOP] - world[GOAL], [0.0, 0.0, 0.065], atol=1e-15)
        yaws.append(angle_between(world["goal_block_2.orientation"], upright))
    assert np.ptp(yaws) > 0.3


def test_parts_of_the_tower_have_no_spaces_of_their_own() -> None:
    """Curricula draw the tower and the shared size, never a single goal or the size of one."""
    model = stacking().model
    removed = [
        *(f"goal_block_{i}.{what}" for i in (1, 2) for what in ("size", "cylindrical_position")),
        *(f"goal_block_{i}.euler_orientation" for i in (1, 2)),
        *(f"tool_block_{i}.size" for i in (1, 2)),
    ]
    assert [name for name in removed if model[name].a or model[name].b] == []
    kept = ("block.size", "goal_tower.polar", "goal_tower.euler_orientation", TOWER)
    assert all(model[name].a and model[name].b for name in kept)
