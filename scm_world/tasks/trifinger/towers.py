"""Towers: rebuild a cuboid that is cut into equal blocks."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from typing import Any, Unpack, final

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.tasks.base import checked
from scm_world.tasks.composition import Entity
from scm_world.tasks.rewards import FRACTION, Common
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.base import TriFingerTask
from scm_world.tasks.trifinger.building import Part, assembled
from scm_world.tasks.trifinger.entities.block_world import lowest_point
from scm_world.tasks.trifinger.entities.blocks import ToolBlock
from scm_world.tasks.trifinger.entities.goals import GoalBlock
from scm_world.tasks.trifinger.shapes import (
    MASS,
    MOST_PARTS,
    blocks_mass,
    part_goal,
    part_tool,
)
from scm_world.variables import Function, Variable

DIMS = "tower_dims"
NUMBER = "number_of_blocks_in_tower"
CENTER = "tower_center"

CORNER = 0.12  # [m] where the first block begins: at minus this in x and y
EDGE = 0.16  # [m] how far a block may reach in x and y at the start
GAP = 0.005  # [m] between blocks at the start

Counts = tuple[int, int, int]


def part(dims: Floats, number: Value) -> Floats:
    """Compute the size of a block, shape (..., 3) [m].

    Args:
        dims: Of the tower, shape (..., 3) [m].
        number: How many blocks it has along each axis, shape (..., 3).
    """
    return np.asarray(dims / number)


def place(
    dims: Floats, number: Value, center: Floats, *, level: float, col: float, row: float
) -> Floats:
    """Compute the center of a part of the tower, shape (..., 3) [m].

    Args:
        dims: Of the tower, shape (..., 3) [m].
        number: How many blocks it has along each axis, shape (..., 3).
        center: Of its base, x and y, shape (..., 2) [m].
        level: Which part along z.
        col: Along y.
        row: Along x.
    """
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
    """Compute where a block begins: on the diagonal of the floor, then beside it, then above.

    Args:
        size: Edge lengths, shape (3,) [m].
        orientation: Quaternion (x, y, z, w).
        number: How many blocks the tower has along each axis, shape (3,).
        level: Which part of the tower it is, along z.
        col: Along y.
        row: Along x.

    Returns:
        The center, shape (3,) [m].

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


@lru_cache(maxsize=MOST_PARTS)
def piece(
    name: str, *, level: float, col: float, row: float, airborne: bool
) -> tuple[ToolBlock, GoalBlock]:
    """Describe a block of a tower, and its place in it.

    Args:
        name: Of the two, without what tells them apart.
        level: Which part it is, along z.
        col: Along y.
        row: Along x.
        airborne: Whether its spaces reach into the air, as in the predecessor.
    """
    which = {"level": level, "col": col, "row": row}
    size = ((DIMS, NUMBER), Function(part))
    where = ((DIMS, NUMBER, CENTER), Function(place, constants=which))
    first = ((NUMBER,), Function(start, constants=which))
    return (
        part_tool(f"tool_{name}", size=size, spawn=first, airborne=airborne),
        part_goal(f"goal_{name}", size=size, position=where),
    )


@final
class Towers(TriFingerTask):
    """A cuboid on the floor, cut into equal blocks.

    Its size, its place and into how many blocks it is cut along each axis are variables. The
    blocks begin beside one another on the floor, and do so again whenever their size changes.

    Reward terms:
        fractional_success: How much of the tower the blocks fill.

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
    default_weights = {FRACTION: 1.0}  # noqa: RUF012 # a constant
    interleaved = True
    rest = hardware.RAISED  # the fingers begin out of the way

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
        bounds = numbers.TOWER_COUNT.bounds
        self._mass = checked("tool_block_mass", tool_block_mass, numbers.BLOCK_MASSES.bounds)
        self._number = checked(NUMBER, number_of_blocks_in_tower, bounds, shape=(3,))
        self._dims = checked(DIMS, tower_dims, numbers.TOWER_DIMS.bounds, shape=(3,))
        self._center = checked(CENTER, tower_center, numbers.TOWER_CENTER.bounds, shape=(2,))

    def arrange(self, values: Values) -> Counts:
        """Count the blocks along each axis."""
        x, y, z = (int(count) for count in values[NUMBER])
        return x, y, z

    def parts(self) -> Iterable[Part]:
        """List the blocks, level by level, column by column."""
        plan: Any = self.plan or self._number
        for level, col, row in np.ndindex(*(int(count) for count in reversed(plan))):
            which = {"level": float(level), "col": float(col), "row": float(row)}
            yield f"level_{level}_col_{col}_row_{row}", which

    def entities(self) -> Iterable[Entity]:
        """The blocks, and their places in the tower."""
        airborne = self.conventions.published_spaces
        return assembled(self.parts(), piece, self.targets, airborne=airborne)

    def shared(self) -> Iterable[Variable]:
        """Declare the tower."""
        yield blocks_mass(self._mass)
        yield numbers.TOWER_COUNT.root(
            NUMBER, self._number, "How many blocks the tower has along x, y and z."
        )
        yield numbers.TOWER_DIMS.root(DIMS, self._dims, "Full edge lengths of the tower.")
        yield numbers.TOWER_CENTER.root(
            CENTER, self._center, "Where the middle of its base is, x and y."
        )
