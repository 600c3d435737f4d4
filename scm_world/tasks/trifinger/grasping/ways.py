"""How three fingers may take hold of a block, and which way to bring it somewhere is best."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from itertools import permutations, product
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._types import ArrayLike, Floats
from scm_world.tasks.trifinger.grasping.bodies import Cuboid, turn_about_z
from scm_world.tasks.trifinger.grasping.hand import TIP_RADIUS, Hand, poses

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
    """Where fingertips touch a block, in its own frame; or n such grips, with a leading axis.

    Attributes:
        touch: Centers of the fingertips as they touch, shape (3, 3) [m].
        inward: In which direction they press, each force as a share of the grip's, shape (3, 3).
        used: Which fingers take part, shape (3,).
        opening: How far from there they are while open, shape () [m].
    """

    touch: Floats
    inward: Floats
    used: NDArray[np.bool_]
    opening: Floats

    @property
    def firm(self) -> Any:
        """Whether all fingers take part, so that the block cannot swing."""
        return self.used.all(axis=-1)

    def only(self, rows: Any) -> Grip:
        """Return some of n grips, by a mask or by their numbers."""
        return Grip(self.touch[rows], self.inward[rows], self.used[rows], self.opening[rows])

    def place(self, hand: Hand, body: Cuboid, opening: ArrayLike) -> Floats:
        """Place the fingertips about a block, shape (3, 3) [m]; unused ones are out of the way.

        Args:
            hand: The robot.
            body: The block.
            opening: How far from its faces the fingertips are, shape () [m].
        """
        points = self.touch - np.reshape(opening, (-1, 1, 1)) * np.sign(self.inward)
        tips = np.where(self.used[..., None], body.world(points), hand.aside)
        return tips.reshape(self.touch.shape)


@lru_cache(maxsize=64)
def gripped(x: float, y: float, z: float) -> Grip:
    """List the ways to hold a block with these half edges [m]: one finger against two, or one."""
    half, found = (x, y, z), list[tuple[Floats, Floats, float]]()
    for axis, level, opening in product((0, 1), LEVELS, OPENINGS):
        out, along = half[axis] + TIP_RADIUS, half[1 - axis]
        up = min(level * z, z - TIP_RADIUS)
        places: list[tuple[tuple[_Point, _Point, _Point], _Point]] = []
        for side, spread in product((out, -out), SPREADS):
            wide = min(max(spread * along, NARROWEST), along - EDGE)
            three = ((side, 0.0, up), (-side, wide, up), (-side, -wide, up))
            places.append((three, (1.0, 0.5, 0.5)))
        two = ((out, 0.0, up), (-out, 0.0, up), (0.0, 0.0, up))
        places.append((two, (1.0, 1.0, 0.0)))
        for (three, shares), order in product(places, permutations(range(3))):
            touch, inward = np.empty((3, 3)), np.zeros((3, 3))
            touch[list(order)] = [p if axis == 0 else (p[1], p[0], p[2]) for p in three]
            inward[list(order), axis] = [
                -np.sign(p[0]) * share for p, share in zip(three, shares, strict=True)
            ]
            found.append((touch, inward, opening))
    touches, presses, openings = zip(*found, strict=True)
    inwards: Floats = np.array(presses)
    used: NDArray[np.bool_] = np.any(inwards != 0.0, axis=2)
    return Grip(np.array(touches), inwards, used, np.array(openings))


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
        release: Whether it is let go at the end.
    """

    grip: Grip
    start: Cuboid
    end: Cuboid
    turn: float
    height: float
    above: float
    strength: float
    release: bool

    @property
    def over(self) -> bool:
        """Whether the block goes higher than its goal, over something that is in the way."""
        return self.height > max(float(self.end.place[2]), float(self.start.place[2]) + CLEARANCE)


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

    def best(
        self,
        start: Cuboid,
        ends: Iterable[Way],
        *,
        wanted: float,
        release: bool,
    ) -> Move | None:
        """Find the best way to bring a block to one of some places.

        Two fingers rather than three lift it from the floor: each of the two on one side of three
        presses half as much, and slips sooner.

        Args:
            start: The block as it is.
            ends: Where it may go, and by how much it turns on the way [rad].
            wanted: With which force it should be pressed [N].
            release: Whether it is let go there.

        Returns:
            The best way, or None if the fingers can go none.
        """
        ways = [
            (start.at(end.place, start.yaw + turn), turn, self._height(start, end), end)
            for end, turn in ends
            if all(end.depth_in(other) < CROWDED for other in self._others)
        ]
        if not ways:
            return None
        over, table = self._above(start), gripped(*start.half.tolist())
        table = table.only(self._opens(table, start, over))
        first = self._strengths(table, start)
        table, first = table.only(first > 0.0), first[first > 0.0]
        ease = FIRMNESS * table.firm - TIGHT * (table.opening < max(OPENINGS))
        ease += self._transit(table, start, over)
        worths, strengths = (
            np.full((len(ease), len(ways)), -np.inf),
            np.zeros((len(ease), len(ways))),
        )
        for way, (on, turn, height, _) in enumerate(ways):
            opens = np.full(len(ease), True)
            if release:
                opens = self._opens(table, on, self._above(start, on))
            begin, last = (np.array([*body.place[:2], height]) for body in (start, on))
            middle = (begin + last) / 2.0, start.yaw + turn / 2.0
            rows, held = np.flatnonzero(opens), first[opens]
            for body in (on, on.at(last, on.yaw), start.at(*middle), start.at(begin, start.yaw)):
                held = np.minimum(held, self._strengths(table.only(rows), body))
                rows, held = rows[held > 0.0], held[held > 0.0]
            share = held / wanted
            enough = np.minimum(share, 1.0) + PLENTY * np.minimum(share, 3.0)
            loose = 2.0 * FIRMNESS * (height > start.place[2] + CLEARANCE)
            worths[rows, way] = ease[rows] - loose * table.firm[rows] - TURNING * abs(turn) + enough
            strengths[rows, way] = held
        if not np.isfinite(worths).any():
            return None
        row, way = divmod(int(worths.argmax()), len(ways))
        _, turn, height, end = ways[way]
        above = self._above(start, *[end] * release)
        strength = float(strengths[row, way])
        return Move(table.only(row), start, end, turn, height, above, strength, release)

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

    def _strengths(self, table: Grip, body: Cuboid) -> Floats:
        """Find with which force grips can hold a block somewhere, shape (n,) [N]; 0 if not."""
        tips = table.place(self._hand, body, 0.0)
        joints, reached, depth = self._poses(tips, None, (body, -TOUCH))
        forces = table.inward @ turn_about_z(body.yaw).T
        strengths = self._hand.strengths(joints, forces)
        return np.where(reached & (depth <= 0.0), strengths, 0.0)

    def _opens(self, table: Grip, body: Cuboid, above: float) -> NDArray[np.bool_]:
        """Tell whether open fingers can be about a block, and above it, shape (n,)."""
        tips = table.place(self._hand, body, table.opening)
        joints, reached, depth = self._poses(tips, None, (body, OPEN))
        opens = reached & (depth <= 0.0)
        _, reached, depth = self._poses(_above(tips, table, above)[opens], joints[opens])
        opens[opens] = reached & (depth <= 0.0)
        return opens

    def _transit(self, table: Grip, body: Cuboid, above: float) -> Floats:
        """Judge ways to the block: fingers should not meet; the shorter, the better. Shape (n,)."""
        first = self._hand.tips(self._joints).reshape(3, 3)
        first[:, 2] = np.maximum(first[:, 2], above)
        last = _above(table.place(self._hand, body, table.opening), table, above)
        worth: Floats = -REACHING * np.abs(last - first).max(axis=(1, 2), initial=0.0)
        for share in (0.3, 0.6, 0.9):
            _, _, depth = self._poses((1.0 - share) * first + share * last)
            worth -= MEETING * (depth > 0.0)
        return worth

    def _poses(
        self, tips: Floats, near: Floats | None = None, *more: tuple[Cuboid, float]
    ) -> tuple[Floats, NDArray[np.bool_], Floats]:
        """Find joints for fingertips, and how deep fingers then lie in anything; see ``poses``.

        Each of ``more`` is another box, and by how much its sides are moved outwards [m].
        """
        rows = np.ascontiguousarray(tips).reshape(-1, 9)
        begin = np.tile(self._joints, (len(rows), 1)) if near is None else near
        boxes = [*((other, CLEAR) for other in self._others), *more]
        halves = np.array([body.half + grow for body, grow in boxes]).reshape(-1, 3)
        centers = np.array([body.place for body, _ in boxes]).reshape(-1, 3)
        axes = np.array([turn_about_z(body.yaw) for body, _ in boxes]).reshape(-1, 3, 3)
        found: tuple[Floats, NDArray[np.bool_], Floats] = poses(
            rows, begin, self._hand.height, halves, centers, axes
        )
        return found


def _above(tips: Floats, table: Grip, height: float) -> Floats:
    """Bring the fingertips of grips to a height, shape (n, 3, 3) [m]; unused ones stay."""
    raised = tips.copy()
    raised[..., 2] = np.where(table.used, height, tips[..., 2])
    return raised
