"""Snapshots of a world: bases of interventions, undo, and saved states."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from io import BytesIO
from typing import TYPE_CHECKING, Any, final

from scm_world._types import Floats, Value
from scm_world.backends.base import EngineSnapshot
from scm_world.backends.step import StepModel
from scm_world.errors import SnapshotMismatch
from scm_world.graph import SCM
from scm_world.models import Model, Structure
from scm_world.models.scene import Overlap
from scm_world.variables import Intervention
from scm_world.world.compiled_task import PendingInterventions, Plan
from scm_world.world.mechanisms import Rows

if TYPE_CHECKING:
    from scm_world.world.structures import StructureCache


@final
@dataclass(eq=False)
class Snapshot:
    """A copy of everything that determines the future: physics, causes, noise, clock and memory.

    Without the engine's part it is the base of a control step: the world after physics and before
    any intervention. All interventions at one control step are computed from the base as a single
    one, so undoing one leaves no trace, and their order does not matter.

    Attributes:
        model: The model with the interventions in force; in a base, those of earlier steps.
        row: The values, with the memory of one control step ago; of equations their attributes.
        structure: The structure that the backend has compiled.
        pending: The interventions at this step so far.
        drawn: Number of draws of each variable at this instant, including the initial one.
        at_start: Whether this is the first instant of an episode.
        fresh: States of bodies that are being added.
        engine: The engine's part; None of a base and of equations.
        base: The base of this control step; None after a step.
        index: The control step.
        offset: Steps by which interventions have moved the clock; noise depends on steps taken.
        seed: Seed of the noise.
        episode: Number of the episode.
        world: Task, options and names of all variables: the identity of the world.
        memory: Data of a subclass.
    """

    model: SCM
    row: Rows
    structure: Structure
    pending: PendingInterventions = field(default_factory=dict)
    drawn: Mapping[str, int] = field(default_factory=dict)
    at_start: bool = False
    fresh: frozenset[str] = frozenset()
    engine: EngineSnapshot | None = None
    base: Snapshot | None = None
    index: int = 0
    offset: int = 0
    seed: int = 0
    episode: int = 0
    world: tuple[Any, ...] = ()
    memory: Any = None

    @cached_property
    def overlaps(self) -> tuple[Overlap, ...]:
        """All overlapping bodies, cached because many episodes begin in the same row."""
        compiled, numbers = self.row.compiled, self.row.numbers.tobytes()
        if compiled.last_overlaps is None or compiled.last_overlaps[0] != numbers:
            found = compiled.composition.overlaps(compiled.scene(self.row), 0.0)
            compiled.last_overlaps = numbers, found
        return compiled.last_overlaps[1]

    def value(self, name: str) -> Value | None:
        """Return a parameter or a state, also in other coordinates; None for other variables."""
        compiled = self.row.compiled
        if name in compiled.slices:
            return self.row[name]
        known = compiled.static | compiled.slices.keys()
        targets = compiled.model.targets(name)
        return compiled.coordinates(name, self.row) if known.issuperset(targets) else None

    def opened(self, structures: StructureCache, structure: Any) -> Snapshot:
        """Return the snapshot with the task as some structures compile it; see ``SealedSnapshot``.

        Raises:
            SnapshotMismatch: It was taken of another model, or is damaged.
        """
        parts = (self.row.compiled, (self.base or self).row.compiled)
        if all(structures.compiled(one.plan) is one for one in parts):
            return self
        return self.sealed().opened(structures, structure)

    def sealed(self) -> SealedSnapshot:
        """Return the snapshot as bytes."""
        file = BytesIO()
        _Pickler(file, pickle.HIGHEST_PROTOCOL).dump(replace(self, memory=None))
        return SealedSnapshot(file.getvalue(), self.index, self.world, self.memory)

    def __reduce__(self) -> tuple[Any, ...]:
        return SealedSnapshot, tuple(vars(self.sealed()).values())

    def __deepcopy__(self, memo: dict[int, Any]) -> Snapshot:
        return self  # nothing writes into it


@final
@dataclass(frozen=True, eq=False)
class SealedSnapshot:
    """A pickled snapshot: bytes until a world opens it.

    The model and compiled objects are left out: a world that restores it has the same ones.

    Attributes:
        content: The snapshot, pickled.
        index: As in ``Snapshot``.
        world: As in ``Snapshot``.
        memory: As in ``Snapshot``.
    """

    content: bytes
    index: int
    world: tuple[Any, ...]
    memory: Any = None

    def opened(self, structures: StructureCache | None, structure: Any) -> Snapshot:
        """Return the snapshot, with the task as some structures compile it.

        Args:
            structures: Structures of the world; None for equations.
            structure: The structure that its backend has compiled.

        Raises:
            SnapshotMismatch: It was taken of another model, or is damaged.
        """
        found: Snapshot = _Unpickler(BytesIO(self.content), structures, structure).load()
        return found


_STRUCTURES = object()


def reference(structure: Any) -> str | None:
    """Return the digest of a model that cannot be rebuilt from a few names; else None."""
    return structure.digest if type(structure) in (Model, StepModel) else None


def _opened(
    structures: StructureCache,
    plan: Plan,
    numbers: Floats,
    held: Mapping[str, Intervention],
    *rest: Any,
) -> Snapshot:
    compiled = structures.compiled(plan)
    row = Rows(compiled, numbers.reshape(compiled.start.shape))
    structure = compiled.composition.structure(row)
    return Snapshot(compiled.model.with_interventions(held), row, structure, *rest)


class _Pickler(pickle.Pickler):
    """Writes references in place of models and compiled objects."""

    def persistent_id(self, obj: Any) -> str | None:
        return "" if obj is _STRUCTURES else reference(obj)

    def reducer_override(self, obj: Any) -> Any:
        if type(obj) is not Snapshot:
            return NotImplemented
        fields = [vars(obj)[name] for name in Snapshot.__dataclass_fields__]
        if not isinstance(obj.row, Rows):  # equations
            return Snapshot, tuple(fields)
        compiled = obj.row.compiled
        numbers = compiled.start.copy()
        numbers[compiled.kept] = obj.row.numbers[compiled.kept]
        head = (_STRUCTURES, compiled.plan, numbers, obj.model.interventions)
        return _opened, (*head, *fields[3:])


class _Unpickler(pickle.Unpickler):
    """Puts models and compiled objects in place of references."""

    def __init__(self, file: BytesIO, structures: StructureCache | None, structure: Any) -> None:
        super().__init__(file)
        self._structures, self._structure = structures, structure

    def persistent_load(self, pid: Any) -> Any:
        if pid == "":
            return self._structures
        if pid != reference(self._structure):
            raise SnapshotMismatch("the snapshot is one of another model")
        return self._structure
