"""Walls: the families in which blocks form levels on one another, and how these are laid out."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from typing import Any, ClassVar, Unpack, final

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.errors import InterventionError
from scm_world.tasks.composition import Entity
from scm_world.tasks.rewards import Common
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.building import MASS, Building, Part, Piece, blocks_mass
from scm_world.tasks.trifinger.entities.bodies import (
    COUNT,
    lowest_point,
    obstacle_names,
    scattered,
    scattering,
)
from scm_world.tasks.trifinger.hardware import ARENA_HALF_WIDTH, ARENA_HEIGHT
from scm_world.variables import Box, Categories, Derived, Function
from scm_world.variables.kinds import SpaceName

LEVELS = "stack_levels"
SIZE = "blocks_min_size"
WIDTH = "max_level_width"
PATTERN = "wall_pattern"
NOISE = "wall_noise"
LAYOUT = "wall.layout"
RANDOM = 1  # the category of ``wall_pattern``

LOW = 0.25  # [m] a lower block fits under the raised fingers
MAX_LEVELS = 10
MAX_PER_LEVEL = 15
SHAPE = (MAX_LEVELS, MAX_PER_LEVEL, 3)

SHIFT = 0.005  # [m] of every other level of the regular wall
SIDE = 0.1  # [m] how far in front of it, or behind, its blocks begin
PASSES = 3  # how often blocks of the random wall are halved
GAP = 0.005  # [m] between blocks at the start
DEPTH = 0.13  # [m] at most this far from the middle, in y, is the middle of a row of blocks
EDGE = 0.16  # [m] and at most this far their outer side

Beam = tuple[float, float]
"""Center, in x, and width of a block [m]."""


def layout(levels: Value, least: Value, widest: Value, pattern: Value, noise: Floats) -> Floats:
    """Lay the blocks of a wall out.

    There are as many levels as asked for, or as fit into the arena. A wall that should be narrower
    than its narrowest block has one such block in each level.

    Args:
        levels: How many levels, shape (...).
        least: Depth, height and least width of a block, shape (...) [m].
        widest: Greatest width of a level, shape (...) [m].
        pattern: 0 for the regular wall, 1 for a random one, shape (...).
        noise: What a random wall is made of, in [0, 1], shape (..., MAX_LEVELS, 3).

    Returns:
        For each place in each level x and y of the center and the width of its block, shape
        (..., MAX_LEVELS, MAX_PER_LEVEL, 3) [m]. The width is zero where a block is missing.
    """
    signature = "(),(),(),(),(l,n)->(l,m,k)"
    return np.asarray(
        np.vectorize(_layout, signature=signature)(levels, least, widest, pattern, noise)
    )


def _layout(levels: Value, least: Value, widest: Value, pattern: Value, noise: Floats) -> Floats:
    size, width = float(least), max(float(widest), float(least))
    count = min(int(levels), int(ARENA_HEIGHT / size + 1e-9))
    if int(pattern) == 0:
        rows, y = [_regular(level, size, width) for level in range(count)], 0.0
    else:
        rows, y = _random(size, width, noise[:count])
    found = np.zeros(SHAPE)
    for level, row in enumerate(rows):
        found[level, : len(row)] = [(x, y, piece) for x, piece in row]
    return found


def _regular(level: int, size: float, width: float) -> list[Beam]:
    """Lay cubes side by side; every other level is shifted a little."""
    count = min(int(width / size + 1e-9), MAX_PER_LEVEL)
    shift = SHIFT if level % 2 else -SHIFT
    return [((i - 0.5 * (count - 1)) * size + shift, size) for i in range(count)]


def _random(size: float, width: float, noise: Floats) -> tuple[list[list[Beam]], float]:
    """Lay beams on one another, each with its middle on the one below, and halve them.

    Source:
        CausalWorld 1.2, ``stacked_blocks.py``; there the halves are not in order.
    """
    inside = ARENA_HALF_WIDTH - size
    low, high = np.full(2, -inside), np.full(2, inside)
    below, rows = (-np.inf, np.inf), []
    y = 0.0
    for u in noise:
        x, y = (low + (high - low) * u[:2]).tolist()
        room = min(2.0 * (ARENA_HALF_WIDTH - abs(x)), width)
        beam = size + (max(room, size) - size) * float(u[2])
        rows.append(_halved(x, beam, size, below))
        middle, reach = np.array([x, y]), np.array([beam, size]) / 2.0
        low, high = np.maximum(low, middle - reach), np.minimum(high, middle + reach)
        below = (x - beam / 2.0, x + beam / 2.0)
    return rows, y


def _halved(
    x: float, width: float, size: float, below: tuple[float, float], passes: int = PASSES
) -> list[Beam]:
    """Halve pieces that are wide enough, as long as the middles of both halves lie on something.

    Halving keeps the ends of a level, so that the levels above stay as stable as they were.
    """
    left, right = x - width / 4.0, x + width / 4.0
    if passes == 0 or width <= 2.0 * size or left < below[0] or right > below[1]:
        return [(x, width)]
    halves = (_halved(half, width / 2.0, size, below, passes - 1) for half in (left, right))
    return [piece for half in halves for piece in half]


def brick_size(found: Floats, least: Value, *, level: float, num: float) -> Floats:
    """Compute the edge lengths of a block, shape (..., 3) [m], from its level and place in it."""
    width = found[..., int(level), int(num), 2]
    return np.stack(np.broadcast_arrays(width, least, least), axis=-1)


def brick_place(found: Floats, least: Value, *, level: float, num: float) -> Floats:
    """Compute the center of a block in the wall, shape (..., 3) [m]; see ``brick_size``."""
    x, y = found[..., int(level), int(num), 0], found[..., int(level), int(num), 1]
    return np.stack(np.broadcast_arrays(x, y, (level + 0.5) * least), axis=-1)


@lru_cache(maxsize=64)
def _spread(
    widths: tuple[tuple[float, ...], ...], size: float, y: float
) -> dict[tuple[int, int], tuple[float, float, int]]:
    """Put blocks in rows on the floor, beside the wall at ``y``, and in layers where it is full.

    ``size`` is their depth [m]. Return x, y and the layer, by level and place in it.
    """
    first, step = min(DEPTH, EDGE - size / 2.0), size + GAP
    every = np.arange(-first, first + 1e-9, step).tolist()
    rows = [row for row in every if abs(row - y) > step - 1e-9] or every
    found = {}
    x, row = -ARENA_HALF_WIDTH, 0
    for level, num, width in ((i, j, w) for i, ws in enumerate(widths) for j, w in enumerate(ws)):
        if x + width > ARENA_HALF_WIDTH + 1e-9:
            x, row = -ARENA_HALF_WIDTH, row + 1
        layer, which = divmod(row, len(rows))
        found[level, num] = (x + width / 2.0, rows[which], layer)
        x += width + GAP
    return found


def start(
    size: Floats,
    orientation: Floats,
    found: Floats,
    least: Value,
    pattern: Value,
    *,
    level: float,
    num: float,
    airborne: float,
) -> Floats:
    """Compute where a block begins: its center, shape (3,) [m].

    The blocks of a regular wall stand in front of it and behind it, by turns of its levels, in
    two walls half as high. Those of a random one lie in rows on the floor beside it.

    ``airborne`` is 1 to begin at the height that it has in the wall, as in the predecessor, whose
    blocks fall at first.
    """
    floor, i, j = lowest_point(size, orientation), int(level), int(num)
    if int(pattern) == 0:
        layer = i if airborne else i // 2
        side = SIDE if i % 2 else -SIDE
        return np.array([found[i, j, 0], side, layer * float(least) + floor])
    widths = tuple(tuple(row[row > 0.0].tolist()) for row in found[..., 2])
    x, y, layer = _spread(widths, float(least), float(found[i, j, 1]))[i, j]
    return np.array([x, y, layer * float(least) + floor])


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
    """

    name = "stacked_blocks"
    decided_by: ClassVar[tuple[str, ...]] = (LAYOUT,)
    goal_causes = (LEVELS, MASS, SIZE, WIDTH, NOISE)
    piece = Piece(
        size=(brick_size, LAYOUT, SIZE),
        place=(brick_place, LAYOUT, SIZE),
        start=(start, LAYOUT, SIZE, PATTERN),
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
        both, unit = Categories((0, RANDOM)), Box(0.0, 1.0)
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
            numbers.Range(both, both, both, dtype="categorical").root(
                PATTERN, 0, "How the blocks are laid out: 0 is regular, 1 is random."
            ),
            numbers.Range(unit, unit, unit, shape=(MAX_LEVELS, 3)).root(
                NOISE,
                (0.5,) * (3 * MAX_LEVELS),
                "What a random wall is made of: x, y and width of each level, as fractions.",
            ),
            Derived(
                name=LAYOUT,
                unit="m",
                shape=SHAPE,
                bounds=Box(-0.3, 0.3),
                parents=(LEVELS, SIZE, WIDTH, PATTERN, NOISE),
                mechanism=Function(layout),
                doc="For each place in each level: x and y of a block, and its width, or zero.",
            ),
        )

    def arrange(self, values: Values) -> Any:
        """Count the blocks of each level, and the obstacles if the family has some.

        Raises:
            InterventionError: There are no blocks.
        """
        per_level = (values[LAYOUT][..., 2] > 0.0).sum(axis=-1)
        counts = tuple(int(count) for count in per_level if count)
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
            place = brick_place(values[LAYOUT], values[SIZE], **which)
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


@final
class CreativeStackedBlocks(StackedBlocks):
    """A wall, regular or random; the blocks of the first and last level have their places.

    The robot has to make up the levels between the two. Small boxes may be in the way. The other
    variables are those of ``StackedBlocks``.

    Args:
        number_of_obstacles: How many small boxes are in the way.
        options: Those of ``StackedBlocks``, with 8 levels of at most 0.12 m by default.
    """

    name = "creative_stacked_blocks"
    decided_by = (LAYOUT, COUNT)
    levels = numbers.CREATIVE_LEVELS

    def __init__(self, *, number_of_obstacles: int = 0, **options: Any) -> None:
        super().__init__(**{"num_of_levels": 8, "max_level_width": 0.12, **options})
        self.roots += (*scattering(number_of_obstacles),)

    @property
    def targets(self) -> dict[str, str]:
        """The goals of the first level and of the last."""
        ends = (0, len(self.built[0]) - 1)
        return {f"goal_{p}": f"tool_{p}" for p, which in self.parts() if which["level"] in ends}
