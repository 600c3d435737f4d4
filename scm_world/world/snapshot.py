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
from scm_world.world.compiled_task import Plan, StepBase
from scm_world.world.mechanisms import Rows
from scm_world.world.structures import StructureCache


@final
@dataclass(frozen=True, eq=False)
class Snapshot:
    """All that decides the future of a world: physics, causes, noise, clock and memory.

    A pickled snapshot leaves the model and what is compiled out: the world that goes back to it
    has the same ones. Its parts are bytes until a world opens them.

    Attributes:
        engine: The engine's part; None of equations.
        present: The world, its memory of one control step ago included: a ``StepBase``, or of
            equations their values.
        base: The world at this control step before anyone intervened; None after a step.
        index: The control step.
        offset: By how much interventions have moved the clock; noise follows the steps taken.
        seed: Of the noise.
        episode: Number of the episode.
        world: Task, options and names of all variables, to tell worlds apart.
        memory: What a subclass keeps.
    """

    engine: EngineSnapshot | bytes | None
    present: Any
    base: StepBase | bytes | None
    index: int
    offset: int
    seed: int
    episode: int
    world: tuple[Any, ...]
    memory: Any = None

    def __reduce__(self) -> tuple[Any, ...]:
        content = vars(self)
        return Snapshot, tuple(
            _packed(value) if isinstance(value, StepBase | EngineSnapshot) else value
            for value in content.values()
        )

    def __deepcopy__(self, memo: dict[int, Any]) -> Snapshot:
        return self  # nothing writes into it

    def opened(
        self, structures: StructureCache, structure: Any
    ) -> tuple[EngineSnapshot, StepBase, StepBase | None]:
        """Return engine, present and base, with the task as some structures compile it.

        Args:
            structures: Of the world.
            structure: What its backend has compiled.

        Raises:
            SnapshotMismatch: It was taken of another model, or a part is of another kind.
        """

        def part(given: Any, kind: type) -> Any:
            if isinstance(given, StepBase):
                compiled = given.compiled
                given = given if structures.compiled(compiled.plan) is compiled else _packed(given)
            if isinstance(given, bytes):
                given = _Unpickler(BytesIO(given), structures, structure).load()
            if not isinstance(given, kind):
                raise SnapshotMismatch(f"the snapshot is damaged: {given!r} is no {kind.__name__}")
            return given

        base = None if self.base is None else part(self.base, StepBase)
        return part(self.engine, EngineSnapshot), part(self.present, StepBase), base


def reference(structure: Any) -> str | None:
    """Return the digest of a model, if it is one that cannot be made again from a few names."""
    return structure.digest if type(structure) in (Model, StepModel) else None


def _packed(part: Any) -> Any:
    if part is None or isinstance(part, bytes):
        return part
    file = BytesIO()
    _Pickler(file, pickle.HIGHEST_PROTOCOL).dump(part)
    return file.getvalue()


_STRUCTURES = object()


def _base(
    structures: StructureCache,
    plan: Plan,
    numbers: Floats,
    held: Mapping[str, Intervention],
    *rest: Any,
) -> StepBase:
    compiled = structures.compiled(plan)
    row = Rows(compiled.mechanisms, numbers.reshape(compiled.mechanisms.start.shape))
    structure = compiled.composition.structure(row)
    return StepBase(compiled, compiled.model.with_interventions(held), row, structure, *rest)


class _Pickler(pickle.Pickler):
    """Writes references in the place of models and of what is compiled."""

    def persistent_id(self, obj: Any) -> str | None:
        return "" if obj is _STRUCTURES else reference(obj)

    def reducer_override(self, obj: Any) -> Any:
        if type(obj) is not StepBase:
            return NotImplemented
        mechanisms = obj.row.mechanisms
        numbers = mechanisms.start.copy()
        numbers[mechanisms.kept] = obj.row.numbers[mechanisms.kept]
        what = (obj.compiled.plan, numbers, obj.model.interventions)
        return _base, (_STRUCTURES, *what, dict(obj.pending), obj.drawn, obj.at_start)


class _Unpickler(pickle.Unpickler):
    """Puts a model and the structures in the place of references to them."""

    def __init__(self, file: BytesIO, structures: StructureCache, structure: Any) -> None:
        super().__init__(file)
        self._structures, self._structure = structures, structure

    def persistent_load(self, pid: Any) -> Any:
        if pid == "":
            return self._structures
        if pid != reference(self._structure):
            raise SnapshotMismatch("the snapshot is one of another model")
        return self._structure
