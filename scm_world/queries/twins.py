"""Copies of a world on which questions are run."""

from __future__ import annotations

import copy
import multiprocessing
import threading
import weakref
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any, final
from weakref import WeakKeyDictionary

from scm_world.backends.base import EngineBatch
from scm_world.errors import UnknownOption
from scm_world.graph import SCM
from scm_world.queries.equations import Equations, Layout
from scm_world.world import Simulation
from scm_world.world.batch import Batch
from scm_world.world.structures import StructureCache


@final
class Twins:
    """Twins of one world: same task, options and backend, but none of its present.

    Args:
        world: Is never touched.

    Attributes:
        task: Of the world.
        options: Further arguments of a twin.
        batches: Whether the backend steps many worlds in one call.
    """

    def __init__(self, world: Simulation) -> None:
        self._build, (self._kind, self.task, self.options, _), *_ = world.__reduce__()
        self.batches = world.backend.batch is not EngineBatch
        self._clear()

    def _clear(self) -> None:
        self._free: list[Simulation] = []
        self._lock = threading.Lock()
        self._members: list[Simulation] = []  # of batches
        self._batching = threading.RLock()
        self._pool: tuple[int, ProcessPoolExecutor] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Copy and pickle without the twins."""
        private = ("_free", "_lock", "_members", "_batching", "_pool")
        return {name: value for name, value in self.__dict__.items() if name not in private}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Begin without twins."""
        self.__dict__.update(state)
        self._clear()

    @contextmanager
    def twin(self) -> Iterator[Simulation]:
        """Lend a twin; it may be given back in any state."""
        with self._lock:
            world = self._free.pop() if self._free else self._make()
        try:
            yield world
        finally:
            with self._lock:
                self._free.append(world)

    @contextmanager
    def together(self, n: int, names: tuple[str, ...], threads: int) -> Iterator[Batch]:
        """Lend twins that are stepped together; one thread at a time.

        They share what is declared, which twins that are lent to several threads cannot.

        Args:
            n: How many.
            names: What has to be computed in every step.
            threads: Of the engine.
        """
        with self._batching:
            worlds, self._members = self._members[:n], self._members[n:]
            while len(worlds) < n:
                worlds.append(self._make(worlds[0].structures if worlds else None))
            try:
                yield Batch(worlds, threads=threads, names=names)
            finally:
                for world in worlds:
                    if world.has_begun:
                        world.backend.read()  # it comes back, and the batch can be forgotten
                self._members = worlds + self._members

    @property
    def batched(self) -> int:
        """How many twins there are that can be stepped together."""
        return len(self._members)

    def has_pool(self, workers: int) -> bool:
        """Tell whether there are so many processes already."""
        return self._pool is not None and self._pool[0] == workers

    def pool(self, workers: int) -> ProcessPoolExecutor:
        """Return processes, which end with the twins."""
        if self._pool is not None and self._pool[0] == workers:
            return self._pool[1]
        self.close_pool()
        made = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"))
        weakref.finalize(self, made.shutdown, wait=False, cancel_futures=True)
        self._pool = workers, made
        return made

    def close_pool(self) -> None:
        """End the processes, if there are any."""
        if self._pool is not None:
            self._pool[1].shutdown(wait=False, cancel_futures=True)
            self._pool = None

    def _make(self, family: StructureCache | None = None) -> Simulation:
        task = copy.copy(self.task) if family is None else family
        made: Simulation = self._build(self._kind, task, dict(self.options), None)
        return made


@final
class EquationTwins:
    """Where questions to a causal model without a backend are run.

    Args:
        model: With the interventions that hold in every episode.
    """

    def __init__(self, model: SCM) -> None:
        self.layout = Layout(model)

    @contextmanager
    def twin(self) -> Iterator[Equations]:
        """Give equations to step."""
        yield Equations(self.layout)


AnyTwins = Twins | EquationTwins


def asked(system: Simulation | SCM) -> tuple[AnyTwins, Simulation | Equations]:
    """Return where episodes of a system are run, and a system that knows what is declared.

    Raises:
        UnknownOption: It is neither a world nor a model.
    """
    if isinstance(system, Simulation):
        return twins_of(system), system
    if not isinstance(system, SCM):
        raise UnknownOption("system", system, ("a World", "an SCM"))
    twins = EquationTwins(system)
    return twins, Equations(twins.layout)


_TWINS: WeakKeyDictionary[Simulation, Twins] = WeakKeyDictionary()


def twins_of(world: Simulation) -> Twins:
    """Return the twins of a world; they are freed with it.

    Raises:
        UnknownOption: It is no world.
    """
    if not isinstance(world, Simulation):
        raise UnknownOption("world", world, ("a World",))
    found = _TWINS.get(world)
    if found is None:
        found = _TWINS[world] = Twins(world)
    return found
