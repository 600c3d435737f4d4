"""Agents that choose experiments: at random, by information, and trained.

``python examples/lab_agents.py 40000`` trains one with PPO (extra ``train``). All agents have the
same six experiments with ten episodes each, and the same estimator answers for them. The questions
of the training have other seeds than those of the comparison.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

from scm_world.evaluation.statistics import mean_interval
from scm_world.lab.environment import HIGH, LOW, LabEnv

SETTING: dict[str, Any] = {"kind": "effect", "experiments": 6, "n": 10}
TRAINED_ON = range(1000, 1064)
PPO_SETTING: dict[str, Any] = {"ent_coef": 0.01, "gamma": 1.0, "n_steps": 1536, "batch_size": 256}
PPO_SETTING |= {"learning_rate": 1e-3}


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


def compare(steps: int = 0, n: int = 40) -> dict[str, list[float]]:
    """Return the score of each question by agent; one trains so many steps on other questions."""
    env = opened(range(n))
    env.action_space.seed(0)
    causes = len(env.action_space.nvec)
    agents: dict[str, Callable[[np.ndarray], Any]] = {
        "random": lambda _: env.action_space.sample(),
        "information": lambda observation: informed(observation, causes),
    }
    if steps:
        from stable_baselines3 import PPO

        model = PPO("MlpPolicy", opened(TRAINED_ON), seed=0, device="cpu", **PPO_SETTING)
        model.learn(steps)
        agents["trained"] = lambda seen: model.predict(seen, deterministic=True)[0]
    return {name: scores(env, agent) for name, agent in agents.items()}


def main(steps: str = "0", compared: str = "40") -> None:
    """Print mean scores with intervals."""
    for name, found in compare(int(steps), int(compared)).items():
        print(f"{name}: {mean_interval(found, proportion=True)}")


if __name__ == "__main__":
    main(*sys.argv[1:])
