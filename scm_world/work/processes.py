"""Processes for work that may take too long or crash, and how many threads and cores work has.

With one thread for each library sums do not depend on the machine, and seconds are of one core.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from types import TracebackType
from typing import Any, final

from threadpoolctl import threadpool_limits

from scm_world.errors import EngineFailure, ScmWorldError, UnknownOption, in_one_line

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
    """Limit BLAS and OpenMP to one thread in this process, and in those started meanwhile.

    Sums in several threads add in another order, so that their last bits differ. It may be nested,
    and used in several threads. A library that is first loaded meanwhile keeps to one thread.
    """
    with _ENVIRONMENT.held(), _LIMITS.held():
        yield


PROCESS = "process"  # the engine of an EngineFailure
DONE, FAILED, UNMADE = "done", "failed", "unmade"
"""How an answer begins: a result, an error of what was asked, or one of what makes the thing."""
GUARD = (
    "it reads the file that was started, too: what that file does has to stand under "
    "'if __name__ == \"__main__\":'"
)
PICKLED = ("a function or class of a module, functools.partial of one, or plain data",)


@final
class Ended(Exception):
    """A process ended before it answered.

    Attributes:
        code: Its exit code; that of a signal is negative. None if it never began.
        was_interrupted: Whether another thread ended it.
        cannot_begin: Whether it ended by itself before it could be asked: another one would, too.
    """

    def __init__(
        self, code: int | None, *, was_interrupted: bool = False, cannot_begin: bool = False
    ) -> None:
        self.code, self.was_interrupted, self.cannot_begin = code, was_interrupted, cannot_begin
        ended = f"its process ended with exit code {code}"
        if cannot_begin:
            ended = f"a process cannot begin: it ended with exit code {code}; {GUARD}"
        super().__init__("interrupted" if was_interrupted else ended)


@final
class TookTooLong(Exception):
    """A process was ended because it did not answer in time."""


def pickled(what: str, thing: object) -> bytes:
    """Write something for another process.

    Args:
        what: Said in the error.
        thing: Anything.

    Raises:
        UnknownOption: It cannot be pickled.

    Example:
        >>> pickled("job", lambda: 0)
        Traceback (most recent call last):
        scm_world.errors.UnknownOption: job cannot be <function ... it can be: a function or ...
    """
    try:
        return bytes(ForkingPickler.dumps(thing))
    except Exception as error:
        remedy = f"everything in it of such a kind ({in_one_line(error)})"
        raise UnknownOption(what, thing, (*PICKLED, remedy)) from error


@final
class Worker:
    """A process that makes one thing, and calls its methods when it is asked to.

    The process is started when it is first needed. It has one thread for each numerical library,
    does not hear Ctrl-C, and ends when the process that started it does, however that ends.

    Args:
        make: Makes the thing, in the process: a function or class that can be pickled.

    Attributes:
        is_made: Whether the last answer was one of the thing; an error of ``make`` is none.

    Raises:
        UnknownOption: ``make`` cannot be pickled.

    Example:
        >>> with Worker(dict) as worker:
        ...     worker.ask("update", {"a": 1})
        ...     worker.ask("__getitem__", "a")
        1
    """

    def __init__(self, make: Callable[[], object]) -> None:
        self._make = pickled("make", make)
        self.is_made = False
        self._process: Any = None
        self._pipe: Any = None
        self._signs: Any = None
        self._interrupted = False

    def ask(self, method: str, *given: Any, timeout: float | None = None) -> Any:
        """Call a method of the thing, and wait for what it gives.

        Args:
            method: Its name; ``"__call__"`` calls the thing itself.
            *given: Arguments.
            timeout: After which the process is ended [s]; None waits however long it takes.

        Raises:
            UnknownOption: An argument cannot be pickled.
            TookTooLong: There was no answer in time.
            Ended: The process ended, or was interrupted. Asked again, a new one is started, unless
                it was interrupted.
            Exception: What the method, or ``make``, raised.
        """
        try:
            self.begin(method, *given)
            if self._is_late(timeout):
                self.stop()
                raise TookTooLong
            return self.answer()
        except Exception:
            raise
        except BaseException:  # Ctrl-C, at any moment: the answer is not read any more
            self.stop()
            raise

    def _is_late(self, timeout: float | None) -> bool:
        """Wait for an answer; tell whether there is none in time."""
        try:
            return not self._pipe.poll(timeout)
        except OSError:
            return False  # ``answer`` tells why there is none

    def begin(self, method: str, *given: Any) -> Connection:
        """Begin to ask; ``answer`` ends it.

        Returns:
            What can be waited for with ``multiprocessing.connection.wait``.

        Raises:
            UnknownOption: An argument cannot be pickled.
            Ended: The process ended, or was interrupted.
        """
        asked = pickled(f"argument of {method}", given)
        parts = [method.encode(), asked]
        if self._process is None:
            self._start()
            parts.insert(0, self._make)
        if self._interrupted:
            self.stop()
            raise Ended(None, was_interrupted=True)
        try:
            for part in parts:
                self._pipe.send_bytes(part)
        except OSError:
            raise self._ended() from None
        pipe: Connection = self._pipe
        return pipe

    def answer(self) -> Any:
        """Wait for what was begun; it raises what ``ask`` does."""
        try:
            said = self._pipe.recv_bytes()
        except (EOFError, OSError):
            raise self._ended() from None
        except BaseException:
            self.stop()  # the rest of the answer would be taken for the next one
            raise
        how, given = pickle.loads(said)  # noqa: S301 # written by our own process
        self.is_made = how != UNMADE
        if how != DONE:
            raise given
        return given

    def _ended(self) -> Ended:
        self._process.join(1.0)
        code = self._process.exitcode
        cannot_begin = code is not None and code > 0 and not self._has_begun()
        self.stop()
        return Ended(code, was_interrupted=self._interrupted, cannot_begin=cannot_begin)

    def _has_begun(self) -> bool:
        """Tell whether the process, which has ended, came so far as to be asked."""
        try:
            return bool(self._signs.recv_bytes())
        except (EOFError, OSError):
            return False

    @property
    def has_ended(self) -> bool:
        """Whether the process ended by itself."""
        return self._process is not None and not self._process.is_alive()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._signs, sign = context.Pipe(duplex=False)
        with children_single_threaded(), _uninterrupted():
            process = context.Process(target=_serve, args=(theirs, sign), daemon=True)
            process.start()
        self._process = process
        theirs.close()
        sign.close()

    def interrupt(self) -> None:
        """End the process from another thread, for good; who waits for an answer gets an error."""
        self._interrupted = True
        process = self._process
        if process is not None:
            process.kill()

    def stop(self) -> None:
        """End the process. Asked again, a new one is started."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
        for pipe in (self._pipe, self._signs):
            if pipe is not None:
                pipe.close()  # one that has just begun ends by this
        self._process = self._pipe = self._signs = None

    def __enter__(self) -> Worker:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Start processes that Ctrl-C does not reach, where a system has such."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


# --- in the process -------------------------------------------------------------------------------


def _serve(pipe: Connection, sign: Connection) -> None:
    """Answer until the pipe is closed, or until the calling process has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that asks ends this one
    threading.Thread(target=_end_with_parent, daemon=True).start()
    things: list[object] = []
    try:
        sign.send_bytes(b"begun")
        sign.close()
        make = pipe.recv_bytes()
        while True:
            method, given = pipe.recv_bytes().decode(), pipe.recv_bytes()
            pipe.send_bytes(answered(make, things, method, given))
    except (EOFError, OSError):
        return


def answered(make: bytes, things: list[object], method: str, given: bytes) -> bytes:
    """Do what was asked, and write down how it ended.

    Args:
        make: Makes the thing, pickled; it is called before the first time.
        things: Keeps the thing.
        method: Of the thing.
        given: Its arguments, pickled.

    Returns:
        ``DONE`` and the result, or ``FAILED`` or ``UNMADE`` and an error, pickled.
    """
    how = FAILED if things else UNMADE
    try:
        if not things:
            things.append(pickle.loads(make)())  # noqa: S301 # written by our own process
        how = FAILED
        result = getattr(things[0], method)(*pickle.loads(given))  # noqa: S301 # as above
        return bytes(ForkingPickler.dumps((DONE, result)))
    except Exception as error:  # reported to the calling process
        return bytes(ForkingPickler.dumps((how, _portable(error))))


def _portable(error: Exception) -> Exception:
    """Give an error that survives the way: the same one if it can be pickled."""
    if not isinstance(error, ScmWorldError):
        error.add_note("".join(traceback.format_exception(error)).rstrip())
    try:
        again = pickle.loads(pickle.dumps(error))  # noqa: S301 # written in the line itself
    except Exception:
        again = None
    if type(again) is type(error):
        return error
    said = "".join(traceback.format_exception_only(error)).rstrip()
    return EngineFailure(said, PROCESS)


def _end_with_parent() -> None:
    """End this process when the one that started it has ended."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
