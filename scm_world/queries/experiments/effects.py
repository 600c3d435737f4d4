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
    """The largest observed effect of each ordered pair of variables.

    Attributes:
        largest: Largest effect by cause, effect and lag.
        sizes: The largest effect in each probe state, without zeros.
        settings: Experiment of each effect that is not zero.
        violations: Size and experiment of changes of variables whose parents were held.
        unstable: Differences of variables without a change.
        changed: Number of probe states in which each variable was changed.
        refused: Number of probe states in which no value of a target was feasible.
        touching: Pairs of bodies in contact with a force, in each probe state.
        sought: Number of probe states in which unsaturated commands were sought.
        unsaturated: Number of these in which there was one, for each action.
        rollouts: Number of simulated control steps.
        rounding: The largest difference of a variable that is not an effect, even if the noise
            floor is zero; 0 if any difference without a declared edge is one.
    """

    largest: dict[EdgeKey, float] = field(default_factory=dict)
    sizes: dict[EdgeKey, array[float]] = field(default_factory=dict)
    settings: dict[EdgeKey, ProbeSetting] = field(default_factory=dict)
    violations: dict[EdgeKey, tuple[float, ProbeSetting]] = field(default_factory=dict)
    unstable: dict[str, float] = field(default_factory=dict)
    changed: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    touching: list[frozenset[tuple[str, str]]] = field(default_factory=list)
    sought: int = 0
    unsaturated: Counter[str] = field(default_factory=Counter)
    rollouts: int = 0
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
