"""Files on this machine or behind URLs of fsspec: written whole, and read without running code."""

from __future__ import annotations

import io
import os
import re
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import load
from scm_world.errors import (
    MissingExtra,
    UnknownOption,
    UnreadableFile,
    UnwritableFolder,
    in_one_line,
)

if TYPE_CHECKING:
    from upath import UPath

Location: TypeAlias = "Path | UPath"
"""A file or folder: a ``Path`` on this machine, elsewhere a ``UPath`` of universal_pathlib."""

DRAFT = ".part"
"""How the names of files end that are not whole yet; they begin with a dot."""
STORES = ("abfs", "az", "gs", "memory", "s3", "sftp", "file", "any other that fsspec knows")
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")
_PASSWORD = re.compile(r"://[^/@]*:[^/]*@")


def located(given: Location | str) -> Location:
    """Return the file or folder that a path, or a URL as a text, names.

    Passwords in URLs are refused: messages and results would show them.
    """
    if isinstance(given, str | Path) and (not given or _CONTROL.search(str(given))):
        raise UnknownOption("path", given, ("a path, or a URL, without control characters",))
    if not isinstance(given, str):
        if not hasattr(given, "iterdir"):
            raise UnknownOption("path", given, ("a path, or a URL as a text",))
        if isinstance(given, Path) and re.match(r"[A-Za-z][A-Za-z0-9+.-]+:/", str(given)):
            raise UnknownOption("folder", str(given), ("a URL as a text: a Path spoils it",))
        return given
    protocol, slashes, rest = given.partition("://")
    if not slashes:
        return Path(given)
    if protocol in ("file", "local") and rest.removeprefix("localhost").startswith("/"):
        from urllib.request import url2pathname  # slow to import

        return Path(url2pathname(rest.removeprefix("localhost")))
    if protocol in ("", "file", "local"):
        raise UnknownOption("URL", given, ("s3://bucket/run", "file:///… with three slashes"))
    if _PASSWORD.search(given):
        safe = ["one without a password: fsspec reads it from its own configuration"]
        raise UnknownOption("URL", _PASSWORD.sub("://…@", given), safe)
    upath = load("upath", "universal_pathlib", "cloud")
    try:
        found: UPath = upath.UPath(given)
        found.fs.invalidate_cache()  # others write there, too
    except ValueError:
        raise UnknownOption("protocol of a URL", protocol, STORES) from None
    except ImportError as error:
        named = re.search(r"nstall ['\"`]?([\w.-]+)", str(error))
        raise MissingExtra(named[1] if named else protocol) from None
    return found


def read_bytes(path: Location | str) -> bytes:
    """Read a file; an ``OSError`` where it is a folder, or a device or pipe without an end."""
    where = located(path)
    if (found := obstacle(where, "regular file")) is not None:
        raise OSError(found)
    return where.read_bytes()


def is_there(path: Location) -> bool:
    """Return whether a name is taken, be it by a link to a file that does not exist."""
    return path.exists() or (isinstance(path, Path) and path.is_symlink())


def obstacle(path: Location, wanted: str) -> str | None:
    """Describe why a path is not a ``"regular file"`` or a ``"folder"``; None if it is, or is free.

    A link without its file, and a file in place of a folder above, are such reasons.
    """
    places = (path, *path.parents) if isinstance(path, Path) else (path,)
    for place in places:
        if not is_there(place):
            continue
        if not place.exists():
            return f"{place} is a link to {place.readlink()}, which does not exist"
        kind = "a device, a pipe or a socket"
        kind = "a folder" if place.is_dir() else "a regular file" if place.is_file() else kind
        kinds = f"a {wanted if place is path else 'folder'}"
        return None if kind == kinds else f"{place} is not {kinds}, but {kind}"
    return None


def read_text(path: Location | str, encoding: str = "utf-8") -> str:
    """Read a text; errors as in ``read_bytes``, and a ``ValueError`` for other bytes."""
    return read_bytes(path).decode(encoding).replace("\r\n", "\n")


def read_arrays(source: Location | str | bytes) -> dict[str, NDArray[Any]]:
    """Read the arrays of an archive of NumPy (.npz), by name; pickled objects are refused."""
    data = source if isinstance(source, bytes) else read_bytes(source)
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


def write_whole(path: Location | str, data: bytes | str) -> None:
    """Write a file whole or not at all, with its folder; a text as UTF-8.

    Of several simultaneous writers the last one decides; a reader always finds a whole file.
    Behind a URL all of this is as fsspec and the store have it.
    """
    target = located(path)
    content = data if isinstance(data, bytes) else data.encode("utf-8", "backslashreplace")
    make_folder(target.parent)
    with _naming(target.parent, target.name):
        if not isinstance(target, Path):
            target.write_bytes(content)
            return
        if not target.is_file() and is_there(target):
            raise FileExistsError  # a device, a folder, a link: it is not replaced
        draft = target.with_name(f".{target.name}.{uuid4().hex[:16]}{DRAFT}")
        try:
            with draft.open("xb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            draft.replace(target)
        finally:
            with suppress(OSError):
                draft.unlink(missing_ok=True)


def remove(path: Location) -> None:
    """Remove a file, if it is there; ``UnwritableFolder`` without permission."""
    with _naming(path.parent, path.name):
        path.unlink(missing_ok=True)


def make_folder(folder: Location | str) -> Location:
    """Make a folder, unless it exists; ``UnwritableFolder`` where that is impossible."""
    path = located(folder)
    with _naming(path):
        path.mkdir(parents=True, exist_ok=True)
    return path


@contextmanager
def _naming(folder: Location, file: str = "") -> Iterator[None]:
    """Raise an error of the system as one that names the folder, and the file."""
    try:
        yield
    except OSError as error:
        found = obstacle(folder / file, "regular file") if file else obstacle(folder, "folder")
        if found is not None:
            raise UnwritableFolder(str(folder), found, "give another path") from None
        said = error.strerror or in_one_line(error)
        raise UnwritableFolder(str(folder), f"{file}: {said}" if file else said) from None


@contextmanager
def drafted(folder: Location) -> Iterator[Location]:
    """Yield a folder whose files are in ``folder`` when the block has ended without an error.

    Behind a URL they are written in place, and removed after an error.
    """
    draft: Location = folder
    if isinstance(folder, Path):
        whole = folder.resolve()
        draft = whole.with_name(f".{whole.name}{DRAFT}")
        shutil.rmtree(draft, ignore_errors=True)  # of a process that was killed
    try:
        yield draft
    except BaseException:
        for path in draft.iterdir() if draft.exists() else ():
            remove(path)
        with suppress(OSError):
            draft.rmdir()
        raise
    if isinstance(draft, Path) and isinstance(folder, Path):
        with suppress(OSError):
            folder.rmdir()  # an empty one, which Windows does not replace
        draft.replace(folder)


@contextmanager
def locked(folder: Location | str) -> Iterator[None]:
    """Lock a folder for this process, until the block or the process ends.

    Behind a URL nothing is locked: two writers of one study write the same files there.
    """
    path = make_folder(folder)
    if not isinstance(path, Path):
        yield
        return
    there, flags = path.resolve(), os.O_RDONLY
    if sys.platform == "win32":  # which opens no folder: a file beside it, gone when it is closed
        there = there.with_name(f".{there.name}.lock")
        flags = os.O_RDWR | os.O_CREAT | os.O_TEMPORARY
    handle = os.open(there, flags)
    try:
        try:
            if sys.platform == "win32":
                import msvcrt

                msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
            else:
                import fcntl

                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            reason = "another process is writing to it"
            raise UnreadableFile(str(path), reason, "wait, or give another folder") from None
        yield
    finally:
        os.close(handle)
