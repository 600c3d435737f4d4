"""Facts about rewards and success, against numbers computed by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from scm_world.errors import UnknownOption
from scm_world.tasks import CONVENTIONS, Pushing, Reaching, make_task
from scm_world.tasks.trifinger import hardware, kernels
from scm_world.tasks.trifinger.kinematics import forward
from scm_world.variables import Shift
from scm_world.world import Simulation

REST = np.array(hardware.REST)
TIPS = np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.2, 0.3, 0.4, 0.0])


def pushing(convention: str = "scm_world", **options: Any) -> Simulation:
    """Give a pushing world without physics, with the fingers out of the way."""
    world = Simulation(Pushing(**options), backend="fake", conventions=convention)
    world.reset(seed=0)
    world.do({"joint_positions": hardware.RAISED})
    return world


def place(world: Simulation, offset: tuple[float, float, float], yaw: float = 0.0) -> None:
    """Put the block near the goal."""
    position = world["goal_block.cartesian_position"] + np.array(offset)
    tool = {"cartesian_position": position, "euler_orientation": [0.0, 0.0, yaw]}
    world.do({"tool_block": tool})


# --- the numbers themselves ----------------------------------------------------------------------


def test_distances() -> None:
    """Pythagoras: 3, 4, 5, and a Frobenius norm over three tips."""
    assert kernels.distance(np.zeros(3), np.array([3.0, 0.0, 4.0])) == 5.0
    # distances of the tips: 0.1, 0.2 and 0.5, squares 0.01 + 0.04 + 0.25
    assert kernels.tips_distance(TIPS, np.zeros(3)) == pytest.approx(np.sqrt(0.3))


def test_progress_is_distance_before_minus_distance_after() -> None:
    """Coming nearer is positive; the block that comes to the tips counts as well."""
    origin, there = np.zeros(3), np.array([0.0, 0.0, 0.1])
    assert kernels.tips_progress(np.zeros(9), TIPS, origin, origin) == pytest.approx(np.sqrt(0.3))
    # seen from (0, 0, 0.1) the squares are 0 + 0.01 + 0.26
    expected = np.sqrt(0.3) - np.sqrt(0.27)
    assert kernels.tips_progress(TIPS, TIPS, there, origin) == pytest.approx(expected)
    goal = np.array([0.3, 0.0, 0.4])
    assert kernels.block_progress(0.5 * goal, origin, goal) == pytest.approx(0.25)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_turning_towards_the_goal_counts_in_radians(sign: float) -> None:
    """From 90 to 30 degrees is pi / 3, whichever quaternion stands for the rotation."""

    def yaw(degrees: float) -> np.ndarray:
        half = np.radians(degrees) / 2.0
        return np.array([0.0, 0.0, np.sin(half), np.cos(half)])

    progress = kernels.turn_progress(sign * yaw(30.0), yaw(90.0), yaw(0.0))
    assert progress == pytest.approx(np.pi / 3)


@pytest.mark.parametrize(
    ("offset", "yaw", "expected"),
    [
        ((0.0, 0.0, 0.0), 0.0, 1.0),
        ((0.5, 0.0, 0.0), 0.0, 0.5),
        ((0.5, 0.5, 0.5), 0.0, 0.125),
        ((1.0, 0.0, 0.0), 0.0, 0.0),
        ((5.0, 0.0, 0.0), 0.3, 0.0),
        ((0.0, 0.0, 0.0), np.pi / 2, 1.0),
        # two unit squares at 45 degrees share a regular octagon of area 2 (sqrt 2 - 1)
        ((0.0, 0.0, 0.0), np.pi / 4, 2.0 * (np.sqrt(2.0) - 1.0)),
        ((0.0, 0.0, 0.25), np.pi / 4, 1.5 * (np.sqrt(2.0) - 1.0)),
    ],
)
def test_the_filled_fraction_of_a_unit_cube(
    offset: tuple[float, ...], yaw: float, expected: float
) -> None:
    """The overlap of two oriented cubes is exact."""
    one = np.ones(3)
    turn = np.array([0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)])
    straight = np.array([0.0, 0.0, 0.0, 1.0])
    found = kernels.filled(one, np.array(offset), turn, one, np.zeros(3), straight, tools=1.0)
    assert found == pytest.approx(expected, abs=1e-9)


def test_a_larger_block_fills_no_more_than_the_goal() -> None:
    """The fraction is capped at one, and a small block in a large goal fills its own volume."""
    small, large, straight = np.ones(3), np.full(3, 2.0), np.array([0.0, 0.0, 0.0, 1.0])
    at = np.zeros(3)
    assert kernels.filled(large, at, straight, small, at, straight, tools=1.0) == 1.0
    eighth = kernels.filled(small, at, straight, large, at, straight, tools=1.0)
    assert eighth == pytest.approx(0.125)


def test_distances_to_three_goals() -> None:
    """Nine offsets of 1, 2, …: Euclidean for the reward, mean absolute for success."""
    goals = np.arange(1.0, 10.0).reshape(3, 3)
    assert kernels.distance(np.zeros(9), goals.ravel()) == pytest.approx(np.sqrt(285.0))
    assert kernels.reach_error(np.zeros(9), *goals) == pytest.approx(5.0)
    half = goals.ravel() / 2.0
    assert kernels.reach_progress(half, np.zeros(9), *goals) == pytest.approx(np.sqrt(285.0) / 2)


# --- in the world --------------------------------------------------------------------------------


def test_pushing_rewards_what_one_step_changed() -> None:
    """A block that glides 8 mm towards its goal earns 250 for each meter, and no tips moved it."""
    world = pushing()
    position = np.array([0.0, -0.05, 0.0325])
    world.do({"tool_block": {"cartesian_position": position, "linear_velocity": [0.0, 0.2, 0.0]}})
    tips = forward(np.array(hardware.RAISED), 0.34).reshape(3, 3)
    world.step(hardware.RAISED)
    moved = position + np.array([0.0, 0.2 * 0.04, 0.0])
    values = world.values()
    before, after = (np.linalg.norm(tips - p) for p in (position, moved))
    assert values["reward.block_to_goal"] == pytest.approx(0.008)
    assert values["reward.tips_to_block"] == pytest.approx(before - after)
    assert values["reward.orientation"] == 0.0
    expected = 250.0 * 0.008 + 750.0 * (before - after) + values["fractional_success"]
    assert values["reward"] == pytest.approx(expected)


def test_turning_the_goal_away_is_no_reward() -> None:
    """A goal that do moves changes what is left to do, not what was earned."""
    world = pushing()
    world.step(hardware.RAISED)
    world.do({"goal_block.polar": [0.1, 0.0], "goal_block.euler_orientation": [0.0, 0.0, 1.0]})
    world.step(hardware.RAISED)
    assert world["reward"] == pytest.approx(world["fractional_success"], abs=1e-9)


@pytest.mark.parametrize(
    ("offset", "fraction", "success"),
    [(0.0, 1.0, 1), (0.006, 1 - 0.006 / 0.065, 1), (0.007, 1 - 0.007 / 0.065, 0), (0.1, 0.0, 0)],
)
def test_pushing_succeeds_above_nine_tenths(offset: float, fraction: float, success: int) -> None:
    """The block may be 6.5 mm off at most."""
    world = pushing()
    place(world, (offset, 0.0, 0.0))
    assert world["fractional_success"] == pytest.approx(fraction, abs=1e-9)
    assert world["success"] == success


def test_the_predecessor_measured_the_hull() -> None:
    """A cube at 45 degrees fills 0.828 of its goal; by axis-aligned hulls it fills all of it."""
    ours, theirs = pushing(), pushing("causal_world")
    for world, expected in ((ours, 2.0 * (np.sqrt(2.0) - 1.0)), (theirs, 1.0)):
        place(world, (0.0, 0.0, 0.0), yaw=np.pi / 4)
        assert world["fractional_success"] == pytest.approx(expected, abs=1e-9)
        overlap = world.task.goal.measures["published_overlap"]
        assert overlap(*world.task.goal.vectors(world.evaluate(()))) == pytest.approx(1.0, abs=1e-9)


def test_reaching_rewards_tips_that_come_nearer() -> None:
    """The joints jump, and the reward is the difference of two distances, times 100,000."""
    world = Simulation("reaching", backend="fake")
    world.reset(seed=0)
    goals = np.array([0.0, 0.0, 0.10, 0.0, 0.0, 0.13, 0.0, 0.0, 0.16])
    target = REST + np.tile([0.05, -0.1, 0.05], 3)
    distances = [np.linalg.norm(forward(q, 0.34) - goals) for q in (REST, target)]
    world.step(target)
    values = world.values()
    assert values["reward.tips_to_goals"] == pytest.approx(distances[0] - distances[1])
    assert values["reward.distance"] == pytest.approx(-distances[1])
    assert values["reward.torque"] == values["reward.smoothness"] == 0.0
    error = np.abs(forward(target, 0.34) - goals).mean()
    assert values["reach_error"] == pytest.approx(error)
    earned = 1e5 * (distances[0] - distances[1]) + values["fractional_success"]
    assert values["reward"] == pytest.approx(earned)


@pytest.mark.parametrize(
    ("error", "fraction", "success"),
    [(0.0, 1.0, 1), (0.009, 1.0, 1), (0.02, 0.5, 0), (0.025, 0.25, 0), (0.03, 0.0, 0), (1, 0.0, 0)],
)
def test_reaching_succeeds_within_a_centimeter(error: float, fraction: float, success: int) -> None:
    """The fraction falls from one at a centimeter to zero at three."""
    from scm_world.tasks.trifinger.reaching import FAR, REACHED, nearness, within

    measured = np.array(error)
    found = nearness(measured, reached=np.array(REACHED), far=np.array(FAR))
    assert found == pytest.approx(fraction)
    assert within(measured, reached=np.array(REACHED)) == success


def test_the_predecessor_added_the_distance() -> None:
    """In reaching its reward grew with the error; under its conventions ours does too."""
    world = Simulation("reaching", backend="fake", conventions="causal_world")
    world.reset(seed=0)
    assert "reach_error" in world.model.parents("reward")
    assert "fractional_success" not in world.model.parents("reward")
    assert world["reward"] == pytest.approx(world["reach_error"])


def test_weights_can_be_chosen() -> None:
    """A term whose weight is zero is no cause of the reward; it is computed all the same."""
    world = pushing(weights={"reward.orientation": 0.0, "fractional_success": 3.0})
    assert "reward.orientation" not in world.model.parents("reward")
    place(world, (0.0, 0.0, 0.0))
    world.step(hardware.RAISED)
    assert world["reward.orientation"] == 0.0
    assert world["reward"] == pytest.approx(3.0 + 750.0 * world["reward.tips_to_block"])


def test_velocities_that_change_cost_smoothness() -> None:
    """The term is minus the norm of the difference of two steps."""
    world = Simulation(Reaching(weights={"reward.smoothness": 2.0}), backend="mujoco")
    world.reset(seed=0)
    world.step(REST + 0.1)
    before = world["joint_velocities"]
    world.step(REST - 0.1)
    values = world.values()
    expected = -np.linalg.norm(values["joint_velocities"] - before)
    assert values["reward.smoothness"] == pytest.approx(expected)
    assert values["reward.torque"] == pytest.approx(-np.linalg.norm(values["joint_torques"]))
    world.do({"joint_velocities": Shift(1.0)})
    assert world["reward.smoothness"] != values["reward.smoothness"]
    world.close()


# --- the registry --------------------------------------------------------------------------------


def test_conventions_are_chosen_by_name() -> None:
    """Ours differ from the predecessor's in everything that is listed."""
    assert pushing().options.conventions is CONVENTIONS["scm_world"]
    ours, theirs = (vars(CONVENTIONS[name]) for name in ("scm_world", "causal_world"))
    assert not [name for name in ours if ours[name] == theirs[name]]
    with pytest.raises(UnknownOption, match="did you mean 'causal_world'"):
        pushing("causalworld")


def test_a_task_is_made_with_its_options() -> None:
    """An unknown name is an error that lists the tasks."""
    task = make_task("reaching", default_goal_60=(0.1, 0.0, 0.1))
    assert isinstance(task, Reaching)
    with pytest.raises(UnknownOption, match="there are: reaching, pushing"):
        make_task("pushin")
