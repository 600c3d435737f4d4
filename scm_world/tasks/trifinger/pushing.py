"""Pushing: bring a block on the floor to a goal on the floor."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Unpack, final

from scm_world.tasks.composition import Entity
from scm_world.tasks.rewards import weighted
from scm_world.tasks.trifinger import kernels, shapes, shaping
from scm_world.tasks.trifinger.base import TriFingerTask
from scm_world.tasks.trifinger.entities.goals import goal_position, polar, turned_on_the_floor
from scm_world.tasks.trifinger.shapes import Place
from scm_world.tasks.trifinger.single import (
    BLOCK,
    GOAL,
    TARGET,
    TIPS_TO_BLOCK,
    TURNED,
    WAS,
    Alike,
    OneBlock,
)
from scm_world.variables import Function


@final
class Pushing(TriFingerTask):
    """One tool block and one goal block of the same size, both on the floor.

    The blocks share the parent ``block.size``. An intervention on it keeps them alike; one on
    the pose of one leaves the other where it is.

    Args:
        tool_block_position: Where the center of the block begins: x and y if it stands on the
            floor, or x, y and z [m].
        goal_block_position: Default x and y of the goal, which is on the floor [m].
        options: Of block, goal and every task; see ``Alike`` and ``Common``.
    """

    name = "pushing"
    default_weights, dense_terms = weighted(
        (750.0, *TIPS_TO_BLOCK),
        (250.0, "block_to_goal", kernels.block_progress, (BLOCK, WAS, TARGET)),
        (100.0, *TURNED),
        fraction=1.0,
    )
    paper_weights = {"reward.orientation": 0.0}  # noqa: RUF012 # a constant
    options = Alike
    ready_terms = shaping.ONE_BLOCK
    goal_causes: tuple[str, ...] = ("goal_block.polar", "goal_block.euler_orientation")

    def __init__(
        self,
        *,
        tool_block_position: Place = (0.0, -0.08),
        goal_block_position: Place = (0.0, 0.08),
        **options: Unpack[Alike],
    ) -> None:
        self.block = OneBlock(tool_block_position, options)
        super().__init__(**self.block.common)
        self.goal_causes = self.block.causes(self.goal_causes)
        self._polar = self.block.floor_polar(goal_block_position)

    def entities(self) -> Iterable[Entity]:
        """A block and its goal."""
        yield self.block.tool()
        rests = turned_on_the_floor if self.shape is None else shapes.hull_on_the_floor
        yield self.block.goal(
            polar(GOAL, self._polar),
            goal_position(
                GOAL, parents=(f"{GOAL}.polar", *self.block.form(GOAL)), mechanism=Function(rests)
            ),
        )
