"""Blocks that should fill goals: success, goal, solution and the parts of a building."""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, final

import numpy as np
from numba import njit

from scm_world._types import ArrayLike, Floats, Values
from scm_world.errors import ModelError
from scm_world.geometry.filling import aabb_overlap_fraction, overlap_fraction
from scm_world.geometry.hulls import Hull
from scm_world.geometry.rotations import rotation_matrix
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger import shapes
from scm_world.tasks.trifinger.entities.blocks import ToolBlock, block_mass
from scm_world.tasks.trifinger.entities.goals import GoalBlock, goal_orientation, goal_position
from scm_world.tasks.trifinger.views import SIZE, view
from scm_world.variables import Function, Variable
from scm_world.variables.mechanisms import Constant, Stacked

MASS = "blocks_mass"
BOX = 10  # numbers of a box in a goal vector: size (3), position (3), quaternion (4)
TIPS = "end_effector_positions"

NEAR = 0.1
"""What a meter between fingertips and block counts beside one between block and goal."""

CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
"""Of a cube with edges of length one, shape (8, 3)."""

POSE = ("size", "cartesian_position", "orientation")


@Stacked
@njit(cache=True)
def filled(numbers: Floats, tools: float) -> float:
    """Compute the fraction of the volume of all goals that the blocks fill, in [0, 1].

    Args:
        numbers: Size, position and quaternion of each block, then of each goal, shape (10 n,).
        tools: How many blocks there are.
    """
    rows, of = numbers.reshape(-1, BOX), int(tools)
    size, position, turn = rows[:, :3].copy(), rows[:, 3:6].copy(), rows[:, 6:].copy()
    return overlap_fraction(
        size[:of], position[:of], turn[:of], size[of:], position[of:], turn[of:]
    )


@Stacked
def aligned(numbers: Floats, tools: float) -> float:
    """Compute the predecessor's overlap: of the axis-aligned hulls, not capped; see ``filled``."""
    parts = np.split(numbers.reshape(-1, BOX), [3, 6], axis=1)
    of = int(tools)
    return aabb_overlap_fraction(*(part[:of] for part in parts), *(part[of:] for part in parts))


def fraction_of(
    shape: Hull | None, published: bool, achieved: ArrayLike, desired: ArrayLike
) -> Floats:
    """Compute how much of the desired boxes, or of the desired hull, is filled, shape (...)."""
    vertices = None if shape is None else np.array(shape.vertices)

    def one(mine: Floats, its: Floats) -> float:
        if vertices is None:
            boxes = aligned if published else filled
            return float(boxes(mine, its, tools=len(mine) / BOX))
        overlap = shapes.hull_aligned if published else shapes.hull_filled
        return overlap(vertices, mine[3:6], mine[6:], vertices, its[3:6], its[6:])

    vectorized = np.vectorize(one, signature="(n),(n)->()", otypes=[float])
    return np.asarray(vectorized(np.asarray(achieved, float), np.asarray(desired, float)))


def view_of(
    targets: Mapping[str, str],
) -> tuple[tuple[str, ...], int, Callable[[Values], Floats]]:
    """Describe the view of the boxes that have goals, in their own frames."""
    parts = [
        (TIPS, *(f"{tool}.{part}" for part in POSE), *(f"{goal}.{p}" for p in POSE[1:]))
        for goal, tool in targets.items()
    ]

    def seen(values: Values) -> Floats:
        return np.concatenate([view(*(values[name] for name in names)) for names in parts])

    return tuple(dict.fromkeys(itertools.chain(*parts))), SIZE * len(parts), seen


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


Causes = str | tuple[Any, ...]
"""The name of a variable to copy, or ``(function, "parent", …)``: a function of their values.

Keyword-only arguments of the function get the constants of the part, and ``airborne``: 1 where
blocks may begin in the air, as in the predecessor.
"""


@final
@dataclass(frozen=True)
class Piece:
    """Where the parts of a building come from; they have no spaces of their own.

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
        """Refuse what is neither a name nor a function with its parents."""
        for field, given in vars(self).items():
            named = isinstance(given, str) and field != "start"
            made = isinstance(given, tuple) and given and callable(given[0])
            if not (named or made or (given is None and field == "turn")):
                advice = "give the name of a variable, or (function, 'parent', …)"
                raise ModelError([f"Piece.{field}={given!r}: {advice}"])


def _bound(causes: Causes | None, constants: Mapping[str, Constant]) -> dict[str, Any]:
    """Return parents and mechanism."""
    if causes is None or isinstance(causes, str):
        return {"parents": () if causes is None else (causes,), "mechanism": None}
    function, *parents = causes
    taken = inspect.signature(function).parameters.values()
    names = [one.name for one in taken if one.kind is one.KEYWORD_ONLY]
    own = {name: constants[name] for name in names if name in constants}
    return {"parents": tuple(parents), "mechanism": Function(function, constants=own)}


@lru_cache(maxsize=512)  # they are immutable, and most structures of a family have them
def bodies(
    piece: Piece, name: str, which: Constants, airborne: bool
) -> tuple[ToolBlock, GoalBlock]:
    """Describe a block of a building, and its place.

    Args:
        piece: Where they come from.
        name: Of the two, without what tells them apart.
        which: The constants that say which one it is.
        airborne: Whether blocks may begin in the air, as in the predecessor.
    """
    constants = {**dict(which), "airborne": float(airborne)}
    size, place, start, turn = (_bound(one, constants) for one in vars(piece).values())
    (tool, mine), (goal, its) = (
        (body, numbers.PART_SIZES.declare(f"{body}.size", None, "Full edge lengths.", **size))
        for body in (f"tool_{name}", f"goal_{name}")
    )
    block = ToolBlock(
        tool,
        size=mine,
        mass=block_mass(f"{tool}.mass", MASS),
        spawn=start["mechanism"],
        spawn_from=start["parents"],
        spawn_again=True,
        spaces=numbers.places(numbers.half_height(mine.name), airborne=airborne),
    )
    pose = goal_position(goal, **place), goal_orientation(goal, **turn)
    return block, GoalBlock(goal, size=its, pose=pose, yaw=False)


def boxes_apart(tips: Floats, *values: Floats) -> Floats:
    """Compute minus the distances of boxes, given as size, position and quaternion each."""
    half = len(values) // 2
    total = np.zeros(tips.shape[:-1])
    fingers = tips.reshape(*tips.shape[:-1], 3, 3)
    for first in range(0, half, 3):
        box, goal = (values[at : at + 3] for at in (first, half + first))
        gaps = np.linalg.norm(corners(*box) - corners(*goal), axis=-1)
        reach = np.linalg.norm(fingers - box[1][..., None, :], axis=-1)
        total += gaps.mean(axis=-1) + NEAR * reach.mean(axis=-1)
    return -total / (half // 3)


def corners(size: Floats, position: Floats, orientation: Floats) -> Floats:
    """Compute the corners of boxes, shape (..., 8, 3) [m]."""
    body = CORNERS * size[..., None, :]
    found: Floats = position[..., None, :] + body @ np.swapaxes(
        rotation_matrix(orientation), -1, -2
    )
    return found
