"""What several processes share: memory, and signals."""

from __future__ import annotations

import mmap
import os
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world.errors import UnwritableFolder

IN_MEMORY = "/dev/shm"  # noqa: S108 # a folder made for this
LINE = 64  # [bytes] of a cache line: no array begins within the last one of another
MEMORY = "memory"


@contextmanager
def meeting_place() -> Iterator[Path]:
    """Give a folder in which processes find what they share, and remove it after the block.

    What they have opened lasts as long as one of them uses it. So nothing is left behind, however
    they end. (Named memory of ``multiprocessing`` has to be removed by somebody at the end, and
    cannot be closed while an array shows it.)
    """
    folder = IN_MEMORY if os.access(IN_MEMORY, os.W_OK) else None
    with tempfile.TemporaryDirectory(prefix="scm_world_", dir=folder) as path:
        yield Path(path)


def share(place: Path, size: int) -> mmap.mmap:
    """Make memory, filled with zeros.

    Args:
        place: Where the others find it.
        size: In bytes.

    Raises:
        UnwritableFolder: There is not enough memory.
    """
    with (place / MEMORY).open("x+b") as file:
        try:
            os.posix_fallocate(file.fileno(), 0, size)  # else writing to it may end the process
        except OSError as error:
            raise UnwritableFolder(str(place.parent), str(error)) from None
        return mmap.mmap(file.fileno(), size)


def shared(place: Path) -> mmap.mmap:
    """Open the memory that another process has made."""
    with (place / MEMORY).open("r+b") as file:
        return mmap.mmap(file.fileno(), 0)


@final
class Allocator:
    """Cuts arrays out of memory, one after another.

    Args:
        memory: Filled with zeros; if None, the arrays have memory of their own.

    Attributes:
        size: How many bytes are cut so far.

    Example:
        >>> allocator = Allocator(bytearray(128))
        >>> allocator((3,), np.float64), allocator((2,), np.bool_)
        (array([0., 0., 0.]), array([False, False]))
        >>> allocator.size
        128
    """

    def __init__(self, memory: Any = None) -> None:
        self._memory = memory
        self.size = 0

    def __call__(self, shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
        """Cut an array of zeros."""
        count, start = int(np.prod(shape)), self.size
        self.size += -(-count * np.dtype(dtype).itemsize // LINE) * LINE
        if self._memory is None:
            return np.zeros(shape, dtype)
        return np.frombuffer(self._memory, dtype, count, start).reshape(shape)


@final
class Signal:
    """Lets another process do something, many times, at the cost of two bytes through the kernel.

    The other one calls ``answer_signal`` before the first one.

    Args:
        place: Where the other process finds it.
        name: Of the signal.
    """

    def __init__(self, place: Path, name: str) -> None:
        there, back = _paths(place, name)
        os.mkfifo(there)
        os.mkfifo(back)
        self._there = os.open(there, os.O_RDWR)  # a reader of its own, so that it need not wait
        self._back = os.open(back, os.O_RDONLY | os.O_NONBLOCK)  # as nobody writes to it yet
        os.set_blocking(self._back, True)

    def send(self, what: bytes) -> None:
        """Ask for something, one byte; ``answer`` tells when it is done."""
        os.write(self._there, what)

    def answer(self) -> bytes:
        """Wait for the answer, one byte; none if the other process has ended."""
        return os.read(self._back, 1)

    def close(self) -> None:
        """Send no more."""
        os.close(self._there)
        os.close(self._back)


def answer_signal(place: Path, name: str, serve: Callable[[bytes], bytes]) -> None:
    """Answer a signal from now on, in a thread, for as long as there is somebody to send it.

    Args:
        place: Where it is.
        name: Of the signal.
        serve: Takes and gives one byte.
    """
    there, back = _paths(place, name)
    ends = os.open(there, os.O_RDONLY), os.open(back, os.O_WRONLY)
    threading.Thread(target=_answer, args=(*ends, serve), daemon=True).start()


def _answer(there: int, back: int, serve: Callable[[bytes], bytes]) -> None:
    while asked := os.read(there, 1):
        os.write(back, serve(asked))


def _paths(place: Path, name: str) -> tuple[Path, Path]:
    return place / f"{name}.there", place / f"{name}.back"
