"""Facts about options that every task has."""

from __future__ import annotations

import pytest

from scm_world.errors import UnknownOption
from scm_world.tasks import TASKS, term


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
