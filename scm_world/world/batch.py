"""A batch of worlds that are stepped together, each with its own parameters, noise and clock."""

from __future__ import annotations

import secrets
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from inspect import signature
from types import MappingProxyType
from typing import Any, Literal, Self

import numpy as np

from scm_world._arguments import EPISODES, one_of, real_numbers, typed, whole_number
from scm_world._types import ArrayLike, Floats, Integers, Mask, Value
from scm_world.backends import Backend, Capabilities, make_backend
from scm_world.errors import (
    ActionError,
    EngineFailure,
    InterventionError,
    NotReset,
    ScmWorldError,
    UnknownOption,
)
from scm_world.graph import SCM, flatten
from scm_world.graph.scm import request_of
from scm_world.runs.processes import cores
from scm_world.tasks import AnySource
from scm_world.tasks.composition import Held, parts
from scm_world.variables import Hard
from scm_world.variables.distributions import word_of
from scm_world.variables.interventions import has_times
from scm_world.variables.subsets import AnyRegion, as_region
from scm_world.world.audit import Audit, Audits
from scm_world.world.compiled_task import CompiledTask, beginnings, check_functions
from scm_world.world.mechanisms import Rows
from scm_world.world.philox import CompiledNoise
from scm_world.world.row_memory import RowMemory, changes
from scm_world.world.simulation import READ_BACK, Simulation, physics_steps, warn_of_start
from scm_world.world.snapshot import Snapshot

OF_WORLD = frozenset(signature(Simulation).parameters)
"""Options of a world; all others are options of its task."""


class WorldsInRows(ABC):
    """Many worlds, of which a mask selects those that something is done to."""

    @abstractmethod
    def __len__(self) -> int:
        """Return the number of worlds."""

    def values(self, *, where: Mask | None = None) -> dict[str, Value]:
        """Return the present values of all variables that the selected worlds have.

        Args:
            where: Boolean mask of the worlds, shape (n,); all if None.

        Returns:
            By name, shape (m, *shape), with the m selected worlds in their order; as copies.

        Raises:
            NotReset: No episode has begun in one of them.
        """
        return self._values(np.flatnonzero(read_mask("where", where, len(self))))

    @abstractmethod
    def _values(self, rows: Integers) -> dict[str, Value]: ...

    def do(
        self,
        request: Mapping[str, Any],
        *,
        where: Mask | None = None,
        space: AnyRegion | None = None,
        on_refusal: Literal["raise", "skip"] = "raise",
    ) -> Audits:
        """Intervene now in all selected worlds; see ``Simulation.do``.

        It is computed in worlds that are alike together, else in one world after another, with
        the same bits; see ``RowMemory.ask``.

        Args:
            request: Values or interventions by name. A value with a leading axis of n worlds, as
                such or in a ``Hard``, gives one value to each world; others apply to all.
            where: Boolean mask of the worlds, shape (n,); all if None.
            space: Space in which every target must lie.
            on_refusal: With ``"raise"``, no world changes if one of them refuses. With
                ``"skip"``, those that refuse are unchanged and are listed in ``refused``.

        Returns:
            The audits by number of the world.

        Raises:
            InterventionError: It was refused; the message names the world. Nothing has changed.
            NotReset: No episode has begun in one of the worlds.
        """
        one_of("on_refusal", on_refusal, ("raise", "skip"))
        rows = np.flatnonzero(read_mask("where", where, len(self)))
        return self._do(request, rows, space, skips=on_refusal == "skip")

    @abstractmethod
    def _do(
        self,
        request: Mapping[str, Any],
        rows: Integers,
        space: AnyRegion | None,
        *,
        skips: bool = False,
    ) -> Audits: ...

    def _numbered(self, index: int) -> int:
        return whole_number("world", index, least=0, most=len(self) - 1)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def close(self) -> None:
        """End the episodes of all worlds, and free what they hold."""


class Batch(WorldsInRows):
    """Worlds of one task, options and backend, advanced in one call.

    The present values of each world are a row in the matrix of all worlds of its structure. A world
    in a batch is bit-identical to a world that is stepped alone, and can be used alone at any time.
    ``World(task, num_worlds=n)`` returns a batch.

    Args:
        worlds: The worlds; the batch owns them from now on.
        threads: Number of threads of a backend with several; the number of cores if None.
        names: Variables that are computed after every step.

    Attributes:
        names: As given; they may be replaced.
        threads: As given.

    Raises:
        UnknownOption: The worlds differ in task, options or engine, or ``threads`` is not a
            positive whole number.

    Example:
        >>> worlds = [Simulation("pushing", backend="fake") for _ in range(3)]
        >>> for seed, world in enumerate(worlds):
        ...     world.reset(seed=seed)
        >>> batch = Batch(worlds, names=["reward"])
        >>> batch.advance(np.zeros((3, 9)))
        >>> batch["reward"].shape, batch.world(2).index
        ((3,), 1)
    """

    @typed
    def __init__(
        self, worlds: Sequence[Simulation], *, threads: int | None = None, names: Iterable[str] = ()
    ) -> None:
        given = tuple(worlds)
        if not given:
            raise UnknownOption("worlds", [], ("one or more",))
        kinds = {(world.identity, world.engine) for world in given}
        if len(kinds) > 1:
            raise UnknownOption("worlds", kinds, ("worlds of one task, options and engine",))
        self._set_up(given[0], given, len(given), threads, names)
        backends = [world.backend for world in given]
        self._engine = backends[0].batch.of(backends, self.threads)

    def _set_up(
        self,
        first: Simulation,
        worlds: Sequence[Simulation | None],
        n: int,
        threads: int | None,
        names: Iterable[str],
    ) -> None:
        self.threads = cores() if threads is None else whole_number("threads", threads, least=1)
        self.names, self._all = tuple(names), np.arange(n)
        self._first, self._structures = first, first.structures  # what all worlds have in common
        self._tables: dict[CompiledTask, Rows] = {}
        self._kinds: list[tuple[CompiledTask, int]] = []  # structures, and physics steps
        self._kind = np.full(n, -1)  # of each world, among these
        self._gone: set[int] = set()  # worlds that have lost their state once
        # The worlds that exist by themselves, and the versions of which the rows are up to date.
        self._worlds: list[Simulation | None] = [*worlds]
        self._exists = np.array([world is not None for world in worlds])
        self._shown = {*np.flatnonzero(self._exists).tolist()}  # somebody may hold these
        self._versions = [-1] * n
        # All others: what they did together, and the place of each in it; the key of the seed, the
        # episode and the control step then; the seeds.
        self._done: list[RowMemory | None] = [None] * n
        self._place = np.zeros(n, dtype=int)
        self._where, self._seeds = np.zeros((n, 3), dtype=np.uint64), [0] * n
        self._built = self._exists.copy()  # scenes that the engine has
        self._acts_alone = np.zeros(n, bool)
        self._origin: Snapshot | None = None  # before anything is drawn
        self._changes, self._is_closed = 0, False
        self._options: Mapping[str, Any] | None = None  # of worlds that do not exist yet
        self._make = partial(make_backend, first.backend.name)  # an empty backend for one

    @classmethod
    def _of(
        cls,
        kind: type[Simulation],
        num_worlds: int,
        task: AnySource = "pushing",
        *,
        threads: int | None = None,
        **options: Any,
    ) -> Batch:
        """Build worlds of a kind, ``Simulation`` or ``World``, that share one compiled task.

        A backend is given by its name; ``threads`` are as in ``Batch``.
        """
        n = whole_number("num_worlds", num_worlds, least=1)
        backend = options.get("backend")
        if isinstance(backend, Backend) and n > 1:
            raise UnknownOption("backend of many worlds", backend, ("the name of one",))
        of_world = {name: value for name, value in options.items() if name in OF_WORLD}
        first = kind(task, **options)
        return cls([first], threads=threads) if n == 1 else cls._like(first, of_world, n, threads)

    @classmethod
    def _like(
        cls,
        first: Simulation,
        options: Mapping[str, Any],
        n: int,
        threads: int | None,
        names: Iterable[str] = (),
    ) -> Self:
        """Build n worlds with the options of another one; at first they exist in rows only."""
        made = cls.__new__(cls)
        made._set_up(first, [None] * n, n, threads, names)
        made._options = {n: value for n, value in options.items() if n not in ("backend", "device")}
        made._engine = first.backend.batch.made_by(made._make, n, made.threads)
        return made

    def _alone(self, row: int) -> Simulation:
        """Return a world as one by itself, which goes on from its row."""
        world = self._worlds[row]
        if world is None:
            backend = self._engine.alone(row, self._make, is_built=bool(self._built[row]))
            world = self._new(**(self._options or {}), backend=backend)
            done = self._done[row]
            if done is not None and self._origin is not None:
                own = self._tables[done.compiled].row(row)
                world._go_on(done, int(self._place[row]), own, self._origin)
                self._versions[row] = world.version
            world._closed |= self._is_closed
            self._worlds[row], self._exists[row] = world, True
            self._done[row], self._acts_alone[row] = None, world.acts_alone
        return world

    def _new(self, **options: Any) -> Simulation:
        return type(self._first)(self._structures, **options)

    @property
    def first(self) -> Simulation:
        """A world like these, of which no episode has begun."""
        return self._first

    def _existing(self, rows: Integers) -> list[int]:
        """List which of some worlds exist by themselves."""
        found: list[int] = rows[self._exists[rows]].tolist()
        return found

    def __len__(self) -> int:
        """Return the number of worlds."""
        return len(self._worlds)

    def __getitem__(self, name: str) -> Value:
        """Return the present values of a variable, shape (n, *shape), as a copy.

        Raises:
            UnknownVariable: No variable has this name in one of the worlds.
            NotReset: No episode has begun in one of the worlds.
        """
        parts = []
        for table, rows in self.by_structure(self._all):
            table.compiled.model.declared(name)
            table.evaluate((name,), rows)
            parts.append((table[name][rows], rows))
        if len(parts) == 1:
            return parts[0][0]
        found = np.empty((len(self), *parts[0][0].shape[1:]), parts[0][0].dtype)
        for values, rows in parts:
            found[rows] = values
        return found

    @typed
    def tensor(self, name: str) -> Any:
        """Return a state of all worlds, shape (n, size); see ``Simulation.tensor``."""
        self._require_states(self._all)
        for table, _ in self.by_structure(self._all):
            table.compiled.model.declared(name)
        return self._engine.tensor(self._all, name)

    @property
    def index(self) -> Integers:
        """Number of finished control steps of each episode, shape (n,)."""
        found = np.zeros(len(self), dtype=int)
        for (compiled, _), rows in self._by_kind(np.flatnonzero(self._kind >= 0)):
            found[rows] = self._tables[compiled].numbers[rows, compiled.clock]
        for row in self._existing(self._all):
            found[row] = self._alone(row).index
        return found

    def _values(self, rows: Integers) -> dict[str, Value]:
        found: dict[str, Value] = {}
        for table, members in self.by_structure(rows):
            table.evaluate(None, members)
            common = [name for name in table.compiled.model if not found or name in found]
            there = np.searchsorted(rows, members)
            values = {name: table[name][members] for name in common}
            for name, one in values.items():
                found.setdefault(name, np.empty((len(rows), *one.shape[1:]), one.dtype))
                found[name][there] = one
            found = {name: found[name] for name in common}
        return found

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        episode: int | Sequence[int] = 0,
        where: Mask | None = None,
        do: Mapping[str, Any] | None = None,
        space: AnyRegion | None = None,
    ) -> Audits:
        """Begin an episode in all selected worlds; see ``Simulation.reset``.

        Args:
            seed: Seed of the first world, from which the others count up; or a list of seeds.
            episode: Number of the episode of every world with a seed, or a list of n numbers.
            where: Boolean mask of the worlds to reset, shape (n,); all if None.
            do: As in ``do``.
            space: As in ``do``.

        Returns:
            The audits of the intervention; without one, an empty table.

        Raises:
            InterventionError: The intervention was refused; the message names the world. The
                episodes of all selected worlds have begun without it.
        """
        seeds, numbers = read_seeds(seed, len(self)), read_numbers(episode, len(self))
        request = request_of(do)
        rows = np.flatnonzero(read_mask("where", where, len(self)))
        there = [self._first, *map(self._alone, self._existing(rows))]
        has_context = bool(getattr(request, "context", ()))  # a plan with layers, for all alike
        planned = has_times(request) or any(getattr(world, "plan", ()) for world in there)
        if not (planned or has_context):
            self._begin_all(rows, seeds, numbers)
            return self._do(request, rows, space) if request else Audits({}, {})
        flat = flatten(request)

        def begin(row: int) -> Audit | None:
            asked = request if has_context else self._request(row, flat)
            how = {"seed": seeds[row], "episode": numbers[row]}
            return self._alone(row).reset(**how, do=asked, space=space)

        try:
            found = self._everywhere(rows, begin)
        except ScmWorldError as error:
            if not isinstance(error, EngineFailure):
                self._everywhere(
                    rows,
                    lambda row: self._alone(row).reset(seed=seeds[row], episode=numbers[row]),
                )
            raise
        return Audits({row: audit for row, audit in found.items() if audit is not None}, {})

    def _begin_all(self, rows: Integers, seeds: Sequence[Any], numbers: Sequence[int]) -> None:
        """Begin an episode without interventions in some worlds, or in none of them."""
        back: list[Callable[[], None]] = []
        alike = self.begins_alike()
        apart = [row for row in rows.tolist() if row in self._shown or not alike]
        try:
            self._everywhere(
                np.array(apart, dtype=int),
                lambda row: self._alone(row).reset(seed=seeds[row], episode=numbers[row]),
                back,
            )
            if len(apart) < len(rows):
                together = np.setdiff1d(rows, apart)
                each = [(seeds[row], numbers[row]) for row in together.tolist()]
                self._begin_together(together, each, back)
        except BaseException:
            for undo in reversed(back):
                undo()
            raise

    def begins_alike(self) -> bool:
        """Return whether what is drawn at the beginning is numbers that move no body."""
        if any(variable.own_noise is not None for variable in self._structures.head.variables):
            return False
        natural = self._structures.natural(None)
        order = natural.static_order(natural.random)
        moves = natural.composition.solid and any(map(natural.moves_bodies, natural.random))
        return not moves and natural.composition.structural.isdisjoint(order)

    def _begin_together(
        self, rows: Integers, each: Sequence[tuple[Any, int]], back: list[Callable[[], None]]
    ) -> None:
        """Begin an episode in worlds that begin alike; see ``Simulation._begin``.

        ``each`` has the seed and the number of the episode of each world.
        """
        natural, engine = self._structures.natural(None), self._engine
        where, own, built = self._where[rows], list[int](), self._built[rows]
        where[:, 2] = 0
        lost = np.zeros(len(rows), bool)
        for place, (row, (seed, number)) in enumerate(zip(rows.tolist(), each, strict=True)):
            world, there = self._worlds[row], self._done[row] is not None
            if world is not None:
                built[place] = there = world.has_begun
                self._seeds[row], where[place, 1] = world.noise.seed, world.episode
                lost[place] = world.is_lost
            if seed is not None:
                own.append(CompiledNoise(seed).seed)
            else:
                own.append(self._seeds[row] if there else secrets.randbits(63))
            following = where[place, 1] + np.uint64(1) if there else 0
            where[place, 1] = following if seed is None else number
        where[:, 0] = [word_of(f"seed {seed}") for seed in own]
        fresh, again, kept = rows[~built], rows[built], rows[built & ~lost]
        if kept.size:
            back.append(partial(engine.restore, kept, engine.snapshot(kept)))
        first = self._structures.first.copy()
        if fresh.size:
            engine.build(fresh, natural.scene(first))
        if self._origin is None and fresh.size:
            first.numbers[: natural.state_size] = engine.read(fresh[:1])[0]
            structure, saved = natural.composition.structure(first), engine.snapshot(fresh[:1])
            self._origin = Snapshot(natural.model, first, structure, engine=saved[0])
        origin: Any = self._origin or self._alone(int(again[0]))._origin
        self._origin = origin
        if again.size:
            engine.restore(again, [origin.engine])
        numbers = np.repeat(origin.row.numbers[None], len(rows), axis=0)
        numbers[:, natural.fresh] = 0.0
        one = RowMemory(self._structures, origin.structure, natural, numbers, where, own)
        if natural.random:
            self._draw_nature(rows, one, numbers, beginnings(natural, first, where, one.key))
        number = self._number((natural, physics_steps(self._structures.options, origin.structure)))
        table = self._tables[natural]
        back.append(partial(table.numbers.__setitem__, rows, table.numbers[rows]))
        table.numbers[rows] = numbers
        table.remember(rows)
        numbers[:] = table.numbers[rows]
        self._check(table, fresh)
        for row in self._existing(rows):
            self._changes += getattr(self._worlds[row], "version", 0)
            self._worlds[row] = None
        self._exists[rows], self._built[rows], self._kind[rows] = False, True, number
        for place, row in enumerate(rows.tolist()):
            self._seeds[row] = own[place]
        self._gone.difference_update(rows.tolist())
        self._take(one, rows, np.arange(len(rows)), table)

    def _draw_nature(self, rows: Integers, one: RowMemory, numbers: Floats, then: Floats) -> None:
        """Change worlds that begin to what is drawn in them; see ``Simulation._draw_nature``."""
        compiled, size = one.compiled, one.compiled.state_size
        for places, changed, moved in changes(compiled, numbers, then)[0]:
            parameters = _parameters(Rows(compiled, then), changed, places)
            if parameters or moved:
                states = then[places, :size] if moved else None
                self._engine.apply(rows[places], parameters, states)
        layout = compiled.composition.system.layout
        held = layout.can_be_set & ~layout.engine_takes  # of which the engine knows nothing
        numbers[:] = then
        numbers[:, :size] = np.where(held, then[:, :size], self._engine.read(rows))
        numbers[:, compiled.fresh] = 0.0

    def _check(self, table: Rows, fresh: Integers) -> None:
        """Refuse worlds that begin for the first time if functions fail there."""
        compiled = table.compiled
        if not fresh.size:
            return
        fresh = fresh if compiled.random else fresh[:1]  # all are equal
        table.evaluate(None, fresh)
        wrong = np.zeros(len(fresh), bool)
        for name in compiled.readouts:
            values = table[name][fresh].reshape(len(fresh), -1)
            wrong |= ~np.isfinite(values).all(axis=1)
            bounds = compiled.model.declared(name).bounds
            wrong |= bounds is not None
        for row in {*fresh[:1].tolist(), *fresh[wrong].tolist()}:
            check_functions(compiled, table.row(row))
        warn_of_start(table.row(int(fresh[0])), stacklevel=6)

    def _do(
        self,
        request: Mapping[str, Any],
        rows: Integers,
        space: AnyRegion | None,
        *,
        skips: bool = False,
    ) -> Audits:
        flat = flatten(request)
        ready: list[tuple[RowMemory, Integers, Rows]] = []
        alone: list[int] = []
        alike: dict[Any, list[int]] = {}
        now = self.index == self._where[:, 2]
        for row in rows.tolist():
            done = self._done[row]
            if done is None:
                alone.append(row)
            else:
                alike.setdefault((id(done), now[row]), []).append(row)
        for group in alike.values():
            found = self._together(flat, np.array(group), space)
            if found is None:
                alone += group
                continue
            ready.append(found)
            alone += [group[place] for place in found[0].refused]
        refused: dict[int, InterventionError] = {}
        back: list[Callable[[], None]] = []

        def act(row: int) -> Audit:
            return self._alone(row).do(self._request(row, flat), space=space)

        try:
            alone_rows = np.array(sorted(alone), dtype=int)
            audits = self._everywhere(alone_rows, act, back, refused if skips else None)
            together = [part for each in ready for part in self._write(*each, back)]
        except BaseException:
            for undo in reversed(back):
                undo()
            raise
        for one, members, table in ready:
            places = np.setdiff1d(np.arange(len(members)), one.refused)
            which, differ = members[places], places[one.differs[places]]
            moved = members[differ]
            table.numbers[moved] = one.numbers[differ]
            table.numbers[moved, one.compiled.fresh] = 0.0
            if one.at_start and len(moved):
                table.remember(moved)
            del one.numbers
            self._take(one, which, places, table)
        return Audits(audits, refused, together)

    def _together(
        self, request: Mapping[str, Any], members: Integers, space: AnyRegion | None
    ) -> tuple[RowMemory, Integers, Rows] | None:
        """Compute an intervention in worlds that are alike; None if each has to do it alone."""
        below: Any = self._done[members[0]]
        compiled = below.compiled
        table = self._tables[compiled]
        try:
            named = dict(compiled.model.named(request))
        except InterventionError:
            return None
        each = values_of_each(compiled.model, named, len(self))
        values = {name: [all_of[row] for row in members] for name, all_of in each.items()}
        now, where = table.numbers[members], self._where[members]
        where[:, 2] = now[:, compiled.clock]
        seeds = [self._seeds[row] for row in members.tolist()]
        before = below, self._place[members]
        one = RowMemory(self._structures, below.structure, compiled, now, where, seeds, before)
        region = self._first.variables_space if space is None else as_region("space", space)
        return (one, members, table) if one.ask(named, values, region) else None

    def _take(self, one: RowMemory, rows: Integers, places: Integers, table: Rows) -> None:
        """Note what worlds have done together; their rows have the values already."""
        for row in rows.tolist():
            self._done[row] = one
        self._place[rows] = places
        self._where[rows] = one.where[places]
        self._changes += 1
        self._acts_alone[rows], commands = False, one.compiled.composition.commands
        if commands is not None:
            self._acts_alone[rows] = commands.applies(Rows(one.compiled, table.numbers[rows]))
        if self.names:
            table.evaluate(self.names, rows)

    def _write(
        self, one: RowMemory, members: Integers, table: Rows, back: list[Callable[[], None]]
    ) -> list[tuple[Integers, Callable[[int], Audit]]]:
        """Change the engine for worlds that intervene together; see ``Simulation._commit``.

        Returns:
            Their numbers, and what makes the audit of each; see ``Audits``.
        """
        compiled, size = one.compiled, one.compiled.state_size
        keys, known, targets = compiled.parameter_keys, compiled.inertias, compiled.model.targets
        wanted = {keys[t] for name in one.asked for t in targets(name) if t in keys}
        old, new = Rows(compiled, table.numbers[members]), Rows(compiled, one.numbers)
        layout = compiled.composition.system.layout
        settable, kept = layout.can_be_set, layout.can_be_set & ~layout.engine_takes
        remarked = self._first.backend.capabilities.remarks
        audits: list[tuple[Integers, Callable[[int], Audit]]] = []
        is_moved = False
        for group, changed, moved in one.groups:
            places = np.setdiff1d(group, one.refused) if one.refused else group
            if not len(places):
                continue
            which = members[places]
            before, then = (_parameters(each, changed, places) for each in (old, new))
            left, states = (each.numbers[places, :size] if moved else None for each in (old, new))
            inertia = self._engine.parameters(which, sorted({known[k] for k in then if k in known}))
            others = np.ones(len(which), bool)
            try:
                if then or moved:
                    self._engine.apply(which, then, states)
            except ScmWorldError as error:
                others = ~np.isin(which, error.scenes)
                raise located(error, error.scenes[0], "world") from error.__cause__
            finally:  # these have changed
                values = {key: value[others] for key, value in before.items()}
                earlier = None if left is None else left[others]
                back.append(partial(self._engine.apply, which[others], values, earlier))
            reported = self._engine.parameters(which, {*wanted, *then, *inertia})
            found = {".".join(key): (value, reported[key]) for key, value in then.items()}
            if states is not None:
                read = np.where(kept, states, self._engine.read(which))
                found["the state"] = states[:, settable], read[:, settable]
                one.numbers[places, :size], is_moved = read, True
            for name, (value, got) in found.items():
                near = np.isclose(got, value, READ_BACK, READ_BACK)
                if not near.all():
                    first = which[~near.reshape(len(which), -1).all(axis=1)][0]
                    said = f"the engine did not take over {name}"
                    raise located(EngineFailure(said, self._first.backend.name), first, "world")
            remarks: list[tuple[str, ...]] = []
            for at, row in enumerate(which.tolist()):
                if not then or remarked is Capabilities.remarks:  # no engine says anything
                    break
                backend = self._engine.alone(row, self._make, is_built=True)
                was = {key: value[at] for key, value in before.items()}
                remarks.append(backend.capabilities.remarks(backend, was))
            audits.append((which, partial(one.audit, places, inertia, reported, remarks)))
        one.states = one.numbers[:, :size].copy() if is_moved else None
        return audits

    def _request(self, row: int, flat: Mapping[str, Any]) -> dict[str, Any]:
        """Return the request of one world."""
        model = self._alone(row).model
        return of_row(flat, values_of_each(model, flat, len(self)), model, row)

    def _everywhere(
        self,
        rows: Integers,
        act: Callable[[int], Any],
        back: list[Callable[[], None]] | None = None,
        refused: dict[int, InterventionError] | None = None,
    ) -> dict[int, Any]:
        """Change worlds one after another: all, or none if one of them fails.

        Args:
            rows: Their numbers.
            act: What changes one of them.
            back: A list for the functions that undo it; the caller calls them after an error.
            refused: Errors of interventions by number of the world; they are raised if None.
        """
        found: dict[int, Any] = {}
        undoing: list[Callable[[], None]] = [] if back is None else back
        for row in rows.tolist():
            undoing.append(self._alone(row).way_back())
            try:
                found[row] = act(row)
            except BaseException as error:
                if refused is not None and isinstance(error, InterventionError):
                    refused[row] = error
                    continue
                for undo in undoing if back is None else ():
                    undo()
                if isinstance(error, ScmWorldError):
                    located(error, row, "world")
                raise
        return found

    def step(self, actions: ArrayLike, *, where: Mask | None = None) -> None:
        """Advance some worlds one control step.

        Args:
            actions: Shape (n, n_actions) in SI units; clipped to their range.
            where: Boolean mask of the worlds to step, shape (n,); all if None.

        Raises:
            ActionError: Wrong shape, or a number that is not finite. No world was stepped.
            InterventionError: A planned intervention of a world was refused. Nothing has changed.
            NotReset: No episode has begun in one of them.
            EngineFailure: The backend lost a state; all other worlds are one step further. The
                message names the world.
        """
        mask = read_mask("where", where, len(self))
        shape = len(self), self._first.compiled.n_actions
        given = read_actions(actions, mask, shape, "world")
        each: dict[int, Any] = {
            row: self._worlds[row] for row in self._existing(np.flatnonzero(mask))
        }
        due = [row for row, one in each.items() if one.is_planned and one._may_act(one.index)]
        if due:
            self._everywhere(np.array(due), lambda row: each[row].act())
        low, high = self._first.compiled.action_bounds
        try:
            self.advance(np.clip(given, low, high), None if where is None else mask)
        except EngineFailure as error:
            raise located(error, error.row, "world") from error.__cause__

    def world(self, index: int) -> Simulation:
        """Return a world by its number, or raise ``UnknownOption``.

        From then on it takes resets and interventions by itself, which costs more.
        """
        row = self._numbered(index)
        self._shown.add(row)
        return self._alone(row)

    @typed
    def table(self, index: int) -> Rows:
        """Return the rows of all worlds with the structure of one world."""
        index = self._numbered(index)
        return self.by_structure(self._all[index : index + 1])[0][0]

    def by_structure(self, rows: Integers) -> list[tuple[Rows, Integers]]:
        """Return the rows of some worlds by structure, with the numbers of these worlds."""
        return [(self._tables[kind[0]], members) for kind, members in self._groups(rows)]

    def advance(
        self,
        commands: Floats,
        which: Mask | None = None,
        within: Mapping[int, Floats] = MappingProxyType({}),
    ) -> None:
        """Advance worlds one control step; see ``Simulation.advance``.

        Args:
            commands: Finite numbers within the bounds, shape (n, n_actions).
            which: The worlds; all if None.
            within: By number of a world, what acts in each physics step in place of its command,
                shape (substeps, n_actions).

        Raises:
            NotReset: No episode has begun in one of the worlds.
            EngineFailure: The backend lost a state, or a step function failed and left its world
                unchanged, and all other worlds are one step further; or a world had lost its state
                before, and none was stepped. It has the number of the world.
        """
        rows = self._all if which is None else np.flatnonzero(which)
        self._require_states(rows)
        groups, sent = self._groups(rows), commands
        held: dict[int, Held] = {}
        late: Mapping[int, Floats] = within
        alone = rows[self._acts_alone[rows]].tolist()
        if alone:
            others = np.setdiff1d(rows, alone)
            commands, sent, late, held = self._decide(alone, others, commands, within)
        failed: EngineFailure | None = None
        for (compiled, substeps), members in groups:
            table = self._tables[compiled]
            table.prepare(members)
            kept = table.numbers[members if self._engine.may_refuse else members[:0]]
            table.advance(commands, members)
            try:
                self._step(members, sent, late, held, substeps, table.numbers)
            except BaseException as error:  # or Ctrl-C: the others were stepped
                unmoved = error.unmoved if isinstance(error, EngineFailure) else ()
                for place, row in enumerate(members.tolist()):
                    if row in unmoved:
                        table.numbers[row] = kept[place]
                        held.pop(row, None)
                table.numbers[members, : compiled.state_size] = self._engine.read(members)
                if not isinstance(error, EngineFailure):
                    raise
                self._gone.update(error.lost)
                for row in error.lost:
                    self._alone(row)._lose(f"the state was lost: {error}")
                failed = error.after(failed)
            finally:
                for row in members.tolist() if held else ():
                    if row in held:
                        numbers, size = held[row].numbers, compiled.state_size
                        table.numbers[row, size - numbers.size : size] = numbers
        if failed is not None:
            raise failed
        for (compiled, _), members in groups:
            self._tables[compiled].evaluate(self.names, members)

    def _decide(
        self, alone: list[int], others: Integers, commands: Floats, within: Mapping[int, Floats]
    ) -> tuple[Floats, Floats, dict[int, Floats], dict[int, Held]]:
        """Return actions, commands, those of each physics step, and what worlds keep; see above."""
        commands, late, held = commands.copy(), dict(within), dict[int, Held]()
        sent = np.zeros((len(self), self._first.structure.n_commands))
        if others.size:  # none, and a row of commands may be of another size
            sent[others] = commands[others]
        for row in alone:
            if row in within:
                now = [self._decided(row, one)[1].copy() for one in within[row]]
                late[row] = np.array([c if c.ndim == 1 else c[i] for i, c in enumerate(now)])
            commands[row], found, after = self._decided(row, commands[row])
            if found.ndim > 1:
                late.setdefault(row, found.copy())
            sent[row] = found if found.ndim == 1 else found[-1]
            if after is not None:
                held[row] = after
        return commands, sent, late, held

    def _step(
        self,
        members: Integers,
        sent: Floats,
        late: Mapping[int, Floats],
        held: Mapping[int, Held],
        substeps: int,
        into: Floats,
    ) -> None:
        """Step the engine, part by part where commands change within the control step."""
        mine = [row for row in members.tolist() if row in late] if late else []
        if not mine:
            self._engine.step(members, sent, substeps, into)
            return
        each = np.repeat(sent[None], substeps, axis=0)
        each[:, mine] = np.stack([late[row] for row in mine], axis=1)
        going, done, failed = members, 0, None
        samples = {step for row in mine if row in held for step in held[row].samples}
        for steps, part in parts(each, samples):
            try:
                self._engine.step(going, part, steps, into)
            except EngineFailure as error:
                if done:  # the control step was taken in part
                    error.lost, error.unmoved = (*error.lost, *error.unmoved), ()
                going = np.setdiff1d(going, (*error.lost, *error.unmoved))
                failed = error.after(failed)
            done += steps
            for row in going.tolist() if done in samples else ():
                if row in held:
                    held[row].see(done, into[row])
        if failed is not None:
            raise failed

    def _decided(self, row: int, action: Floats) -> tuple[Floats, Floats, Held | None]:
        """Compute what a control step does with an action; see ``Simulation._decided``."""
        world, done = self._worlds[row], self._done[row]
        if world is not None or done is None:
            return self._alone(row)._decided(action)
        own, key = self._tables[done.compiled].row(row), done.key(int(self._place[row]))
        key.step = int(own.numbers[done.compiled.clock])
        state = own.numbers[: done.compiled.state_size]
        commands: Any = done.compiled.composition.commands
        given = action, own, state, key, self._kinds[self._kind[row]][1]
        return action, commands.command(*given), commands.held(*given)

    def _require_states(self, rows: Integers) -> None:
        for row in self._gone.intersection(rows.tolist()) if self._gone else ():
            try:
                self._alone(row).require_state()
            except EngineFailure as error:
                error.row = row
                raise

    def _groups(self, rows: Integers) -> list[tuple[tuple[CompiledTask, int], Integers]]:
        """Group worlds by structure and number of physics steps; fill the rows of changed ones."""
        there: Sequence[Any] = self._worlds
        changed = [n for n in self._existing(rows) if there[n].version != self._versions[n]]
        for row in changed:
            self._fill(row)
        if changed:
            for (compiled, _), members in self._by_kind(np.array(changed)):
                self._tables[compiled].evaluate(self.names, members)
            for row in changed:
                self._versions[row] = there[row].version
        return self._by_kind(rows)

    def _by_kind(self, rows: Integers) -> list[tuple[tuple[CompiledTask, int], Integers]]:
        kinds = self._kind[rows]
        if len(rows) and kinds[0] >= 0 and not np.count_nonzero(kinds != kinds[0]):
            return [(self._kinds[kinds[0]], rows)]
        if np.count_nonzero(kinds < 0):
            raise NotReset(closed=self._is_closed)
        return [(self._kinds[n], rows[kinds == n]) for n in dict.fromkeys(kinds.tolist())]

    def _fill(self, row: int) -> None:
        """Assign a world its row in the table of its structure."""
        world = self._alone(row)
        world._require_episode()
        self._kind[row] = self._number((world.compiled, world.substeps))
        self._acts_alone[row] = world.acts_alone
        table = self._tables[world.compiled]
        if world.row.numbers.base is not table.numbers:
            world.move(table.row(row))

    def _number(self, kind: tuple[CompiledTask, int]) -> int:
        """Return the number of a kind of worlds, which have a table; forget unused ones."""
        if kind not in self._kinds:
            used, numbers = np.unique(self._kind, return_inverse=True)
            none = int(used[:1].tolist() == [-1])
            self._kinds = [*[self._kinds[n] for n in used[none:].tolist()], kind]
            self._kind = numbers - none
            tables = {one: self._tables.get(one) for one, _ in self._kinds}
            if tables[kind[0]] is None:
                fresh = np.repeat(kind[0].start[None], len(self), axis=0)
                tables[kind[0]] = Rows(kind[0], fresh)
            self._tables = {one: table for one, table in tables.items() if table is not None}
        return self._kinds.index(kind)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the parts for copying and pickling."""
        if self._options is None:
            return partial(type(self), threads=self.threads, names=self.names), (self._worlds,)
        begun = {row: self._alone(row) for row in np.flatnonzero(self._kind >= 0).tolist()}
        saved = {row: world.snapshot() for row, world in begun.items() if world.has_begun}
        given = self._options, len(self), self.threads, self.names
        return _copied, (type(self), saved, self._first, *given)

    def close(self) -> None:
        """Free the backends of all worlds."""
        for world in (self._first, *map(self._alone, self._existing(self._all))):
            world.close()
        self._engine.close()
        self._is_closed |= any(done is not None for done in self._done)
        self._kind[~self._exists] = -1
        self._done, self._built[:] = [None] * len(self), False


def _copied(kind: type[Batch], saved: Mapping[int, Snapshot], *given: Any) -> Batch:
    made = kind._like(*given)
    for row, snapshot in saved.items():
        made._alone(row).restore(snapshot)
    return made


def _parameters(rows: Rows, names: Iterable[str], places: Integers) -> dict[Any, Value]:
    keys = rows.compiled.parameter_keys
    return {keys[name]: rows[name][places] for name in names if name in keys}


# --- arguments of many worlds ---------------------------------------------------------------------


def located(error: ScmWorldError, index: int, what: str) -> ScmWorldError:
    """Prefix an error with the number of its world."""
    error.args = (f"{what} {index}: {error.args[0]}", *error.args[1:])
    return error


def read_seeds(seed: object, size: int) -> list[Any]:
    """Return the seed of each world; one seed counts up."""
    if seed is None:
        return [None] * size
    if not isinstance(seed, Sequence | np.ndarray) or isinstance(seed, str) or not np.ndim(seed):
        first = whole_number("seed", seed, least=0)
        return [*range(first, first + size)]
    if len(seed) != size:
        raise UnknownOption("seed", seed, ("a whole number", f"a list of {size} of them or None"))
    return [*seed]


def read_numbers(episode: Any, size: int) -> list[int]:
    """Return the number of the episode of each world; one number is that of all."""
    each = [*episode] if np.ndim(episode) else [episode] * size
    if len(each) != size:
        raise UnknownOption("episode", episode, ("a whole number", f"a list of {size} of them"))
    return [whole_number("episode", number, least=0, most=EPISODES) for number in each]


def values_of_each(model: SCM, request: Mapping[str, Any], count: int) -> dict[str, Any]:
    """Return what a request has for each of so many worlds, by name: values with a leading axis."""
    found: dict[str, Any] = {}
    for name, act in model.named(request).items():
        values: Any = act.value if isinstance(act, Hard) and act.time is None else act
        if name not in model or not isinstance(values, list | tuple | np.ndarray):
            continue
        if np.shape(values) == (count, *model.declared(name).shape):
            found[name] = values
    return found


def of_row(
    request: Mapping[str, Any], each: Mapping[str, Any], model: SCM, row: int
) -> dict[str, Any]:
    """Return the request of one world, of values that there are for each."""
    found = dict(model.named(request))
    for name, values in each.items():
        act, one = found[name], {"value": values[row]}
        found[name] = act.model_copy(update=one) if isinstance(act, Hard) else values[row]
    return found


def read_mask(name: str, mask: object, size: int) -> Mask:
    """Return a checked boolean mask of worlds; all if None."""
    if mask is None:
        return np.ones(size, bool)
    is_array = isinstance(mask, np.ndarray) and mask.dtype == np.bool_ and mask.shape == (size,)
    if not is_array or not np.asarray(mask).any():
        allowed = (f"an array of {size} truth values, at least one of them true",)
        raise UnknownOption(name, mask, allowed)
    return np.array(mask)


def read_actions(
    actions: ArrayLike, which: Mask | None, shape: tuple[int, int], what: str
) -> Floats:
    """Return the checked actions of all worlds, of which ``which`` are stepped, in a shape.

    A world is called ``what`` in errors.
    """
    try:
        given = real_numbers(actions)
    except (TypeError, ValueError):  # text, or a ragged list
        given = np.empty(0)
    count, size = shape
    if given.shape != shape:
        raise ActionError(
            f"actions of {count} {what}s have shape {shape}, got {given.shape}", actions
        )
    if np.isfinite(given).all():
        return given
    wrong = np.flatnonzero(~np.isfinite(given).all(axis=1) & (True if which is None else which))
    if wrong.size:
        numbers = "a finite number" if size == 1 else f"{size} finite numbers"
        text = f"{what} {wrong[0]}: an action is {numbers}, got {given[wrong[0]]!r}"
        raise ActionError(text, actions)
    return given
