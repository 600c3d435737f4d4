"""Telling how far something is."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int], None]
"""Told after each piece of work how many are done, and how many there will be."""


def part(progress: Progress | None, before: int, total: int) -> Progress | None:
    """Tell of a part of some work as of the whole.

    Args:
        progress: Is told of the whole; nobody if None.
        before: Pieces of the whole that come before the part.
        total: Pieces of the whole.
    """
    return None if progress is None else lambda done, _: progress(before + done, total)
