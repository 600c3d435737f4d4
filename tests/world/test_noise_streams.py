"""Which numbers the noise of a control step is made of."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from scm_world.world import Simulation

PUSH = np.full(9, 0.1)


def joints(world: Simulation, steps: int = 2) -> np.ndarray:
    """Step, and give the joint positions."""
    for _ in range(steps):
        world.step(PUSH)
    return np.array(world["joint_positions"])


@pytest.mark.parametrize("backend", ["fake", "mujoco"])
def test_the_clock_does_not_choose_the_noise(backend: str) -> None:
    """Noise follows the steps that were taken, also after snapshots and in another world."""
    world = Simulation("pushing", backend=backend)
    world.reset(seed=0)
    world.do({"actuator_noise": 0.01})
    start = world.snapshot()
    expected = joints(world)
    world.restore(start)
    world.do({"control_index": 3})
    moved = pickle.loads(pickle.dumps(world.snapshot()))  # noqa: S301 # written above
    np.testing.assert_array_equal(joints(world), expected)
    assert world.index == 5
    other = Simulation("pushing", backend=backend)
    other.restore(moved)
    np.testing.assert_array_equal(joints(other), expected)
    world.restore(start)
    world.do({"control_index": 3})
    world.do({"control_index": 0})
    np.testing.assert_array_equal(joints(world), expected)
    world.restore(start)
    world.step(PUSH)
    later = joints(world, 1)
    assert (joints(world, 1) != later).any()  # each step has noise of its own
