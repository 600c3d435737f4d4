"""Work in other processes of this machine, each with one thread for each numerical library.

With one thread sums do not depend on the machine, and seconds are of one core.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing.reduction import ForkingPickler
from typing import Any, TypeAlias, final

from threadpoolctl import threadpool_limits

from scm_world.errors import EngineFailure, UnknownOption, in_one_line

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
"""What numerical libraries look at when they are loaded."""
PROCESS = "process"  # the engine of an EngineFailure
TRIES = 3  # of a job whose process ends: it may have been killed for another one's sake
GUARD = (
    "processes end before they can begin; they read the file that was started, too: what that file "
    "does has to stand under 'if __name__ == \"__main__\":'"
)
PICKLED = ("a function or class of a module, functools.partial of one, or plain data",)

Outcome: TypeAlias = "tuple[int, Any, Exception | None]"
"""The place of a job, its result, and the error if there is none."""


def cores() -> int:
    """Count the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def children_single_threaded() -> Iterator[None]:
    """Start processes whose libraries use one thread; those of this process are as they were."""
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


@contextmanager
def single_threaded() -> Iterator[None]:
    """Limit BLAS and OpenMP to one thread in this process, and in those started meanwhile.

    Sums in several threads add in another order, so that their last bits differ.
    """
    with children_single_threaded(), threadpool_limits(limits=1):
        yield


def pickled(what: str, thing: object, dumps: Callable[[object], Any] | None = None) -> bytes:
    """Write something for another process.

    Args:
        what: Said in the error.
        thing: Anything.
        dumps: Writes it; that of ``multiprocessing`` if None.

    Raises:
        UnknownOption: It cannot be pickled.

    Example:
        >>> pickled("job", lambda: 0)
        Traceback (most recent call last):
        scm_world.errors.UnknownOption: job cannot be <function ... it can be: a function or ...
    """
    try:
        return bytes((dumps or ForkingPickler.dumps)(thing))
    except Exception as error:
        remedy = f"everything in it of such a kind ({in_one_line(error)})"
        raise UnknownOption(what, thing, (*PICKLED, remedy)) from error


@final
class Worker:
    """One process for work that may crash or never end.

    It starts when it is first asked, ignores Ctrl-C, and ends with the process that asks.

    Args:
        work: A function, or an object that can be called, which the process keeps.

    Example:
        >>> worker = Worker(pow)
        >>> worker.ask(2, 10, timeout=60.0)
        1024
        >>> worker.close()
    """

    def __init__(self, work: Callable[..., Any]) -> None:
        self._work = pickled("work", work)
        self._process: Any = None
        self._pipe: Any = None

    def ask(self, *given: Any, timeout: float | None = None) -> Any:
        """Call the work; after an error of the process itself the next call starts another one.

        Args:
            *given: Arguments.
            timeout: After which the process is ended [s]; None waits however long it takes.

        Raises:
            UnknownOption: An argument cannot be pickled.
            TimeoutError: There was no answer in time.
            BrokenProcessPool: The process ended.
            Exception: What the work raised.
        """
        job = pickled("argument", given)
        try:
            if self._process is None:
                self._start()
            self._pipe.send_bytes(job)
            is_late = not self._pipe.poll(timeout)
            answer = None if is_late else self._pipe.recv_bytes()
        except (EOFError, OSError):
            self._process.join(1.0)
            said = f"its process ended with exit code {self._process.exitcode}"
            self.close()
            raise BrokenProcessPool(said) from None
        except BaseException:  # Ctrl-C: the answer is not read any more
            self.close()
            raise
        if answer is None:
            self.close()
            raise TimeoutError
        result, error = pickle.loads(answer)  # noqa: S301 # written by our own process
        if error is not None:
            raise error
        return result

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        with _starting(), theirs:
            self._process = context.Process(target=_serve, args=(self._work, theirs), daemon=True)
            self._process.start()

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._pipe.close()
        self._process = None


@contextmanager
def _starting() -> Iterator[None]:
    """Start processes with one thread for each library, which Ctrl-C does not reach."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        with children_single_threaded():
            yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def outcomes(workers: int, work: bytes, jobs: Sequence[bytes]) -> Iterator[Outcome]:
    """Do jobs in processes, each result in the order in which they are ready.

    When a process ends by itself, those jobs that were being done are done again, one at a time,
    so that it is found out which one ends its process.
    """
    waiting, suspects, lost = deque(range(len(jobs))), deque[int](), Counter[int]()
    never_begun = 0
    while waiting or suspects:
        queue = deque([suspects.popleft()]) if suspects else waiting
        processes = _Processes(1 if queue is not waiting else min(workers, len(jobs)), work)
        try:
            for place in (yield from _until_one_ends(processes, jobs, queue)):
                lost[place] += 1
                if lost[place] < TRIES:
                    suspects.append(place)
                    continue
                said = f"it was tried {TRIES} times, and then {processes.said()}"
                yield place, None, EngineFailure(said, PROCESS)
            never_begun = 0 if processes.begun.is_set() else never_begun + 1
            if never_begun == TRIES:
                raise EngineFailure(GUARD, PROCESS)
        finally:
            processes.end()


def _until_one_ends(
    processes: _Processes, jobs: Sequence[bytes], queue: deque[int]
) -> Any:  # a generator of outcomes, which returns the places of the jobs that were lost
    flying: dict[Future[Any], int] = {}
    is_broken = False
    while flying or (queue and not is_broken):
        found: list[Outcome] = []
        for future in wait(flying, return_when=FIRST_COMPLETED).done if flying else ():
            try:
                found.append((flying[future], *pickle.loads(future.result())))  # noqa: S301 # ours
                del flying[future]
            except BrokenProcessPool:
                is_broken = True
        try:
            while queue and not is_broken and len(flying) < processes.workers:
                flying[processes.submit(jobs[queue[0]])] = queue[0]
                queue.popleft()
        except BrokenProcessPool:
            is_broken = True
        yield from found
        if is_broken and all(future.done() for future in flying):
            break
    return list(flying.values())


@final
class _Processes:
    """Processes that keep one piece of work, and do jobs with it until they are ended."""

    def __init__(self, workers: int, work: bytes) -> None:
        context = multiprocessing.get_context("spawn")
        self.workers, self.begun = workers, context.Event()
        self._children: set[Any] = set()
        self._pool = ProcessPoolExecutor(workers, context, _begin, (work, self.begun))

    def submit(self, job: bytes) -> Future[Any]:
        """Begin a job; a process is started for it if all are busy, which Ctrl-C does not reach."""
        before = set(multiprocessing.active_children())
        try:
            with _starting():
                return self._pool.submit(_answered, job)
        finally:
            self._children |= set(multiprocessing.active_children()) - before

    def said(self) -> str:
        """Say how the only process ended."""
        (child,) = self._children
        child.join(1.0)
        return f"its process ended with exit code {child.exitcode}"

    def end(self) -> None:
        """Kill the processes."""
        for child in self._children:
            child.kill()
        self._pool.shutdown(cancel_futures=True)


# --- in the process -------------------------------------------------------------------------------

_WORK: list[Any] = []  # pickled, and then itself when it was first needed


def _begin(work: bytes, begun: Any) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _WORK.append(work)
    begun.set()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _serve(work: bytes, pipe: Any) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _WORK.append(work)
    with suppress(EOFError, OSError):
        while True:
            pipe.send_bytes(_answered(pipe.recv_bytes()))


def _answered(job: bytes) -> bytes:
    return answered(_WORK, job)


def answered(work: list[Any], job: bytes) -> bytes:
    """Return a result and no error, or no result and an error, pickled.

    Args:
        work: Pickled; it is replaced by itself.
        job: A tuple of arguments, pickled.
    """
    try:
        if isinstance(work[0], bytes):
            work[0] = pickle.loads(work[0])  # noqa: S301 # written by our own process
        result = work[0](*pickle.loads(job))  # noqa: S301 # as above
        return bytes(ForkingPickler.dumps((result, None)))
    except BaseException as error:  # also of a learner that ends Python; for the process that asked
        error.add_note("".join(traceback.format_exception(error)).rstrip())
        try:
            again = pickle.loads(pickle.dumps(error))  # noqa: S301 # our own
        except Exception:
            again = None
        if not isinstance(error, Exception) or type(again) is not type(error):
            said = "".join(traceback.format_exception_only(error)).split("\n")[0]
            again = EngineFailure(said, PROCESS)
        return pickle.dumps((None, again))
