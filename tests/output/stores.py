"""Stores for tests: in the memory of this process, and with the faults that real ones have."""

from __future__ import annotations

from typing import Any
from uuid import uuid4

import pytest

from scm_world.output.remote import Remote, located

fsspec: Any = pytest.importorskip("fsspec")
memory: Any = pytest.importorskip("fsspec.implementations.memory")


class Shelf(memory.MemoryFileSystem):  # type: ignore[misc]
    """No object store: a file grows while it is written, and is moved by its name."""

    protocol = "shelf"
    store: dict[str, Any] = {}  # noqa: RUF012 # as in the class above
    pseudo_dirs = [""]  # noqa: RUF012

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return str(super()._strip_protocol(path.removeprefix("shelf://")))


class Closed(Shelf):
    """Nobody may write."""

    protocol = "closed"

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return str(super()._strip_protocol(path.removeprefix("closed://")))

    def pipe_file(self, path: str, value: bytes, mode: str = "overwrite", **kwargs: Any) -> None:
        """Refuse."""
        raise PermissionError(13, "Access Denied", path)


class Careless(Shelf):
    """It creates what is there already, as stores do that know no conditions."""

    protocol = "careless"

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return str(super()._strip_protocol(path.removeprefix("careless://")))

    def pipe_file(self, path: str, value: bytes, mode: str = "overwrite", **kwargs: Any) -> None:
        """Write over what is there."""
        super().pipe_file(path, value)


for kind in (Shelf, Closed, Careless):
    fsspec.register_implementation(kind.protocol, kind, clobber=True)


def fresh(protocol: str = "memory") -> Remote:
    """Name a folder that nobody has used."""
    made = located(f"{protocol}://{uuid4().hex}/run")
    assert isinstance(made, Remote)
    return made


def everything(folder: Remote) -> dict[str, bytes]:
    """Read all that is below a folder, under its names there."""
    found: dict[str, bytes] = {}
    for one in folder.iterdir():
        if one.is_dir():
            found |= {f"{one.name}/{name}": data for name, data in everything(one).items()}
        else:
            found[one.name] = one.read_bytes()
    return found
