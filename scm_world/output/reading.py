"""Files of users, read whole: what has no end, or would fill the memory, is refused before."""

from __future__ import annotations

import errno
import io
import os
import stat
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scm_world.output.remote import Location, located

LARGEST = 2**28
"""Bytes of a text, a model or a policy: more is none."""
LARGEST_TABLE = 2**34
"""Bytes of a table or an archive, and of the numbers in it."""


def regular(path: Location | str, largest: int = LARGEST) -> Location:
    """Return a file that can be read to its end.

    Args:
        path: Of the file, or a URL.
        largest: Number of bytes that it may have.

    Raises:
        OSError: It is not there; it is a folder, a device or a pipe; or it is too large.
    """
    where = located(path)
    status = where.stat()
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(where))
    if not stat.S_ISREG(status.st_mode):
        raise OSError("it is not a regular file, but a device, a pipe or a socket")
    refuse_large("it", status.st_size, largest)
    return where


def refuse_large(what: str, size: int, largest: int = LARGEST) -> None:
    """Raise an ``OSError`` where something has more bytes than are read."""
    if size > largest:
        raise OSError(f"{what} has {size:,} bytes; at most {largest:,} are read")


def read_bytes(path: Location | str, largest: int = LARGEST) -> bytes:
    """Read a file; arguments and errors as in ``regular``."""
    where = regular(path, largest)
    if not isinstance(where, Path):
        return where.read_bytes()
    with where.open("rb") as stream:
        return stream.read(where.stat().st_size)  # some files of the system have no end


def read_text(path: Location | str, encoding: str = "utf-8") -> str:
    """Read a text; errors as in ``regular``, and a ``ValueError`` where it is none."""
    return read_bytes(path).decode(encoding).replace("\r\n", "\n")


def read_arrays(
    source: Location | str | bytes, largest: int = LARGEST_TABLE
) -> dict[str, NDArray[Any]]:
    """Read the arrays of an archive of NumPy (.npz), by name; nothing in it is executed.

    Args:
        source: Path, URL or content.
        largest: Number of bytes that the archive, and the arrays in it, may have.

    Raises:
        OSError: As in ``regular``, also for what is packed in it.
        ValueError: It is something else, or it has pickled objects; or zipfile's and zlib's errors.
    """
    data = io.BytesIO(source if isinstance(source, bytes) else read_bytes(source, largest))
    with zipfile.ZipFile(data) as archive:
        refuse_large("its content", sum(one.file_size for one in archive.infolist()), largest)
    with np.load(data, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


def read_table(data: bytes) -> Any:
    """Read the content of a Parquet file: a ``pyarrow.Table``.

    Raises:
        ValueError: It is no whole Parquet file, or has more numbers than can be read.
    """
    import pyarrow as arrow
    from pyarrow.parquet import ParquetFile

    try:
        file: Any = ParquetFile(arrow.BufferReader(data))
        groups = [file.metadata.row_group(i) for i in range(file.metadata.num_row_groups)]
        parts = [group.column(i) for group in groups for i in range(group.num_columns)]
        size = sum(max(8 * part.num_values, part.total_uncompressed_size) for part in parts)
        refuse_large("its content", size, LARGEST_TABLE)
        return file.read(use_threads=False)
    except (arrow.ArrowException, OSError) as error:
        raise ValueError(f"it is no whole Parquet file ({error})") from None
