"""Many worlds at once, and many futures of one of them.

Run it with ``python examples/vector.py [mujoco|bullet]``.
"""

from __future__ import annotations

import sys
from typing import Any

import gymnasium
import numpy as np

import scm_world  # noqa: F401 # registers the environments

FRICTIONS = (0.3, 0.4, 0.6, 0.8)  # of the floor
SPEED = 0.3  # [m/s]
GRAVITY = 9.81  # [m/s²]


def main(backend: str = "mujoco") -> None:
    """Push in four worlds; then let four futures of the first one differ by the floor alone."""
    envs: Any = gymnasium.make_vec(
        "scm_world/Pushing-v0",
        num_envs=len(FRICTIONS),
        backend=backend,
        autoreset_mode="SameStep",
        max_episode_length=50,
        start={"tool_block.mass": "A"},  # drawn in each world by itself
    )
    envs.reset(seed=0)
    envs.action_space.seed(0)
    returns = np.zeros(envs.num_envs)
    for _ in range(50):
        _, rewards, _, _, infos = envs.step(envs.action_space.sample())
        returns += rewards
    print("returns of four worlds:", np.round(returns, 2))
    print("success at their ends: ", infos["final_info"]["is_success"])

    envs.branch(0)  # four times the first world, with its noise
    thrown = {"tool_block.linear_velocity": [SPEED, 0.0, 0.0]}
    envs.do([{"floor_friction": friction, **thrown} for friction in FRICTIONS])
    where = envs.get_attr("layout")[0]["tool_block.cartesian_position"]
    for _ in range(25):
        observations, *_ = envs.step(np.zeros((envs.num_envs, 9), dtype=np.float32))
    for friction, place in zip(FRICTIONS, observations[:, where], strict=True):
        expected = SPEED**2 / (2 * friction * GRAVITY)  # what friction leaves of the energy
        print(f"friction {friction}: slid {place[0]:.3f} m, Coulomb says {expected:.3f} m")
    envs.close()


if __name__ == "__main__":
    main(*sys.argv[1:2])
