"""A policy that grasps blocks and puts them where their goals are."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise
from typing import Any, final
from weakref import WeakKeyDictionary

import numpy as np

from scm_world._types import Floats
from scm_world.errors import ActionError, UnknownOption
from scm_world.tasks.trifinger.grasping.bodies import (
    QUARTER,
    Cuboid,
    Sight,
    smallest,
    turn_about_z,
    unit,
)
from scm_world.tasks.trifinger.grasping.choice import Choice, Job, lifted
from scm_world.tasks.trifinger.grasping.ways import Grip, Planner

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
        aside: Commanded fingertips, shape (9,) [m]; unused ones stay there.

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

    def carry(self, end: Cuboid, rate: float, turning: float) -> Iterator[Step]:
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


PRESS = 5
SETTLE = 2
"""Control steps in which fingers come to their force, and in which they are given time."""

LETTING_GO = (0.6, 0.3, 0.0)
"""Shares of the force, control step by control step."""

SAFE = 0.09  # [m] above the floor, where the fingers wait
AGAIN = 25
"""Control steps until it is tried again when nothing can be done."""

RESERVE = 40.0
"""Control steps that a move keeps for coming to its speed, settling, and letting go."""

HURRY = 20.0
"""Control steps that a move is given at least, however little time there is."""

LEISURE = 0.6
"""Share of the time there is that a move takes if it may."""

SLOWEST = 0.0008  # [m] that a block is carried per control step
HEAVY, LIGHT = 0.7, 0.2
"""Shares of the force that the weight of a block needs: it is carried slowly, or at full pace."""

_FREE = np.zeros((3, 3))


@final
@dataclass(frozen=True)
class Pace:
    """How fast a grasp is, per control step.

    Attributes:
        travel: Of fingertips that hold nothing [m].
        close: Of fingertips that come to a block [m].
        carry: Of a block, at most [m].
        turn: Of a block about the vertical [rad].

    Raises:
        UnknownOption: One of them is not a positive number.
    """

    travel: float = 0.016
    close: float = 0.0025
    carry: float = 0.0045
    turn: float = 0.03

    def __post_init__(self) -> None:
        for name, rate in asdict(self).items():
            if not (math.isfinite(rate) and rate > 0.0):
                raise UnknownOption(name, rate, ("a positive number per control step",))


@final
class Grasp:
    """Takes block after block, the one with the lowest goal first, and puts it at its goal.

    It reads places, sizes, masses and friction of the blocks, and the robot's state. It chooses
    the faces to press and the fingers that do so, goes around what is in the way, turns a block
    about the vertical if its goal asks for it, puts it down on the way if it cannot go there at
    once, makes way for it, tries again when it has slipped, and holds it where a goal is in the
    air. Heavy blocks are carried slowly, as far as there is time. A block that lies on the wrong
    face stays on it, and one that no two fingers reach stays where it is.

    It is meant for picking, pick and place, stacking two and pushing. Where there are dozens of
    blocks it begins, and mostly does not finish.

    It depends on nothing but the world, without noise, and starts again with every episode: one
    instance serves any number of episodes and of worlds.

    Args:
        pace: How fast it is; ``Pace()`` if None.
        holds: Whether the last block is not let go of, but held at its goal. That is easier to
            imitate: what fingers do while they let go depends on what they did before.

    Example:
        >>> from scm_world.queries import World
        >>> world = World("picking", action_mode="end_effector_positions")
        >>> episode = world.rollout(Grasp())
        >>> bool(episode.final("success"))
        True
    """

    def __init__(self, pace: Pace | None = None, *, holds: bool = False) -> None:
        self.pace, self.holds = pace or Pace(), holds
        self._programs: WeakKeyDictionary[Any, _Grasping] = WeakKeyDictionary()

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle without what is going on."""
        return partial(Grasp, holds=self.holds), (self.pace,)

    def __call__(self, world: Any) -> Floats:
        """Give the action of the present step.

        Raises:
            ActionError: Actions are torques, or the task has no blocks that have goals.
        """
        if world.action_mode == "joint_torques":
            problem = "a grasp needs joint or fingertip positions as actions, not torques"
            raise ActionError(problem, world.action_mode)
        program = self._programs.get(world)
        if program is None or not program.goes_on(world):
            program = self._programs[world] = _Grasping(world, self.pace, holds=self.holds)
        return program.action(world)


@final
class _Grasping:
    """What is done in one episode, as a generator of steps."""

    def __init__(self, world: Any, pace: Pace, *, holds: bool) -> None:
        self._pace, self._holds = pace, holds
        self._sight = Sight(world)
        self._unit, self._next = unit(world), world.index
        self._tips = self._sight.hand.tips(self._sight.joints)
        self._steps = self._work()

    def goes_on(self, world: Any) -> bool:
        """Tell whether the present is the step after the last one."""
        return world.index == self._next and self._unit == unit(world)

    def action(self, world: Any) -> Floats:
        """Give the action of the present step."""
        self._next = world.index + 1
        self._sight.look(world)
        self._tips, forces = next(self._steps)
        hand = self._sight.hand
        command = hand.command(self._tips, forces, self._sight.joints)
        return hand.tips(command) if "effector" in world.action_mode else command

    def _work(self) -> Iterator[Step]:
        while True:
            job = Choice(self._sight, holds=self._holds).job()
            if job is None:
                yield from self._rise(SAFE)
                for _ in range(AGAIN):
                    yield self._tips, _FREE
            else:
                yield from self._take(job)
                yield from self._bring(job)
                yield from self._rise(job.move.above)

    # --- fingers without a block ----------------------------------------------------------

    def _glide(self, tips: Floats, rate: float) -> Iterator[Step]:
        """Move the fingertips straight, smoothly."""
        first = self._tips
        way = tips - first
        steps = max(math.ceil(float(np.abs(way).max()) / rate), 1)
        for step in range(1, steps + 1):
            yield first + (0.5 - 0.5 * math.cos(math.pi * step / steps)) * way, _FREE

    def _rise(self, above: float) -> Iterator[Step]:
        tips = self._tips.copy()
        tips[2::3] = np.maximum(tips[2::3], above)
        yield from self._glide(tips, self._pace.travel)

    def _take(self, job: Job) -> Iterator[Step]:
        """Come to a block from above and press on its faces, wherever it moves in the meantime."""
        move, tool, grip = job.move, job.tool, job.move.grip
        place = Planner(self._sight.hand, self._sight.joints, ()).place
        yield from self._rise(move.above)
        yield from self._glide(place(grip, move.start, grip.opening, move.above), self._pace.travel)
        yield from self._glide(place(grip, move.start, grip.opening), self._pace.travel)
        press = min(self._sight.wanted(tool), move.strength)
        place = Planner(self._sight.hand, self._sight.joints, ()).place
        steps = math.ceil(grip.opening / self._pace.close)
        for step in range(1, steps + PRESS + SETTLE + 1):
            body = self._sight.body(tool)
            force = press * min(max((step - steps) / PRESS, 0.0), 1.0)
            opening = grip.opening * max(1.0 - step / steps, 0.0)
            yield place(grip, body, opening), force * grip.inward @ turn_about_z(body.yaw).T

    # --- fingers with a block -------------------------------------------------------------

    def _bring(self, job: Job) -> Iterator[Step]:
        """Bring a block to its end, and let go of it there or when it is lost."""
        tool, move, sight = job.tool, job.move, self._sight
        body, press = sight.body(tool), min(sight.wanted(tool), move.strength)
        hold = Hold(sight, tool, move.grip, press, self._tips)
        # It comes by above its place, above its end, and at its end.
        yaw = body.yaw + move.turn + smallest(move.start.yaw - body.yaw, QUARTER)
        over, there = (np.array([*on.place[:2], move.height]) for on in (body, move.end))
        stations = body.at(over, body.yaw), body.at(there, yaw), body.at(move.end.place, yaw)
        rate = self._rate(job, [body, *stations], sight.burden(tool) / press)
        for station in stations:
            yield from hold.carry(station, rate, self._pace.turn)
        if not move.release:
            goal = next(goal for block, goal in sight.pairs if block == tool)
            yield from hold.stay(goal, self._pace.carry, lifted(self._holds))
        yield from hold.settle()
        for share in LETTING_GO:
            yield hold.step(share)
        axes = turn_about_z(sight.body(tool).yaw)
        away = (move.grip.points(move.grip.opening) - move.grip.touch) @ axes.T
        yield from self._glide(self._tips + away.ravel(), 2.0 * self._pace.close)

    def _rate(self, job: Job, way: list[Cuboid], burden: float) -> float:
        """Choose how fast a block is carried [m] per control step.

        Args:
            job: What is done.
            way: Where it goes.
            burden: Share of the force that its weight needs.
        """
        length = sum(math.dist(one.place, other.place) for one, other in pairwise(way))
        time = max(self._sight.left / job.jobs - RESERVE, HURRY)
        light = min(max((HEAVY - burden) / (HEAVY - LIGHT), 0.0), 1.0) ** 2
        calm = max(self._pace.carry * light, length / time)
        slow = max(length / (LEISURE * time), SLOWEST)
        return float(min(calm, slow, self._pace.carry))
