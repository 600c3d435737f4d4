"""Blocks that should fill goals: success, goal, solution and the parts of a building."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping
from functools import partial

import numpy as np
from numba import njit

from scm_world._types import ArrayLike, Floats, Value, Values
from scm_world.geometry.filling import aabb_overlap_fraction, overlap_fraction
from scm_world.geometry.hulls import Hull
from scm_world.geometry.rotations import rotation_matrix
from scm_world.tasks.base import OVERLAP, Goal
from scm_world.tasks.composition import Entity
from scm_world.tasks.rewards import FRACTION, FULFILLED, SUCCESS, UNIT
from scm_world.tasks.trifinger import hardware, kernels, shapes
from scm_world.tasks.trifinger.feasibility import fingers_reach
from scm_world.tasks.trifinger.views import SIZE, view
from scm_world.variables import Function, Measured
from scm_world.variables.mechanisms import Stacked

BOX = 10  # numbers of a box in a goal vector: size (3), position (3), quaternion (4)
TIPS = "end_effector_positions"

NEAR = 0.1
"""What a meter between fingertips and block counts beside one between block and goal."""

CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
"""Of a cube with edges of length one, shape (8, 3)."""

_POSE = ("size", "cartesian_position", "orientation")


def gathered(*parents: Floats, tools: float) -> tuple[Floats, ...]:
    """Stack sizes, positions and quaternions of blocks, then those of goals.

    Args:
        parents: Size, position and quaternion of each block, then of each goal.
        tools: How many blocks there are.
    """
    n = 3 * int(tools)
    groups = (parents[:n], parents[n:])
    return tuple(np.array(group[i::3]) for group in groups for i in range(3))


@Stacked
@njit(cache=True)
def filled(numbers: Floats, tools: float) -> float:
    """Compute the fraction of the volume of all goals that the blocks fill, in [0, 1].

    Args:
        numbers: Size, position and quaternion of each block, then of each goal, shape (10 n,).
        tools: How many blocks there are.
    """
    n = len(numbers) // BOX
    size, position, turn = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4))
    for i in range(n):
        for k in range(3):
            size[i, k], position[i, k] = numbers[BOX * i + k], numbers[BOX * i + 3 + k]
        for k in range(4):
            turn[i, k] = numbers[BOX * i + 6 + k]
    of = int(tools)
    return overlap_fraction(
        size[:of], position[:of], turn[:of], size[of:], position[of:], turn[of:]
    )


def aligned(*parents: Floats, tools: float) -> float:
    """Compute the predecessor's overlap: of the axis-aligned hulls, not capped."""
    return aabb_overlap_fraction(*gathered(*parents, tools=tools))


def fractional_success(
    tools: tuple[str, ...], targets: Mapping[str, str], shape: Hull | None, *, published: bool
) -> Measured:
    """Declare the fraction of the goals that is filled.

    Args:
        tools: Names of the blocks.
        targets: Names of the goals.
        shape: Shape of block and goal, where that is not a box.
        published: Whether the overlap is that of the axis-aligned hulls, as in the predecessor.
    """
    parts = _POSE
    if shape is not None:
        mechanism = Function(shapes.hull_aligned if published else shapes.hull_filled)
        parts = ("vertices", *_POSE[1:])
    elif len(tools) == len(targets) == 1 and not published:
        mechanism = Function(kernels.filled)
    else:
        constants = {"tools": float(len(tools))}
        mechanism = Function(aligned if published else filled, constants=constants)
    return Measured(
        name=FRACTION,
        bounds=None if published else UNIT,
        parents=tuple(f"{body}.{part}" for body in (*tools, *targets) for part in parts),
        mechanism=mechanism,
        doc="Fraction of the volume of all goals that the blocks fill.",
    )


def goal(
    tools: tuple[str, ...],
    targets: Mapping[str, str],
    causes: tuple[str, ...],
    shape: Hull | None,
    *,
    published: bool,
) -> Goal:
    """Return the goal of blocks that should fill others: size, position and quaternion of each.

    Args:
        tools: Names of the blocks.
        targets: Names of the goals, each with the block that its solution puts there.
        causes: The variables that a new goal is drawn for.
        shape: Shape of block and goal, where that is not a box.
        published: Whether the overlap is that of the axis-aligned hulls, as in the predecessor.
    """
    have, want = (
        tuple(f"{name}.{part}" for name in names for part in _POSE)
        for names in (targets.values(), targets)
    )
    fraction = partial(_fraction, shape=shape, published=published)
    return Goal(
        achieved=have,
        desired=want,
        causes=causes,
        measures={
            FRACTION: fraction,
            SUCCESS: lambda mine, its: fraction(mine, its) > FULFILLED,
            OVERLAP: partial(_fraction, shape=shape, published=True),
        },
        closeness=((TIPS, *have, *want), boxes_apart),
        tools=tools,
        targets=targets,
    )


def _fraction(
    achieved: ArrayLike, desired: ArrayLike, *, shape: Hull | None, published: bool
) -> Floats:
    """Compute how much of the desired boxes, or of the desired hull, is filled, shape (...)."""
    have, want = np.asarray(achieved, dtype=float), np.asarray(desired, dtype=float)
    if shape is None:
        boxes = aabb_overlap_fraction if published else overlap_fraction

        def filled(mine: Floats, its: Floats) -> float:
            return float(boxes(*_split(mine), *_split(its)))
    else:
        overlap = shapes.hull_aligned if published else shapes.hull_filled
        corners = np.array(shape.vertices)

        def filled(mine: Floats, its: Floats) -> float:
            return overlap(corners, mine[3:6], mine[6:], corners, its[3:6], its[6:])

    vectorized = np.vectorize(filled, signature="(n),(n)->()", otypes=[float])
    return np.asarray(vectorized(have, want))


def view_of(
    targets: Mapping[str, str],
) -> tuple[tuple[str, ...], int, Callable[[Values], Floats]]:
    """Describe the view of the boxes that have goals, in their own frames."""
    parts = [
        (TIPS, *(f"{tool}.{part}" for part in _POSE), *(f"{goal}.{p}" for p in _POSE[1:]))
        for goal, tool in targets.items()
    ]

    def seen(values: Values) -> Floats:
        return np.concatenate([view(*(values[name] for name in names)) for names in parts])

    return tuple(dict.fromkeys(itertools.chain(*parts))), SIZE * len(parts), seen


def solution(targets: Mapping[str, str], values: Values) -> dict[str, Value]:
    """Put each block where its goal is, and fingers that are in the way to the side."""
    found = {
        f"{tool}.{part}": values[f"{goal}.{part}"]
        for goal, tool in targets.items()
        for part in _POSE[1:]
    }
    joints, height = values["joint_positions"], float(values["robot_height"])
    boxes = [[values[f"{goal}.{part}"] for part in _POSE] for goal in targets]
    if any(fingers_reach(b[0], b[1], b[2], joints, height) for b in boxes):
        found["joint_positions"] = np.array(hardware.ASIDE)
    return found


Part = tuple[str, dict[str, float]]
"""The name of a part of a building, and the constants that say which one it is."""


def assembled(
    parts: Iterable[Part],
    piece: Callable[..., tuple[Entity, Entity]],
    targets: Mapping[str, str],
    *causes: Entity,
    airborne: bool,
) -> Iterable[Entity]:
    """List the block of each part, and its place in the building.

    Args:
        parts: The parts.
        piece: Returns the block of a part and its goal.
        targets: The goals that there are.
        causes: Entities that the places of the parts follow from.
        airborne: Whether the spaces of blocks reach into the air, as in the predecessor.
    """
    pieces = [piece(name, **which, airborne=airborne) for name, which in parts]
    yield from (tool for tool, _ in pieces)
    yield from causes
    yield from (goal for _, goal in pieces if goal.name in targets)


def _split(boxes: Floats) -> tuple[Floats, Floats, Floats]:
    rows = boxes.reshape(-1, BOX)
    parts = (rows[:, :3], rows[:, 3:6], rows[:, 6:])
    size, position, orientation = (np.array(part, order="C") for part in parts)
    return size, position, orientation


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
    """Give the corners of boxes.

    Args:
        size: Edges, shape (..., 3) [m].
        position: Of the centers, shape (..., 3) [m].
        orientation: Quaternions, shape (..., 4).

    Returns:
        Shape (..., 8, 3) [m].
    """
    body = CORNERS * size[..., None, :]
    found: Floats = position[..., None, :] + body @ np.swapaxes(
        rotation_matrix(orientation), -1, -2
    )
    return found
