"""Effects of experiments, and how large they are."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import final

import numpy as np

from scm_world._types import Value
from scm_world.discovery.scores import EdgeKey


@final
@dataclass
class Effects:
    """The largest effect seen so far on each ordered pair.

    Attributes:
        largest: By cause, effect and lag.
        floor: Largest difference after something was done and undone.
        rollouts: Control steps simulated in an experiment of their own.
        refused: Targets for which no feasible value was found, with how often.
    """

    largest: dict[EdgeKey, float] = field(default_factory=dict)
    floor: float = 0.0
    rollouts: int = 0
    refused: dict[str, int] = field(default_factory=dict)

    def see(self, cause: str, effect: str, lag: int, size: float) -> None:
        """Remember an effect if it is the largest of its pair."""
        key = (cause, effect, lag)
        self.largest[key] = max(size, self.largest.get(key, 0.0))

    def found(self, threshold: float) -> set[EdgeKey]:
        """List the pairs whose effect exceeds a threshold."""
        return {key for key, size in self.largest.items() if size > threshold}


def gap(a: Value, b: Value) -> float:
    """Compute the largest difference of two values; NaN counts as infinite."""
    size = float(np.max(np.abs(np.asarray(a, dtype=float) - np.asarray(b, dtype=float))))
    return size if size == size else np.inf
