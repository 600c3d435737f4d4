"""A clock of the processor for the parts of something, that takes itself into account."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Callable
from typing import Any, final

CALLS = 50_000  # of an empty function, to learn what the clock itself costs
OUTSIDE = ""


@final
class Stopwatch:
    """Adds up the time that functions take for themselves, without those that they call.

    Looking at the clock takes time as well, some of it within a call and some in its caller: both
    are measured with an empty function, and taken off.
    """

    def __init__(self) -> None:
        self._within, self._around = 0.0, 0.0
        self.clear()
        self._within, self._around = self._cost()

    def clear(self) -> None:
        """Forget what was measured."""
        self._total: defaultdict[str, float] = defaultdict(float)
        self._calls: Counter[str] = Counter()
        self._made: Counter[str] = Counter()  # how many timed calls each part makes
        self._frames: list[list[Any]] = [[OUTSIDE, 0.0, 0]]

    def timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Give a function that does the same, and is timed as a part."""
        clock = time.process_time

        def call(*args: Any, **kwargs: Any) -> Any:
            frame: list[Any] = [part, 0.0, 0]
            self._frames.append(frame)
            started = clock()
            found = function(*args, **kwargs)
            spent = clock() - started
            self._frames.pop()
            self._total[part] += spent - frame[1]
            self._calls[part] += 1
            self._made[part] += frame[2]
            caller = self._frames[-1]
            caller[1] += spent
            caller[2] += 1
            return found

        return call

    def spent(self) -> dict[str, float]:
        """Give the time of each part [s]."""
        return {
            part: total - self._within * self._calls[part] - self._around * self._made[part]
            for part, total in self._total.items()
        }

    def _cost(self) -> tuple[float, float]:
        """Measure what timing adds to a call, and to its caller [s]."""

        def empty() -> None:
            pass

        watched = self.timed("empty", empty)

        def loop(function: Callable[[], None]) -> None:
            for _ in range(CALLS):
                function()

        self.timed("plain", loop)(empty)
        self.timed("watched", loop)(watched)
        within = self._total["empty"] / CALLS
        around = (self._total["watched"] - self._total["plain"]) / CALLS
        self.clear()
        return within, around
