"""A bag of jobs, done by several processes at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import wait
from types import TracebackType
from typing import Any, Generic, TypeVar, final

from scm_world.errors import EngineFailure, UnknownOption
from scm_world.work.jobs import Bag
from scm_world.work.processes import PROCESS, Ended, Worker, pickled

Job = TypeVar("Job")
Result = TypeVar("Result")


@final
class Pool(Generic[Job, Result]):
    """Processes that do jobs. What comes out does not depend on how many there are.

    Jobs must not depend on one another, and doing one twice must be the same as doing it once: if
    a process is killed, its job is done again by another one. Each process uses one thread.

    Args:
        make: Called once in each process; gives what does a job.
        workers: How many processes.

    Raises:
        UnknownOption: ``make`` cannot be pickled, or ``workers`` is no number from 1 on.

    Example:
        >>> from functools import partial
        >>> with Pool(partial(partial, pow, 2), workers=1) as pool:
        ...     sorted(pool.run([3, 10]))
        [(0, 8), (1, 1024)]
    """

    def __init__(self, make: Callable[[], Callable[[Job], Result]], workers: int) -> None:
        if isinstance(workers, bool) or not isinstance(workers, int) or workers < 1:
            raise UnknownOption("workers", workers, ("any whole number from 1 on",))
        self._workers = tuple(Worker(make) for _ in range(workers))
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
            EngineFailure: While reading: the pool was closed, results of other jobs are not all
                read yet, or processes cannot begin. At the end: three of them ended over one job.
            Exception: While reading: what ``make`` raised. At the end, when all other jobs are
                done: what a job raised.
        """
        for number, job in enumerate(jobs):
            pickled(f"job {number}", job)
        return self._there(Bag(jobs, PROCESS))

    def _there(self, bag: Bag[Job]) -> Iterator[tuple[int, Result]]:
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
        bag.settle()

    def _answer(self, pipe: Any, bag: Bag[Job]) -> tuple[tuple[int, Result], ...]:
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

    def _hand_out(self, bag: Bag[Job]) -> None:
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

    @property
    def is_busy(self) -> bool:
        """Whether there are results that nobody has read yet."""
        return self._run is not None

    def close(self) -> None:
        """End the processes at once, whatever they are doing."""
        for worker in self._workers:
            worker.stop()
        self._idle = list(self._workers)
        self._busy.clear()
        self._run = None

    def __enter__(self) -> Pool[Job, Result]:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _put_back(bag: Bag[Any], number: int, ended: Ended) -> None:
    """Let a job wait once more, unless no process could do it."""
    if ended.cannot_begin:
        raise EngineFailure(str(ended), PROCESS)
    bag.put_back(number, ended)
