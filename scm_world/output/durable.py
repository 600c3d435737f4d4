"""Files that are whole or absent, also after a loss of power, and folders with one writer."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from scm_world.errors import UnreadableFile, UnwritableFolder
from scm_world.output.leases import leased
from scm_world.output.locations import Location, located
from scm_world.output.remote import Remote, draft_name, said


def draft_of(path: Location) -> Location:
    """Name the hidden file that becomes another one once it is whole.

    Example:
        >>> draft_of(Path("study.json")).name
        '.study.json.part'
    """
    return path.with_name(draft_name(path.name))


def write_durably(path: Location | str, data: bytes) -> None:
    """Write a file, whole or not at all; it is on the disk, or in the store, when this ends.

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
        with draft.open("wb") as stream:
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

    It ends with the process, however that ends; in an object store after a while, see ``leased``.
    In one process, too, a second one is refused.

    Raises:
        UnreadableFile: Somebody else is writing to it.
        UnwritableFolder: There is no permission, or a file in its place.
    """
    place = located(folder)
    with leased(place) if isinstance(place, Remote) else _flocked(place):
        yield


@contextmanager
def _flocked(path: Path) -> Iterator[None]:
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
