"""Independent jobs: in this process, in processes of this machine, or on a Ray cluster.

The results depend neither on the executor nor on the number of workers. The job of a killed worker
is done again. A job that fails, or whose worker ends three times, is put aside; its error is raised
when all other jobs are done.
"""

from __future__ import annotations

import re
import reprlib
import weakref
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.connection import wait
from typing import Any, Self, TypeAlias, TypeVar, final

from scm_world._arguments import whole_number
from scm_world.errors import EngineFailure, UnknownOption
from scm_world.runs.cluster import RAY, Cluster
from scm_world.runs.processes import PROCESS, Worker, cores, pickled, single_threaded

Job = TypeVar("Job")
Result = TypeVar("Result")

SERIAL = "serial"
ENGINES = (SERIAL, PROCESS, RAY, "host:port or 'auto' of a Ray cluster")
SHOWN = 5  # failed jobs that an error lists
TRIES = 3  # of a job whose worker ends: it may have been killed for another one's sake
GUARD = (
    "if no process can begin: it reads the file that was started, too; what that file does has to "
    "stand under 'if __name__ == \"__main__\":'"
)
Outcome: TypeAlias = "tuple[int, Any, Exception | None]"
"""The place of a job, its result, and its error or None."""


@final
class Pool:
    """What does independent jobs.

    Args:
        engine: ``"serial"``: this process; ``"process"``: others of this machine; ``"ray"``, or
            the address of a Ray cluster: ``"auto"`` or ``host:port``. ``"ray"`` means the cluster
            of ``RAY_ADDRESS`` if that is set, and else processes that Ray starts on this machine.
            None is ``"process"`` if several workers are asked for, and else ``"serial"``.
        workers: How many jobs are done at the same time; None is as many as there are cores, on
            this machine or in the cluster.

    Raises:
        UnknownOption: The executor is unknown, or cannot have so many workers.
        MissingExtra: Ray is not installed.
        EngineFailure: No cluster answers at the address.

    Example:
        >>> with Pool("process", workers=2) as pool:
        ...     sorted(pool.run(abs, [-3, 10]))
        [(0, 3), (1, 10)]
    """

    def __init__(self, engine: str | None = None, workers: int | None = None) -> None:
        if workers is not None:
            whole_number("workers", workers, least=1)
        if engine is None:
            engine = PROCESS if workers is not None and workers > 1 else SERIAL
        if engine == SERIAL and workers not in (None, 1):
            raise UnknownOption("workers of the executor 'serial'", workers, ("1", "None"))
        self._cluster: Cluster | None = None
        self._running: Callable[[], Any] = lambda: None
        if engine in (SERIAL, PROCESS):
            self.engine = engine
            self.workers = (workers or cores()) if engine == PROCESS else 1
            return
        if engine not in (RAY, "auto") and not re.fullmatch(r"[^/:]+:\d+", str(engine)):
            raise UnknownOption("executor", engine, ENGINES)
        self._cluster = Cluster(None if engine == RAY else engine, workers)
        self.engine, self.workers = RAY, self._cluster.workers

    @property
    def where(self) -> str:
        """Where the work is done, in words."""
        if self._cluster is not None:
            return self._cluster.where
        if self.engine == SERIAL:
            return "in this process"
        return f"in {self.workers} process{'es' * (self.workers > 1)} of this machine"

    def check(self, what: str, thing: object) -> bytes:
        """Return something as it is sent to workers, if it is; ``UnknownOption`` names it else."""
        if self.engine == SERIAL:
            return b""
        return pickled(what, thing) if self._cluster is None else self._cluster.pickled(what, thing)

    def run(
        self, work: Callable[[Job], Result], jobs: Sequence[Job]
    ) -> Generator[tuple[int, Result]]:
        """Do jobs; closing the returned iterator ends the work.

        Args:
            work: Called with each job. Each worker keeps its own copy for all of them.
            jobs: Its arguments.

        Returns:
            The place of a job among the jobs, and its result: each once, in the order in which
            they are ready. At the end the error of a job is raised, with a note that names it.

        Raises:
            UnknownOption: The work or a job cannot be sent; none was begun.
            EngineFailure: No worker can begin; or, at the end, three ended over one job.
        """
        sent = self.check("work", work)
        given = [self.check(f"job {place}", (job,)) for place, job in enumerate(jobs)]
        found = _here(work, jobs) if self.engine == SERIAL else self._outcomes(sent, given)
        running = _results(found, jobs)
        self._running = weakref.ref(running)
        return running

    def _outcomes(self, work: bytes, jobs: Sequence[bytes]) -> Iterator[Outcome]:
        """Do jobs; that of a worker that ends by itself is done again, at the end."""
        waiting, lost = deque(range(len(jobs))), Counter[int]()
        count, ready = min(self.workers, len(jobs)), getattr(self._cluster, "ready", wait)
        idle: list[Any] = [Worker(work, daemon=False) for _ in range(count)]
        if self._cluster is not None:
            idle = self._cluster.workers_for(work, count)
        busy: dict[Any, tuple[Any, int]] = {}
        is_known_to_begin = False
        try:
            while waiting or busy:
                found: list[Outcome] = []
                for job in ready(list(busy)) if busy else ():
                    worker, place = busy.pop(job)
                    idle.append(worker)
                    try:
                        found.append((place, *worker.answer()))
                        is_known_to_begin = True
                    except BrokenProcessPool as ended:
                        lost[place] += 1
                        if not is_known_to_begin and lost.total() == TRIES * self.workers:
                            raise EngineFailure(f"{ended}; {GUARD}", self.engine) from None
                        if lost[place] < TRIES:
                            waiting.append(place)
                            continue
                        said = f"it was tried {TRIES} times, and then {ended}"
                        found.append((place, None, EngineFailure(said, self.engine)))
                while waiting and idle:
                    worker, place = idle.pop(), waiting.popleft()
                    busy[worker.begin(jobs[place])] = worker, place
                yield from found  # while workers have the next ones
        finally:
            for worker in (*idle, *(worker for worker, _ in busy.values())):
                worker.close()

    def close(self) -> None:
        """End running work, and close its workers."""
        running = self._running()
        if running is not None:
            running.close()
        if self._cluster is not None:
            self._cluster.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _here(work: Callable[[Any], Any], jobs: Sequence[Any]) -> Iterator[Outcome]:
    for place, job in enumerate(jobs):
        result, failed = None, None
        try:
            with single_threaded():
                result = work(job)
        except Exception as error:
            failed = error
        yield place, result, failed


def _results(found: Iterator[Outcome], jobs: Sequence[Any]) -> Generator[tuple[int, Any]]:
    aside: dict[int, Exception] = {}
    for place, result, error in found:
        if error is None:
            yield place, result
        else:
            aside[place] = error
    if not aside:
        return
    first, *others = sorted(aside)
    error = aside[first]
    error.add_note(f"in job {first}, {reprlib.repr(jobs[first])}")
    for place in others[:SHOWN]:
        other, name = aside[place], reprlib.repr(jobs[place])
        error.add_note(f"so did job {place}, {name}: {type(other).__name__}: {other}")
    if len(others) > SHOWN:
        error.add_note(f"and {len(others) - SHOWN} more")
    error.add_note(f"{len(jobs) - len(aside)} of {len(jobs)} jobs are done")
    raise error


@contextmanager
def pool_of(engine: Pool | str | None, workers: int | None = None) -> Iterator[Pool]:
    """Return a pool that is given, which has its workers, or open one for the block."""
    if isinstance(engine, Pool):
        if workers is not None:
            raise UnknownOption("workers", workers, ("None with a pool, which has its own",))
        yield engine
        return
    with Pool(engine, workers) as made:
        yield made
