"""A curriculum as a sentence: its effect from episode to episode, and how it is held out.

Run it with ``python examples/curricula.py [mujoco|bullet]``.
"""

from __future__ import annotations

import sys
from typing import Any

import gymnasium
import numpy as np

import scm_world  # noqa: F401 # registers the environments
from scm_world.curricula import (
    A,
    B,
    CurriculumEnv,
    Situation,
    at_step,
    during,
    goals,
    make_vec,
    resample,
    stages,
    together,
)

EASY_TO_HARD = stages(goals("A"), together(goals("A"), resample("*.mass", "A")), window=20)
TRAINING = A - "joint_positions"


def rougher(situation: Situation) -> dict[str, Any]:
    """Raise the friction from episode to episode, from 0.3 to 0.6."""
    return {"floor_friction": 0.3 + 0.1 * min(situation.episode, 3)}


SENTENCE = together(
    EASY_TO_HARD,
    rougher,
    during(range(2, 1_000), at_step(10, resample("tool_block.mass", "A"))),
)


def main(backend: str = "mujoco") -> None:
    """Play a few episodes, in one environment and in several, and hold masses out."""
    options: Any = {"backend": backend, "variables_space": TRAINING}  # all else is refused
    env: Any = CurriculumEnv(gymnasium.make("scm_world/Pushing-v0", **options), SENTENCE)
    for episode in range(4):
        env.reset(seed=0 if episode == 0 else None)
        for _ in range(12):
            env.step(np.zeros(9, np.float32))
        done = [f"step {step}: {', '.join(acts)}" for step, acts in env.unwrapped.interventions]
        print(f"episode {episode}: friction {env.unwrapped.world['floor_friction']:.2f}; {done}")
    evaluation = TRAINING.swap("*.mass", B)
    print(f"trained in {TRAINING}, evaluated in {evaluation}")

    envs = make_vec("scm_world/Pushing-v0", 2, SENTENCE, **options)
    print(f"two at once: observations of shape {envs.reset(seed=0)[0].shape}")
    envs.close()


if __name__ == "__main__":
    main(*sys.argv[1:2])
