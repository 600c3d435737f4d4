"""Pushing: bring a block on the floor to a goal on the floor."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Unpack, final

import numpy as np

from scm_world.entities import Entity, GoalBlock, ToolBlock, block_mass, block_size
from scm_world.entities.goals import goal_orientation, goal_position, on_the_floor, polar
from scm_world.tasks import kernels
from scm_world.tasks.building import Building
from scm_world.tasks.rewards import Common, term
from scm_world.variables import Box, Function, Parent, Variable
from scm_world.variables import catalogue as numbers

SIZE = "block.size"


@final
class Pushing(Building):
    """One tool block and one goal block of the same size, both on the floor.

    The blocks share the parent ``block.size``. An intervention on it keeps them alike; one on
    the pose of one leaves the other where it is.

    Reward terms:
        reward.tips_to_block: How much nearer the three fingertips came to the block [m].
        reward.block_to_goal: How much nearer the block came to the goal [m].
        reward.orientation: By how much the angle between block and goal shrank [rad].
        fractional_success: How much of the goal the block fills.

    Args:
        tool_block_mass: Default mass of the block [kg].
        tool_block_position: Where its center begins, x and y; it stands on the floor [m].
        goal_polar: Default radius [m] and angle [rad] of the goal.
        common: Options of every task; see ``Common``.
    """

    name = "pushing"
    default_weights = {  # noqa: RUF012 # a constant
        "reward.tips_to_block": 750.0,
        "reward.block_to_goal": 250.0,
        "reward.orientation": 100.0,
        "fractional_success": 1.0,
    }
    paper_weights = {"reward.orientation": 0.0}  # noqa: RUF012 # a constant
    goal_causes = ("goal_block.polar", "goal_block.euler_orientation")

    def __init__(
        self,
        *,
        tool_block_mass: float = numbers.BLOCK_MASS,
        tool_block_position: tuple[float, float] = (0.0, -0.08),
        goal_polar: tuple[float, float] = (0.08, np.pi / 2),
        **common: Unpack[Common],
    ) -> None:
        super().__init__(**common)
        self._mass = tool_block_mass
        self._place = (*tool_block_position, 0.0)
        self._polar = goal_polar

    def tools(self) -> tuple[str, ...]:
        """One block."""
        return ("tool_block",)

    def targets(self) -> dict[str, str]:
        """One goal."""
        return {"goal_block": "tool_block"}

    def entities(self) -> Iterable[Entity]:
        """A block and its goal."""
        yield ToolBlock(
            "tool_block",
            size=block_size("tool_block.size", SIZE),
            mass=block_mass("tool_block.mass", default=self._mass),
            place=self._place,
            a=floor_level("tool_block.size", numbers.RADIUS_A),
            b=floor_level("tool_block.size", numbers.RADIUS_B),
        )
        yield GoalBlock(
            "goal_block",
            size=block_size("goal_block.size", SIZE),
            pose=(
                polar("goal_block", self._polar, a=numbers.POLAR_A, b=numbers.POLAR_B),
                goal_position(
                    "goal_block",
                    parents=("goal_block.polar", "goal_block.size"),
                    mechanism=Function(on_the_floor),
                ),
                goal_orientation("goal_block"),
            ),
            a=floor_level("goal_block.size", numbers.RADIUS_A),
            b=floor_level("goal_block.size", numbers.RADIUS_B),
        )

    def shared(self) -> Iterable[Variable]:
        """One size for both."""
        yield block_size(SIZE)

    def dense(self) -> Iterable[Variable]:
        """Declare how the fingers and the block come nearer."""
        tips, block = "end_effector_positions", "tool_block.cartesian_position"
        turn, goal = "tool_block.orientation", "goal_block.cartesian_position"
        yield term(
            "reward.tips_to_block",
            kernels.tips_progress,
            (tips, Parent(tips, 1), block, Parent(block, 1)),
            "How much nearer the fingertips came to the block [m].",
        )
        yield term(
            "reward.block_to_goal",
            kernels.block_progress,
            (block, Parent(block, 1), goal),
            "How much nearer the block came to the goal [m].",
        )
        yield term(
            "reward.orientation",
            kernels.turn_progress,
            (turn, Parent(turn, 1), "goal_block.orientation"),
            "By how much the angle between block and goal shrank [rad].",
        )


def floor_level(size: str, radii: tuple[float, float]) -> Box:
    """Give the cylindrical positions of a block that stands on the floor.

    Args:
        size: Name of the variable that holds its edge lengths.
        radii: Least and greatest distance from the middle [m].
    """
    height = numbers.half_height(size)
    return numbers.cylindrical(radii, height, height)
