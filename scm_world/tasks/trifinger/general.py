"""General: put blocks where others came to lie that were dropped."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Unpack, final

import numpy as np

from scm_world._types import Floats, Values
from scm_world.tasks.composition import Entity
from scm_world.tasks.rewards import Common
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger import piles
from scm_world.tasks.trifinger.base import Building
from scm_world.tasks.trifinger.building import MASS, Part, Piece, blocks_mass
from scm_world.tasks.trifinger.entities.blocks import lowest_point
from scm_world.variables import Box, Derived, Function, Variable

COUNT = "nums_objects"
SIZE = "tool_block_size"
PLACES = "drop_positions"
TURNS = "drop_orientations"
PILE = "pile"

DROPS = (
    (0.1, 0.1, 0.2),
    (0.0, 0.0, 0.2),
    (0.05, 0.05, 0.3),
    (-0.05, -0.05, 0.1),
    (-0.12, -0.12, 0.2),
    (-0.12, 0.12, 0.2),
    (0.12, -0.10, 0.3),
    (0.09, -0.08, 0.1),
)
"""Where blocks are let go by default, in turn [m]."""

STARTS = ((1, -1), (-1, 1), (0, -1), (1, 0), (-1, 0), (0, 1), (-1, -1), (1, 1), (0, 0))
"""Where blocks begin, in steps along x and y: first where the default drops are not."""
STEP = 0.11  # [m]


def cube(edge: Floats) -> Floats:
    """Compute the edge lengths of a cube, shape (..., 3) [m]."""
    return np.stack([edge, edge, edge], axis=-1)


def start(size: Floats, orientation: Floats, *, index: float) -> Floats:
    """Compute where a block begins: in a square on the floor, shape (3,) [m]."""
    x, y = STARTS[int(index)]
    return np.array([STEP * x, STEP * y, lowest_point(size, orientation)])


@final
class General(Building):
    """Blocks on the floor, and the places where such blocks came to lie that were dropped.

    From where they are dropped is a variable: draw it for another goal. What the blocks are like,
    gravity and the friction of the floor are causes of the goal, as they are of all motion. The
    pile is simulated on MuJoCo for every backend of the world, so that one seed gives the same
    goal everywhere. The fingers begin raised.

    Args:
        tool_block_mass: Default mass of a block [kg].
        tool_block_size: Default edge length of a block [m].
        nums_objects: Default number of blocks.
        common: Options of every task; see ``Common``.

    Raises:
        UnknownOption: An argument is out of the bounds of its variable.
    """

    name = "general"
    decided_by = (COUNT,)
    goal_causes = (COUNT, MASS, SIZE, PLACES, TURNS)
    interleaved = False
    piece = Piece(
        size=(cube, SIZE),
        place=(piles.part_of, PILE),
        start=(start,),
        turn=(piles.turn_of, PILE),
    )

    def __init__(
        self,
        *,
        tool_block_mass: float = numbers.BLOCKS_MASS,
        tool_block_size: float = 0.05,
        nums_objects: int = 5,
        **common: Unpack[Common],
    ) -> None:
        super().__init__(**common)
        self.roots = (
            blocks_mass(tool_block_mass),
            numbers.NUMS_OBJECTS.option(COUNT, nums_objects, "How many blocks there are."),
            numbers.DROPPED_SIZE.option(SIZE, tool_block_size, "Edge length of every block."),
            *_drops(),
        )

    def arrange(self, values: Values) -> int:
        """Count the blocks."""
        return int(values[COUNT])

    def parts(self) -> Iterable[Part]:
        """List the blocks."""
        return ((str(index), {"index": float(index)}) for index in range(self.arranged))

    def entities(self) -> Iterable[Entity]:
        """List the blocks, the pile, and the places of the blocks in it."""
        bodies, count = tuple(super().entities()), self.arranged
        pile = Derived(
            name=PILE,
            unit="m, 1",
            shape=piles.SHAPE,
            bounds=Box(-1.0, 1.0),
            parents=(
                *(COUNT, SIZE, MASS, PLACES, TURNS, "gravity", "floor_friction"),
                *(f"{tool}.friction" for tool in self.tools),
            ),
            mechanism=Function(piles.pile),
            doc="Position and quaternion of each block some time after it was dropped.",
        )
        return *bodies[:count], Entity(PILE, (pile,)), *bodies[count:]


def _drops() -> Iterable[Variable]:
    """Declare what the predecessor takes from a global generator."""
    region, anywhere = (
        Box(*(tuple(end) * piles.MOST for end in ends))
        for ends in (numbers.DROP_REGION, numbers.POSITION_ENDS)
    )
    bounds, turns, shape = (
        Box(-2.0 * math.pi, 2.0 * math.pi),
        Box(0.0, 2.0 * math.pi),
        (piles.MOST, 3),
    )
    yield numbers.Range(anywhere, region, region, "m", shape).declare(
        PLACES,
        tuple(x for i in range(piles.MOST) for x in DROPS[i % len(DROPS)]),
        "Where the center of each block is let go, or above it if something is there.",
    )
    yield numbers.Range(bounds, turns, turns, "rad", shape).declare(
        TURNS,
        (0.0,) * (3 * piles.MOST),
        "How each block is turned when it is let go, as a rotation vector.",
    )
