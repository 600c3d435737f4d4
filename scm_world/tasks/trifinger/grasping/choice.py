"""What a policy that grasps does next: which block, by which grip, and where to."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import permutations, product
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._types import ArrayLike, Floats
from scm_world.tasks.trifinger.grasping.bodies import Cuboid, Sight, turn_about_z
from scm_world.tasks.trifinger.grasping.hand import TIP_RADIUS, poses

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

    def only(self, rows: int | NDArray[np.bool_ | np.int64]) -> Grip:
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


ENOUGH, FAIR = 0.85, 0.8  # shares of a goal that a block fills where it is left alone: usually,
LATE = 70  # and with fewer control steps left, since there is not enough time for more
HOVER = np.array([0.0, 0.0, 0.001])  # [m] of the last block above its goal, where it is held
ON_FLOOR = 0.006  # [m] that a goal may be above the floor and still be on it
ON_TOP = 0.01  # [m] that it may be above or in the block below it
ROOM = 0.03  # [m] for fingers about a block that is put down on the way
ASIDE = 0.005  # [m] that such a block keeps away from goals
NEAR = 0.04  # [m] between blocks that are in one another's way
MOVED, TURNED = 0.02, 0.2  # [m], [rad] at least, of a block that is put down on the way
TRIES = 12  # places to put a block down on the way that are thought through
RINGS = (0.0, 0.05, 0.09, 0.12)  # [m] radii of these places
PARTS = (1.0, 0.5, 0.0)  # shares of a turn that may be made before a block is put down there
LESS = (0.75, 0.5, 0.25, 0.0)
"""Shares of a turn that may be made instead, where there is one block: no grip can make the whole
turn then, and putting the block down on the way takes so long that an episode mostly ends."""

STOPS = [
    np.array([radius * math.cos(angle), radius * math.sin(angle)])
    for radius in RINGS
    for angle in np.linspace(0.0, 2.0 * math.pi, 12 if radius else 1, endpoint=False)
]

CROWDED = 0.003  # [m] that blocks may lie in one another at the end, as stacked ones do
CLEAR = 0.003  # [m] that fingers stay away from other things
OPEN = 0.004  # [m] that open fingers stay away from the block
TOUCH = 0.0015  # [m] that a leg may be deeper in the block than its fingertip
UPRIGHT = 0.004  # [m] that a block may go sideways without being carried over something
OVER = 0.025  # [m] that fingertips pass above things
LOWEST = 0.09  # [m] of fingertips that travel

FIRMNESS, TIGHT, MEETING, PLENTY = 0.5, 0.1, 0.3, 0.05
TURNING, REACHING = 0.3, 0.5  # [1/rad], [1/m]
"""What makes a way better or worse. A force that is just enough is worth 1."""


@final
class Choice:
    """Chooses what to do next. The block with the highest goal is held there."""

    def __init__(self, sight: Sight) -> None:
        self._sight = sight
        self._bodies = {name: sight.body(name) for name in sight.solid}
        self._goals = {goal: sight.body(goal) for _, goal in sight.pairs}
        pairs = sorted(sight.pairs, key=lambda pair: float(self._goals[pair[1]].place[2]))
        self._last, self._alone = pairs[-1][1], len(pairs) == 1
        enough = ENOUGH if sight.left > LATE else FAIR
        self._todo = [
            (tool, goal)
            for tool, goal in pairs
            if self._hangs(tool, goal) or self._bodies[tool].fills(self._goals[goal]) < enough
        ]

    def move(self) -> Move | None:
        """Choose how to fill the lowest goal that is not filled; None if nothing can be done."""
        for tool, goal in self._todo:
            if self._waits(tool, goal):
                continue
            end, start, release = self._goals[goal], self._bodies[tool], not self._hangs(tool, goal)
            end = end.at(end.place + HOVER * (goal == self._last), end.yaw)
            place, turns = end.place, start.turns(end)
            for share in (1.0, *LESS) if self._alone else (1.0,):
                less = [share * turn for turn in turns]
                if share < 1.0:
                    less = [t for t in less if start.at(place, start.yaw + t).fills(end) > FAIR]
                move = self._best(start, place, less, release=release)
                if move is not None:
                    return move
            move = self._detour(start, place, turns, release=release) or self._make_way(start, end)
            if move is not None:
                return move
        return None

    def _others(self, block: str) -> list[Cuboid]:
        return [body for name, body in self._bodies.items() if name != block]

    def _hangs(self, tool: str, goal: str) -> bool:
        """Return whether a block is held at its goal: it is the last, or there is nothing below."""
        end = self._goals[goal]
        return goal == self._last or (
            end.bottom > ON_FLOOR
            and not any(
                abs(end.bottom - body.top) < ON_TOP and end.depth_in(body, flat=True) > 0.0
                for body in self._others(tool)
            )
        )

    def _waits(self, tool: str, goal: str) -> bool:
        """Return whether a block cannot stand before a goal below its own is filled."""
        return self._hangs(tool, goal) and any(
            self._goals[goal].depth_in(self._goals[other], flat=True) > 0.0
            for _, other in self._todo
            if other != goal
        )

    def _make_way(self, start: Cuboid, end: Cuboid) -> Move | None:
        """Move a block that stands where another one should go, or where its fingers would be."""
        others = [self._bodies[tool] for tool, _ in self._todo if tool != start.name]
        depth = {
            body.name: max(body.depth_in(place, flat=True) for place in (end, start))
            for body in others
        }
        near = [body for body in others if depth[body.name] > -NEAR]
        for body in sorted(near, key=lambda body: -depth[body.name]):
            move = self._detour(body, body.place, (), release=True)
            if move is not None:
                return move
        return None

    def _detour(
        self, start: Cuboid, place: Floats, turns: Sequence[float], *, release: bool
    ) -> Move | None:
        """Put a block down from where it can be carried on; out of the way if there are no turns.

        The shortest detours come first.
        """
        first, last, tried = start.place[:2], place[:2], 0
        stops = sorted(STOPS, key=lambda at: math.dist(first, at) + math.dist(at, last))
        for at in stops:
            for turn in [part * turns[0] for part in PARTS] if turns else [0.0]:
                stop = start.at(np.array([*at, start.half[2]]), start.yaw + turn)
                moved, turned = math.dist(first, at), abs(stop.yaw - start.yaw)
                if not self._is_free(stop) or (moved <= MOVED and turned <= TURNED):
                    continue
                rest, tried = [full - turn for full in turns], tried + 1
                move = self._best(start, stop.place, [turn], release=True)
                if move and (not turns or self._best(stop, place, rest, release=release)):
                    return move
                if tried == TRIES:
                    return None
        return None

    def _is_free(self, stop: Cuboid) -> bool:
        """Return whether a block can stand somewhere, with room for fingers and beside goals."""
        near = [(body, ROOM) for body in self._others(stop.name)]
        wide = [(body, ASIDE) for body in self._goals.values()]
        return not any(
            stop.depth_in(body, margin=gap, flat=True) > 0.0 for body, gap in near + wide
        )

    # --- by which grip ------------------------------------------------------------------------

    def _best(
        self, start: Cuboid, place: Floats, turns: Iterable[float], *, release: bool
    ) -> Move | None:
        """Find the best way to bring a block to a place, turned by one of some angles [rad].

        Two fingers rather than three lift it from the floor: each of the two on one side of three
        presses half as much, and slips sooner.
        """
        others, wanted = self._others(start.name), self._sight.wanted(start.name)
        ends = [(start.at(place, start.yaw + turn), turn) for turn in turns]
        ends = [way for way in ends if all(way[0].depth_in(other) < CROWDED for other in others)]
        if not ends:
            return None
        lifted = float(start.place[2]) + CLEARANCE
        height = max(lifted, float(place[2]))
        if math.dist(start.place[:2], place[:2]) >= UPRIGHT:
            steps = np.linspace(0.0, 1.0, SAMPLES)[:, None] * (place - start.place)
            height = max(height, passing(start, steps, others))
        over, table = self._above(start), gripped(*start.half.tolist())
        table = table.only(self._opens(table, start, over))
        first = self._strengths(table, start)
        table, first = table.only(first > 0.0), first[first > 0.0]
        ease = FIRMNESS * table.firm - TIGHT * (table.opening < max(OPENINGS))
        ease += self._transit(table, start, over)
        loose = 2.0 * FIRMNESS * (height > lifted)
        begin, last = (np.array([*at[:2], height]) for at in (start.place, place))
        worths = np.full((len(ease), len(ends)), -np.inf)
        strengths = np.zeros(worths.shape)
        for way, (end, turn) in enumerate(ends):
            rows, held = np.arange(len(ease)), first
            if release:
                rows = np.flatnonzero(self._opens(table, end, self._above(start, end)))
                held = first[rows]
            middle = start.at((begin + last) / 2.0, start.yaw + turn / 2.0)
            for body in (end, end.at(last, end.yaw), middle, start.at(begin, start.yaw)):
                held = np.minimum(held, self._strengths(table.only(rows), body))
                rows, held = rows[held > 0.0], held[held > 0.0]
            share = held / wanted
            enough = np.minimum(share, 1.0) + PLENTY * np.minimum(share, 3.0)
            worths[rows, way] = ease[rows] - loose * table.firm[rows] - TURNING * abs(turn) + enough
            strengths[rows, way] = held
        if not np.isfinite(worths).any():
            return None
        row, way = divmod(int(worths.argmax()), len(ends))
        return Move(
            grip=table.only(row),
            end=(end := ends[way][0]),
            height=height,
            above=self._above(start, *[end] * release),
            strength=float(strengths[row, way]),
            over=height > max(lifted, float(place[2])),
            release=release,
        )

    def _above(self, *blocks: Cuboid) -> float:
        """Compute a height at which fingertips pass over everything [m]."""
        others = self._others(blocks[0].name)
        return max(LOWEST, *(body.top + OVER for body in (*others, *blocks)))

    def _strengths(self, table: Grip, body: Cuboid) -> Floats:
        """Compute with which force grips can hold a block somewhere, shape (n,) [N]; 0 if not."""
        tips = table.place(self._sight, body, 0.0)
        joints, fits, _ = self._poses(tips, body, grow=-TOUCH)
        strengths = self._sight.strengths(joints, table.inward @ turn_about_z(body.yaw).T)
        return np.where(fits, strengths, 0.0)

    def _opens(self, table: Grip, body: Cuboid, above: float) -> NDArray[np.bool_]:
        """Return whether open fingers can be about a block, and above it, shape (n,)."""
        tips = table.place(self._sight, body, table.opening)
        joints, opens, _ = self._poses(tips, body, grow=OPEN)
        raised = _raised(tips, table, above)[opens]
        opens[opens] = self._poses(raised, body, near=joints[opens])[1]
        return opens

    def _transit(self, table: Grip, body: Cuboid, above: float) -> Floats:
        """Judge ways to the block: fingers should not meet; the shorter, the better. Shape (n,)."""
        first = self._sight.tips.copy()
        first[:, 2] = np.maximum(first[:, 2], above)
        last = _raised(table.place(self._sight, body, table.opening), table, above)
        worth: Floats = -REACHING * np.abs(last - first).max(axis=(1, 2), initial=0.0)
        for share in (0.3, 0.6, 0.9):
            _, _, depth = self._poses((1.0 - share) * first + share * last, body)
            worth -= MEETING * (depth > 0.0)
        return worth

    def _poses(
        self, tips: Floats, body: Cuboid, near: Floats | None = None, grow: float | None = None
    ) -> tuple[Floats, NDArray[np.bool_], Floats]:
        """Find joints for fingertips, whether fingers can be there, and their depth in bodies.

        The block itself counts if its sides are moved outwards by ``grow`` [m].
        """
        sight, rows = self._sight, np.ascontiguousarray(tips).reshape(-1, 9)
        bodies = [(other, CLEAR) for other in self._others(body.name)]
        bodies += [(body, grow)] if grow is not None else []
        boxes = [np.c_[b.half + more, b.place, turn_about_z(b.yaw)] for b, more in bodies]
        near = np.tile(sight.joints, (len(rows), 1)) if near is None else near
        joints, reached, depth = poses(rows, near, sight.height, np.reshape(boxes, (-1, 3, 5)))
        return joints, reached & (depth <= 0.0), depth


def _raised(tips: Floats, table: Grip, height: float) -> Floats:
    """Bring the fingertips of grips to a height, shape (n, 3, 3) [m]; unused ones stay."""
    raised = tips.copy()
    raised[..., 2] = np.where(table.used, height, tips[..., 2])
    return raised
