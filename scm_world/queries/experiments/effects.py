"""Effects that experiments observe, with their sizes."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Container, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, final

import numpy as np

from scm_world._types import Floats, Value

EdgeKey = tuple[str, str, int]
"""Cause, effect, lag."""

RESOLUTION = 1e-12
"""Smaller differences are rounding, even if the noise floor is zero."""

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
    sizes: dict[EdgeKey, array[float]] = field(default_factory=dict)  # by probe state, without 0
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
    # The largest differences that are no effects, even without noise floor; 0 if any is one:
    rounding: Mapping[str, float] = field(default_factory=dict)

    def see(self, key: EdgeKey, size: float, setting: ProbeSetting | None = None) -> None:
        """Record an effect if it is the largest of its pair."""
        if size > self.largest.get(key, -1.0):
            self.largest[key] = size
            if setting is not None and size > 0.0:
                self.settings[key] = setting

    def see_unstable(self, name: str, size: float) -> None:
        """Record an unexplained difference if it is the largest of its variable."""
        if size > self.unstable.get(name, 0.0):
            self.unstable[name] = size

    def add(self, other: Effects) -> None:
        """Add the effects of another probe state."""
        for key, size in other.largest.items():
            self.see(key, size, other.settings.get(key))
            if size > 0.0:
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

    def threshold(self, effect: str, *, declared: bool = True) -> float:
        """Smallest size of an effect on a variable, given the noise floor."""
        rounding = self.rounding.get(effect, RESOLUTION)
        return max(FACTOR * self.floor, rounding, RESOLUTION * declared)

    def edges(self, declared: Container[EdgeKey]) -> set[EdgeKey]:
        """Return the observed edges: declared ones beyond rounding, and others."""
        return {
            key
            for key, size in self.largest.items()
            if size > self.threshold(key[1], declared=key in declared)
        }


def gap(a: Value, b: Value) -> float:
    """Compute the largest difference of two values; NaN counts as infinite."""
    x, y = np.asarray(a), np.asarray(b)
    if (x == y).all():
        return 0.0
    size = float(np.max(np.abs(x.astype(float) - y)))
    return size if size == size else np.inf
