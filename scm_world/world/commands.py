"""From what a policy asks for to what the engine is told."""

from __future__ import annotations

import numpy as np

from scm_world._types import ArrayLike, Floats
from scm_world.errors import ActionError
from scm_world.graph import Moment
from scm_world.scene.kinematics import clip_kernel
from scm_world.variables import Normal

STREAM = "actuators"
"""The stream of the noise; draws of the variable that scales it have another one."""


def clipped(action: ArrayLike, low: Floats, high: Floats, unit: str) -> Floats:
    """Clip an action to its range, shape (9,).

    Raises:
        ActionError: It is not nine finite numbers.
    """
    try:
        given = np.ascontiguousarray(action, dtype=np.float64)
    except (TypeError, ValueError):  # text, or a ragged list
        given = np.empty(0)
    command = np.empty(9)
    if given.shape != (9,) or not clip_kernel(given, low, high, command):
        raise ActionError(f"an action is 9 finite numbers [{unit}], got {action!r}", action)
    return command


def disturbed(command: Floats, low: Floats, high: Floats, noise: float, moment: Moment) -> Floats:
    """Add the noise of the actuators to a command.

    Args:
        command: Shape (9,).
        low: Lower end of an action, shape (9,).
        high: Upper end.
        noise: Standard deviation as a fraction of half the range.
        moment: Where to draw.
    """
    drawn = moment.draw(Normal(), STREAM, (9,), {})
    return command + noise * (high - low) / 2.0 * drawn
