"""What a policy that grasps sees of a world."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, final

import numpy as np

from scm_world._types import Floats, Value
from scm_world.errors import ActionError
from scm_world.geometry import overlap_volume
from scm_world.tasks.trifinger.grasping.bodies import Body, body_of
from scm_world.tasks.trifinger.grasping.hand import Hand

LEAST_FRICTION = 0.05
"""Friction that is reckoned with at least, so that no force is infinite."""

FIRM = 0.6  # [N] with which even a block without weight is pressed
MARGIN = 2.0
"""How many times the force that just carries a block it is pressed with, besides."""

_POSE = ("size", "cartesian_position", "orientation")


@final
class Sight:
    """The present of a world, looked at once per control step.

    Args:
        world: With blocks that have goals.

    Attributes:
        hand: The robot.
        joints: Its joint positions, shape (9,) [rad].
        pairs: Blocks, each with its goal.
        left: How many control steps the episode still has.

    Raises:
        ActionError: The task of the world has no blocks with goals.
    """

    hand: Hand
    joints: Floats
    pairs: tuple[tuple[str, str], ...]

    def __init__(self, world: Any) -> None:
        self._version = -1
        self.look(world)

    def look(self, world: Any) -> None:
        """See how things are now."""
        self._values: Mapping[str, Value] = world.evaluate(())
        self.joints = np.array(self._values["joint_positions"])
        self.left = world.max_episode_length - world.index
        if self._version != world.version:
            self._version = world.version
            self._learn(world)

    def _learn(self, world: Any) -> None:
        """See what moves only when someone intervenes."""
        self.hand = Hand(self._values, world.control_period)
        self._solid = (*world.composition.blocks, *world.composition.obstacles)
        task = world.compiled.task
        targets = task.targets()
        self.pairs = tuple(
            (tool, goal)
            for goal, tool in targets.items()
            if tool in self._solid and f"{goal}.size" in self._values
        )
        if not self.pairs:
            problem = f"a grasp needs blocks that have goals; {task.name!r} has none"
            raise ActionError(problem, None)

    def body(self, name: str) -> Body:
        """See a block, a goal or an obstacle."""
        return body_of(name, self._values)

    def solid(self) -> dict[str, Body]:
        """See everything that fingers could run into, by name."""
        return {name: self.body(name) for name in self._solid}

    def filled(self, tool: str, goal: str) -> float:
        """Compute which share of a goal its block fills."""
        poses = (self._values[f"{name}.{part}"] for name in (tool, goal) for part in _POSE)
        return float(overlap_volume(*poses)) / float(np.prod(self._values[f"{goal}.size"]))

    def weight(self, tool: str) -> float:
        """Compute the weight of a block [N]."""
        return float(self._values[f"{tool}.mass"]) * -float(self._values["gravity"][2])

    def burden(self, tool: str) -> float:
        """Compute with which force a block must be pressed from both sides to be carried [N]."""
        friction = float(self._values["finger_friction"]) * float(self._values[f"{tool}.friction"])
        return abs(self.weight(tool)) / (2.0 * max(friction, LEAST_FRICTION))

    def wanted(self, tool: str) -> float:
        """Choose with which force a block should be pressed [N]."""
        return FIRM + MARGIN * self.burden(tool)
