"""Many worlds at once, and many futures of one of them.

Run it with ``python examples/vector.py [mujoco|bullet]``.
"""

from __future__ import annotations

import sys
from typing import Any

import gymnasium
import numpy as np

import scm_world  # noqa: F401 # registers the environments

MASSES = (0.02, 0.04, 0.06, 0.09)  # [kg]


def main(backend: str = "mujoco") -> None:
    """Push in four worlds; then let four futures of the first one differ by a mass alone."""
    envs: Any = gymnasium.make_vec(
        "scm_world/Pushing-v0",
        num_envs=len(MASSES),
        backend=backend,
        autoreset_mode="SameStep",
        max_episode_length=50,
        start={"tool_block.mass": "A"},  # drawn in each world by itself
    )
    envs.reset(seed=0)
    envs.action_space.seed(0)
    returns = np.zeros(envs.num_envs)
    for _ in range(50):
        _, rewards, _, truncated, infos = envs.step(envs.action_space.sample())
        returns += rewards
    assert truncated.all()
    print("returns of four worlds:", np.round(returns, 2))
    print("how far they came:", infos["final_info"]["fractional_success"])

    envs.branch(0)  # four times the first world, with its noise
    thrown = {"tool_block.linear_velocity": [0.6, 0.0, 0.0]}
    envs.do([{"tool_block.mass": mass, **thrown} for mass in MASSES])
    where = envs.get_attr("layout")[0]["tool_block.cartesian_position"]
    for _ in range(25):
        observations, *_ = envs.step(np.zeros((envs.num_envs, 9), dtype=np.float32))
    for mass, place in zip(MASSES, observations[:, where], strict=True):
        print(f"a block of {mass:.2f} kg slid to x = {place[0]:.4f} m")
    envs.close()


if __name__ == "__main__":
    main(*sys.argv[1:2])
