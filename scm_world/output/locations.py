"""Where results are: in a folder of this machine, or where a URL says."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import unquote

from scm_world.errors import UnknownOption
from scm_world.output.remote import Remote

Location = Path | Remote
"""A file or folder, on this machine or elsewhere."""

_MANGLED = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")


def located(given: Location | str) -> Location:
    """Turn what names a file or folder into something that can be read and written.

    Args:
        given: A path, or a URL as a text: ``"s3://bucket/run"``, ``"memory://run"``. Where
            ``file://`` stands in front, the rest is a path of this machine.

    Raises:
        MissingExtra: It is a URL of another place, and fsspec or the package of the protocol is not
            installed.
        UnknownOption: There is no such protocol, a password stands in the URL, or a URL was made
            a ``Path``.

    Example:
        >>> located("runs/one").name, located("file:///runs/one%202").name
        ('one', 'one 2')
    """
    if isinstance(given, Remote):
        return given
    if isinstance(given, Path):
        if _MANGLED.match(str(given)):
            raise UnknownOption("folder", str(given), ("a URL as a text: a Path spoils it",))
        return given
    protocol, slashes, rest = given.partition("://")
    if not slashes:
        return Path(given)
    if not protocol:
        raise UnknownOption("URL", given, ("protocol://place, such as s3://bucket/run",))
    if protocol not in ("file", "local"):
        return Remote(given)
    path = rest.removeprefix("localhost")
    if not path.startswith("/"):
        raise UnknownOption("URL", given, ("file:///… with three slashes",))
    return Path(unquote(path))
