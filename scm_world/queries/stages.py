"""Copies of a world on which questions are tried out."""

from __future__ import annotations

import copy
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar, final
from weakref import WeakKeyDictionary

from scm_world.world import World

T = TypeVar("T")
R = TypeVar("R")


@final
class Stage:
    """Twins of one world: same task, options and engine, but none of its present.

    Args:
        world: Is never touched.

    Attributes:
        task: Of the world.
        options: What a twin is made with besides.
    """

    def __init__(self, world: World) -> None:
        self._build, (self._kind, self.task, self.options, _), *_ = world.__reduce__()
        self._free: list[World] = []
        self._lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        """Copy and pickle without the twins."""
        return {**self.__dict__, "_free": [], "_lock": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Begin without twins."""
        self.__dict__.update(state, _lock=threading.Lock())

    @contextmanager
    def twin(self) -> Iterator[World]:
        """Lend a twin; it is given back afterwards, in whatever state."""
        with self._lock:
            world = self._free.pop() if self._free else self._make()
        try:
            yield world
        finally:
            with self._lock:
                self._free.append(world)

    def _make(self) -> World:
        made: World = self._build(self._kind, copy.copy(self.task), dict(self.options), None)
        return made


def threaded(work: Callable[[T], R], items: Iterable[T], workers: int) -> list[R]:
    """Do a piece of work for each item.

    The engines compute without Python's lock, so that threads are worth it. The result does not
    depend on how many there are.
    """
    todo: Sequence[T] = list(items)
    if workers <= 1 or len(todo) <= 1:
        return [work(item) for item in todo]
    with ThreadPoolExecutor(min(workers, len(todo))) as pool:
        return list(pool.map(work, todo))


_STAGES: WeakKeyDictionary[World, Stage] = WeakKeyDictionary()


def stage_of(world: World) -> Stage:
    """Give the stage of a world; it lives as long as the world."""
    found = _STAGES.get(world)
    if found is None:
        found = _STAGES[world] = Stage(world)
    return found
