"""A grasp by feedback: the next command follows from the poses of bodies, not from the time."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, final
from weakref import WeakKeyDictionary

import numpy as np

from scm_world._types import Floats
from scm_world.errors import ActionError
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.grasping.bodies import Cuboid, Sight, turn_about_z
from scm_world.tasks.trifinger.grasping.choice import (
    CLEARANCE,
    EDGE,
    OPENINGS,
    SAMPLES,
    Choice,
    Grip,
    Move,
    passing,
)
from scm_world.tasks.trifinger.grasping.hand import TIP_RADIUS

if TYPE_CHECKING:
    from scm_world.tasks.base import Simulation

FREE = np.zeros((3, 3))
TRAVEL, CLOSE = 0.022, 0.006  # [m] per control step, of fingertips far from a block, and beside it
CARRY, TURN = 0.0045, 0.03  # [m], [rad] per control step, of a block
RISE = 0.0012  # [m] per control step, upwards or downwards
SINK, SLOWEST, FASTEST = 0.0015, 0.0006, 0.002  # [m] likewise, of a block that goes over a wall
STIFF = 400.0  # [N/m] of a fingertip: 10 N m/rad, the usual gain, at a lever of 0.16 m
SOON = 0.03  # [m] of its way, for which it is high enough before it goes on
FREE_GAIN, GAIN, HOLD = 0.35, 0.15, 0.4  # shares of an error that are corrected in a control step
AHEAD = 0.02  # [m] that a command may be from where a fingertip is
TOUCHING, SLIPPED = 0.004, 0.02  # [m] across and along a face, of fingertips that hold a block
BESIDE, ASIDE = 0.012, 0.015  # [m] likewise, beyond the opening, of those that come to it
STRAIGHT, OBLIQUE = 0.008, 0.02  # [m] along a face, of fingers that close fully, or not at all
INTO = 0.012  # [m] behind a face, of the place that fingers close towards: they touch at full speed
NEAR, FAR = 0.008, 0.025  # [m] from above a grip: fingertips come down; they go up first
FUNNEL = 2.5  # how much higher fingertips are, for each metre they are too far aside
UNEVEN = 0.012  # [m] by which the fingers of two faces may be aside of one another
PRESS, LIGHT = 2.0, 1.5  # [N] with which a block is pressed, if fingers can, that wants less
FIRMLY = 1.5  # with which a heavier one is pressed, as a multiple of the needed force
LANDING, TILTED, SOFT = 0.012, 0.1, 0.6  # [m], sine, share: a block that swings is laid flat
LAG, TWIST = 0.015, 0.2  # [m], [rad] that a held block may be behind its command
OFF = 0.001, 0.007  # [m] above the floor, between which a block begins to follow fingertips
BACK = 0.0005  # [m] by which slipping fingertips are brought back
PUSHED = 0.06  # [rad] that a command changes in a step while fingers press
ARRIVED, ALIGNED = 0.005, 0.06  # [m], [rad] of a block that is let go of
AGAIN, STUCK, RETREAT = 25, 100, 14
"""Control steps until another plan, until fingers count as stuck, and that they then go back."""


@final
class Feedback:
    """Takes block after block, the one with the lowest goal first, to its goal; holds the last one.

    It reads places, sizes, masses and friction of the blocks, and the robot's state. It chooses
    the faces to press and the fingers that do so, turns a block about the vertical if its goal
    asks for it, puts it down on the way if it cannot go there at once, makes way for it, and tries
    again when it has slipped. A block that lies on the wrong face stays on it. It is meant for
    pushing, picking, pick and place, and stacking two; where there are dozens of blocks it begins,
    and mostly does not finish.

    Its commands follow from the poses of bodies and from its last command, not from the time. So a
    network can imitate it, and it goes on from wherever somebody else has led. It remembers which
    block it takes, by which grip, and where to; all else is read in each step: fingertips go above
    the grip, down, towards the faces, and press; then the block goes towards its goal, higher than
    that as long as it is away from it. A command is the command before, corrected by a share of the
    error: so forces need not be known exactly.

    One instance serves any number of episodes and of worlds.

    Example:
        >>> from scm_world.queries import World
        >>> episode = World("picking").rollout(Feedback())
        >>> bool(episode.final("success"))
        True
    """

    def __init__(self) -> None:
        self._programs: WeakKeyDictionary[Any, tuple[Any, Program]] = WeakKeyDictionary()

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle without the present episode."""
        return Feedback, ()

    def __call__(self, world: Simulation) -> Floats:
        """Return the action of the present step.

        Raises:
            ActionError: Actions are torques, or the task has no blocks that have goals.
        """
        if world.options.action_mode == "joint_torques":
            problem = "a grasp needs joint or fingertip positions as actions, not torques"
            raise ActionError(problem, world.options.action_mode)
        episode, index = (world.noise.seed, world.episode), world.index
        expected, program = self._programs.get(world, (None, None))
        if program is None or expected != (episode, index):
            program = Program(world)
        self._programs[world] = (episode, index + 1), program
        command = program.command(world)
        tips = "effector" in world.options.action_mode
        return program.sight.tips_at(command).ravel() if tips else command

    def memory(self, world: Simulation) -> Floats:
        """Return its memory after the action of the present step: -1 for no, 1 for yes.

        Where a finger touches, and where the block is taken to, is not among it.

        Returns:
            Shape (n + 5,) where there are n blocks with goals: which of them it takes, which
            fingers take part, whether they let go, and whether they go back since they were stuck.
        """
        _, program = self._programs[world]
        move, pairs = program.move, program.sight.pairs
        used = move.grip.used if move is not None else (False,) * 3
        taken = [move is not None and tool == move.end.name for tool, _ in pairs]
        return np.where([*taken, *used, program.opens, program.back > 0], 1.0, -1.0)


@final
class Program:
    """The policy in one episode, and its memory: the job."""

    def __init__(self, world: Simulation) -> None:
        self.sight = Sight(world)
        self.move: Move | None = None
        self.opens = False  # whether fingers let go
        self.back = 0  # control steps for which they still go back since they were stuck
        self._goals: Any = None  # for which the job was chosen
        self._idle = self._waiting = 0

    def command(self, world: Simulation) -> Floats:
        """Compute the joint positions to command now, shape (9,) [rad]."""
        sight = self.sight
        sight.look(world)
        move, tips = self._planned(), sight.tips
        if self.back > 0 or move is None:
            place = sight.tips_at(np.array(hardware.REST)) if self.back > 0 else tips.copy()
            place[:, 2] = 0.12 if self.back > 0 else np.maximum(tips[:, 2], 0.09)
            self.back = max(self.back - 1, 0)
            return self._to(place, TRAVEL)
        body, grip = sight.body(move.end.name), move.grip
        own = body.own(tips)
        inward, away = np.sign(grip.inward), own - grip.touch
        across = -(away * inward).sum(axis=1)
        along = np.linalg.norm(away + across[:, None] * inward, axis=1)
        gap, side = across[grip.used].max(), along[grip.used].max()
        if self.opens:
            self._waiting += 1
            return self._to(grip.place(sight, body, grip.opening), CLOSE)
        holds = gap < TOUCHING and side < SLIPPED
        other = None if holds else held(body, own)
        if other is not None and (other.firm or not grip.firm):
            holds, move = True, replace(move, grip=other)
            self.move = move
        if holds:
            self._waiting = 0
            return self._carry(move, body)
        self._waiting += 1
        if gap < grip.opening + BESIDE and side < ASIDE:
            opening = float(np.interp(side, (STRAIGHT, OBLIQUE), (-INTO, float(grip.opening))))
            return self._to(grip.place(sight, body, opening), CLOSE)
        return self._to(self._way(move, body), TRAVEL)

    def _planned(self) -> Move | None:
        """Keep the job until the block has arrived or has fallen over, or a goal moves.

        Fingers that are stuck go back first.
        """
        sight, move, self._idle = self.sight, self.move, self._idle - 1
        goals = [(*goal.place, goal.yaw) for goal in (sight.body(name) for _, name in sight.pairs)]
        if move is not None:
            body, grip = sight.body(move.end.name), move.grip
            stuck = self._waiting > STUCK
            if stuck:
                self.back = RETREAT
            arrived = math.dist(move.end.place, body.place) < ARRIVED
            self.opens |= move.release and arrived and abs(_turn(move, body)) < ALIGNED
            away = np.abs(sight.tips - grip.place(sight, body, 0.0))[grip.used].max(axis=1)
            done = self.opens and away.min() > 0.8 * grip.opening
            if stuck or done or goals != self._goals or math.hypot(*body.lean) > 0.6:
                move = self.move = None
                self._idle = 0
        if move is None and self._idle <= 0 and self.back <= 0:
            self._idle, self._waiting, self.opens = AGAIN, 0, False
            self.move, self._goals = Choice(sight).move(), goals
        return self.move

    # --- fingers without a block -------------------------------------------------------------

    def _to(self, place: Floats, rate: float) -> Floats:
        """Bring fingertips nearer to places, shape (3, 3) [m]."""
        sight, tips = self.sight, self.sight.tips
        more = sight.more(FREE)
        last = tips + np.clip(sight.tips_at(sight.before - more) - tips, -AHEAD, AHEAD)
        way = place - tips
        farthest = float(np.linalg.norm(way, axis=1).max())
        return sight.command(last + way * min(FREE_GAIN, rate / max(farthest, 1e-9)), more)

    def _way(self, move: Move, body: Cuboid) -> Floats:
        """Choose where fingertips go that are not beside the block yet, shape (3, 3) [m].

        They go away from faces first, then up, then above the grip, then down a funnel.
        """
        tips, used = self.sight.tips, move.grip.used
        place = move.grip.place(self.sight, body, move.grip.opening)
        far = float(np.linalg.norm((place - tips)[used, :2], axis=1).max())
        rise = np.minimum(move.above - place[used, 2], FUNNEL * max(far - NEAR, 0.0))
        place[used, 2] += rise
        if far <= FAR:
            return place
        free = min(max((float(tips[used, 2].min()) - move.above + 0.035) / 0.02, 0.0), 1.0)
        if free == 1.0:
            return place
        own = body.own(tips)
        outside = np.abs(own[:, :2]) - body.half[:2]
        axis, each = outside.argmax(axis=1), np.arange(3)
        clear = outside[each, axis] - TIP_RADIUS
        normal = np.zeros((3, 3))
        normal[each, axis] = np.sign(own[each, axis])
        beside = np.clip((body.top + 0.01 - tips[:, 2]) / 0.01, 0.0, 1.0)
        push = np.clip((0.014 - clear) / 0.008, 0.0, 1.0) * beside
        back = tips + 0.02 * push[:, None] * (normal @ turn_about_z(body.yaw).T)
        up = float(np.clip(1.0 - beside * (0.008 - clear) / 0.006, 0.0, 1.0).min())
        place[:, :2] = free * place[:, :2] + (1.0 - free) * back[:, :2]
        place[:, 2] = up * place[:, 2] + (1.0 - up) * tips[:, 2]
        return place

    # --- fingers with a block ----------------------------------------------------------------

    def _carry(self, move: Move, body: Cuboid) -> Floats:
        """Press, and bring the block nearer to its end."""
        sight, grip, tool = self.sight, move.grip, body.name
        used, shares = grip.used, np.abs(grip.inward).max(axis=1)
        wanted, strength, follows = sight.wanted(tool), move.strength, 1.0
        turn = turn_about_z(body.yaw).T
        if sight.walls:  # a block that is carried over a wall must not slip
            strength = float(sight.strengths(sight.joints[None], (grip.inward @ turn)[None])[0])
            follows = float(np.interp(body.bottom, OFF, (0.0, 1.0)))
        press = min(PRESS if wanted < LIGHT else FIRMLY * wanted, strength)
        far = math.dist(body.place[:2], move.end.place[:2])
        lands = far < 2.0 * LANDING and max(body.bottom, move.end.bottom) < LANDING
        if not grip.firm and move.over and lands:  # near the floor, and near a goal on it
            press *= 1.0 - SOFT * min(math.hypot(*body.lean) / TILTED, 1.0)
        forces = press * grip.inward @ turn
        forces[:, 2] += sight.weight(tool) * shares / shares.sum()
        more = sight.more(forces)
        own = body.own(sight.tips)
        at = body.world(own + np.clip(grip.touch - own, -BACK, BACK))
        last = sight.tips_at(sight.before - more)
        lag = np.clip((last - at)[used].mean(axis=0), -LAG, LAG)
        lag[:2] *= follows
        middle = at[used].mean(axis=0)
        arms = at - middle
        across = np.stack([-arms[:, 1], arms[:, 0]], axis=-1)
        turned = (across * (last - at - lag)[:, :2])[used].sum() / (across**2)[used].sum()
        rate, turning = self._speed(move, body, press)
        yaw = follows * min(max(float(turned), -TWIST), TWIST)
        firmer = HOLD * (middle + lag + arms @ turn_about_z(yaw).T - last)
        aim = last + firmer + rate + arms @ (turn_about_z(yaw + turning) - turn_about_z(yaw)).T
        lean = 2.0 * GAIN * body.lean
        aim[:, :2] -= arms[:, 2:] * lean
        aim[:, 2] += arms[:, :2] @ lean
        aim[~used] = grip.place(sight, body, 0.0)[~used]
        return np.clip(sight.command(aim, more), sight.before - PUSHED, sight.before + PUSHED)

    def _speed(self, move: Move, body: Cuboid, press: float) -> tuple[Floats, float]:
        """Choose how a block moves in this control step, shape (3,) [m], and turns [rad]."""
        sight, error, turn = self.sight, move.end.place - body.place, _turn(move, body)
        far = math.hypot(error[0], error[1])
        burden = sight.burden(body.name) / max(press, 1e-9)
        pace = CARRY * max(min(max((0.7 - burden) / 0.5, 0.0), 1.0) ** 2, 0.3)
        height, most, least = move.height, RISE, RISE
        below = height - float(body.place[2])
        if move.over and sight.walls:
            walls = [sight.body(wall) for wall in sight.walls]
            ahead = np.array([*error[:2] / max(far, 1e-9), 0.0])
            soon, whole = (
                passing(body, np.linspace(0.0, reach, SAMPLES)[:, None] * ahead, walls)
                for reach in (min(SOON, far), far)
            )
            height = max(whole, float(body.half[2]) + CLEARANCE)
            below = soon - float(body.place[2]) if soon > 0.0 else 0.014 - body.bottom
            spare = sight.friction(body.name) * press * max(1.0 - burden, 0.0)
            most, least = min(max(spare / STIFF, SLOWEST), FASTEST), SINK
        elif not move.over:
            below = min(below, 0.014 - body.bottom)
        lifted = min(max((0.014 - below) / 0.006, 0.05), 1.0) if far > 0.015 else 1.0
        higher = min(max(max(far / 0.01, abs(turn) / 0.15) - 0.5, 0.0), 1.0)
        aim = move.end.place[2] + higher * max(height - move.end.place[2], 0.0)
        flat = error[:2] * min(GAIN, pace * lifted / max(far, 1e-9))
        rise = min(max(GAIN * (aim - body.place[2]), -least), most)
        turning = min(max(GAIN * turn, -TURN), TURN) * lifted * pace / CARRY
        return np.array([*flat, rise]), turning


def held(body: Cuboid, own: Floats) -> Grip | None:
    """Return how fingertips hold a block, from where they are in its frame, shape (3, 3) [m]."""
    each = np.arange(3)
    for axis in (0, 1):
        along, out = own[:, 1 - axis], body.half[axis] + TIP_RADIUS
        on_face = np.abs(np.delete(own, axis, axis=1)) < np.delete(body.half, axis) - EDGE
        touches = (np.abs(np.abs(own[:, axis]) - out) < TOUCHING) & on_face.all(axis=1)
        side = np.where(touches, np.sign(own[:, axis]), 0.0)
        one, two = side > 0.0, side < 0.0
        if one.any() and two.any() and abs(along[one].mean() - along[two].mean()) < UNEVEN:
            touch, inward = own.copy(), np.zeros((3, 3))
            touch[touches, axis] = side[touches] * out
            inward[each, axis] = two / two.sum() - one / one.sum()
            return Grip(touch, inward, touches, np.array(OPENINGS[0]))
    return None


def _turn(move: Move, body: Cuboid) -> float:
    """Compute how far a block has still to be turned [rad]."""
    return math.remainder(move.end.yaw - body.yaw, math.tau)
