"""One environment, three ways to look at it, and one intervention that only some of them show.

Run it with ``python examples/environments.py [mujoco|bullet]``.
"""

from __future__ import annotations

import sys
from typing import Any

import gymnasium
import numpy as np

import scm_world  # noqa: F401 # registers the environments

VIEWS: dict[str, dict[str, Any]] = {
    "structured": {},
    "structured + context": {"context": "observation"},
    "pixels": {"observation_mode": "pixel", "image_size": 64},
}


def main(backend: str = "mujoco") -> None:
    """Make the block heavier, then paint it, and see which observations notice."""
    for name, options in VIEWS.items():
        env: Any = gymnasium.make("scm_world/Pushing-v0", backend=backend, **options)
        seen = []
        for change in ({}, {"tool_block.mass": 0.09}, {"tool_block.color": [0.0, 0.0, 1.0]}):
            observation, _ = env.reset(seed=0, options={"do": change})
            seen.append(observation)
        plain, heavy, blue = seen
        print(f"{name:<21} shape {plain.shape!s:<16}", end="")
        print(f"mass seen: {np.any(plain != heavy)!s:<6} color seen: {np.any(plain != blue)}")
        env.close()

    env = gymnasium.make(
        "scm_world/Pushing-v0", backend=backend, action_mode="delta_joint_positions"
    )
    env.reset(seed=0)
    env.action_space.seed(0)
    total = sum(float(env.step(env.action_space.sample())[1]) for _ in range(25))
    print(f"a second of random motion earned {total:.2f}")


if __name__ == "__main__":
    main(*sys.argv[1:2])
