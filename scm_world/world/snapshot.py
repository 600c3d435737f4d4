"""A world that can be gone back to."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
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
from scm_world.world.compiled_task import PendingInterventions, Plan


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
        plan: The structure.
        memory: What a world of another kind remembers besides.
        base: The world at this control step before anyone intervened; None after a step. Of it,
            only ``static``, ``interventions``, ``index``, ``plan`` and what follows here count.
        vector: Of a base: where everything is.
        pending: Of a base: what was asked for since.
        at_start: Of a base: whether an episode was just beginning.
    """

    engine: EngineSnapshot | bytes | None
    static: Mapping[str, Value]
    interventions: Mapping[str, Intervention] = field(default_factory=dict)
    previous: Mapping[str, Value] = field(default_factory=dict)
    action: Floats = field(default_factory=lambda: np.zeros(0))
    index: int = 0
    seed: int = 0
    episode: int = 0
    world: tuple[Any, ...] = ()
    plan: Plan = (None, frozenset())
    memory: Any = None
    base: WorldSnapshot | None = None
    vector: Floats = field(default_factory=lambda: np.zeros(0))
    pending: PendingInterventions = field(default_factory=dict)
    at_start: bool = False

    def __getstate__(self) -> dict[str, Any]:
        if self.engine is None or isinstance(self.engine, bytes):
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
            SnapshotMismatch: It was taken of another model, or is the base of another snapshot.
        """
        if self.engine is None:
            raise SnapshotMismatch("the snapshot has no engine's part: it is the base of another")
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
