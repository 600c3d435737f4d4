"""Facts about options that every task has."""

from __future__ import annotations

import pytest

from scm_world.errors import UnknownOption
from scm_world.tasks import TASKS


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
