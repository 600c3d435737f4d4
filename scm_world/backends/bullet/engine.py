"""The module ``pybullet``: imported when it is needed, and quietly."""

from __future__ import annotations

import ctypes
import os
import sys
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from importlib import metadata
from types import ModuleType
from typing import Any, final

from scm_world.errors import EngineFailure, MissingEngine

INSTALL = 'pip install "pybullet==3.2.7"'
REASON = "wheels exist for Linux and Python < 3.12 only"


def load() -> tuple[ModuleType, str]:
    """Import pybullet; return the module and its version.

    The import writes to the C library's streams, past ``sys.stdout``; nothing of it gets through.
    """
    try:
        with nullcontext() if sys.modules.get("pybullet") else silence():
            import pybullet
        return pybullet, metadata.version("pybullet")
    except (ImportError, metadata.PackageNotFoundError) as error:
        raise MissingEngine("bullet", INSTALL, f"{error}; {REASON}") from error


@final
class Connection:
    """The functions and constants of the engine, for a physics client of its own.

    ``handle`` is the number of the client, ``close`` disconnects it; so does the end of this.
    """

    def __init__(self, engine: ModuleType) -> None:
        self._engine, self.handle = engine, engine.connect(engine.DIRECT)
        if self.handle < 0:
            raise EngineFailure("Bullet has no physics client left; close some backends", "bullet")
        self.close = weakref.finalize(self, _disconnect, engine, self.handle)

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._engine, name)
        if callable(found):
            found = partial(found, physicsClientId=self.handle)
        setattr(self, name, found)
        return found


def _disconnect(engine: ModuleType, handle: int) -> None:
    with suppress(engine.error):
        engine.disconnect(physicsClientId=handle)


@contextmanager
def silence() -> Iterator[None]:
    """Discard what the C library writes to the file descriptors of stdout and stderr."""
    flush, saved = ctypes.CDLL(None).fflush, dict[int, int]()
    flush(None)
    with open(os.devnull, "w") as nowhere:
        for stream in (1, 2):
            with suppress(OSError):  # a daemon may have closed it
                saved[stream] = os.dup(stream)
                os.dup2(nowhere.fileno(), stream)
    try:
        yield
    finally:
        flush(None)
        for stream, copy in saved.items():
            os.dup2(copy, stream)
            os.close(copy)
