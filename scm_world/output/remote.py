"""Where results are: in a folder of this machine, in object stores, and wherever fsspec reaches."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from fnmatch import fnmatchcase
from importlib import import_module
from pathlib import Path
from typing import Any, final
from urllib.parse import unquote
from uuid import uuid4

from scm_world.errors import MissingExtra, ScmWorldError, UnknownOption, UnreadableFile

OBJECT_STORES = ("abfs", "abfss", "az", "gcs", "gs", "memory", "s3", "s3a")
"""Protocols of stores that have no folders, and in which an object appears as a whole."""

PARTIAL = ".part"
"""How the names of files end that are not whole yet."""

_PACKAGE = re.compile(r"nstall ['\"`]?([\w.-]+)")
"""What fsspec says of a protocol whose package is missing."""

_PASSWORD = re.compile(r"://[^/@]*:[^/]*@")


@final
class Remote:
    """A file or folder that a URL names, with those methods of ``pathlib.Path`` that results need.

    It keeps its text only, so it can be pickled. Credentials come from where fsspec and the
    package of the store look for them. Like those of a ``Path``, methods that read or write raise
    ``OSError``.

    Args:
        url: Such as ``"s3://bucket/run"``.

    Raises:
        MissingExtra: fsspec, or the package of the protocol, is not installed.
        UnknownOption: There is no such protocol, or a password stands in the URL.
    """

    __slots__ = ("_path", "_protocol")

    def __init__(self, url: str) -> None:
        self._protocol, _, path = url.partition("://")
        self._path = path.rstrip("/")
        _check(url, self._protocol)

    # --- names --------------------------------------------------------------------------------

    @property
    def name(self) -> str:
        """The last part."""
        return self._path.rpartition("/")[2]

    @property
    def suffix(self) -> str:
        """The ending of the name, with its dot."""
        stem, dot, ending = self.name.rpartition(".")
        return dot + ending if stem and ending else ""

    @property
    def parent(self) -> Remote:
        """The folder that it is in."""
        return self._other(self._path.rpartition("/")[0])

    def with_name(self, name: str) -> Remote:
        """Name another file in the same folder."""
        return self.parent / name

    def __truediv__(self, name: str) -> Remote:
        return self._other(f"{self._path}/{name}" if self._path else name)

    def _other(self, path: str) -> Remote:
        made = object.__new__(Remote)
        made._protocol, made._path = self._protocol, path.rstrip("/")
        return made

    def __str__(self) -> str:
        return f"{self._protocol}://{self._path}"

    def __repr__(self) -> str:
        return f"Remote({str(self)!r})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Remote) and str(self) == str(other)

    def __hash__(self) -> int:
        return hash(str(self))

    def __lt__(self, other: object) -> bool:
        return str(self) < str(other)

    def __reduce__(self) -> tuple[type[Remote], tuple[str]]:
        return Remote, (str(self),)

    # --- reading ------------------------------------------------------------------------------

    def exists(self) -> bool:
        """Tell whether there is such a file or folder; a folder is there once a file is in it.

        Raises:
            UnreadableFile: The store does not tell.
        """
        return bool(self._kind())

    def is_dir(self) -> bool:
        """Tell whether it is a folder with something in it.

        Raises:
            UnreadableFile: The store does not tell.
        """
        return self._kind() == "directory"

    def _kind(self) -> str:
        with self._asked(), self._store() as (store, path):
            return str(store.info(path)["type"])
        return ""

    def read_bytes(self) -> bytes:
        """Read the file."""
        with self._store() as (store, path):
            return bytes(store.cat_file(path))

    def read_text(self, encoding: str = "utf-8") -> str:
        """Read the file as a text."""
        return self.read_bytes().decode(encoding)

    def size(self) -> int:
        """Return the number of bytes of the file; 0 where the store does not tell."""
        with self._store() as (store, path):
            return int(store.size(path) or 0)

    def iterdir(self) -> Iterator[Remote]:
        """List what is in the folder, in order; nothing if it is not there.

        Raises:
            UnreadableFile: The store does not tell.
        """
        listed: list[str] = []
        with self._asked(), self._store() as (store, path):
            own = str(path).strip("/")
            listed = [one.strip("/") for one in store.ls(path, detail=False)]
            listed = [one for one in listed if one != own]  # some stores list the folder, too
        yield from (self / name for name in sorted({one.rpartition("/")[2] for one in listed}))

    def glob(self, pattern: str) -> Iterator[Remote]:
        """List what is below the folder and fits a pattern such as ``"cells/*/*.json"``."""
        first, _, rest = pattern.partition("/")
        for found in self.iterdir():
            if fnmatchcase(found.name, first):
                yield from found.glob(rest) if rest else (found,)

    @contextmanager
    def _asked(self) -> Iterator[None]:
        """Ask what there is; that there is nothing is an answer."""
        try:
            yield
        except FileNotFoundError:
            return
        except OSError as error:
            advice = "check the name, the network, and that you are allowed to"
            raise UnreadableFile(str(self), said(error), advice) from error

    # --- writing ------------------------------------------------------------------------------

    def mkdir(self, *, parents: bool = False, exist_ok: bool = False) -> None:
        """Make the folder where there are such things; the arguments are those of a ``Path``."""
        if self._protocol not in OBJECT_STORES:  # there it would be a bucket
            with self._store() as (store, path):
                store.makedirs(path, exist_ok=True)

    def put(self, data: bytes) -> None:
        """Write the file, whole or not at all; a folder is made if need be.

        Elsewhere than in an object store a draft is written, and moved to its place.
        """
        if self._protocol in OBJECT_STORES:
            with self._store() as (store, path):
                store.pipe_file(path, data)
            return
        self.parent.mkdir(parents=True, exist_ok=True)
        draft = self.with_name(draft_name(self.name))
        try:
            with self._store() as (store, path), draft._store() as (_, unfinished):
                store.pipe_file(unfinished, data)
                store.mv(unfinished, path)
        finally:
            with suppress(OSError):
                draft.unlink(missing_ok=True)

    def unlink(self, missing_ok: bool = False) -> None:
        """Remove the file."""
        try:
            with self._store() as (store, path):
                store.rm_file(path)
        except FileNotFoundError:
            if not missing_ok:
                raise

    @contextmanager
    def _store(self) -> Iterator[tuple[Any, str]]:
        """Reach the store, which must not answer from what it remembers: others write to it, too.

        Raises:
            OSError: Whatever went wrong.
        """
        try:
            store, path = import_module("fsspec.core").url_to_fs(str(self))
            store.invalidate_cache()
            yield store, path
        except (OSError, ScmWorldError):
            raise
        except Exception as error:  # of whatever kind: each package of a store has its own
            raise OSError(f"{type(error).__name__}: {error}") from error


def draft_name(name: str) -> str:
    """Return a hidden name for a file until it is whole; another one each time.

    Example:
        >>> draft_name("study.json") == draft_name("study.json")
        False
    """
    return f".{name}.{uuid4().hex[:16]}{PARTIAL}"


def said(error: OSError) -> str:
    """Say what went wrong; some errors of stores are but a path, and need their name.

    Example:
        >>> said(FileExistsError("/run")), said(OSError(28, "No space left"))
        ('FileExistsError: /run', 'No space left')
    """
    if error.strerror:
        return error.strerror
    return str(error) if type(error) is OSError else f"{type(error).__name__}: {error}"


def _check(url: str, protocol: str) -> None:
    """Refuse what fsspec cannot reach, and passwords, which would stand in messages and results."""
    if _PASSWORD.search(url):
        safe = ["one without a password: fsspec reads it from its own configuration"]
        raise UnknownOption("URL", _PASSWORD.sub("://…@", url), safe)
    try:
        registry = import_module("fsspec.registry")
    except ImportError:
        raise MissingExtra("fsspec", "cloud") from None
    try:
        registry.get_filesystem_class(protocol)
    except ValueError:
        known = [*OBJECT_STORES, "file", "any other that fsspec knows"]
        raise UnknownOption("protocol of a URL", protocol, known) from None
    except ImportError as error:
        named = _PACKAGE.search(str(error))
        raise MissingExtra(named[1] if named else protocol) from None


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
