"""Worlds of one causal model without a backend, solved together."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from copy import copy, deepcopy
from functools import partial
from typing import Any, final

import numpy as np

from scm_world._arguments import one_of, typed, whole_number
from scm_world._types import ArrayLike, Floats, Integers, Mask, Value
from scm_world.errors import FunctionFailure, InterventionError, ScmWorldError
from scm_world.graph import flatten
from scm_world.graph.scm import request_of
from scm_world.variables.interventions import has_times
from scm_world.variables.subsets import AnyRegion
from scm_world.world.audit import Applied, Audit, Audits
from scm_world.world.batch import (
    WorldsInRows,
    located,
    of_row,
    read_actions,
    read_mask,
    read_numbers,
    read_seeds,
    values_of_each,
)
from scm_world.world.equations import LATE, Equations
from scm_world.world.interventions import same
from scm_world.world.mechanisms import Rows

Part = tuple[Equations, Integers]
"""Equations of some worlds, and the numbers of these."""


class EquationBatch(WorldsInRows):
    """Worlds of one causal model, each with its own noise, clock and interventions; see ``Batch``.

    Worlds at the same control step, under interventions on the same variables, are solved together
    if the functions of the model are vectorised. A world is bit-identical to one that is stepped
    alone if they compute number by number; a matrix product in a function may change last digits.
    ``World(model, num_worlds=n)`` returns one.

    Args:
        one: Equations without an episode, of which all worlds are copies.
        num_worlds: Number of worlds.

    Raises:
        UnknownOption: ``num_worlds`` is not a positive whole number.

    Example:
        >>> from scm_world import SCM, World
        >>> from scm_world.variables import Derived, Exogenous, Linear, Normal
        >>> worlds = World(SCM([
        ...     Exogenous(name="x", distribution=Normal()),
        ...     Derived(name="y", parents=("x",), mechanism=Linear(weights=(2.0,))),
        ... ]), num_worlds=3)
        >>> _ = worlds.reset(seed=0, do={"x": [0.5, 1.0, 1.5]})
        >>> worlds["y"]
        array([1., 2., 3.])
    """

    @typed
    def __init__(self, one: Equations, num_worlds: int) -> None:
        self._one, n = one, whole_number("num_worlds", num_worlds, least=1)
        self._all = np.arange(n)
        self._out: set[int] = set()  # worlds that somebody else has, too
        self._parts: list[Part] = [(one.several(n), self._all)]
        if not one.compiled.is_vectorised:
            self._parts = [(copy(one), self._all[row : row + 1]) for row in range(n)]

    def __len__(self) -> int:
        """Return the number of worlds."""
        return len(self._all)

    def __getitem__(self, name: str) -> Value:
        """Return the present values of a variable, shape (n, *shape), as a copy.

        Raises:
            UnknownVariable: No variable has this name.
            NotReset: No episode has begun in one of the worlds.
        """
        return self._gathered((self._one.model.declared(name).name,), self._all)[name]

    def _values(self, rows: Integers) -> dict[str, Value]:
        return self._gathered(tuple(self._one.model), rows)

    def _gathered(self, names: tuple[str, ...], rows: Integers) -> dict[str, Value]:
        if len(self._parts) == 1 and len(rows) == len(self):
            ((part, _),) = self._parts
            now = part.evaluate(names)
            return {n: np.array(now[n] if part.is_several else now[n][None]) for n in names}
        found: dict[str, Value] = {}
        place = np.full(len(self), -1)
        place[rows] = np.arange(len(rows))
        for part, members in self._parts:
            inside = place[members] >= 0
            now = part.evaluate(names) if inside.any() else {}
            for name in names if now else ():
                value = now[name] if part.is_several else now[name][None]
                if name not in found:
                    found[name] = np.empty((len(rows), *value.shape[1:]), value.dtype)
                found[name][place[members[inside]]] = value[inside]
        return found

    @property
    def index(self) -> Integers:
        """Number of finished control steps of each episode, shape (n,)."""
        found = np.empty(len(self), dtype=int)
        for part, members in self._parts:
            found[members] = part.index
        return found

    def world(self, index: int) -> Equations:
        """Return a world by its number, or raise ``UnknownOption``; it is solved alone then."""
        index = self._numbered(index)
        at = next(i for i, (_, members) in enumerate(self._parts) if index in members)
        part, members = self._parts.pop(at)
        if part.is_several:
            mine = members == index
            if not mine.all():
                self._parts.append((part.of(np.flatnonzero(~mine)), members[~mine]))
            part = part.of(np.flatnonzero(mine), alone=True)
        self._parts.append((part, np.array([index])))
        self._out.add(index)
        return part

    # --- changes --------------------------------------------------------------------------------

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        episode: int | Sequence[int] = 0,
        where: Mask | None = None,
        do: Mapping[str, Any] | None = None,
        space: AnyRegion | None = None,
    ) -> Audits:
        """Begin an episode in all selected worlds; see ``Batch.reset``."""
        mask, request = read_mask("where", where, len(self)), request_of(do)
        seeds = read_seeds(seed, len(self))
        numbers = np.array(read_numbers(episode, len(self)), dtype=np.uint64)
        for part, members in self._parts if any(one is None for one in seeds) else ():
            now = zip(members.tolist(), part.seeds, np.ravel(part.episode), strict=True)
            for row, old, number in now:
                if seeds[row] is None and part.has_begun:
                    seeds[row], numbers[row] = old, number + 1
                elif seeds[row] is None:
                    seeds[row], numbers[row] = secrets.randbits(63), 0

        def begin(asked: Mapping[str, Any]) -> Callable[[Equations, Integers], Audit | None]:
            def act(part: Equations, members: Integers) -> Audit | None:
                noise: Any = [seeds[row] for row in members], numbers[members]
                one, number = noise if part.is_several else (noise[0][0], int(noise[1][0]))
                here = self._request(asked, members, several=part.is_several)
                return part.reset(seed=one, episode=number, do=here or None, space=space)

            return act

        try:
            return self._change(mask, begin(request), request)
        except InterventionError:
            self._change(mask, begin({}))
            raise

    def _do(
        self,
        request: Mapping[str, Any],
        rows: Integers,
        space: AnyRegion | None,
        *,
        skips: bool = False,
    ) -> Audits:
        def act(part: Equations, members: Integers) -> Audit:
            return part.do(self._request(request, members, several=part.is_several), space=space)

        return self._change(np.isin(self._all, rows), act, request_of(request), skips=skips)

    def step(self, actions: ArrayLike, *, where: Mask | None = None) -> None:
        """Advance some worlds one control step.

        Args:
            actions: Shape (n, n_actions); clipped to their range.
            where: Boolean mask of the worlds to step, shape (n,); all if None.

        Raises:
            ActionError: Wrong shape, or a number that is not finite. No world was stepped.
            InterventionError: A planned intervention of a world was refused. Nothing has changed.
            ModelError: The model has no lagged edges, so that it has one instant.
            NotReset: No episode has begun in one of them.
        """
        mask = read_mask("where", where, len(self))
        given = read_actions(actions, mask, (len(self), self._one.compiled.n_actions), "world")

        def act(part: Equations, members: Integers) -> None:
            part.step(given[members] if part.is_several else given[members[0]])

        (part, _), *others = self._parts
        if where is None and part.is_several and not others:
            with suppress(ScmWorldError):  # found again below, with the number of the world
                part.step(given)
                return
        self._change(mask, act)

    def _request(
        self, request: Mapping[str, Any], members: Integers, *, several: bool
    ) -> Mapping[str, Any]:
        """Return the request of some worlds, each with its own values."""
        each, model = self._each(request), self._one.model
        if not each:
            return request
        if not several:
            return of_row(flatten(request), each, model, int(members[0]))
        mine = {name: np.asarray(values)[members] for name, values in each.items()}
        return {**model.named(flatten(request)), **mine}

    def _each(self, request: Mapping[str, Any]) -> dict[str, Any]:
        return values_of_each(self._one.model, flatten(request), len(self))

    def _change(
        self,
        mask: Mask,
        act: Callable[[Equations, Integers], Audit | None],
        request: Mapping[str, Any] | None = None,
        *,
        skips: bool = False,
    ) -> Audits:
        """Change all selected worlds, or none if one of them fails, unless refusals are skipped."""
        back, each = self.way_back(), self._each(request) if request else {}
        found, refused, parts = dict[int, Audit](), dict[int, InterventionError](), list[Part]()
        named = self._one.model.named(flatten(request)) if each and request else {}
        differ = {name: named[name] for name in each}
        try:
            for whole in self._parts:
                chosen, other = _split(*whole, mask)
                parts += other
                todo = self._divided(chosen, request or {}, each)
                while todo:
                    one, rows = todo.pop(0)
                    before = copy(one)
                    try:
                        audit = act(one, rows)
                    except ScmWorldError as error:
                        if one.is_several:  # each answers for itself
                            todo = self._singles(before, rows) + todo
                        elif skips and isinstance(error, InterventionError):
                            refused[int(rows[0])] = error
                            parts.append((one, rows))
                        else:
                            raise located(error, int(rows[0]), "world") from error.__cause__
                        continue
                    parts.append((one, rows))
                    if audit is not None:
                        for place, row in enumerate(rows.tolist()):
                            asked = partial(self._request, differ, rows[place:], several=False)
                            own = partial(_of_row, audit, place, asked)
                            found[row] = Audit(own) if one.is_several else audit
        except BaseException:
            back()
            raise
        self._parts = parts if len(parts) == 1 else self._merged(parts)
        return Audits({row: found[row] for row in sorted(found)}, refused)

    def way_back(self) -> Callable[[], None]:
        """Return a function that restores the present bit-identically."""
        parts = [(part, dict(vars(part)), members) for part, members in self._parts]

        def back() -> None:
            for part, state, _ in parts:
                version = part.version + 1
                vars(part).clear()
                vars(part).update(state, version=version)
            self._parts = [(part, members) for part, _, members in parts]

        return back

    def _singles(self, part: Equations, members: Integers) -> list[Part]:
        """Return the worlds of a part one by one."""
        where = [self._all[at : at + 1] for at in range(len(members))]
        return [(part.of(at, alone=True), members[at]) for at in where]

    def _divided(
        self, chosen: list[Part], request: Mapping[str, Any], each: Collection[str]
    ) -> list[Part]:
        """Return worlds one by one where they cannot intervene together."""
        if not chosen:
            return []
        ((part, members),) = chosen
        alike = not each or (part.takes_each(each) and not has_times(request))
        if not part.is_several or (alike and not part.awaits(request)):
            return [(part, members)]
        return self._singles(part, members)

    def _merged(self, parts: list[Part]) -> list[Part]:
        """Return the worlds in as few parts as possible."""
        if not self._one.compiled.is_vectorised:
            return parts
        lone = [p.is_planned or not self._out.isdisjoint(rows.tolist()) for p, rows in parts]
        free = [one for one, is_lone in zip(parts, lone, strict=True) if not is_lone]
        return [*(one for one, is_lone in zip(parts, lone, strict=True) if is_lone), *merged(free)]

    # --- the whole ------------------------------------------------------------------------------

    def close(self) -> None:
        """End the episodes of all worlds; there is no engine to free."""


@final
class EquationTable:
    """Worlds of equations, declared alike, that are advanced in one call; see ``Batch``.

    Worlds at the same instant, under interventions that differ in constants only, are solved
    together, if the functions of the model are vectorised. Each equals a world alone: the common
    results are written into a world when it is asked.

    Args:
        worlds: The worlds; the table owns them from now on.
        threads: None: one thread solves.
        names: Variables that are read after every step.
    """

    def __init__(
        self, worlds: Sequence[Equations], *, threads: int | None, names: Sequence[str]
    ) -> None:
        one_of("threads", threads, (None, 1))
        self._worlds = tuple(worlds)
        self._parts: list[Part] = []
        self._versions = np.full(len(worlds), -1)  # of each world when it was joined
        self._places = {id(world): row for row, world in enumerate(worlds)}
        self._all = np.arange(len(worlds))

    def advance(self, commands: Floats, which: Mask | None = None) -> None:
        """Advance worlds one control step, all if ``which`` is None, or none if one fails.

        Commands are finite numbers within the bounds, shape (n, n_actions).
        """
        self._join(self._all if which is None else np.flatnonzero(which))
        before = [dict(vars(part)) for part, _ in self._parts]
        try:
            for part, members in self._parts:
                part._advance(commands[members if part.is_several else members[0]])
                part._now()
        except BaseException as error:
            for (part, _), state in zip(self._parts, before, strict=True):
                vars(part).update(state)
            if isinstance(error, ScmWorldError):
                self._blame(commands)
            raise
        for part, members in self._parts:
            for row in members.tolist() if part is not self._worlds[members[0]] else ():
                own = vars(self._worlds[row])
                own["index"], own["_table"] = part.index, self
                for name in LATE:
                    own.pop(name, None)

    def _blame(self, commands: Floats) -> None:
        """Raise the error of the first world that cannot take its step."""
        for row in np.concatenate([members for _, members in self._parts]).tolist():
            alone: Any = deepcopy(self._worlds[row])
            try:
                alone.advance(commands[row])
            except FunctionFailure as error:
                error.row = row
                raise
            except ScmWorldError as error:
                raise located(error, row, "environment") from error.__cause__

    def settle(self, world: Equations) -> None:
        """Write the results of a common solution into a world."""
        row = self._places[id(world)]
        part, members = next(one for one in self._parts if row in one[1])
        at, own = np.searchsorted(members, [row]), vars(world)
        for name in LATE:
            now = getattr(part, name)
            is_numbers = name != "_drawn" and now is not None
            own[name] = {n: value[at] for n, value in now.items()} if is_numbers else now

    def _join(self, rows: Integers) -> None:
        """Make parts of some worlds, and of no others."""
        versions = np.array([world.version for world in self._worlds])
        chosen = np.zeros(len(self._worlds), bool)
        chosen[rows] = True
        there, fresh = chosen & self._is_here(versions), chosen.copy()
        parts: list[Part] = []
        for part, members in self._parts:
            kept = there[members]
            for row in members[~kept].tolist():
                if LATE[0] not in vars(self._worlds[row]):
                    self.settle(self._worlds[row])
            if kept.any():
                rest = part if kept.all() else part.of(np.flatnonzero(kept))
                parts.append((rest, members[kept]))
                fresh[members[kept]] = False
        self._versions = np.where(chosen, versions, self._versions)
        new = np.flatnonzero(fresh).tolist()
        for row in new:
            self._worlds[row]._now()
        if self._worlds[0].compiled.is_vectorised:
            singles = [(self._worlds[row].joining(), self._all[row : row + 1]) for row in new]
            self._parts = merged([*parts, *singles]) if new else parts
        else:
            self._parts = [*parts, *((self._worlds[row], self._all[row : row + 1]) for row in new)]

    def _is_here(self, versions: Integers) -> Mask:
        """Return which worlds are as the parts have them: nothing else changed them since."""
        indices = np.array([world.index for world in self._worlds])
        known = np.full(len(self._worlds), -1)
        for part, members in self._parts:
            known[members] = part.index
        found: Mask = (versions == self._versions) & (indices == known)
        return found

    def by_structure(self, rows: Integers) -> list[tuple[Rows, Integers]]:
        """Return the rows of all worlds, and the numbers of some of them."""
        if not len(rows):
            return []
        compiled: Any = self._worlds[0].compiled
        numbers = np.zeros((len(self._worlds), compiled.clock + 1))
        left = np.zeros(len(self._worlds), bool)
        left[rows] = True
        here = self._is_here(np.array([world.version for world in self._worlds]))
        for part, members in self._parts:
            if here[members].all():
                numbers[members] = part.row.numbers
                left[members] = False
        for row in np.flatnonzero(left).tolist():
            numbers[row] = self._worlds[row].row.numbers
        return [(Rows(compiled, numbers), rows)]


def merged(parts: list[Part]) -> list[Part]:
    """Return worlds in as few parts as possible, each with its worlds in order."""
    alike: dict[Any, list[Part]] = {}
    for part, members in parts:
        alike.setdefault(part.instant, []).append((part, members))
    found: list[Part] = []
    for some in alike.values():
        if len(some) == 1:
            found += some
            continue
        systems, numbers = zip(*some, strict=True)
        members = np.concatenate(numbers)
        order = np.argsort(members)  # the worlds of a part are in order
        found.append((systems[0].together(systems).of(order), members[order]))
    return found


def _split(part: Equations, members: Integers, mask: Mask) -> tuple[list[Part], list[Part]]:
    """Return the worlds of a part that a mask selects, and the others."""
    inside = mask[members]
    if inside.all():
        return [(part, members)], []
    if not inside.any():
        return [], [(part, members)]
    chosen, other = (
        [(part.of(np.flatnonzero(taken)), members[taken])] for taken in (inside, ~inside)
    )
    return chosen, other


def _of_row(audit: Audit, place: int, asked: Callable[[], Mapping[str, Any]]) -> tuple[Any, ...]:
    """Return the attributes of the audit of one of several worlds.

    ``asked`` returns its own values, where they differ between the worlds.
    """
    own, targets = asked(), dict[str, Applied]()
    for name, one in audit.targets.items():
        applied = None if one.applied is None else one.applied[place]
        targets[name] = Applied(name, own.get(name, one.requested), applied, None)
    moved = {name: (old[place], new[place]) for name, (old, new) in audit.followed.items()}
    kept = {name: pair for name, pair in moved.items() if not same(*pair)}
    return targets, kept, {}, (), (), ()
