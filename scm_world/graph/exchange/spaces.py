"""Spaces in few words, as they are declared."""

from __future__ import annotations

from scm_world.variables import Affine, Box, Either, Space, Switch
from scm_world.variables.spaces import Bound, Bounds


def space_lines(space: Space | None, *, digits: int = 4) -> list[str]:
    """Write a space down, with the names of the variables that it follows.

    Args:
        space: Any space, or None.
        digits: Of a number.

    Returns:
        One line, or one per component where they differ.

    Example:
        >>> space_lines(Box(0.015, 0.045)), space_lines(Box(0.0, (1.0, 2.0)))
        (['0.015 to 0.045'], ['0 to 1', '0 to 2'])
        >>> space_lines(Box(Affine(parent="size", index=2, scale=0.5), 0.3))
        ['0.5 size[2] to 0.3']
    """
    match space:
        case None:
            return []
        case Box(low=low, high=high):
            return _box_lines(_ends(low, digits), _ends(high, digits))
        case Either(first=first, second=second):
            parts = (", ".join(space_lines(part, digits=digits)) for part in (first, second))
            return [" or ".join(parts)]
    return [space.describe((), {})]


def _box_lines(lows: list[str], highs: list[str]) -> list[str]:
    size = max(len(lows), len(highs))
    lows, highs = (ends * size if len(ends) == 1 else ends for ends in (lows, highs))
    ends = zip(lows, highs, strict=True)
    pairs = [low if low == high else f"{low} to {high}" for low, high in ends]
    if len(set(pairs)) == 1:
        return pairs[:1]
    finger = pairs[:3]
    return finger if pairs == finger * (size // 3) else pairs


def _ends(end: Bounds, digits: int) -> list[str]:
    parts = end if isinstance(end, tuple) else (end,)
    return [_end(part, digits) for part in parts]


def _end(end: Bound, digits: int) -> str:
    match end:
        case Affine(parent=parent, index=index, scale=scale, offset=offset):
            which = "" if index is None else f"[{index}]"
            factor = "" if scale == 1.0 else f"{scale:g} "
            summand = "" if offset == 0.0 else f"{offset:g} + "
            return f"{summand}{factor}{parent}{which}"
        case Switch(parent=parent, below=below, above=above, at=at):
            return f"({below:g} if {parent} < {at:g} else {above:g})"
    return f"{float(end):.{digits}g}"
