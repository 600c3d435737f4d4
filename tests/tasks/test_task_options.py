"""Facts about options that every task has."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from scm_world.env import ScmWorldEnv, vector_env
from scm_world.errors import Infeasible, InterventionError, ModelError, UnknownOption
from scm_world.evaluation import evaluate
from scm_world.geometry.rotations import rotation_matrix
from scm_world.tasks import TASKS, term
from scm_world.tasks.trifinger.single import Pushing
from scm_world.variables import Box, Draw, Function, Measured
from scm_world.variables.kinds import SpaceName
from scm_world.world import Simulation


@pytest.mark.parametrize("name", TASKS)
def test_an_unknown_option_is_refused(name: str) -> None:
    """A word that is misspelled is no silent default."""
    with pytest.raises(UnknownOption, match="weights"):
        TASKS[name](weigths="sparse")  # type: ignore[call-arg] # that is the point


@pytest.mark.parametrize("name", TASKS)
def test_weights_that_are_given_win(name: str) -> None:
    """A reward-free task with a weight for the overlap has that weight alone."""
    task = TASKS[name](weights="none", fractional_reward_weight=2.0)
    assert {n: w for n, w in task.weights.items() if w} == {"fractional_success": 2.0}
    assert not any(TASKS[name](weights="none").weights.values())


@pytest.mark.parametrize("name", TASKS)
def test_a_sparse_reward_has_no_other_terms(name: str) -> None:
    """It is 1 for success; further weights contradict it."""
    for options in ({"weights": "sparse"}, {"activate_sparse_reward": True}):
        task = TASKS[name](**options)  # type: ignore[arg-type] # options by name
        assert {n: w for n, w in task.weights.items() if w} == {"success": 1.0}
        with pytest.raises(UnknownOption, match="sparse"):
            TASKS[name](**options, fractional_reward_weight=1.0)  # type: ignore[arg-type]


@pytest.mark.parametrize("weight", [float("nan"), float("inf"), "much", None, [1.0]])
def test_a_weight_is_a_finite_number(weight: object) -> None:
    """Else every reward would be NaN."""
    for options in ({"weights": {"fractional_success": weight}}, {"weights": {"success": weight}}):
        with pytest.raises(UnknownOption, match="finite number"):
            TASKS["pushing"](**options)  # type: ignore[arg-type] # that is the point
    with pytest.raises(UnknownOption, match="weights cannot be 5"):
        TASKS["pushing"](weights=5)  # type: ignore[arg-type] # that is the point


@pytest.mark.parametrize(
    ("name", "option", "value"),
    [
        ("pushing", "tool_block_position", None),
        ("pushing", "tool_block_position", "abc"),
        ("pushing", "tool_block_position", 5),
        ("pushing", "tool_block_mass", (0.1, 0.2)),
        ("pushing", "goal_block_orientation", "up"),
        ("pushing", "joint_positions", 1.0),
        ("pushing", "joint_positions", [[0.0], [0.0, 1.0]]),
        ("picking", "goal_height", (0.1, 0.2)),
        ("towers", "tower_dims", 0.1),
        ("towers", "tower_center", 0.01),
        ("towers", "tool_block_mass", (1.0, 2.0)),
        ("towers", "number_of_blocks_in_tower", 3),
        ("general", "nums_objects", (2, 3)),
        ("stacked_blocks", "tool_block_mass", 100.0),
    ],
)
def test_an_argument_of_another_shape_is_refused(name: str, option: str, value: object) -> None:
    """With its name, when the task is made."""
    with pytest.raises(UnknownOption, match=option):
        TASKS[name](**{option: value})  # type: ignore[arg-type] # that is the point


def test_terms_may_come_from_an_iterator() -> None:
    """They are read once, and are there."""
    own = term("reward.h", lambda position: float(position[2]), ("tool_block.orientation",), "h")
    task = TASKS["pushing"](terms=iter([own]), weights={"reward.h": 2.0})  # type: ignore[call-arg]
    assert task.terms == (own,)
    assert task.weights["reward.h"] == 2.0


@pytest.mark.parametrize("count", [-1, 1.5, 20, "many", (1, 2)])
def test_obstacles_are_counted_in_whole_numbers(count: object) -> None:
    """As many as there are places for."""
    with pytest.raises(UnknownOption, match="number_of_obstacles"):
        TASKS["reaching"](number_of_obstacles=count)  # type: ignore[call-arg] # that is the point


def test_an_unknown_argument_is_answered_with_all_there_are() -> None:
    """Those of the family and those of every task, with the nearest name."""
    with pytest.raises(UnknownOption, match="did you mean 'tool_block_mass'") as refused:
        TASKS["pushing"](tool_mass=0.1)  # type: ignore[call-arg] # that is the point
    assert {"tool_block_position", "shape", "weights", "terms"} <= {*refused.value.choices}


@pytest.mark.parametrize("goal", ["x", [9, 9, 9], [0.0, 0.1]], ids=repr)
def test_a_goal_that_cannot_be_is_refused_by_its_name(goal: Any) -> None:
    """When the task is made."""
    with pytest.raises(UnknownOption, match="default_goal_60"):
        TASKS["reaching"](default_goal_60=goal)  # type: ignore[call-arg] # that is the point


def test_a_shape_is_a_hull() -> None:
    """A path is none: it has to be read."""
    with pytest.raises(ModelError, match="load_hull"):
        TASKS["pushing"](shape="cube.obj")  # type: ignore[call-arg] # that is the point


@pytest.mark.parametrize(
    ("term", "words"),
    [
        ("reward.x", "Measured"),
        (Measured(name="bonus", mechanism=Function(np.sum)), "begins with 'reward.'"),
        (Measured(name="reward.orientation", mechanism=Function(np.sum)), "new name"),
        (Measured(name="reward.x"), "with a mechanism"),
        (Measured(name="reward.x", shape=(2,), mechanism=Function(np.sum)), "of shape"),
    ],
    ids=["text", "prefix", "taken", "bare", "vector"],
)
def test_a_term_of_ones_own_is_a_number_with_a_name(term: Any, words: str) -> None:
    """Anything else is refused when the task is made."""
    with pytest.raises(UnknownOption, match=words):
        TASKS["pushing"](terms=[term])  # type: ignore[call-arg] # that is the point


def test_a_wall_of_no_blocks_is_one_problem() -> None:
    """The wall stays as it was."""
    world = Simulation("stacked_blocks", backend="fake")
    world.reset(seed=0)
    before = world["wall.layout"]
    with pytest.raises(InterventionError, match="at least one block"):
        world.do({"wall.layout": np.zeros_like(before)})
    np.testing.assert_array_equal(world["wall.layout"], before)


@pytest.mark.parametrize("task", ["pushing", "picking", "pick_and_place", "stacking2", "towers"])
@pytest.mark.parametrize("space", ["A", "B"])
def test_a_random_goal_can_be_fulfilled(task: str, space: SpaceName) -> None:
    """Fingers that would be in the way make room, and no goal lies in an obstacle."""
    world = Simulation(task, backend="fake")
    for seed in range(2 if task == "towers" else 8):
        world.reset(seed=seed, do=world.task.sample_goal(space))
        world.do(world.task.solution(world.values()))
        assert world["fractional_success"] > 0.99


def test_goals_are_drawn_outside_of_obstacles() -> None:
    """By hand they may be put anywhere; what is drawn can be filled."""
    world = Simulation(TASKS["pick_and_place"](), backend="fake")
    world.reset(seed=0, do={"goal_block.cartesian_position": [0.0, 0.0, 0.0325]})
    inside = Draw(Box((0.0, 0.0), (0.15, 1.5)))
    for seed in range(30):
        world.reset(seed=seed, do={"goal_block.polar": inside})
        assert world.composition.obstructed(world.scene(), {"goal_block.polar"}) == ()
    with pytest.raises(Infeasible, match="none of 1,000 draws"):
        world.reset(seed=0, do={"goal_block.polar": Draw(Box((0.0, 0.0), (0.001, 0.0)))})
    world.reset(seed=0, do={"goal_block.cartesian_position": [0.0, 0.0, 0.0325]})
    before = world["goal_block.cartesian_position"]
    world.do({"goal_block.color": Draw("B")})  # which moves no goal
    np.testing.assert_array_equal(world["goal_block.cartesian_position"], before)


def test_a_tilted_goal_rests_on_the_floor() -> None:
    """A box on its edge is higher than one on its side."""
    world = Simulation("pushing", backend="fake")
    world.reset(seed=0, do={"goal_block.euler_orientation": [np.pi / 4, 0.0, 0.3]})
    height = world["goal_block.cartesian_position"][2]
    turned = rotation_matrix(world["goal_block.orientation"])[2]
    assert height == pytest.approx(0.0325 * np.abs(turned).sum())
    assert height > 0.04


def turning(spin: Any) -> float:
    """Compute how fast a block turns, of 2 rad/s about the vertical, as a fraction."""
    return float(np.clip(abs(spin[2]) / 2.0, 0.0, 1.0))


SHORT = {"max_episode_length": 2}
SPIN = "tool_block.angular_velocity"


class Spinning(Pushing):
    """Turn the block; where it lies does not matter."""

    success = (turning, SPIN)


@pytest.mark.parametrize("backend", ["fake", "mujoco"])
def test_a_task_declares_its_own_success(backend: str) -> None:
    """A block on the goal is no success where it should turn, in one world and in many."""
    for task in (Spinning(), TASKS["pushing"](success=(turning, SPIN))):
        world = Simulation(task, backend=backend)
        world.reset(seed=0)
        world.do(world.task.solution(world.values()))
        assert (world["success"], world["fractional_success"]) == (0, 0.0)
        world.do({SPIN: [0.0, 0.0, 1.0]})
        assert (world["success"], float(world["fractional_success"])) == (0, 0.5)
        world.do({SPIN: [0.0, 0.0, 3.0]})
        assert (world["success"], world["fractional_success"]) == (1, 1.0)
        assert world.model.parents("fractional_success") == (SPIN,)
        world.close()
    envs = vector_env(2, task=Spinning(), backend=backend)
    envs.reset(seed=0)
    envs.do({1: {SPIN: [0.0, 0.0, 30.0]}})
    infos = envs.step(np.zeros((2, 9)))[-1]
    assert infos["is_success"].tolist() == [False, True]
    envs.close()
    assert evaluate("still", task=Spinning(), n=1, env=SHORT).score("P0").value == 0.0
    with pytest.raises(UnknownOption, match="goals do not decide"):
        ScmWorldEnv(Spinning(), backend=backend, goal_env=True)
    with pytest.raises(ModelError, match="give a function and the names of its parents"):
        Simulation(TASKS["reaching"](success=turning), backend=backend)
