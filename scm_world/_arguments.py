"""Checks of arguments, and optional libraries."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Container, Iterable
from importlib import import_module
from typing import Any

import numpy as np

from scm_world.errors import MissingExtra, ModelError, UnknownOption


def whole_number(option: str, value: Any, *, least: int) -> int:
    """Return an option that is a whole number.

    Raises:
        UnknownOption: It is none, or too small.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise UnknownOption(option, value, (f"any whole number from {least} on",))
    return int(value)


def one_of(option: str, value: Any, allowed: Collection[Any]) -> None:
    """Refuse an option that is none of those allowed; None is left out of the message.

    Raises:
        UnknownOption: It is none of them.
    """
    if value not in allowed:
        raise UnknownOption(option, value, [one for one in allowed if one is not None])


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


def enter(
    registry: dict[str, Any],
    kind: Any,
    base: type,
    *,
    what: str,
    taken: Container[str],
    check: Callable[[Any], Iterable[str]],
) -> None:
    """Enter a class of a user into a registry, by its ``name``.

    Args:
        registry: The classes that were entered.
        kind: The class. One whose module was run again takes its own place.
        base: What it must be derived from.
        what: What it is called in errors.
        taken: Names that it may not have.
        check: Lists what else is wrong with it.

    Raises:
        ModelError: It is no such class, it lacks methods or a name, or what ``check`` says.
        UnknownOption: Another one has this name.
    """
    if not (inspect.isclass(kind) and issubclass(kind, base)):
        public = f"{base.__module__.rpartition('.')[0]}.{base.__name__}"
        raise ModelError([f"{kind!r} is no class derived from {public}"])
    missing = sorted(getattr(kind, "__abstractmethods__", ()))
    problems = [f"{kind.__name__} does not define {method!r}" for method in missing]
    name = getattr(kind, "name", None)
    if not isinstance(name, str) or not name:
        problems.append(f"{kind.__name__} has no name; set name = 'mine' in the class")
    problems += check(kind)
    if problems:
        raise ModelError(problems)
    other = registry.get(str(name), kind)
    same = (other.__module__, other.__qualname__) == (kind.__module__, kind.__qualname__)
    if name in taken or not same:
        raise UnknownOption(f"name of a {what}", name, ("a name that is not taken",))
    registry[str(name)] = kind
