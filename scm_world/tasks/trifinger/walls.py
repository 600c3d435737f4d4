"""Walls: the families in which blocks form levels on one another."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, ClassVar, Unpack, final

import numpy as np

from scm_world._types import Value, Values
from scm_world.errors import InterventionError
from scm_world.tasks.composition import Entity
from scm_world.tasks.rewards import Common
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger import hardware, layouts
from scm_world.tasks.trifinger.base import Building
from scm_world.tasks.trifinger.building import MASS, Part, Piece, blocks_mass
from scm_world.tasks.trifinger.entities.obstacles import (
    COUNT,
    obstacle_names,
    scattered,
    scattering,
)
from scm_world.variables import Box, Categories, Derived, Function, Variable
from scm_world.variables.kinds import SpaceName

LEVELS = "stack_levels"
SIZE = "blocks_min_size"
WIDTH = "max_level_width"
PATTERN = "wall_pattern"
NOISE = "wall_noise"
LAYOUT = "wall.layout"
RANDOM = 1  # the category of ``wall_pattern``

LOW = 0.25  # [m] what is lower fits under the raised fingers


class StackedBlocks(Building):
    """A wall, regular or random; each block has its place in it.

    How many levels it has, how wide it is and how small its blocks are, are variables, and so is
    the noise of a random wall: an intervention on one of the others keeps it; draw ``wall_noise``
    for another wall. The layout follows from them, or can be set as a whole. The fingers begin
    raised: at rest they would stand where larger blocks begin.

    Args:
        tool_block_mass: Default mass of a block [kg].
        blocks_min_size: Default depth, height and least width of a block [m].
        num_of_levels: Default number of levels.
        max_level_width: Default greatest width of a level [m].
        common: Options of every task; see ``Common``.

    Attributes:
        levels: Bounds and spaces of the number of levels.

    Raises:
        UnknownOption: An argument is out of the bounds of its variable.
    """

    name = "stacked_blocks"
    decided_by: ClassVar[tuple[str, ...]] = (LAYOUT,)
    goal_causes = (LEVELS, MASS, SIZE, WIDTH, NOISE)
    piece = Piece(
        size=(layouts.brick_size, LAYOUT, SIZE),
        place=(layouts.brick_place, LAYOUT, SIZE),
        start=(layouts.start, LAYOUT, SIZE, PATTERN),
    )
    levels: ClassVar[numbers.Range] = numbers.STACK_LEVELS

    def __init__(
        self,
        *,
        tool_block_mass: float = numbers.BLOCKS_MASS,
        blocks_min_size: float = 0.035,
        num_of_levels: int = 5,
        max_level_width: float = 0.25,
        **common: Unpack[Common],
    ) -> None:
        super().__init__(**common)
        self.roots = (
            blocks_mass(tool_block_mass),
            self.levels.option(
                LEVELS,
                num_of_levels,
                "How many levels the wall has, as far as they fit into the arena.",
                "num_of_levels",
            ),
            numbers.MIN_SIZE.option(
                SIZE, blocks_min_size, "Depth and height of every block, and the least width."
            ),
            numbers.LEVEL_WIDTH.option(
                WIDTH,
                max_level_width,
                "Greatest width of a level; it is never narrower than a block.",
            ),
            *_noise(),
            Derived(
                name=LAYOUT,
                unit="m",
                shape=layouts.SHAPE,
                bounds=Box(-0.3, 0.3),
                parents=(LEVELS, SIZE, WIDTH, PATTERN, NOISE),
                mechanism=Function(layouts.layout),
                doc="For each place in each level: x and y of a block, and its width, or zero.",
            ),
        )

    def arrange(self, values: Values) -> Any:
        """Count the blocks of each level, and the obstacles if the family has some.

        Raises:
            InterventionError: There are no blocks.
        """
        counts = layouts.counts(values[LAYOUT])
        if not counts:
            message = f"do({LAYOUT}): a wall has at least one block; give one a width above zero"
            raise InterventionError(message, variable=LAYOUT)
        return (counts, int(values[COUNT])) if COUNT in self.decided_by else counts

    @property
    def built(self) -> tuple[tuple[int, ...], int]:
        """How many blocks each level has, and how many obstacles there are."""
        return self.arranged if COUNT in self.decided_by else (self.arranged, 0)

    @property
    def obstacles(self) -> tuple[str, ...]:
        """The small boxes, if the family has some."""
        return obstacle_names(self.built[1])

    def entities(self) -> Iterable[Entity]:
        """List the blocks, their places in the wall, and small boxes."""
        yield from super().entities()
        yield from scattered(self.built[1])

    def parts(self) -> Iterable[Part]:
        """List the blocks, level by level."""
        for level, count in enumerate(self.built[0]):
            for num in range(count):
                yield f"level_{level}_num_{num}", {"level": float(level), "num": float(num)}

    def solution(self, values: Values) -> dict[str, Value]:
        """Build the wall: all of it, so that it stands, with the fingers out of its way."""
        found = {}
        for name, which in self.parts():
            place = layouts.brick_place(values[LAYOUT], values[SIZE], **which)
            found[f"tool_{name}.cartesian_position"] = place
            found[f"tool_{name}.orientation"] = np.array(numbers.IDENTITY)
        if len(self.built[0]) * float(values[SIZE]) > LOW:
            found["joint_positions"] = np.array(hardware.ASIDE)
        return found

    def nearby(self, values: Values) -> Iterable[dict[str, Value]]:
        """Take the last block away, or put one more beside it or on it."""
        layout = np.array(values[LAYOUT])
        level = int(np.flatnonzero(layout[:, :, 2].any(axis=1))[-1])
        last = int(np.flatnonzero(layout[level, :, 2])[-1])
        fewer, more = layout.copy(), layout.copy()
        fewer[level, last] = 0.0
        if last + 1 < layout.shape[1]:
            more[level, last + 1] = layout[level, last] + [layout[level, last, 2], 0.0, 0.0]
            yield {LAYOUT: more}
        if level or last:
            yield {LAYOUT: fewer}

    def sample_goal(self, space: SpaceName = "A") -> dict[str, Any]:
        """Draw a new random wall."""
        return {**super().sample_goal(space), PATTERN: RANDOM}


def _noise() -> Iterable[Variable]:
    """Declare what the predecessor takes from a global generator."""
    both, unit = Categories((0, RANDOM)), Box(0.0, 1.0)
    yield numbers.Range(both, both, both, dtype="categorical").declare(
        PATTERN, 0, "How the blocks are laid out: 0 is regular, 1 is random."
    )
    yield numbers.Range(unit, unit, unit, shape=(layouts.MAX_LEVELS, 3)).declare(
        NOISE,
        (0.5,) * (3 * layouts.MAX_LEVELS),
        "What a random wall is made of: x, y and width of each level, as fractions.",
    )


@final
class CreativeStackedBlocks(StackedBlocks):
    """A wall, regular or random; the blocks of the first and last level have their places.

    The robot has to make up the levels between the two. Small boxes may be in the way. The other
    variables are those of ``StackedBlocks``.

    Args:
        tool_block_mass: Default mass of a block [kg].
        blocks_min_size: Default depth, height and least width of a block [m].
        num_of_levels: Default number of levels.
        max_level_width: Default greatest width of a level [m].
        number_of_obstacles: How many small boxes are in the way.
        common: Options of every task; see ``Common``.
    """

    name = "creative_stacked_blocks"
    decided_by = (LAYOUT, COUNT)
    levels = numbers.CREATIVE_LEVELS

    def __init__(
        self,
        *,
        tool_block_mass: float = numbers.BLOCKS_MASS,
        blocks_min_size: float = 0.035,
        num_of_levels: int = 8,
        max_level_width: float = 0.12,
        number_of_obstacles: int = 0,
        **common: Unpack[Common],
    ) -> None:
        super().__init__(
            tool_block_mass=tool_block_mass,
            blocks_min_size=blocks_min_size,
            num_of_levels=num_of_levels,
            max_level_width=max_level_width,
            **common,
        )
        self.roots += (*scattering(number_of_obstacles),)

    @property
    def targets(self) -> dict[str, str]:
        """The goals of the first level and of the last."""
        ends = (0, len(self.built[0]) - 1)
        return {f"goal_{p}": f"tool_{p}" for p, which in self.parts() if which["level"] in ends}
