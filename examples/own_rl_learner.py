"""A custom learner for control: the cross-entropy method over a linear policy.

Many worlds with the same draws try as many weights; the best say where to look next (Rubinstein,
1999). It needs numpy alone. Run it with ``python examples/own_rl_learner.py [ITERATIONS [FILE]]``.
"""

import sys
import tempfile
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from scm_world.evaluation import evaluate
from scm_world.policies import save_policy
from scm_world.tasks import Reaching

GOALS = [f"goal_{finger}.cartesian_position" for finger in (60, 120, 300)]
SEEN = {"observation_mode": "custom", "observe": ["end_effector_positions", *GOALS]}
FORM = {**Reaching.training["env"], **SEEN}
LACK = np.hstack([-np.eye(9), np.eye(9)])  # from the observation to the distance that the tips lack
OWN = np.kron(np.eye(3), np.ones((3, 3)))  # a finger looks at its own tip only
WORLDS, ELITE, WIDTH = 32, 8, 5.0


def returns(envs: Any, gains: np.ndarray, seed: int) -> np.ndarray:
    """Play an episode in every world, each with its own matrix and all with the same draws."""
    seen, _ = envs.reset(seed=[seed] * envs.num_envs)
    total, done = np.zeros(envs.num_envs), np.zeros(envs.num_envs, bool)
    while not done.all():
        actions = np.einsum("nae,ne->na", gains, seen @ LACK.T)
        seen, rewards, _, done, _ = envs.step(np.clip(actions, -1.0, 1.0).astype(np.float32))
        total += rewards
    return total


def main(iterations: str = "30", path: str = "") -> None:
    """Search, write the policy into a file, and evaluate the file."""
    play = {"random_goal": "A", "max_episode_length": 40, "autoreset_mode": "Disabled"}
    envs: Any = gymnasium.make_vec("scm_world/Reaching-v0", WORLDS, **FORM, **play)
    rng, mean, width = np.random.default_rng(0), np.zeros((9, 9)), WIDTH * OWN
    for iteration in range(int(iterations)):
        tried = mean + width * rng.normal(size=(WORLDS, 9, 9))
        found = returns(envs, tried, seed=iteration)
        best = tried[np.argsort(found)[-ELITE:]]
        mean, width = best.mean(axis=0), best.std(axis=0) + 0.02 * WIDTH * OWN
        print(f"{iteration}: returns {found.mean():.0f} on average, {found.max():.0f} at best")

    file = Path(path or Path(tempfile.mkdtemp()) / "linear.safetensors")
    layer = {"layers.0.weight": np.float32(mean @ LACK), "layers.0.bias": np.zeros(9, np.float32)}
    save_policy(file, layer, {"task": "reaching", "env": FORM, "card": {"learner": "CEM"}})
    result = evaluate({"mine": str(file), "still": "still"}, "P0,P5,P12", task="reaching", n=5)
    for protocol in result.protocols:
        print(f"{protocol}:", *(f"{a} {result.score(protocol, agent=a)}" for a in result.agents))
    print(f"the policy is in {file}")


if __name__ == "__main__":
    main(*sys.argv[1:])
