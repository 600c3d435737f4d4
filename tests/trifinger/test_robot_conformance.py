"""The robot on every engine: the suite of backends, and what bodies and parameters do."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, ClassVar

import numpy as np
import pytest
from robot_scenes import STONE, another, apart_scene, busy_scene, changed_states, named, octahedron
from robot_scenes import other_value as other_parameter

from scm_world._types import ArrayLike, Floats
from scm_world.backends import Backend, make_backend
from scm_world.geometry.rotations import from_rotation_vector, rotation_matrix
from scm_world.models import Difference, ParameterKey, Parameters, Scene
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.hardware import FAST, PRECISE, Preset
from scm_world.tasks.trifinger.kinematics import forward, inverse
from scm_world.tasks.trifinger.system import PhysicalState, trifinger
from scm_world.testing.backend import BackendConformance, apart

HALF = 0.0325  # [m] of the default cube
FAR_UP = {("robot", "height"): np.array(1.5)}  # [m] where the robot touches nothing

LAW = ("position_gains", "velocity_gains", "safety_damping", "torque_limit")
Values = Mapping[ParameterKey, Floats]


class RobotConformance(BackendConformance):
    """The suite of backends with a busy scene of the robot, and facts about it.

    Facts about what acts, and in which direction, are empty without physics.

    Attributes:
        preset: Numerical settings.
    """

    preset: ClassVar[Preset] = FAST
    substeps = 10

    def busy(self) -> Scene:
        """Describe the busy scene."""
        return busy_scene(self.preset)

    def commands(self, structure: Any, steps: int, seed: int = 20_26) -> Floats:
        """Draw joint positions near the rest pose."""
        return hardware.REST + np.random.default_rng(seed).uniform(-0.3, 0.3, (steps, 9))

    def other_value(self, structure: Any, key: ParameterKey, value: Floats) -> Floats:
        """Return another possible value of a parameter."""
        return other_parameter(key, value)

    def changed_states(self, state: Any) -> Iterator[Any]:
        """Change one field of the state after the other."""
        for _, changed in changed_states(state):
            changed.orientations[changed.orientations[:, 3] < 0] *= -1
            yield changed

    def other_structures(self, scene: Scene) -> Iterable[Any]:
        """List what can become of the busy scene: blocks, obstacles, shapes, settings."""
        whole = scene.structure
        yield whole.with_(blocks=(*whole.blocks, "new"))
        yield trifinger(("sliding", "near"), self.preset)
        yield trifinger((), self.preset)
        yield whole.with_(obstacles=())
        yield whole.with_(obstacles=("new", *whole.obstacles))
        yield whole.with_(hulls=())
        yield whole.with_(hulls=(*whole.hulls, ("near", octahedron(0.04, 0.05, 0.03))))
        yield whole.with_(preset=another(self.preset))

    def test_a_body_that_touches_nothing_does_nothing(self, scene: Scene) -> None:
        """A block that rocks alone on a ledge has no effect on the others, nor they on it."""
        alone, others = np.r_[27:40], np.r_[0:27, 40:53]
        busy, leaks = apart_scene(self.preset), []
        with self.built(busy) as backend:
            room, steps = apart(backend, self.substeps)
            start = backend.snapshot()
            expected = self.play(backend, steps)
            for key, value in self.others(busy).items():
                if key[0] in ("world", "floor", "stage"):
                    continue
                untouched = others if key[0] in ("apart", "ledge") else alone
                backend.restore(start)
                backend.apply(Difference(parameters={key: value}))
                changed = self.play(backend, steps) - expected
                far = np.abs(changed) / np.maximum(1.0, np.abs(expected))
                if (far > room)[:, untouched].any():
                    leaks.append(key)
        assert leaks == []

    def test_all_but_colors_and_fixed_masses_acts(self, backend: Backend, scene: Scene) -> None:
        """Colors and the masses of fixed links have exactly no effect; all else moves something."""
        start = backend.snapshot()
        expected, wrong = self.continued(backend, start, steps=40), []
        for key, value in self.others(scene).items():
            idle = key[1] == "color" or key[0].endswith("link_0")
            backend.restore(start)
            backend.apply(Difference(parameters={key: value}))
            acts = not np.array_equal(self.play(backend, 40), expected)
            if acts if idle else backend.capabilities.physics and not acts:
                wrong.append(key)
        assert wrong == []

    @pytest.mark.parametrize("torques", [False, True])
    def test_the_control_law(self, backend: Backend, scene: Scene, torques: bool) -> None:
        """The torque of one physics step is the specified function of the state before it."""
        if not backend.capabilities.physics:
            return
        scene = scene.structure.with_(torques=torques).default_scene()
        backend.build(scene)
        self.check_control_law(backend, torques, scene.parameters)
        keys = [key for key in scene.parameters if key[0] == "controller"]
        other = {key: other_parameter(key, scene.parameters[key]) for key in keys}
        backend.apply(Difference(parameters=other))
        self.check_control_law(backend, torques, other)

    def check_control_law(self, backend: Backend, torques: bool, parameters: Parameters) -> None:
        """Compare many single steps with the law that these parameters specify."""
        generator = np.random.default_rng(5)
        law = {name: value for (_, name), value in parameters.items() if name in LAW}
        kp, kd, safety = (np.tile(law.get(name, 0.0), 3) for name in LAW[:3])
        limit = float(law["torque_limit"])
        saturated = 0
        for _ in range(100):
            state = backend.read()
            state.joint_positions[:] = hardware.REST + generator.uniform(-0.5, 0.5, 9)
            state.joint_velocities[:] = generator.normal(size=9, scale=3.0)
            state.positions[:, 2] = 2.0 + np.arange(len(state.blocks))
            command = state.joint_positions + generator.uniform(-0.1, 0.1, 9)
            if torques:
                command = generator.uniform(-0.5, 0.5, 9)
            wanted, speeds = command, state.joint_velocities.copy()
            if not torques:
                wanted = kp * (command - state.joint_positions) - kd * speeds
            expected = np.clip(np.clip(wanted, -limit, limit) - safety * speeds, -limit, limit)
            backend.apply(Difference(state=state))
            backend.step(command, 1)
            applied = backend.read().joint_torques
            np.testing.assert_allclose(applied, expected, rtol=0, atol=1e-12)
            saturated += int((np.abs(expected) == limit).sum())
        assert 0 < saturated < 900

    def test_contacts_carry_the_weight(self, scene: Scene) -> None:
        """A resting block touches the floor only, and the forces add up to its weight."""
        with self.built(trifinger(("block",), preset=self.preset).default_scene()) as backend:
            if not backend.capabilities.physics:
                assert backend.contacts() == ()
                return
            for _ in range(40):
                backend.step(np.array(hardware.REST), self.substeps)
            contacts = backend.contacts()
        assert {frozenset(contact.bodies) for contact in contacts} == {
            frozenset(("floor", "block"))
        }
        assert sum(contact.force for contact in contacts) == pytest.approx(0.02 * 9.81, rel=0.02)
        for contact in contacts:
            up = 1.0 if contact.bodies[0] == "floor" else -1.0
            np.testing.assert_allclose(contact.normal, [0, 0, up], atol=1e-6)
            assert abs(contact.position[2]) < 1e-3
            assert abs(contact.depth) < 1e-3

    def test_contacts_name_bodies(self, backend: Backend, scene: Scene) -> None:
        """Contacts name blocks, links, obstacles, floor and stage; normals have length one."""
        structure = scene.structure
        known = {*structure.blocks, *hardware.LINK_NAMES, *structure.obstacles, "floor", "stage"}
        seen: set[str] = set()
        for _ in range(300):
            backend.step(np.array(hardware.REST), 1)
            for contact in backend.contacts():
                seen |= set(contact.bodies)
                assert np.linalg.norm(contact.normal) == pytest.approx(1.0)
        assert seen <= known
        if backend.capabilities.physics:
            assert {*structure.blocks, *structure.obstacles, "floor", "stage"} <= seen

    def test_inertia_follows_mass_and_size(self, backend: Backend) -> None:
        """A block is a solid body, and the inertia of a link scales with its mass."""
        mass, size = np.array(0.04), np.array([0.03, 0.05, 0.08])
        link = hardware.link_name("120", 2)
        changes = {("near", "mass"): mass, ("near", "size"): size, (link, "mass"): np.array(0.3)}
        backend.apply(Difference(parameters={**changes, ("stone", "mass"): mass}))
        squares = size**2
        expected = mass / 12.0 * (squares.sum() - squares)
        np.testing.assert_allclose(
            backend.parameters([("near", "inertia")])["near", "inertia"], expected, rtol=1e-9
        )
        per_mass = np.array(hardware.INERTIAL[2].per_mass)
        np.testing.assert_allclose(
            backend.parameters([(link, "inertia")])[link, "inertia"], 0.3 * per_mass, rtol=1e-6
        )
        moments = mass * np.array(STONE.moments)
        np.testing.assert_allclose(
            backend.parameters([("stone", "inertia")])["stone", "inertia"], moments, rtol=1e-9
        )

    def test_a_new_block_moves_nothing(self, backend: Backend, scene: Scene) -> None:
        """When a block comes, the others keep their state and their parameters."""
        more = scene.structure.with_(blocks=(*scene.structure.blocks, "new"))
        backend.apply(Difference(parameters={("near", "mass"): np.array(0.05)}))
        before = backend.read()
        backend.apply(Difference(structure=more))
        assert backend.structure == more
        assert np.array_equal(backend.read().blocks[:-1], before.blocks)
        assert np.array_equal(backend.read().vector[:27], before.vector[:27])
        mass = backend.parameters([("near", "mass")])["near", "mass"]
        np.testing.assert_allclose(mass, 0.05, rtol=1e-12)

    def test_what_stays_keeps_its_parameters(self, backend: Backend, scene: Scene) -> None:
        """When an obstacle comes or another preset does, every other parameter stays."""
        other = {key: other_parameter(key, value) for key, value in scene.parameters.items()}
        backend.apply(Difference(parameters=other))
        before = backend.read()
        more = scene.structure.with_(obstacles=("new", "ledge"))
        for structure in (more, more.with_(preset=another(self.preset))):
            backend.apply(Difference(structure=structure))
            self.check_parameters(backend.parameters(other), other)
            assert np.array_equal(backend.read().settable(), before.settable())

    def test_orientations_stay_unit_quaternions(self, backend: Backend) -> None:
        """Orientations have length one and w >= 0 at every instant."""
        states = self.play(backend, 60)
        for vector in states:
            orientations = backend.read().with_vector(vector).orientations
            np.testing.assert_allclose(np.linalg.norm(orientations, axis=1), 1.0, atol=1e-9)
            assert (orientations[:, 3] >= 0).all()

    def test_either_sign_of_a_quaternion(self, backend: Backend) -> None:
        """A quaternion and its negative are one orientation."""
        start = backend.snapshot()
        *_, state = self.changed_states(backend.read())
        results = []
        for sign in (1.0, -1.0):
            backend.restore(start)
            turned = state.copy()
            turned.orientations[:] *= sign
            backend.apply(Difference(state=turned))
            assert (backend.read().orientations[:, 3] >= 0).all()
            results.append(self.play(backend, 10))
        assert np.array_equal(results[0], results[1])

    def test_what_touches_nothing_can_be_missing(self) -> None:
        """Without a block that nothing touches, the others move as before, but for rounding.

        An engine may sum in another order where there are fewer bodies.
        """
        scene = apart_scene(self.preset)
        with self.built(scene) as backend:
            expected = self.play(backend, 40)
            backend.build(scene)
            state = backend.read()
            fewer = trifinger(("near",), preset=self.preset)
            without = PhysicalState(fewer.layout, np.delete(state.vector, np.s_[27:40]))
            backend.apply(Difference(structure=fewer, state=without))
            others = np.delete(expected, np.s_[27:40], axis=1)
            np.testing.assert_allclose(self.play(backend, 40), others, rtol=0, atol=1e-7)

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
            rows.append(backend.read().vector)
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
        assert np.array_equal(*paths)

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
            moved.append(np.abs(backend.read().joint_positions - hardware.REST).sum())
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
                torques.append(backend.read().joint_torques.copy())
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
        state = backend.read()
        turned = np.array(STONE.vertices) @ rotation_matrix(state.orientations[0]).T
        heights = np.sort(state.positions[0, 2] + turned[:, 2])
        np.testing.assert_allclose(heights[:3], 0.0, atol=2e-3)
        assert heights[3] > 0.02
        weight = sum(contact.force for contact in backend.contacts())
        assert weight == pytest.approx(0.02 * 9.81, rel=0.05)


class TestMujocoFast(RobotConformance):
    """MuJoCo with large steps."""

    def make(self) -> Backend:
        """Create it."""
        return make_backend("mujoco")


class TestMujocoPrecise(TestMujocoFast):
    """MuJoCo with small steps."""

    preset: ClassVar[Preset] = PRECISE


@pytest.mark.skipif(importlib.util.find_spec("pybullet") is None, reason="needs pybullet")
class TestBullet(RobotConformance):
    """Bullet with large steps."""

    def make(self) -> Backend:
        """Create it."""
        return make_backend("bullet")


class TestFake(RobotConformance):
    """The backend without physics."""

    def make(self) -> Backend:
        """Create it."""
        return make_backend("fake")
