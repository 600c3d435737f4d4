"""A store for tests, in the memory of this process."""

from __future__ import annotations

from typing import Any
from uuid import uuid4

import pytest

from scm_world.runs.files import Location, located

pytest.importorskip("upath")
MemoryFileSystem: Any = pytest.importorskip("fsspec.implementations.memory").MemoryFileSystem


def refuse(*given: Any, **how: Any) -> None:
    """Let nobody write."""
    raise PermissionError(13, "Access Denied", str(given[1]))


def fresh() -> Location:
    """Name a folder that nobody has used."""
    return located(f"memory://{uuid4().hex}/run")


def everything(folder: Location) -> dict[str, bytes]:
    """Read all that is below a folder, under its names there."""
    found: dict[str, bytes] = {}
    for one in folder.iterdir():
        if one.is_dir():
            found |= {f"{one.name}/{name}": data for name, data in everything(one).items()}
        else:
            found[one.name] = one.read_bytes()
    return found
