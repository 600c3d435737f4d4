"""A backend of one's own: MuJoCo with slow motors, and what these cost a policy.

Run it with ``python examples/own_backend.py [EPISODES]``.
"""

from __future__ import annotations

import importlib.util
import sys

import gymnasium
import numpy as np

import scm_world  # noqa: F401 # registers the environments
from scm_world.backends import BackendWrapper, make_backend, register
from scm_world.evaluation import evaluate
from scm_world.scene.controller import ControlMode

AHEAD = 0.02  # [rad] how far ahead of its joint a motor is commanded at most


@register  # at the top level, so that other processes know it, too
class SlowMotors(BackendWrapper):
    """Commands are moved towards the joints; all else is as MuJoCo does it."""

    name = "slow_motors"

    def __init__(self) -> None:
        super().__init__(make_backend("mujoco"))

    def step(self, mode: ControlMode, command: np.ndarray, substeps: int) -> None:
        """Hold a command for some physics steps."""
        if mode is ControlMode.JOINT_POSITIONS:
            joints = self.state().joint_positions
            command = np.clip(command, joints - AHEAD, joints + AHEAD)
        super().step(mode, command, substeps)


def main(episodes: str = "4", length: str = "250") -> None:
    """Step it, hold it against the suite that every engine passes, and let it pick a block up."""
    for engine in ("mujoco", SlowMotors.name):
        env = gymnasium.make("scm_world/Pushing-v0", backend=engine)
        before, _ = env.reset(seed=0)
        after, *_ = env.step(np.ones(9, np.float32))
        moved = np.abs(after - before)[env.unwrapped.layout["joint_positions"]] * 3.3
        print(f"{engine}: joints moved by {moved.max():.2f} rad in a control step")

    if importlib.util.find_spec("pytest"):  # a part of it by hand; docs/extending.md has all of it
        from scm_world.testing.backend import BackendConformance
        from scm_world.testing.scenes import busy_scene

        suite = type("Suite", (BackendConformance,), {"make": lambda self: SlowMotors()})()
        suite.test_equal_scenes_continue_alike(busy_scene())
        suite.test_two_backends_do_not_share_anything(busy_scene())
        print("equal scenes continue bit for bit alike, also if two of them take turns")

    env_options = {"max_episode_length": int(length)}
    both = ("mujoco", SlowMotors.name)
    found = evaluate(
        "grasp", "P0,P5", task="picking", n=int(episodes), backend=both, env=env_options
    )
    for protocol in found.protocols:
        print(f"{protocol}: slow motors cost {found.gap(*both, protocol)} of fractional success")


if __name__ == "__main__":
    main(*sys.argv[1:])
