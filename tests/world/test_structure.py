"""Facts about variables that decide which entities there are."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from worlds import PARAMS, actions, begin, play, same, shared

from scm_world.errors import InterventionError, UnknownVariable
from scm_world.tasks import Reaching
from scm_world.variables import Box, Derived, Draw, Exogenous, Normal, Shift, Variable
from scm_world.world import Simulation

REACHING = [p for p in PARAMS if "reaching" in str(p.id)]


@pytest.mark.parametrize(("backend", "task"), REACHING)
def test_entities_come_and_go(backend: str, task: str) -> None:
    """The graph, the scene and the engine have exactly the obstacles there are."""
    world = begin(backend, task)
    before = len(world.model)
    audit = world.do({"number_of_obstacles": 2})
    assert audit.came == ("obstacle_0", "obstacle_1")
    assert world.structure.obstacles == audit.came
    assert {"obstacle_0.size", "obstacle_1.friction"} <= set(world.graph)
    assert "obstacle_2.size" not in world.graph
    world.step(actions(1)[0])
    assert world.do({"number_of_obstacles": 0}).went == audit.came
    assert len(world.model) == before
    assert world["number_of_obstacles"] == 0


@pytest.mark.parametrize(("backend", "task"), REACHING)
def test_what_comes_and_goes_at_once_leaves_no_trace(backend: str, task: str) -> None:
    """Obstacles that are put there and taken away at one instant never were."""
    world = begin(backend, task)
    start, values = world.snapshot(), world.values()
    future = play(world, actions(30, seed=3))
    world.restore(start)
    world.do({"number_of_obstacles": 3, "obstacle_2.size": [0.02, 0.02, 0.02]})
    world.do({"robot_finger_60_link_1.mass": 0.2})
    world.do({"number_of_obstacles": 0, "robot_finger_60_link_1.mass": 0.14854})
    assert same(world.values(), values)
    np.testing.assert_array_equal(play(world, actions(30, seed=3)), future)


@pytest.mark.parametrize(("backend", "task"), REACHING)
def test_what_stays_is_kept(backend: str, task: str) -> None:
    """Physics, parameters and interventions of everything else go on as they were."""
    world = begin(backend, task)
    world.do({"gravity": [0.0, 0.0, -8.0], "number_of_obstacles": 2})
    world.do({"obstacle_0.friction": 0.9})
    world.step(actions(1)[0])
    values = world.values()
    world.do({"number_of_obstacles": 1})
    now = world.values()
    assert now["obstacle_0.friction"] == 0.9
    assert all(np.array_equal(now[n], values[n]) for n in now if n != "number_of_obstacles")
    assert {"gravity", "obstacle_0.friction"} <= world.graph.interventions.keys()


@pytest.mark.parametrize(("backend", "task"), REACHING)
def test_a_reset_brings_the_first_structure_back(backend: str, task: str) -> None:
    """Obstacles of one episode are not in the next, and it goes as if they had never been."""
    world = shared(backend, task)
    world.reset(seed=0)
    values, future = world.values(), play(world, actions(10))
    world.reset(seed=0, do={"number_of_obstacles": 4})
    play(world, actions(5))
    world.reset(seed=0)
    assert same(world.values(), values)
    np.testing.assert_array_equal(play(world, actions(10)), future)


@pytest.mark.parametrize(("backend", "task"), REACHING)
def test_snapshots_know_the_structure(backend: str, task: str) -> None:
    """A world with obstacles is saved, pickled and restored from one without, bit for bit."""
    world = begin(backend, task)
    world.do({"number_of_obstacles": 2, "obstacle_places": Draw("A")})
    saved, values = pickle.loads(pickle.dumps(world.snapshot())), world.values()  # noqa: S301
    future = play(world, actions(10, seed=4))
    world.reset()
    world.restore(saved)
    assert same(world.values(), values)
    np.testing.assert_array_equal(play(world, actions(10, seed=4)), future)


def test_a_snapshot_before_anything_was_read_goes_on_alike_from_another_structure() -> None:
    """Rewards compare with one control step ago, which is computed where nothing read it yet."""
    world = Simulation("reaching")
    world.reset(seed=0)
    world.step(np.full(9, 0.1))
    here, runs = world.snapshot(), []
    for _ in range(2):
        world.restore(here)
        world.step(np.full(9, 0.2))
        runs.append(world.values())
        world.restore(here)
        world.do({"number_of_obstacles": 1})
        world.step(np.full(9, 0.1))
    assert all(np.array_equal(value, runs[1][name]) for name, value in runs[0].items())


def test_what_is_not_there_cannot_be_set() -> None:
    """The error names what there is; after the structure changed it can be set."""
    world = shared("fake", "reaching")
    world.reset(seed=0)
    with pytest.raises(UnknownVariable, match="obstacle_0"):
        world.do({"obstacle_0.friction": 0.3})
    values = world.values()
    with pytest.raises(UnknownVariable, match="obstacle_5"):
        world.do({"number_of_obstacles": 2, "obstacle_5.friction": 0.3})
    assert same(world.values(), values)
    world.do({"number_of_obstacles": Shift(2), "obstacle_1.friction": 0.3})
    assert world["obstacle_1.friction"] == 0.3


def test_what_was_asked_of_a_body_waits_for_it() -> None:
    """Interventions at one instant are one, even if a body is gone in between."""
    world = shared("fake", "reaching")
    world.reset(seed=0)
    world.do({"number_of_obstacles": 2, "obstacle_1.friction": 0.3})
    world.do({"number_of_obstacles": 1})
    world.do({"number_of_obstacles": 2})
    assert world["obstacle_1.friction"] == 0.3


class _Random(Reaching):  # type: ignore[misc] # final for users; here it stands for another task
    """Reaching in which nature throws dice."""

    def shared(self) -> list[Variable]:
        """Declare an obstacle count and two random roots."""
        own = [
            Exogenous(name="dice", distribution=Box(0.0, 1.0), bounds=Box(0.0, 5.0), doc="A die."),
            Derived(
                name="blurred",
                parents=("dice",),
                mechanism=_blur,
                noise=Normal(0.0, 0.1),
                doc="The die, seen through a fog.",
            ),
        ]
        return [*super().shared(), *own]


def _blur(dice: float, *, noise: float = 0.0) -> float:
    return dice + noise


def test_nature_draws_at_the_start_of_an_episode() -> None:
    """What is random by declaration differs between episodes and is the same for one seed."""
    world = Simulation(_Random(), backend="fake")
    drawn = []
    for seed in (1, 1, 2):
        world.reset(seed=seed)
        drawn.append((float(world["dice"]), float(world["blurred"])))
        world.reset()
        drawn.append((float(world["dice"]), float(world["blurred"])))
    assert drawn[0:2] == drawn[2:4]
    assert len(set(drawn)) == 4


def test_an_intervention_keeps_the_noise_of_nature() -> None:
    """Setting the cause, at any time, leaves the noise of the effect as it was drawn."""
    world = Simulation(_Random(), backend="fake")
    world.reset(seed=1)
    noise = float(world["blurred"] - world["dice"])
    for _ in range(3):
        world.step(np.zeros(9))
    world.do({"dice": 2.0})
    assert float(world["blurred"]) == pytest.approx(2.0 + noise, abs=1e-15)
    world.step(np.zeros(9))
    natural = world["dice"] - 0.0
    world.do({"dice": Shift(1.0)})
    assert float(world["dice"]) == pytest.approx(1.0 + _natural_dice(), abs=1e-12)
    assert natural == 2.0


def _natural_dice() -> float:
    world = Simulation(_Random(), backend="fake")
    world.reset(seed=1)
    return float(world["dice"])


def test_a_draw_needs_a_space() -> None:
    """What has no space cannot be drawn from it."""
    world = shared("fake", "reaching")
    world.reset(seed=0)
    with pytest.raises(InterventionError, match="no space A to draw from"):
        world.do({"obstacle_places": Draw("A"), "joint_velocities": Draw("A")})


def test_what_is_partly_impossible_is_refused_as_a_whole() -> None:
    """A layout that fits no longer beside a number that is impossible: an error, no crash."""
    world = Simulation("stacked_blocks", backend="fake")
    world.reset(seed=0)
    values = world.values()
    fewer = np.zeros_like(values["wall.layout"])
    fewer[0, 0] = [0.0, 0.0, 0.05]
    with pytest.raises(InterventionError, match="stack_levels"):
        world.do({"wall.layout": fewer, "stack_levels": Shift(1000)})
    assert same(world.values(), values)
    world.do({"wall.layout": fewer})
    assert world.composition.blocks == ("tool_level_0_num_0",)
