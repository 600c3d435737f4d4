"""A custom backend: MuJoCo with slow motors, and what these cost a policy.

Run it with ``python examples/own_backend.py [EPISODES]``.
"""

import importlib.util
import sys

import numpy as np

from scm_world import World
from scm_world.backends import BackendWrapper, make_backend, register
from scm_world.evaluation import evaluate

AHEAD = 0.02  # [rad] that a command is ahead of the joints, at most


@register  # at the top level, so that other processes know it, too
class SlowMotors(BackendWrapper):
    """Commands are moved towards the joints; all else is as MuJoCo does it."""

    name = "slow_motors"

    def __init__(self) -> None:
        super().__init__(make_backend("mujoco"))

    def step(self, command: np.ndarray, substeps: int) -> None:
        """Hold a command for some physics steps."""
        if "joint_positions" in self.structure.layout.names:  # a model of another kind has none
            joints = self.read()["joint_positions"]
            command = np.clip(command, joints - AHEAD, joints + AHEAD)
        super().step(command, substeps)


def main(episodes: str = "4", length: str = "250") -> None:
    """Step it, hold it against a part of the suite of engines, and let it pick a block up."""
    for engine in (both := ("mujoco", SlowMotors.name)):
        world = World("pushing", backend=engine)
        world.reset(seed=0)
        before = world["joint_positions"]
        world.step(before + 0.3)  # [rad]
        moved = np.abs(world["joint_positions"] - before).max()
        print(f"{engine}: joints moved by {moved:.2f} rad in a control step, towards 0.30 rad")
    if importlib.util.find_spec("pytest"):  # docs/extending.md has the whole suite
        from scm_world.testing.backend import BackendConformance

        suite = type("Suite", (BackendConformance,), {"make": lambda self: SlowMotors()})()
        suite.test_worlds_undo_exactly()
        print("setting a value and setting it back leaves no trace")
    how = {"backend": both, "env": {"max_episode_length": int(length)}}
    found = evaluate("feedback", "P0,P5", task="picking", n=int(episodes), **how)
    for protocol in found.protocols:
        cost = found.difference(*both, protocol)
        print(f"{protocol}: slow motors cost {cost} of fractional success")


if __name__ == "__main__":
    main(*sys.argv[1:])
