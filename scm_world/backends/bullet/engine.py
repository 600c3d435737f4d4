"""The module ``pybullet``: imported when it is needed, and quietly."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import metadata
from typing import Any

from scm_world.errors import MissingEngine

INSTALL = 'pip install "pybullet==3.2.7"'
REASON = "wheels exist for Linux and Python < 3.12 only"


def load() -> Any:
    """Import pybullet.

    Its import writes to the C library's streams, past ``sys.stdout``; nothing of it gets through.

    Raises:
        MissingEngine: It is not installed.
    """
    if sys.modules.get("pybullet") is not None:
        return sys.modules["pybullet"]
    try:
        with silence():
            import pybullet
    except ImportError as error:
        raise MissingEngine("bullet", INSTALL, f"{error}; {REASON}") from error
    return pybullet


def version() -> str:
    """Give the version of pybullet.

    Raises:
        MissingEngine: It is not installed.
    """
    try:
        return metadata.version("pybullet")
    except metadata.PackageNotFoundError as error:
        raise MissingEngine("bullet", INSTALL, REASON) from error


@contextmanager
def silence() -> Iterator[None]:
    """Send what is written to the file descriptors of stdout and stderr nowhere."""
    _flush()
    saved: dict[int, int] = {}
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        for stream in (1, 2):
            with suppress(OSError):  # a daemon may have closed it
                saved[stream] = os.dup(stream)
                os.dup2(nowhere, stream)
        yield
    finally:
        _flush()
        for stream, copy in saved.items():
            os.dup2(copy, stream)
            os.close(copy)
        os.close(nowhere)


def _flush() -> None:
    """Empty the buffers of Python and of C, so that nothing crosses the border late."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, OSError, ValueError):
            stream.flush()
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).fflush(None)
