"""What a change of state or structure does, and what a snapshot holds."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from scm_world.backends.base import Backend, EngineSnapshot
from scm_world.errors import SnapshotMismatch
from scm_world.models.scene import Difference, Scene
from scm_world.tasks.trifinger.system import trifinger
from scm_world.testing.scenes import (
    Suite,
    another,
    changed_states,
    check_parameters,
    octahedron,
    other_value,
    play,
    same,
)


class StateConformance(Suite):
    """Sentences about states, structures and snapshots."""

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
        assert same(results[0], results[1])

    def test_orientations_stay_unit_quaternions(self, backend: Backend) -> None:
        """Orientations have length one and w >= 0 at every instant."""
        states = play(backend, 60, torques=True)
        for vector in states:
            orientations = backend.state().with_vector(vector).orientations
            np.testing.assert_allclose(np.linalg.norm(orientations, axis=1), 1.0, atol=1e-9)
            assert (orientations[:, 3] >= 0).all()

    def test_a_new_block_moves_nothing(self, backend: Backend, scene: Scene) -> None:
        """When a block comes, the others keep their state and their parameters."""
        more = scene.structure.with_(blocks=(*scene.structure.blocks, "new"))
        backend.apply(Difference(parameters={("near", "mass"): np.array(0.05)}))
        before = backend.state()
        backend.apply(Difference(structure=more))
        assert backend.structure == more
        assert same(backend.state().blocks[:-1], before.blocks)
        assert same(backend.state().vector[:27], before.vector[:27])
        mass = backend.parameters([("near", "mass")])["near", "mass"]
        np.testing.assert_allclose(mass, 0.05, rtol=1e-12)

    def test_what_stays_keeps_its_parameters(self, backend: Backend, scene: Scene) -> None:
        """When an obstacle comes or another preset does, every other parameter stays."""
        other = {key: other_value(key, value) for key, value in scene.parameters.items()}
        backend.apply(Difference(parameters=other))
        before = backend.state()
        more = scene.structure.with_(obstacles=("new", "ledge"))
        for structure in (more, replace(more, preset=another(self.preset))):
            backend.apply(Difference(structure=structure))
            check_parameters(backend.parameters(other), other)
            assert same(backend.state().settable(), before.settable())

    def structures(self, scene: Scene) -> Iterator[Any]:
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

    def test_bodies_that_come_and_go_leave_no_trace(self, backend: Backend, scene: Scene) -> None:
        """Changing the structure in any way and taking it back has exactly no effect."""
        start, now = backend.snapshot(), backend.state()
        expected = self.continued(backend, start, 20)
        for structure in self.structures(scene):
            backend.restore(start)
            backend.apply(Difference(structure=structure))
            backend.apply(Difference(scene.structure, scene.parameters, now))
            assert backend.state() == now
            assert same(play(backend, 20), expected)

    def snapshots(self, backend: Backend, scene: Scene) -> Iterator[EngineSnapshot]:
        """Take snapshots in all kinds of moments."""
        yield backend.snapshot()
        other = {key: other_value(key, value) for key, value in scene.parameters.items()}
        backend.apply(Difference(parameters=other))
        yield backend.snapshot()
        *_, (_, state) = changed_states(backend.state())
        backend.apply(Difference(state=state))
        yield backend.snapshot()
        play(backend, 3, torques=True)
        yield backend.snapshot()
        backend.apply(Difference(structure=trifinger(("near", "new"), preset=self.preset)))
        yield backend.snapshot()

    def test_a_snapshot_continues_bit_for_bit(self, backend: Backend, scene: Scene) -> None:
        """From a snapshot, this, another and a pickled backend continue alike, repeatedly."""
        for snapshot in self.snapshots(backend, scene):
            state, touching = backend.state(), backend.contacts()
            bytes_ = pickle.dumps(snapshot)
            expected = play(backend, 15)
            backend.restore(snapshot)
            assert backend.state() == state
            assert [c.bodies for c in backend.contacts()] == [c.bodies for c in touching]
            assert same(play(backend, 15), expected)
            elsewhere = trifinger(("stranger",), preset=self.preset).default_scene()
            with self.built(elsewhere) as other:
                play(other, 2)
                assert same(self.continued(other, pickle.loads(bytes_), 15), expected)  # noqa: S301
            backend.restore(snapshot)

    def test_a_snapshot_holds_the_parameters(self, backend: Backend, scene: Scene) -> None:
        """Restoring brings back the parameters of the snapshot."""
        keys = tuple(scene.parameters)
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
