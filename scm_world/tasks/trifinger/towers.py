"""Towers: rebuild a cuboid that is cut into equal blocks."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from typing import Unpack, final

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.tasks.rewards import Common
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger.base import Building
from scm_world.tasks.trifinger.building import MASS, Part, Piece, blocks_mass
from scm_world.tasks.trifinger.entities.blocks import lowest_point

DIMS = "tower_dims"
NUMBER = "number_of_blocks_in_tower"
CENTER = "tower_center"

CORNER = 0.12  # [m] where the first block begins: at minus this in x and y
EDGE = 0.16  # [m] how far a block may reach in x and y at the start
GAP = 0.005  # [m] between blocks at the start

Counts = tuple[int, int, int]


def part(dims: Floats, number: Value) -> Floats:
    """Compute the size of a block of the tower, shape (..., 3) [m]."""
    return np.asarray(dims / number)


def place(
    dims: Floats, number: Value, center: Floats, *, level: float, col: float, row: float
) -> Floats:
    """Compute the center of the part with these numbers along z, y and x, shape (..., 3) [m]."""
    corner = np.concatenate([center - dims[..., :2] / 2.0, 0.0 * dims[..., 2:]], axis=-1)
    return np.asarray(corner + (np.array([row, col, level]) + 0.5) * part(dims, number))


@lru_cache(maxsize=256)
def _cells(columns: int, rows: int) -> tuple[tuple[int, int], ...]:
    """List the cells of a grid: its diagonal, then the ones beside it."""
    cells = ((i, j) for i in range(columns) for j in range(rows))
    return tuple(sorted(cells, key=lambda cell: (abs(cell[0] - cell[1]), cell)))


def start(
    size: Floats, orientation: Floats, number: Value, *, level: float, col: float, row: float
) -> Floats:
    """Compute where a block begins: on the diagonal of the floor, then beside it, then above [m].

    Source:
        CausalWorld 1.2, ``towers.py``; there the diagonal is all there is, and the blocks rise
        by half of their height when it is full, into one another.
    """
    first = [max(0.0, min(CORNER, EDGE - 0.5 * edge)) for edge in size[:2].tolist()]
    step = [edge + GAP for edge in size[:2].tolist()]
    fits = [int(2.0 * f / s + 1e-9) + 1 for f, s in zip(first, step, strict=True)]
    index = int((level * number[1] + col) * number[0] + row)
    layer, cell = divmod(index, fits[0] * fits[1])
    i, j = _cells(*fits)[cell]
    height = layer * float(size[2]) + lowest_point(size, orientation)
    return np.array([i * step[0] - first[0], j * step[1] - first[1], height])


@final
class Towers(Building):
    """A cuboid on the floor, cut into equal blocks.

    Its size, its place and into how many blocks it is cut along each axis are variables. The
    blocks begin beside one another on the floor, and do so again whenever their size changes.

    Args:
        tool_block_mass: Default mass of a block [kg].
        number_of_blocks_in_tower: Default number of blocks along x, y and z.
        tower_dims: Default size of the tower [m].
        tower_center: Default place of the middle of its base, x and y [m].
        common: Options of every task; see ``Common``.

    Raises:
        UnknownOption: An argument is out of the bounds of its variable.
    """

    name = "towers"
    decided_by = (NUMBER,)
    goal_causes = (NUMBER, MASS, DIMS, CENTER)
    piece = Piece(
        size=(part, DIMS, NUMBER), place=(place, DIMS, NUMBER, CENTER), start=(start, NUMBER)
    )

    def __init__(
        self,
        *,
        tool_block_mass: float = numbers.BLOCKS_MASS,
        number_of_blocks_in_tower: Counts = (1, 1, 5),
        tower_dims: tuple[float, float, float] = (0.035, 0.035, 0.175),
        tower_center: tuple[float, float] = (0.0, 0.0),
        **common: Unpack[Common],
    ) -> None:
        super().__init__(**common)
        self.roots = (
            blocks_mass(tool_block_mass),
            numbers.TOWER_COUNT.option(
                NUMBER,
                number_of_blocks_in_tower,
                "How many blocks the tower has along x, y and z.",
            ),
            numbers.TOWER_DIMS.option(DIMS, tower_dims, "Full edge lengths of the tower."),
            numbers.TOWER_CENTER.option(
                CENTER, tower_center, "Where the middle of its base is, x and y."
            ),
        )

    def arrange(self, values: Values) -> Counts:
        """Count the blocks along each axis."""
        x, y, z = (int(count) for count in values[NUMBER])
        return x, y, z

    def parts(self) -> Iterable[Part]:
        """List the blocks, level by level, column by column."""
        for level, col, row in np.ndindex(*reversed(self.arranged)):
            which = {"level": float(level), "col": float(col), "row": float(row)}
            yield f"level_{level}_col_{col}_row_{row}", which
