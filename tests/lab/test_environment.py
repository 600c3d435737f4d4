"""A laboratory as a Gymnasium environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from scm_world import lab
from scm_world.errors import Forbidden, UnknownOption
from scm_world.lab.environment import HIGH, LEAVE, LOW, RANDOM, LabEnv


def opened(kind: str = "effect", **setting: Any) -> LabEnv:
    """Return the registered environment."""
    env = gymnasium.make("scm_world/Lab-v0", kind=kind, **{"seeds": 2, **setting}).unwrapped
    assert isinstance(env, LabEnv)
    return env


@pytest.mark.parametrize("kind", ["effect", "graph"])
def test_gymnasium_checks_it(kind: str) -> None:
    """With its own checker; the observation says what was done."""
    env = opened(kind)
    check_env(env, skip_render_check=True)
    observation, info = env.reset(options={"question": 1})
    assert info == {"question": 1}
    n = len(env.action_space.nvec)
    assert not observation[: 3 * n].any()
    action = np.full(n, LEAVE)
    action[0], action[1] = HIGH, RANDOM
    observation, reward, *ends = env.step(action)
    assert (observation[n], observation[2 * n + 1], observation[:n].any()) == (1.0, 1.0, False)
    assert observation[-1] == pytest.approx(1.0 - 1.0 / env.experiments)
    assert (reward, ends) == (0.0, [False, False, {}])


def test_an_effect_is_estimated_from_what_the_agent_tried() -> None:
    """By hand: the same experiments with the tools, and the grade of the difference of means."""
    env = opened(experiments=2, n=50)
    env.reset(options={"question": 0})
    question = lab.question("effect", seed=0)
    room, query = lab.Laboratory(question), question.query
    names = [one["name"] for one in question.describe()["variables"]]
    action, means = np.full(len(names), LEAVE), []
    for how, end in ((LOW, "from"), (HIGH, "to")):
        action[names.index(query["cause"])] = how
        _, reward, terminated, _, info = env.step(action)
        table = room.experiment({query["cause"]: query[end]}, n=50)["columns"]
        means.append(np.mean(table[query["outcome"]]))
    assert terminated
    assert reward == info["score"] == pytest.approx(question.grade(means[1] - means[0]), abs=1e-6)
    with pytest.raises(Forbidden):
        env.step(action)


def test_information_beats_chance() -> None:
    """Whoever sets the cause that is asked for scores more than whoever sets anything."""
    env = opened(seeds=6, experiments=6, n=40)
    n, found = len(env.action_space.nvec), {"random": 0.0, "information": 0.0}
    env.action_space.seed(0)
    for name in found:
        for number in range(env.seeds):
            seen, _ = env.reset(options={"question": number})
            over, turn = False, 0
            while not over:
                action = np.zeros(n, int)
                action[int(np.argmax(seen[3 * n : 4 * n]))] = (LOW, HIGH)[turn % 2]
                chosen = env.action_space.sample() if name == "random" else action
                seen, reward, over, _, _ = env.step(chosen)
                turn += 1
            found[name] += reward / env.seeds
    assert found["information"] > found["random"] + 0.3


def test_wrong_arguments_are_refused() -> None:
    """And the episode is as before."""
    for wrong in (
        {"kind": "law"},
        {"world": "nowhere"},
        {"experiments": 10**6},
        {"n": 0},
        {"seeds": 0},
    ):
        with pytest.raises(UnknownOption):
            opened(**{"kind": "effect", **wrong})
    env = opened()
    n = len(env.action_space.nvec)
    with pytest.raises(Forbidden):
        env.step(np.zeros(n, int))
    seen, _ = env.reset(seed=0)
    for action in (np.zeros(n + 1, int), np.full(n, 9), np.full(n, np.nan)):
        with pytest.raises(UnknownOption):
            env.step(action)
    with pytest.raises(UnknownOption):
        env.reset(options={"question": 2})
    again, _ = opened().reset(seed=0)
    np.testing.assert_array_equal(seen, again)
