"""How three fingers may take hold of a block."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations, product
from typing import final

import numpy as np

from scm_world._types import Floats
from scm_world.tasks.trifinger.grasping.bodies import Body
from scm_world.tasks.trifinger.grasping.hand import TIP_RADIUS

LEVELS = (0.15, 0.4, 0.0)
"""How high the fingertips are above the middle of a block, in halves of its height."""

SPREADS = (0.55, 0.3)
"""How far from the middle of a face its two fingertips are, in halves of its width."""

OPENINGS = (0.025, 0.014)  # [m] between fingertip and face, open
NARROWEST = 0.013  # [m] of a spread: fingers have room beside one another
EDGE = 0.006  # [m] that fingertips keep away from edges

_Point = tuple[float, float, float]


@final
@dataclass(frozen=True)
class Grip:
    """Where fingertips touch a block, in its own frame.

    Attributes:
        touch: Centers of the fingertips as they touch, shape (3, 3) [m].
        inward: In which direction they press, each force as a share of the grip's, shape (3, 3).
        used: Which fingers take part.
        opening: How far from there they are while open [m].
    """

    touch: Floats
    inward: Floats
    used: tuple[bool, bool, bool]
    opening: float

    @property
    def firm(self) -> bool:
        """Whether all fingers take part, so that the block cannot swing."""
        return all(self.used)

    def points(self, opening: float) -> Floats:
        """Give the fingertips at a distance from the faces, shape (3, 3) [m]."""
        points: Floats = self.touch - opening * np.sign(self.inward)
        return points


def grips(block: Body) -> Iterator[Grip]:
    """List the ways to hold a block: one finger against two, or against one."""
    for axis, level, opening in product((0, 1), LEVELS, OPENINGS):
        out, along = block.half[axis] + TIP_RADIUS, block.half[1 - axis]
        z = min(level * block.half[2], block.half[2] - TIP_RADIUS)
        for side, spread in product((out, -out), SPREADS):
            wide = min(max(spread * along, NARROWEST), along - EDGE)
            three = ((side, 0.0, z), (-side, wide, z), (-side, -wide, z))
            yield from _orders(axis, three, (1.0, 0.5, 0.5), opening)
        two = ((out, 0.0, z), (-out, 0.0, z), (0.0, 0.0, z))
        yield from _orders(axis, two, (1.0, 1.0, 0.0), opening)


def _orders(
    axis: int, places: Sequence[_Point], shares: Sequence[float], opening: float
) -> Iterator[Grip]:
    """List in which way three fingers can be at three places.

    Args:
        axis: Across which the block is pressed.
        places: Across it, along the face, and upwards [m].
        shares: Of the force.
        opening: See ``Grip``.
    """
    for order in permutations(range(3)):
        touch, inward = np.empty((3, 3)), np.zeros((3, 3))
        for finger, (across, along, up), share in zip(order, places, shares, strict=True):
            touch[finger] = (across, along, up) if axis == 0 else (along, across, up)
            inward[finger, axis] = -np.sign(across) * share
        one, two, three = (bool(row.any()) for row in inward)
        yield Grip(touch, inward, (one, two, three), opening)
