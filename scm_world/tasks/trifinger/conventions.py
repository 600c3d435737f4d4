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

OBSTACLE_FRICTION = 1.0


@final
@dataclass(frozen=True)
class TriFingerConventions(Conventions):
    """Conventions of the goal families.

    Attributes:
        aligned_boxes: Overlap of axis-aligned hulls, not capped, instead of the exact one.
        distance_as_reward: In reaching, the mean tip error itself is added to the reward.
        published_spaces: The spaces of the code instead of those of the paper: bright floors,
            blocks and goals in A, no space for gravity, blocks that begin in the air,
            ``A|B`` as the hull of A and B, and, in picking, cylindrical positions of goals of
            which the height alone counts.
        static_counts: Obstacles count for the length of an episode, like blocks.
        published_physics: On Bullet, the shapes, the damping and the spinning friction of the
            predecessor; everywhere, obstacles with the friction of blocks.
        tolerance: How deep two bodies may lie in one another after an intervention [m].
        robot_tolerance: The same where one of them is a link of the robot [m].
    """

    aligned_boxes: bool = False
    distance_as_reward: bool = False
    published_spaces: bool = False
    static_counts: bool = False
    published_physics: bool = False
    tolerance: float = TOLERANCE
    robot_tolerance: float = TOLERANCE

    def adapt(self, variables: Iterable[Variable]) -> Iterable[Variable]:
        """Return the variables with the spaces of these conventions."""
        for variable in variables:
            yield _as_published(variable) if self.published_spaces else variable


CONVENTIONS = {
    "scm_world": TriFingerConventions(),
    "causal_world": TriFingerConventions(
        *("causal_world", True, True, True, True, True, True, True, True),
        tolerance=0.03,
        robot_tolerance=0.0095,
    ),
}


def _as_published(variable: Variable) -> Variable:
    """Source: CausalWorld 1.2, ``task_generators/base_task.py``."""
    changes: dict[str, Any] = {}
    a, b = variable.a, variable.b
    if variable.name == "gravity":
        a = b = None
    elif variable.name.endswith("color") and not variable.name.startswith(("robot", "stage")):
        a, b = numbers.COLOR.b, numbers.COLOR.a
    if a is not variable.a or b is not variable.b:
        changes = {"a": a, "b": b}
    hull = _hull(variable.shape, a, b)
    if hull is not None:
        changes["a_or_b"] = hull
    if variable.name.startswith("obstacle") and variable.name.endswith(".friction"):
        changes["default"] = OBSTACLE_FRICTION
    return variable.model_copy(update=changes) if changes else variable


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
