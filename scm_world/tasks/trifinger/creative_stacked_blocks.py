"""Creative stacked blocks: build a wall of which only the first and the last level are given."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Unpack, final

from scm_world._types import Values
from scm_world.tasks.composition import Entity
from scm_world.tasks.rewards import Common
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger.scattered import COUNT, obstacle_names, scattered, scattering
from scm_world.tasks.trifinger.walls import LAYOUT, Walls
from scm_world.variables import Variable

Plan = tuple[tuple[int, ...], int]


@final
class CreativeStackedBlocks(Walls):
    """A wall, regular or random; the blocks of the first and last level have their places.

    What is between the two, the robot has to make up. Small boxes may be in the way. The other
    variables are those of ``Walls``.

    Reward terms:
        fractional_success: How much of the two levels the blocks fill.

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
    levels_a = numbers.CREATIVE_LEVELS_A

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
        self._obstacles = number_of_obstacles

    def arrange(self, values: Values) -> Plan:
        """Count the blocks of each level, and the obstacles."""
        return super().arrange(values), int(values[COUNT])

    def counts(self) -> tuple[int, ...]:
        """Say how many blocks each level has."""
        return self._arranged()[0]

    def wanted(self, level: int) -> bool:
        """Tell whether a level is the first or the last."""
        return level in (0, len(self.counts()) - 1)

    def obstacles(self) -> tuple[str, ...]:
        """Name the small boxes."""
        return obstacle_names(self._arranged()[1])

    def _arranged(self) -> Plan:
        return self.plan or (self.regular(), self._obstacles)  # type: ignore[return-value]

    def entities(self) -> Iterable[Entity]:
        """The wall, and small boxes."""
        yield from super().entities()
        yield from scattered(self._arranged()[1])

    def shared(self) -> Iterable[Variable]:
        """Declare the wall, and where obstacles are."""
        yield from super().shared()
        yield from scattering(self._obstacles)
