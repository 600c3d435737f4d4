"""How the blocks of a wall are laid out, and where they begin."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from scm_world._types import Floats, Value
from scm_world.tasks.trifinger.entities.blocks import lowest_point
from scm_world.tasks.trifinger.hardware import ARENA_HALF_WIDTH, ARENA_HEIGHT

MAX_LEVELS = 10
MAX_PER_LEVEL = 15
SHAPE = (MAX_LEVELS, MAX_PER_LEVEL, 3)

SHIFT = 0.005  # [m] of every other level of the regular wall
SIDE = 0.1  # [m] how far in front of it, or behind, its blocks begin
PASSES = 3  # how often blocks of the random wall are halved
GAP = 0.005  # [m] between blocks at the start
DEPTH = 0.13  # [m] at most this far from the middle, in y, is the middle of a row of blocks
EDGE = 0.16  # [m] and at most this far their outer side

Piece = tuple[float, float]
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
        (..., MAX_LEVELS, MAX_PER_LEVEL, 3) [m]. Where there is no block, the width is zero.
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


def _regular(level: int, size: float, width: float) -> list[Piece]:
    """Lay cubes side by side; every other level is shifted a little."""
    count = min(int(width / size + 1e-9), MAX_PER_LEVEL)
    shift = SHIFT if level % 2 else -SHIFT
    return [((i - 0.5 * (count - 1)) * size + shift, size) for i in range(count)]


def _random(size: float, width: float, noise: Floats) -> tuple[list[list[Piece]], float]:
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


def _halved(x: float, beam: float, size: float, below: tuple[float, float]) -> list[Piece]:
    """Halve pieces that are wide enough, as long as the middles of both halves lie on something.

    Halving keeps the ends of a level, so that the levels above stay as stable as they were.
    """
    pieces = [(x, beam)]
    for _ in range(PASSES):
        pieces = [half for piece in pieces for half in _halves(piece, size, below)]
    return pieces


def _halves(piece: Piece, size: float, below: tuple[float, float]) -> Iterator[Piece]:
    x, width = piece
    left, right = x - width / 4.0, x + width / 4.0
    if width > 2.0 * size and below[0] <= left and right <= below[1]:
        yield from ((left, width / 2.0), (right, width / 2.0))
    else:
        yield piece


def counts(found: Floats) -> tuple[int, ...]:
    """Count the blocks of every level of a layout that has some."""
    per_level = (found[..., 2] > 0.0).sum(axis=-1)
    return tuple(int(count) for count in per_level if count)


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
