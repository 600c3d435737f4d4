"""Checks of arguments, and optional libraries."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

from scm_world.errors import MissingExtra, UnknownOption


def whole_number(option: str, value: Any, *, least: int) -> int:
    """Return an option that is a whole number.

    Raises:
        UnknownOption: It is none, or too small.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise UnknownOption(option, value, (f"any whole number from {least} on",))
    return int(value)


def load(module: str, library: str, extra: str = "") -> Any:
    """Import a module of an optional library.

    Args:
        module: Its full name.
        library: As it is called on the package index.
        extra: The optional dependency of this package that brings it; named like it if empty.

    Raises:
        MissingExtra: It is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise MissingExtra(library, extra or library) from error
