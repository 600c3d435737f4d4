"""One block that should fill one goal of its shape."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar, final

import numpy as np

from scm_world._types import Floats
from scm_world.errors import ModelError
from scm_world.geometry import canonical, quaternion_product
from scm_world.geometry.coordinates import from_cylindrical
from scm_world.geometry.hulls import Hull, extents
from scm_world.tasks.base import checked
from scm_world.tasks.composition import Entity
from scm_world.tasks.rewards import Common
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger import kernels, shapes
from scm_world.tasks.trifinger.entities.blocks import (
    ToolBlock,
    block_mass,
    block_size,
    lowest_point,
    stand,
)
from scm_world.tasks.trifinger.entities.goals import GoalBlock, goal_orientation
from scm_world.tasks.trifinger.shapes import Place, Quaternion
from scm_world.tasks.trifinger.shaping import TIPS
from scm_world.tasks.trifinger.shaping import WAS as TIPS_WAS
from scm_world.variables import Box, Fixed, Function, Parent, Variable
from scm_world.variables.spaces import Bound

SIZE = "block.size"
TOOL = "tool_block"
GOAL = "goal_block"


class Alike(Common, total=False):
    """Options of tasks with one block and one goal, in addition to those of every task.

    Attributes:
        shape: Shape of block and goal; a box if None. The size of a shape cannot change.
        tool_block_mass: Default mass of the block [kg].
        tool_block_orientation: How it begins: quaternion (x, y, z, w). A shape is turned by so
            much from the way its points were given.
        goal_block_orientation: Default orientation of the goal, likewise. A shape rests like this
            on the floor; it is turned about the vertical by ``goal_block.yaw``.
    """

    shape: Hull | None
    tool_block_mass: float
    tool_block_orientation: Quaternion
    goal_block_orientation: Quaternion


@final
class OneBlock:
    """A block and a goal of the same shape.

    Args:
        tool_block_position: Where the center of the block begins: x and y if it stands on the
            floor, or x, y and z [m].
        options: Options of the task.

    Attributes:
        common: The options that every task has.
        shape: Shape of block and goal; None for a box.
        targets: The goal, with the block that belongs there.
        place: x and y of the block at the start, and the height of its lowest point [m].
    """

    targets: ClassVar[Mapping[str, str]] = {GOAL: TOOL}

    def __init__(self, tool_block_position: Place, options: Alike) -> None:
        self.common: Any = dict(options)
        self.shape: Hull | None = self.common.pop("shape", None)
        if not (self.shape is None or isinstance(self.shape, Hull)):
            raise ModelError(
                [f"shape must be a Hull: load_hull(path) or hull_of(points); {self.shape!r}"]
            )
        self._corners = () if self.shape is None else (np.array(self.shape.vertices),)
        mass = self.common.pop("tool_block_mass", numbers.BLOCK_MASS)
        self._mass = checked("tool_block_mass", mass, numbers.BLOCK_MASSES.bounds)
        self._turns = {name: self._turn(f"{name}_orientation") for name in (TOOL, GOAL)}
        below = self.below(TOOL)
        self.place = shapes.start_place("tool_block_position", tool_block_position, below)

    def _turn(self, option: str) -> Quaternion:
        """Read how a body begins turned; a hull is turned from the way its points were given."""
        turn = shapes.unit_quaternion(option, self.common.pop(option, numbers.IDENTITY))
        if self.shape is None:
            return turn
        x, y, z, w = canonical(quaternion_product(turn, self.shape.axes)).tolist()
        return x, y, z, w

    def causes(self, box: Iterable[str]) -> tuple[str, ...]:
        """Return the variables that a goal is drawn for; a hull turns about the vertical only."""
        turns = {} if self.shape is None else {f"{GOAL}.euler_orientation": f"{GOAL}.yaw"}
        return tuple(turns.get(name, name) for name in box)

    def below(self, name: str) -> float:
        """Compute how far block or goal reaches below its center as it begins [m]."""
        size, turn = np.array(numbers.BLOCK_SIZE), np.array(self._turns[name])
        return lowest_point(size, turn, *self._corners)

    def level(self, name: str) -> Bound:
        """Return the height of the center of block or goal on the floor, as a bound of a space."""
        return numbers.half_height(f"{name}.size") if self.shape is None else self.below(name)

    def floor_polar(self, place: Place) -> tuple[float, float]:
        """Turn the place of a goal on the floor into radius [m] and angle [rad]."""
        return shapes.floor_place("goal_block_position", place, self.below(GOAL))

    def shared(self) -> Iterable[Variable]:
        """One size for both, or one shape."""
        if self.shape is None:
            yield block_size(SIZE)
            return
        for name in (TOOL, GOAL):
            yield Fixed(
                name=f"{name}.vertices",
                unit="m",
                shape=(len(self.shape.vertices), 3),
                value=tuple(float(x) for corner in self.shape.vertices for x in corner),
                doc="Corners of the convex shape, in the frame of its center of mass.",
            )

    def _size(self, name: str) -> Variable:
        if self.shape is None:
            return block_size(f"{name}.size", SIZE)
        return Fixed(
            name=f"{name}.size",
            unit="m",
            shape=(3,),
            value=tuple(extents(self.shape).tolist()),
            doc="Edge lengths of the box around the shape, in its own frame.",
        )

    def form(self, name: str) -> tuple[str, ...]:
        """Name the variables that say how high block or goal is on the floor."""
        form = "size" if self.shape is None else "vertices"
        return f"{name}.{form}", f"{name}.orientation"

    def tool(
        self,
        *,
        spaces: tuple[Box, Box] | None = None,
        start: Function | None = None,
        causes: tuple[str, ...] = (),
    ) -> Entity:
        """Describe the block.

        Args:
            spaces: A and B of its cylindrical position; those on the floor if None.
            start: Where it begins, if that has further causes than size, orientation and shape.
            causes: The further ones.
        """
        corners = () if self.shape is None else (f"{TOOL}.vertices",)
        return ToolBlock(
            TOOL,
            size=self._size(TOOL),
            mass=block_mass(f"{TOOL}.mass", default=self._mass),
            spawn=start or Function(stand, constants={"place": self.place}),
            spawn_from=(*corners, *causes),
            spaces=spaces or numbers.places(self.level(TOOL), airborne=False),
            hull=self.shape,
            orientation=self._turns[TOOL],
        )

    def goal(
        self,
        *place: Variable,
        spaces: tuple[Box, Box] | None = None,
        inverse: Callable[[Floats], Floats] = from_cylindrical,
    ) -> Entity:
        """Describe the goal; a shape keeps to the side it rests on.

        Args:
            place: Its position, and the causes of it.
            spaces: A and B of its cylindrical position; those on the floor if None.
            inverse: Cartesian position where a cylindrical one is set.
        """
        rest, box = self._turns[GOAL], self.shape is None
        pose = (*place, goal_orientation(GOAL, default=rest))
        if not box:
            circle = Box(-np.pi, np.pi)
            yaw = numbers.Range(circle, circle, circle, "rad").declare(
                f"{GOAL}.yaw",
                0.0,
                "How far it is turned about the vertical from the way it rests.",
            )
            turn = Function(shapes.about_z, constants={"rest": rest})
            pose = (*place, yaw, goal_orientation(GOAL, parents=(yaw.name,), mechanism=turn))
        return GoalBlock(
            GOAL,
            size=self._size(GOAL),
            pose=pose,
            spaces=spaces or numbers.places(self.level(GOAL), airborne=False),
            yaw=box,
            hull=self.shape,
            inverse=inverse,
        )


BLOCK, TARGET = f"{TOOL}.cartesian_position", f"{GOAL}.cartesian_position"
WAS = Parent(BLOCK, 1)

TIPS_TO_BLOCK = "tips_to_block", kernels.tips_progress, (TIPS, TIPS_WAS, BLOCK, WAS)
TURNED = (
    "orientation",
    kernels.turn_progress,
    (f"{TOOL}.orientation", Parent(f"{TOOL}.orientation", 1), f"{GOAL}.orientation"),
)
"""Reward terms of several tasks with one block."""
