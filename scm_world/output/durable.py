"""Files that are whole or absent, also after a loss of power, and folders with one writer."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from scm_world.errors import UnreadableFile, UnwritableFolder

PARTIAL = ".part"


def draft_of(path: Path) -> Path:
    """Name the hidden file that becomes another one once it is whole.

    Example:
        >>> draft_of(Path("study.json")).name
        '.study.json.part'
    """
    return path.with_name(f".{path.name}{PARTIAL}")


def write_durably(path: Path | str, data: bytes) -> None:
    """Write a file, whole or not at all; it is on the disk when this ends.

    Raises:
        UnwritableFolder: There is no room, or no permission; what was there is still there.
    """
    target = Path(path)
    draft = draft_of(target)
    try:
        with draft.open("wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        draft.replace(target)
        _sync(target.parent)
    except OSError as error:
        reason = error.strerror or str(error)
        raise UnwritableFolder(str(target.parent), f"{target.name}: {reason}") from None
    finally:
        with suppress(OSError):
            draft.unlink(missing_ok=True)


def write_whole(text: str, path: Path | str) -> None:
    """Write a text as UTF-8, whole or not at all.

    Raises:
        UnwritableFolder: There is no room, or no permission.
    """
    write_durably(path, text.encode("utf-8", errors="backslashreplace"))


def _sync(folder: Path) -> None:
    """Make a new name in a folder outlast a loss of power."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def locked(folder: Path | str) -> Iterator[None]:
    """Be the only one who writes to a folder, which is made if need be.

    It ends with the process, however that ends. In one process, too, a second one is refused.

    Raises:
        UnreadableFile: Somebody else is writing to it.
        UnwritableFolder: There is no permission, or a file in its place.
    """
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_RDONLY)
    except OSError as error:
        raise UnwritableFolder(str(path), error.strerror or str(error)) from None
    try:
        _hold(path, handle)
        yield
    finally:
        os.close(handle)


def _hold(path: Path, handle: int) -> None:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        reason = "another process is writing to it"
        raise UnreadableFile(str(path), reason, "wait, or give another folder") from None
