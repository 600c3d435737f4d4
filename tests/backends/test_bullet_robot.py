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
from scm_world.backends.mujoco.reading import compiled
from scm_world.errors import EngineFailure, MissingEngine
from scm_world.models import Difference
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.hardware import SPINNING_FRICTION
from scm_world.tasks.trifinger.system import trifinger

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("pybullet") is None, reason="needs pybullet"
)


@pytest.fixture
def backend() -> Iterator[BulletBackend]:
    """Provide a backend without a scene."""
    backend = BulletBackend()
    yield backend
    backend.close()


# --- the robot in the engine ----------------------------------------------------------------------


def robot(backend: BulletBackend) -> tuple[Any, Any, tuple[str, ...]]:
    """Give the engine, the client that holds the last step, and the names of the bodies."""
    client = backend.client()
    return backend._engine, client, backend.structure.body_names


def test_links_are_where_kinematics_has_them(backend: BulletBackend) -> None:
    """The engine's link frames are those of the closed form."""
    scene = trifinger().default_scene()
    scene.state.joint_positions[:] = np.random.default_rng(0).uniform(-1, 1, 9)
    backend.build(scene)
    engine, client, names = robot(backend)
    positions, _ = robot_scenes.link_frames(scene.state.joint_positions)
    for finger, places in zip(hardware.FINGERS, positions.reshape(3, -1, 3), strict=True):
        for link in (1, 2, 3):
            place = client.bodies[names.index(hardware.link_name(finger, link))]
            state = engine.getLinkState(
                *place, computeForwardKinematics=1, physicsClientId=client.engine.handle
            )
            # The engine keeps the frames of links in single precision.
            np.testing.assert_allclose(state[4], places[link], atol=1e-6)


def test_every_link_has_its_inertia(backend: BulletBackend) -> None:
    """Moments, center and principal axes are those of the model."""
    backend.build(trifinger().default_scene())
    engine, client, names = robot(backend)
    for finger in hardware.FINGERS:
        for link in (1, 2, 3):
            place = client.bodies[names.index(hardware.link_name(finger, link))]
            info = engine.getDynamicsInfo(*place, physicsClientId=client.engine.handle)
            inertial, mass = hardware.INERTIAL[link], hardware.LINK_MASS[link]
            np.testing.assert_allclose(info[3], inertial.center, atol=1e-12)
            np.testing.assert_allclose(info[4], inertial.orientation, atol=1e-12)
            np.testing.assert_allclose(info[2], mass * np.array(inertial.per_mass), rtol=1e-12)


def test_frictions_reach_the_shapes(backend: BulletBackend) -> None:
    """Friction lands on the shapes of the robot, each of which is a link of its own."""
    backend.build(trifinger(("block",)).default_scene())
    backend.apply(Difference(parameters={("robot", "friction"): np.array(0.37)}))
    engine, client, _ = robot(backend)
    mj = compiled(backend.structure)
    owners = {geom: mj.geom(geom).name for geom in client.geoms}
    places = [client.geoms[g] for g, name in owners.items() if name[:2].isdigit()]
    assert len(places) == 12
    for place in places:  # compound shapes would make saved states inexact
        shapes = engine.getCollisionShapeData(*place, physicsClientId=client.engine.handle)
        info = engine.getDynamicsInfo(*place, physicsClientId=client.engine.handle)
        assert len(shapes) == 1
        assert info[1] == pytest.approx(0.37)
        assert info[5] == 0.0
        assert info[7] == 0.75 * SPINNING_FRICTION


def test_nothing_slows_a_flying_block(backend: BulletBackend) -> None:
    """Without gravity and contacts, velocities stay as they are to the last bit."""
    scene = trifinger(("block",)).default_scene()
    scene.state.positions[0] = [0.0, 0.0, 1.0]
    scene.state.linear_velocities[0] = [0.1, 0.2, 0.3]
    scene.state.angular_velocities[0] = [0.4, 0.0, 0.0]
    backend.build(scene)
    backend.apply(Difference(parameters={("world", "gravity"): np.zeros(3)}))
    backend.step(np.array(hardware.REST), 100)
    after = backend.read()
    np.testing.assert_array_equal(after.linear_velocities, scene.state.linear_velocities)
    np.testing.assert_allclose(after.angular_velocities, scene.state.angular_velocities, atol=1e-14)


# --- viscous joints ------------------------------------------------------------------------------


def test_a_driven_joint_reaches_its_final_speed(backend: BulletBackend) -> None:
    """With strong damping, the speed of a joint becomes torque over damping."""
    damping, torque = 0.5, 0.1
    scene = trifinger(torques=True).default_scene()
    values = {
        ("robot", "joint_damping"): np.array(damping),
        ("world", "gravity"): np.zeros(3),
        ("controller", "safety_damping"): np.zeros(3),
    }
    backend.build(scene.with_(parameters={**scene.parameters, **values}))
    backend.step(np.full(9, torque), 125)
    np.testing.assert_allclose(backend.read().joint_velocities, torque / damping, rtol=0.02)


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
    handle = backend.client().engine.handle
    assert engine.isConnected(handle)
    del backend
    assert not engine.isConnected(handle)


def test_a_backend_without_a_scene_says_so(backend: BulletBackend) -> None:
    """Using a backend before ``build``, or after ``close``, is an error with a hint."""
    for use in (
        backend.snapshot,
        backend.contacts,
        lambda: backend.read(trifinger().empty_state()),
    ):
        with pytest.raises(EngineFailure, match="call build"):
            use()
