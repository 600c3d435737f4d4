"""A conformance suite for physics engines.

Subclass it in a test file, say how to make a backend, and pytest runs the rest::

    class TestMyEngine(BackendConformance):
        def make(self) -> Backend:
            return MyBackend()
"""

from __future__ import annotations

import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world._types import Floats
from scm_world.backends.base import Backend
from scm_world.errors import EngineFailure
from scm_world.models.scene import Difference, Parameters, Scene
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.hardware import controller_spec
from scm_world.tasks.trifinger.state import PhysicalState
from scm_world.tasks.trifinger.system import trifinger
from scm_world.testing.effects import EffectConformance
from scm_world.testing.parameters import ParameterConformance
from scm_world.testing.scenes import (
    SEED,
    SUBSTEPS,
    apart_scene,
    busy_scene,
    changed_states,
    digest,
    other_value,
    play,
    same,
)
from scm_world.testing.states import StateConformance
from scm_world.testing.together import TogetherConformance


class BackendConformance(
    ParameterConformance, StateConformance, EffectConformance, TogetherConformance
):
    """Every sentence of ``Backend``, as a test.

    Attributes:
        preset: Numerical settings under which the suite runs.
        long: Horizon of the longest comparison, in control steps.
    """

    def test_equal_scenes_continue_alike(self, scene: Scene) -> None:
        """Two backends with equal scenes move bit-identically."""
        with self.built(scene) as first, self.built(scene) as second:
            assert same(play(first, 40), play(second, 40))

    def test_building_forgets(self, backend: Backend, scene: Scene) -> None:
        """A used backend that is built again behaves like a new one."""
        other = {key: other_value(key, value) for key, value in scene.parameters.items()}
        backend.apply(Difference(parameters=other))
        play(backend, 3, torques=True)
        backend.build(scene)
        again = play(backend, 20)
        backend.build(trifinger(("other",), preset=self.preset).default_scene())
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
            generator = np.random.default_rng(SEED)
            for _ in range(20):
                command = np.array(hardware.REST) + generator.uniform(-0.3, 0.3, 9)
                for backend, rows in zip((first, second), turns, strict=True):
                    backend.step(command, SUBSTEPS)
                    rows.append(backend.state().vector)
            assert same(np.array(turns[0]), alone[0])
            assert same(np.array(turns[1]), alone[1])

    @pytest.mark.parametrize("torques", [False, True])
    def test_the_control_law(self, backend: Backend, scene: Scene, torques: bool) -> None:
        """The torque of one physics step is the specified function of the state before it."""
        if not backend.capabilities.physics:
            return
        system: Any = scene.structure
        scene = system.with_(torques=torques).default_scene()
        backend.build(scene)
        self.check_control_law(backend, torques, scene.parameters)
        keys = [key for key in scene.parameters if key[0] == "controller"]
        other = {key: other_value(key, scene.parameters[key]) for key in keys}
        backend.apply(Difference(parameters=other))
        self.check_control_law(backend, torques, other)

    def check_control_law(self, backend: Backend, torques: bool, parameters: Parameters) -> None:
        """Compare many single steps with the law that these parameters specify."""
        generator = np.random.default_rng(5)
        spec = controller_spec(parameters)
        saturated = 0
        for _ in range(100):
            state = backend.state()
            state.joint_positions[:] = hardware.REST + generator.uniform(-0.5, 0.5, 9)
            state.joint_velocities[:] = generator.normal(size=9, scale=3.0)
            state.positions[:, 2] = 2.0 + np.arange(len(state.blocks))
            command = state.joint_positions + generator.uniform(-0.1, 0.1, 9)
            if torques:
                command = generator.uniform(-0.5, 0.5, 9)
            expected = spec.torques(
                command, state.joint_positions, state.joint_velocities, direct=torques
            )
            backend.apply(Difference(state=state))
            backend.step(command, 1)
            applied = backend.state().joint_torques
            np.testing.assert_allclose(applied, expected, rtol=0, atol=1e-12)
            saturated += int((np.abs(expected) == spec.limit).sum())
        assert 0 < saturated < 900

    def test_contacts_carry_the_weight(self, scene: Scene) -> None:
        """A resting block touches the floor only, and the forces add up to its weight."""
        with self.built(trifinger(("block",), preset=self.preset).default_scene()) as backend:
            if not backend.capabilities.physics:
                assert backend.contacts() == ()
                return
            for _ in range(40):
                backend.step(np.array(hardware.REST), SUBSTEPS)
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
        """Apply a state and continue."""
        backend.apply(Difference(state=state))
        play(backend, 1)

    def test_closing_twice(self, scene: Scene) -> None:
        """Closing a backend twice is harmless."""
        backend = self.make()
        backend.build(scene)
        backend.close()
        backend.close()


__all__ = [
    "BackendConformance",
    "apart_scene",
    "busy_scene",
    "changed_states",
    "digest",
    "other_value",
    "play",
]
