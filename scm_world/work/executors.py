"""One door to whatever does jobs: this process, processes of this machine, or a Ray cluster.

Whoever has a bag of jobs runs it on an ``Executor``. All of them keep the same promises:

- Every result comes once, in the order in which they are ready, with the place of its job.
- The results do not depend on the engine, or on the number of workers: jobs are independent, and
  doing one twice is the same as doing it once.
- A worker that is killed costs the job it was doing, which is done again. A job that fails, or
  takes three workers with it, is put aside; its error is raised when all other jobs are done.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import TracebackType
from typing import Any, Self, TypeVar, final

from scm_world.errors import EngineFailure, UnknownOption
from scm_world.work.jobs import Bag
from scm_world.work.pool import Pool
from scm_world.work.processes import PROCESS, pickled
from scm_world.work.threads import cores, single_threaded

Job = TypeVar("Job")
Result = TypeVar("Result")

SERIAL, RAY = "serial", "ray"
ENGINES = (SERIAL, PROCESS, RAY)


class Executor(ABC):
    """Does jobs.

    Attributes:
        engine: Its name, one of ``ENGINES``.
        workers: How many jobs are done at the same time.
    """

    engine: str
    workers: int

    @property
    @abstractmethod
    def where(self) -> str:
        """Where the work is done, in words."""

    @abstractmethod
    def check(self, what: str, thing: object) -> None:
        """Check that something can be sent to where the work is done.

        Args:
            what: Said in the error.
            thing: What ``make`` or the jobs will hold.

        Raises:
            UnknownOption: It cannot.
        """

    @abstractmethod
    def run(
        self, make: Callable[[], Callable[[Job], Result]], jobs: Sequence[Job]
    ) -> Iterator[tuple[int, Result]]:
        """Do jobs.

        Args:
            make: Called once in each worker; gives what does a job. The same one again finds what
                was made for it before.
            jobs: What is handed to what ``make`` gave.

        Returns:
            The place of a job among the jobs, and its result: each once, in the order in which
            they are ready. Whoever stops reading ends the work.

        Raises:
            UnknownOption: ``make`` or a job cannot be sent; none was begun.
            EngineFailure: While reading: the executor was closed, or is at work already. At the
                end: three workers ended over one job.
            Exception: While reading: what ``make`` raised. At the end, when all other jobs are
                done: what a job raised, with a note that names it.
        """

    @abstractmethod
    def close(self) -> None:
        """End the work at once, and free what it holds."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


@final
class Serial(Executor):
    """Does jobs in this process, one after another, in their order. Nothing is pickled.

    Example:
        >>> from functools import partial
        >>> with Serial() as executor:
        ...     list(executor.run(partial(partial, pow, 2), [3, 10]))
        [(0, 8), (1, 1024)]
    """

    engine = SERIAL
    workers = 1

    def __init__(self) -> None:
        self._make: Any = None
        self._do: Any = None

    @property
    def where(self) -> str:
        """Where the work is done, in words."""
        return "in this process"

    def check(self, what: str, thing: object) -> None:
        """Accept anything: nothing is sent."""

    def run(
        self, make: Callable[[], Callable[[Job], Result]], jobs: Sequence[Job]
    ) -> Iterator[tuple[int, Result]]:
        """Do jobs; see ``Executor.run``."""
        bag = Bag(jobs, SERIAL)
        while bag.waiting:
            number = bag.waiting.popleft()
            with single_threaded():
                if self._do is None or make is not self._make:
                    self.close()
                    self._do, self._make = make(), make
                try:
                    result: Result = self._do(jobs[number])
                except Exception as error:
                    bag.put_aside(number, error)
                    continue
            yield number, result
        bag.settle()

    def close(self) -> None:
        """Free what was made, if it can be closed."""
        getattr(self._do, "close", _nothing)()
        self._make = self._do = None


def _nothing() -> None:
    """Do what has to be done to close what cannot be closed."""


@final
class Processes(Executor):
    """Does jobs in processes of this machine; one that is killed is replaced.

    Args:
        workers: How many.

    Raises:
        UnknownOption: ``workers`` is no number from 1 on.
    """

    engine = PROCESS

    def __init__(self, workers: int) -> None:
        self.workers = _counted(workers)
        self._pool: Pool[Any, Any] | None = None
        self._make = b""

    @property
    def where(self) -> str:
        """Where the work is done, in words."""
        return f"in {self.workers} process{'es' * (self.workers > 1)} of this machine"

    def check(self, what: str, thing: object) -> None:
        """Check that something can be pickled."""
        pickled(what, thing)

    def run(
        self, make: Callable[[], Callable[[Job], Result]], jobs: Sequence[Job]
    ) -> Iterator[tuple[int, Result]]:
        """Do jobs; see ``Executor.run``."""
        key = pickled("make", make)
        if self._pool is None or key != self._make:
            if self._pool is not None and self._pool.is_busy:
                raise EngineFailure("the processes are at work for something else", PROCESS)
            self.close()
            self._pool, self._make = Pool(make, self.workers), key
        return self._pool.run(jobs)

    def close(self) -> None:
        """End the processes."""
        if self._pool is not None:
            self._pool.close()
        self._pool = None


def engine_of(
    engine: str | None = None, *, workers: int | None = None, address: str | None = None
) -> Executor:
    """Open what does jobs.

    Args:
        engine: ``"serial"``, ``"process"`` or ``"ray"``; None is ``"process"`` if several workers
            are asked for, and else ``"serial"``.
        workers: How many jobs are done at the same time; None is as many as there are cores: on
            this machine, or in the cluster.
        address: Of a Ray cluster: ``"auto"`` or ``host:port``. Without one, Ray is started on this
            machine.

    Raises:
        UnknownOption: There is no such engine, it cannot have so many workers, or no address.
        MissingExtra: Ray is not installed.
        EngineFailure: There is no cluster at the address.

    Example:
        >>> engine_of("process", workers=2).where
        'in 2 processes of this machine'
    """
    if engine is not None and engine not in ENGINES:
        raise UnknownOption("engine of work", engine, ENGINES)
    if address is not None and engine != RAY:
        allowed = (f"None with the engine {engine or SERIAL!r}; 'ray' has one",)
        raise UnknownOption("address", address, allowed)
    count = None if workers is None else _counted(workers)
    match engine:
        case "ray":
            from scm_world.work.ray_engine import connected

            return connected(count, address)
        case "process":
            return Processes(cores() if count is None else count)
        case None if count is not None and count > 1:
            return Processes(count)
    if count is not None and count > 1:
        raise UnknownOption("workers of the engine 'serial'", workers, ("1", "None"))
    return Serial()


@contextmanager
def opened(
    engine: Executor | str | None, workers: int | None = None, address: str | None = None
) -> Iterator[Executor]:
    """Hold what does jobs: what is given is left open, what is named is closed in the end.

    Args:
        engine: An executor, which has its workers already; or a name, see ``engine_of``.
        workers: See ``engine_of``.
        address: Likewise.

    Raises:
        UnknownOption: An executor is told how many workers it has, or where it is.
    """
    if isinstance(engine, Executor):
        for name, value in (("workers", workers), ("address", address)):
            if value is not None:
                raise UnknownOption(name, value, ("None with an executor, which has its own",))
        yield engine
        return
    with engine_of(engine, workers=workers, address=address) as made:
        yield made


def _counted(workers: int) -> int:
    if isinstance(workers, bool) or not isinstance(workers, int) or workers < 1:
        raise UnknownOption("workers", workers, ("any whole number from 1 on",))
    return workers
