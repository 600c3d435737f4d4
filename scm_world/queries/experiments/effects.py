"""Effects that experiments observe, with their sizes."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Container, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, final

import numpy as np

from scm_world._types import Floats, Value
from scm_world.backends.base import ROUNDING

EdgeKey = tuple[str, str, int]
"""Cause, effect, lag."""

RESOLUTION = ROUNDING
"""Smaller differences, by the values that differ, are rounding, even if the noise floor is zero."""

FACTOR = 10.0
"""Smallest effect as a multiple of the noise floor."""


class ProbeSetting(NamedTuple):
    """The experiment that observed an effect: number and kind of the probe state, and the change.

    The change of the cause is flattened, and empty if a mechanism was evaluated.
    """

    probe: int
    kind: str
    change: Floats = np.zeros(0)


@final
@dataclass
class Effects:
    """The largest observed effect of each ordered pair of variables."""

    largest: dict[EdgeKey, float] = field(default_factory=dict)
    # The same, by the values that differ, or by ``least`` if they are smaller:
    relative: dict[EdgeKey, float] = field(default_factory=dict)
    sizes: dict[EdgeKey, array[float]] = field(default_factory=dict)  # by probe state; no rounding
    settings: dict[EdgeKey, ProbeSetting] = field(default_factory=dict)  # of each effect but zeros
    # Changes of variables whose parents were held, and differences without a change:
    violations: dict[EdgeKey, tuple[float, ProbeSetting]] = field(default_factory=dict)
    unstable: dict[str, float] = field(default_factory=dict)
    # Numbers of probe states in which a variable was changed, and no value of it was feasible:
    changed: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    # Pairs of bodies in contact with a force, in each probe state:
    touching: list[frozenset[tuple[str, str]]] = field(default_factory=list)
    # Numbers of probe states in which unsaturated commands were sought, and found for an action:
    sought: int = 0
    unsaturated: Counter[str] = field(default_factory=Counter)
    rollouts: int = 0  # number of simulated control steps
    # The largest differences that are no effects, but the memory of a solver:
    floors: Mapping[str, float] = field(default_factory=dict)
    least: float = 0.0  # physics in SI units computes with numbers of order one, and rounds them
    # Of each state on an engine that computes with fewer than 64 bits; of all else, RESOLUTION:
    rounding: Mapping[str, float] = field(default_factory=dict)
    exact: bool = False  # whether any difference is an effect if no edge is declared

    def see(
        self, key: EdgeKey, value: Value, base: Value, setting: ProbeSetting | None = None
    ) -> bool:
        """Record the value of an effect with and without a change of its cause.

        Returns:
            Whether the difference is larger than rounding.
        """
        size = gap(value, base)
        share = self.share(size, value, base)
        self._record(key, size, share, setting)
        return share > self.resolution(key[1])

    def resolution(self, effect: str) -> float:
        """Return the largest difference of a variable that is rounding, by its value."""
        return self.rounding.get(effect, RESOLUTION)

    def _record(
        self, key: EdgeKey, size: float, share: float, setting: ProbeSetting | None
    ) -> None:
        if size > self.largest.get(key, -1.0):
            self.largest[key] = size
            if setting is not None and size > 0.0:
                self.settings[key] = setting
        self.relative[key] = max(share, self.relative.get(key, 0.0))

    def share(self, size: float, value: Value, base: Value) -> float:
        """Return the size of a difference by the larger value, which is ``least`` at least."""
        if size == 0.0:
            return 0.0
        largest = max(float(np.abs(end).max()) for end in (value, base))
        return size / max(largest, self.least) if np.isfinite(largest) else 1.0

    def undeclared(self, effect: str, value: Value, base: Value) -> float:
        """Return the size of a difference that has no declared cause; 0 if it is rounding."""
        size = gap(value, base)
        counts = self.exact or self.share(size, value, base) > self.resolution(effect)
        return size if counts and size > self.floors.get(effect, 0.0) else 0.0

    def see_unstable(self, name: str, size: float) -> None:
        """Record an unexplained difference if it is the largest of its variable."""
        if size > self.unstable.get(name, 0.0):
            self.unstable[name] = size

    def add(self, other: Effects) -> None:
        """Add the effects of another probe state."""
        for key, size in other.largest.items():
            share = other.relative[key]
            self._record(key, size, share, other.settings.get(key))
            if share > self.resolution(key[1]):
                self.sizes.setdefault(key, array("d")).append(size)
        for name, size in other.unstable.items():
            self.see_unstable(name, size)
        self.violations = other.violations | self.violations
        self.changed += other.changed
        self.refused += other.refused
        self.touching += other.touching
        self.sought += other.sought
        self.unsaturated += other.unsaturated
        self.rollouts += other.rollouts

    @property
    def floor(self) -> float:
        """The noise floor: the largest difference between two runs without a change."""
        return max(self.unstable.values(), default=0.0)

    def noise(self, effect: str) -> float:
        """Return the largest difference of a variable that is noise."""
        return max(FACTOR * self.unstable.get(effect, 0.0), self.floors.get(effect, 0.0))

    def ratio(self, key: EdgeKey) -> float:
        """Return the largest effect of a pair by the least one beyond rounding and noise."""
        clear, noise = self.relative[key] / self.resolution(key[1]), self.noise(key[1])
        return min(clear, self.largest[key] / noise) if noise else clear

    def edges(self, declared: Container[EdgeKey]) -> set[EdgeKey]:
        """Return the observed edges: those beyond rounding and noise.

        With ``exact``, an edge that is not declared may be as small as rounding.
        """
        return {
            key
            for key, size in self.largest.items()
            if (
                size > self.noise(key[1])
                if self.exact and key not in declared
                else self.ratio(key) > 1.0
            )
        }


def gap(a: Value, b: Value) -> float:
    """Compute the largest difference of two values; NaN counts as infinite."""
    x, y = np.asarray(a), np.asarray(b)
    if (x == y).all():
        return 0.0
    size = float(np.max(np.abs(x.astype(float) - y)))
    return size if size == size else np.inf
