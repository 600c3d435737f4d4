"""A world that can be gone back to."""

from __future__ import annotations

import pickle
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any, final

import numpy as np

from scm_world._types import Floats, Value
from scm_world.backends.base import EngineSnapshot
from scm_world.backends.step import StepModel
from scm_world.errors import SnapshotMismatch
from scm_world.models import Model
from scm_world.variables import Intervention
from scm_world.world.family import Family
from scm_world.world.proposal import Instant, Requests


@final
@dataclass(frozen=True)
class SavedInstant:
    """An instant without its model, of which only the interventions are kept."""

    interventions: Mapping[str, Intervention]
    static: Mapping[str, Value]
    vector: Floats
    index: int
    requests: Requests
    at_start: bool
    plan: Hashable = None

    @classmethod
    def of(cls, instant: Instant) -> SavedInstant:
        """Save an instant."""
        return cls(
            instant.model.interventions,
            dict(instant.static),
            instant.state.vector.copy(),
            instant.index,
            dict(instant.requests),
            instant.at_start,
            instant.declaration.plan,
        )

    def instant(self, family: Family) -> Instant:
        """Give the instant back."""
        declaration = family.declaration(self.plan)
        state = declaration.empty_state(self.vector.copy())
        held = declaration.model.with_interventions(self.interventions)
        return Instant(
            declaration,
            held,
            self.static,
            state,
            self.index,
            dict(self.requests),
            self.at_start,
        )


@final
@dataclass(frozen=True)
class WorldSnapshot:
    """All that decides how a world goes on: physics, causes, noise, clock and memory.

    A pickled snapshot leaves the model out: the world that goes back to it has the same one.

    Attributes:
        engine: The engine's part; bytes that ``unpacked`` reads once it was pickled.
        static: Values of everything that physics does not move.
        interventions: What ``do`` holds.
        previous: Values of one control step ago.
        action: The last action.
        index: The control step.
        seed: Of the noise.
        episode: Number of the episode.
        world: Task, options and names of all variables, to tell worlds apart.
        instant: What was done at this instant so far, and where it began.
        plan: What stands in the world.
        memory: What a world of another kind remembers besides.
    """

    engine: EngineSnapshot | bytes
    static: Mapping[str, Value]
    interventions: Mapping[str, Intervention] = field(default_factory=dict)
    previous: Mapping[str, Value] = field(default_factory=dict)
    action: Floats = field(default_factory=lambda: np.zeros(0))
    index: int = 0
    seed: int = 0
    episode: int = 0
    world: tuple[Any, ...] = ()
    instant: SavedInstant | None = None
    plan: Hashable = None
    memory: Any = None

    def __getstate__(self) -> dict[str, Any]:
        if isinstance(self.engine, bytes):
            return vars(self)
        file = BytesIO()
        _Pickler(file, pickle.HIGHEST_PROTOCOL).dump(self.engine)
        return {**vars(self), "engine": file.getvalue()}

    def __deepcopy__(self, memo: dict[int, Any]) -> WorldSnapshot:
        return self  # nothing writes into it

    def unpacked(self, structure: Any) -> EngineSnapshot:
        """Give the engine's part.

        Args:
            structure: What the world compiles.

        Raises:
            SnapshotMismatch: It was taken of another model.
        """
        if not isinstance(self.engine, bytes):
            return self.engine
        found: EngineSnapshot = _Unpickler(BytesIO(self.engine), structure).load()
        return found


def _reference(structure: Any) -> str | None:
    """Say which model something is, if it is one."""
    if isinstance(structure, StepModel):
        return f"step function {structure.name}"
    return structure.digest if isinstance(structure, Model) else None


class _Pickler(pickle.Pickler):
    """Writes references in the place of models."""

    def persistent_id(self, obj: Any) -> str | None:
        """Give the reference that is written."""
        return _reference(obj)


class _Unpickler(pickle.Unpickler):
    """Puts a model in the place of references to it."""

    def __init__(self, file: BytesIO, structure: Any) -> None:
        super().__init__(file)
        self._structure = structure

    def persistent_load(self, pid: Any) -> Any:
        """Give the model."""
        if pid != _reference(self._structure):
            raise SnapshotMismatch("the snapshot is one of another model")
        return self._structure
