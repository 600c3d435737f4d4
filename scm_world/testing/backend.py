"""A conformance suite for physics engines, on models from files.

Subclass it in a test file, return a new backend, and pytest runs the rest::

    class TestMyEngine(BackendConformance):
        def make(self) -> Backend:
            return MyBackend()

``model`` of a subclass is another MJCF text, or ``scene`` another scene.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import subprocess
import sys
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from scm_world._types import Floats
from scm_world.backends import Backend, EngineSnapshot, read_model
from scm_world.errors import EngineFailure, SnapshotMismatch
from scm_world.models import Difference, ParameterKey, Parameters, Scene, State
from scm_world.models.scene import RANGES

MODEL = """
<mujoco model="conformance">
  <option integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="9 9 1" friction="0.8"/>
    <body name="crate" pos="0 0 0.049">
      <freejoint/><geom name="crate" type="box" size="0.06 0.05 0.05" mass="0.4"/>
    </body>
    <body name="falling" pos="0.03 0.01 0.17" euler="10 20 30">
      <freejoint/><geom name="falling" type="box" size="0.04 0.05 0.03" mass="0.2"/>
    </body>
    <body name="apart" pos="3 0 0.1">
      <freejoint/><geom name="apart" type="sphere" size="0.1" mass="0.5"/>
    </body>
    <body name="upper" pos="0 0.25 0.3">
      <joint name="shoulder" axis="1 0 0" damping="0.1" range="-120 120" limited="true"/>
      <geom name="upper" type="capsule" fromto="0 0 0 0 0 -0.1" size="0.02" mass="0.2"/>
      <body name="fore" pos="0 0 -0.14">
        <joint name="elbow" axis="1 0 0" damping="0.05"/>
        <geom name="fore" type="capsule" fromto="0 0 0 0 -0.12 -0.03" size="0.02" mass="0.1"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="shoulder" kp="8" kv="0.5" ctrlrange="-1 1" ctrllimited="true"/>
    <motor name="motor" joint="elbow" gear="0.5" ctrlrange="-1 1" ctrllimited="true"/>
  </actuator>
</mujoco>
"""
"""An arm with a servo and a motor, two boxes that it reaches, and a ball that touches nothing."""

SUBSTEPS = 5
SEED = 20_26
COUNT = 4  # scenes of a batch


def same(first: Floats, second: Floats) -> bool:
    """Compare two arrays bit for bit, but for the sign of zero."""
    return bool(np.array_equal(first, second))


def play(backend: Backend, commands: Floats, substeps: int) -> Floats:
    """Give commands, shape (n, n_commands); return the state after each one."""
    rows = []
    for command in commands:
        backend.step(command, substeps)
        rows.append(backend.read().vector)
    return np.array(rows)


_ELSEWHERE = """
import hashlib, pickle, sys
sys.path[:] = {path!r}
from scm_world.testing.backend import play
make, scene, arguments = pickle.load(sys.stdin.buffer)
backend = make()
backend.build(scene)
print(hashlib.sha256(play(backend, *arguments).tobytes()).hexdigest())
"""


class BackendConformance(ABC):
    """Every promise of ``Backend``, as a test.

    Attributes:
        model: The model, an MJCF text.
        substeps: Physics steps of a control step.
        long: Horizon of the longest comparison, in control steps.
        apart: Prefix of the body that touches nothing.
        everywhere: Elements whose parameters act on all bodies.
    """

    model: ClassVar[str] = MODEL
    substeps: ClassVar[int] = SUBSTEPS
    long: ClassVar[int] = 250
    apart: ClassVar[str] = "apart"
    everywhere: ClassVar[tuple[str, ...]] = ("", "floor")

    @abstractmethod
    def make(self) -> Backend:
        """Create a backend without a scene."""

    # --- the scene; override these for another one ----------------------------------------------

    def busy(self) -> Scene:
        """Describe a scene in which bodies touch: the default one of the model."""
        model, backend = read_model(self.model), self.make()
        kept = tuple(
            row for row in model.parameters if backend.capabilities.supports(model, row.key)
        )
        backend.close()
        return replace(model, parameters=kept).default_scene()

    def commands(self, structure: Any, steps: int, seed: int = SEED) -> Floats:
        """Draw commands, shape (steps, n_commands)."""
        generator = np.random.default_rng(seed)
        return generator.uniform(-1.0, 1.0, (steps, structure.n_commands))

    def other_value(self, structure: Any, key: ParameterKey, value: Floats) -> Floats:
        """Return another possible value of a parameter."""
        row = next(row for row in structure.parameters if row.key == key)
        if row.kind == "rotation" or key[1] == "axis":
            turned = value + np.linspace(0.05, 0.1, value.size)
            return np.asarray(turned / np.linalg.norm(turned))
        if row.kind == "switch":
            return 1.0 - value
        if key[1] in RANGES:
            return 0.8 * value
        shift = np.where(value == 0.0, 0.01, 0.1 * np.abs(value))
        return np.where(
            value + shift <= row.high, value + shift, np.maximum(value - shift, row.low)
        )

    def changed_states(self, state: State) -> Iterator[State]:
        """Change one quantity of a state after the other."""
        generator = np.random.default_rng(3)
        changed = state.copy()
        for name in state:
            if name in state.layout.reported:
                continue
            values = changed[name]
            values += generator.normal(size=values.shape, scale=0.2)
            if name.endswith("orientation"):
                values /= np.linalg.norm(values)
            yield changed.copy()

    def other_structures(self, scene: Scene) -> Iterable[Any]:
        """List other structures that can take the place of the scene's."""
        text = self.model.replace('name="apart"', 'name="other"')
        return (read_model(text),)

    # --- helpers --------------------------------------------------------------------------------

    @pytest.fixture
    def scene(self) -> Scene:
        """Describe the scene."""
        return self.busy()

    @pytest.fixture
    def backend(self, scene: Scene) -> Iterator[Backend]:
        """Provide a backend in the middle of an episode."""
        with self.built(scene) as backend:
            self.play(backend, 2, seed=1)
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

    def play(self, backend: Backend, steps: int, seed: int = SEED) -> Floats:
        """Give random commands; return the state after each one."""
        commands = self.commands(backend.structure, steps, seed)
        return play(backend, commands, self.substeps)

    def continued(self, backend: Backend, start: EngineSnapshot, steps: int = 10) -> Floats:
        """Continue from a snapshot."""
        backend.restore(start)
        return self.play(backend, steps)

    def others(self, scene: Scene) -> dict[ParameterKey, Floats]:
        """Return another value of every parameter."""
        given = scene.parameters.items()
        return {key: self.other_value(scene.structure, key, value) for key, value in given}

    # --- scenes ---------------------------------------------------------------------------------

    def test_equal_scenes_continue_alike(self, scene: Scene) -> None:
        """Two backends with equal scenes move bit-identically."""
        with self.built(scene) as first, self.built(scene) as second:
            assert same(self.play(first, 40), self.play(second, 40))

    def test_building_forgets(self, backend: Backend, scene: Scene) -> None:
        """A used backend that is built again behaves like a new one."""
        with self.built(scene) as fresh:
            expected = self.play(fresh, 20)
        backend.apply(Difference(parameters=self.others(scene)))
        self.play(backend, 3)
        backend.build(scene)
        assert same(self.play(backend, 20), expected)
        for structure in self.other_structures(scene):
            backend.build(structure.default_scene())
            self.play(backend, 2)
            backend.build(scene)
            assert same(self.play(backend, 20), expected)

    def test_another_process_agrees(self, scene: Scene) -> None:
        """A new process computes the same bits."""
        arguments = self.commands(scene.structure, 30), self.substeps
        with self.built(scene) as backend:
            here = hashlib.sha256(play(backend, *arguments).tobytes()).hexdigest()
            child = subprocess.run(  # noqa: S603 # our own interpreter, our own code
                [sys.executable, "-c", _ELSEWHERE.format(path=[os.getcwd(), *sys.path])],
                input=pickle.dumps((type(backend), scene, arguments)),
                capture_output=True,
                check=True,
            )
        assert child.stdout.decode().split()[-1] == here

    def test_two_backends_do_not_share_anything(self, scene: Scene) -> None:
        """Two backends that take turns move like each one alone."""
        scenes = (scene, scene.with_(parameters=self.others(scene)))
        commands, alone = self.commands(scene.structure, 20), []
        for each in scenes:
            with self.built(each) as backend:
                alone.append(self.play(backend, 20))
        with self.built(scenes[0]) as first, self.built(scenes[1]) as second:
            for step, command in enumerate(commands):
                for backend, expected in zip((first, second), alone, strict=True):
                    found = play(backend, command[None], self.substeps)[0]
                    assert same(found, expected[step])

    def test_an_explosion_is_an_error(
        self, backend: Backend, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """A state that is not finite is never returned."""
        monkeypatch.chdir(tmp_path)  # engines may write a log
        with pytest.raises(EngineFailure):
            self.explode(backend, lambda: self.play(backend, 1))

    def explode(self, backend: Backend, advance: Any) -> None:
        """Set a velocity to infinity and continue."""
        state = backend.read()
        state.vector[np.flatnonzero(state.layout.can_be_set)[-1]] = np.inf
        backend.apply(Difference(state=state))
        advance()

    def test_closing_twice(self, scene: Scene) -> None:
        """Closing a backend twice is harmless."""
        backend = self.make()
        backend.build(scene)
        backend.close()
        backend.close()

    # --- contacts -------------------------------------------------------------------------------

    def test_a_scene_begins_without_contacts(self, scene: Scene) -> None:
        """Contacts are those of the last physics step: there are none before the first."""
        with self.built(scene) as backend:
            assert backend.contacts() == ()

    def test_contacts_are_those_of_the_last_step(self, backend: Backend) -> None:
        """They have unit normals, and a change of the state does not change them."""
        contacts = backend.contacts()
        assert bool(contacts) == backend.capabilities.physics
        for contact in contacts:
            assert np.linalg.norm(contact.normal) == pytest.approx(1.0)
        *_, changed = self.changed_states(backend.read())
        backend.apply(Difference(state=changed))
        assert [c.bodies for c in backend.contacts()] == [c.bodies for c in contacts]

    # --- parameters -----------------------------------------------------------------------------

    def test_every_parameter_is_read_back(self, backend: Backend, scene: Scene) -> None:
        """The engine reports each parameter as it was set, and a snapshot holds it."""
        self.check_parameters(backend.parameters(scene.parameters), scene.parameters)
        other = self.others(scene)
        start = backend.snapshot()
        backend.apply(Difference(parameters=other))
        self.check_parameters(backend.parameters(other), other)
        backend.restore(start)
        self.check_parameters(backend.parameters(other), scene.parameters)

    def check_parameters(self, actual: Parameters, expected: Parameters) -> None:
        """Compare parameters as engines keep them: colors with 32 bits or less."""
        assert set(actual) == set(expected)
        for key, value in expected.items():
            rough = key[1] in ("color", "rgba")
            name, tolerance = ".".join(key), 1e-6 if rough else 1e-12
            np.testing.assert_allclose(actual[key], value, rtol=0, atol=tolerance, err_msg=name)
            assert actual[key].shape == value.shape

    def test_a_parameter_changes_nothing_else(self, backend: Backend, scene: Scene) -> None:
        """Setting one parameter leaves the state and every other parameter as they were."""
        keys = tuple(scene.parameters)
        state, before = backend.read(), backend.parameters(keys)
        for key, value in self.others(scene).items():
            backend.apply(Difference(parameters={key: value}))
            now = backend.parameters(keys)
            assert [k for k in keys if k != key and not same(now[k], before[k])] == []
            assert backend.read() == state
            backend.apply(Difference(parameters={key: scene.parameters[key]}))

    def test_a_change_taken_back_leaves_no_trace(self, backend: Backend, scene: Scene) -> None:
        """Each parameter and state that is changed and restored has exactly no effect."""
        start, state = backend.snapshot(), backend.read()
        expected, traces = self.continued(backend, start, 2), []
        for key, value in self.others(scene).items():
            backend.restore(start)
            backend.apply(Difference(parameters={key: value}))
            backend.apply(Difference(parameters={key: scene.parameters[key]}))
            if not same(self.play(backend, 2), expected):
                traces.append(".".join(key))
        for number, changed in enumerate((state, *self.changed_states(state))):
            backend.restore(start)
            backend.apply(Difference(state=changed))
            backend.apply(Difference(state=state))
            if backend.read() != state or not same(self.play(backend, 2), expected):
                traces.append(f"state {number}")
        assert traces == []

    def test_changes_taken_back_leave_no_trace_for_long(
        self, backend: Backend, scene: Scene
    ) -> None:
        """All of these changes together have exactly no effect on a whole episode."""
        start, state = backend.snapshot(), backend.read()
        expected = self.continued(backend, start, self.long)
        backend.restore(start)
        for key, value in self.others(scene).items():
            backend.apply(Difference(parameters={key: value}))
        for changed in self.changed_states(state):
            backend.apply(Difference(state=changed))
        backend.apply(Difference(parameters=scene.parameters, state=state))
        assert same(self.play(backend, self.long), expected)

    def test_the_order_of_changes_is_irrelevant(self, backend: Backend, scene: Scene) -> None:
        """All together, one by one, and with detours: the result is the same."""
        start, other = backend.snapshot(), self.others(scene)
        *_, state = self.changed_states(backend.read())

        def at_once() -> None:
            backend.apply(Difference(parameters=other, state=state))

        def state_first() -> None:
            backend.apply(Difference(state=state))
            for key in sorted(other):
                backend.apply(Difference(parameters={key: other[key]}))

        def with_detours() -> None:
            for key in sorted(other, reverse=True):
                backend.apply(Difference(parameters={key: scene.parameters[key]}))
                backend.apply(Difference(parameters={key: other[key]}))
            for detour in self.changed_states(state):
                backend.apply(Difference(state=detour))
            backend.apply(Difference(state=state))

        results = []
        for path in (at_once, state_first, with_detours):
            backend.restore(start)
            path()
            results.append(self.play(backend, 20))
        assert same(results[0], results[1])
        assert same(results[0], results[2])

    def test_changes_equal_a_scene_built_so(self, scene: Scene) -> None:
        """Before the first step, changing a scene and building the changed one are the same."""
        other = self.others(scene)
        *_, state = self.changed_states(scene.state)
        changed = scene.with_(parameters=other, state=state)
        with self.built(scene) as edited, self.built(changed) as new:
            edited.apply(Difference(parameters=other, state=state))
            assert edited.read() == new.read()
            assert same(self.play(edited, 20), self.play(new, 20))

    def test_parameters_act_where_there_is_physics(self, backend: Backend, scene: Scene) -> None:
        """All of them together change the motion."""
        start = backend.snapshot()
        expected = self.continued(backend, start, 20)
        backend.restore(start)
        backend.apply(Difference(parameters=self.others(scene)))
        assert same(self.play(backend, 20), expected) != backend.capabilities.physics

    def test_a_body_that_touches_nothing_does_nothing(self, scene: Scene) -> None:
        """It has exactly no effect on the others, nor they on it."""
        slices, leaks = scene.state.layout.slices, []
        mine = np.zeros(scene.state.vector.size, dtype=bool)
        for name in slices:
            mine[slices[name]] = name.startswith(self.apart)
        with self.built(scene) as backend:
            start = backend.snapshot()
            expected = self.play(backend, 40)
            for key, value in self.others(scene).items():
                if key[0] in self.everywhere:
                    continue
                backend.restore(start)
                backend.apply(Difference(parameters={key: value}))
                untouched = ~mine if key[0].startswith(self.apart) else mine
                if not same(self.play(backend, 40)[:, untouched], expected[:, untouched]):
                    leaks.append(".".join(key))
        assert leaks == []

    # --- states and structures ------------------------------------------------------------------

    def test_a_state_is_read_back(self, backend: Backend) -> None:
        """The engine reports the state as it was set; what it reports stays that of the step."""
        before = backend.read()
        fixed = ~before.layout.can_be_set
        for changed in self.changed_states(before):
            backend.apply(Difference(state=changed))
            read = backend.read()
            np.testing.assert_allclose(read.settable(), changed.settable(), rtol=0, atol=1e-12)
            assert same(read.vector[fixed], before.vector[fixed])

    def test_bodies_that_come_and_go_leave_no_trace(self, backend: Backend, scene: Scene) -> None:
        """Changing the structure and taking it back has exactly no effect."""
        start, now = backend.snapshot(), backend.read()
        expected = self.continued(backend, start, 20)
        for structure in self.other_structures(scene):
            backend.restore(start)
            backend.apply(Difference(structure=structure))
            assert backend.structure == structure
            backend.apply(Difference(scene.structure, scene.parameters, now))
            assert backend.read() == now
            assert same(self.play(backend, 20), expected)

    # --- snapshots ------------------------------------------------------------------------------

    def snapshots(self, backend: Backend, scene: Scene) -> Iterator[EngineSnapshot]:
        """Take snapshots in all kinds of moments."""
        yield backend.snapshot()
        backend.apply(Difference(parameters=self.others(scene)))
        yield backend.snapshot()
        *_, state = self.changed_states(backend.read())
        backend.apply(Difference(state=state))
        yield backend.snapshot()
        self.play(backend, 3)
        yield backend.snapshot()
        for structure in self.other_structures(scene):
            backend.apply(Difference(structure=structure))
            yield backend.snapshot()

    def test_a_snapshot_continues_bit_for_bit(self, backend: Backend, scene: Scene) -> None:
        """From a snapshot, this, another and a pickled backend continue alike, repeatedly."""
        for snapshot in self.snapshots(backend, scene):
            state, touching = backend.read(), backend.contacts()
            assert backend.snapshot() is not snapshot  # another one does not disturb
            copy = pickle.loads(pickle.dumps(snapshot))  # noqa: S301 # our own
            expected = self.play(backend, 15)
            backend.apply(Difference(state=backend.read()))
            backend.restore(snapshot)
            assert backend.read() == state
            assert [c.bodies for c in backend.contacts()] == [c.bodies for c in touching]
            assert same(self.play(backend, 15), expected)
            with self.built(scene) as other:
                self.play(other, 2)
                assert same(self.continued(other, copy, 15), expected)
            backend.restore(snapshot)

    def test_a_snapshot_remembers_how_to_undo(self, backend: Backend) -> None:
        """A change that was made before a snapshot can be taken back after it, without a trace."""
        start, now = backend.snapshot(), backend.read()
        expected = self.continued(backend, start, 10)
        for changed in self.changed_states(now):
            backend.restore(start)
            backend.apply(Difference(state=changed))
            backend.restore(pickle.loads(pickle.dumps(backend.snapshot())))  # noqa: S301
            backend.apply(Difference(state=now))
            assert same(self.play(backend, 10), expected)

    def test_snapshots_of_another_engine_are_refused(self, backend: Backend) -> None:
        """A snapshot of an engine that does not exist cannot be restored."""
        state = backend.read()
        with pytest.raises(SnapshotMismatch):
            backend.restore(EngineSnapshot("no engine 0", None))
        assert backend.read() == state

    # --- batches --------------------------------------------------------------------------------

    @pytest.fixture
    def twice(self, scene: Scene) -> Iterator[tuple[list[Backend], list[Backend]]]:
        """Provide scenes that differ in a parameter each, two of each kind."""
        other = list(self.others(scene).items())
        with ExitStack() as stack:

            def several() -> list[Backend]:
                scenes = [
                    scene.with_(parameters={**scene.parameters, **dict(other[:number])})
                    for number in range(COUNT)
                ]
                return [stack.enter_context(self.built(one)) for one in scenes]

            yield several(), several()

    @pytest.mark.parametrize("threads", [1, 2, 4])
    def test_a_batch_is_one_after_another(
        self, twice: tuple[list[Backend], list[Backend]], threads: int
    ) -> None:
        """Scenes that are stepped together do, bit for bit, what they do alone.

        Between two steps each can be read, changed, saved, restored and stepped by itself.
        """
        alone, many = twice
        batch = type(many[0]).batch(many, threads)
        into = _table(many)
        saved = [(one.snapshot(), other.snapshot()) for one, other in zip(alone, many, strict=True)]
        commands = self.commands(many[0].structure, 8 * COUNT).reshape(8, COUNT, -1)
        for step, rows in enumerate(commands):
            which = np.arange(COUNT) if step % 3 else np.array([0, 2])
            batch.step(which, rows, self.substeps, into)
            for index in which.tolist():
                play(alone[index], rows[index][None], self.substeps)
                vector = alone[index].read().vector
                np.testing.assert_array_equal(into[index, : vector.size], vector)
            for number, backends in enumerate((alone, many)):
                self._change_one(backends[1], step, saved[1][number])
            for one, other in zip(alone, many, strict=True):
                np.testing.assert_array_equal(other.read().vector, one.read().vector)
            first, second = alone[step % COUNT].contacts(), many[step % COUNT].contacts()
            assert [(c.bodies, c.force) for c in first] == [(c.bodies, c.force) for c in second]

    def _change_one(self, backend: Backend, step: int, start: EngineSnapshot) -> None:
        """Change one of the scenes by itself, each time in another way."""
        match step % 4:
            case 0:
                *_, state = self.changed_states(backend.read())
                backend.apply(Difference(state=state))
            case 1:
                self.play(backend, 1)
            case 2:
                for structure in self.other_structures(Scene(backend.structure, {}, None)):
                    if structure.layout.size <= backend.structure.layout.size:
                        backend.apply(Difference(structure=structure))
            case _:
                backend.restore(start)

    def test_an_explosion_in_a_batch_is_an_error(
        self,
        twice: tuple[list[Backend], list[Backend]],
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        """A state that is not finite is never returned from a batch."""
        monkeypatch.chdir(tmp_path)  # engines may write a log
        _, many = twice
        batch = type(many[0]).batch(many, 2)
        rows = self.commands(many[0].structure, COUNT)
        with pytest.raises(EngineFailure):
            self.explode(
                many[1],
                lambda: batch.step(np.arange(COUNT), rows, self.substeps, _table(many)),
            )


def _table(backends: list[Backend]) -> Floats:
    width = max(backend.structure.layout.size for backend in backends)
    return np.full((len(backends), width), np.nan)


__all__ = ["MODEL", "BackendConformance", "play", "same"]
