"""A batch of worlds that are stepped together, each with its own parameters, noise and clock."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from inspect import signature
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import one_of, real_numbers, typed, whole_number
from scm_world._types import ArrayLike, Floats, Integers, Value
from scm_world.backends import Backend
from scm_world.errors import (
    ActionError,
    EngineFailure,
    InterventionError,
    ScmWorldError,
    UnknownOption,
)
from scm_world.graph import SCM, flatten
from scm_world.graph.scm import request_of
from scm_world.runs.processes import cores
from scm_world.variables import Hard
from scm_world.variables.interventions import has_times
from scm_world.variables.subsets import AnyRegion
from scm_world.world.audit import Audit, Audits
from scm_world.world.compiled_task import CompiledTask
from scm_world.world.mechanisms import Rows
from scm_world.world.shared_transaction import SharedTransaction
from scm_world.world.simulation import READ_BACK, Simulation

OF_WORLD = frozenset(signature(Simulation).parameters)
"""Options of a world; all others are options of its task."""

Mask = NDArray[np.bool_]


class Batch:
    """Worlds of one task, options and backend, advanced in one call.

    The present values of each world are a row in the matrix of all worlds of its structure. A world
    in a batch is bit-identical to a world that is stepped alone, and can be used alone at any time.
    ``World(task, num_worlds=n)`` returns a batch.

    Args:
        worlds: The worlds; the batch owns them from now on.
        threads: Number of threads of a backend with several; the number of cores if None.
        names: Variables that are computed after every step.

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
        self._worlds = tuple(worlds)
        if not self._worlds:
            raise UnknownOption("worlds", [], ("one or more",))
        kinds = {(world.identity, world.engine) for world in self._worlds}
        if len(kinds) > 1:
            raise UnknownOption("worlds", kinds, ("worlds of one task, options and engine",))
        count = self._threads = (
            cores() if threads is None else whole_number("threads", threads, least=1)
        )
        backends = [world.backend for world in self._worlds]
        self._engine = backends[0].batch.of(backends, count)
        self._names, n = tuple(names), len(self._worlds)
        self._tables: dict[CompiledTask, Rows] = {}
        self._versions = [-1] * n  # of each world when its row was filled
        self._kinds: list[Any] = [None] * n  # structure of each world, and physics steps
        self._gone: set[int] = set()  # worlds that have lost their state once
        self._all = np.arange(n)

    @classmethod
    def _of(
        cls,
        kind: type[Simulation],
        num_worlds: int,
        task: Any = "pushing",
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
        first = kind(task, **options)
        of_world = {name: value for name, value in options.items() if name in OF_WORLD}
        return cls(
            [first, *(kind(first.structures, **of_world) for _ in range(n - 1))], threads=threads
        )

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
        for table, rows in self._by_structure(self._all):
            self._worlds[rows[0]].model.declared(name)
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
        for world in self._worlds:
            world.require_state()
        self._worlds[0].model.declared(name)
        return self._engine.tensor(self._all, name)

    @property
    def index(self) -> Integers:
        """Number of finished control steps of each episode, shape (n,)."""
        return np.array([world.index for world in self._worlds])

    def values(self, *, where: Any = None) -> dict[str, Value]:
        """Return the present values of all variables that the selected worlds have.

        Args:
            where: Boolean mask of the worlds, shape (n,); all if None.

        Returns:
            By name, shape (m, *shape), with the m selected worlds in their order; as copies.

        Raises:
            NotReset: No episode has begun in one of them.
        """
        rows = np.flatnonzero(read_mask("where", where, len(self)))
        found: dict[str, Value] = {}
        for table, members in self._by_structure(rows):
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
        where: Any = None,
        do: Mapping[str, Any] | None = None,
        space: AnyRegion | None = None,
    ) -> Audits:
        """Begin an episode in all selected worlds; see ``Simulation.reset``.

        Args:
            seed: Seed of the first world, from which the others count up; or a list of seeds.
            where: Boolean mask of the worlds to reset, shape (n,); all if None.
            do: As in ``do``.
            space: As in ``do``.

        Returns:
            The audits of the intervention; without one, an empty table.

        Raises:
            InterventionError: The intervention was refused; the message names the world. The
                episodes of all selected worlds have begun without it.
        """
        seeds, request = read_seeds(seed, len(self)), request_of(do)
        flat = flatten(request)
        rows = np.flatnonzero(read_mask("where", where, len(self)))
        worlds = [self._worlds[row] for row in rows.tolist()]
        has_context = bool(getattr(request, "context", ()))  # a plan with layers, for all alike
        planned = has_times(request) or any(getattr(world, "plan", ()) for world in worlds)
        planned |= has_context

        def begin(row: int) -> Audit | None:
            if not planned:
                return self._worlds[row].reset(seed=seeds[row])
            asked = request if has_context else self._request(row, flat)
            return self._worlds[row].reset(seed=seeds[row], do=asked, space=space)

        try:
            found = self._everywhere(rows, begin)
        except InterventionError:
            self._everywhere(rows, lambda row: self._worlds[row].reset(seed=seeds[row]))
            raise
        if planned or not request:
            return Audits({row: audit for row, audit in found.items() if audit is not None}, {})
        return self._do(request, rows, space)

    def do(
        self,
        request: Mapping[str, Any],
        *,
        where: Any = None,
        space: AnyRegion | None = None,
        on_refusal: Literal["raise", "skip"] = "raise",
    ) -> Audits:
        """Intervene now in all selected worlds; see ``Simulation.do``.

        Parameters that move no body are set, or drawn from boxes, in all rows at once; other
        interventions are computed in one world after another. Both give the same bits.

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

    def _do(
        self,
        request: Mapping[str, Any],
        rows: Integers,
        space: AnyRegion | None,
        *,
        skips: bool = False,
    ) -> Audits:
        alike: dict[Any, list[int]] = {}
        for row in rows.tolist():
            alike.setdefault(self._worlds[row].alike(), []).append(row)
        flat = flatten(request)
        ready: list[tuple[SharedTransaction, Integers, Rows]] = []
        alone: list[int] = []
        for group in alike.values():
            found = self._together(flat, np.array(group), space) if len(group) > 1 else None
            if found is None:
                alone += group
                continue
            ready.append(found)
            alone += [group[place] for place in found[0].refused]
        refused: dict[int, InterventionError] = {}
        back: list[Callable[[], None]] = []

        def act(row: int) -> Audit:
            return self._worlds[row].do(self._request(row, flat), space=space)

        try:
            alone_rows = np.array(sorted(alone), dtype=int)
            audits = self._everywhere(alone_rows, act, back, refused if skips else None)
            for one, members, table in ready:
                audits |= self._write(one, members, table, back)
        except BaseException:
            for undo in reversed(back):
                undo()
            raise
        for one, members, table in ready:
            self._take(one, members, table)
        return Audits({row: audits[row] for row in sorted(audits)}, refused)

    def _together(
        self, request: Mapping[str, Any], members: Integers, space: AnyRegion | None
    ) -> tuple[SharedTransaction, Integers, Rows] | None:
        """Compute an intervention in worlds that are alike; None if each has to do it alone."""
        table = self._by_structure(members)[0][0]
        worlds = [self._worlds[row] for row in members.tolist()]
        try:
            named = dict(worlds[0].model.named(request))
        except InterventionError:
            return None
        each = values_of_each(worlds[0].model, named, len(self))
        values = {name: [all_of[row] for row in members] for name, all_of in each.items()}
        one = SharedTransaction(worlds, table.numbers[members], named, values, space)
        return (one, members, table) if one.fits else None

    def _write(
        self, one: SharedTransaction, members: Integers, table: Rows, back: list[Callable[[], None]]
    ) -> dict[int, Audit]:
        """Change the engine for worlds that intervene together; see ``Simulation._commit``."""
        compiled, taken = one.compiled, np.ones(len(members), bool)
        keys, known, taken[one.refused] = compiled.parameter_keys, compiled.inertias, False
        wanted = {keys[name] for name in one.asked if name in keys}
        old, new = Rows(compiled, table.numbers[members]), Rows(compiled, one.numbers)
        audits: dict[int, Audit] = {}
        patterns, of = np.unique(one.changed, axis=0, return_inverse=True)
        for number, pattern in enumerate(patterns):  # nearly always the same in all of them
            places = np.flatnonzero(taken & (of.ravel() == number))
            which = members[places]
            changed = [n for n, is_one in zip(one.names, pattern, strict=True) if is_one]
            before, then = (
                {keys[n]: row[n][places] for n in changed if n in keys} for row in (old, new)
            )
            if not len(places):
                continue
            inertia = self._engine.parameters(which, sorted({known[k] for k in then if k in known}))
            others = np.ones(len(which), bool)
            try:
                if then:
                    self._engine.apply(which, then)
            except ScmWorldError as error:
                others = ~np.isin(which, error.scenes)
                raise located(error, error.scenes[0], "world") from error.__cause__
            finally:  # these have changed
                values = {key: value[others] for key, value in before.items()}
                back.append(partial(self._engine.apply, which[others], values))
            reported = self._engine.parameters(which, {*wanted, *then, *inertia})
            for key, value in then.items():
                near = np.isclose(reported[key], value, READ_BACK, READ_BACK)
                if not near.all():
                    first = which[~near.reshape(len(which), -1).all(axis=1)][0]
                    said = f"the engine did not take over {'.'.join(key)}"
                    raise located(
                        EngineFailure(said, self._worlds[first].backend.name), first, "world"
                    )
            for at, place in enumerate(places.tolist()):
                backend = self._worlds[row := int(members[place])].backend
                was = {key: value[at] for key, value in before.items()}
                remarks = backend.capabilities.remarks(backend, was) if then else ()
                was_inert, back_now = (
                    {k: v[at] for k, v in each.items()} for each in (inertia, reported)
                )
                audits[row] = Audit(partial(one.report, place, was_inert, back_now, remarks))
        return audits

    def _take(self, one: SharedTransaction, members: Integers, table: Rows) -> None:
        """Change the rows of worlds that intervene together."""
        taken = np.ones(len(members), bool)
        taken[one.refused] = False
        members, numbers, changed = members[taken], one.numbers[taken], one.changed[taken]
        table.numbers[members] = numbers
        moved = members[changed.any(axis=1)]
        table.numbers[moved, one.compiled.fresh] = 0.0
        if one.at_start and len(moved):
            table.remember(moved)
        for place, row in zip(np.flatnonzero(taken).tolist(), members.tolist(), strict=True):
            self._worlds[row].take(one, place)

    def _request(self, row: int, flat: Mapping[str, Any]) -> dict[str, Any]:
        """Return the request of one world."""
        model = self._worlds[row].model
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
            undoing.append(self._worlds[row].way_back())
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

    def step(self, actions: ArrayLike, *, where: Any = None) -> None:
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
        shape = len(self), self._worlds[0].compiled.n_actions
        given = read_actions(actions, mask, shape, "world")
        planned: Any = {i: one for i, one in enumerate(self._worlds) if one.is_planned and mask[i]}
        due = [row for row, one in planned.items() if one._may_act(one.index)]
        if due:
            self._everywhere(np.array(due), lambda row: planned[row].act())
        low, high = self._worlds[0].compiled.action_bounds
        try:
            self.advance(np.clip(given, low, high), None if where is None else mask)
        except EngineFailure as error:
            raise located(error, error.row, "world") from error.__cause__

    def world(self, index: int) -> Simulation:
        """Return a world by its number, or raise ``UnknownOption``."""
        if whole_number("world", index, least=0) >= len(self):
            allowed = (f"any whole number from 0 to {len(self) - 1}",)
            raise UnknownOption("world", index, allowed)
        return self._worlds[index]

    @typed
    def table(self, index: int) -> Rows:
        """Return the rows of all worlds with the structure of one world."""
        self.world(index)  # refuses one that there is not
        return self._by_structure(self._all[index : index + 1])[0][0]

    def _by_structure(self, rows: Integers) -> list[tuple[Rows, Integers]]:
        """Return the rows of some worlds by structure, with the numbers of these worlds."""
        return [(self._tables[kind[0]], members) for kind, members in self._groups(rows)]

    def advance(self, commands: Floats, which: Mask | None = None) -> None:
        """Advance worlds one control step, all if ``which`` is None; see ``Simulation.advance``.

        Commands are finite numbers within the bounds, shape (n, n_actions).

        Raises:
            NotReset: No episode has begun in one of the worlds.
            EngineFailure: The backend lost a state, or a step function failed and left its world
                unchanged, and all other worlds are one step further; or a world had lost its state
                before, and none was stepped. It has the number of the world.
        """
        rows = self._all if which is None else np.flatnonzero(which)
        self._require_states(rows)
        groups, sent = self._groups(rows), commands
        held: dict[int, Floats] = {}
        alone = [row for row in rows.tolist() if self._worlds[row].acts_alone]
        if alone:
            commands = commands.copy()
            sent = np.zeros((len(self), self._worlds[0].structure.n_commands))
            for row in np.setdiff1d(rows, alone).tolist():
                sent[row] = commands[row]
            for row in alone:
                commands[row], sent[row], numbers = self._worlds[row]._decided(commands[row])
                if numbers is not None:
                    held[row] = numbers
        failed: EngineFailure | None = None
        for (compiled, substeps), members in groups:
            table = self._tables[compiled]
            table.prepare(members)
            kept = table.numbers[members if self._engine.may_refuse else members[:0]]
            table.advance(commands, members)
            try:
                self._engine.step(members, sent, substeps, table.numbers)
            except BaseException as error:  # or Ctrl-C: the others were stepped
                unmoved = error.unmoved if isinstance(error, EngineFailure) else ()
                for place, row in enumerate(members.tolist()):
                    if row in unmoved:
                        table.numbers[row] = kept[place]
                        held.pop(row, None)
                    self._worlds[row].backend.read(self._worlds[row].state)
                if not isinstance(error, EngineFailure):
                    raise
                self._gone.update(error.lost)
                for row in error.lost:
                    self._worlds[row]._lose(f"the state was lost: {error}")
                failed = error.after(failed)
            finally:
                for row in members.tolist() if held else ():
                    if row in held:
                        self._worlds[row].vector[-held[row].size :] = held[row]
        if failed is not None:
            raise failed
        for (compiled, _), members in groups:
            self._tables[compiled].evaluate(self._names, members)

    def _require_states(self, rows: Integers) -> None:
        for row in self._gone.intersection(rows.tolist()) if self._gone else ():
            try:
                self._worlds[row].require_state()
            except EngineFailure as error:
                error.row = row
                raise

    def _groups(self, rows: Integers) -> list[tuple[tuple[CompiledTask, int], Integers]]:
        """Group worlds by structure and number of physics steps; fill the rows of changed ones."""
        changed = [n for n in rows.tolist() if self._worlds[n].version != self._versions[n]]
        for row in changed:
            self._fill(row)
        if changed:
            for (compiled, _), members in self._by_kind(np.array(changed)):
                self._tables[compiled].evaluate(self._names, members)
            for row in changed:
                self._versions[row] = self._worlds[row].version
        return self._by_kind(rows)

    def _by_kind(self, rows: Integers) -> list[tuple[tuple[CompiledTask, int], Integers]]:
        first = self._kinds[0]
        if self._kinds.count(first) == len(self._worlds):
            return [(first, rows)] if len(rows) else []
        found: dict[Any, list[int]] = {}
        for row in rows.tolist():
            found.setdefault(self._kinds[row], []).append(row)
        return [(kind, np.array(members)) for kind, members in found.items()]

    def _fill(self, row: int) -> None:
        """Let a world use its row in the table of its structure."""
        world = self._worlds[row]
        world._require_episode()
        self._kinds[row] = world.compiled, world.substeps
        if world.compiled not in self._tables:
            used = {kind[0] for kind in self._kinds if kind}
            kept = {one: table for one, table in self._tables.items() if one in used}
            start = world.compiled.start[None]
            rows_of_it = Rows(world.compiled, np.repeat(start, len(self), axis=0))
            self._tables = {**kept, world.compiled: rows_of_it}
        table = self._tables[world.compiled]
        if world.row.numbers.base is not table.numbers:
            world.move(table.row(row))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the parts for copying and pickling."""
        return partial(type(self), threads=self._threads, names=self._names), (self._worlds,)

    def close(self) -> None:
        """Free the backends of all worlds."""
        for world in self._worlds:
            world.close()


# --- arguments of many worlds ---------------------------------------------------------------------


def located(error: ScmWorldError, index: int, what: str) -> ScmWorldError:
    """Prefix an error with the number of its world."""
    error.args = (f"{what} {index}: {error.args[0]}", *error.args[1:])
    return error


def read_seeds(seed: Any, size: int) -> list[Any]:
    """Return the seed of each world; one seed counts up."""
    if seed is None:
        return [None] * size
    if not isinstance(seed, Sequence | np.ndarray) or isinstance(seed, str) or not np.ndim(seed):
        first = whole_number("seed", seed, least=0)
        return [*range(first, first + size)]
    if len(seed) != size:
        raise UnknownOption("seed", seed, ("a whole number", f"a list of {size} of them or None"))
    return [*seed]


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


def read_mask(name: str, mask: Any, size: int) -> Mask:
    """Return a checked boolean mask of worlds; all if None."""
    if mask is None:
        return np.ones(size, bool)
    read = isinstance(mask, np.ndarray) and mask.shape == (size,) and mask.dtype == np.bool_
    if not (read and mask.any()):
        allowed = (f"an array of {size} truth values, at least one of them true",)
        raise UnknownOption(name, mask, allowed)
    return np.array(mask)


def read_actions(actions: Any, which: Mask | None, shape: tuple[int, int], what: str) -> Floats:
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
