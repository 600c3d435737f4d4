"""A world that can be gone back to."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from typing import Any, final

from scm_world._types import Floats
from scm_world.backends.base import EngineSnapshot
from scm_world.backends.step import StepModel
from scm_world.errors import SnapshotMismatch
from scm_world.models import Model
from scm_world.variables import Intervention
from scm_world.world.compiled_task import PendingInterventions, Plan, StepBase
from scm_world.world.mechanisms import Row
from scm_world.world.structures import StructureCache


@final
@dataclass(frozen=True, eq=False)
class SavedBase:
    """A world at one control step, without what is compiled; see ``StepBase``.

    Attributes:
        plan: The structure.
        numbers: The values, shape (width,).
        interventions: What ``do`` holds.
        pending: The interventions at this step so far.
        at_start: Whether an episode is just beginning.
        drawn: How often each variable was drawn at this step.
    """

    plan: Plan
    numbers: Floats
    interventions: Mapping[str, Intervention]
    pending: PendingInterventions
    at_start: bool
    drawn: Mapping[str, int]

    @classmethod
    def of(cls, base: StepBase) -> SavedBase:
        """Leave out what is compiled, and what follows from the rest."""
        plan, held, mechanisms = base.compiled.plan, base.model.interventions, base.row.mechanisms
        numbers = mechanisms.start.copy()
        numbers[mechanisms.kept] = base.row.numbers[mechanisms.kept]
        return cls(plan, numbers, held, dict(base.pending), base.at_start, base.drawn)

    def opened(self, structures: StructureCache) -> StepBase:
        """Compile what was left out."""
        compiled = structures.compiled(self.plan)
        row = Row(compiled.mechanisms, self.numbers.reshape(compiled.mechanisms.start.shape))
        model = compiled.model.with_interventions(self.interventions)
        return StepBase(
            compiled, model, row, self.pending, at_start=self.at_start, drawn=self.drawn
        )


@final
@dataclass(frozen=True, eq=False)
class WorldSnapshot:
    """All that decides the future of a world: physics, causes, noise, clock and memory.

    A pickled snapshot leaves the model out: the world that goes back to it has the same one.

    Attributes:
        engine: The engine's part; bytes that ``unpacked`` reads once it was pickled.
        present: The world, its memory of one control step ago included.
        base: The world at this control step before anyone intervened; None after a step.
        index: The control step.
        offset: By how much interventions have moved the index; noise follows the steps taken.
        seed: Of the noise.
        episode: Number of the episode.
        world: Task, options and names of all variables, to tell worlds apart.
        memory: What a subclass keeps.
    """

    engine: EngineSnapshot | bytes
    present: StepBase | SavedBase
    base: StepBase | SavedBase | None
    index: int
    offset: int
    seed: int
    episode: int
    world: tuple[Any, ...]
    memory: Any = None

    def __reduce__(self) -> tuple[Any, ...]:
        content = dict(vars(self))
        for name in ("present", "base"):
            if isinstance(content[name], StepBase):
                content[name] = SavedBase.of(content[name])
        if isinstance(self.engine, EngineSnapshot):
            file = BytesIO()
            _Pickler(file, pickle.HIGHEST_PROTOCOL).dump(self.engine)
            content["engine"] = file.getvalue()
        return WorldSnapshot, tuple(content.values())

    def __deepcopy__(self, memo: dict[int, Any]) -> WorldSnapshot:
        return self  # nothing writes into it

    def unpacked(self, structure: Any) -> EngineSnapshot:
        """Return the backend's part.

        Args:
            structure: What the world compiles.

        Raises:
            SnapshotMismatch: It was taken of another model.
        """
        if isinstance(self.engine, EngineSnapshot):
            return self.engine
        found: EngineSnapshot = _Unpickler(BytesIO(self.engine), structure).load()
        return found


def opened(base: StepBase | SavedBase, structures: StructureCache) -> StepBase:
    """Return a saved base with the task as some structures compile it."""
    if isinstance(base, SavedBase):
        return base.opened(structures)
    known = structures.compiled(base.compiled.plan) is base.compiled
    return base if known else SavedBase.of(base).opened(structures)


def reference(structure: Any) -> str | None:
    """Return the digest of a model, if it is one that cannot be made again from a few names."""
    return structure.digest if type(structure) in (Model, StepModel) else None


class _Pickler(pickle.Pickler):
    """Writes references in the place of models."""

    def persistent_id(self, obj: Any) -> str | None:
        return reference(obj)


class _Unpickler(pickle.Unpickler):
    """Puts a model in the place of references to it."""

    def __init__(self, file: BytesIO, structure: Any) -> None:
        super().__init__(file)
        self._structure = structure

    def persistent_load(self, pid: Any) -> Any:
        if pid != reference(self._structure):
            raise SnapshotMismatch("the snapshot is one of another model")
        return self._structure
