"""Between which numbers an observed variable lies, whatever the other variables are."""

from __future__ import annotations

from typing import Any

import numpy as np

from scm_world._types import Floats
from scm_world.graph import SCM
from scm_world.variables import Box, Categories, Integers, Rotations
from scm_world.variables.spaces import Affine, Switch

WIDE = float(np.finfo(np.float32).max)
"""Stands for no bound: Gymnasium wants finite ones, and no 32-bit number lies beyond."""

_COORDINATES: dict[str, tuple[Any, Any]] = {
    "cylindrical_position": ((0.0, -np.pi, -1.0), (1.5, np.pi, 1.0)),  # [m, rad, m]
    "euler_orientation": (-np.pi, np.pi),  # [rad]
}
"""Other coordinates of a pose declare no bounds: those of the pose hold for them."""


def bounds(model: SCM, name: str) -> tuple[Floats, Floats]:
    """Give the bounds of every component of a variable.

    A declared bound that follows another variable is taken where that one makes it widest.

    Args:
        model: Where the variable is declared.
        name: Of the variable.

    Returns:
        Lower and upper bound, shape (n,) each; ``∓WIDE`` where none is declared.

    Raises:
        UnknownVariable: No variable has this name.
    """
    variable = model.declared(name)
    extent = _extent(model, variable.bounds, name.rpartition(".")[2])
    low, high = (spread(np.clip(end, -WIDE, WIDE), variable.shape) for end in extent)
    room = np.where(high > low, 0.0, 0.5)  # a space with one point is none
    return low - room, high + room


def spread(bound: Any, shape: tuple[int, ...]) -> Floats:
    """Give one bound to each of the components, shape (n,)."""
    flat = np.asarray(bound, dtype=np.float64).ravel()
    return np.broadcast_to(flat, (int(np.prod(shape)),))


def _extent(model: SCM, space: Any, quantity: str) -> tuple[Any, Any]:
    match space:
        case None:
            return _COORDINATES.get(quantity, (-WIDE, WIDE))
        case Box():
            return _ends(model, space.low)[0], _ends(model, space.high)[1]
        case Integers():
            return space.low, space.high
        case Categories():
            return min(space.members), max(space.members)
        case Rotations():
            return -1.0, 1.0
        case _:  # the union of two spaces
            parts = [_extent(model, part, quantity) for part in (space.first, space.second)]
            (low_a, high_a), (low_b, high_b) = parts
            return np.minimum(low_a, low_b), np.maximum(high_a, high_b)


def _ends(model: SCM, bound: Any) -> tuple[Any, Any]:
    """Give the least and the greatest value that a bound can have."""
    match bound:
        case tuple():
            pairs = [_ends(model, part) for part in bound]
            return tuple(low for low, _ in pairs), tuple(high for _, high in pairs)
        case Affine():
            parents = [side[bound.index or 0] for side in bounds(model, bound.parent)]
            both = [bound.offset + bound.scale * float(parent) for parent in parents]
            return min(both), max(both)
        case Switch():
            return min(bound.below, bound.above), max(bound.below, bound.above)
        case _:
            return bound, bound
