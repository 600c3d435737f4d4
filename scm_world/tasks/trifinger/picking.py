"""Picking: lift a block from the floor to a goal in the air."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Unpack, final

import numpy as np

from scm_world._types import Floats, Value
from scm_world.geometry.coordinates import from_cylindrical
from scm_world.tasks.composition import Entity
from scm_world.tasks.rewards import weighted
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger import kernels, shaping
from scm_world.tasks.trifinger.base import TriFingerTask
from scm_world.tasks.trifinger.entities.goals import goal_position
from scm_world.tasks.trifinger.shapes import Place
from scm_world.tasks.trifinger.single import (
    BLOCK,
    GOAL,
    TARGET,
    TIPS_TO_BLOCK,
    TOOL,
    WAS,
    Alike,
    OneBlock,
)
from scm_world.variables import Box, Function

HEIGHT = f"{GOAL}.height"
HEIGHT_A = (0.08, 0.2)  # [m] of the center of the goal
HEIGHT_B = (0.2, 0.25)
HEIGHTS = numbers.Range(Box(0.0, 0.5), Box(*HEIGHT_A), Box(*HEIGHT_B), "m")


def lifted(height: Value, *, place: Floats) -> Floats:
    """Put something at a height above a place (x and y), shape (..., 3) [m]."""
    at = np.broadcast_to(place, (*np.shape(height), 2))
    return np.concatenate([at, np.asarray(height)[..., None]], axis=-1)


def put(*parents: Floats, center: Floats) -> Floats:
    """Put a block at its place, however large it is and however it is turned, shape (3,) [m].

    Source: CausalWorld 1.2: in picking alone, blocks that grow reach into the floor.
    """
    return np.array(center)


def above_the_center(cylindrical: Floats) -> Floats:
    """Put a goal above the centre of the arena, at the height of a cylindrical position [m].

    Source: CausalWorld 1.2, ``task_generators/picking.py``,
    ``_handle_contradictory_interventions``; radius and azimuth are ignored.
    """
    return np.asarray(cylindrical, dtype=np.float64) * (0.0, 0.0, 1.0)


@final
class Picking(TriFingerTask):
    """A block on the floor, and a goal of the same size in the air above its place.

    The blocks share the parent ``block.size``. How high the goal is does not depend on it.

    Args:
        tool_block_position: Where the center of the block begins: x and y if it stands on the
            floor, or x, y and z [m]. The goal is above it.
        goal_height: Default height of the center of the goal [m].
        options: Of block, goal and every task; see ``Alike`` and ``Common``.
    """

    name = "picking"
    default_weights, dense_terms = weighted(
        (250.0, "block_to_height", kernels.height_progress, (BLOCK, WAS, TARGET)),
        (0.0, "height_error", kernels.minus_height_error, (BLOCK, TARGET)),
        (125.0, "block_to_center", kernels.centering_progress, (BLOCK, WAS)),
        (0.0, "center_distance", kernels.minus_eccentricity, (BLOCK,)),
        (750.0, *TIPS_TO_BLOCK),
        (0.0, "tips_distance", kernels.minus_tips_distance, (shaping.TIPS, BLOCK)),
        (0.0, "grasp", kernels.minus_grasp_distance, (shaping.TIPS, BLOCK, f"{TOOL}.size")),
        (0.005, *shaping.SMOOTHNESS),
        fraction=1.0,
    )
    options = Alike
    ready_terms = shaping.ONE_BLOCK
    goal_causes: tuple[str, ...] = (HEIGHT,)

    def __init__(
        self,
        *,
        tool_block_position: Place = (0.0, 0.0),
        goal_height: float = 0.15,
        **options: Unpack[Alike],
    ) -> None:
        self.block = OneBlock(tool_block_position, options)
        super().__init__(**self.block.common)
        self.goal_causes = self.block.causes(self.goal_causes)
        self._height = HEIGHTS.option(HEIGHT, goal_height, "Height of its center.", "goal_height")

    def entities(self) -> Iterable[Entity]:
        """A block and its goal."""
        published = self.conventions.published
        center = (*self.block.place[:2], self.block.place[2] + self.block.below(TOOL))
        yield self.block.tool(
            spaces=numbers.places(self.block.level(TOOL), airborne=published),
            start=Function(put, constants={"center": center}) if published else None,
        )
        yield self.block.goal(
            self._height,
            goal_position(
                GOAL,
                parents=(HEIGHT,),
                mechanism=Function(lifted, constants={"place": self.block.place[:2]}),
            ),
            spaces=self._above(),
            inverse=above_the_center if published else from_cylindrical,
        )

    def _above(self) -> tuple[Box, Box]:
        """Return the cylindrical positions above the block's place; at radius 0 any angle will do.

        The predecessor publishes wider spaces, and moves every value that is drawn or set above the
        centre of the arena; see ``above_the_center``.
        """
        if self.conventions.published:
            return (
                numbers.cylindrical(numbers.RADIUS_A, *HEIGHT_A),
                numbers.cylindrical(numbers.RADIUS_B, *HEIGHT_B),
            )
        x, y, _ = self.block.place
        radius, angle = math.hypot(x, y), math.atan2(y, x)
        low, high = (angle, angle) if radius > 0.0 else (-math.pi, math.pi)
        a, b = (
            Box((radius, low, bottom), (radius, high, top)) for bottom, top in (HEIGHT_A, HEIGHT_B)
        )
        return a, b
