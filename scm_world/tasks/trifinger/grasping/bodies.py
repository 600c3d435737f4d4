"""The scene of a policy that grasps: boxes on a table, and the hand above them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, final

import numpy as np

from scm_world._types import Floats, Value
from scm_world.errors import ActionError
from scm_world.geometry import from_rotation_vector
from scm_world.tasks.trifinger import kernels
from scm_world.tasks.trifinger.grasping.hand import Hand
from scm_world.tasks.trifinger.views import upright

QUARTER = math.pi / 2.0
ALIKE = 0.003  # [m] by which edges may differ of which one may stand for the other


def turn_about_z(yaw: float) -> Floats:
    """Give the axes of something turned about the vertical as columns, shape (3, 3)."""
    sine, cosine = math.sin(yaw), math.cos(yaw)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def smallest(angle: float, period: float = 2.0 * math.pi) -> float:
    """Bring an angle nearest to zero by whole periods [rad]."""
    return angle - period * round(angle / period)


@final
@dataclass(frozen=True)
class Cuboid:
    """A box that stands on one of its faces.

    Attributes:
        name: Of block, obstacle or goal.
        half: Half its edges: along its own x and y, and upwards, shape (3,) [m].
        place: Its center, shape (3,) [m].
        yaw: Of its own x from that of the world [rad].
        lean: x and y of the unit vector that points upwards in it, shape (2,).
    """

    name: str
    half: Floats
    place: Floats
    yaw: float
    lean: Floats = field(default_factory=lambda: np.zeros(2))

    @property
    def top(self) -> float:
        """Height of its upper face [m]."""
        return float(self.place[2] + self.half[2])

    @property
    def bottom(self) -> float:
        """Height of its lower face [m]."""
        return float(self.place[2] - self.half[2])

    def at(self, place: Floats, yaw: float) -> Cuboid:
        """Put it elsewhere."""
        return replace(self, place=place, yaw=yaw)

    def world(self, points: Floats) -> Floats:
        """Turn points of its own frame, shape (n, 3), into points of the world [m]."""
        return self.place + points @ turn_about_z(self.yaw).T

    def own(self, points: Floats) -> Floats:
        """Turn points of the world, shape (n, 3), into points of its own frame [m]."""
        return (points - self.place) @ turn_about_z(self.yaw)

    def depth_in(self, other: Cuboid, *, margin: float = 0.0, flat: bool = False) -> float:
        """Compute how deep it lies in another one [m]: the least overlap along all axes.

        Args:
            other: The other one.
            margin: By which its sides are moved outwards [m].
            flat: Whether heights are left aside.
        """
        between = turn_about_z(self.yaw - other.yaw)[:2, :2]
        mine, its = self.half[:2] + margin, other.half[:2]
        along_mine = mine + abs(between.T) @ its - abs(self.own(other.place)[:2])
        along_its = its + abs(between) @ mine - abs(other.own(self.place)[:2])
        high = min(self.top - other.bottom, other.top - self.bottom)
        return float(min(*along_mine, *along_its, *[high] * (not flat)))

    def fills(self, goal: Cuboid) -> float:
        """Compute which share of a goal it fills."""
        poses = (
            part
            for body in (self, goal)
            for part in (2.0 * body.half, body.place, from_rotation_vector([0.0, 0.0, body.yaw]))
        )
        return float(kernels.filled(*poses, tools=1.0))


def body_of(name: str, values: Mapping[str, Value]) -> Cuboid:
    """See a box: which of its faces is below, and how it is turned about the vertical."""
    orientation = np.asarray(values[f"{name}.orientation"], dtype=np.float64)
    up, yaw, lean_x, lean_y = upright(orientation)
    edges = [(up + 1) % 3, (up + 2) % 3, up]
    half = 0.5 * np.asarray(values[f"{name}.size"], dtype=np.float64)[edges]
    place = np.array(values[f"{name}.cartesian_position"], dtype=np.float64)
    return Cuboid(name, half, place, yaw, np.array([lean_x, lean_y]))


def turns(block: Cuboid, goal: Cuboid) -> tuple[float, ...]:
    """List by how much a block may be turned to stand like its goal, the least first [rad].

    A box looks the same after half a turn, and after a quarter if it is as wide as it is deep.
    """
    gap = goal.yaw - block.yaw
    straight = abs(block.half[:2] - goal.half[:2]).max()
    across = abs(block.half[:2] - goal.half[1::-1]).max()
    found = [smallest(gap + QUARTER * quarter) for quarter in range(4)]
    fitting = [
        turn
        for quarter, turn in enumerate(found)
        if (across if quarter % 2 else straight) <= min(straight, across) + ALIKE
    ]
    return tuple(sorted(fitting, key=abs))


LEAST_FRICTION = 0.05
"""Friction that is reckoned with at least, so that no force is infinite."""

FIRM = 0.6  # [N] with which even a block without weight is pressed
MARGIN = 2.0
"""Pressing force, as a multiple of the force that just carries a block."""


@final
class Sight:
    """The present of a world, read once per control step.

    Args:
        world: With blocks that have goals.

    Attributes:
        hand: The robot.
        joints: Its joint positions, shape (9,) [rad].
        pairs: Blocks, each with its goal.
        walls: What stands in the way and is not moved.
        left: How many control steps the episode still has.

    Raises:
        ActionError: The task of the world has no blocks with goals.
    """

    hand: Hand
    joints: Floats
    pairs: tuple[tuple[str, str], ...]
    walls: tuple[str, ...]

    def __init__(self, world: Any) -> None:
        self._version = -1
        self.look(world)

    def look(self, world: Any) -> None:
        """See how things are now."""
        self._values: Mapping[str, Value] = world.evaluate(())
        self.joints = np.array(self._values["joint_positions"])
        self.left = world.max_episode_length - world.index
        if self._version == world.version:
            return  # all else moves only when someone intervenes
        self._version, task = world.version, world.compiled.task
        self.hand = Hand(self._values)
        self.walls = world.composition.obstacles
        self._solid = (*world.composition.blocks, *self.walls)
        self.pairs = tuple(
            (tool, goal)
            for goal, tool in task.goal.targets.items()
            if tool in self._solid and f"{goal}.size" in self._values
        )
        if not self.pairs:
            problem = f"a grasp needs blocks that have goals; {task.name!r} has none"
            raise ActionError(problem, None)

    def body(self, name: str) -> Cuboid:
        """See a block, a goal or an obstacle."""
        return body_of(name, self._values)

    def solid(self) -> dict[str, Cuboid]:
        """See everything that fingers could run into, by name."""
        return {name: self.body(name) for name in self._solid}

    def weight(self, tool: str) -> float:
        """Compute the weight of a block [N]."""
        return float(self._values[f"{tool}.mass"]) * -float(self._values["gravity"][2])

    def burden(self, tool: str) -> float:
        """Compute with which force a block must be pressed from both sides to be carried [N]."""
        return abs(self.weight(tool)) / (2.0 * self.friction(tool))

    def friction(self, tool: str) -> float:
        """Return the friction of a block and a fingertip."""
        friction = float(self._values["finger_friction"]) * float(self._values[f"{tool}.friction"])
        return max(friction, LEAST_FRICTION)

    def wanted(self, tool: str) -> float:
        """Choose with which force a block should be pressed [N]."""
        return FIRM + MARGIN * self.burden(tool)


def instant(world: Any) -> tuple[int, int, int]:
    """Return which episode it is, as seed and number, and which of its control steps."""
    return world.noise.seed, world.episode, world.index
