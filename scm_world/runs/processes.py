"""Work in other processes of this machine, each with one thread for each numerical library.

With one thread sums do not depend on the machine, and seconds are of one core.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import threading
import traceback
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from functools import lru_cache
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from multiprocessing.reduction import ForkingPickler
from typing import Any, final

from threadpoolctl import ThreadpoolController

from scm_world.errors import EngineFailure, UnknownOption, in_one_line

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
"""Variables that numerical libraries read when they are loaded."""
PROCESS = "process"  # the engine of an EngineFailure
PICKLED = ("a function or class of a module, functools.partial of one, or plain data",)


def cores() -> int:
    """Count the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def piped(
    target: Callable[..., None], *given: object, daemon: bool
) -> tuple[SpawnProcess, Connection]:
    """Start a process that ignores the Ctrl-C of a terminal: it ends with this one.

    Returns:
        The process, and the pipe to it, whose other end is the last argument of the function.
    """
    context = multiprocessing.get_context("spawn")
    ends: Any = context.Pipe()  # of another class on Windows
    pipe, other = ends
    process = context.Process(target=target, args=(*given, other), daemon=daemon)
    with _deaf(), other:
        process.start()
    return process, pipe


@contextmanager
def _deaf() -> Iterator[None]:
    """Ignore Ctrl-C in processes that are started meanwhile."""
    if sys.platform == "win32":
        from ctypes import windll

        ignore = windll.kernel32.SetConsoleCtrlHandler
        ignore(None, True)
        try:
            yield
        finally:
            ignore(None, False)
    else:
        from multiprocessing.resource_tracker import ensure_running

        ensure_running()  # at its start it would unblock the signal for the process that starts now
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)


@final
class _Shared:
    """A context for several Python threads at once: the first one enters it, the last one leaves.

    Separate contexts would restore the setting of one another instead of the original one.
    """

    def __init__(self, make: Callable[[], AbstractContextManager[Any]]) -> None:
        self._make, self._users = make, 0
        self._lock, self._stack = threading.Lock(), ExitStack()

    def __enter__(self) -> None:
        with self._lock:
            if not self._users:
                self._stack.enter_context(self._make())
            self._users += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._users -= 1
            if not self._users:
                self._stack.close()


@contextmanager
def _set_variables() -> Iterator[None]:
    before = {name: os.environ[name] for name in THREADS if name in os.environ}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name in THREADS:
            os.environ.pop(name, None)
        os.environ.update(before)


@lru_cache(maxsize=1)
def _libraries(modules: int) -> ThreadpoolController:
    """Find the numerical libraries, which takes milliseconds; again when modules were imported."""
    return ThreadpoolController()


_VARIABLES = _Shared(_set_variables)
_LIMITS = _Shared(lambda: _libraries(len(sys.modules)).limit(limits=1))


@contextmanager
def single_threaded(*, here: bool = True) -> Iterator[None]:
    """Limit BLAS and OpenMP to one thread in processes started meanwhile, and in this one.

    Sums in several threads add in another order, so that their last bits differ.
    """
    with _VARIABLES, _LIMITS if here else nullcontext():
        yield


def pickled(
    what: str, thing: object, dumps: Callable[[object], Any] = ForkingPickler.dumps
) -> bytes:
    """Pickle an object for another process; ``UnknownOption`` names the one that cannot be."""
    try:
        return bytes(dumps(thing))
    except Exception as error:
        remedy = f"everything in it of such a kind ({in_one_line(error)})"
        raise UnknownOption(what, thing, (*PICKLED, remedy)) from error


@final
class Worker:
    """One process for work that may crash or never end, which it keeps; or the work pickled.

    It starts when it is first asked, ignores Ctrl-C, and ends with the process that asks. As a
    ``daemon`` it may have no processes of its own.

    Example:
        >>> worker = Worker(pow)
        >>> worker.ask(2, 10, timeout=60.0)
        1024
        >>> worker.close()
    """

    def __init__(self, work: Callable[..., Any] | bytes, *, daemon: bool = True) -> None:
        self._work = work if isinstance(work, bytes) else pickled("work", work)
        self._daemon = daemon
        self._process: SpawnProcess | None = None

    def ask(self, *given: object, timeout: float | None = None) -> Any:
        """Call the work; raise its error, or ``BrokenProcessPool`` if the process ended.

        After a ``timeout`` [s] the process is ended, and ``TimeoutError`` raised.
        """
        try:
            if not self.begin(pickled("argument", given)).poll(timeout):
                raise TimeoutError
            result, error = self.answer()
        except BaseException:  # Ctrl-C, too: the answer is not read any more
            self.close()
            raise
        if error is not None:
            raise error
        return result

    def begin(self, job: bytes) -> Connection:
        """Submit a pickled tuple of arguments; return the pipe, to wait for the answer."""
        if self._process is None:
            with single_threaded(here=False):
                self._process, self._pipe = piped(_serve, self._work, daemon=self._daemon)
            self._end = weakref.finalize(self, _end, self._process, self._pipe, os.getpid())
        with suppress(OSError):  # it has ended: `answer` says so
            self._pipe.send_bytes(job)
        return self._pipe

    def answer(self) -> tuple[Any, Exception | None]:
        """Return the result or the error of the present job; ``BrokenProcessPool`` without one."""
        try:
            answer = self._pipe.recv_bytes()
        except (EOFError, OSError):
            code = None
            if self._process is not None:
                self._process.join(1.0)
                code = self._process.exitcode
            self.close()
            raise BrokenProcessPool(f"its process ended with exit code {code}") from None
        found: tuple[Any, Exception | None] = pickle.loads(answer)  # noqa: S301 # our own process
        return found

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._end()
        self._process = None


def _end(process: SpawnProcess, pipe: Connection, owner: int) -> None:
    if os.getpid() == owner:  # not in a fork, which has a copy of the worker
        process.kill()
        process.join()
    pipe.close()


# --- in the process -------------------------------------------------------------------------------


def _serve(work: bytes, pipe: Connection) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    kept: list[Any] = [work]
    with suppress(EOFError, OSError):
        while True:
            pipe.send_bytes(answered(kept, pipe.recv_bytes()))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def answered(work: list[Any], job: bytes) -> bytes:
    """Return a result or an error, pickled; the pickled ``work[0]`` is replaced by itself."""
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
