"""What bodies and parameters do to what moves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from scm_world._types import ArrayLike, Floats
from scm_world.backends.base import Backend
from scm_world.geometry.rotations import from_rotation_vector, rotation_matrix
from scm_world.models.scene import ParameterKey, Scene
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.kinematics import forward, inverse
from scm_world.tasks.trifinger.system import trifinger
from scm_world.testing.scenes import STONE, Suite, named, same

HALF = 0.0325  # [m] of the default cube
FAR_UP = {("robot", "height"): np.array(1.5)}  # [m] where the robot touches nothing

Values = Mapping[ParameterKey, Floats]


class EffectConformance(Suite):
    """Sentences about what acts, and in which direction. They are empty without physics."""

    def arranged(self, structure: Any, values: Values, position: ArrayLike = ()) -> Scene:
        """Put one block somewhere, with some parameters."""
        scene = structure.default_scene()
        if structure.blocks:
            scene.state.positions[0] = position
        return scene.with_(parameters={**scene.parameters, **values})

    def watched(
        self, backend: Backend, scene: Scene, seconds: float, command: ArrayLike = hardware.REST
    ) -> Floats:
        """Hold a command and record the state after each physics step, shape (n, 27 + 13 n)."""
        backend.build(scene)
        rows = []
        for _ in range(round(seconds / self.preset.timestep)):
            backend.step(np.array(command, dtype=float), 1)
            rows.append(backend.state().vector)
        return np.array(rows)

    @pytest.mark.parametrize("away", ["", "position", "orientation"])
    def test_an_obstacle_stops_a_block(self, backend: Backend, away: str) -> None:
        """A sliding block stops at a wall, unless the wall is lifted or turned out of its way."""
        if not backend.capabilities.physics:
            return
        wall = {"size": [0.03, 0.3, 0.1], "position": [0.05, 0.1, 0.05]}
        changes: Mapping[str, ArrayLike] = {
            "position": [0.05, 0.1, 0.35],
            "orientation": from_rotation_vector([0.0, 0.0, np.pi / 2]),
        }
        moved = {away: changes[away]} if away else {}
        values = {
            **named("wall", {**wall, **moved}),
            **FAR_UP,
            ("floor", "friction"): np.array(0.05),
        }
        structure = trifinger(("block",), self.preset, obstacles=("wall",))
        scene = self.arranged(structure, values, [-0.08, 0.0, HALF])
        scene.state.linear_velocities[0] = [0.8, 0.0, 0.0]
        farthest = self.watched(backend, scene, 0.5)[:, 27].max()
        touch = 0.05 - 0.015 - HALF
        if away:
            assert farthest > 0.1
        else:
            assert touch - 1e-3 < farthest < touch + 0.01

    def test_an_obstacle_stops_fingers(self, backend: Backend) -> None:
        """Fingers that reach for something below a plate stay on the plate."""
        if not backend.capabilities.physics:
            return
        height = hardware.NOMINAL_HEIGHT
        tips = forward(np.array(hardware.REST), height).reshape(3, 3)
        low = inverse((tips - [0.0, 0.0, 0.05]).ravel(), height, np.array(hardware.REST))
        top = float(tips[:, 2].min()) - 0.02
        plate = named("plate", {"size": [0.4, 0.4, 0.01], "position": [0.0, 0.0, top - 0.005]})
        lowest = []
        for obstacles, values in (((), {}), (("plate",), plate)):
            scene = self.arranged(trifinger((), self.preset, obstacles), values)
            joints = self.watched(backend, scene, 0.6, low.joint_positions)[-1, :9]
            lowest.append(forward(joints, height).reshape(3, 3)[:, 2].min())
        radius = hardware.COLLISION["tip"].radius
        assert lowest[0] < top
        assert lowest[1] > top + radius - 3e-3

    def test_restitution_makes_bounce(self, backend: Backend) -> None:
        """A dropped block rises clearly where restitution is 0.6, and hardly where it is 0."""
        if not backend.capabilities.physics:
            return
        drop, risen = 0.15, []
        for restitution in (0.0, 0.6):
            values = {**FAR_UP, ("world", "restitution"): np.array(restitution)}
            structure = trifinger(("block",), self.preset)
            scene = self.arranged(structure, values, [0.0, 0.0, HALF + drop])
            heights = self.watched(backend, scene, 0.4)[:, 29]
            landed = int(np.argmax(heights <= HALF))
            assert landed > 0
            risen.append(heights[landed:].max() - HALF)
        assert risen[0] < 0.1 * drop
        assert 0.2 * drop < risen[1] < 0.55 * drop  # 0.36 without any error

    def test_spinning_friction_slows_a_spin(self, backend: Backend) -> None:
        """On a smooth floor a block goes on spinning for longer where spinning friction is less."""
        if not backend.capabilities.physics:
            return
        speeds = []
        for friction in (0.0002, 0.001, 0.01):
            smooth = {("floor", "friction"): np.array(0.01)}
            values = {**FAR_UP, **smooth, ("world", "spinning_friction"): np.array(friction)}
            scene = self.arranged(trifinger(("block",), self.preset), values, [0.0, 0.0, HALF])
            scene.state.angular_velocities[0] = [0.0, 0.0, 8.0]
            speeds.append(self.watched(backend, scene, 0.2)[-1, 39])
        assert speeds[0] > speeds[1] + 0.5
        assert speeds[1] > speeds[2] + 0.5

    @pytest.mark.parametrize("sliding", [0.0, 0.001, 0.003, 0.3])
    @pytest.mark.parametrize("spinning", [0.0, 0.005, 0.05, 0.1])
    def test_friction_only_slows_a_spin(
        self, backend: Backend, sliding: float, spinning: float
    ) -> None:
        """No pair of frictions makes a spinning block turn faster."""
        if not backend.capabilities.physics:
            return
        smooth = {("floor", "friction"): np.array(sliding)}
        values = {**FAR_UP, **smooth, ("world", "spinning_friction"): np.array(spinning)}
        scene = self.arranged(trifinger(("block",), self.preset), values, [0.0, 0.0, HALF])
        scene.state.angular_velocities[0] = [0.0, 0.0, 10.0]
        turns = np.abs(self.watched(backend, scene, 0.3)[:, 39])
        assert turns.max() <= 10.0 + 1e-9
        assert turns[-1] < 9.999 or not (sliding and spinning)

    @pytest.mark.parametrize("name", ["restitution", "spinning_friction"])
    def test_contacts_need_touch(self, backend: Backend, name: str) -> None:
        """What belongs to contacts has exactly no effect on a block in the air."""
        structure = trifinger(("block",), self.preset, obstacles=("post",))
        paths = []
        for value in (0.0, 0.3):
            values = {**FAR_UP, ("world", name): np.array(value)}
            scene = self.arranged(structure, values, [0.0, 0.0, 1.0])
            scene.state.angular_velocities[0] = [1.0, 2.0, 3.0]
            paths.append(self.watched(backend, scene, 0.2))
        assert same(*paths)

    def test_joint_damping_slows_fingers(self, backend: Backend) -> None:
        """Fingers that were pushed and are left alone move less where joints are damped more."""
        if not backend.capabilities.physics:
            return
        moved = []
        for damping in (0.0, 0.01, 0.03):
            damped = {("robot", "joint_damping"): np.array(damping)}
            values = {**FAR_UP, **damped, ("world", "gravity"): np.zeros(3)}
            scene = self.arranged(trifinger((), self.preset, torques=True), values)
            scene.state.joint_velocities[:] = 1.0
            backend.build(scene)
            backend.step(np.zeros(9), round(0.1 / self.preset.timestep))
            moved.append(np.abs(backend.state().joint_positions - hardware.REST).sum())
        assert moved[1] < 0.97 * moved[0]
        assert moved[2] < 0.9 * moved[1]

    def test_the_torque_limit_caps_torques(self, backend: Backend) -> None:
        """No torque exceeds the limit in either mode, and joints at rest reach it."""
        if not backend.capabilities.physics:
            return
        limit = {("controller", "torque_limit"): np.array(0.1)}
        reach = np.tile([-1.0, 0.5, 0.9], 3)
        for direct, command in ((True, reach), (False, hardware.REST + reach)):
            system = trifinger((), self.preset, torques=direct)
            backend.build(self.arranged(system, {**FAR_UP, **limit}))
            torques = []
            for _ in range(20):
                backend.step(command, 1)
                torques.append(backend.state().joint_torques.copy())
            np.testing.assert_allclose(np.abs(torques[0]), 0.1, rtol=1e-12)
            assert np.abs(torques).max() <= 0.1 * (1.0 + 1e-12)

    def test_a_hull_rests_on_a_side(self, backend: Backend) -> None:
        """A stone that was dropped lies on three of its corners, and floor forces carry it."""
        if not backend.capabilities.physics:
            return
        structure = trifinger(("stone",), self.preset, hulls=(("stone", STONE),))
        scene = self.arranged(structure, FAR_UP, [0.0, 0.0, 0.05])
        scene.state.orientations[0] = from_rotation_vector([0.3, 0.2, 0.0])
        scene.state.angular_velocities[0] = [1.0, 0.5, 0.0]
        self.watched(backend, scene, 3.0)
        state = backend.state()
        turned = np.array(STONE.vertices) @ rotation_matrix(state.orientations[0]).T
        heights = np.sort(state.positions[0, 2] + turned[:, 2])
        np.testing.assert_allclose(heights[:3], 0.0, atol=2e-3)
        assert heights[3] > 0.02
        weight = sum(contact.force for contact in backend.contacts())
        assert weight == pytest.approx(0.02 * 9.81, rel=0.05)
