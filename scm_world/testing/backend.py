"""A conformance suite for physics engines, on models from files.

Subclass it in a test file, return a new backend, and pytest runs the rest::

    class TestMyEngine(BackendConformance):
        def make(self) -> Backend:
            return MyBackend()

``model`` of a subclass is another MJCF text, with a geom ``floor`` and a body ``apart`` that
touches nothing; ``busy`` returns a scene of another kind.
"""

from __future__ import annotations

import pickle
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from scm_world._types import Floats, Integers
from scm_world.backends import Backend, EngineSnapshot, Scenes, read_model
from scm_world.backends.base import ROUNDING
from scm_world.errors import EngineFailure, SnapshotMismatch, UnknownOption
from scm_world.models import (
    Difference,
    ParameterKey,
    Parameters,
    Scene,
    State,
    Structure,
)
from scm_world.queries import World
from scm_world.testing.model import SEED, check_undo, elsewhere

__all__ = ["BackendConformance"]

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

LONG = 250  # control steps of the longest comparison


def play(backend: Backend, commands: Floats, substeps: int) -> Floats:
    """Apply commands, shape (n, n_commands); return the state after each one."""
    rows = []
    for command in commands:
        backend.step(command, substeps)
        rows.append(backend.read().vector)
    return np.array(rows)


def played(kind: type[Backend], scene: Scene, commands: Floats, substeps: int) -> Floats:
    """Return the states of a new backend after each command."""
    with closing(kind()) as backend:
        backend.build(scene)
        return play(backend, commands, substeps)


def apart(backend: Backend, substeps: int) -> tuple[Floats, int]:
    """Return how far bodies that do not touch may move each state, and in how many control steps.

    That is zero, in any number, or what the engine says of one.
    """
    size, structure = backend.read().layout.size, backend.structure
    room = np.broadcast_to(backend.capabilities.rounding(backend, structure, substeps), (size,))
    return (room, 1) if room.max() > ROUNDING else (np.zeros(size), 40)


class BackendConformance(ABC):
    """Every promise of ``Backend``, as a test.

    Attributes:
        model: The model, an MJCF text.
        substeps: Physics steps of a control step.
    """

    model: ClassVar[str] = MODEL
    substeps: ClassVar[int] = 5

    @abstractmethod
    def make(self) -> Backend:
        """Create a backend without a scene."""

    # --- the scene; override these for another one ----------------------------------------------

    def busy(self) -> Scene:
        """Return a scene in which bodies touch: the default one of the model."""
        with closing(World(self.model, backend=self.make())) as world:
            return world.structure.default_scene()

    def commands(self, structure: Structure, steps: int, seed: int = SEED) -> Floats:
        """Draw commands, shape (steps, n_commands)."""
        return np.random.default_rng(seed).uniform(-1.0, 1.0, (steps, structure.n_commands))

    def other_value(self, structure: Structure, key: ParameterKey, value: Floats) -> Floats:
        """Return another possible value of a parameter."""
        row: Any = next(row for row in structure.parameters if row.key == key)
        if row.kind == "rotation" or key[1] == "axis":
            turned = value + np.linspace(0.05, 0.1, value.size)
            return np.asarray(turned / np.linalg.norm(turned))
        if row.kind == "switch":
            return 1.0 - value
        return np.clip(np.where(value == 0.0, 0.01, 0.9 * value), row.low, row.high)

    def changed_states(self, state: State) -> Iterator[State]:
        """Change one quantity of a state after the other."""
        generator, changed = np.random.default_rng(3), state.copy()
        for name in [name for name in state if name not in state.layout.reported]:
            values = changed[name]
            values += generator.normal(size=values.shape, scale=0.2)
            if name.endswith("orientation"):
                values /= np.linalg.norm(values)
            yield changed.copy()

    def other_structures(self, scene: Scene) -> Iterable[Any]:
        """List other structures that can take the place of the scene's."""
        return (read_model(self.model.replace('name="apart"', 'name="other"')),)

    @pytest.fixture
    def scene(self) -> Scene:
        """Provide the scene."""
        return self.busy()

    @pytest.fixture
    def backend(self, scene: Scene) -> Iterator[Backend]:
        """Provide a backend in the middle of an episode."""
        with self.built(scene) as backend:
            self.play(backend, 2, seed=1)
            yield backend

    @contextmanager
    def built(self, scene: Scene) -> Iterator[Backend]:
        """Provide a new backend with a scene, and close it; closing it twice is harmless."""
        backend = self.make()
        backend.build(scene)
        try:
            yield backend
        finally:
            backend.close()
            backend.close()

    def play(self, backend: Backend, steps: int, seed: int = SEED) -> Floats:
        """Apply random commands; return the state after each one."""
        return play(backend, self.commands(backend.structure, steps, seed), self.substeps)

    def continued(
        self, backend: Backend, start: EngineSnapshot, *changes: Difference, steps: int = 20
    ) -> Floats:
        """Continue from a snapshot with some changes."""
        backend.restore(start)
        for change in changes:
            backend.apply(change)
        return self.play(backend, steps)

    def others(self, scene: Scene) -> dict[ParameterKey, Floats]:
        """Return another value of every parameter."""
        given = scene.parameters.items()
        return {key: self.other_value(scene.structure, key, value) for key, value in given}

    def check_parameters(self, actual: Parameters, expected: Parameters) -> None:
        """Compare parameters as engines keep them: colors with 32 bits or less."""
        assert set(actual) == set(expected)
        for key, value in expected.items():
            tolerance = 1e-6 if key[1] in ("color", "rgba") else 1e-12
            np.testing.assert_allclose(actual[key], value, 0.0, tolerance, err_msg=str(key))
            assert actual[key].shape == value.shape

    def test_the_future_depends_on_the_scene_alone(self, backend: Backend, scene: Scene) -> None:
        """Neither earlier scenes of the backend nor the process change it."""
        other = scene.with_(parameters=self.others(scene))
        commands, kind = self.commands(scene.structure, 20), type(backend)
        alone, acts = played(kind, scene, commands, self.substeps), backend.capabilities.physics
        assert np.array_equal(played(kind, other, commands, self.substeps), alone) != acts
        for used in (other, *(each.default_scene() for each in self.other_structures(scene))):
            backend.build(used)
            self.play(backend, 3)
            backend.build(scene)
            assert np.array_equal(play(backend, commands, self.substeps), alone)
        assert np.array_equal(elsewhere(played, kind, scene, commands, self.substeps), alone)

    def test_a_command_can_be_held_in_parts(self, backend: Backend) -> None:
        """Commands that arrive within a control step divide it; the others do not notice."""
        if not backend.capabilities.physics:
            pytest.skip("nothing moves by itself")
        start, commands = backend.snapshot(), self.commands(backend.structure, 10)
        whole = play(backend, commands, self.substeps)
        backend.restore(start)
        parts = play(backend, np.repeat(commands, self.substeps, axis=0), 1)
        floor = backend.capabilities.floor
        assert np.allclose(parts[self.substeps - 1 :: self.substeps], whole, rtol=0.0, atol=floor)

    def test_contacts_are_those_of_the_last_step(self, scene: Scene) -> None:
        """Nothing touches before the first step; a change of the state does not change them."""
        with self.built(scene) as backend:
            assert backend.contacts() == ()
            self.play(backend, 3, seed=1)
            contacts = backend.contacts()
            assert bool(contacts) == backend.capabilities.physics
            for contact in contacts:
                assert np.linalg.norm(contact.normal) == pytest.approx(1.0)
            *_, changed = self.changed_states(backend.read())
            backend.apply(Difference(state=changed))
            assert [c.bodies for c in backend.contacts()] == [c.bodies for c in contacts]

    def test_parameters_are_read_back(self, backend: Backend, scene: Scene) -> None:
        """Each parameter is reported as set, and leaves the state and all others unchanged."""
        keys, start, state = tuple(scene.parameters), backend.snapshot(), backend.read()
        given, other = scene.parameters, self.others(scene)
        self.check_parameters(backend.parameters(keys), given)
        for key, value in other.items():
            backend.apply(Difference(parameters={key: value}))
            self.check_parameters(backend.parameters(keys), {**given, key: value})
            assert backend.read() == state
            backend.apply(Difference(parameters={key: given[key]}))
        backend.apply(Difference(parameters=other))
        self.check_parameters(backend.parameters(keys), other)
        backend.restore(start)
        self.check_parameters(backend.parameters(keys), given)

    def test_a_state_is_read_back(self, backend: Backend) -> None:
        """The engine reports the state as it was set; reported values stay those of the step."""
        before = backend.read()
        for changed in self.changed_states(before):
            backend.apply(Difference(state=changed))
            read, fixed = backend.read(), ~before.layout.can_be_set
            np.testing.assert_allclose(read.settable(), changed.settable(), rtol=0, atol=1e-12)
            assert np.array_equal(read.vector[fixed], before.vector[fixed])

    def test_worlds_undo_exactly(self) -> None:
        """Every quantity of a world of the model is set and set back: nothing at all is left."""
        with closing(World(self.model, backend=self.make())) as world:
            assert check_undo(world, (1, 20)) > 0

    def test_only_the_result_of_changes_counts(self, backend: Backend, scene: Scene) -> None:
        """Together, one by one, or with detours; all taken back, nothing is left for long."""
        start, before, other = backend.snapshot(), backend.read(), self.others(scene)
        *_, state = self.changed_states(before)
        alone = [Difference(parameters={key: other[key]}) for key in sorted(other)]
        undone = [Difference(parameters={key: scene.parameters[key]}) for key in sorted(other)]
        detours = [Difference(state=detour) for detour in self.changed_states(state)]
        bodies = [Difference(structure=others) for others in self.other_structures(scene)]
        end, result = Difference(state=state), Difference(parameters=other, state=state)
        back = Difference(parameters=scene.parameters, state=before)
        expected = self.continued(backend, start, steps=LONG)
        found = self.continued(backend, start, result)
        for path in (
            [result],
            [end, *alone],
            [*alone, *undone[::-1], *detours, *alone[::-1], end],
            [*bodies, Difference(scene.structure, other, state)],
        ):
            assert np.array_equal(self.continued(backend, start, *path), found)
            self.continued(backend, start, *path, steps=0)
            saved = pickle.loads(pickle.dumps(backend.snapshot()))  # noqa: S301 # our own
            assert np.array_equal(self.continued(backend, saved, back, steps=LONG), expected)
        with self.built(scene) as edited, self.built(scene.with_(parameters=other)) as new:
            edited.apply(Difference(parameters=other))
            assert np.array_equal(self.play(edited, 20), self.play(new, 20))

    def test_a_body_that_touches_nothing_does_nothing(self, scene: Scene) -> None:
        """It has no effect on the others, nor they on it: none at all, or as is said.

        ``Capabilities.rounding`` says it, of one control step.
        """
        mine = np.zeros(scene.state.layout.size, dtype=bool)
        for name, where in scene.state.layout.slices.items():
            mine[where] = name.startswith("apart.")
        with self.built(scene) as backend:
            room, steps = apart(backend, self.substeps)
            start = backend.snapshot()
            expected = self.continued(backend, start, steps=steps)
            for key, value in self.others(scene).items():
                if key[0] not in ("", "floor"):  # these act on all bodies
                    change = Difference(parameters={key: value})
                    changed = self.continued(backend, start, change, steps=steps) - expected
                    untouched = ~mine if key[0].startswith("apart") else mine
                    far = np.abs(changed) / np.maximum(1.0, np.abs(expected))
                    assert (far <= room)[:, untouched].all(), key

    def moments(self, backend: Backend, scene: Scene) -> Iterator[None]:
        """Change a backend in one way after another."""
        start = backend.snapshot()
        yield
        backend.apply(Difference(parameters=self.others(scene)))
        yield
        *_, state = self.changed_states(backend.read())
        backend.apply(Difference(state=state))
        yield
        self.play(backend, 3)
        yield
        for structure in self.other_structures(scene):
            backend.apply(Difference(structure=structure))
            assert backend.structure == structure
            yield
            backend.restore(start)

    def test_a_snapshot_continues_bit_for_bit(self, backend: Backend, scene: Scene) -> None:
        """From a snapshot, this, another and a pickled backend continue alike, repeatedly."""
        for _ in self.moments(backend, scene):
            snapshot, state, touching = backend.snapshot(), backend.read(), backend.contacts()
            assert backend.snapshot() is not snapshot  # another one does not disturb
            expected = self.play(backend, 15)
            backend.apply(Difference(state=backend.read()))
            backend.restore(snapshot)
            with pytest.raises(SnapshotMismatch):
                backend.restore(EngineSnapshot("no engine 0", None))
            assert backend.read() == state
            assert [c.bodies for c in backend.contacts()] == [c.bodies for c in touching]
            assert np.array_equal(self.play(backend, 15), expected)
            with self.built(scene) as other:
                self.play(other, 2)
                copy = pickle.loads(pickle.dumps(snapshot))  # noqa: S301 # our own
                assert np.array_equal(self.continued(other, copy, steps=15), expected)
            backend.restore(snapshot)

    @pytest.mark.parametrize(("n", "threads"), [(1, 1), (7, 1), (7, 2), (7, 4)])
    def test_a_batch_is_one_after_another(self, scene: Scene, n: int, threads: int) -> None:
        """Scenes that are stepped together give the same bits as alone.

        Between two steps each can be read, changed, saved, restored and stepped by itself.
        """
        with self.pairs(scene, n, threads) as (engine, alone, many):
            values = list(self.others(scene).items())
            for index, both in enumerate(zip(alone, many, strict=True)):
                for backend in both:
                    backend.apply(Difference(parameters=dict(values[:index])))
            changes = [self.moments(backends[n // 4], scene) for backends in (alone, many)]
            for step in range(8):
                which = np.arange(n) if step % 3 else np.arange(0, n, 2)
                self.step_both(engine, alone, which, seed=step)
                for moments in changes:
                    next(moments, None)
                self.compare_both(engine, alone)

    @contextmanager
    def pairs(
        self, scene: Scene, n: int, threads: int = 2
    ) -> Iterator[tuple[Scenes, list[Backend], list[Backend]]]:
        """Provide an engine with n scenes in the middle of an episode, and the same ones alone.

        The third part are the backends of the scenes in the engine.
        """
        with ExitStack() as stack:
            alone = [stack.enter_context(self.built(scene)) for _ in range(n)]
            backends = [self.make() for _ in range(n)]
            engine = type(backends[0]).batch.of(backends, threads)
            stack.callback(engine.close)
            assert len(engine) == n
            engine.build(np.arange(n), scene)
            self.step_both(engine, alone)
            yield engine, alone, backends

    def step_both(
        self,
        engine: Scenes,
        alone: list[Backend],
        which: Integers | None = None,
        seed: int = SEED,
    ) -> None:
        """Step some scenes, all if None, and the same ones alone; compare all."""
        which = np.arange(len(alone)) if which is None else which
        commands = self.commands(engine.structure(0), len(alone), seed)
        into = np.full((len(alone), 2 * engine.structure(0).layout.size), np.nan)
        engine.step(which, commands, self.substeps, into)
        for index in which.tolist():
            vector = play(alone[index], commands[index][None], self.substeps)[0]
            assert np.array_equal(into[index, : vector.size], vector)
        self.compare_both(engine, alone)

    def compare_both(self, engine: Scenes, alone: list[Backend]) -> None:
        """Compare structures, states, parameters and contacts of scenes with those alone."""
        for index, backend in enumerate(alone):
            row, structure = np.array([index]), backend.structure
            keys = tuple(structure.default_scene().parameters)
            assert engine.structure(index) == structure
            assert np.array_equal(engine.read(row), backend.read().vector[None])
            found, expected = engine.parameters(row, keys), backend.parameters(keys)
            assert all(np.array_equal(found[key][0], expected[key]) for key in keys)
            both = engine.contacts(row)[0], backend.contacts()
            touching = [[(c.bodies, c.force) for c in contacts] for contacts in both]
            assert touching[0] == touching[1]

    @pytest.mark.parametrize("n", [1, 7])
    def test_some_scenes_change_together(self, scene: Scene, n: int) -> None:
        """Each scene changes as it does alone; all others stay unchanged."""
        with self.pairs(scene, n) as (engine, alone, _):
            which, everyone = np.arange(0, n - 1 or 1, 2), np.arange(n)
            others, usual = self.others(scene), scene.parameters
            values = {
                key: np.stack([(other, usual[key])[place % 2] for place in range(len(which))])
                for key, other in others.items()
            }
            *_, state = self.changed_states(alone[0].read())
            engine.apply(which, values)
            for place, index in enumerate(which.tolist()):
                given = {key: value[place] for key, value in values.items()}
                alone[index].apply(Difference(parameters=given))
            self.compare_both(engine, alone)
            key, other = next(iter(others.items()))
            engine.apply(everyone[:2], {key: other[None]})  # the same in all of them
            engine.apply(which, {}, np.repeat(state.vector[None], len(which), axis=0))
            for backend in alone[:2]:
                backend.apply(Difference(parameters={key: other}))
            for index in which.tolist():
                alone[index].apply(Difference(state=state))
            self.step_both(engine, alone, which)
            self.step_both(engine, alone)
            kept, keeps = engine.snapshot(which), [backend.snapshot() for backend in alone]
            copies = pickle.loads(pickle.dumps(kept))  # noqa: S301 # our own
            self.step_both(engine, alone)
            for structure in self.other_structures(scene):
                engine.apply(which, {}, structure=structure)
                for index in which.tolist():
                    alone[index].apply(Difference(structure=structure))
                self.compare_both(engine, alone)
            engine.restore(which, copies)
            for index in which.tolist():
                alone[index].restore(keeps[index])
            self.step_both(engine, alone)
            engine.restore(everyone, kept[:1])
            for backend in alone:
                backend.restore(keeps[0])
            self.step_both(engine, alone)

    def test_scenes_that_refuse_are_named_and_unchanged(self, scene: Scene) -> None:
        """All others have changed; where all refuse, nothing has."""
        other, key = next(
            (structure, key)
            for structure in self.other_structures(scene)
            for key in sorted({*scene.parameters} - {*structure.default_scene().parameters})
        )
        everyone = np.arange(7)
        value = self.other_value(scene.structure, key, scene.parameters[key])
        with self.pairs(scene, 7) as (engine, alone, _):
            for index in (1, 4):
                engine.apply(everyone[[index]], {}, structure=other)
                alone[index].apply(Difference(structure=other))
            with pytest.raises(UnknownOption) as refused:
                engine.apply(everyone[1:], {key: value[None]})
            assert refused.value.scenes == (1, 4)
            for index in (2, 3, 5, 6):
                alone[index].apply(Difference(parameters={key: value}))
            self.compare_both(engine, alone)
            mixed = *engine.snapshot(everyone[:1]), EngineSnapshot("no engine 0", None)
            with pytest.raises(SnapshotMismatch):
                engine.restore(everyone[2:4], mixed)
            self.compare_both(engine, alone)

    @pytest.mark.parametrize("n", [1, 7])
    def test_a_lost_state_is_that_of_its_scene(
        self, scene: Scene, n: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        """It is named; all others are stepped, and a snapshot brings it back."""
        monkeypatch.chdir(tmp_path)  # engines may write a log
        with self.pairs(scene, n) as (engine, alone, _):
            everyone, index = np.arange(n), n // 2
            kept, state = engine.snapshot(everyone[[index]]), alone[index].read()
            state.vector[np.flatnonzero(state.layout.can_be_set)[-1]] = np.inf
            commands, row = self.commands(scene.structure, n), everyone[[index]]
            into = np.zeros((n, scene.structure.layout.size))
            with pytest.raises(EngineFailure) as failed:  # noqa: PT012 # either may notice it
                engine.apply(row, {}, state.vector[None])
                engine.step(everyone, commands, self.substeps, into)
            noticed = failed.value.scenes or failed.value.lost or failed.value.unmoved
            assert noticed == (index,)
            if failed.value.scenes:
                engine.step(everyone[everyone != index], commands, self.substeps, into)
            for other in everyone[everyone != index].tolist():
                vector = play(alone[other], commands[other][None], self.substeps)[0]
                assert np.array_equal(into[other], vector)
            engine.restore(row, kept)
            self.step_both(engine, alone)

    @pytest.mark.parametrize("together", [False, True])
    def test_an_explosion_is_an_error(
        self, backend: Backend, together: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        """A state that is not finite is never returned, also not from a batch."""
        monkeypatch.chdir(tmp_path)  # engines may write a log
        batch, state = type(backend).batch.of([backend], 1), backend.read()
        state.vector[np.flatnonzero(state.layout.can_be_set)[-1]] = np.inf
        with pytest.raises(EngineFailure):  # noqa: PT012 # either of the two may notice it
            backend.apply(Difference(state=state))
            if together:
                commands = self.commands(backend.structure, 1)
                batch.step(np.array([0]), commands, self.substeps, state.vector[None].copy())
            else:
                self.play(backend, 1)
