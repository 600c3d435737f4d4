"""How three fingers may hold a block, and how it is then brought somewhere."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from itertools import permutations, product
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._types import ArrayLike, Floats
from scm_world.tasks.trifinger.grasping.bodies import Cuboid, Sight
from scm_world.tasks.trifinger.grasping.hand import TIP_RADIUS

LEVELS = (0.15, 0.4, 0.0)  # of fingertips above the middle of a block, in halves of its height
SPREADS = (0.55, 0.3)  # of two fingertips from the middle of a face, in halves of its width
OPENINGS = (0.025, 0.014)  # [m] between fingertip and face, open
NARROWEST = 0.013  # [m] of a spread: fingers have room beside one another
EDGE = 0.006  # [m] that fingertips keep away from edges
CLEARANCE = 0.012  # [m] of a block that is carried, below and on all sides
SAMPLES = 9  # places on a way that are looked at


@final
@dataclass(frozen=True)
class Grip:
    """Where fingertips touch a block, in its own frame; or n such grips, with a leading axis."""

    touch: Floats  # [m] centers of the fingertips as they touch, shape (3, 3)
    inward: Floats  # where they press, each force as a share of the grip's, shape (3, 3)
    used: NDArray[np.bool_]  # which fingers take part, shape (3,)
    opening: Floats  # [m] how far from there they are while open, shape ()

    @property
    def firm(self) -> Any:
        """Whether all fingers take part, so that the block cannot swing."""
        return self.used.all(axis=-1)

    def only(self, rows: Any) -> Grip:
        """Return some of n grips, by a mask or by their numbers."""
        return Grip(self.touch[rows], self.inward[rows], self.used[rows], self.opening[rows])

    def place(self, sight: Sight, body: Cuboid, opening: ArrayLike) -> Floats:
        """Place the fingertips so far from a block's faces [m]; unused ones are out of the way."""
        points = self.touch - np.reshape(opening, (-1, 1, 1)) * np.sign(self.inward)
        tips = np.where(self.used[..., None], body.world(points), sight.aside)
        return tips.reshape(self.touch.shape)


@final
@dataclass(frozen=True)
class Move:
    """A way to bring a block somewhere."""

    grip: Grip
    end: Cuboid  # where it shall be
    height: float  # [m] of its center as it is carried
    above: float  # [m] of the fingertips on their way to it, and away
    strength: float  # [N] with which it can be pressed everywhere on the way
    over: bool  # whether it goes higher than its goal, over something that is in the way
    release: bool  # whether it is let go at the end


@lru_cache(maxsize=64)
def gripped(x: float, y: float, z: float) -> Grip:
    """List the ways to hold a block with these half edges [m]: one finger against two, or one."""
    touches, inwards, openings = list[Floats](), list[Floats](), list[float]()
    for axis, level, opening in product((0, 1), LEVELS, OPENINGS):
        out, along = ((x, y), (y, x))[axis]
        out, up = out + TIP_RADIUS, min(level * z, z - TIP_RADIUS)
        places = []
        for side, spread in product((out, -out), SPREADS):
            wide = min(max(spread * along, NARROWEST), along - EDGE)
            three = ((side, 0.0, up), (-side, wide, up), (-side, -wide, up))
            places.append((three, (1.0, 0.5, 0.5)))
        places.append((((out, 0.0, up), (-out, 0.0, up), (0.0, 0.0, up)), (1.0, 1.0, 0.0)))
        for (three, shares), fingers in product(places, permutations(range(3))):
            touch, inward = np.empty((3, 3)), np.zeros((3, 3))
            touch[list(fingers)] = np.array(three)[:, [axis, 1 - axis, 2]]
            inward[list(fingers), axis] = -np.sign(np.array(three)[:, 0]) * shares
            touches.append(touch)
            inwards.append(inward)
            openings.append(opening)
    used = np.any(np.array(inwards) != 0.0, axis=2)
    return Grip(np.array(touches), np.array(inwards), used, np.array(openings))


def passing(body: Cuboid, steps: Floats, others: Iterable[Cuboid]) -> float:
    """Compute how high a block must be to pass over others [m], after steps (n, 3) [m]; 0: any."""
    height, others = 0.0, tuple(others)
    for step in steps:
        on = body.at(body.place + step, body.yaw)
        for other in others:
            if on.depth_in(other, margin=CLEARANCE, flat=True) > 0.0:
                height = max(height, other.top + float(body.half[2]) + CLEARANCE)
    return height
