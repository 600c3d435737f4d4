"""Bases of interventions, and snapshots: saved states of a world."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from io import BytesIO
from typing import TYPE_CHECKING, Any, final

from scm_world._types import Value
from scm_world.backends.base import EngineSnapshot
from scm_world.backends.step import StepModel
from scm_world.errors import SnapshotMismatch, UnknownVariable
from scm_world.graph import SCM
from scm_world.models import Model, Structure
from scm_world.models.scene import Overlap
from scm_world.world.compiled_task import PendingInterventions
from scm_world.world.mechanisms import Rows

if TYPE_CHECKING:
    from scm_world.world.structures import StructureCache


@final
@dataclass(eq=False)
class Base:
    """A control step before any intervention: the world as physics left it.

    All interventions at one control step are computed from it as a single one, so undoing one
    leaves no trace, and their order does not matter.

    Attributes:
        model: The model with the interventions of earlier steps.
        row: The values, with the memory of one control step ago.
        structure: The structure that the backend has compiled.
        pending: The interventions at this step so far.
        drawn: Number of draws of each variable at this instant, including the initial one.
        at_start: Whether this is the first instant of an episode.
        fresh: States of bodies that are being added.
    """

    model: SCM
    row: Rows
    structure: Structure
    pending: PendingInterventions = field(default_factory=dict)
    drawn: Mapping[str, int] = field(default_factory=dict)
    at_start: bool = False
    fresh: frozenset[str] = frozenset()

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
        if not isinstance(name, str):
            raise UnknownVariable(name, compiled.model)
        if name in compiled.slices:
            return self.row[name]
        known = compiled.static | compiled.slices.keys()
        targets = compiled.model.targets(name)
        return compiled.coordinates(name, self.row) if known.issuperset(targets) else None


@final
@dataclass(eq=False)
class Snapshot:
    """A copy of everything that determines the future: physics, causes, noise, clock and memory.

    Attributes:
        model: The model with the interventions in force.
        row: The values, with the memory of one control step ago; of equations their attributes.
        structure: The structure that the backend has compiled; None of equations.
        engine: The engine's part; None of equations.
        base: The base of this control step; None after a step.
        index: The control step.
        offset: Steps by which interventions have moved the clock; noise depends on steps taken.
        seed: Seed of the noise.
        episode: Number of the episode.
        draws: Number of the episode whose draws hold; None for its own.
        world: Task, options and names of all variables: the identity of the world.
        memory: Data of a subclass.
        content: A snapshot that was pickled, until a world opens it: everything but the index, the
            world and the memory.
    """

    model: SCM
    row: Rows
    structure: Structure
    engine: EngineSnapshot | None = None
    base: Base | None = None
    index: int = 0
    offset: int = 0
    seed: int = 0
    episode: int = 0
    draws: int | None = None
    world: tuple[Any, ...] = ()
    memory: Any = None
    content: bytes | None = None

    def _opened(self, structures: StructureCache | None, structure: Structure | None) -> Snapshot:
        """Return the snapshot with the task as the structures of a world compile it.

        ``structure`` is the one that its backend has compiled. Equations have none of them.
        """
        if self.content is None and structures is not None:
            parts = (self.row.compiled, (self.base or self).row.compiled)
            if all(structures.compiled(one.plan) is one for one in parts):
                return self

        def known(digest: str) -> Any:
            if digest != reference(structure):
                raise SnapshotMismatch("the snapshot is one of another model")
            return structure

        unpickler: Any = pickle.Unpickler(BytesIO(self.sealed()))  # noqa: S301 # a world's own
        unpickler.persistent_load = known
        return _whole(Snapshot, unpickler.load(), structures)  # type: ignore[no-any-return]

    def sealed(self) -> bytes:
        """Return the content, without models and compiled objects, which a world has itself."""
        if self.content is not None:
            return self.content
        file = BytesIO()
        pickler: Any = pickle.Pickler(file, pickle.HIGHEST_PROTOCOL)
        pickler.persistent_id = reference
        pickler.dump(_stored(self))
        return file.getvalue()

    def __reduce__(self) -> tuple[Any, ...]:
        there: dict[str, Any] = {"index": self.index, "world": self.world, "memory": self.memory}
        empty: Any = dict.fromkeys(("model", "row", "structure"))
        return partial(Snapshot, **empty, **there, content=self.sealed()), ()

    def __deepcopy__(self, memo: dict[int, Any]) -> Snapshot:
        return self  # nothing writes into it


def reference(structure: Any) -> str | None:
    """Return the digest of a model that cannot be rebuilt from a few names; else None."""
    return structure.digest if type(structure) in (Model, StepModel) else None


def _stored(one: Snapshot | Base) -> dict[str, Any]:
    """Return the fields of a snapshot or a base, with names in place of compiled objects."""
    fields = dict(vars(one))
    fields.pop("overlaps", None)
    if isinstance(one.row, Rows):  # not of equations
        compiled = one.row.compiled
        numbers = compiled.start.copy()
        numbers[compiled.kept] = one.row.numbers[compiled.kept]
        fields |= {"row": (compiled.plan, numbers), "model": one.model.interventions}
        fields["structure"] = None
    if isinstance(one, Snapshot):
        fields |= {"memory": None, "base": one.base and _stored(one.base)}
    return fields


def _whole(kind: Any, fields: dict[str, Any], structures: StructureCache | None) -> Any:
    """Return the snapshot or the base of stored fields."""
    if structures is not None:
        plan, numbers = fields["row"]
        compiled = structures.compiled(plan)
        row = Rows(compiled, numbers.reshape(compiled.start.shape))
        model = compiled.model._with_interventions(fields["model"])
        fields |= {"row": row, "model": model, "structure": compiled.composition.structure(row)}
    if fields.get("base"):
        fields["base"] = _whole(Base, fields["base"], structures)
    return kind(**fields)
