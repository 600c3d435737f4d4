"""What a policy that grasps does next: which block, and where to."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import final

import numpy as np

from scm_world.tasks.trifinger.grasping.bodies import Cuboid, Sight, turns
from scm_world.tasks.trifinger.grasping.ways import Move, Planner, Way

ENOUGH, FAIR = 0.85, 0.8
"""Shares of a goal that a block fills where it is left alone: usually, and in the end."""

LATE = 70
"""So many control steps before the end less is enough, since there is no time to do it better."""

HOVER = np.array([0.0, 0.0, 0.001])  # [m] of the last block above its goal, where it is held
ON_FLOOR = 0.006  # [m] that a goal may be above the floor and still be on it
ON_TOP = 0.01  # [m] that it may be above or in the block below it
ROOM = 0.03  # [m] for fingers about a block that is put down on the way
ASIDE = 0.005  # [m] that such a block keeps away from goals
NEAR = 0.04  # [m] between blocks that are in one another's way
MOVED = 0.02  # [m]
TURNED = 0.2  # [rad]
TRIES = 12
"""How many places to put a block down on the way are thought through."""

RINGS = (0.0, 0.05, 0.09, 0.12)  # [m] radii of these places
PARTS = (1.0, 0.5, 0.0)
"""Shares of a turn that may be made before a block is put down on the way."""

LESS = (0.75, 0.5, 0.25, 0.0)
"""Shares of a turn that may be made instead, where there is one block: no grip can make the whole
turn then, and putting the block down on the way takes so long that an episode mostly ends."""

STOPS = [
    np.array([radius * math.cos(angle), radius * math.sin(angle)])
    for radius in RINGS
    for angle in np.linspace(0.0, 2.0 * math.pi, 12 if radius else 1, endpoint=False)
]


@final
class Choice:
    """Chooses what to do next. The block with the highest goal is held there.

    Args:
        sight: The present of the world.
    """

    def __init__(self, sight: Sight) -> None:
        self._sight = sight
        self._bodies = sight.solid()
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
            end, start, last = self._goals[goal], self._bodies[tool], goal == self._last
            release = not self._hangs(tool, goal)
            end = end.at(end.place + HOVER * last, end.yaw)
            turned = turns(start, end)
            for share in (1.0, *LESS) if self._alone else (1.0,):
                ways = [
                    (start.at(end.place, start.yaw + share * turn), share * turn) for turn in turned
                ]
                fair = [way for way in ways if share == 1.0 or way[0].fills(end) > FAIR]
                move = self._best(start, fair, release=release)
                if move is not None:
                    return move
            ways = [(start.at(end.place, start.yaw + turn), turn) for turn in turned]
            move = self._detour(start, ways, release=release) or self._make_way(start, end)
            if move is not None:
                return move
        return None

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

    def _others(self, tool: str) -> list[Cuboid]:
        return [body for name, body in self._bodies.items() if name != tool]

    def _best(self, start: Cuboid, ways: Iterable[Way], *, release: bool) -> Move | None:
        planner = Planner(self._sight.hand, self._sight.joints, self._others(start.name))
        return planner.best(start, ways, wanted=self._sight.wanted(start.name), release=release)

    def _make_way(self, start: Cuboid, end: Cuboid) -> Move | None:
        """Move a block that stands where another one should go, or where its fingers would be."""
        depth = {
            other: max(self._bodies[other].depth_in(place, flat=True) for place in (end, start))
            for other, _ in self._todo
            if other != start.name
        }
        for other in sorted(depth, key=lambda name: -depth[name]):
            move = self._detour(self._bodies[other], []) if depth[other] > -NEAR else None
            if move is not None:
                return move
        return None

    def _detour(self, start: Cuboid, ways: list[Way], *, release: bool = True) -> Move | None:
        """Find a way to put a block down from where it can be carried on, or out of the way.

        Args:
            start: The block.
            ways: Where it should go in the end; nowhere if empty.
            release: Whether it is let go there.
        """
        for stop, turn in self._stops(start, ways):
            move = self._best(start, [(stop, turn)], release=True)
            rest = [(end, full - turn) for end, full in ways]
            if move is not None and (
                not ways or self._best(stop, rest, release=release) is not None
            ):
                return move
        return None

    def _stops(self, start: Cuboid, ways: list[Way]) -> Iterator[Way]:
        """List places where a block may be put down, the shortest detours first."""
        tried, (end, full) = 0, ways[0] if ways else (start, 0.0)
        first, last = start.place[:2], end.place[:2]
        for place in sorted(STOPS, key=lambda at: math.dist(first, at) + math.dist(at, last)):
            for part in PARTS if ways else PARTS[-1:]:
                turn = part * full
                stop = start.at(np.array([*place, start.half[2]]), start.yaw + turn)
                moved, turned = math.dist(first, stop.place[:2]), abs(stop.yaw - start.yaw)
                if self._is_free(stop) and (moved > MOVED or turned > TURNED):
                    tried += 1
                    yield stop, turn
                if tried == TRIES:
                    return

    def _is_free(self, stop: Cuboid) -> bool:
        """Return whether a block can stand somewhere, with room for fingers and beside goals."""
        near = ((body, ROOM) for body in self._others(stop.name))
        wide = ((body, ASIDE) for body in self._goals.values())
        return not any(
            stop.depth_in(body, margin=margin, flat=True) > 0.0
            for bodies in (near, wide)
            for body, margin in bodies
        )
