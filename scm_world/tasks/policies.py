"""Policies that do not look at what happens."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from scm_world._types import Floats


class Blind(ABC):
    """A policy that does not look at what happens: all its actions are known beforehand."""

    @abstractmethod
    def ahead(self, world: Any, first: int, count: int) -> Floats:
        """Give the actions of some control steps.

        Args:
            world: As it is now. A policy asked for the first time may look at it.
            first: The first control step.
            count: How many.

        Returns:
            Shape (count, n_actions).
        """

    def __call__(self, world: Any) -> Floats:
        """Give the action of the present step."""
        action: Floats = self.ahead(world, world.index, 1)[0]
        return action


def kept_rows(actions: Floats, first: int, count: int) -> Floats:
    """Take rows of actions; after the last one it is kept."""
    found: Floats = actions[np.minimum(np.arange(first, first + count), len(actions) - 1)]
    return found


def action_range(world: Any) -> tuple[Floats, Floats]:
    """Return the lower and upper end of all actions, shape (n_actions,) each.

    An action without an end is drawn from [-1, 1], or as far beyond the end that it has.
    """
    low, high = world.action_low, world.action_high
    low = np.where(np.isfinite(low), low, np.minimum(-1.0, high - 2.0))
    high = np.where(np.isfinite(high), high, np.maximum(1.0, low + 2.0))
    return low, high
