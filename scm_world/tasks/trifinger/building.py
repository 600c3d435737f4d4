"""Buildings: families whose blocks are parts of something; and towers, the simplest of them."""

from __future__ import annotations

import inspect
from abc import abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar, Unpack, final

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.errors import ModelError
from scm_world.tasks.composition import Entity
from scm_world.tasks.rewards import FRACTION, Common
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.base import TriFingerTask
from scm_world.tasks.trifinger.catalogue import Causes
from scm_world.tasks.trifinger.entities.bodies import (
    body,
    lowest_point,
    orientation,
    position,
    tool,
)
from scm_world.variables import Function, Variable
from scm_world.variables.mechanisms import Constant

MASS = "blocks_mass"

Part = tuple[str, dict[str, Any]]
"""The name of a part of a building, and the numbers, or arrays, that say which one it is."""

Constants = tuple[tuple[str, Constant], ...]


def constants_of(which: Mapping[str, Any]) -> Constants:
    """Return the numbers of a part as mechanisms keep them: arrays as tuples."""
    return tuple(Function("part", constants=which).constants.items())


def blocks_mass(default: float) -> Variable:
    """Declare the mass that all blocks share, with the option ``tool_block_mass`` [kg]."""
    doc = "Mass of every block, unless a block is given another one."
    return numbers.SHARED_MASSES.option(MASS, default, doc, "tool_block_mass")


@final
@dataclass(frozen=True)
class Piece:
    """Where the parts of a building come from; they have no spaces of their own.

    Each is the name of a variable to copy, or ``(function, "parent", …)``. Keyword-only arguments
    of the function get the constants of the part, and ``airborne``: 1 where blocks may begin in the
    air, as in the predecessor.

    Attributes:
        size: Edge lengths of a block and of its place.
        place: Center of the place in the building.
        start: Where the block begins: a function of its size, its orientation and of the values of
            further parents. When one of them changes, the block is put there again.
        turn: Quaternion of the place; it is upright if None.
    """

    size: Causes
    place: Causes
    start: tuple[Any, ...]
    turn: Causes | None = None

    def __post_init__(self) -> None:
        """Refuse a field that is neither a name nor a function with its parents."""
        for field, given in vars(self).items():
            named = isinstance(given, str) and field != "start"
            made = isinstance(given, tuple) and given and callable(given[0])
            if not (named or made or (given is None and field == "turn")):
                advice = "give the name of a variable, or (function, 'parent', …)"
                raise ModelError([f"Piece.{field}={given!r}: {advice}"])


@lru_cache(maxsize=512)  # they are immutable, and most structures of a family have them
def bodies(piece: Piece, name: str, which: Constants, airborne: bool) -> tuple[Entity, Entity]:
    """Describe a part of a building, of which ``which`` are the constants: block and place."""

    def taken(causes: Causes | None) -> dict[str, Any]:
        if causes is None or isinstance(causes, str):
            return {}
        given = {**dict(which), "airborne": float(airborne)}
        options = inspect.signature(causes[0]).parameters.values()
        names = (one.name for one in options if one.kind is one.KEYWORD_ONLY)
        return {name: given[name] for name in names if name in given}

    mine, its = f"tool_{name}", f"goal_{name}"
    sizes = [
        numbers.PART_SIZES.derived(f"{solid}.size", piece.size, constants=taken(piece.size))
        for solid in (mine, its)
    ]
    start, *start_from = piece.start
    block = tool(
        mine,
        sizes[0],
        numbers.BLOCK_MASSES.derived(f"{mine}.mass", MASS),
        start=Function(start, constants=taken(piece.start)),
        start_from=tuple(start_from),
        start_again=True,
        spaces=numbers.places(numbers.half_height(f"{mine}.size"), airborne=airborne),
    )
    pose = (
        position(its, piece.place, taken(piece.place)),
        orientation(its, piece.turn, taken(piece.turn)),
    )
    return block, body("goal", its, sizes[1], *pose, yaw=False)


class Building(TriFingerTask):
    """A goal family whose blocks are parts of a building, as many as variables say.

    ``roots`` has to hold ``blocks_mass(default)``: the mass of every part is a copy of it.

    Attributes:
        piece: Where the parts come from.
    """

    default_weights: ClassVar[Mapping[str, float]] = {FRACTION: 1.0}
    interleaved = True
    rest = hardware.RAISED  # the fingers begin out of the way
    piece: ClassVar[Piece]

    @abstractmethod
    def parts(self) -> Iterable[Part]:
        """List the parts of the building, each a block with its place."""

    @property
    def tools(self) -> tuple[str, ...]:
        """Names of the blocks that should be moved: one for each part."""
        return tuple(f"tool_{name}" for name, _ in self.parts())

    @property
    def targets(self) -> Mapping[str, str]:
        """Names of the goals, each with the block that its solution puts there."""
        return {f"goal_{name}": f"tool_{name}" for name, _ in self.parts()}

    def entities(self) -> Iterable[Entity]:
        """List the blocks, and their places in the building."""
        airborne, targets = self.conventions.published, self.targets
        pieces = [
            bodies(self.piece, name, constants_of(which), airborne) for name, which in self.parts()
        ]
        yield from (tool for tool, _ in pieces)
        yield from (goal for _, goal in pieces if goal.name in targets)


# --- towers ---------------------------------------------------------------------------------------

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
