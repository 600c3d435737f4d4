"""Files that are whole or absent, also after a loss of power, and folders with one writer."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

from scm_world.errors import UnreadableFile, UnwritableFolder
from scm_world.output.remote import Location, located

PARTIAL = ".part"
"""How the names of files end that are not whole yet."""


def draft_name(name: str) -> str:
    """Return a hidden name for a file until it is whole; another one each time.

    Example:
        >>> draft_name("study.json") == draft_name("study.json")
        False
    """
    return f".{name}.{uuid4().hex[:16]}{PARTIAL}"


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
    """Write a file, whole or not at all; it is on the disk when this ends.

    Of several simultaneous writers the last one decides; a reader always finds a whole file.
    Behind a URL all of this is as fsspec and the store have it.

    Raises:
        UnwritableFolder: There is no room, or no permission; what was there is still there.
    """
    target = located(path)
    if not isinstance(target, Path):
        try:
            target.write_bytes(data)
        except OSError as error:
            raise UnwritableFolder(str(target.parent), f"{target.name}: {said(error)}") from error
        return
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


def said(error: OSError) -> str:
    """Say what went wrong; some errors of stores are but a path, and need their name.

    Example:
        >>> said(FileExistsError("/run")), said(OSError(28, "No space left"))
        ('FileExistsError: /run', 'No space left')
    """
    if error.strerror:
        return error.strerror
    return str(error) if type(error) is OSError else f"{type(error).__name__}: {error}"


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
    Behind a URL there are no locks: two writers may write there. What they write in the folders
    of this package is the same, whoever writes it.

    Raises:
        UnreadableFile: Another process is writing to it.
        UnwritableFolder: There is no permission, or a file in its place.
    """
    path = located(folder)
    if not isinstance(path, Path):
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
