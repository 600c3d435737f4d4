"""Pushing: bring a block on the floor to a goal on the floor."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import final

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.entities import Entity, GoalBlock, ToolBlock
from scm_world.entities.blocks import block_size
from scm_world.geometry.overlap import aabb_overlap_fraction
from scm_world.tasks import kernels
from scm_world.tasks.base import (
    SUCCESS,
    UNIT,
    Conventions,
    Observed,
    Task,
    above,
    observe_goal,
    observe_tool,
    reward,
    term,
)
from scm_world.variables import Box, Function, Integers, Measured, Parent, Variable
from scm_world.variables import catalogue as numbers

WEIGHTS = {
    "reward.tips_to_block": 750.0,
    "reward.block_to_goal": 250.0,
    "reward.orientation": 100.0,
    "fractional_success": 1.0,
}


@final
class Pushing(Task):
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
        weights: Weights of reward terms that differ from the published ones.
    """

    name = "pushing"
    seconds = 10.0

    def __init__(
        self,
        *,
        tool_block_mass: float = numbers.BLOCK_MASS,
        weights: Mapping[str, float] | None = None,
    ) -> None:
        self.weights = {**WEIGHTS, **(weights or {})}
        self._tool = ToolBlock(
            "tool_block",
            size_from="block.size",
            mass=tool_block_mass,
            place=(0.0, -0.08, 0.0),
            a=_on_the_floor("tool_block.size", numbers.RADIUS_A),
            b=_on_the_floor("tool_block.size", numbers.RADIUS_B),
        )
        self._goal = GoalBlock(
            "goal_block",
            size_from="block.size",
            polar=(0.08, np.pi / 2),
            a=_on_the_floor("goal_block.size", numbers.RADIUS_A),
            b=_on_the_floor("goal_block.size", numbers.RADIUS_B),
        )

    def entities(self) -> Iterable[Entity]:
        """A block and its goal."""
        return (self._tool, self._goal)

    def shared(self) -> Iterable[Variable]:
        """One size for both."""
        yield block_size("block.size", None)

    def readouts(self, conventions: Conventions) -> Iterable[Variable]:
        """Declare reward terms and success."""
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
        yield Measured(
            name="fractional_success",
            bounds=None if conventions.aligned_boxes else UNIT,
            parents=tuple(
                f"{entity}.{quantity}"
                for entity in ("tool_block", "goal_block")
                for quantity in ("size", "cartesian_position", "orientation")
            ),
            mechanism=aligned if conventions.aligned_boxes else kernels.filled,
            doc="Fraction of the goal's volume that the block fills.",
        )
        yield Measured(
            name="success",
            dtype="integer",
            bounds=Integers(0, 1),
            parents=("fractional_success",),
            mechanism=Function(above, constants={"threshold": SUCCESS}),
            doc="1 where more than nine tenths of the goal are filled.",
        )
        yield reward(self.weights)

    def observed(self) -> Iterable[Observed]:
        """Observe the block, then the goal."""
        yield from observe_tool("tool_block")
        yield from observe_goal("goal_block")

    def goals(self, values: Values) -> tuple[Floats, Floats]:
        """Give position and quaternion of the block and of the goal, shape (7,) each."""
        block = (values["tool_block.cartesian_position"], values["tool_block.orientation"])
        goal = (values["goal_block.cartesian_position"], values["goal_block.orientation"])
        return np.concatenate(block), np.concatenate(goal)

    def solution(self, values: Values) -> dict[str, Value]:
        """Put the block where the goal is."""
        return {
            f"tool_block.{quantity}": values[f"goal_block.{quantity}"]
            for quantity in ("cartesian_position", "orientation")
        }


def _on_the_floor(size: str, radii: tuple[float, float]) -> Box:
    """Give the cylindrical positions of a block that stands on the floor."""
    height = numbers.half_height(size)
    return numbers.cylindrical(radii, height, height)


def aligned(
    size: Floats,
    position: Floats,
    orientation: Floats,
    goal_size: Floats,
    goal_position: Floats,
    goal_orientation: Floats,
) -> float:
    """Compute the predecessor's overlap: of the axis-aligned hulls, not capped."""
    block = (size[None], position[None], orientation[None])
    goal = (goal_size[None], goal_position[None], goal_orientation[None])
    return aabb_overlap_fraction(*block, *goal)
