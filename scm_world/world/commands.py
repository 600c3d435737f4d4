"""From what a policy asks for to an action."""

from __future__ import annotations

import numpy as np

from scm_world._types import ArrayLike, Floats
from scm_world.errors import ActionError
from scm_world.geometry.clipping import clip_kernel


def clipped(action: ArrayLike, low: Floats, high: Floats, unit: str) -> Floats:
    """Clip an action to its range, shape (n,).

    Raises:
        ActionError: It is not n finite numbers.
    """
    try:
        given = np.ascontiguousarray(action, dtype=np.float64)
    except (TypeError, ValueError):  # text, or a ragged list
        given = np.full(low.size + 1, np.nan)
    command = np.empty(low.shape)
    if given.shape != low.shape or not clip_kernel(given, low, high, command):
        numbers = "a finite number" if low.size == 1 else f"{low.size} finite numbers"
        raise ActionError(f"an action is {numbers} [{unit}], got {action!r}", action)
    return command
