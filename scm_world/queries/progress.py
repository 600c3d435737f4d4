"""Telling how far something is."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int], None]
"""Called after each piece of work with how many are done, and how many there will be.

An error that it raises ends the work and reaches the caller as it is: so a caller stops a long job.
"""


Tell = Callable[[str], None]
"""Called with a sentence about each event."""


def clock(seconds: float) -> str:
    """Write a duration.

    Example:
        >>> clock(75.4), clock(7384.0)
        ('1:15', '2:03:04')
    """
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def part(progress: Progress | None, before: int, total: int) -> Progress | None:
    """Tell of a part of some work as of the whole.

    Args:
        progress: Called for the whole; nothing is called if None.
        before: Pieces of the whole that come before the part.
        total: Pieces of the whole.
    """
    return None if progress is None else lambda done, _: progress(before + done, total)
