"""A world that can be gone back to."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from dataclasses import dataclass, field
from hashlib import blake2b
from io import BytesIO
from typing import Any, final

import numpy as np

from scm_world._types import Floats, Value
from scm_world.backends.base import EngineSnapshot
from scm_world.backends.step import StepModel
from scm_world.errors import ScmWorldError, SnapshotMismatch, in_one_line
from scm_world.models import Model
from scm_world.variables import Intervention
from scm_world.world.compiled_task import PendingInterventions, Plan


@final
@dataclass(frozen=True, eq=False)
class WorldSnapshot:
    """All that decides the future of a world: physics, causes, noise, clock and memory.

    A pickled snapshot leaves the model out: the world that goes back to it has the same one.

    Attributes:
        engine: The engine's part; bytes that ``unpacked`` reads once it was pickled.
        kept: Values of everything that physics does not move; ``static`` gives copies.
        interventions: What ``do`` holds.
        previous: Values of one control step ago.
        action: The last action.
        index: The control step.
        offset: By how much interventions have moved ``index``; noise follows the steps taken.
        seed: Of the noise.
        episode: Number of the episode.
        world: Task, options and names of all variables, to tell worlds apart.
        plan: The structure.
        memory: What a subclass keeps.
        base: The world at this control step before anyone intervened; None after a step. Of it,
            only ``kept``, ``interventions``, ``index``, ``plan`` and what follows here count.
        vector: Of a base: where everything is.
        pending: Of a base: what was asked for since.
        at_start: Of a base: whether an episode was just beginning.
        drawn: Of a base: how often each variable has been drawn since.
    """

    engine: EngineSnapshot | bytes | None
    kept: Mapping[str, Value]
    interventions: Mapping[str, Intervention] = field(default_factory=dict)
    previous: Mapping[str, Value] = field(default_factory=dict)
    action: Floats = field(default_factory=lambda: np.zeros(0))
    index: int = 0
    offset: int = 0
    seed: int = 0
    episode: int = 0
    world: tuple[Any, ...] = ()
    plan: Plan = (None, frozenset())
    memory: Any = None
    base: WorldSnapshot | None = None
    vector: Floats = field(default_factory=lambda: np.zeros(0))
    pending: PendingInterventions = field(default_factory=dict)
    at_start: bool = False
    drawn: Mapping[str, int] = field(default_factory=dict)

    @property
    def static(self) -> dict[str, Value]:
        """Values of everything that physics does not move, as copies."""
        return {name: np.array(value) for name, value in self.kept.items()}

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle with a checksum."""
        engine = self.engine
        if engine is not None and not isinstance(engine, bytes):
            file = BytesIO()
            _Pickler(file, pickle.HIGHEST_PROTOCOL).dump(engine)
            engine = file.getvalue()
        content = pickle.dumps({**vars(self), "engine": engine}, pickle.HIGHEST_PROTOCOL)
        return _unpickled, (content, blake2b(content, digest_size=16).digest())

    def __deepcopy__(self, memo: dict[int, Any]) -> WorldSnapshot:
        return self  # nothing writes into it

    def unpacked(self, structure: Any) -> EngineSnapshot:
        """Give the backend's part.

        Args:
            structure: What the world compiles.

        Raises:
            SnapshotMismatch: It was taken of another model, is the base of another snapshot, or is
                damaged.
        """
        if self.engine is None:
            raise SnapshotMismatch("the snapshot has no engine's part: it is the base of another")
        found: Any = self.engine
        if isinstance(found, bytes):
            try:
                found = _Unpickler(BytesIO(found), structure).load()
            except ScmWorldError:
                raise
            except Exception as error:
                problem = f"the snapshot is damaged: {in_one_line(error)}"
                raise SnapshotMismatch(problem) from error
        if not isinstance(found, EngineSnapshot):
            raise SnapshotMismatch(f"the snapshot is damaged: {found!r} is no engine's part")
        return found


def _unpickled(content: bytes, checksum: bytes) -> WorldSnapshot:
    """Read what was pickled.

    Raises:
        SnapshotMismatch: It is damaged.
    """
    if blake2b(content, digest_size=16).digest() != checksum:
        raise SnapshotMismatch("the snapshot is damaged: its checksum is another one")
    return WorldSnapshot(**pickle.loads(content))  # noqa: S301 # pickled by whom it is read


def reference(structure: Any) -> str | None:
    """Return the digest of a model, if it is one that cannot be made again from a few names."""
    return structure.digest if type(structure) in (Model, StepModel) else None


class _Pickler(pickle.Pickler):
    """Writes references in the place of models."""

    def persistent_id(self, obj: Any) -> str | None:
        """Give the reference that is written."""
        return reference(obj)


class _Unpickler(pickle.Unpickler):
    """Puts a model in the place of references to it."""

    def __init__(self, file: BytesIO, structure: Any) -> None:
        super().__init__(file)
        self._structure = structure

    def persistent_load(self, pid: Any) -> Any:
        """Give the model."""
        if pid != reference(self._structure):
            raise SnapshotMismatch("the snapshot is one of another model")
        return self._structure
