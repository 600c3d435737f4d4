"""Clocks, and sides that take turns."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

Rows = dict[str, list[float]]
"""What each side took in each round."""

MICRO, MILLI = 1e6, 1e3


@dataclass(frozen=True)
class Settings:
    """How long to measure, and what else there is on this machine.

    Attributes:
        quick: Whether to do everything in a minute; its figures are worth little.
        predecessor: An interpreter that has CausalWorld, or None.
        sb3: An interpreter that has Stable-Baselines3, or None.
        cores: The cores that this process may use when it is not pinned.
    """

    quick: bool = False
    predecessor: str | None = None
    sb3: str | None = None
    cores: frozenset[int] = frozenset(range(os.cpu_count() or 1))

    def rounds(self, number: int) -> int:
        """Give the number of rounds: two if it must be quick."""
        return 2 if self.quick else number

    def steps(self, number: int) -> int:
        """Give the number of steps: a tenth if it must be quick."""
        return max(5, number // 10) if self.quick else number


def busy(function: Callable[[Any], Any], given: Iterable[Any]) -> float:
    """Call a function with one thing after another; give the time of the processor [s]."""
    started = time.process_time()
    for one in given:
        function(one)
    return time.process_time() - started


def micros(function: Callable[[], Any]) -> float:
    """Time one call by the clock on the wall [µs]; that of the processor has no finer steps."""
    started = time.perf_counter()
    function()
    return (time.perf_counter() - started) * MICRO


def in_turns(sides: Mapping[str, Callable[[], float]], rounds: int) -> Rows:
    """Let every side measure once in each round, after one round that does not count."""
    for measure in sides.values():
        measure()
    rows: Rows = {name: [] for name in sides}
    for _ in range(rounds):
        for name, measure in sides.items():
            rows[name].append(measure())
    return rows


def medians(rows: Rows) -> dict[str, float]:
    """Give the median of every side."""
    return {name: statistics.median(row) for name, row in rows.items()}


def ratio(rows: Rows, of: str, to: str) -> float:
    """Give the median over rounds of how many times longer one side takes than another."""
    return statistics.median(a / b for a, b in zip(rows[of], rows[to], strict=True))


@contextmanager
def on(cores: Iterable[int]) -> Iterator[None]:
    """Run on these cores; threads and processes that are started meanwhile do as well."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, set(cores))
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
