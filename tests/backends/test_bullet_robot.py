"""Facts about the robot in Bullet, the control law, and the life of the engine."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import robot_scenes
from robot_scenes import busy_scene

from scm_world.backends.bullet import BulletBackend
from scm_world.errors import EngineFailure, MissingEngine
from scm_world.geometry.rotations import rotation_matrix
from scm_world.models import ControlMode, Difference
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.bullet import arena
from scm_world.tasks.trifinger.bullet.arena import PARTS, link_index
from scm_world.tasks.trifinger.bullet.client import compile_law
from scm_world.tasks.trifinger.bullet.passive import MASSES, inverse_dynamics, mass_matrix
from scm_world.tasks.trifinger.hardware import ControllerSpec
from scm_world.tasks.trifinger.kinematics import link_frames
from scm_world.tasks.trifinger.state import PhysicalState
from scm_world.tasks.trifinger.structure import SPINNING_FRICTION, TriFingerStructure, default_scene

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("pybullet") is None, reason="needs pybullet"
)

POSITIONS = ControlMode.JOINT_POSITIONS


@pytest.fixture
def backend() -> Iterator[BulletBackend]:
    """Provide a backend without a scene."""
    backend = BulletBackend()
    yield backend
    backend.close()


@pytest.mark.parametrize("mode", [POSITIONS, ControlMode.JOINT_TORQUES])
def test_the_law_in_plain_floats_is_the_law(mode: ControlMode) -> None:
    """The torques equal those of ``ControllerSpec`` to the last bit."""
    spec = ControllerSpec()
    law, generator = compile_law(spec, mode), np.random.default_rng(0)
    for _ in range(500):
        command, positions, velocities = generator.normal(size=(3, 9), scale=0.1)
        velocities *= 10
        states = list(zip(positions.tolist(), velocities.tolist(), strict=True))
        expected = spec.torques(mode, command, positions, velocities)
        assert law(states, command.tolist()) == expected.tolist()


# --- the robot in the engine ----------------------------------------------------------------------


def robot(backend: BulletBackend) -> tuple[Any, int, int]:
    """Give the engine, the client and the body of the robot."""
    client = backend._last()
    return backend._engine, client.handle, client.bodies.robot


def test_links_are_where_kinematics_has_them(backend: BulletBackend) -> None:
    """The engine's link frames are those of the closed form."""
    scene = default_scene(TriFingerStructure())
    scene.state.joint_positions[:] = np.random.default_rng(0).uniform(-1, 1, 9)
    backend.build(scene)
    engine, client, body = robot(backend)
    positions, _ = link_frames(scene.state.joint_positions, hardware.NOMINAL_HEIGHT)
    per_finger = positions.reshape(3, -1, 3)
    for finger in range(3):
        for link in range(per_finger.shape[1]):
            state = engine.getLinkState(
                body, link_index(finger, link), computeForwardKinematics=1, physicsClientId=client
            )
            # The engine keeps the frames of links in single precision.
            np.testing.assert_allclose(state[4], per_finger[finger, link], atol=1e-6)


def test_every_link_has_one_shape_and_its_inertia(backend: BulletBackend) -> None:
    """Compound shapes would make saved states inexact, so the tip is a link of its own."""
    backend.build(default_scene(TriFingerStructure()))
    engine, client, body = robot(backend)
    for finger in range(3):
        for link in range(5):
            index = link_index(finger, link)
            shapes = engine.getCollisionShapeData(body, index, physicsClientId=client)
            assert len(shapes) == (1 if link else 0)
            info = engine.getDynamicsInfo(body, index, physicsClientId=client)
            if link == 4:
                np.testing.assert_allclose(info[2], hardware.TIP_INERTIA, rtol=1e-12)
                continue
            inertial = hardware.INERTIAL[link]
            np.testing.assert_allclose(info[3], inertial.center, atol=1e-12)
            np.testing.assert_allclose(info[4], inertial.orientation, atol=1e-12)
            expected = hardware.LINK_MASS[link] * np.array(inertial.per_mass)
            np.testing.assert_allclose(info[2], expected, rtol=1e-12)


def test_frictions_reach_the_links(backend: BulletBackend) -> None:
    """Friction lands on the colliding links, not on the base; nothing damps or bounces."""
    backend.build(default_scene(TriFingerStructure()))
    backend.apply(Difference(parameters={("robot", "friction"): np.array(0.37)}))
    engine, client, body = robot(backend)
    for link in arena.COLLIDING_LINKS:
        info = engine.getDynamicsInfo(body, link, physicsClientId=client)
        assert info[1] == pytest.approx(0.37)
        assert info[5] == 0.0
        assert info[7] == 0.75 * SPINNING_FRICTION
    for joint in range(engine.getNumJoints(body, physicsClientId=client)):
        assert engine.getJointInfo(body, joint, physicsClientId=client)[6] == 0.0


def test_nothing_slows_a_flying_block(backend: BulletBackend) -> None:
    """Without gravity and contacts, velocities stay as they are to the last bit."""
    scene = default_scene(TriFingerStructure(("block",)))
    scene.state.positions[0] = [0.0, 0.0, 1.0]
    scene.state.linear_velocities[0] = [0.1, 0.2, 0.3]
    scene.state.angular_velocities[0] = [0.4, 0.0, 0.0]
    backend.build(scene)
    backend.apply(Difference(parameters={("world", "gravity"): np.zeros(3)}))
    backend.step(POSITIONS, np.array(hardware.REST), 100)
    after = backend.state()
    np.testing.assert_array_equal(after.linear_velocities, scene.state.linear_velocities)
    np.testing.assert_allclose(after.angular_velocities, scene.state.angular_velocities, atol=1e-14)


def test_who_may_touch_whom() -> None:
    """Links meet blocks, the other fingers and what stands around them, as specified."""
    bodies = {"block": (arena.BLOCK, -1), "floor": (arena.FLOOR, arena.FLOOR_MASK)}
    bodies["wall"] = (arena.WALL, arena.WALL_MASK)
    bodies["obstacle"] = (arena.OBSTACLE, arena.OBSTACLE_MASK)
    bodies |= {f"{part}{f}": arena.groups(f, part) for f in range(3) for part in PARTS}

    def meets(first: str, second: str) -> bool:
        (group, mask), (other_group, other_mask) = bodies[first], bodies[second]
        return bool(group & other_mask) and bool(other_group & mask)

    assert all(meets("block", other) for other in bodies)
    assert [part for part in PARTS if meets(f"{part}0", "floor")] == ["middle", "lower", "tip"]
    assert [part for part in PARTS if meets(f"{part}0", "obstacle")] == ["middle", "lower", "tip"]
    assert [part for part in PARTS if meets(f"{part}0", "wall")] == ["tip"]
    assert not any(meets("obstacle", other) for other in ("floor", "wall", "obstacle"))
    assert not any(meets(f"{a}0", f"{b}0") for a in PARTS for b in PARTS)
    for a in PARTS:
        for b in PARTS:
            assert meets(f"{a}0", f"{b}2") == ("upper" not in (a, b))


# --- viscous joints ------------------------------------------------------------------------------


def test_the_dynamics_of_a_finger_are_the_engines(backend: BulletBackend) -> None:
    """Mass matrix and bias in closed form equal those that the engine computes."""
    backend.build(default_scene(TriFingerStructure()))
    engine, client, body = robot(backend)
    generator, weights = np.random.default_rng(0), np.array(hardware.LINK_MASS[1:])
    for _ in range(10):
        angles, speeds = generator.uniform(-1, 1, 9), generator.normal(size=9, scale=5.0)
        matrix = engine.calculateMassMatrix(body, angles.tolist(), physicsClientId=client)
        bias = engine.calculateInverseDynamics(
            body, angles.tolist(), speeds.tolist(), [0.0] * 9, physicsClientId=client
        )
        for finger in range(3):
            own = slice(3 * finger, 3 * finger + 3)
            mine = mass_matrix(angles[own], weights)
            np.testing.assert_allclose(mine, np.array(matrix)[own, own], rtol=1e-12, atol=1e-16)
            gravity = (0.0, 0.0, -9.81)
            torques = inverse_dynamics(angles[own], speeds[own], np.zeros(3), gravity, weights)
            np.testing.assert_allclose(torques, bias[own], rtol=1e-9, atol=1e-12)


def test_a_damped_step_is_implicit(backend: BulletBackend) -> None:
    """The engine moves as the equations of an implicit step say, tilted and with other masses."""
    damping, gravity = 0.3, np.array([1.0, -2.0, -9.0])
    masses = np.linspace(0.02, 0.2, 9)
    scene = default_scene(TriFingerStructure())
    values = {
        ("robot", "joint_damping"): np.array(damping),
        ("world", "gravity"): gravity,
        ("controller", "safety_damping"): np.zeros(3),
        **dict(zip(MASSES, masses, strict=True)),
    }
    scene.state.joint_velocities[:] = np.linspace(-3.0, 3.0, 9)
    backend.build(scene.with_(parameters={**scene.parameters, **values}))
    command = np.linspace(-0.3, 0.3, 9)
    backend.step(ControlMode.JOINT_TORQUES, command, 1)
    after, before = backend.state(), scene.state
    np.testing.assert_array_equal(after.joint_torques, command)

    h = scene.structure.preset.timestep
    for finger in range(3):
        own = slice(3 * finger, 3 * finger + 3)
        angles, speeds = before.joint_positions[own], before.joint_velocities[own]
        yaw = hardware.WORLD_YAW + hardware.FINGER_YAW[finger]
        pull = rotation_matrix([0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)]).T @ gravity
        bias = inverse_dynamics(angles, speeds, np.zeros(3), tuple(pull), masses[own])
        inertia = mass_matrix(angles, masses[own]) + h * damping * np.eye(3)
        rates = np.linalg.solve(inertia, command[own] - bias - damping * speeds)
        # The engine integrates the bias with terms of higher order in the step.
        np.testing.assert_allclose(after.joint_velocities[own], speeds + h * rates, atol=1e-6)


def test_a_driven_joint_reaches_its_final_speed(backend: BulletBackend) -> None:
    """With strong damping, the speed of a joint becomes torque over damping."""
    damping, torque = 0.5, 0.1
    scene = default_scene(TriFingerStructure())
    values = {
        ("robot", "joint_damping"): np.array(damping),
        ("world", "gravity"): np.zeros(3),
        ("controller", "safety_damping"): np.zeros(3),
    }
    backend.build(scene.with_(parameters={**scene.parameters, **values}))
    backend.step(ControlMode.JOINT_TORQUES, np.full(9, torque), 125)
    np.testing.assert_allclose(backend.state().joint_velocities, torque / damping, rtol=0.02)


# --- life -----------------------------------------------------------------------------------------


def test_nothing_is_printed() -> None:
    """Importing us imports no engine; neither importing nor using it writes a word."""
    code = (
        f"import sys; sys.path.append({str(Path(robot_scenes.__file__).parent)!r});"
        "from scm_world.backends.bullet import BulletBackend;"
        "assert 'pybullet' not in sys.modules;"
        "from robot_scenes import busy_scene, play;"
        "b = BulletBackend(); b.build(busy_scene()); play(b, 2); b.close()"
    )
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)  # noqa: S603 # our own code
    assert (child.returncode, child.stdout, child.stderr) == (0, b"", b"")


def test_a_missing_engine_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without pybullet the error names the command, and where wheels exist."""
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(MissingEngine, match=r"Python < 3\.12.*pip install \"pybullet==3\.2\.7\""):
        BulletBackend()


def test_clients_are_given_back() -> None:
    """A backend that is dropped without being closed leaves no client behind."""
    backend = BulletBackend()
    engine = backend._engine
    backend.build(busy_scene())
    handle = backend._last().handle
    assert engine.isConnected(handle)
    del backend
    assert not engine.isConnected(handle)


def test_a_backend_without_a_scene_says_so(backend: BulletBackend) -> None:
    """Using a backend before ``build``, or after ``close``, is an error with a hint."""
    for use in (backend.snapshot, backend.contacts, lambda: backend.read(PhysicalState(0))):
        with pytest.raises(EngineFailure, match="call build"):
            use()
