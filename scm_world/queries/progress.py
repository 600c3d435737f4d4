"""Progress of long computations."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int], None]
"""Called after each item of work with the numbers of finished and planned items.

An error that it raises ends the work and propagates to the caller, who can so stop a long job.
"""


Tell = Callable[[str], None]
"""Called with a sentence about each event."""


def part(progress: Progress | None, before: int, total: int) -> Progress | None:
    """Return a callback that reports progress after ``before`` items as that of ``total`` items."""
    return None if progress is None else lambda done, _: progress(before + done, total)
