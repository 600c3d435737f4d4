"""Agents that choose experiments: at random, by information, and trained.

``python examples/lab_agents.py --train 60000`` needs the extra ``train``. All agents have the same
six experiments with ten episodes each, and the same estimator answers for them. The questions of
the training have other seeds than those of the comparison.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

from scm_world.evaluation.statistics import mean_interval
from scm_world.lab.environment import HIGH, LOW, LabEnv

SETTING: dict[str, Any] = {"kind": "effect", "experiments": 6, "n": 10}
TRAINED_ON, COMPARED_ON = range(1000, 1064), range(40)


def opened(seeds: range) -> LabEnv:
    """Return the environment with the questions of some seeds."""
    made: Any = gymnasium.make("scm_world/Lab-v0", seeds=len(seeds), first=seeds[0], **SETTING)
    env: LabEnv = made.unwrapped
    return env


def informed(observation: np.ndarray, n: int) -> np.ndarray:
    """Set the cause that is asked for, where it was set less often.

    The variance of a difference of means is s² (1/n_low + 1/n_high): this choice reduces it most.
    """
    low, high, _, asked = observation[: 4 * n].reshape(4, n)
    cause, action = int(np.argmax(asked)), np.zeros(n, int)
    action[cause] = LOW if low[cause] <= high[cause] else HIGH
    return action


def scores(env: LabEnv, agent: Callable[[np.ndarray], Any]) -> list[float]:
    """Return the score of each question."""
    found = []
    for question in range(env.seeds):
        observation, _ = env.reset(seed=question, options={"question": question})
        is_over, reward = False, 0.0
        while not is_over:
            observation, reward, is_over, _, _ = env.step(agent(observation))
        found.append(reward)
    return found


def main(steps: int, compared: range = COMPARED_ON, trained_on: range = TRAINED_ON) -> None:
    """Print mean scores with intervals."""
    env = opened(compared)
    env.action_space.seed(0)
    n = len(env.action_space.nvec)
    agents: dict[str, Callable[[np.ndarray], Any]] = {
        "random": lambda _: env.action_space.sample(),
        "information": lambda observation: informed(observation, n),
    }
    if steps:
        from stable_baselines3 import PPO

        model = PPO("MlpPolicy", opened(trained_on), seed=0, device="cpu", ent_coef=0.01)
        model.learn(steps)
        agents["trained"] = lambda seen: model.predict(seen, deterministic=True)[0]
    for name, agent in agents.items():
        print(f"{name}: {mean_interval(scores(env, agent), proportion=True)}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--train", type=int, default=0, help="Steps of PPO; 0 for no training.")
    main(parser.parse_args().train)
