"""Backends with one fault each, and the suite on every one of them."""

from __future__ import annotations

import os
from typing import Any, ClassVar

import numpy as np

from scm_world.backends import Backend, BackendWrapper, EngineSnapshot, make_backend
from scm_world.backends.base import Capabilities, SeparateScenes
from scm_world.errors import EngineFailure, ScmWorldError
from scm_world.models import Difference
from scm_world.testing.backend import BackendConformance


class Sound(BackendWrapper):
    """A backend without a fault, to derive others from."""

    name: ClassVar[str] = "sound"
    capabilities: ClassVar[Capabilities] = Capabilities(physics=False)

    def __init__(self) -> None:
        super().__init__(make_backend("fake"))
        self.kept = 0.0

    def push(self, number: float) -> None:
        """Add a number to the last number of the state."""
        state = self.engine.read()
        state.vector[np.flatnonzero(state.layout.can_be_set)[-1]] += number
        self.engine.apply(Difference(state=state))


class Keeps(Sound):
    """Snapshots hold a number. This alone is no fault."""

    def snapshot(self) -> EngineSnapshot:
        """Save the number, too."""
        return EngineSnapshot.of(self, (self.engine.snapshot(), self.kept))

    def restore(self, snapshot: EngineSnapshot) -> None:
        """Restore the number, too."""
        inside, self.kept = snapshot.opened(self)
        self.engine.restore(inside)


class Remembers(Keeps):
    """Building does not forget the steps before."""

    def step(self, command: Any, substeps: int) -> None:
        """Push by the number of steps."""
        self.kept += 1e-9
        super().step(command, substeps)
        self.push(self.kept)


class Forgets(Remembers):
    """The number of steps is not a part of snapshots."""

    def build(self, scene: Any) -> None:
        """Forget the steps."""
        self.kept = 0.0
        super().build(scene)

    def snapshot(self) -> EngineSnapshot:
        """Save the engine alone."""
        return EngineSnapshot.of(self, (self.engine.snapshot(), 0.0))


class Shares(Sound):
    """All backends have one clock."""

    clock: ClassVar[list[float]] = [0.0]

    def build(self, scene: Any) -> None:
        """Set the clock back."""
        self.clock[0] = 0.0
        super().build(scene)

    def step(self, command: Any, substeps: int) -> None:
        """Push by the time of the clock."""
        self.clock[0] += 1e-9
        super().step(command, substeps)
        self.push(self.clock[0])


class OfOneProcess(Sound):
    """Another process moves otherwise."""

    def step(self, command: Any, substeps: int) -> None:
        """Push by the number of the process."""
        super().step(command, substeps)
        self.push(1e-9 * os.getpid())


class Rounds(Sound):
    """Parameters are reported with 32 bits."""

    def parameters(self, keys: Any) -> Any:
        """Read parameters."""
        return {k: v.astype(np.float32).astype(float) for k, v in super().parameters(keys).items()}


class Couples(Sound):
    """Setting a parameter sets another one, too."""

    def apply(self, difference: Difference) -> None:
        """Change the friction of the floor with every other parameter."""
        super().apply(difference)
        key = ("floor", "friction")
        if difference.structure is None and difference.parameters and key in self.known:
            self.engine.apply(
                Difference(parameters={key: 0.5 * self.engine.parameters([key])[key]})
            )

    @property
    def known(self) -> Any:
        """Keys of all parameters."""
        return {row.key for row in self.engine.structure.parameters}


class Counts(Keeps):
    """The number of changes matters, and not only their result."""

    def build(self, scene: Any) -> None:
        """Forget the changes."""
        self.kept = 0.0
        super().build(scene)

    def apply(self, difference: Difference) -> None:
        """Count."""
        self.kept += 1e-9
        super().apply(difference)

    def step(self, command: Any, substeps: int) -> None:
        """Push by the number of changes."""
        super().step(command, substeps)
        self.push(self.kept)


class Nudges(Sound):
    """A state that is set is not quite the one that was given."""

    def apply(self, difference: Difference) -> None:
        """Nudge the state."""
        super().apply(difference)
        if difference.state is not None:
            self.push(1e-9)


class TakesAll(Sound):
    """Snapshots of any engine are restored."""

    def restore(self, snapshot: EngineSnapshot) -> None:
        """Restore what can be restored."""
        if snapshot.payload is not None:
            super().restore(snapshot)


class IgnoresBodies(Sound):
    """A change of the structure is not realised."""

    def apply(self, difference: Difference) -> None:
        """Change parameters and state alone."""
        if difference.structure is None:
            super().apply(difference)


class LetsNumbersExplode(Sound):
    """A state that is not finite is returned."""

    def step(self, command: Any, substeps: int) -> None:
        """Step only what is finite."""
        if np.isfinite(self.engine.read().vector).all():
            super().step(command, substeps)


class Leaks(Sound):
    """The mass of the crate moves the body that touches nothing."""

    def step(self, command: Any, substeps: int) -> None:
        """Push by the mass."""
        super().step(command, substeps)
        state, key = self.engine.read(), ("crate", "mass")
        place = state.layout.slices.get("apart.cartesian_position")
        if place is not None:
            state.vector[place] += self.parameters([key])[key]
            self.engine.apply(Difference(state=state))


class ClosesOnce(Sound):
    """A second ``close`` is an error."""

    def close(self) -> None:
        """Close it."""
        assert not self.kept
        self.kept = 1.0


class StaleBatch(SeparateScenes):
    """Changes between two steps of a batch are not seen by it."""

    def step(self, which: Any, commands: Any, substeps: int, into: Any) -> None:
        """Continue from the last states."""
        if hasattr(self, "last"):
            for backend, state in zip(self._backends, self.last, strict=True):
                if state.layout == backend.read().layout:
                    backend.apply(Difference(state=state))
        super().step(which, commands, substeps, into)
        self.last = [backend.read() for backend in self._backends]


class Batches(Sound):
    """Its batch is stale."""

    batch = StaleBatch


class LeakyScenes(SeparateScenes):
    """A change of some scenes reaches the last one, too."""

    def apply(self, which: Any, parameters: Any, *rest: Any, **named: Any) -> None:
        """Give the last scene what the first one gets."""
        super().apply(which, parameters, *rest, **named)
        for key, values in parameters.items():
            self._backends[-1].apply(Difference(parameters={key: values[0]}))


class StoppingScenes(SeparateScenes):
    """Scenes after one that refuses are not changed."""

    def _each(self, which: Any, act: Any) -> None:
        for place, index in enumerate(which.tolist()):
            try:
                act(place, self._backends[index])
            except ScmWorldError as error:
                error.scenes = (index,)
                raise


class NamelessScenes(SeparateScenes):
    """An error of a step names the first scene that was stepped."""

    def step(self, which: Any, commands: Any, substeps: int, into: Any) -> None:
        """Name the wrong scene."""
        try:
            super().step(which, commands, substeps, into)
        except EngineFailure as error:
            error.lost = (0,)
            raise


class LeaksScenes(Sound):
    """Its scenes leak."""

    batch = LeakyScenes


class StopsScenes(Sound):
    """Its scenes stop."""

    batch = StoppingScenes


class NamesNoScenes(Sound):
    """Its scenes have no names."""

    batch = NamelessScenes


FAULTS = {
    Remembers: "test_the_future_depends_on_the_scene_alone",
    Forgets: "test_a_snapshot_continues_bit_for_bit",
    Shares: "test_a_batch_is_one_after_another",
    OfOneProcess: "test_the_future_depends_on_the_scene_alone",
    Rounds: "test_parameters_are_read_back",
    Couples: "test_parameters_are_read_back",
    Counts: "test_only_the_result_of_changes_counts",
    Nudges: "test_a_state_is_read_back",
    TakesAll: "test_a_snapshot_continues_bit_for_bit",
    IgnoresBodies: "test_a_snapshot_continues_bit_for_bit",
    LetsNumbersExplode: "test_an_explosion_is_an_error",
    Leaks: "test_a_body_that_touches_nothing_does_nothing",
    ClosesOnce: "test_a_body_that_touches_nothing_does_nothing",
    Batches: "test_a_batch_is_one_after_another",
    LeaksScenes: "test_some_scenes_change_together",
    StopsScenes: "test_scenes_that_refuse_are_named_and_unchanged",
    NamesNoScenes: "test_a_lost_state_is_that_of_its_scene",
}
"""The test that finds each fault."""


def suite(kind: type[Sound]) -> type:
    """Make the suite of a backend."""

    class OfThis(BackendConformance):
        def make(self) -> Backend:
            return kind()

    return OfThis


for faulty in FAULTS:
    globals()[f"Test{faulty.__name__}"] = suite(faulty)
