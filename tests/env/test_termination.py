"""Episodes that end before their time, as a task of a user's own declares it."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from model_tasks import ANGLE, PLACE, Falling

from scm_world import World
from scm_world.curricula import CurriculumEnv
from scm_world.errors import FunctionFailure, ModelError
from scm_world.evaluation import evaluate
from scm_world.evaluation.episodes import unrelated
from scm_world.evaluation.recording import record
from scm_world.tasks import TASKS

MODEL = "scm_world/Model-v0"
PUSH = np.ones(1, np.float32)  # the cart reaches the end of its rail within the episode


class Leaning(Falling):
    """It ends where the pole leans, and has a success."""

    seconds, terminated, success = 1.0, (lambda angle: abs(angle) > 0.3, ANGLE), None
    start = {ANGLE: 0.0, PLACE: 0.0}  # noqa: RUF012


def played(env: Any) -> list[tuple[float, bool, bool]]:
    """Push until the episode is over."""
    env.reset(seed=0)
    found: list[tuple[float, bool, bool]] = []
    while not (found and any(found[-1][1:])):
        _, reward, terminated, truncated, _ = env.step(PUSH)
        found.append((float(reward), terminated, truncated))
    return found


def test_an_episode_ends_where_its_task_says_so() -> None:
    """In the step in which the condition holds for the first time, and by termination."""
    env = gymnasium.make(MODEL, model=Leaning())
    steps = played(env)
    assert steps[-1][1:] == (True, False)
    assert 1 < len(steps) < env.unwrapped.limit
    assert abs(env.unwrapped.world[ANGLE]) > 0.3


@pytest.mark.parametrize("workers", [1, 2])
def test_many_worlds_end_like_single_ones(workers: int) -> None:
    """Each kind gives the same flags and rewards, and begins the next episode."""
    alone = played(gymnasium.make(MODEL, model=Leaning()))
    envs: Any = gymnasium.make_vec(MODEL, num_envs=2, model=Leaning(), workers=workers)
    envs.reset(seed=0)
    for reward, terminated, truncated in alone:
        _, rewards, ends, cuts, _ = envs.step(np.ones((2, 1), np.float32))
        assert (rewards.tolist(), ends.tolist()) == ([reward] * 2, [terminated] * 2)
        assert cuts.tolist() == [truncated] * 2
    _, rewards, ends, _, _ = envs.step(np.ones((2, 1), np.float32))
    assert (rewards.tolist(), ends.tolist()) == ([0.0] * 2, [False] * 2)
    envs.close()


def test_a_rollout_of_a_world_goes_on_and_shows_when_it_ended() -> None:
    """So that all answers to one question are of one length."""
    steps = len(played(gymnasium.make(MODEL, model=Leaning())))
    world = World(Leaning())
    lived = world.rollout(lambda world: world.action_high, seed=0, steps=steps + 3)
    assert lived["terminated"].tolist().index(1) == steps
    assert len(lived["terminated"]) == steps + 4
    assert "terminated" in world.graph.children(ANGLE)


def test_evaluations_and_recordings_have_the_length_until_then() -> None:
    """Scores add up the rewards of the steps that there were."""
    steps = played(gymnasium.make(MODEL, model=Leaning()))
    found = evaluate(lambda _: PUSH, "P0", task=Leaning(), n=1)
    assert found.frame["steps"].tolist() == [len(steps)]
    assert found.score("P0", "return").value == pytest.approx(sum(one[0] for one in steps))
    made = record(lambda _: PUSH, gymnasium.make(MODEL, model=Leaning()), 2)
    for episode in made.episodes:
        assert episode.terminations.tolist() == [False] * (len(steps) - 1) + [True]
        assert not episode.truncations.any()


def test_a_curriculum_counts_episodes_that_end_early() -> None:
    """The next reset begins the next one."""
    env = CurriculumEnv(gymnasium.make(MODEL, model=Leaning()), {"pole.mass": 0.1})
    for number in range(3):
        assert env.state.episode == number
        played(env)


def test_what_ends_an_episode_matters_to_its_score() -> None:
    """A variable that acts on the end alone is no unrelated one."""
    ended = (lambda place: abs(place) > 0.01, PLACE)
    names = {}
    for key, terminated in (("yes", ended), ("no", None)):
        env = gymnasium.make(MODEL, model=Still(terminated=terminated)).unwrapped
        names[key] = unrelated(env, {"kind": "object"})
    assert "motor.gear" in names["no"]
    assert "motor.gear" not in names["yes"]


class Still(Falling):
    """Nothing that the motor acts on is observed or rewarded."""

    outcomes, observe = (), ("control_index",)
    reward, terminated, success = (lambda step: 1.0, "control_index"), None, None


def test_a_task_of_the_robot_takes_it_too() -> None:
    """As an option of every task, and as an attribute of a class."""
    lifted = (lambda height: height[2] > 0.0, "tool_block.cartesian_position")
    for task in (
        TASKS["pushing"](terminated=lifted),
        type("Mine", (TASKS["pushing"],), {"terminated": lifted})(),
    ):
        env = gymnasium.make("scm_world/Pushing-v0", task=task, backend="fake")
        env.reset(seed=0)
        assert env.step(env.action_space.sample())[2]
    assert "terminated" not in World("pushing", backend="fake").model


def test_what_fails_or_is_no_truth_value_is_named() -> None:
    """A condition that raises an error, or gives something else than 0 and 1."""
    for wrong, words in (
        (lambda _: {}["x"], "'terminated' raised KeyError"),
        (lambda _: 0.5, "gives 0.5"),
    ):
        env = gymnasium.make(MODEL, model=Falling(terminated=(wrong, PLACE)))
        with pytest.raises(FunctionFailure, match=words):
            env.reset(seed=0)
    with pytest.raises(ModelError, match="terminated=3 is not a declaration"):
        World(Falling(terminated=3))
