"""The TriFinger Pro, through the interface of the real robot, plays policies."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from scm_world import World
from scm_world.errors import EngineFailure, MissingEngine, UnknownOption
from scm_world.tasks.trifinger.grasping import Feedback
from scm_world.tasks.trifinger.kinematics import forward
from scm_world.tasks.trifinger.platform import TriFingerPlatform, turned

HERE = importlib.util.find_spec("trifinger_simulation") is not None
pytestmark = pytest.mark.filterwarnings("ignore")  # of gym and pinocchio, which it imports
needed = pytest.mark.skipif(not HERE, reason="the extra 'trifinger' is not installed")


@pytest.mark.skipif(HERE, reason="the extra 'trifinger' is installed")
def test_what_is_missing_is_said() -> None:
    """Without the extra the error says how to install it."""
    said = (
        "^the trifinger_platform engine is not installed; try: pip install 'scm-world.trifinger.'$"
    )
    with pytest.raises(MissingEngine, match=said):
        TriFingerPlatform()


@needed
def test_a_scripted_policy_pushes_the_cube() -> None:
    """The fingertips follow, and the cube is seen near where it was pushed."""
    with World("pushing", backend="trifinger_platform") as world:
        world.reset(seed=0)
        start, policy = world["tool_block.cartesian_position"], Feedback()
        for _ in range(110):
            world.step(policy(world))
        seen, cube = world["tool_block.cartesian_position"], world.backend._platform.cube
        assert np.linalg.norm(seen - start) > 0.05
        np.testing.assert_allclose(seen, turned(cube.get_state()[0], -1), atol=0.03)
        world.reset(seed=0)
        for _ in range(5):
            world.step(0.5 * (world.action_low + world.action_high))
        platform = world.backend._platform
        tips = np.array(platform.forward_kinematics(world.backend._joints)).ravel()
        ours = forward(world["joint_positions"], float(world["robot_height"]))
        np.testing.assert_allclose(
            np.linalg.norm(ours.reshape(3, 3)[:, :2], axis=1),
            np.linalg.norm(tips.reshape(3, 3)[:, :2], axis=1),
            atol=1e-3,
        )


@needed
def test_restoring_repeats_what_was_played() -> None:
    """Equal commands give equal bits: in another world, and from a snapshot on."""
    moved = []
    for _ in range(2):
        with World("pushing", backend="trifinger_platform") as world:
            world.reset(seed=1)
            action = 0.5 * (world.action_low + world.action_high)
            for _ in range(3):
                world.step(action)
            before = world.snapshot()
            for _ in range(3):
                world.step(world.action_low)
            after = world.vector.copy()
            world.restore(before)
            for _ in range(3):
                world.step(world.action_low)
            np.testing.assert_array_equal(world.vector, after)
            moved.append(after)
    np.testing.assert_array_equal(*moved)


@needed
def test_parameters_are_written_or_refused() -> None:
    """The mass is that of the engine afterwards; another size is refused, and nothing changes."""
    import pybullet

    with World("pushing", backend="trifinger_platform") as world:
        world.reset(seed=0)
        world.do({"tool_block.mass": 0.05, "position_gains": (15.0, 15.0, 9.0)})
        world.step(0.5 * (world.action_low + world.action_high))
        platform = world.backend._platform
        client, cube = platform.simfinger._pybullet_client_id, platform.cube._object_id
        assert pybullet.getDynamicsInfo(cube, -1, physicsClientId=client)[0] == 0.05
        assert platform.simfinger.position_gains[:3].tolist() == [15.0, 15.0, 9.0]
        before = world.vector.copy()
        with pytest.raises(UnknownOption, match="size"):
            world.do({"tool_block.size": (0.06, 0.06, 0.06)})
        np.testing.assert_array_equal(world.vector, before)
        assert world["tool_block.size"].tolist() == [0.065] * 3


@needed
def test_closing_disconnects() -> None:
    """No simulation is left: not of a world that is closed, and not of episodes before."""
    import pybullet

    with World("pushing", backend="trifinger_platform") as world:
        clients = set()
        for seed in range(2):
            world.reset(seed=seed)
            world.step(0.5 * (world.action_low + world.action_high))
            clients.add(world.backend._platform.simfinger._pybullet_client_id)
        assert len(clients) == 1  # numbers of clients that are gone are given again
    assert not any(pybullet.isConnected(physicsClientId=client) for client in clients)


@needed
def test_other_scenes_and_torques_are_refused() -> None:
    """There is one cube, and it takes joint positions."""
    with pytest.raises(UnknownOption, match="one cube"):
        World("stacking2", backend="trifinger_platform").reset(seed=0)
    with World("pushing", backend="trifinger_platform", action_mode="joint_torques") as world:
        world.reset(seed=0)
        with pytest.raises(EngineFailure, match="joint positions"):
            world.step(world.action_high)
