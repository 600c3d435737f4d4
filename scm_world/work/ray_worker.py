"""What happens in a worker of Ray: it needs this package, and nothing of Ray."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import final

from scm_world.errors import EngineFailure
from scm_world.work.processes import UNMADE, answered
from scm_world.work.threads import single_threaded

SAME = ("scm-world", "numpy", "numba", "mujoco", "pybullet")
"""Packages whose versions decide what comes out of a job."""


@final
@dataclass(frozen=True)
class Luggage:
    """What a worker needs beside its jobs.

    Attributes:
        key: Names ``make``.
        make: Pickled; called once in each worker.
        paths: Where the process that asks finds its modules; it is looked there, too.
        folder: Where that process works.
        versions: Of what it uses; those of a worker have to be the same.
    """

    key: str
    make: bytes
    paths: tuple[str, ...]
    folder: str
    versions: dict[str, str]


_THINGS: dict[str, list[object]] = {}
_HELD = ExitStack()  # one thread for each library, until the worker ends


def versions() -> dict[str, str]:
    """List the versions that decide what comes out of a job."""
    found = {"python": platform.python_version()}
    for package in SAME:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "none"
    return found


def answer(luggage: Luggage, job: bytes) -> bytes:
    """Do a job; what was made for it is kept for the next one.

    Args:
        luggage: Beside the job.
        job: A tuple of it alone, pickled.

    Returns:
        What ``answered`` gives.
    """
    if luggage.key not in _THINGS:
        problem = _prepared(luggage)
        if problem is not None:
            return bytes(ForkingPickler.dumps((UNMADE, problem)))
    return answered(luggage.make, _THINGS[luggage.key], "__call__", job)


def _prepared(luggage: Luggage) -> EngineFailure | None:
    """Make room for another bag of jobs."""
    mine = versions()
    others = [name for name, version in luggage.versions.items() if mine[name] != version]
    if others:
        said = ", ".join(f"{n} is {mine[n]} there, {luggage.versions[n]} here" for n in others)
        return EngineFailure(f"a node of Ray would give other results: {said}", "ray")
    if not _THINGS:
        _HELD.enter_context(single_threaded())
    for things in _THINGS.values():
        for thing in things:
            getattr(thing, "close", lambda: None)()
    _THINGS.clear()
    _follow(luggage)
    _THINGS[luggage.key] = []
    return None


def _follow(luggage: Luggage) -> None:
    """Look for modules and files where the process that asks does, if that is there."""
    for path in (path or luggage.folder for path in luggage.paths):
        if path not in sys.path and Path(path).exists():
            sys.path.append(path)
    if Path(luggage.folder).is_dir():
        os.chdir(luggage.folder)
