"""Copies of a system that run episodes, one at a time or many together, with equal results."""

from __future__ import annotations

import math
import multiprocessing
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from typing import Any, final
from weakref import WeakKeyDictionary

import numpy as np

from scm_world._arguments import whole_number
from scm_world._fingerprint import digest, fingerprint
from scm_world._types import Floats
from scm_world.backends.base import SeparateScenes
from scm_world.errors import EngineFailure, ScmWorldError, UnknownOption, blamed
from scm_world.graph import SCM
from scm_world.policies.scripted import OpenLoopPolicy, as_policy
from scm_world.queries.episodes import ALL, Episode, Era, Unit, run, who
from scm_world.runs.processes import cores
from scm_world.world import CausalSystem, CompiledModel, Equations, Simulation
from scm_world.world.batch import Batch

Result = Episode | Exception
"""The result of a unit: its episode, or the exception that stopped it."""

MOST = 64
"""Largest number of worlds in a batch of an engine that says nothing else."""

LEAST = 4
"""Smallest number of units for a batch."""

PRICE = 32
"""Cost of building a world, in control steps of one thread."""

EQUAL = 64
"""Largest number of units that are run again to measure how far apart equal runs are."""


@final
class Twins:
    """Twins of one system: same task, options and backend, or equations, in any state."""

    def __init__(self, system: CausalSystem) -> None:
        compiled, engine = system.compiled, system.backend
        self.model = compiled if isinstance(compiled, CompiledModel) else None
        # Whether the backend steps many worlds in one call:
        self.batches = engine is not None and engine.batch is not SeparateScenes
        self.has_engine = engine is not None
        self.is_exact = engine is None or not engine.capabilities.floor
        self.scenes = None if engine is None else engine.capabilities.scenes
        self._floors: dict[str, tuple[int, list[Floats]]] = {}  # with the number of units
        self._make = system.maker()
        self._clear()

    def _clear(self) -> None:
        self._free: list[Any] = []
        self._lock = threading.RLock()  # the garbage collector may return a twin within it
        self._members: list[Simulation] = []  # worlds of batches
        self._batching = threading.RLock()

    def __getstate__(self) -> dict[str, Any]:
        private = ("_free", "_lock", "_members", "_batching")
        return {name: value for name, value in self.__dict__.items() if name not in private}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._clear()

    @contextmanager
    def twin(self) -> Iterator[Any]:
        """Provide a twin, which may be returned in any state."""
        with self._lock:
            system = self._free.pop() if self._free else None
        if system is None:
            system = self._make()
        try:
            yield system
        finally:
            with self._lock:
                self._free.append(system)

    @contextmanager
    def together(self, n: int, names: tuple[str, ...], threads: int) -> Iterator[Batch]:
        """Provide n twins of a world as a batch that computes ``names`` in every step.

        They share compiled tasks, which twins in several threads cannot.
        """
        with self._batching:
            worlds, self._members = self._members[:n], self._members[n:]
            while len(worlds) < n:
                worlds.append(self._make(*(one.structures for one in worlds[:1])))
            try:
                yield Batch(worlds, threads=threads, names=names)
            finally:
                for world in worlds:
                    if world.has_begun:
                        world.backend.read()  # leaves the batch
                self._members = worlds + self._members

    @property
    def batched(self) -> int:
        """Number of existing twins for batches."""
        return len(self._members)

    def run(
        self,
        units: Sequence[Unit],
        finish: Callable[[Episode], Any],
        workers: int | None = None,
        catch: type[Exception] | tuple[type[Exception], ...] = (),
    ) -> list[Any]:
        """Run units of equal steps and names, and reduce their episodes with ``finish``.

        Exceptions of the kinds ``catch`` are results, too; others propagate.
        """

        def ended(result: Result) -> Any:
            if isinstance(result, catch):
                return result
            if isinstance(result, Exception):
                raise result
            return finish(result)

        given = 1 if workers is None else whole_number("workers", workers, least=1)
        is_child = multiprocessing.parent_process() is not None  # workers share the cores
        threads = given if workers is not None or is_child else cores()
        if self.model is not None:
            results = self._solved(units)
        elif n := self._batch_size(units, threads):
            results = self._in_batches(units, n, threads)
        elif given == 1:
            results = (self._alone(unit) for unit in units)
        else:
            with ThreadPoolExecutor(given) as pool:  # backends release the GIL
                return [*map(ended, pool.map(self._alone, units))]
        with closing(results):  # type: ignore[type-var] # all of these are generators
            return [*map(ended, results)]

    def floors(
        self,
        units: Sequence[Unit],
        what: Any,
        found: Sequence[Floats],
        read: Callable[[Episode], list[Floats]],
        workers: int | None,
    ) -> list[Floats]:
        """Return how far apart equal runs are, at most, in each number that is read of an episode.

        Up to ``EQUAL`` units are run again, with the same noise and interventions, when their plan,
        policy and length are asked about for the first time, or with more units than before.

        Args:
            units: The units, which differ in their numbers only.
            what: The variables that are read.
            found: Its values in all of them, shape (n, ...) each.
            read: Reads it.
            workers: As in ``run``.
        """
        count = min(len(units), EQUAL)
        key = digest(fingerprint({"unit": replace(units[0], seed=0, number=0), "read": what}))
        known, largest = self._floors.get(key, (0, [np.zeros(one.shape[1:]) for one in found]))
        if known < count:
            again = self.run(units[:count], read, workers)
            apart = [
                np.abs(one[:count] - [row[i] for row in again]).max(axis=0)
                for i, one in enumerate(found)
            ]
            largest = [np.maximum(one, other) for one, other in zip(largest, apart, strict=True)]
            self._floors[key] = count, largest
        return largest

    def require_exact(self, question: str, *, independent: bool = False) -> None:
        """Refuse a question that compares equal runs bit for bit; see ``Simulation``."""
        if not self.is_exact or (independent and self.has_engine):
            with self.twin() as system:
                system.require_exact(question, independent=independent)

    def episode(self, unit: Unit) -> Episode:
        """Run a unit in a twin."""
        with self.twin() as system:
            return unit.run(system, self)

    def _alone(self, unit: Unit) -> Result:
        try:
            return self.episode(unit)
        except Exception as error:
            return error

    def _batch_size(self, units: Sequence[Unit], threads: int) -> int:
        """Return the number of units per batch; 0 if a batch is slower.

        An engine may say how many scenes it steps best, which are then built once.
        """
        if not self.batches or len(units) < LEAST or not is_known(units[0]) or units[0].listens:
            return 0
        steps = len(units) * (units[0].steps - units[0].first)
        worth = math.isqrt(steps * threads // PRICE)
        if worth < LEAST and self.scenes is None:
            return 0
        most = self.scenes or min(max(worth, self.batched), MOST)
        return math.ceil(len(units) / math.ceil(len(units) / most))

    def _in_batches(self, units: Sequence[Unit], n: int, threads: int) -> Iterator[Result]:
        with self.together(n, units[0].names, threads) as batch:
            for first in range(0, len(units), n):
                some = units[first : first + n]
                try:
                    yield from run_together(batch, some, self)
                except EngineFailure:  # run separately, it ends its own unit only
                    yield from map(self._alone, some)

    # --- equations ----------------------------------------------------------------------------

    def _solved(self, units: Sequence[Unit]) -> Iterator[Result]:
        """Run units of equations, together if possible."""
        together = None
        with suppress(ScmWorldError):  # run separately, it ends its own unit only
            together = self._solved_together(units)
        yield from map(self._alone, units) if together is None else together

    def _solved_together(self, units: Sequence[Unit]) -> list[Episode] | None:
        """Run units of each plan together; None if policies or events do not allow that."""
        first, compiled = units[0], self.model
        assert compiled is not None  # noqa: S101
        one = Equations(compiled)
        policies = [as_policy(u.policy, one) for u in units] if compiled.n_actions else []
        plans: dict[int, list[int]] = {}  # rows by plan
        for row, unit in enumerate(units):
            plans.setdefault(id(unit.plan), []).append(row)
        if (
            len(units) == 1
            or not compiled.is_vectorised
            or any((u.first, u.steps) != (0, first.steps) for u in units)
            or not all(isinstance(policy, OpenLoopPolicy) for policy in policies)
            or any(a.time.when for rows in plans.values() for _, a in units[rows[0]].plan.timed())
        ):
            return None
        actions = np.empty((len(units), first.steps, compiled.n_actions))
        for row, policy in enumerate(policies):
            one.reset(seed=units[row].seed, episode=units[row].number)
            actions[row] = policy.ahead(one, 0, first.steps)  # type: ignore[attr-defined] # OpenLoopPolicy
        found: dict[int, Episode] = {}  # by row
        for rows in plans.values():
            how: Any = {"seed": [units[row].seed for row in rows], "names": ()}
            how["seed"] = how["seed"][0] if len({*how["seed"]}) == 1 else how["seed"]
            how["number"] = [units[row].number for row in rows]
            how["policy"] = lambda it, taken=actions[rows]: taken[:, it.index]
            episode = replace(units[rows[0]], **how).run(Equations(compiled, len(rows)))
            for row, path in zip(rows, np.stack(episode.vectors, axis=1), strict=True):
                found[row] = Episode(self, units[row], vectors=[*path], taken=[*actions[row]])
                found[row].eras.append(Era(0, compiled, {}))
        return [found[row] for row in range(len(units))]


def is_known(unit: Unit) -> bool:
    """Return whether a unit can be in a batch: its actions are known beforehand."""
    return isinstance(as_policy(unit.policy), OpenLoopPolicy) and ALL not in unit.names


def run_together(batch: Batch, units: Sequence[Unit], twins: Twins | None = None) -> list[Result]:
    """Run units in the rows of a batch, which has at least as many worlds.

    The units have equal instants, names that the tables of the batch contain, and open-loop
    policies. A backend that loses a state stops all of them.
    """
    running = _Together(batch, units, twins)
    run(running, units[0].first, units[0].steps)
    return running.results()


@final
class _Together:
    """Running units in the rows of a batch; an error stops its own unit only."""

    def __init__(self, batch: Batch, units: Sequence[Unit], twins: Twins | None) -> None:
        self._batch = batch
        self._rows = [Episode._of(twins, unit, batch.world(i)) for i, unit in enumerate(units)]
        self._errors: dict[int, Exception] = {}
        self._first, self._steps = units[0].first, units[0].steps
        self._goes_on = np.arange(len(batch)) < len(units)
        self._pending = np.zeros(len(batch), dtype=np.bool_)  # stepped, and not recorded
        n_actions = self._rows[0].world.compiled.n_actions
        self._commands = np.zeros((self._steps, len(batch), n_actions))
        for row in range(len(units)):
            self._alone(row, self._first)

    def _intervene(self, step: int) -> None:
        for row in np.flatnonzero(self._goes_on).tolist():
            one = self._rows[row]
            if one.plan._concerns(one.world, step, one.memory):
                self._alone(row, step)

    def _record(self, step: int) -> None:
        """Record an instant of the rows that have not been recorded alone."""
        for row in np.flatnonzero(self._pending).tolist():
            self._rows[row]._note(step, ready=True)

    def _act(self, step: int) -> None:
        if self._goes_on.any():
            self._batch.advance(self._commands[step], self._goes_on)
        for row in np.flatnonzero(self._goes_on).tolist():
            self._rows[row]._complete()
        self._pending[:] = self._goes_on

    def results(self) -> list[Result]:
        return [self._errors.get(row, one._ended()) for row, one in enumerate(self._rows)]

    def _alone(self, row: int, step: int) -> None:
        """Reset or intervene in one world, record the instant, and get its further actions."""
        one = self._rows[row]
        self._pending[row] = False
        self._batch.world(row)
        try:
            if step == self._first:
                one._begin()
            else:
                one._intervene(step)
            one._note(step)
            with blamed(lambda: who(one.policy, one.world)):
                given = one.policy.ahead(one.world, one.world.index, self._steps - step)
            for command, action in zip(self._commands[step:, row], given, strict=True):
                command[:] = one.world.compiled.clipped(action)
            one.taken[step:] = np.array(given)
        except Exception as error:  # ends this unit only
            self._errors[row] = error
            self._goes_on[row] = False


_TWINS: WeakKeyDictionary[Any, Twins] = WeakKeyDictionary()


def twins_of(system: CausalSystem) -> Twins:
    """Return the twins of a world or of equations, which are freed with it."""
    if not isinstance(system, CausalSystem):
        raise UnknownOption("world", system, ("a World",))
    one = system.one
    found = _TWINS.get(one)
    if found is None:
        found = _TWINS[one] = Twins(one)
    return found


def asked(system: object) -> tuple[Twins, Any]:
    """Return the twins of a system, and the system with its declarations."""
    if not isinstance(system, CausalSystem | SCM):
        raise UnknownOption("system", system, ("a World", "an SCM"))
    found = Equations(CompiledModel(system)) if isinstance(system, SCM) else system.one
    return twins_of(found), found
