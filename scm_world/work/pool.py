"""A bag of jobs, done by several processes at once."""

from __future__ import annotations

import reprlib
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import wait
from types import TracebackType
from typing import Any, Generic, TypeVar, final

from scm_world.errors import EngineFailure, UnknownOption
from scm_world.work.processes import PROCESS, Ended, Worker, pickled
from scm_world.work.threads import single_threaded

Job = TypeVar("Job")
Result = TypeVar("Result")

TRIES = 3  # of a job whose process ends: it may have been killed for another one's sake


@final
class Pool(Generic[Job, Result]):
    """Processes that do jobs. What comes out does not depend on how many there are.

    Jobs must not depend on one another, and doing one twice must be the same as doing it once: if
    a process is killed, its job is done again by another one. Each process uses one thread.

    Args:
        make: Called once in each process; gives what does a job.
        workers: How many processes.
        inline: Do the jobs in this process, in their order, with one thread as well. Then nothing
            needs to be pickled.

    Raises:
        UnknownOption: ``make`` cannot be pickled, ``workers`` is no number from 1 on, or more than
            one of them is asked to work in this process.

    Example:
        >>> from functools import partial
        >>> with Pool(partial(partial, pow, 2), workers=1, inline=True) as pool:
        ...     sorted(pool.run([3, 10]))
        [(0, 8), (1, 1024)]
    """

    def __init__(
        self, make: Callable[[], Callable[[Job], Result]], workers: int, *, inline: bool = False
    ) -> None:
        if isinstance(workers, bool) or not isinstance(workers, int) or workers < 1:
            raise UnknownOption("workers", workers, ("any whole number from 1 on",))
        if inline and workers > 1:
            raise UnknownOption("workers in this process", workers, ("1",))
        self._make = make
        self._do: Callable[[Job], Result] | None = None
        self._inline = inline
        self._workers = () if inline else tuple(Worker(make) for _ in range(workers))
        self._idle = list(self._workers)
        self._busy: dict[Any, tuple[Worker, int]] = {}
        self._run: object = None

    def run(self, jobs: Sequence[Job]) -> Iterator[tuple[int, Result]]:
        """Do jobs.

        Args:
            jobs: What is handed to what ``make`` gave.

        Returns:
            The place of a job among the jobs, and its result: each once, in the order in which
            they are ready. Whoever stops reading ends the processes.

        Raises:
            UnknownOption: A job cannot be pickled; none was begun.
            EngineFailure: While reading: three processes ended over one job, the pool was closed,
                or results of other jobs are not all read yet.
            Exception: While reading: what a job, or ``make``, raised. Other jobs are given up.
        """
        if self._inline:
            return self._here(jobs)
        for number, job in enumerate(jobs):
            pickled(f"job {number}", job)
        return self._there(_Bag(jobs))

    def _here(self, jobs: Sequence[Job]) -> Iterator[tuple[int, Result]]:
        for number, job in enumerate(jobs):
            with single_threaded(), _named(number, job):
                if self._do is None:
                    self._do = self._make()
                result = self._do(job)
            yield number, result

    def _there(self, bag: _Bag[Job]) -> Iterator[tuple[int, Result]]:
        if self._run is not None:
            raise EngineFailure("the pool is at work; read all results of it first", PROCESS)
        mine = self._run = object()
        try:
            self._hand_out(bag)
            while self._busy:
                for pipe in wait(list(self._busy)):
                    answered = self._answer(pipe, bag)
                    self._hand_out(bag)
                    yield from answered
                    if self._run is not mine:
                        raise EngineFailure("the pool was closed before its work was done", PROCESS)
        except BaseException:
            if self._run is mine:
                self.close()
            raise
        self._run = None

    def _answer(self, pipe: Any, bag: _Bag[Job]) -> tuple[tuple[int, Result], ...]:
        """Take a result; none if the process has ended."""
        worker, number = self._busy.pop(pipe)
        self._idle.append(worker)
        try:
            with _named(number, bag.jobs[number]):
                return ((number, worker.answer()),)
        except Ended as ended:
            bag.put_back(number, ended)
            return ()

    def _hand_out(self, bag: _Bag[Job]) -> None:
        """Give jobs to those who have none."""
        while bag.waiting and self._idle:
            worker, number = self._idle.pop(), bag.waiting.popleft()
            if worker.has_ended:
                worker.stop()
            try:
                pipe = worker.begin("__call__", bag.jobs[number])
            except Ended as ended:
                self._idle.append(worker)
                bag.put_back(number, ended)
            else:
                self._busy[pipe] = (worker, number)

    def close(self) -> None:
        """End the processes at once, whatever they are doing."""
        for worker in self._workers:
            worker.stop()
        self._idle = list(self._workers)
        self._busy.clear()
        self._do = self._run = None

    def __enter__(self) -> Pool[Job, Result]:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


@final
class _Bag(Generic[Job]):
    """Jobs, and the places of those that wait.

    Args:
        jobs: All of them.
    """

    def __init__(self, jobs: Sequence[Job]) -> None:
        self.jobs = jobs
        self.waiting = deque(range(len(jobs)))
        self._lost = Counter[int]()

    def put_back(self, number: int, ended: Ended) -> None:
        """Let a job wait once more, as its process has ended.

        Raises:
            EngineFailure: It was the last try.
        """
        self._lost[number] += 1
        if self._lost[number] == TRIES:
            job = reprlib.repr(self.jobs[number])
            said = f"job {number}, {job}, was tried {TRIES} times, and then {ended}"
            raise EngineFailure(said, PROCESS) from None
        self.waiting.appendleft(number)


@contextmanager
def _named(number: int, job: object) -> Iterator[None]:
    """Add to an error which job it is of."""
    try:
        yield
    except Exception as error:
        error.add_note(f"in job {number}, {reprlib.repr(job)}")
        raise
