"""General: put blocks where others came to lie that were dropped."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import cache
from typing import Any, Unpack, final

import numpy as np

from scm_world._types import Floats, Values
from scm_world.tasks.base import checked
from scm_world.tasks.composition import Entity
from scm_world.tasks.rewards import FRACTION, Common
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger import hardware, piles
from scm_world.tasks.trifinger.base import TriFingerTask
from scm_world.tasks.trifinger.building import Part, assembled
from scm_world.tasks.trifinger.entities.block_world import lowest_point
from scm_world.tasks.trifinger.entities.blocks import ToolBlock
from scm_world.tasks.trifinger.entities.goals import GoalBlock
from scm_world.tasks.trifinger.shapes import MASS, blocks_mass, part_goal, part_tool
from scm_world.variables import Box, Derived, Exogenous, Function, Variable

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
    """Give the edge lengths of a cube, shape (..., 3) [m].

    Args:
        edge: Shape (...) [m].
    """
    return np.stack([edge, edge, edge], axis=-1)


def start(size: Floats, orientation: Floats, *, index: float) -> Floats:
    """Compute where a block begins: in a square on the floor, shape (3,) [m].

    Args:
        size: Edge lengths, shape (3,) [m].
        orientation: Quaternion (x, y, z, w).
        index: Which block.
    """
    x, y = STARTS[int(index)]
    return np.array([STEP * x, STEP * y, lowest_point(size, orientation)])


@cache
def block(name: str, *, index: float, airborne: bool) -> tuple[ToolBlock, GoalBlock]:
    """Describe a block, and its place in the pile.

    Args:
        name: Name of the two, without what tells them apart.
        index: Number of the block.
        airborne: Whether its spaces reach into the air, as in the predecessor.
    """
    which = {"index": index}
    size = ((SIZE,), Function(cube))
    return (
        part_tool(
            f"tool_{name}",
            size=size,
            spawn=((), Function(start, constants=which)),
            airborne=airborne,
        ),
        part_goal(
            f"goal_{name}",
            size=size,
            position=((PILE,), Function(piles.part_of, constants=which)),
            orientation=((PILE,), Function(piles.turn_of, constants=which)),
        ),
    )


@final
class Pile(Entity):
    """Where the dropped blocks came to lie: a simulation, as one variable.

    Args:
        count: How many blocks there are.
    """

    name = PILE

    def __init__(self, count: int) -> None:
        self._count = count

    def variables(self) -> Iterable[Variable]:
        """Declare the pile."""
        frictions = (f"tool_{index}.friction" for index in range(self._count))
        physics = ("gravity", "floor_friction", *frictions)
        yield Derived(
            name=PILE,
            unit="m, 1",
            shape=piles.SHAPE,
            bounds=Box(-1.0, 1.0),
            parents=(COUNT, SIZE, MASS, PLACES, TURNS, *physics),
            mechanism=Function(piles.pile),
            doc="Position and quaternion of each block some time after it was dropped.",
        )


@final
class General(TriFingerTask):
    """Blocks on the floor, and the places where such blocks came to lie that were dropped.

    From where they are dropped is a variable: draw it for another goal. What the blocks are like,
    gravity and the friction of the floor are causes of the goal, as they are of all motion. The
    pile is simulated on MuJoCo for every backend of the world, so that one seed gives the same
    goal everywhere. The fingers begin raised.

    Reward terms:
        fractional_success: How much of the goals the blocks fill.

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
    default_weights = {FRACTION: 1.0}  # noqa: RUF012 # a constant
    rest = hardware.RAISED  # the fingers begin out of the way

    def __init__(
        self,
        *,
        tool_block_mass: float = numbers.BLOCKS_MASS,
        tool_block_size: float = 0.05,
        nums_objects: int = 5,
        **common: Unpack[Common],
    ) -> None:
        super().__init__(**common)
        self._mass = checked("tool_block_mass", tool_block_mass, numbers.BLOCK_MASSES.bounds)
        self._size = checked(SIZE, tool_block_size, numbers.DROPPED_SIZE.bounds)
        self._number = checked(COUNT, nums_objects, numbers.NUMS_OBJECTS.bounds)

    def arrange(self, values: Values) -> int:
        """Count the blocks."""
        return int(values[COUNT])

    def parts(self) -> Iterable[Part]:
        """List the blocks."""
        count = self.plan if isinstance(self.plan, int) else self._number
        return ((str(index), {"index": float(index)}) for index in range(count))

    def entities(self) -> Iterable[Entity]:
        """The blocks, the pile, and the places of the blocks in it."""
        pile, airborne = Pile(len(self.tools)), self.conventions.published_spaces
        return assembled(self.parts(), block, self.targets, pile, airborne=airborne)

    def shared(self) -> Iterable[Variable]:
        """Declare the blocks, and how they are dropped."""
        yield blocks_mass(self._mass)
        yield numbers.NUMS_OBJECTS.root(COUNT, self._number, "How many blocks there are.")
        yield numbers.DROPPED_SIZE.root(SIZE, self._size, "Edge length of every block.")
        yield from _drops()


def _drops() -> Iterable[Variable]:
    """Declare what the predecessor takes from a global generator."""
    region = _repeated(Box(*numbers.DROP_REGION))
    common: dict[str, Any] = {"shape": (piles.MOST, 3)}
    yield Exogenous(
        name=PLACES,
        unit="m",
        bounds=_repeated(numbers.POSITION_BOUNDS),
        a=region,
        b=region,
        default=tuple(x for i in range(piles.MOST) for x in DROPS[i % len(DROPS)]),
        doc="Where the center of each block is let go, or above it if something is there.",
        **common,
    )
    turns = Box(0.0, 2.0 * math.pi)
    yield Exogenous(
        name=TURNS,
        unit="rad",
        bounds=Box(-2.0 * math.pi, 2.0 * math.pi),
        a=turns,
        b=turns,
        default=(0.0,) * (3 * piles.MOST),
        doc="How each block is turned when it is let go, as a rotation vector.",
        **common,
    )


def _repeated(box: Box) -> Box:
    """Give the bounds of points in a row, from those of one."""
    low, high = box.bounds((3,), {})
    return Box(tuple(low.tolist()) * piles.MOST, tuple(high.tolist()) * piles.MOST)
