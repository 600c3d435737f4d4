"""Versions of the software that a result depends on."""

from __future__ import annotations

import importlib.metadata
import platform
from functools import cache

_version = cache(importlib.metadata.version)  # each reads a file of the package for 5 ms


def versions(engine: str = "") -> dict[str, str]:
    """Return the versions that determine a result; ``engine`` is ``"name version"`` of physics."""
    found = {"python": platform.python_version()}
    for package in ("scm-world", "numpy", "numba", "networkx", "gymnasium", "pydantic"):
        found[package] = _version(package)
    if engine:
        name, _, version = engine.partition(" ")
        found[name] = version
    return found
