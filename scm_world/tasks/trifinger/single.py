"""The families with one block that should fill one goal of its shape."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, ClassVar, Unpack, final

import numpy as np

from scm_world._types import ArrayLike, Floats, Value
from scm_world.errors import ModelError, UnknownOption
from scm_world.geometry.coordinates import from_cylindrical
from scm_world.geometry.hulls import Hull
from scm_world.geometry.rotations import canonical, quaternion_product
from scm_world.tasks.base import checked, some_numbers
from scm_world.tasks.composition import Entity
from scm_world.tasks.rewards import FRACTION, Common, weighted
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger import kernels
from scm_world.tasks.trifinger.base import TriFingerTask
from scm_world.tasks.trifinger.catalogue import Causes
from scm_world.tasks.trifinger.entities.bodies import (
    Place,
    Quaternion,
    about_z,
    block_size,
    body,
    hull_on_the_floor,
    lowest_point,
    obstacle,
    orientation,
    position,
    stand,
    tool,
    turned_on_the_floor,
)
from scm_world.tasks.trifinger.kernels import BLOCK, GOAL, TARGET, TIPS, TOOL, TURNED, WAS
from scm_world.variables import Box, Fixed, Function, Switch, Variable
from scm_world.variables.spaces import Bound

SIZE = "block.size"


def start_place(option: str, place: Place, below: float) -> tuple[float, float, float]:
    """Read where a block begins: x and y of its center, and the height of its lowest point [m].

    It stands on the floor if no z is given, and reaches so far ``below`` its center [m].

    Raises:
        UnknownOption: These are not two or three numbers, or it would reach below the floor.
    """
    x, y, *z = some_numbers(option, place, (2, 3), "x, y", "x, y, z [m]")
    height = z[0] - below if z else 0.0
    if height < -1e-6:
        raise UnknownOption(option, place, ("x, y", f"x, y and z >= {below:g} [m]"))
    return x, y, max(height, 0.0)


def floor_place(option: str, place: Place, height: float) -> tuple[float, float]:
    """Read the place of something on the floor: radius [m] and angle [rad].

    ``height`` is the only z of the center that can be given [m].

    Raises:
        UnknownOption: These are not two or three numbers, or it would not stand on the floor.
    """
    x, y, *z = some_numbers(option, place, (2, 3), "x, y", "x, y, z [m]")
    if z and abs(z[0] - height) > 1e-6:
        raise UnknownOption(option, place, ("x, y", f"x, y, {height:g} [m]: it is on the floor"))
    return math.hypot(x, y), math.atan2(y, x)


def unit_quaternion(option: str, orientation: Quaternion) -> Quaternion:
    """Read an orientation as a unit quaternion (x, y, z, w) with w >= 0.

    Raises:
        UnknownOption: These are not four numbers, or they are all zero.
    """
    allowed = "a quaternion x, y, z, w"
    given = some_numbers(option, orientation, (4,), allowed)
    if not any(given):
        raise UnknownOption(option, orientation, (allowed,))
    x, y, z, w = canonical(np.array(given)).tolist()
    return x, y, z, w


class BlockOptions(Common, total=False):
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


class OneBlock(TriFingerTask):
    """A block and a goal of the same shape.

    The blocks share the parent ``block.size``. An intervention on it keeps them alike; one on
    the pose of one leaves the other where it is.

    Args:
        tool_block_position: Where the center of the block begins: x and y if it stands on the
            floor, or x, y and z [m].
        options: Of block, goal and every task; see ``BlockOptions`` and ``Common``.

    Attributes:
        place: x and y of the block at the start, and the height of its lowest point [m].
    """

    options = BlockOptions
    targets: ClassVar[dict[str, str]] = {GOAL: TOOL}
    ready_terms = kernels.ONE_BLOCK

    def __init__(self, tool_block_position: Place, **options: Unpack[BlockOptions]) -> None:
        common: dict[str, Any] = {**options}
        self.shape = common.pop("shape", None)
        if not (self.shape is None or isinstance(self.shape, Hull)):
            raise ModelError(
                [f"shape must be a Hull: load_hull(path) or hull_of(points); {self.shape!r}"]
            )
        mass = common.pop("tool_block_mass", numbers.BLOCK_MASS)
        self._mass = checked("tool_block_mass", mass, numbers.BLOCK_MASSES.bounds)
        self._turns = dict[str, Quaternion]()
        for name in (TOOL, GOAL):
            option = f"{name}_orientation"
            turn = unit_quaternion(option, common.pop(option, numbers.IDENTITY))
            if self.shape is not None:  # it is turned from the way its points were given
                x, y, z, w = canonical(quaternion_product(turn, self.shape.axes)).tolist()
                turn = x, y, z, w
            self._turns[name] = turn
        self.place = start_place("tool_block_position", tool_block_position, self.below(TOOL))
        super().__init__(**common)
        if self.shape is not None:  # it turns about the vertical only
            turns = {f"{GOAL}.euler_orientation": f"{GOAL}.yaw"}
            self.goal_causes = tuple(turns.get(name, name) for name in self.goal_causes)

    def below(self, name: str) -> float:
        """Compute how far block or goal reaches below its center as it begins [m]."""
        corners = () if self.shape is None else (np.array(self.shape.vertices),)
        return lowest_point(np.array(numbers.BLOCK_SIZE), np.array(self._turns[name]), *corners)

    def level(self, name: str) -> Bound:
        """Return the height of the center of block or goal on the floor, as a bound of a space."""
        return numbers.half_height(f"{name}.size") if self.shape is None else self.below(name)

    def shared(self) -> Iterable[Variable]:
        """Declare one size, or one shape, for both."""
        if self.shape is None:
            yield block_size(SIZE)
            return
        for name in (TOOL, GOAL):
            doc = "Corners of the convex shape, in the frame of its center of mass."
            yield _constant(f"{name}.vertices", self.shape.vertices, doc)

    def _size(self, name: str) -> Variable:
        if self.shape is None:
            return block_size(f"{name}.size", SIZE)
        doc = "Edge lengths of the box around the shape, in its own frame."
        return _constant(f"{name}.size", np.ptp(self.shape.vertices, axis=0), doc)

    def tool_block(
        self,
        *causes: str,
        spaces: tuple[Box, Box] | None = None,
        start: Function | None = None,
    ) -> Entity:
        """Describe the block.

        Args:
            causes: Further causes of the place at the start, besides size, orientation and shape.
            spaces: A and B of its cylindrical position; those on the floor if None.
            start: Where it begins; it stands at ``place`` if None.
        """
        return tool(
            TOOL,
            self._size(TOOL),
            numbers.BLOCK_MASSES.root(f"{TOOL}.mass", self._mass),
            start=start or Function(stand, constants={"place": self.place}),
            start_from=(*(() if self.shape is None else (f"{TOOL}.vertices",)), *causes),
            turn=self._turns[TOOL],
            hull=self.shape,
            spaces=spaces or numbers.places(self.level(TOOL), airborne=False),
        )

    def goal_block(
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
        pose = (*place, orientation(GOAL, default=rest))
        if not box:
            circle = Box(-np.pi, np.pi)
            doc = "How far it is turned about the vertical from the way it rests."
            yaw = numbers.Range(circle, circle, circle, "rad").root(f"{GOAL}.yaw", 0.0, doc)
            pose = (*place, yaw, orientation(GOAL, (about_z, yaw.name), {"rest": rest}))
        spaces = spaces or numbers.places(self.level(GOAL), airborne=False)
        how: dict[str, Any] = {"spaces": spaces, "yaw": box, "inverse": inverse}
        return body("goal", GOAL, self._size(GOAL), *pose, hull=self.shape, **how)

    def form(self, box: Callable[..., Any], hull: Callable[..., Any], *causes: str) -> Causes:
        """Return a function of a box or of a hull, with its causes: these, shape, orientation."""
        function, form = (box, "size") if self.shape is None else (hull, "vertices")
        return function, *causes, f"{GOAL}.{form}", f"{GOAL}.orientation"


def _constant(name: str, value: ArrayLike, doc: str) -> Variable:
    """Declare lengths that cannot change [m]."""
    given = np.asarray(value, dtype=np.float64)
    return Fixed(
        name=name, unit="m", shape=given.shape, value=tuple(given.ravel().tolist()), doc=doc
    )


# --- pushing --------------------------------------------------------------------------------------


class Pushing(OneBlock):
    """One tool block and one goal block of the same size, both on the floor.

    Args:
        tool_block_position: Where the center of the block begins: x and y if it stands on the
            floor, or x, y and z [m].
        goal_block_position: Default x and y of the goal, which is on the floor [m].
        options: Of block, goal and every task; see ``BlockOptions`` and ``Common``.
    """

    name = "pushing"
    default_weights, dense_terms = weighted(
        (750.0, *kernels.TIPS_TO_BLOCK),
        (250.0, "block_to_goal", kernels.block_progress, (BLOCK, WAS, TARGET)),
        (100.0, *TURNED),
        fraction=1.0,
    )
    paper_weights = {"reward.orientation": 0.0}  # noqa: RUF012 # a constant
    goal_causes: tuple[str, ...] = (f"{GOAL}.polar", f"{GOAL}.euler_orientation")

    def __init__(
        self,
        *,
        tool_block_position: Place = (0.0, -0.08),
        goal_block_position: Place = (0.0, 0.08),
        **options: Unpack[BlockOptions],
    ) -> None:
        super().__init__(tool_block_position, **options)
        self._polar = floor_place("goal_block_position", goal_block_position, self.below(GOAL))

    def entities(self) -> Iterable[Entity]:
        """A block and its goal."""
        causes = self.form(turned_on_the_floor, hull_on_the_floor, f"{GOAL}.polar")
        polar = numbers.POLAR.root(f"{GOAL}.polar", self._polar)
        return self.tool_block(), self.goal_block(polar, position(GOAL, causes))


# --- picking --------------------------------------------------------------------------------------

HEIGHT = f"{GOAL}.height"
HEIGHT_A = (0.08, 0.2)  # [m] of the center of the goal
HEIGHT_B = (0.2, 0.25)


def lifted(height: Value, *, place: Floats) -> Floats:
    """Put something at a height above a place (x and y), shape (..., 3) [m]."""
    at = np.broadcast_to(place, (*np.shape(height), 2))
    return np.concatenate([at, np.asarray(height)[..., None]], axis=-1)


def put(*parents: Floats, center: Floats) -> Floats:
    """Put a block at its place, however large it is and however it is turned, shape (3,) [m].

    Source: CausalWorld 1.2: in picking alone, blocks that grow reach into the floor.
    """
    return np.array(center)


def above_the_center(cylindrical: Floats) -> Floats:
    """Put a goal above the centre of the arena, at the height of a cylindrical position [m].

    Source: CausalWorld 1.2, ``task_generators/picking.py``,
    ``_handle_contradictory_interventions``; radius and azimuth are ignored.
    """
    return np.asarray(cylindrical, dtype=np.float64) * (0.0, 0.0, 1.0)


@final
class Picking(OneBlock):
    """A block on the floor, and a goal of the same size in the air above its place.

    How high the goal is does not depend on the size.

    Args:
        tool_block_position: Where the center of the block begins: x and y if it stands on the
            floor, or x, y and z [m]. The goal is above it.
        goal_height: Default height of the center of the goal [m].
        options: Of block, goal and every task; see ``BlockOptions`` and ``Common``.
    """

    name = "picking"
    default_weights, dense_terms = weighted(
        (250.0, "block_to_height", kernels.height_progress, (BLOCK, WAS, TARGET)),
        (0.0, "height_error", kernels.minus_height_error, (BLOCK, TARGET)),
        (125.0, "block_to_center", kernels.centering_progress, (BLOCK, WAS)),
        (0.0, "center_distance", kernels.minus_eccentricity, (BLOCK,)),
        (750.0, *kernels.TIPS_TO_BLOCK),
        (0.0, "tips_distance", kernels.minus_tips_distance, (TIPS, BLOCK)),
        (0.0, "grasp", kernels.minus_grasp_distance, (TIPS, BLOCK, f"{TOOL}.size")),
        (0.005, *kernels.SMOOTHNESS),
        fraction=1.0,
    )
    goal_causes = (HEIGHT,)

    def __init__(
        self,
        *,
        tool_block_position: Place = (0.0, 0.0),
        goal_height: float = 0.15,
        **options: Unpack[BlockOptions],
    ) -> None:
        super().__init__(tool_block_position, **options)
        heights = numbers.Range(Box(0.0, 0.5), Box(*HEIGHT_A), Box(*HEIGHT_B), "m")
        self._height = heights.option(HEIGHT, goal_height, "Height of its center.", "goal_height")

    def entities(self) -> Iterable[Entity]:
        """A block and its goal."""
        published, (x, y, z) = self.conventions.published, self.place
        start = Function(put, constants={"center": (x, y, z + self.below(TOOL))})
        yield self.tool_block(
            spaces=numbers.places(self.level(TOOL), airborne=published),
            start=start if published else None,
        )
        yield self.goal_block(
            self._height,
            position(GOAL, (lifted, HEIGHT), {"place": (x, y)}),
            spaces=self._above(),
            inverse=above_the_center if published else from_cylindrical,
        )

    def _above(self) -> tuple[Box, Box]:
        """Return the cylindrical positions above the block's place; at radius 0 any angle will do.

        The predecessor publishes wider spaces, and moves every value that is drawn or set above the
        centre of the arena; see ``above_the_center``.
        """
        if self.conventions.published:
            return (
                numbers.cylindrical(numbers.RADIUS_A, *HEIGHT_A),
                numbers.cylindrical(numbers.RADIUS_B, *HEIGHT_B),
            )
        x, y, _ = self.place
        radius, angle = math.hypot(x, y), math.atan2(y, x)
        low, high = (angle, angle) if radius > 0.0 else (-math.pi, math.pi)
        a, b = (
            Box((radius, low, bottom), (radius, high, top)) for bottom, top in (HEIGHT_A, HEIGHT_B)
        )
        return a, b


# --- pick and place -------------------------------------------------------------------------------

WALL = "obstacle"
SIDE = "wall_side"

WALL_SIZE = (0.5, 0.015, 0.065)  # [m]
WALL_A = Box((0.5, 0.015, 0.02), (0.5, 0.015, 0.065))
WALL_B = Box((0.5, 0.015, 0.065), (0.5, 0.015, 0.1))
RADIUS_A = (0.07, 0.12)  # [m]
RADIUS_B = (0.12, 0.15)
ANGLES = (math.pi / 6, 5 * math.pi / 6)  # [rad] on the side where y > 0


def mirrored(polar_position: Floats, side: Value) -> Floats:
    """Reflect a radius [m] and an angle [rad] at the wall where the side is 1, shape (..., 2)."""
    sign = 1.0 - 2.0 * np.asarray(side)
    return polar_position * np.stack([np.ones_like(sign), sign], axis=-1)


def goal_across(side: Value, polar_position: Floats, size: Floats, orientation: Floats) -> Floats:
    """Put a box on the floor on its side of the wall, shape (..., 3) [m]."""
    return turned_on_the_floor(mirrored(polar_position, side), size, orientation)


def hull_across(
    side: Value, polar_position: Floats, corners: Floats, orientation: Floats
) -> Floats:
    """Put a hull on the floor on its side of the wall, shape (..., 3) [m]."""
    return hull_on_the_floor(mirrored(polar_position, side), corners, orientation)


def stand_across(size: Floats, orientation: Floats, *causes: Value, place: Floats) -> Floats:
    """Stand a body on its side of the wall, shape (3,) [m].

    The last of ``causes`` is the side; ``place`` is where it stands on side 0, see ``stand``.
    """
    *corners, side = causes
    sign = 1.0 - 2.0 * float(side)
    return stand(size, orientation, *corners, place=place * [1.0, sign, 1.0])


def wall_on_the_floor(size: Floats) -> Floats:
    """Put a box on the floor in the middle of the arena: its center, shape (..., 3) [m]."""
    return np.asarray(size * [0.0, 0.0, 0.5])


@final
class PickAndPlace(Pushing):
    """A wall, a block on one side of it, and a goal of the same size on the other.

    The blocks share the parents ``block.size`` and ``wall_side``. Which side the block begins
    on decides where the goal is, so that the wall is always between them; the wall stands on the
    floor however high it is.

    Args:
        options: Those of pushing, for ``wall_side`` 0; block and goal are at y of -0.09 and 0.09 m.
    """

    name = "pick_and_place"
    default_weights, dense_terms = weighted(
        (750.0, *kernels.TIPS_TO_BLOCK),
        (50.0, "block_to_goal", kernels.horizontal_progress, (BLOCK, WAS, TARGET)),
        (250.0, "block_to_height", kernels.crossing_progress, (BLOCK, WAS, TARGET, f"{GOAL}.size")),
        (0.0, *TURNED),
        (0.005, *kernels.SMOOTHNESS),
        fraction=0.0,
    )
    paper_weights = {FRACTION: 1.0}  # noqa: RUF012 # a constant
    obstacles = (WALL,)
    goal_causes = (SIDE, f"{GOAL}.polar", f"{GOAL}.euler_orientation")

    def __init__(self, **options: Any) -> None:
        at = {"tool_block_position": (0.0, -0.09), "goal_block_position": (0.0, 0.09)}
        super().__init__(**{**at, **options})

    def entities(self) -> Iterable[Entity]:
        """A block, its goal and the wall between them."""
        start = Function(stand_across, constants={"place": self.place})
        yield self.tool_block(SIDE, spaces=self._sector(TOOL, sign=-1.0), start=start)
        a, b = (Box((near, ANGLES[0]), (far, ANGLES[1])) for near, far in (RADIUS_A, RADIUS_B))
        yield self.goal_block(
            replace(numbers.POLAR, a=a, b=b).root(f"{GOAL}.polar", self._polar),
            position(GOAL, self.form(goal_across, hull_across, SIDE, f"{GOAL}.polar")),
            spaces=self._sector(GOAL, sign=1.0),
        )
        sizes = replace(numbers.OBSTACLE_SIZES, a=WALL_A, b=WALL_B)
        size = sizes.root(f"{WALL}.size", WALL_SIZE)
        center = (0.0, 0.0, WALL_SIZE[2] / 2.0)
        place = position(WALL, default=center)  # in the predecessor it keeps its center
        if not self.conventions.published:
            doc = "Position of the center; it stands on the floor in the middle."
            follows = (wall_on_the_floor, size.name)
            place = numbers.POSITIONS.derived(f"{WALL}.cartesian_position", follows, doc)
        yield obstacle(WALL, size, place)

    def _sector(self, name: str, *, sign: float) -> tuple[Box, Box]:
        """Return the cylindrical positions on one side of the wall; ``sign`` of y on side 0."""
        height = self.level(name)
        near, far = ANGLES if sign > 0.0 else (-ANGLES[1], -ANGLES[0])
        low = Switch(parent=SIDE, below=near, above=-far)
        high = Switch(parent=SIDE, below=far, above=-near)
        a, b = (
            Box((inner, low, height), (outer, high, height))
            for inner, outer in (RADIUS_A, RADIUS_B)
        )
        return a, b

    def shared(self) -> Iterable[Variable]:
        """One size for both, and on which side of the wall they are."""
        yield from super().shared()
        yield numbers.SIDES.root(
            SIDE,
            0,
            "Where the block begins: 0 is at negative y, 1 at positive y; the goal is across.",
        )
