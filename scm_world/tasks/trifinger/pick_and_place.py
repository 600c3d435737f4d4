"""Pick and place: bring a block over a wall to a goal on the other side."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Unpack, final

import numpy as np

from scm_world._types import Floats, Value
from scm_world.tasks.composition import Entity
from scm_world.tasks.rewards import FRACTION, weighted
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger import kernels, shapes, shaping
from scm_world.tasks.trifinger.base import TriFingerTask
from scm_world.tasks.trifinger.entities.blocks import stand
from scm_world.tasks.trifinger.entities.goals import goal_position, polar, turned_on_the_floor
from scm_world.tasks.trifinger.entities.obstacles import obstacle
from scm_world.tasks.trifinger.shapes import Place
from scm_world.tasks.trifinger.single import (
    BLOCK,
    GOAL,
    TARGET,
    TIPS_TO_BLOCK,
    TOOL,
    TURNED,
    WAS,
    Alike,
    OneBlock,
)
from scm_world.variables import Box, Function, Switch, Variable

WALL = "obstacle"
SIDE = "wall_side"

WALL_SIZE = (0.5, 0.015, 0.065)  # [m]
WALL_A = Box((0.5, 0.015, 0.02), (0.5, 0.015, 0.065))
WALL_B = Box((0.5, 0.015, 0.065), (0.5, 0.015, 0.1))
RADIUS_A = (0.07, 0.12)  # [m]
RADIUS_B = (0.12, 0.15)
ANGLES = (math.pi / 6, 5 * math.pi / 6)  # [rad] on the side where y > 0


def mirrored(polar_position: Floats, side: Value) -> Floats:
    """Reflect a radius [m] and an angle [rad] at the wall where the side is 1, shape (..., 2)."""
    sign = 1.0 - 2.0 * np.asarray(side)
    return polar_position * np.stack([np.ones_like(sign), sign], axis=-1)


def goal_across(side: Value, polar_position: Floats, size: Floats, orientation: Floats) -> Floats:
    """Put a box on the floor on its side of the wall, shape (..., 3) [m]."""
    return turned_on_the_floor(mirrored(polar_position, side), size, orientation)


def hull_across(
    side: Value, polar_position: Floats, corners: Floats, orientation: Floats
) -> Floats:
    """Put a hull on the floor on its side of the wall, shape (..., 3) [m]."""
    return shapes.hull_on_the_floor(mirrored(polar_position, side), corners, orientation)


def stand_across(size: Floats, orientation: Floats, *causes: Value, place: Floats) -> Floats:
    """Stand a body on its side of the wall, shape (3,) [m].

    The last of ``causes`` is the side; ``place`` is where it stands on side 0, see ``stand``.
    """
    *corners, side = causes
    sign = 1.0 - 2.0 * float(side)
    return stand(size, orientation, *corners, place=place * [1.0, sign, 1.0])


def wall_on_the_floor(size: Floats) -> Floats:
    """Put a box on the floor in the middle of the arena: its center, shape (..., 3) [m]."""
    return np.asarray(size * [0.0, 0.0, 0.5])


@final
class PickAndPlace(TriFingerTask):
    """A wall, a block on one side of it, and a goal of the same size on the other.

    The blocks share the parents ``block.size`` and ``wall_side``. Which side the block begins
    on decides where the goal is, so that the wall is always between them; the wall stands on the
    floor however high it is.

    Args:
        tool_block_position: Where the center of the block begins while ``wall_side`` is 0: x and
            y if it stands on the floor, or x, y and z [m].
        goal_block_position: Default x and y of the goal, which is on the floor, likewise [m].
        options: Of block, goal and every task; see ``Alike`` and ``Common``.
    """

    name = "pick_and_place"
    default_weights, dense_terms = weighted(
        (750.0, *TIPS_TO_BLOCK),
        (50.0, "block_to_goal", kernels.horizontal_progress, (BLOCK, WAS, TARGET)),
        (250.0, "block_to_height", kernels.crossing_progress, (BLOCK, WAS, TARGET, f"{GOAL}.size")),
        (0.0, *TURNED),
        (0.005, *shaping.SMOOTHNESS),
        fraction=0.0,
    )
    paper_weights = {FRACTION: 1.0}  # noqa: RUF012 # a constant
    options = Alike
    obstacles = (WALL,)
    ready_terms = shaping.ONE_BLOCK
    goal_causes: tuple[str, ...] = (SIDE, f"{GOAL}.polar", f"{GOAL}.euler_orientation")

    def __init__(
        self,
        *,
        tool_block_position: Place = (0.0, -0.09),
        goal_block_position: Place = (0.0, 0.09),
        **options: Unpack[Alike],
    ) -> None:
        self.block = OneBlock(tool_block_position, options)
        super().__init__(**self.block.common)
        self.goal_causes = self.block.causes(self.goal_causes)
        self._polar = self.block.floor_polar(goal_block_position)

    def entities(self) -> Iterable[Entity]:
        """A block, its goal and the wall between them."""
        yield self.block.tool(
            spaces=self._sector(TOOL, sign=-1.0),
            start=Function(stand_across, constants={"place": self.block.place}),
            causes=(SIDE,),
        )
        a, b = (Box((near, ANGLES[0]), (far, ANGLES[1])) for near, far in (RADIUS_A, RADIUS_B))
        yield self.block.goal(
            polar(GOAL, self._polar, (a, b)),
            goal_position(
                GOAL,
                parents=(SIDE, f"{GOAL}.polar", *self.block.form(GOAL)),
                mechanism=Function(goal_across if self.shape is None else hull_across),
            ),
            spaces=self._sector(GOAL, sign=1.0),
        )
        sizes = replace(numbers.OBSTACLE_SIZES, a=WALL_A, b=WALL_B)
        size = sizes.declare(f"{WALL}.size", WALL_SIZE, "Full edge lengths.")
        center = (0.0, 0.0, WALL_SIZE[2] / 2.0)
        position = goal_position(WALL, default=center)  # in the predecessor it keeps its center
        if not self.conventions.published:
            position = numbers.POSITIONS.declare(
                f"{WALL}.cartesian_position",
                None,
                "Position of the center; it stands on the floor in the middle.",
                (size.name,),
                Function(wall_on_the_floor),
            )
        yield obstacle(WALL, size=size, position=position)

    def _sector(self, name: str, *, sign: float) -> tuple[Box, Box]:
        """Return the cylindrical positions on one side of the wall; ``sign`` of y on side 0."""
        height = self.block.level(name)
        near, far = ANGLES if sign > 0.0 else (-ANGLES[1], -ANGLES[0])
        low = Switch(parent=SIDE, below=near, above=-far)
        high = Switch(parent=SIDE, below=far, above=-near)
        a, b = (
            Box((inner, low, height), (outer, high, height))
            for inner, outer in (RADIUS_A, RADIUS_B)
        )
        return a, b

    def shared(self) -> Iterable[Variable]:
        """One size for both, and on which side of the wall they are."""
        yield from self.block.shared()
        yield numbers.SIDES.declare(
            SIDE,
            0,
            "Where the block begins: 0 is at negative y, 1 at positive y; the goal is across.",
        )
