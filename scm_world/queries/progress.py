"""Telling how far something is."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int], None]
"""Called after each piece of work with how many are done, and how many there will be."""


def part(progress: Progress | None, before: int, total: int) -> Progress | None:
    """Tell of a part of some work as of the whole.

    Args:
        progress: Called for the whole; nothing is called if None.
        before: Pieces of the whole that come before the part.
        total: Pieces of the whole.
    """
    return None if progress is None else lambda done, _: progress(before + done, total)
