"""Copies of a system that run episodes, one at a time or many together, with equal results."""

from __future__ import annotations

import math
import multiprocessing
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from itertools import count
from typing import Any, final
from weakref import WeakKeyDictionary

import numpy as np

from scm_world._arguments import whole_number
from scm_world._fingerprint import digest, fingerprint
from scm_world._types import Floats
from scm_world.errors import EngineFailure, ScmWorldError, UnknownOption
from scm_world.graph import SCM
from scm_world.policies.scripted import OpenLoopPolicy, as_policy
from scm_world.queries.episodes import Episode, Era, Unit
from scm_world.queries.together import EpisodeBatch, Result, is_known, run_together
from scm_world.runs.processes import cores
from scm_world.world import CausalSystem, CompiledModel, Equations, Simulation
from scm_world.world.batch import Batch

MOST = 64
"""Largest number of worlds in a batch of an engine that says nothing else."""

LEAST = 4
"""Smallest number of units for a batch."""

PRICE = 8
"""Cost of building a world, in control steps of one thread."""

EQUAL = 64
"""Largest number of units that are run again to measure how far apart equal runs are."""


@final
class Twins:
    """Twins of one system: same task, options and backend, or equations, in any state."""

    def __init__(self, system: CausalSystem) -> None:
        compiled, engine = system.compiled, system.backend
        self.model = compiled if isinstance(compiled, CompiledModel) else None
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
        self._rows: Batch | None = None  # in whose rows episodes run together
        self._batching = threading.RLock()

    def __getstate__(self) -> dict[str, Any]:
        private = ("_free", "_lock", "_members", "_rows", "_batching")
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

    @contextmanager
    def rows(self, n: int, names: tuple[str, ...], threads: int) -> Iterator[Batch]:
        """Provide a batch of n worlds or more that computes ``names`` in every step.

        Its worlds are rows, which may be left in any state.
        """
        with self._batching:
            batch, self._rows = self._rows, None
            if batch is None or len(batch) < n or batch.threads != threads:
                if batch is not None:
                    batch.close()
                first = self._make()
                batch = Batch._like(first, first.made_with, n, threads)
            batch.names = names
            try:
                yield batch
            finally:
                self._rows = batch

    @property
    def batched(self) -> int:
        """Number of rows in which episodes run together."""
        return 0 if self._rows is None else len(self._rows)

    def run(
        self,
        units: Sequence[Unit],
        finish: Callable[[EpisodeBatch], Iterable[Any]],
        workers: int | None = None,
        catch: type[Exception] | tuple[type[Exception], ...] = (),
    ) -> list[Any]:
        """Run units of equal steps and names, and reduce their episodes with ``finish``.

        It is given episodes that ran together, and returns a result for each. Exceptions of the
        kinds ``catch`` are results, too; others propagate.
        """
        given = 1 if workers is None else whole_number("workers", workers, least=1)
        is_child = multiprocessing.parent_process() is not None  # workers share the cores
        threads = given if workers is not None or is_child else cores()
        found: list[Any] = [None] * len(units)
        with ExitStack() as open_:
            parts: Iterable[Result]
            if self.model is not None:
                parts = self._solved(units)
            elif n := self._batch_size(units, threads):
                parts = open_.enter_context(closing(self._in_batches(units, n, threads)))
            elif given == 1:
                parts = (([place], self._alone(unit)) for place, unit in enumerate(units))
            else:
                pool = open_.enter_context(ThreadPoolExecutor(given))  # backends release the GIL
                parts = zip(([i] for i in count()), pool.map(self._alone, units), strict=False)
            for places, result in parts:
                if isinstance(result, catch):
                    found[places[0]] = result
                elif isinstance(result, Exception):
                    raise result
                else:
                    for place, one in zip(places, finish(result), strict=True):
                        found[place] = one
        return found

    def floors(
        self,
        units: Sequence[Unit],
        what: Any,
        found: Sequence[Floats],
        read: Callable[[EpisodeBatch], Iterable[Sequence[Floats]]],
        workers: int | None,
    ) -> list[Floats]:
        """Return how far apart equal runs are, at most, in each number that is read of an episode.

        Up to ``EQUAL`` units are run again, with the same noise and interventions, when their plan,
        policy and length are asked about for the first time, or with more units than before.

        Args:
            units: The units, which differ in their numbers only.
            what: The variables that are read.
            found: Its values in all of them, shape (n, ...) each.
            read: Reads it, of each episode.
            workers: As in ``run``.
        """
        some = min(len(units), EQUAL)
        key = digest(fingerprint({"unit": replace(units[0], seed=0, number=0), "read": what}))
        known, largest = self._floors.get(key, (0, [np.zeros(one.shape[1:]) for one in found]))
        if known < some:
            again = self.run(units[:some], read, workers)
            apart = [
                np.abs(one[:some] - [row[i] for row in again]).max(axis=0)
                for i, one in enumerate(found)
            ]
            largest = [np.maximum(one, other) for one, other in zip(largest, apart, strict=True)]
            self._floors[key] = some, largest
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

    def _alone(self, unit: Unit) -> EpisodeBatch | Exception:
        try:
            return EpisodeBatch.of(self.episode(unit))
        except Exception as error:
            return error

    def _batch_size(self, units: Sequence[Unit], threads: int) -> int:
        """Return the number of units per batch; 0 if a batch is slower.

        An engine may say how many scenes it steps best, which are then built once.
        """
        if len(units) < LEAST or not is_known(units[0]) or units[0].listens:
            return 0
        steps = len(units) * (units[0].steps - units[0].first)
        worth = math.isqrt(steps * threads // PRICE)
        if worth < LEAST and self.scenes is None:
            return 0
        most = self.scenes or min(max(worth, self.batched), MOST)
        return math.ceil(len(units) / math.ceil(len(units) / most))

    def _in_batches(
        self, units: Sequence[Unit], n: int, threads: int
    ) -> Generator[Result, None, None]:
        """Run units in batches of n rows, those of one plan next to one another."""
        plans = {id(unit.plan): rank for rank, unit in reversed([*enumerate(units)])}
        order = sorted(range(len(units)), key=lambda place: plans[id(units[place].plan)])
        with self.rows(n, units[0].names, threads) as batch:
            for first in range(0, len(units), n):
                here = order[first : first + n]
                some = [units[place] for place in here]
                try:
                    parts = [*run_together(batch, some, self)]
                except ScmWorldError as error:  # run separately, it ends its own unit only
                    parts = [([place], self._alone(unit)) for place, unit in enumerate(some)]
                    alike = all(isinstance(result, EngineFailure) for _, result in parts)
                    if alike and isinstance(error, EngineFailure) and not error.lost:
                        raise  # the first failure has the cause, such as a kept memory
                for places, result in parts:
                    yield [here[place] for place in places], result

    # --- equations ----------------------------------------------------------------------------

    def _solved(self, units: Sequence[Unit]) -> Iterator[Result]:
        """Run units of equations, together if possible."""
        together = None
        with suppress(ScmWorldError):  # run separately, it ends its own unit only
            together = self._solved_together(units)
        if together is None:
            yield from (([place], self._alone(unit)) for place, unit in enumerate(units))
        else:
            yield from together

    def _solved_together(self, units: Sequence[Unit]) -> list[Result] | None:
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
        found = list[Result]()
        for rows in plans.values():
            mine = [units[row] for row in rows]
            how: dict[str, Any] = {"seed": [unit.seed for unit in mine], "names": ()}
            how["seed"] = how["seed"][0] if len({*how["seed"]}) == 1 else how["seed"]
            how["number"] = [unit.number for unit in mine]
            how["policy"] = lambda it, taken=actions[rows]: taken[:, it.index]
            episode = replace(mine[0], **how).run(Equations(compiled, len(rows)), self)
            episode.eras = [Era(0, compiled, {})]
            found.append((rows, EpisodeBatch(mine, episode)))
        return found


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
