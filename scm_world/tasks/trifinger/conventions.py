"""Conventions of CausalWorld, where they differ from ours."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from scm_world.models.scene import TOLERANCE
from scm_world.tasks.base import Conventions
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.variables import Box, Integers, Space, Variable


@final
@dataclass(frozen=True)
class TriFingerConventions(Conventions):
    """Conventions of the goal families.

    Those of CausalWorld 1.2 differ in this, too:

    - Overlap is that of axis-aligned hulls, not capped.
    - In reaching, the mean tip error itself is added to the reward.
    - Spaces are those of the code instead of those of the paper: bright floors, blocks and goals
      in A, no space for gravity, blocks that begin in the air, ``A|B`` as the hull of A and B,
      and, in picking, cylindrical positions of goals of which the height alone counts.
    - Obstacles count for the length of an episode, like blocks.
    - On Bullet, bodies have the shapes, the damping and the spinning friction of the predecessor;
      everywhere, obstacles have the friction of blocks.

    Attributes:
        tolerance: How deep two bodies may lie in one another after an intervention [m].
        robot_tolerance: The same where one of them is a link of the robot [m].
    """

    tolerance: float = TOLERANCE
    robot_tolerance: float = TOLERANCE

    def adapt(self, variables: Iterable[Variable]) -> Iterable[Variable]:
        """Return the variables with the spaces of these conventions."""
        return map(_as_published, variables) if self.published else variables


CONVENTIONS = {
    "scm_world": TriFingerConventions(),
    "causal_world": TriFingerConventions("causal_world", True, 0.03, 0.0095),
}


def _as_published(variable: Variable) -> Variable:
    """Source: CausalWorld 1.2, ``task_generators/base_task.py``."""
    name, a, b = variable.name, variable.a, variable.b
    if name == "gravity":
        a = b = None
    elif name.endswith("color") and not name.startswith(("robot", "stage")):
        a, b = numbers.COLOR.b, numbers.COLOR.a
    changes: dict[str, Any] = {"a": a, "b": b}
    hull = _hull(variable.shape, a, b)
    if hull is not None:
        changes["a_or_b"] = hull
    if name.startswith("obstacle") and name.endswith(".friction"):
        changes["default"] = 1.0
    return variable.model_copy(update=changes)


def _hull(shape: tuple[int, ...], a: Space | None, b: Space | None) -> Space | None:
    """Return the smallest box around two spaces; None where their corners follow variables."""
    match a, b:
        case Integers(), Integers():
            return Integers(min(a.low, b.low), max(a.high, b.high))
        case Box(), Box() if not a.parents() and not b.parents():
            (low_a, high_a), (low_b, high_b) = a.bounds(shape, {}), b.bounds(shape, {})
            low, high = np.minimum(low_a, low_b).ravel(), np.maximum(high_a, high_b).ravel()
            return Box(tuple(low), tuple(high)) if shape else Box(float(low[0]), float(high[0]))
    return None
