"""Memory that several processes share."""

from __future__ import annotations

import mmap
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world.errors import UnwritableFolder

FOLDER = "/dev/shm"  # noqa: S108 # files in it are memory
LINE = 64  # [bytes] of a cache line: no array begins within the last one of another


@contextmanager
def shared(size: int) -> Iterator[tuple[str, mmap.mmap]]:
    """Give memory, and a path at which other processes find it until the end of the block.

    After the block nothing of it has a name any more, so nothing is left behind, however the
    processes end; it lasts as long as an array or a process uses it. (Named memory of
    ``multiprocessing`` has to be removed by somebody at the end, and cannot be closed while an
    array shows it.)

    Args:
        size: In bytes.

    Raises:
        UnwritableFolder: There is not enough memory.
    """
    folder = FOLDER if os.access(FOLDER, os.W_OK) else None
    descriptor, path = tempfile.mkstemp(prefix="scm_world_", dir=folder)
    try:
        try:
            os.posix_fallocate(descriptor, 0, size)  # else writing to it may end the process
        except OSError as error:
            raise UnwritableFolder(str(Path(path).parent), str(error)) from None
        yield path, mmap.mmap(descriptor, size)
    finally:
        os.close(descriptor)
        Path(path).unlink()


def found(path: str) -> mmap.mmap:
    """Open the memory that another process shares."""
    with Path(path).open("r+b") as file:
        return mmap.mmap(file.fileno(), 0)


@final
class Carver:
    """Cuts arrays out of memory, one after another.

    Args:
        memory: Filled with zeros; if None, the arrays have memory of their own.

    Attributes:
        size: How many bytes are cut so far.

    Example:
        >>> carver = Carver(bytearray(128))
        >>> carver((3,), np.float64), carver((2,), np.bool_)
        (array([0., 0., 0.]), array([False, False]))
        >>> carver.size
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
