"""How three fingers may take hold of a block, and which way to bring it somewhere is best."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations, product
from typing import final

import numpy as np

from scm_world._types import Floats
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.grasping.bodies import Cuboid, solids, turn_about_z
from scm_world.tasks.trifinger.grasping.hand import TIP_RADIUS, Hand, deepest_kernel

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


def grips(block: Cuboid) -> Iterator[Grip]:
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


Way = tuple[Cuboid, float]
"""Where a block shall be, and by how much it is turned on the way [rad]."""

CROWDED = 0.003  # [m] that blocks may lie in one another at the end, as stacked ones do
CLEAR = 0.003  # [m] that fingers stay away from other things
OPEN = 0.004  # [m] that open fingers stay away from the block
TOUCH = 0.0015  # [m] that a leg may be deeper in the block than its fingertip
CLEARANCE = 0.012  # [m] of a block that is carried, below and on all sides
UPRIGHT = 0.004  # [m] that a block may go sideways without being carried over something
OVER = 0.025  # [m] that fingertips pass above things
LOWEST = 0.09  # [m] of fingertips that travel
SAMPLES = 9
"""Places on a way that are looked at."""

FIRMNESS = 0.5
TURNING = 0.3  # [1/rad]
TIGHT = 0.1
REACHING = 0.5  # [1/m]
MEETING = 0.3
PLENTY = 0.05
"""What makes a way better or worse. A force that is just enough is worth 1."""


@final
@dataclass(frozen=True)
class Move:
    """A way to bring a block somewhere.

    Attributes:
        grip: How it is held.
        start: Where it is.
        end: Where it shall be.
        turn: By how much it is turned on the way [rad].
        height: Of its center as it is carried [m].
        above: Of the fingertips on their way to it, and away [m].
        strength: With which it can be pressed everywhere on the way [N].
        worth: How good the way is; more is better.
        release: Whether it is let go at the end.
    """

    grip: Grip
    start: Cuboid
    end: Cuboid
    turn: float
    height: float
    above: float
    strength: float
    worth: float
    release: bool


@final
class Planner:
    """Looks for the best way to bring a block somewhere.

    Args:
        hand: The robot.
        joints: Where it is, shape (9,) [rad].
        others: Everything else that stands in the world.
    """

    def __init__(self, hand: Hand, joints: Floats, others: Iterable[Cuboid]) -> None:
        self._hand, self._joints = hand, joints
        self._others = tuple(others)
        self._boxes = solids(self._others, CLEAR)
        self._aside = hand.tips(np.array(hardware.ASIDE)).reshape(3, 3)

    def best(
        self, start: Cuboid, ends: Iterable[Way], *, wanted: float, release: bool
    ) -> Move | None:
        """Find the best way to bring a block to one of some places.

        Args:
            start: The block as it is.
            ends: Where it may go, and by how much it turns on the way [rad].
            wanted: With which force it should be pressed [N].
            release: Whether it is let go there.

        Returns:
            The best way, or None if the fingers can go none.
        """
        ways = [
            (end, turn, self._height(start, end))
            for end, turn in ends
            if all(end.depth_in(other) < CROWDED for other in self._others)
        ]
        best: Move | None = None
        for grip in grips(start) if ways else ():
            over = self._above(start)  # how it is taken hold of: with which force, how easily
            opens = self._opens(grip, start, over)
            strength = self._strength(grip, start) if opens else 0.0
            ease = FIRMNESS * grip.firm - TIGHT * (grip.opening < max(OPENINGS))
            ease += self._transit(grip, start, over) if opens else 0.0
            for end, turn, height in ways if strength > 0.0 else ():
                above = self._above(start, *[end] * release)
                worth = ease - TURNING * abs(turn) + 1.0 + 3.0 * PLENTY
                move = Move(grip, start, end, turn, height, above, strength, worth, release)
                if best is None or worth > best.worth:
                    move = self._judged(move, wanted)
                    if move.strength > 0.0 and (best is None or move.worth > best.worth):
                        best = move
        return best

    def place(self, grip: Grip, body: Cuboid, opening: float, above: float | None = None) -> Floats:
        """Place the fingertips about a block.

        Args:
            grip: How it is held.
            body: Where it is.
            opening: How far from its faces the fingertips are [m].
            above: Their height, if they are not yet beside it [m].

        Returns:
            Shape (9,) [m]; unused fingers are out of the way.
        """
        tips = body.world(grip.points(opening))
        if above is not None:
            tips[:, 2] = above
        idle = ~np.array(grip.used)
        tips[idle] = self._aside[idle]
        return tips.ravel()

    # --- heights ------------------------------------------------------------------------------

    def _height(self, start: Cuboid, end: Cuboid) -> float:
        """Find how high a block must be carried to pass over what stands in its way [m]."""
        height = max(float(start.place[2]) + CLEARANCE, float(end.place[2]))
        if math.dist(start.place[:2], end.place[:2]) < UPRIGHT:
            return height
        for share in np.linspace(0.0, 1.0, SAMPLES):
            on = start.at(start.place + share * (end.place - start.place), start.yaw)
            for other in self._others:
                if on.depth_in(other, margin=CLEARANCE, flat=True) > 0.0:
                    height = max(height, other.top + float(start.half[2]) + CLEARANCE)
        return height

    def _above(self, *blocks: Cuboid) -> float:
        """Find a height at which fingertips pass over everything [m]."""
        return max(LOWEST, *(body.top + OVER for body in (*self._others, *blocks)))

    # --- judging ------------------------------------------------------------------------------

    def _judged(self, move: Move, wanted: float) -> Move:
        """Judge a way as a whole; its strength is 0 if the fingers cannot go it."""
        grip, start, height = move.grip, move.start, move.height
        on = start.at(move.end.place, start.yaw + move.turn)
        opens = not move.release or self._opens(grip, on, self._above(start, on))
        strength = min(move.strength, self._strength(grip, on)) if opens else 0.0
        first, last = (np.array([*body.place[:2], height]) for body in (start, on))
        for share in (1.0, 0.5, 0.0):
            if strength > 0.0:
                over = start.at(first + share * (last - first), start.yaw + share * move.turn)
                strength = min(strength, self._strength(grip, over))
        enough = min(strength / wanted, 1.0) + PLENTY * min(strength / wanted, 3.0)
        worth = move.worth - 1.0 - 3.0 * PLENTY + enough
        return Move(
            grip, start, move.end, move.turn, height, move.above, strength, worth, move.release
        )

    def _strength(self, grip: Grip, body: Cuboid) -> float:
        """Find with which force a grip can hold a block somewhere [N]; 0 if it cannot."""
        joints, reached = self._hand.solve(self.place(grip, body, 0.0), self._joints)
        if not reached or self._depth(joints, body, -TOUCH) > 0.0:
            return 0.0
        return self._hand.strength(joints, grip.inward @ turn_about_z(body.yaw).T)

    def _opens(self, grip: Grip, body: Cuboid, above: float) -> bool:
        """Tell whether open fingers can be about a block, and above it."""
        tips = self.place(grip, body, grip.opening)
        joints, reached = self._hand.solve(tips, self._joints)
        if not reached or self._depth(joints, body, OPEN) > 0.0:
            return False
        over, reached = self._hand.solve(self.place(grip, body, grip.opening, above), joints)
        return reached and self._depth(over) <= 0.0

    def _transit(self, grip: Grip, body: Cuboid, above: float) -> float:
        """Judge the way to the block: fingers should not meet; the shorter, the better."""
        first = self._hand.tips(self._joints)
        first[2::3] = np.maximum(first[2::3], above)
        last = self.place(grip, body, grip.opening, above)
        worth = -REACHING * float(np.abs(last - first).max())
        for share in (0.3, 0.6, 0.9):
            joints, _ = self._hand.solve((1.0 - share) * first + share * last, self._joints)
            worth -= MEETING * (self._depth(joints) > 0.0)
        return worth

    def _depth(self, joints: Floats, block: Cuboid | None = None, margin: float = 0.0) -> float:
        """Measure how deep fingers lie in one another and in things [m]."""
        boxes = self._boxes
        if block is not None:
            half, place, axes = solids([block], margin)
            boxes = (
                np.concatenate([boxes[0], half]),
                np.concatenate([boxes[1], place]),
                np.concatenate([boxes[2], axes]),
            )
        return float(deepest_kernel(joints, self._hand.height, *boxes))
