"""The ranges that actions are drawn from."""

from __future__ import annotations

import numpy as np

from scm_world._types import Floats
from scm_world.queries.equations import System


def action_range(world: System) -> tuple[Floats, Floats]:
    """Give the lower and upper end of all actions, shape (n_actions,) each.

    An action without an end is drawn from [-1, 1], or as far beyond the end that it has.
    """
    low, high = world.action_low, world.action_high
    low = np.where(np.isfinite(low), low, np.minimum(-1.0, high - 2.0))
    high = np.where(np.isfinite(high), high, np.maximum(1.0, low + 2.0))
    return low, high
