"""How many cores there are, and one thread for each library.

Sums then do not depend on the machine, and seconds are of one core.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import final

from threadpoolctl import threadpool_limits

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
"""What numerical libraries look at when they are loaded."""


def cores() -> int:
    """Count the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def _environment() -> Iterator[None]:
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _limits() -> AbstractContextManager[object]:
    limits: AbstractContextManager[object] = threadpool_limits(limits=1)
    return limits


@final
class _Shared:
    """A setting of the process that threads hold together: the last one to let go undoes it."""

    def __init__(self, make: Callable[[], AbstractContextManager[object]]) -> None:
        self._make = make
        self._lock = threading.Lock()
        self._holders = 0
        self._made = ExitStack()

    @contextmanager
    def held(self) -> Iterator[None]:
        with self._lock:
            if self._holders == 0:
                self._made.enter_context(self._make())
            self._holders += 1
        try:
            yield
        finally:
            with self._lock:
                self._holders -= 1
                if self._holders == 0:
                    self._made.close()


_ENVIRONMENT, _LIMITS = _Shared(_environment), _Shared(_limits)


@contextmanager
def children_single_threaded() -> Iterator[None]:
    """Start processes whose libraries use one thread; those of this process are as they were."""
    with _ENVIRONMENT.held():
        yield


@contextmanager
def single_threaded() -> Iterator[None]:
    """Let BLAS and OpenMP use one thread in this process, and in those started meanwhile.

    Sums in several threads add in another order, so that their last bits differ. It may be nested,
    and used in several threads. A library that is first loaded meanwhile keeps to one thread.
    """
    with _ENVIRONMENT.held(), _LIMITS.held():
        yield
