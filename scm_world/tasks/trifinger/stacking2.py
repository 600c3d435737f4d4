"""Stacking: build a tower of two blocks."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Unpack, final

import numpy as np

from scm_world._types import Floats
from scm_world.geometry.rotations import rotation_matrix
from scm_world.tasks.base import checked
from scm_world.tasks.composition import Entity
from scm_world.tasks.rewards import Common, weighted
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger import kernels
from scm_world.tasks.trifinger.base import TriFingerTask
from scm_world.tasks.trifinger.entities.bodies import (
    Place,
    Quaternion,
    block_size,
    body,
    coordinates,
    lowest_point,
    orientation,
    position,
    stand,
    tool,
    turned_on_the_floor,
)
from scm_world.tasks.trifinger.kernels import SMOOTHNESS, TIPS, TIPS_WAS
from scm_world.tasks.trifinger.single import SIZE, floor_place, start_place, unit_quaternion
from scm_world.variables import Affine, Function, Parent

TOWER = "goal_tower"
TOOLS = ("tool_block_1", "tool_block_2")
GOALS = ("goal_block_1", "goal_block_2")
LOWER, UPPER = (f"{name}.cartesian_position" for name in GOALS)
FIRST, SECOND = ((place, Parent(place, 1)) for place in (f"{t}.cartesian_position" for t in TOOLS))
GAP = 0.005  # [m] at least between the blocks at the start


def tower_center(polar_position: Floats, size: Floats, orientation: Floats) -> Floats:
    """Put a tower of two blocks of a size on the floor: compute its center, shape (..., 3) [m]."""
    return turned_on_the_floor(polar_position, size * [1.0, 1.0, 2.0], orientation)


def floor_of_tower(center: Floats, size: Floats, orientation: Floats, *, side: float) -> Floats:
    """Compute the center of a block of the tower, shape (..., 3) [m].

    ``side`` is -1 for the lower block, 1 for the upper one.
    """
    upwards = rotation_matrix(orientation)[..., :, 2]
    return np.asarray(center + (0.5 * side) * size[..., 2:] * upwards)


def beside(size: Floats, orientation: Floats, *, place: Floats, other: Floats) -> Floats:
    """Stand a block on the floor, at least ``GAP`` away from another one of the same size.

    It stands at ``place`` (x, y and the height of its lowest point) if there is room, else farther
    away from ``other`` in the same direction. Return its center, shape (3,) [m].
    """
    offset, room = place[:2] - other[:2], size[:2] + GAP
    apart = np.abs(offset) > 1e-9
    farther = max(1.0, float((room[apart] / np.abs(offset[apart])).min(initial=np.inf)))
    x, y = (other[:2] + (farther if math.isfinite(farther) else 1.0) * offset).tolist()
    return np.array([x, y, place[2] + lowest_point(size, orientation)])


@final
class Stacking2(TriFingerTask):
    """Two blocks on the floor, and two goals of the same size that stand on one another.

    All four share the parent ``block.size``. The goals follow ``goal_tower``, whose center is as
    high as a block.

    Args:
        tool_block_mass: Default mass of a block [kg].
        tool_block_size: Default edge length of all blocks and goals [m].
        tool_block_1_position: Where the center of the first block begins: x and y if it stands on
            the floor, or x, y and z [m].
        tool_block_1_orientation: How it begins: quaternion (x, y, z, w).
        tool_block_2_position: Start of the second block; it begins farther away from the first
            one if they are too large for that.
        tool_block_2_orientation: Likewise.
        goal_position: Default x and y of the tower, whose lower block is on the floor [m].
        goal_orientation: Default orientation of the tower.
        common: Options of every task; see ``Common``.
    """

    name = "stacking2"
    default_weights, dense_terms = weighted(
        (
            750.0,
            "tips_to_block",
            kernels.stacking_tips_progress,
            (TIPS, TIPS_WAS, *FIRST, *SECOND, LOWER),
        ),
        (250.0, "block_to_goal", kernels.placing_progress, (*FIRST, LOWER)),
        (
            250.0,
            "block_to_height",
            kernels.lifting_progress,
            (FIRST[0], LOWER, *SECOND, UPPER),
            "How much nearer the second block came to the height of its goal, once the first one "
            "is placed [m].",
        ),
        (
            125.0,
            "block_to_block",
            kernels.stacking_progress,
            (*FIRST, LOWER, *SECOND, UPPER),
            "How much nearer the second block came to the first one, seen from above, once that is "
            "placed and while it is higher than its goal [m].",
        ),
        (0.005, *SMOOTHNESS),
        fraction=1.0,
    )
    goal_causes = (f"{TOWER}.polar", f"{TOWER}.euler_orientation")
    tools, targets = TOOLS, dict(zip(GOALS, TOOLS, strict=True))  # the lower one first
    unchecked = (TOWER,)

    def __init__(
        self,
        *,
        tool_block_mass: float = numbers.BLOCK_MASS,
        tool_block_size: float = numbers.BLOCK_SIZE[0],
        tool_block_1_position: Place = (0.0, 0.0),
        tool_block_1_orientation: Quaternion = numbers.IDENTITY,
        tool_block_2_position: Place = (0.01, 0.08),
        tool_block_2_orientation: Quaternion = numbers.IDENTITY,
        goal_position: Place = (-0.06, -0.06),
        goal_orientation: Quaternion = numbers.IDENTITY,
        **common: Unpack[Common],
    ) -> None:
        super().__init__(**common)
        self._mass = checked("tool_block_mass", tool_block_mass, numbers.BLOCK_MASSES.bounds)
        edge = checked("tool_block_size", tool_block_size, numbers.BLOCK_SIZES.bounds)
        size = np.array([edge, edge, edge])
        self.roots = (block_size(SIZE, default=(edge, edge, edge)),)  # one for all
        given = (
            (tool_block_1_position, tool_block_1_orientation),
            (tool_block_2_position, tool_block_2_orientation),
        )
        self._places, self._turns = list[tuple[float, ...]](), list[Quaternion]()
        for name, (place, turned) in zip(TOOLS, given, strict=True):
            turn = unit_quaternion(f"{name}_orientation", turned)
            below = lowest_point(size, np.array(turn))
            self._places.append(start_place(f"{name}_position", place, below))
            self._turns.append(turn)
        self._tower_turn = unit_quaternion("goal_orientation", goal_orientation)
        leans = np.array(self._tower_turn)
        lower = floor_of_tower(tower_center(np.zeros(2), size, leans), size, leans, side=-1.0)
        self._tower = floor_place("goal_position", goal_position, float(lower[2]))

    def entities(self) -> Iterable[Entity]:
        """Two blocks, a tower, and its two floors."""
        first, second = self._places
        starts = (
            Function(stand, constants={"place": first}),
            Function(beside, constants={"place": second, "other": first}),
        )
        sizes = replace(numbers.BLOCK_SIZES, a=None, b=None)
        airborne = self.conventions.published
        for name, start, turn in zip(TOOLS, starts, self._turns, strict=True):
            yield tool(
                name,
                sizes.derived(f"{name}.size", SIZE),
                numbers.BLOCK_MASSES.root(f"{name}.mass", self._mass),
                start=start,
                turn=turn,
                spaces=numbers.places(numbers.half_height(f"{name}.size"), airborne=airborne),
            )
        center, turned = f"{TOWER}.cartesian_position", f"{TOWER}.orientation"
        spaces = numbers.places(Affine(parent=SIZE, index=2), airborne=False)
        tower = (
            numbers.POLAR.root(f"{TOWER}.polar", self._tower),
            position(TOWER, (tower_center, f"{TOWER}.polar", SIZE, turned)),
            orientation(TOWER, default=self._tower_turn),
            *coordinates(TOWER, spaces=spaces),
        )
        yield Entity(TOWER, tower)
        for name, side in zip(GOALS, (-1.0, 1.0), strict=True):
            yield body(
                "goal",
                name,
                sizes.derived(f"{name}.size", SIZE),
                position(name, (floor_of_tower, center, SIZE, turned), {"side": side}),
                orientation(name, turned),
                yaw=False,
            )
