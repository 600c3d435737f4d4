"""A block between fingertips: where it should be, and what it takes to keep it there."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import final

import numpy as np

from scm_world._types import Floats
from scm_world.tasks.trifinger.grasping.bodies import QUARTER, Body, smallest, turn_about_z
from scm_world.tasks.trifinger.grasping.grips import Grip
from scm_world.tasks.trifinger.grasping.sight import Sight

Step = tuple[Floats, Floats]
"""Where the fingertips should be, shape (9,) [m], and how they press, shape (3, 3) [N]."""

GAIN = 0.12
"""Share of the error of a block by which its place is corrected in a control step."""

RIGHTING = 0.03
"""Share of its tilt."""

FARTHEST = np.array([0.015, 0.015, 0.015, 0.2])  # [m, m, m, rad] of a correction
STEEPEST = 0.2  # [rad]
SLIPPED = 0.02  # [m] a block has slipped so far from the fingertips: it is lost
FALLEN = 0.6  # sine of the tilt of a block that is lost
CLOSE = np.array([0.001, 0.001, 0.002, 0.015])  # [m, m, m, rad] of a block that has arrived
PATIENCE = 15
SHORTEST = 4
"""Control steps that a block is given to arrive, at most and at least."""

RAMP = 5
"""Control steps in which a block comes to its speed."""


@final
class Hold:
    """Keeps hold of a block, and corrects where the fingertips are by where the block is.

    Args:
        sight: Of the world.
        tool: The block.
        grip: How it is held.
        press: With which force [N].
        aside: Fingertips as they are told to be, shape (9,) [m]; unused ones stay there.

    Attributes:
        lost: Whether the block has slipped away.
    """

    def __init__(self, sight: Sight, tool: str, grip: Grip, press: float, aside: Floats) -> None:
        self._sight, self._tool, self._grip = sight, tool, grip
        self._wanted = body = sight.body(tool)
        self._points = body.own(self._tips())
        self._idle = ~np.array(grip.used)
        self._aside = aside.reshape(3, 3)
        shares = np.abs(grip.inward).max(axis=1)
        self._forces = press * grip.inward
        self._lift = sight.weight(tool) * shares / shares.sum()
        self._correction, self._tilt, self._error = np.zeros(4), np.zeros(2), np.zeros(4)
        self.lost = False

    def _tips(self) -> Floats:
        return self._sight.hand.tips(self._sight.joints).reshape(3, 3)

    def step(self, share: float = 1.0) -> Step:
        """Say what the fingers should do now.

        Args:
            share: Of the force.
        """
        wanted = self._wanted
        place, yaw = wanted.place + self._correction[:3], wanted.yaw + self._correction[3]
        axes = turn_about_z(yaw)
        arms = self._points @ axes.T
        tips = place + arms
        tips[:, :2] -= arms[:, 2:] * self._tilt
        tips[:, 2] += arms[:, :2] @ self._tilt
        tips[self._idle] = self._aside[self._idle]
        forces = self._forces @ axes.T
        forces[:, 2] += self._lift
        return tips.ravel(), share * forces

    def _watch(self) -> None:
        """See where the block is, and correct."""
        body = self._sight.body(self._tool)
        slip = (body.own(self._tips()) - self._points)[~self._idle].mean(axis=0)
        self.lost = math.dist(slip, np.zeros(3)) > SLIPPED or math.hypot(*body.lean) > FALLEN
        self._tilt = np.clip(self._tilt + RIGHTING * body.lean, -STEEPEST, STEEPEST)
        yaw = smallest(self._wanted.yaw - body.yaw, QUARTER)
        self._error = np.array([*(self._wanted.place - body.place), yaw])
        self._correction = np.clip(self._correction + GAIN * self._error, -FARTHEST, FARTHEST)

    def carry(self, end: Body, rate: float, turning: float) -> Iterator[Step]:
        """Bring the block somewhere, straight, unless it is lost.

        Args:
            end: Where to.
            rate: How far per control step [m].
            turning: How far it is turned per control step [rad].
        """
        start = self._wanted
        way, turn = end.place - start.place, end.yaw - start.yaw
        least = max(math.dist(way, np.zeros(3)) / rate, abs(turn) / turning)
        steps = math.ceil(least) + RAMP
        for step in range(1, steps + 1):
            self._watch()
            if self.lost:
                return
            share = _steady(step, steps)
            self._wanted = start.at(start.place + share * way, start.yaw + share * turn)
            yield self.step()

    def settle(self) -> Iterator[Step]:
        """Wait until the block has arrived, but not for long."""
        for waited in range(PATIENCE):
            self._watch()
            arrived = waited >= SHORTEST and bool((np.abs(self._error) < CLOSE).all())
            if self.lost or arrived:
                return
            yield self.step()

    def stay(self, sight_of_goal: str, rate: float, beside: Floats) -> Iterator[Step]:
        """Keep the block where its goal is, wherever that goes, until it is lost.

        Args:
            sight_of_goal: Name of the goal.
            rate: How far the block follows per control step [m].
            beside: Where it is held, seen from the goal, shape (3,) [m].
        """
        while not self.lost:
            yield self.step()
            self._watch()
            way = self._sight.body(sight_of_goal).place + beside - self._wanted.place
            share = min(rate / max(math.dist(way, np.zeros(3)), 1e-9), 1.0)
            self._wanted = self._wanted.at(self._wanted.place + share * way, self._wanted.yaw)


def _steady(step: int, steps: int) -> float:
    """Share a way into steps that are equal, but for the first and the last ones."""
    ramp = min(RAMP, steps / 2.0)
    speed = 1.0 / (steps - ramp)
    if step < ramp:
        return 0.5 * speed * step**2 / ramp
    if step > steps - ramp:
        return 1.0 - 0.5 * speed * (steps - step) ** 2 / ramp
    return speed * (step - 0.5 * ramp)
