"""Many worlds of one source, as one ``World``."""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from operator import attrgetter
from typing import Any, Self, final

import numpy as np

from scm_world._patterns import as_names
from scm_world._types import Value
from scm_world.errors import ModelError, SnapshotMismatch
from scm_world.graph import SCM
from scm_world.queries.twins import Twins, asked
from scm_world.queries.world import EngineWorld, EquationWorld, World
from scm_world.world import Audit, Audits, Batch, CausalSystem, EquationBatch, Snapshot


def _of_one(name: str) -> Any:
    """Return the attribute or method of the world that stands for all."""
    return property(attrgetter(f"one.{name}"))


def _of_each(name: str) -> Any:
    """Return a method that is about the present of one world, and says so."""

    def refuse(self: ManyWorlds, *args: object, **options: object) -> Any:
        said = f"{name} is about one world, and there are {len(self)}"
        raise ModelError([f"{said}: ask worlds.world(i).{name}, with i from 0"])

    refuse.__name__, refuse.__doc__ = name, f"Refuse: ``{name}`` is about one world."
    return refuse


class ManyWorlds(World):
    """Worlds of one source, alike at the beginning; ``World(source, num_worlds=n)`` makes them.

    Questions are about the model under the interventions of ``given``, and are answered as by one
    of the worlds alone. The present of one world is that of ``world(i)``.
    """

    backend, compiled, engine, settings = map(
        _of_one, ("backend", "compiled", "engine", "settings")
    )
    natural_model, has_steps, tools = map(_of_one, ("natural_model", "has_steps", "tools"))
    observed, deciding, policies = map(_of_one, ("observed", "deciding", "policies"))
    keeps_draws, idle, length, maker = map(_of_one, ("keeps_draws", "idle", "length", "maker"))
    may_have, is_set_at_once = map(_of_one, ("may_have", "is_set_at_once"))
    usual_setting, usual_outcomes = map(_of_one, ("usual_setting", "usual_outcomes"))
    usual_columns, require_exact = map(_of_one, ("usual_columns", "require_exact"))
    plan, planned = map(_of_one, ("plan", "planned"))
    fidelity, compare, fit, explain = map(_of_one, ("fidelity", "compare", "fit", "explain"))
    for_fit = _of_one("for_fit")
    scene, cameras, contacts = map(_of_each, ("scene", "cameras", "contacts"))
    local_graph = _of_each("local_graph")
    noise, episode, requested = (property(_of_each(n)) for n in ("noise", "episode", "requested"))

    def evaluate(  # type: ignore[override] # they have no common row
        self, names: tuple[str, ...] | None = None
    ) -> dict[str, Value]:
        """Return the present values, each with a leading axis of worlds."""
        return {name: self[name] for name in (self.model if names is None else as_names(names))}

    # --- all of them ----------------------------------------------------------------------------

    @abstractmethod
    def __len__(self) -> int:
        """Return the number of worlds."""

    @property
    @abstractmethod
    def one(self) -> World:
        """The world that stands for all of them in questions."""

    @property
    @abstractmethod
    def systems(self) -> Sequence[World]:
        """The worlds, or those that are solved together as one."""

    @property
    def has_begun(self) -> bool:  # type: ignore[override] # computed here
        """Whether an episode has begun in each of them."""
        return all(one.has_begun for one in self.systems)

    @property
    def is_lost(self) -> bool:
        """Whether a backend has lost the state of one of them."""
        return any(one.is_lost for one in self.systems)

    @property
    def is_planned(self) -> bool:  # type: ignore[override] # computed here
        """Whether a present episode has planned interventions."""
        return any(one.is_planned for one in self.systems)

    @property
    def version(self) -> int:  # type: ignore[override] # computed here
        """Number of changes so far, apart from those by control steps."""
        return sum(one.version for one in self.systems)

    @property
    def graph(self) -> SCM:  # type: ignore[override] # computed here
        """The causal model with the interventions in force, if they are the same in all worlds.

        Raises:
            ModelError: They are not.
        """
        first, *others = self._graphs()
        each = any(getattr(one, "_each", None) for one in self.systems)
        if each or any(one != first for one in others):
            said = f"{len(self)} worlds are under different interventions"
            raise ModelError([f"{said}: ask worlds.world(i).graph, or worlds.model for no do"])
        return first

    def _graphs(self) -> Iterator[SCM]:
        """Yield the models with the interventions in force; equal ones at least once."""
        yield from (one.graph for one in self.systems)

    def _begin(self) -> None:
        for one in self.systems:
            one._begin()

    def _have_no_episode(self) -> None:
        for one in self.systems:
            one._have_no_episode()

    def _under(self, do: Mapping[str, Any]) -> Self:
        for one in {*self.systems, self.one}:
            one._under(do)
        return self

    def _asked(self) -> tuple[Twins, CausalSystem]:
        if any(world.plan != self.plan for world in self.systems):
            said = "the worlds were given different interventions, so that there is no one answer"
            raise ModelError([f"{said}: ask worlds.world(i)"])
        return asked(self.one)


@final
class EngineWorlds(Batch, ManyWorlds):  # type: ignore[misc] # what ``Batch`` has counts
    """Worlds with a physics engine; ``World`` makes them."""

    @property
    def one(self) -> EngineWorld:
        """A world with the options of all, in which nothing happens; of a list the first one."""
        return self._first  # type: ignore[return-value] # it was made of them

    @property
    def systems(self) -> Sequence[World]:
        """The worlds that exist by themselves; the others have no plan, and have lost nothing."""
        return [self._alone(row) for row in self._existing(self._all)]  # type: ignore[misc]

    @property
    def has_begun(self) -> bool:  # type: ignore[override] # computed here
        """Whether an episode has begun in each of them."""
        apart = [row for row, done in enumerate(self._done) if done is None]
        return all(
            world is not None and world.has_begun for world in map(self._worlds.__getitem__, apart)
        )

    @property
    def version(self) -> int:  # type: ignore[override] # computed here
        """Number of changes so far, apart from those by control steps."""
        return self._changes + super().version

    def _graphs(self) -> Iterator[SCM]:
        yield from super()._graphs()
        seen = set[int]()
        for row, done in enumerate(self._done):
            if done is not None and not (done.is_one and id(done) in seen):
                seen.add(id(done))
                yield done.graph(int(self._place[row]))
            elif done is None and not self._exists[row]:
                yield self.natural_model

    def _new(self, **options: Any) -> EngineWorld:
        world = super()._new(**options)
        vars(world)["_given"] = self.one.plan
        return world  # type: ignore[return-value] # it is of the kind of the first

    def given(self, do: Mapping[str, Any]) -> Self:
        """Return other worlds with further interventions; see ``World.given``."""
        threads, names = self.threads, self.names
        begun = [*self._done, *(world.has_begun or None for world in self.systems)]
        if self._options is not None and all(one is None for one in begun):
            first = self.one.given(do)
            return type(self)._like(first, self._options, len(self), threads, names)
        others: list[Any] = [self._alone(row) for row in self._all.tolist()]
        others = [world.given(do) for world in others]
        return type(self)(others, threads=threads, names=names)

    def act(self) -> dict[int, Audit | None]:  # type: ignore[override] # one of each
        """Apply the planned interventions of this instant in all worlds, or in none."""
        there = np.array(self._existing(self._all))
        found = self._everywhere(there, lambda row: self._alone(row).act())  # type: ignore[attr-defined]
        return {row: found.get(row) for row in self._all.tolist()}

    def way_back(self) -> Callable[[], None]:
        """Return a function that restores the present bit-identically; see ``unchanged``."""
        ways = [self.world(row).way_back() for row in self._all.tolist()]

        def back() -> None:
            for way in ways:
                way()

        return back

    def snapshot(self) -> tuple[Snapshot, ...]:  # type: ignore[override] # one of each
        """Return everything that determines the future, of each world."""
        return tuple(self._alone(row).snapshot() for row in self._all.tolist())

    def restore(self, snapshots: Sequence[Snapshot]) -> None:  # type: ignore[override] # one of each
        """Restore the snapshots of all worlds bit-identically, or of none."""
        taken = _for_all(snapshots, len(self))
        self._everywhere(self._all, lambda row: self._alone(row).restore(taken[row]))


@final
class EquationWorlds(EquationBatch, ManyWorlds):  # type: ignore[misc] # what the batch has counts
    """Worlds of equations; ``World`` makes them."""

    @property
    def one(self) -> EquationWorld:
        """A world like all of them, in which no episode has begun."""
        return self._one  # type: ignore[return-value] # it was made of it

    @property
    def systems(self) -> Sequence[World]:
        """Worlds that are solved together, each as one."""
        return [part for part, _ in self._parts]  # type: ignore[misc] # it was made of them

    def given(self, do: Mapping[str, Any]) -> Self:
        """Return other worlds with further interventions; see ``World.given``."""
        other = copy.copy(self)
        other._one, other._out = self.one.given(do), set()
        parts = [one for part in self._parts for one in self._divided([part], do, ())]
        other._parts = [(part.given(do), members) for part, members in parts]  # type: ignore[attr-defined]
        return other

    def act(self) -> Audits:  # type: ignore[override] # one of each
        """Apply the planned interventions of this instant in all worlds, or in none."""
        return self._change(self._all >= 0, lambda part, _: part.act())  # type: ignore[attr-defined]

    def snapshot(self) -> tuple[Snapshot, ...]:  # type: ignore[override] # one of each
        """Return everything that determines the future, of each world."""
        found = {
            int(members[0]): one.snapshot()
            for part in self._parts
            for one, members in (self._singles(*part) if part[0].is_several else [part])
        }
        return tuple(found[row] for row in self._all.tolist())

    def restore(self, snapshots: Sequence[Snapshot]) -> None:  # type: ignore[override] # one of each
        """Restore the snapshots of all worlds bit-identically, or of none."""
        taken, back = _for_all(snapshots, len(self)), self.way_back()
        parts = [
            one
            for part in self._parts
            for one in (self._singles(*part) if part[0].is_several else [part])
        ]
        try:
            for one, members in parts:
                one.restore(taken[int(members[0])])
        except BaseException:
            back()
            raise
        self._parts = self._merged(parts)


def _for_all(snapshots: object, count: int) -> Sequence[Snapshot]:
    if not isinstance(snapshots, Sequence) or len(snapshots) != count:
        said = f"{count} worlds restore as many snapshots, those of their snapshot()"
        raise SnapshotMismatch(f"{said}, got {snapshots!r}")
    return snapshots
