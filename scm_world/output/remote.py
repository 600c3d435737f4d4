"""Where results are: in a folder of this machine, or behind a URL of fsspec."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias
from urllib.parse import unquote

from scm_world.errors import MissingExtra, UnknownOption

if TYPE_CHECKING:
    from upath import UPath

Location: TypeAlias = "Path | UPath"
"""A file or folder: a ``Path`` on this machine, elsewhere a ``UPath`` of universal_pathlib."""

STORES = ("abfs", "az", "gs", "memory", "s3", "sftp")
"""Some protocols that fsspec knows, for messages."""

_PACKAGE = re.compile(r"nstall ['\"`]?([\w.-]+)")
"""What fsspec says of a protocol whose package is missing."""
_PASSWORD = re.compile(r"://[^/@]*:[^/]*@")
_MANGLED = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")


def located(given: Location | str) -> Location:
    """Turn what names a file or folder into something that can be read and written.

    Args:
        given: A path, or a URL as a text: ``"s3://bucket/run"``, ``"memory://run"``. Where
            ``file://`` stands in front, the rest is a path of this machine.

    Raises:
        MissingExtra: It is a URL of another place, and universal_pathlib or the package of the
            protocol is not installed.
        UnknownOption: It is no path, there is no such protocol, a password stands in the URL, or a
            URL was made a ``Path``.

    Example:
        >>> located("runs/one").name, located("file:///runs/one%202").name
        ('one', 'one 2')
    """
    if isinstance(given, Path):
        if _MANGLED.match(str(given)):
            raise UnknownOption("folder", str(given), ("a URL as a text: a Path spoils it",))
        return given
    if not isinstance(given, str):
        if not hasattr(given, "iterdir"):
            raise UnknownOption("path", given, ("a path, or a URL as a text",))
        return given
    protocol, slashes, rest = given.partition("://")
    if not slashes:
        return Path(given)
    if not protocol:
        raise UnknownOption("URL", given, ("protocol://place, such as s3://bucket/run",))
    if protocol in ("file", "local"):
        path = rest.removeprefix("localhost")
        if not path.startswith("/"):
            raise UnknownOption("URL", given, ("file:///… with three slashes",))
        return Path(unquote(path))
    if _PASSWORD.search(given):  # it would stand in messages and results
        safe = ["one without a password: fsspec reads it from its own configuration"]
        raise UnknownOption("URL", _PASSWORD.sub("://…@", given), safe)
    try:
        upath: Any = import_module("upath")
    except ImportError:
        raise MissingExtra("universal_pathlib", "cloud") from None
    try:
        found: UPath = upath.UPath(given)
        found.fs.invalidate_cache()  # others write there, too
    except ValueError:
        known = [*STORES, "file", "any other that fsspec knows"]
        raise UnknownOption("protocol of a URL", protocol, known) from None
    except ImportError as error:
        named = _PACKAGE.search(str(error))
        raise MissingExtra(named[1] if named else protocol) from None
    return found
