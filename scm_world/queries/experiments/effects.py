"""Effects of experiments, and how large they are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Container
from dataclasses import dataclass, field
from typing import NamedTuple, final

import numpy as np

from scm_world._types import Floats, Value

EdgeKey = tuple[str, str, int]
"""Cause, effect, lag."""

RESOLUTION = 1e-12
"""Smaller differences are rounding, where the noise floor is exactly zero."""

FACTOR = 10.0
"""How many times the noise floor an effect must be."""


class ProbeSetting(NamedTuple):
    """The experiment in which something was seen.

    Attributes:
        probe: Number of the probe state.
        kind: How the probe state came about.
        change: By how much the cause was moved, flattened; empty where a mechanism was evaluated.
    """

    probe: int
    kind: str
    change: Floats = np.zeros(0)


@final
@dataclass
class Effects:
    """The largest effect seen so far of each ordered pair.

    Attributes:
        largest: By cause, effect and lag.
        settings: Where it was seen, if it is not zero.
        violations: By how much, and where, something changed while all its parents were held.
        unstable: By how much a variable differed though nothing had been changed.
        changed: In how many probe states each variable got another value.
        refused: Targets for which no feasible value was found, with how often.
        touched: Bodies that pressed on another one in a probe state.
        rollouts: Control steps simulated in an experiment of their own.
        exact: Whether any difference counts, rounding too, where no edge is declared.
    """

    largest: dict[EdgeKey, float] = field(default_factory=dict)
    settings: dict[EdgeKey, ProbeSetting] = field(default_factory=dict)
    violations: dict[EdgeKey, tuple[float, ProbeSetting]] = field(default_factory=dict)
    unstable: dict[str, float] = field(default_factory=dict)
    changed: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    touched: set[str] = field(default_factory=set)
    rollouts: int = 0
    exact: bool = False

    def see(self, key: EdgeKey, size: float, setting: ProbeSetting | None = None) -> None:
        """Keep an effect if it is the largest of its pair."""
        if size > self.largest.get(key, -1.0):
            self.largest[key] = size
            if setting is not None and size > 0.0:
                self.settings[key] = setting

    def see_unstable(self, name: str, size: float) -> None:
        """Keep a difference that nothing explains if it is the largest of its variable."""
        if size > self.unstable.get(name, 0.0):
            self.unstable[name] = size

    def add(self, other: Effects) -> None:
        """Add what was seen in another probe state."""
        for key, size in other.largest.items():
            self.see(key, size, other.settings.get(key))
        for name, size in other.unstable.items():
            self.see_unstable(name, size)
        self.violations = other.violations | self.violations
        self.changed += other.changed
        self.refused += other.refused
        self.touched |= other.touched
        self.rollouts += other.rollouts

    @property
    def floor(self) -> float:
        """The noise floor: the largest difference between two runs without a change."""
        return max(self.unstable.values(), default=0.0)

    @property
    def threshold(self) -> float:
        """What an effect must exceed, given the floor."""
        return max(FACTOR * self.floor, RESOLUTION)

    def edges(self, declared: Container[EdgeKey]) -> set[EdgeKey]:
        """List the edges that were seen: declared ones beyond rounding, and others."""
        least = FACTOR * self.floor
        return {
            key
            for key, size in self.largest.items()
            if size > (least if self.exact and key not in declared else max(least, RESOLUTION))
        }


def gap(a: Value, b: Value) -> float:
    """Compute the largest difference of two values; NaN counts as infinite."""
    x, y = np.asarray(a), np.asarray(b)
    if (x == y).all():
        return 0.0
    size = float(np.max(np.abs(x.astype(float) - y)))
    return size if size == size else np.inf
