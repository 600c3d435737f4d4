"""The scene of a policy that grasps: boxes on a table, and the robot above them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, final

import numpy as np

from scm_world._types import Floats, Value
from scm_world.errors import ActionError
from scm_world.geometry.rotations import from_rotation_vector
from scm_world.tasks.trifinger import hardware, kernels
from scm_world.tasks.trifinger.grasping.hand import torques
from scm_world.tasks.trifinger.kinematics import N_FINGERS, forward_kernel, inverse_kernel
from scm_world.tasks.trifinger.types import parts_of
from scm_world.tasks.trifinger.views import QUARTER, upright

if TYPE_CHECKING:
    from scm_world.tasks.base import Simulation

ALIKE = 0.003  # [m] by which edges may differ of which one may stand for the other
LEAST_FRICTION = 0.05  # that is reckoned with, so that no force is infinite
FIRM = 0.6  # [N] with which even a block without weight is pressed
MARGIN = 2.0  # pressing force, as a multiple of the force that just carries a block
STRENGTH = 0.97  # share of the largest torque that a finger may be asked for
LEAST_GAIN = 1e-3  # [N m/rad] of a controller that can be commanded


def turn_about_z(yaw: float) -> Floats:
    """Return the axes of something turned about the vertical as columns, shape (3, 3)."""
    sine, cosine = math.sin(yaw), math.cos(yaw)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


@final
@dataclass(frozen=True)
class Cuboid:
    """A box that stands on one of its faces: a block, an obstacle or a goal."""

    name: str
    half: Floats  # [m] half its edges: along its own x and y, and upwards
    place: Floats  # [m] its center
    yaw: float  # [rad] of its own x from that of the world
    lean: Floats = field(default_factory=lambda: np.zeros(2))
    """x and y of the unit vector that points upwards in it."""

    @property
    def top(self) -> float:
        """Height of its upper face [m]."""
        return float(self.place[2] + self.half[2])

    @property
    def bottom(self) -> float:
        """Height of its lower face [m]."""
        return float(self.place[2] - self.half[2])

    def at(self, place: Floats, yaw: float) -> Cuboid:
        """Return it elsewhere."""
        return replace(self, place=place, yaw=yaw)

    def world(self, points: Floats) -> Floats:
        """Turn points of its own frame, shape (n, 3), into points of the world [m]."""
        return self.place + points @ turn_about_z(self.yaw).T

    def own(self, points: Floats) -> Floats:
        """Turn points of the world, shape (n, 3), into points of its own frame [m]."""
        return (points - self.place) @ turn_about_z(self.yaw)

    def depth_in(self, other: Cuboid, *, margin: float = 0.0, flat: bool = False) -> float:
        """Compute how deep it lies in another one [m]: the least overlap along all axes.

        Sides are moved outwards by ``margin`` [m]; heights do not count where it is ``flat``.
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

    def turns(self, goal: Cuboid) -> list[float]:
        """List by how much it may be turned to stand like its goal, the least first [rad].

        A box looks the same after half a turn, and after a quarter if it is as wide as it is deep.
        """
        straight, across = (abs(self.half[:2] - goal.half[own]).max() for own in ([0, 1], [1, 0]))
        most = min(straight, across) + ALIKE
        fitting = [n for n in range(4) if (across if n % 2 else straight) <= most]
        gaps = (goal.yaw - self.yaw + QUARTER * quarters for quarters in fitting)
        return sorted((math.remainder(gap, math.tau) for gap in gaps), key=abs)


def body_of(name: str, values: Mapping[str, Value]) -> Cuboid:
    """Return a box as it is: which of its faces is below, and how it is turned about z."""
    up, yaw, *lean = upright(np.asarray(values[f"{name}.orientation"], dtype=np.float64))
    edges = [(up + 1) % 3, (up + 2) % 3, up]
    half = 0.5 * np.asarray(values[f"{name}.size"], dtype=np.float64)[edges]
    place = np.array(values[f"{name}.cartesian_position"], dtype=np.float64)
    return Cuboid(name, half, place, yaw, np.array(lean))


@final
class Sight:
    """The present of a world with blocks that have goals, read once per control step.

    Raises:
        ActionError: The task of the world has no blocks with goals.
    """

    def __init__(self, world: Simulation) -> None:
        self._version = -1
        self.look(world)

    def look(self, world: Simulation) -> None:
        """Read how things are now."""
        values: Mapping[str, Value] = world.evaluate(())
        self._values = values
        self.left = world.max_episode_length - world.index  # control steps of the episode
        self.joints = np.array(values["joint_positions"])  # (9,) [rad]
        if self._version != world.version:  # all else moves only when someone intervenes
            self._intervened(world, values)
        self.tips = self.tips_at(self.joints)
        self.before = self.joints  # the last command, if any
        if world.index > 0:
            last = np.array(world.evaluate(("action",))["action"])
            self.before = self.solve(last) if "effector" in world.options.action_mode else last

    def _intervened(self, world: Simulation, values: Mapping[str, Any]) -> None:
        self._version, task = world.version, world.compiled.task
        self.height = float(values["robot_height"])  # [m]
        self._gains = np.tile(np.maximum(values["position_gains"], LEAST_GAIN), N_FINGERS)
        self._limit = STRENGTH * float(values["torque_limit"])
        self.weights = np.zeros((N_FINGERS, 3, 3))  # [N] that carry the fingers; see ``torques``
        for finger, name in enumerate(hardware.FINGERS):
            links = [values[f"{hardware.link_name(name, link)}.mass"] for link in (2, 3)]
            masses = np.array([*links, hardware.TIP_MASS], dtype=np.float64)
            self.weights[finger, :, 2] = -float(values["gravity"][2]) * masses
        self.aside = self.tips_at(np.array(hardware.ASIDE))  # where unused fingertips are
        self.walls = parts_of(world).obstacles  # names of obstacles that are not moved
        self.solid = (*parts_of(world).blocks, *self.walls)  # of all that fingers could run into
        self.pairs = [  # blocks, each with its goal
            (tool, goal)
            for goal, tool in task.goal.targets.items()
            if tool in self.solid and f"{goal}.size" in values
        ]
        if not self.pairs:
            problem = f"a grasp needs blocks that have goals; {task.name!r} has none"
            raise ActionError(problem, None)

    # --- bodies -------------------------------------------------------------------------------

    def body(self, name: str) -> Cuboid:
        """Return a block, a goal or an obstacle."""
        return body_of(name, self._values)

    def weight(self, tool: str) -> float:
        """Compute the weight of a block [N]."""
        return float(self._values[f"{tool}.mass"]) * -float(self._values["gravity"][2])

    def friction(self, tool: str) -> float:
        """Return the friction of a block and a fingertip."""
        friction = float(self._values["finger_friction"]) * float(self._values[f"{tool}.friction"])
        return max(friction, LEAST_FRICTION)

    def burden(self, tool: str) -> float:
        """Compute with which force a block must be pressed from both sides to be carried [N]."""
        return abs(self.weight(tool)) / (2.0 * self.friction(tool))

    def wanted(self, tool: str) -> float:
        """Choose with which force a block should be pressed [N]."""
        return FIRM + MARGIN * self.burden(tool)

    # --- fingers ------------------------------------------------------------------------------

    def tips_at(self, joints: Floats) -> Floats:
        """Compute where fingertips are, shape (3, 3) [m]."""
        return forward_kernel(joints, self.height).reshape(3, 3)

    def solve(self, tips: Floats) -> Floats:
        """Compute the joints for fingertips, shape (9,) [rad], as near as they are reached."""
        return inverse_kernel(tips.ravel(), self.height, self.joints)[0]

    def more(self, forces: Floats) -> Floats:
        """Compute what joints need in addition to carry the fingers and press, shape (9,) [rad].

        The controller is a damped spring without gravity compensation. The forces are those on
        what fingertips touch, shape (3, 3) [N].
        """
        exerted = self.weights.copy()
        exerted[:, 2] += forces
        (needed,) = torques(self.joints[None], self.height, exerted[None])
        added: Floats = np.minimum(np.maximum(needed, -self._limit), self._limit) / self._gains
        return added

    def command(self, tips: Floats, more: Floats) -> Floats:
        """Compute the joint positions to command for fingertips, shape (9,) [rad]."""
        return np.clip(self.solve(tips) + more, hardware.JOINT_LOW, hardware.JOINT_HIGH)

    def strengths(self, joints: Floats, forces: Floats) -> Floats:
        """Compute how many times fingertips can exert forces, shape (n, 3, 3), at joints (n, 9)."""
        exerted = np.zeros((len(joints), N_FINGERS, 3, 3))
        own = torques(joints, self.height, exerted + self.weights)
        exerted[:, :, 2] = forces
        unit = torques(joints, self.height, exerted)
        room, need = self._limit - own * np.sign(unit), np.abs(unit)
        times = np.divide(room, need, out=np.full_like(need, math.inf), where=need > 1e-9)
        strengths: Floats = np.maximum(times.min(axis=1), 0.0)
        return strengths
