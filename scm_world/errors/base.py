"""What all errors have in common."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any


def nearest(name: str, known: Iterable[str]) -> str | None:
    """Find the known name that looks most like ``name``.

    Example:
        >>> nearest("tool_blok.mass", ["tool_block.mass", "floor_friction"])
        'tool_block.mass'
    """
    matches = difflib.get_close_matches(str(name), list(known), n=1, cutoff=0.5)
    return matches[0] if matches else None


def suggested(suggestion: str | None) -> str:
    """Say it as a question; nothing if there is none."""
    return f"; did you mean {suggestion!r}?" if suggestion else ""


def _rebuild(kind: type[ScmWorldError], message: str, data: dict[str, Any]) -> ScmWorldError:
    """Make an error from its message and attributes, without its constructor."""
    error = kind.__new__(kind, message)
    error.args = (message,)  # an OSError takes no message before its constructor
    error.__dict__.update(data)
    return error


class ScmWorldError(Exception):
    """Anything this package raises on purpose. It can be pickled, attributes included."""

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild, (type(self), str(self), self.__dict__)


def in_one_line(error: Exception) -> str:
    """Write an error in one line; with its name, unless it is one of ours.

    Example:
        >>> in_one_line(KeyError("mass")), in_one_line(ScmWorldError("too heavy"))
        ("KeyError: 'mass'", 'too heavy')
    """
    text = " ".join(str(error).split())
    name = type(error).__name__
    return text if text and isinstance(error, ScmWorldError) else f"{name}: {text}".rstrip(": ")
