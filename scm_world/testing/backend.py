"""A conformance suite for physics engines.

Subclass it in a test file, say how to make a backend, and pytest runs the rest::

    class TestMyEngine(BackendConformance):
        def make(self) -> Backend:
            return MyBackend()
"""

from __future__ import annotations

import hashlib
import pickle
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from scm_world._types import Floats
from scm_world.backends.base import Backend, EngineSnapshot
from scm_world.errors import EngineFailure, SnapshotMismatch
from scm_world.scene import trifinger
from scm_world.scene.controller import ControlMode
from scm_world.scene.difference import Difference
from scm_world.scene.presets import FAST, Preset
from scm_world.scene.scene import (
    ParameterKey,
    Parameters,
    Scene,
    Structure,
    default_scene,
    parameter_keys,
)
from scm_world.scene.state import PhysicalState

SUBSTEPS = 10
LONG = 250  # control steps

_SEED = 20_26


def busy_scene(preset: Preset = FAST) -> Scene:
    """Make a scene in which everything touches something sooner or later.

    One block stands before a finger, one falls askew on it, one slides into the ring.
    """
    scene = default_scene(Structure(("near", "falling", "sliding"), preset=preset))
    state = scene.state
    state.positions[:] = [[-0.06, 0.11, 0.0325], [-0.05, 0.1, 0.12], [-0.02, -0.13, 0.0325]]
    state.orientations[1] = np.array([0.1, -0.2, 0.3, 0.9]) / np.sqrt(0.95)
    state.linear_velocities[2] = [1.8, -0.2, 0.0]
    state.angular_velocities[1] = [0.5, -1.0, 2.0]
    state.joint_velocities[:] = np.linspace(-0.5, 0.5, 9)
    return scene


def apart_scene(preset: Preset = FAST) -> Scene:
    """Make a scene of a block that rocks alone, and of one that a finger pushes."""
    scene = default_scene(Structure(("apart", "near"), preset=preset))
    state = scene.state
    state.positions[:] = [[0.03, -0.05, 0.05], [-0.06, 0.11, 0.0325]]
    state.angular_velocities[0] = [1.0, -2.0, 0.5]
    return scene


def play(
    backend: Backend,
    steps: int,
    *,
    seed: int = _SEED,
    mode: ControlMode = ControlMode.JOINT_POSITIONS,
) -> Floats:
    """Give random commands near the rest pose.

    Returns:
        The state after each control step, shape (steps, 27 + 13 n).
    """
    generator = np.random.default_rng(seed)
    center = np.array(trifinger.REST) if mode is ControlMode.JOINT_POSITIONS else np.zeros(9)
    states = np.empty((steps, backend.state().vector.size))
    for row in states:
        command = center + generator.uniform(-0.3, 0.3, 9)
        backend.step(mode, command, SUBSTEPS)
        backend.read(PhysicalState(backend.n_blocks, row))
    return states


def digest(backend: Backend, preset: Preset) -> str:
    """Hash what the busy scene does for a while."""
    backend.build(busy_scene(preset))
    return hashlib.sha256(play(backend, 30).tobytes()).hexdigest()


def other_value(key: ParameterKey, value: Floats) -> Floats:
    """Give another possible value of a parameter."""
    match key[1]:
        case "gravity":
            return np.array([0.5, -0.3, -7.0])
        case "height":
            return np.asarray(value + 0.02)
        case "color":
            return np.array([0.2, 0.7, 0.4])
        case "size":
            return np.asarray(value * np.array([0.8, 0.9, 0.7]))
        case _:
            return np.asarray(value * 0.7)


def changed_states(state: PhysicalState) -> Iterator[tuple[str, PhysicalState]]:
    """Change one field of a state after the other."""
    generator = np.random.default_rng(3)
    for field in (
        "joint_positions",
        "joint_velocities",
        "positions",
        "orientations",
        "linear_velocities",
        "angular_velocities",
    ):
        changed = state.copy()
        values = getattr(changed, field)
        values += generator.normal(size=values.shape, scale=0.2)
        norms = np.linalg.norm(changed.orientations, axis=1, keepdims=True)
        changed.orientations[:] /= norms
        yield field, changed


def same(first: Floats, second: Floats) -> bool:
    """Compare two arrays bit for bit, but for the sign of zero."""
    return bool(np.array_equal(first, second))


class BackendConformance:
    """Every sentence of ``Backend``, as a test.

    Attributes:
        preset: Numerical settings under which the suite runs.
        long: Horizon of the longest comparison, in control steps.
    """

    preset: ClassVar[Preset] = FAST
    long: ClassVar[int] = LONG

    def make(self) -> Backend:
        """Create a backend without a scene."""
        raise NotImplementedError

    @pytest.fixture
    def scene(self) -> Scene:
        """Describe the busy scene."""
        return busy_scene(self.preset)

    @pytest.fixture
    def backend(self, scene: Scene) -> Iterator[Backend]:
        """Provide a backend in the middle of an episode."""
        with self.built(scene) as backend:
            play(backend, 2, seed=1)
            yield backend

    @contextmanager
    def built(self, scene: Scene) -> Iterator[Backend]:
        """Provide a new backend with a scene, and close it."""
        backend = self.make()
        backend.build(scene)
        try:
            yield backend
        finally:
            backend.close()

    def continued(self, backend: Backend, start: EngineSnapshot, steps: int = 10) -> Floats:
        """Go on from a snapshot."""
        backend.restore(start)
        return play(backend, steps)

    # --- build ---------------------------------------------------------------------------------

    def test_equal_scenes_continue_alike(self, scene: Scene) -> None:
        """Two backends with equal scenes move bit-identically."""
        with self.built(scene) as first, self.built(scene) as second:
            assert same(play(first, 40), play(second, 40))

    def test_building_forgets(self, backend: Backend, scene: Scene) -> None:
        """A used backend that is built again behaves like a new one."""
        other = {key: other_value(key, value) for key, value in scene.parameters.items()}
        backend.apply(Difference(parameters=other))
        play(backend, 3, mode=ControlMode.JOINT_TORQUES)
        backend.build(scene)
        again = play(backend, 20)
        backend.build(default_scene(Structure(("other",), preset=self.preset)))
        play(backend, 2)
        backend.build(scene)
        with self.built(scene) as fresh:
            expected = play(fresh, 20)
        assert same(again, expected)
        assert same(play(backend, 20), expected)

    def test_another_process_agrees(self) -> None:
        """A new process computes the same bits."""
        backend = self.make()
        code = (
            "import pickle, sys; from scm_world.testing.backend import digest;"
            "make, preset = pickle.load(sys.stdin.buffer); print(digest(make(), preset))"
        )
        child = subprocess.run(  # noqa: S603 # our own interpreter, our own code
            [sys.executable, "-c", code],
            input=pickle.dumps((type(backend), self.preset)),
            capture_output=True,
            check=True,
        )
        assert child.stdout.decode().split()[-1] == digest(backend, self.preset)
        backend.close()

    def test_no_torque_before_the_first_step(self, scene: Scene) -> None:
        """A scene begins without torques and without contacts."""
        with self.built(scene) as backend:
            assert same(backend.state().joint_torques, np.zeros(9))
            assert backend.contacts() == ()

    # --- apply: parameters ---------------------------------------------------------------------

    def test_every_parameter_is_read_back(self, backend: Backend, scene: Scene) -> None:
        """The engine reports each parameter as it was set."""
        keys = tuple(parameter_keys(scene.structure))
        check_parameters(backend.parameters(keys), scene.parameters)
        other = {key: other_value(key, scene.parameters[key]) for key in keys}
        backend.apply(Difference(parameters=other))
        check_parameters(backend.parameters(keys), other)

    def test_a_parameter_changes_nothing_else(self, backend: Backend, scene: Scene) -> None:
        """Setting one parameter leaves the state and every other parameter as they were."""
        keys = tuple(parameter_keys(scene.structure))
        state, before = backend.state(), backend.parameters(keys)
        for key in keys:
            backend.apply(Difference(parameters={key: other_value(key, before[key])}))
            now = backend.parameters(keys)
            assert [k for k in keys if k != key and not same(now[k], before[k])] == []
            assert backend.state() == state
            backend.apply(Difference(parameters={key: scene.parameters[key]}))

    def test_a_parameter_taken_back_leaves_no_trace(self, backend: Backend, scene: Scene) -> None:
        """Each parameter that is changed and restored has exactly no effect on the next step."""
        start = backend.snapshot()
        expected = self.continued(backend, start, 1)
        traces = []
        for key, value in scene.parameters.items():
            backend.restore(start)
            self.change_and_undo(backend, [key], scene.parameters)
            if not same(play(backend, 1), expected):
                traces.append(key)
            assert same(value, scene.parameters[key])
        assert traces == []

    def test_a_state_taken_back_leaves_no_trace(self, backend: Backend) -> None:
        """Each field of the state that is changed and restored has exactly no effect."""
        start, state = backend.snapshot(), backend.state()
        expected = self.continued(backend, start, 1)
        traces = []
        for field, changed in changed_states(state):
            backend.restore(start)
            backend.apply(Difference(state=changed))
            backend.apply(Difference(state=state))
            if backend.state() != state or not same(play(backend, 1), expected):
                traces.append(field)
        assert traces == []

    def test_changes_taken_back_leave_no_trace_for_long(
        self, backend: Backend, scene: Scene
    ) -> None:
        """All of these changes together have exactly no effect on a whole episode."""
        start, state = backend.snapshot(), backend.state()
        expected = self.continued(backend, start, self.long)
        backend.restore(start)
        self.change_and_undo(backend, scene.parameters, scene.parameters)
        for _, changed in changed_states(state):
            backend.apply(Difference(state=changed))
        backend.apply(Difference(state=state))
        assert same(play(backend, self.long), expected)

    def change_and_undo(
        self, backend: Backend, keys: Iterable[ParameterKey], parameters: Parameters
    ) -> None:
        """Set parameters to something else and back."""
        for key in keys:
            backend.apply(Difference(parameters={key: other_value(key, parameters[key])}))
            backend.apply(Difference(parameters={key: parameters[key]}))

    def test_the_order_of_changes_is_irrelevant(self, backend: Backend, scene: Scene) -> None:
        """All at once, one by one, in any order and with detours: the result is the same."""
        start = backend.snapshot()
        *_, (_, state) = changed_states(backend.state())
        state.positions[:, 2] += 0.1
        other = {key: other_value(key, value) for key, value in scene.parameters.items()}

        def at_once() -> None:
            backend.apply(Difference(parameters=other, state=state))

        def state_first() -> None:
            backend.apply(Difference(state=state))
            for key in sorted(other):
                backend.apply(Difference(parameters={key: other[key]}))

        def with_detours() -> None:
            for key in sorted(other, reverse=True):
                backend.apply(Difference(parameters={key: other[key] * 1.1}))
                backend.apply(Difference(parameters={key: other[key]}))
            for _, detour in changed_states(state):
                backend.apply(Difference(state=detour))
            backend.apply(Difference(state=state))

        results = []
        for path in (at_once, state_first, with_detours):
            backend.restore(start)
            path()
            results.append(play(backend, 20))
        assert same(results[0], results[1])
        assert same(results[0], results[2])

    def test_changes_equal_a_scene_built_so(self, scene: Scene) -> None:
        """Before the first step, changing a scene and building the changed one are the same."""
        other = {key: other_value(key, value) for key, value in scene.parameters.items()}
        *_, (_, state) = changed_states(scene.state)
        with (
            self.built(scene) as edited,
            self.built(scene.with_(parameters=other, state=state)) as new,
        ):
            edited.apply(Difference(parameters=other, state=state))
            assert edited.state() == new.state()
            assert same(play(edited, 20), play(new, 20))

    def test_colors_and_fixed_masses_do_nothing(self, backend: Backend, scene: Scene) -> None:
        """Colors and the masses of what cannot move have exactly no effect."""
        start = backend.snapshot()
        expected = self.continued(backend, start, 40)
        backend.restore(start)
        idle = {
            key: other_value(key, value)
            for key, value in scene.parameters.items()
            if key[1] == "color" or (key[1] == "mass" and key[0].endswith("link_0"))
        }
        backend.apply(Difference(parameters=idle))
        assert same(play(backend, 40), expected)

    def test_every_other_parameter_acts(self, backend: Backend, scene: Scene) -> None:
        """Each remaining parameter moves something."""
        if not backend.capabilities.physics:
            return
        start = backend.snapshot()
        expected = self.continued(backend, start, 40)
        silent = []
        for key, value in scene.parameters.items():
            if key[1] == "color" or key[0].endswith("link_0"):
                continue
            backend.restore(start)
            backend.apply(Difference(parameters={key: other_value(key, value)}))
            if same(play(backend, 40), expected):
                silent.append(key)
        assert silent == []

    def test_what_touches_nothing_does_nothing(self) -> None:
        """A block that nothing touches has exactly no effect on the others, nor they on it."""
        scene = apart_scene(self.preset)
        alone, others = np.r_[27:40], np.r_[0:27, 40:53]
        with self.built(scene) as backend:
            start = backend.snapshot()
            expected = play(backend, 40)
            leaks = []
            for key, value in scene.parameters.items():
                if key[0] in ("world", "floor", "stage"):
                    continue
                untouched = others if key[0] == "apart" else alone
                backend.restore(start)
                backend.apply(Difference(parameters={key: other_value(key, value)}))
                if not same(play(backend, 40)[:, untouched], expected[:, untouched]):
                    leaks.append(key)
        assert leaks == []

    def test_inertia_follows_mass_and_size(self, backend: Backend) -> None:
        """A block is a solid box, and the inertia of a link scales with its mass."""
        mass, size = np.array(0.04), np.array([0.03, 0.05, 0.08])
        link = trifinger.link_name("120", 2)
        changes = {("near", "mass"): mass, ("near", "size"): size, (link, "mass"): np.array(0.3)}
        backend.apply(Difference(parameters=changes))
        squares = size**2
        expected = mass / 12.0 * (squares.sum() - squares)
        np.testing.assert_allclose(backend.inertia("near"), expected, rtol=1e-9)
        per_mass = np.array(trifinger.INERTIAL[2].per_mass)
        np.testing.assert_allclose(backend.inertia(link), 0.3 * per_mass, rtol=1e-6)

    # --- apply: state --------------------------------------------------------------------------

    def test_a_state_is_read_back(self, backend: Backend) -> None:
        """The engine reports the state as it was set; torques are those of the last step."""
        torques = backend.state().joint_torques.copy()
        for field, changed in changed_states(backend.state()):
            changed.orientations[changed.orientations[:, 3] < 0] *= -1
            backend.apply(Difference(state=changed))
            read = backend.state()
            np.testing.assert_allclose(
                read.settable(), changed.settable(), rtol=0, atol=1e-12, err_msg=field
            )
            assert same(read.joint_torques, torques)

    def test_reading_and_writing_back_changes_nothing(self, backend: Backend) -> None:
        """Setting the state to what it is has exactly no effect."""
        start = backend.snapshot()
        expected = self.continued(backend, start, 20)
        backend.restore(start)
        backend.apply(Difference(state=backend.state()))
        assert same(play(backend, 20), expected)

    def test_either_sign_of_a_quaternion(self, backend: Backend) -> None:
        """A quaternion and its negative are one orientation."""
        start = backend.snapshot()
        *_, (_, state) = changed_states(backend.state())
        results = []
        for sign in (1.0, -1.0):
            backend.restore(start)
            turned = state.copy()
            turned.orientations[:] *= sign
            backend.apply(Difference(state=turned))
            assert (backend.state().orientations[:, 3] >= 0).all()
            results.append(play(backend, 10))
        assert same(*results)

    def test_orientations_stay_unit_quaternions(self, backend: Backend) -> None:
        """Orientations have length one and w >= 0 whatever happens."""
        states = play(backend, 60, mode=ControlMode.JOINT_TORQUES)
        for vector in states:
            orientations = PhysicalState(backend.n_blocks, vector).orientations
            np.testing.assert_allclose(np.linalg.norm(orientations, axis=1), 1.0, atol=1e-9)
            assert (orientations[:, 3] >= 0).all()

    # --- apply: structure ----------------------------------------------------------------------

    def test_a_new_block_moves_nothing(self, backend: Backend, scene: Scene) -> None:
        """When a block comes, the others keep their state and their parameters."""
        more = Structure((*scene.structure.blocks, "new"), preset=self.preset)
        backend.apply(Difference(parameters={("near", "mass"): np.array(0.05)}))
        before = backend.state()
        backend.apply(Difference(structure=more))
        assert backend.n_blocks == 4
        assert same(backend.state().blocks[:3], before.blocks)
        assert same(backend.state().vector[:27], before.vector[:27])
        mass = backend.parameters([("near", "mass")])["near", "mass"]
        np.testing.assert_allclose(mass, 0.05, rtol=1e-12)

    def test_a_block_that_comes_and_goes_leaves_no_trace(
        self, backend: Backend, scene: Scene
    ) -> None:
        """Adding or removing a block and taking it back has exactly no effect."""
        start, now = backend.snapshot(), backend.state()
        expected = self.continued(backend, start, 20)
        for blocks in (("near", "falling", "sliding", "new"), ("sliding", "near"), ()):
            backend.restore(start)
            backend.apply(Difference(structure=Structure(blocks, preset=self.preset)))
            backend.apply(Difference(scene.structure, scene.parameters, now))
            assert backend.state() == now
            assert same(play(backend, 20), expected)

    # --- snapshots -----------------------------------------------------------------------------

    def snapshots(self, backend: Backend, scene: Scene) -> Iterator[EngineSnapshot]:
        """Take snapshots in all kinds of moments."""
        yield backend.snapshot()
        other = {key: other_value(key, value) for key, value in scene.parameters.items()}
        backend.apply(Difference(parameters=other))
        yield backend.snapshot()
        *_, (_, state) = changed_states(backend.state())
        backend.apply(Difference(state=state))
        yield backend.snapshot()
        play(backend, 3, mode=ControlMode.JOINT_TORQUES)
        yield backend.snapshot()
        backend.apply(Difference(structure=Structure(("near", "new"), preset=self.preset)))
        yield backend.snapshot()

    def test_a_snapshot_continues_bit_for_bit(self, backend: Backend, scene: Scene) -> None:
        """From a snapshot, this, another and a pickled backend go on alike, again and again."""
        for snapshot in self.snapshots(backend, scene):
            state, touching = backend.state(), backend.contacts()
            bytes_ = pickle.dumps(snapshot)
            expected = play(backend, 15)
            backend.restore(snapshot)
            assert backend.state() == state
            assert [c.bodies for c in backend.contacts()] == [c.bodies for c in touching]
            assert same(play(backend, 15), expected)
            elsewhere = default_scene(Structure(("stranger",), preset=self.preset))
            with self.built(elsewhere) as other:
                play(other, 2)
                assert same(self.continued(other, pickle.loads(bytes_), 15), expected)  # noqa: S301
            backend.restore(snapshot)

    def test_a_snapshot_holds_the_parameters(self, backend: Backend, scene: Scene) -> None:
        """Restoring brings back the parameters of the snapshot."""
        keys = tuple(parameter_keys(scene.structure))
        start, before = backend.snapshot(), backend.parameters(keys)
        other = {key: other_value(key, value) for key, value in scene.parameters.items()}
        backend.apply(Difference(parameters=other))
        backend.restore(start)
        after = backend.parameters(keys)
        assert [key for key in keys if not same(after[key], before[key])] == []

    def test_a_snapshot_remembers_how_to_undo(self, backend: Backend) -> None:
        """A change that was made before a snapshot can be taken back after it, without a trace."""
        start, now = backend.snapshot(), backend.state()
        expected = self.continued(backend, start, 10)
        for _, changed in changed_states(now):
            backend.restore(start)
            backend.apply(Difference(state=changed))
            backend.restore(pickle.loads(pickle.dumps(backend.snapshot())))  # noqa: S301
            backend.apply(Difference(state=now))
            assert same(play(backend, 10), expected)

    def test_a_snapshot_does_not_disturb(self, backend: Backend) -> None:
        """Taking a snapshot has no effect on what comes."""
        start = backend.snapshot()
        expected = self.continued(backend, start, 10)
        backend.restore(start)
        for _ in range(3):
            backend.snapshot()
        assert same(play(backend, 10), expected)

    def test_snapshots_of_another_engine_are_refused(self, backend: Backend) -> None:
        """A snapshot of an engine that does not exist cannot be restored."""
        state = backend.state()
        with pytest.raises(SnapshotMismatch):
            backend.restore(EngineSnapshot("no engine 0", None))
        assert backend.state() == state

    # --- step and contacts ---------------------------------------------------------------------

    def test_two_backends_do_not_share_anything(self, scene: Scene) -> None:
        """Two backends that take turns move like each one alone."""
        heavy = {**scene.parameters, ("near", "mass"): np.array(0.09)}
        scenes = (scene, scene.with_(parameters=heavy))
        alone = []
        for each in scenes:
            with self.built(each) as backend:
                alone.append(play(backend, 20))
        with self.built(scenes[0]) as first, self.built(scenes[1]) as second:
            turns: list[list[Floats]] = [[], []]
            generator = np.random.default_rng(_SEED)
            for _ in range(20):
                command = np.array(trifinger.REST) + generator.uniform(-0.3, 0.3, 9)
                for backend, rows in zip((first, second), turns, strict=True):
                    backend.step(ControlMode.JOINT_POSITIONS, command, SUBSTEPS)
                    rows.append(backend.state().vector)
            assert same(np.array(turns[0]), alone[0])
            assert same(np.array(turns[1]), alone[1])

    @pytest.mark.parametrize("mode", list(ControlMode))
    def test_the_control_law(self, backend: Backend, scene: Scene, mode: ControlMode) -> None:
        """The torque of one physics step is the specified function of the state before it."""
        if not backend.capabilities.physics:
            return
        generator = np.random.default_rng(5)
        saturated = 0
        for _ in range(100):
            state = backend.state()
            state.joint_positions[:] = trifinger.REST + generator.uniform(-0.5, 0.5, 9)
            state.joint_velocities[:] = generator.normal(size=9, scale=3.0)
            state.positions[:, 2] = 2.0 + np.arange(3)
            command = state.joint_positions + generator.uniform(-0.1, 0.1, 9)
            if mode is ControlMode.JOINT_TORQUES:
                command = generator.uniform(-0.5, 0.5, 9)
            expected = scene.structure.controller.torques(
                mode, command, state.joint_positions, state.joint_velocities
            )
            backend.apply(Difference(state=state))
            backend.step(mode, command, 1)
            applied = backend.state().joint_torques
            np.testing.assert_allclose(applied, expected, rtol=0, atol=1e-12)
            saturated += int((np.abs(expected) == scene.structure.controller.limit).sum())
        assert 0 < saturated < 900

    def test_contacts_carry_the_weight(self, scene: Scene) -> None:
        """A resting block touches the floor only, and the forces add up to its weight."""
        with self.built(default_scene(Structure(("block",), preset=self.preset))) as backend:
            if not backend.capabilities.physics:
                assert backend.contacts() == ()
                return
            for _ in range(40):
                backend.step(ControlMode.JOINT_POSITIONS, np.array(trifinger.REST), SUBSTEPS)
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
        """Contacts name blocks, links, the floor and the stage; normals have length one."""
        known = {*scene.structure.blocks, *trifinger.LINK_NAMES, "floor", "stage"}
        seen: set[str] = set()
        for _ in range(300):
            backend.step(ControlMode.JOINT_POSITIONS, np.array(trifinger.REST), 1)
            for contact in backend.contacts():
                seen |= set(contact.bodies)
                assert np.linalg.norm(contact.normal) == pytest.approx(1.0)
        assert seen <= known
        if backend.capabilities.physics:
            assert {"near", "falling", "sliding", "floor", "stage"} <= seen

    def test_contacts_are_those_of_the_last_step(self, backend: Backend) -> None:
        """Moving a block away does not change what touched in the last step."""
        before = [contact.bodies for contact in backend.contacts()]
        state = backend.state()
        state.positions[:, 2] += 0.5
        backend.apply(Difference(state=state))
        assert [contact.bodies for contact in backend.contacts()] == before

    def test_an_explosion_is_an_error(
        self, backend: Backend, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """A state that is not finite is never returned."""
        monkeypatch.chdir(tmp_path)  # engines may write a log
        state = backend.state()
        state.linear_velocities[0] = np.inf
        with pytest.raises(EngineFailure):
            self.explode(backend, state)

    def explode(self, backend: Backend, state: PhysicalState) -> None:
        """Apply a state and go on."""
        backend.apply(Difference(state=state))
        play(backend, 1)

    def test_closing_twice(self, scene: Scene) -> None:
        """Closing a backend twice is harmless."""
        backend = self.make()
        backend.build(scene)
        backend.close()
        backend.close()


def check_parameters(actual: Parameters, expected: Parameters) -> None:
    """Compare parameters as engines keep them: colors with 32 bits or less."""
    assert set(actual) == set(expected)
    for key, value in expected.items():
        tolerance = 1e-6 if key[1] == "color" else 1e-12
        np.testing.assert_allclose(
            actual[key], value, rtol=0, atol=tolerance, err_msg=".".join(key)
        )
        assert actual[key].shape == value.shape


__all__ = [
    "BackendConformance",
    "apart_scene",
    "busy_scene",
    "changed_states",
    "digest",
    "other_value",
    "play",
]
