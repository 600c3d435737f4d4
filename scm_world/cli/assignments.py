"""Reading ``name=value`` from the command line."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import typer

from scm_world.errors import ConflictingTargets, UnknownOption

_HINT = "'NAME=VALUE...'"


def _refuse(text: str, why: str, hint: str = _HINT) -> typer.BadParameter:
    return typer.BadParameter(f"{text!r}: {why}", param_hint=hint)


def _number(text: str) -> Any:
    """Read one number; text that is none is left to the model, which knows what it expects."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def _numbers(text: str) -> Any:
    """Read a number, ``1,2,3`` or ``[1, 2, 3]``."""
    bare = text.strip()
    listed = bare.startswith("[") and bare.endswith("]")
    if listed:
        bare = bare[1:-1]
    if not listed and "," not in bare:
        return _number(bare)
    parts = [part.strip() for part in bare.split(",")]
    return [_number(part) for part in parts if part or len(parts) > 1]


def parse_value(text: str, hint: str = _HINT) -> Any:
    """Read a value or an intervention.

    Args:
        text: A number, a list of numbers, ``shift:…``, ``scale:…``, or ``draw:A``.
        hint: The argument that it was given for, for the message.

    Raises:
        BadParameter: It is empty, or an intervention that does not exist.

    Example:
        >>> parse_value("0.05"), parse_value("[0, 0, -5]"), parse_value("shift:0.1")
        (0.05, [0, 0, -5], Shift(kind='shift', by=0.1))
    """
    from scm_world.variables import Draw, Scale, Shift

    if not text.strip():
        raise _refuse(text, "there is no value", hint)
    kind, colon, rest = text.partition(":")
    if not colon:
        return _numbers(text)
    try:
        match kind.strip().lower():
            case "shift":
                return Shift(_numbers(rest))
            case "scale":
                return Scale(_numbers(rest))
            case "draw":
                return Draw(rest.strip())
    except UnknownOption:
        wanted = "draw:A, draw:B or draw:A|B" if kind.strip().lower() == "draw" else "numbers"
        raise _refuse(text, f"expected {wanted}", hint) from None
    raise _refuse(text, "expected a number, a list, shift:…, scale:… or draw:…", hint)


def parse_assignments(texts: Iterable[str], hint: str = _HINT) -> dict[str, Any]:
    """Read ``name=value`` pairs.

    Args:
        texts: One pair each.
        hint: The argument that they were given for, for messages.

    Raises:
        BadParameter: One has no ``=``, no name, or a value that cannot be read.
        ConflictingTargets: A name is given twice.
    """
    request: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        name = name.strip()
        if not equals or not name:
            raise _refuse(text, "expected name=value, for example floor_friction=0.4", hint)
        if name in request:
            raise ConflictingTargets((name, name), name)
        request[name] = parse_value(value, hint)
    return request
