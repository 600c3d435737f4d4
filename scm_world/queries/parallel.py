"""Many episodes: together where the backend can; else in processes, threads, or one by one.

Results do not depend on which.
"""

from __future__ import annotations

import math
import multiprocessing
from collections.abc import Callable, Generator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar, final

import numpy as np

from scm_world._arguments import whole_number
from scm_world._types import Floats, Integers, Value
from scm_world.errors import EngineFailure, UnknownOption
from scm_world.queries.equations import Equations
from scm_world.queries.rollouts import (
    ALL,
    Schedule,
    Schedules,
    Trace,
    Unit,
    begin,
    intervene,
    note_parameters,
    run,
    write,
)
from scm_world.queries.timed import On
from scm_world.queries.twins import AnyTwins, EquationTwins, Twins, threaded
from scm_world.tasks.policies import Blind
from scm_world.work.executors import Executor
from scm_world.work.threads import cores
from scm_world.world import World
from scm_world.world.batch import Batch, Table
from scm_world.world.compiled_task import clipped

R = TypeVar("R")

Ending = Trace | Exception
"""What a unit leaves behind, or what stopped it."""

MOST = 64
"""Worlds that are stepped together, at most."""

LEAST = 4
"""Fewer are not worth it."""

PRICE = 32
"""Control steps of one thread that it costs to make a world."""


def lived(
    twins: AnyTwins,
    units: Sequence[Unit],
    finish: Callable[[int, Ending], R],
    workers: int | None = None,
) -> list[R]:
    """Let units happen, and do something with what each leaves behind.

    Args:
        twins: Of the world.
        units: All of the same steps, with the same names and kind of policy.
        finish: Told the place of a unit, and how it ended; what it raises is raised. It may be
            called by several threads, in any order.
        workers: Threads, see ``Setting``.

    Returns:
        What ``finish`` gave, in the order of the units.
    """
    if isinstance(twins, EquationTwins):
        return [finish(place, ending) for place, ending in enumerate(_solved(twins, units))]
    given = None if workers is None else whole_number("workers", workers, least=1)
    endings = _elsewhere(twins, units, given)
    if endings is None:
        return _apart(twins, units, finish, given or 1)
    with closing(endings):
        return [finish(place, ending) for place, ending in enumerate(endings)]


Endings = Generator[Ending, None, None]


def _elsewhere(twins: Twins, units: Sequence[Unit], workers: int | None) -> Endings | None:
    """Let units happen together, or in processes; None where neither pays."""
    is_child = multiprocessing.parent_process() is not None  # one of many that share the cores
    threads = workers or (1 if is_child else cores())
    n = _together(twins, units, threads)
    if n:
        return _stepped(twins, units, n, threads)
    executor = None if twins.batches else crew(twins, units, workers or 1)
    return None if executor is None else sent(executor, twins, units)


def _together(twins: Twins, units: Sequence[Unit], threads: int) -> int:
    """Say how many units to step together; none if that does not pay.

    Each further world makes a step cheaper by less, and costs the same.
    """
    if not twins.batches or len(units) < LEAST or not is_known(units[0]):
        return 0
    steps = len(units) * (units[0].steps - units[0].first)
    worth = math.isqrt(steps * threads // PRICE)
    if worth < LEAST:
        return 0
    most = min(max(worth, twins.at_hand), MOST)
    return math.ceil(len(units) / math.ceil(len(units) / most))


def _stepped(twins: Twins, units: Sequence[Unit], n: int, threads: int) -> Endings:
    """Let units happen together, some at a time."""
    with twins.together(n, units[0].names, threads) as batch:
        for first in range(0, len(units), n):
            some = units[first : first + n]
            try:
                yield from advanced(batch, some)
            except EngineFailure:  # alone, it ends nothing but the unit in which it happens
                yield from _apart(twins, some, lambda _, ending: ending, 1)


def _apart(
    twins: Twins, units: Sequence[Unit], finish: Callable[[int, Ending], R], workers: int
) -> list[R]:
    def one(place: int) -> R:
        with twins.twin() as world:
            ending = units[place].ended(world)
        return finish(place, ending)

    return threaded(one, range(len(units)), workers)


def _solved(twins: EquationTwins, units: Sequence[Unit]) -> list[Trace | Exception]:
    """Run units: together where they can be, else one by one.

    Returns:
        What each leaves behind, or what stopped it.
    """
    try:
        together = _solved_together(twins, units)
    except Exception:  # alone, it ends nothing but the unit in which it happens
        together = None
    if together is None:
        return [unit.ended(Equations(twins.layout)) for unit in units]
    return [
        Trace(
            vectors=list(vectors),
            statics=[(0, {})],
            declarations=[(0, twins.layout)],
            actions=list(actions),
        )
        for vectors, actions in zip(*together, strict=True)
    ]


def paths(twins: EquationTwins, units: Sequence[Unit]) -> Floats:
    """Run units, and give all values at all instants, shape (n, steps + 1, size).

    Raises:
        Exception: What stopped a unit.
    """
    with suppress(Exception):  # the unit raises it again
        together = _solved_together(twins, units)
        if together is not None:
            return together[0]
    return np.array([unit.lived(Equations(twins.layout)).vectors for unit in units])


def _solved_together(twins: EquationTwins, units: Sequence[Unit]) -> tuple[Floats, Floats] | None:
    """Run units as one, if nothing in them depends on the schedule of one of them."""
    first, one = units[0], Equations(twins.layout)
    policies = [unit.acts(one) for unit in units] if twins.layout.n_actions else []
    numbers = range(first.number, first.number + len(units))
    if (
        not twins.layout.is_vectorised
        or any(unit.first or unit.number != i for unit, i in zip(units, numbers, strict=True))
        or any((unit.seed, unit.steps) != (first.seed, first.steps) for unit in units)
        or not all(isinstance(policy, Blind) for policy in policies)
    ):
        return None
    keys = [tuple((at, id(plan)) for at, plan in unit.layers) for unit in units]
    kinds = {key: unit.layers for key, unit in zip(keys, units, strict=True)}
    plans = (plan for layers in kinds.values() for _, plan in layers)
    if any(isinstance(part, On) for plan in plans for _, part in plan.timed()):
        return None
    places = {kind: group for group, kind in enumerate(kinds)}
    groups = [places[key] for key in keys]
    actions = np.empty((len(units), first.steps, twins.layout.n_actions))
    for row, policy in enumerate(policies):
        one.reset(seed=first.seed, episode=numbers[row])
        actions[row] = policy.ahead(one, 0, first.steps)  # type: ignore[attr-defined]
    schedules, trace = Schedules(map(Schedule, kinds.values())), Trace()
    together = Equations(twins.layout, groups)
    begin(together, first.seed, first.number, schedules, trace)

    def acts(system: Equations) -> Floats:
        found: Floats = actions[:, system.index]
        return found

    run(together, trace, schedules, acts, first=0, steps=first.steps)
    return np.stack(trace.vectors, axis=1), actions


def is_known(unit: Unit) -> bool:
    """Tell whether all actions of a unit are known beforehand, so that it can be in a batch."""
    return isinstance(unit.acts(), Blind) and ALL not in unit.names


def advanced(batch: Batch, units: Sequence[Unit]) -> list[Trace | Exception]:
    """Let units happen together.

    Args:
        batch: Of as many worlds or more, whose tables have the names of the units.
        units: All with the same first control step, as many steps, and the same names.

    Returns:
        What each leaves behind, or what stopped it.

    Raises:
        EngineFailure: The engine lost one of the states; that stops all of them.
    """
    lives = [_Life(batch.world(row), unit) for row, unit in enumerate(units)]
    first, steps = units[0].first, units[0].steps
    together = _Together(batch, lives)
    for row in range(len(lives)):
        together.alone(row, first)
    for step in range(first, steps):
        together.advance(step)
        for row in together.concerned(step + 1) if step + 1 < steps else ():
            together.alone(row, step + 1)
        together.write()
    return [together.ended(row) for row in range(len(lives))]


@final
@dataclass
class _Layout:
    """Where in a table everything is that has to be written down.

    Attributes:
        columns: Of the table, those of the state first.
        size: How many are those of the state.
        names: For each variable its place among these columns, and its shape.
    """

    columns: Integers
    size: int
    names: dict[str, tuple[slice, tuple[int, ...]]]

    @classmethod
    def of(cls, table: Table, names: Sequence[str]) -> _Layout:
        """Look it up."""
        declaration = table.compiled
        size = width = table.state_size
        parts, places = [np.arange(size)], {}
        for name in names:
            if name in declaration.model:
                where = table.where[name]
                parts.append(np.arange(where.start, where.stop))
                shape = declaration.model.declared(name).shape
                places[name] = slice(width, width + len(parts[-1])), shape
                width += len(parts[-1])
        return cls(np.concatenate(parts), size, places)


@final
@dataclass
class _Life:
    """A unit while it happens.

    Attributes:
        world: Its own.
        unit: What is to happen.
        error: What stopped it.
        rows: What is not in the trace yet: numbers in the order of the layout.
    """

    world: World
    unit: Unit
    error: Exception | None = None
    rows: list[Floats] = field(default_factory=list)
    layout: _Layout | None = None
    version: int = -1

    def __post_init__(self) -> None:
        self.schedule, self.policy = Schedule(()), self.unit.acts(self.world)
        self.trace = self.unit.goes_on()
        self.ahead: Floats = np.empty((0, self.world.compiled.n_actions))
        self._shift = 0

    def arrive(self) -> None:
        """Be at the first instant."""
        self.schedule = Schedule(self.unit.layers)
        self.unit.arrive(self.world)

    def note(self, step: int) -> None:
        """Write an instant down, and know what to do from then on."""
        if self.world.version != self.version:
            self.version = self.world.version
            note_parameters(self.world, self.trace, step)
        write(self.world, self.trace, self.unit.names)
        shift = self.world.index - step
        if step == self.unit.first or shift != self._shift:
            self._shift = shift
            self._look_ahead(step)

    def _look_ahead(self, step: int) -> None:
        """Ask for all actions that are left."""
        world, left = self.world, self.unit.steps - step
        policy: Any = self.policy
        given = policy.ahead(world, world.index, left)
        bounds, unit = world.compiled.action_bounds, world.compiled.action_unit
        commands = np.empty((self.unit.steps, world.compiled.n_actions))
        for row, action in zip(commands[step:], given, strict=True):
            row[:] = clipped(action, *bounds, unit)
        self.ahead = commands
        self.trace.actions[step:] = np.array(given)

    def flush(self) -> None:
        """Take over into the trace what is not there yet."""
        if not self.rows or self.layout is None:
            return
        numbers, self.rows = np.array(self.rows), []
        self.trace.vectors.extend(numbers[:, : self.layout.size].copy())
        for name, (place, shape) in self.layout.names.items():
            values = self.trace.values[name]
            like = values[-1].dtype  # the last one was written down by the world itself
            values.extend(_typed(numbers[:, place].reshape(-1, *shape), like))


@final
class _Together:
    """Lives in the rows of a batch."""

    def __init__(self, batch: Batch, lives: Sequence[_Life]) -> None:
        self._batch, self._lives = batch, lives
        self._names = lives[0].unit.names
        self._layouts: dict[int, tuple[Table, _Layout]] = {}
        self._goes_on = np.zeros(len(batch), dtype=np.bool_)
        self._goes_on[: len(lives)] = True
        self._pending = self._goes_on.copy()
        self._commands = np.zeros((len(batch), lives[0].world.compiled.n_actions))

    def alone(self, row: int, step: int) -> None:
        """Let a world do something by itself at an instant, and write the instant down."""
        life = self._lives[row]
        life.flush()
        self._pending[row] = False
        self._batch.world(row)
        try:
            if step == life.unit.first:
                life.arrive()
            intervene(life.world, life.schedule, step, life.trace)
            life.note(step)
        except Exception as error:  # it ends this life, and no other one
            life.error = error
            self._goes_on[row] = False

    def concerned(self, step: int) -> list[int]:
        """List the worlds in which something may be due."""
        return [
            row
            for row in np.flatnonzero(self._goes_on).tolist()
            for life in (self._lives[row],)
            if life.schedule.concerns(life.world, step, life.trace.fired)
        ]

    def advance(self, step: int) -> None:
        """Let all worlds take a control step."""
        rows = np.flatnonzero(self._goes_on)
        for row in rows.tolist():
            self._commands[row] = self._lives[row].ahead[step]
        if len(rows):
            self._batch.advance(self._commands, self._goes_on)
        self._pending[:] = self._goes_on

    def write(self) -> None:
        """Keep the present of those worlds that have not written it down themselves."""
        rows = np.flatnonzero(self._pending)
        for table, members in self._batch.tables(rows) if len(rows) else ():
            layout = self._layout(table)
            numbers = table.matrix[members[:, None], layout.columns]
            for row, mine in zip(members.tolist(), numbers, strict=True):
                life = self._lives[row]
                life.layout = layout
                life.rows.append(mine)

    def _layout(self, table: Table) -> _Layout:
        found = self._layouts.get(id(table))
        if found is None:
            found = self._layouts[id(table)] = table, _Layout.of(table, self._names)
        return found[1]

    def ended(self, row: int) -> Trace | Exception:
        """Give what a life leaves behind."""
        life = self._lives[row]
        life.flush()
        return life.trace if life.error is None else life.error


def _typed(values: Floats, kind: Any) -> Value:
    """Give numbers the type that they have in a single world, where that loses nothing."""
    cast = values.astype(kind)
    return cast if np.array_equal(cast, values, equal_nan=True) else values


PAYS = 10_000
"""Control steps that pay for the start of processes."""

GOES_ON = 200
"""Control steps that are worth sending to processes that are there."""

SHARE = 4
"""Jobs for each process, so that none waits long for the last one."""


def crew(twins: Twins, units: Sequence[Unit], workers: int) -> Executor | None:
    """Give processes for some units; None where they do not pay, or cannot be.

    Args:
        twins: Of the world.
        units: What is to happen.
        workers: How many processes there may be.
    """
    steps = sum(unit.steps - unit.first for unit in units)
    is_child = multiprocessing.parent_process() is not None
    worth = GOES_ON if twins.has_crew(workers) else PAYS
    if workers < 2 or len(units) < 2 or is_child or steps < worth:
        return None
    executor = twins.crew(workers)
    try:
        executor.check("twins", twins)
        executor.check("units", [_sent(unit) for unit in units])
    except UnknownOption:  # such as a policy that is a lambda: it acts in this process
        return None
    return executor


def sent(
    executor: Executor, twins: Twins, units: Sequence[Unit]
) -> Generator[Trace | Exception, None, None]:
    """Let units happen elsewhere.

    Args:
        executor: As ``crew`` gave it.
        twins: Of the world.
        units: What is to happen.

    Returns:
        How each ended, in the order of the units.

    Raises:
        EngineFailure: Processes ended again and again.
    """
    size = math.ceil(len(units) / (SHARE * executor.workers))
    jobs = [tuple(map(_sent, units[i : i + size])) for i in range(0, len(units), size)]
    early: dict[int, list[Any]] = {}
    told = 0
    with twins.twin() as world:
        for job, endings in executor.run(partial(partial, _run_there, twins), jobs):
            early[job] = endings
            while told in early:
                yield from (_unpacked(ending, world) for ending in early.pop(told))
                told += 1


def _run_there(twins: Twins, units: Sequence[Unit]) -> list[Any]:
    """Run units in this process for another one, and pack what each leaves behind."""
    with twins.twin() as world:
        here = (replace(unit, past=_unpacked(unit.past, world)) for unit in units)
        return [_packed(unit.ended(world)) for unit in here]


def _sent(unit: Unit) -> Unit:
    return replace(unit, past=_packed(unit.past))


def _packed(ending: Any) -> Any:
    """Write down a trace for another process: of a structure, what decides it."""
    if not isinstance(ending, Trace):
        return ending
    return replace(ending, declarations=[(step, d.plan) for step, d in ending.declarations])


def _unpacked(ending: Any, world: World) -> Any:
    if not isinstance(ending, Trace):
        return ending
    found = [(step, world.structures.compiled(plan)) for step, plan in ending.declarations]
    return replace(ending, declarations=found)
