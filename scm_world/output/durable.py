"""Files that are whole or absent, also after a loss of power, and folders with one writer."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from scm_world.errors import UnreadableFile, UnwritableFolder
from scm_world.output.remote import PARTIAL, Location, Remote, draft_name, located, said


def is_draft(name: str, of: str = "") -> bool:
    """Tell whether a file is hidden until it is whole; a process that was killed may leave one.

    Args:
        name: Of the file.
        of: Name of the file that it would have become; any if empty.

    Example:
        >>> is_draft(draft_name("study.json"), "study.json"), is_draft("study.json")
        (True, False)
    """
    return name.startswith(f".{of}") and name.endswith(PARTIAL)


def write_durably(path: Location | str, data: bytes) -> None:
    """Write a file, whole or not at all; it is on the disk, or in the store, when this ends.

    Of several writers at once the last one decides; a reader always finds a whole file.

    Raises:
        UnwritableFolder: There is no room, or no permission; what was there is still there.
    """
    target = located(path)
    if isinstance(target, Remote):
        _put(target, data)
    else:
        _write(target, data)


def _put(target: Remote, data: bytes) -> None:
    try:
        target.put(data)
    except OSError as error:
        raise UnwritableFolder(str(target.parent), f"{target.name}: {said(error)}") from error


def _write(target: Path, data: bytes) -> None:
    draft = target.with_name(draft_name(target.name))
    try:
        handle = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o666)
        with open(handle, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        draft.replace(target)
        synced(target.parent)
    except OSError as error:
        reason = error.strerror or str(error)
        raise UnwritableFolder(str(target.parent), f"{target.name}: {reason}") from None
    finally:
        with suppress(OSError):
            draft.unlink(missing_ok=True)


def write_whole(text: str, path: Location | str) -> None:
    """Write a text as UTF-8, whole or not at all.

    Raises:
        UnwritableFolder: There is no room, or no permission.
    """
    write_durably(path, text.encode("utf-8", errors="backslashreplace"))


def removed(path: Location) -> None:
    """Remove a file, if it is there.

    Raises:
        UnwritableFolder: There is no permission.
    """
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise UnwritableFolder(str(path.parent), f"{path.name}: {said(error)}") from None


def made(folder: Location) -> Location:
    """Make a folder, if there is none and if there can be.

    Raises:
        UnwritableFolder: There is no permission, or a file in its place.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UnwritableFolder(str(folder), said(error)) from None
    return folder


def synced(folder: Path) -> None:
    """Make a new name in a folder outlast a loss of power."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def locked(folder: Location | str) -> Iterator[None]:
    """Be the only one who writes to a folder, which is made if need be.

    It ends with the process, however that ends. In one process, too, a second one is refused.
    Object stores know no locks: there two writers may write, each file as a whole. What they
    write in the folders of this package is the same, whoever writes it.

    Raises:
        UnreadableFile: Somebody else is writing to it.
        UnwritableFolder: There is no permission, or a file in its place.
    """
    path = located(folder)
    if isinstance(path, Remote):
        made(path)
        yield
        return
    try:
        path.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_RDONLY)
    except OSError as error:
        raise UnwritableFolder(str(path), error.strerror or str(error)) from None
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            reason = "another process is writing to it"
            raise UnreadableFile(str(path), reason, "wait, or give another folder") from None
        yield
    finally:
        os.close(handle)
