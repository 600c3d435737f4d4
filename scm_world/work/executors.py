"""Executors of independent jobs: this process, processes of this machine, or a Ray cluster.

All of them keep the same promises:

- Every result comes once, in the order in which they are ready, with the place of its job.
- The results do not depend on the engine, or on the number of workers: jobs are independent, and
  doing one twice is the same as doing it once.
- A worker that is killed costs the job it was doing, which is done again. A job that fails, or
  takes three workers with it, is put aside; its error is raised when all other jobs are done.
"""

from __future__ import annotations

import reprlib
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import wait
from types import TracebackType
from typing import Any, Generic, Self, TypeVar, final

from scm_world.errors import EngineFailure, UnknownOption
from scm_world.work.processes import PROCESS, Ended, Worker, cores, pickled, single_threaded

Job = TypeVar("Job")
Result = TypeVar("Result")

SERIAL, RAY = "serial", "ray"
ENGINES = (SERIAL, PROCESS, RAY)


TRIES = 3  # of a job whose process ends: it may have been killed for another one's sake
SHOWN = 5  # failed jobs that an error lists


@final
class Bag(Generic[Job]):
    """Jobs, and the places of those that wait.

    A job that fails, or that repeatedly ends its process, is put aside. Those that
    were put aside are reported when no other job is left.

    Args:
        jobs: All of them.
        engine: What does them, for errors.
    """

    def __init__(self, jobs: Sequence[Job], engine: str) -> None:
        self.jobs = jobs
        self.waiting = deque(range(len(jobs)))
        self._engine = engine
        self._lost = Counter[int]()
        self._aside: dict[int, Exception] = {}

    def put_back(self, number: int, ended: Exception) -> None:
        """Queue a job whose process has ended again, behind the others.

        Args:
            number: Of the job.
            ended: What is known of the end; after the last try it is the fault of the job.
        """
        self._lost[number] += 1
        if self._lost[number] < TRIES:
            self.waiting.append(number)
            return
        said = f"{self.name(number)}, was tried {TRIES} times, and then {ended}"
        self._aside[number] = EngineFailure(said, self._engine)

    def put_aside(self, number: int, error: Exception) -> None:
        """Record that a job failed: as it gives the same every time, it is not tried again."""
        error.add_note(f"in {self.name(number)}")
        self._aside[number] = error

    def name(self, number: int) -> str:
        """Say which job it is.

        Example:
            >>> Bag(["wash", "dry"], "process").name(1)
            "job 1, 'dry'"
        """
        return f"job {number}, {reprlib.repr(self.jobs[number])}"

    def settle(self) -> None:
        """Say what could not be done, once all the rest is.

        Raises:
            Exception: Of the first job that was put aside; the others are notes.
        """
        if not self._aside:
            return
        first, *others = sorted(self._aside)
        error = self._aside[first]
        for number in others[:SHOWN]:
            other = self._aside[number]
            error.add_note(f"so did {self.name(number)}: {type(other).__name__}: {other}")
        if len(others) > SHOWN:
            error.add_note(f"and {len(others) - SHOWN} more")
        error.add_note(f"{len(self.jobs) - len(self._aside)} of {len(self.jobs)} jobs are done")
        raise error


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
        """End the work immediately, and free its resources."""

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

    Each process uses one thread. It is started when it is first needed.

    Args:
        workers: How many.

    Raises:
        UnknownOption: ``workers`` is no number from 1 on.

    Example:
        >>> from functools import partial
        >>> with Processes(1) as executor:
        ...     sorted(executor.run(partial(partial, pow, 2), [3, 10]))
        [(0, 8), (1, 1024)]
    """

    engine = PROCESS

    def __init__(self, workers: int) -> None:
        self.workers = _counted(workers)
        self._made = b""
        self._workers: tuple[Worker, ...] = ()
        self._idle: list[Worker] = []
        self._busy: dict[Any, tuple[Worker, int]] = {}
        self._run: object = None

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
        made = pickled("make", make)
        for number, job in enumerate(jobs):
            pickled(f"job {number}", job)
        return self._results(make, made, Bag(jobs, PROCESS))

    def _results(
        self, make: Callable[[], Any], made: bytes, bag: Bag[Any]
    ) -> Iterator[tuple[int, Any]]:
        if self._run is not None:
            raise EngineFailure("it is at work; read all results of it first", PROCESS)
        if made != self._made:
            self.close()
            self._workers = tuple(Worker(make) for _ in range(self.workers))
            self._idle, self._made = list(self._workers), made
        mine = self._run = object()
        try:
            self._hand_out(bag)
            while self._busy:
                for pipe in wait(list(self._busy)):
                    answered = self._answer(pipe, bag)
                    self._hand_out(bag)
                    yield from answered
                    if self._run is not mine:
                        raise EngineFailure("it was closed before its work was done", PROCESS)
        except BaseException:
            if self._run is mine:
                self.close()
            raise
        self._run = None
        bag.settle()

    def _answer(self, pipe: Any, bag: Bag[Any]) -> tuple[tuple[int, Any], ...]:
        """Take a result; none if the job failed, or the process has ended."""
        worker, number = self._busy.pop(pipe)
        self._idle.append(worker)
        try:
            return ((number, worker.answer()),)
        except Ended as ended:
            _put_back(bag, number, ended)
        except Exception as error:
            if not worker.is_made:
                raise  # it is the fault of no job: there is nothing that could do one
            bag.put_aside(number, error)
        return ()

    def _hand_out(self, bag: Bag[Any]) -> None:
        """Give jobs to those who have none."""
        while bag.waiting and self._idle:
            worker, number = self._idle.pop(), bag.waiting.popleft()
            if worker.has_ended:
                worker.stop()
            try:
                pipe = worker.begin("__call__", bag.jobs[number])
            except Ended as ended:
                self._idle.append(worker)
                _put_back(bag, number, ended)
            else:
                self._busy[pipe] = (worker, number)

    def close(self) -> None:
        """Kill the processes."""
        for worker in self._workers:
            worker.stop()
        self._idle = list(self._workers)
        self._busy.clear()
        self._run = None


def _put_back(bag: Bag[Any], number: int, ended: Ended) -> None:
    """Queue a job again, unless no process could do it."""
    if ended.cannot_begin:
        raise EngineFailure(str(ended), PROCESS)
    bag.put_back(number, ended)


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
def opened(engine: Executor | str | None, workers: int | None = None) -> Iterator[Executor]:
    """Give an executor: one that is passed is left open, one that is named is closed at the end.

    Args:
        engine: An executor, which has its workers already; or a name, see ``engine_of``.
        workers: See ``engine_of``.

    Raises:
        UnknownOption: ``workers`` are given beside an executor.
    """
    if isinstance(engine, Executor):
        if workers is not None:
            raise UnknownOption("workers", workers, ("None with an executor, which has its own",))
        yield engine
        return
    with engine_of(engine, workers=workers) as made:
        yield made


def _counted(workers: int) -> int:
    if isinstance(workers, bool) or not isinstance(workers, int) or workers < 1:
        raise UnknownOption("workers", workers, ("any whole number from 1 on",))
    return workers
