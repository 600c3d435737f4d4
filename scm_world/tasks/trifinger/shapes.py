"""Boxes and convex hulls that stand on the floor, and blocks that are parts of something."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from scm_world._types import Floats, Value
from scm_world.errors import UnknownOption
from scm_world.geometry import (
    aabb_overlap_fraction,
    canonical,
    from_rotation_vector,
    quaternion_product,
    rotation_matrix,
)
from scm_world.geometry.hulls import Hull, hull_of, hull_overlap
from scm_world.tasks.base import finite_numbers
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger.entities.block_world import lowest_point
from scm_world.tasks.trifinger.entities.blocks import ToolBlock, block_mass
from scm_world.tasks.trifinger.entities.goals import (
    GoalBlock,
    goal_orientation,
    goal_position,
    on_the_floor,
)
from scm_world.variables import Box, Derived, Exogenous, Fixed, Function
from scm_world.variables.spaces import Bound

Place = tuple[float, float] | tuple[float, float, float]
"""x and y of a center on the floor, or x, y and z [m]."""

Quaternion = tuple[float, float, float, float]


def vertices(name: str, hull: Hull) -> Fixed:
    """Declare the corners of a hull, which cannot change.

    Args:
        name: Of the block or goal.
        hull: Its shape.
    """
    return Fixed(
        name=f"{name}.vertices",
        unit="m",
        shape=(len(hull.vertices), 3),
        value=tuple(float(x) for corner in hull.vertices for x in corner),
        doc="Corners of the convex shape, in the frame of its center of mass.",
    )


def depth(size: Floats, orientation: Floats, *corners: Floats) -> float:
    """Compute how far a body reaches below its center [m].

    Args:
        size: Edge lengths of a box, shape (3,) [m].
        orientation: Quaternion (x, y, z, w).
        corners: Those of a hull, shape (n, 3) [m]; none for a box.
    """
    if not corners:
        return lowest_point(size, orientation)
    return -float((corners[0] @ rotation_matrix(orientation)[2]).min())


def stand(size: Floats, orientation: Floats, *corners: Floats, place: Floats) -> Floats:
    """Stand a body on the floor.

    Args:
        size: Edge lengths of a box, shape (3,) [m].
        orientation: Quaternion (x, y, z, w).
        corners: Those of a hull, shape (n, 3) [m]; none for a box.
        place: x and y of the center, and the height of the lowest point, shape (3,) [m].

    Returns:
        The center, shape (3,) [m].
    """
    return np.array([place[0], place[1], place[2] + depth(size, orientation, *corners)])


def keep_lowest_corner(position: Floats, *parents: Floats) -> Floats:
    """Raise or lower the center of a hull so that its lowest corner stays where it was.

    Args:
        position: Of the center, shape (3,) [m].
        parents: What ``depth`` takes and what else moves the hull, before; then the same after.
    """
    half = len(parents) // 2
    lift = depth(*parents[half : half + 3]) - depth(*parents[:3])
    return np.array([position[0], position[1], position[2] + lift])


def hull_on_the_floor(polar: Floats, corners: Floats, orientation: Floats) -> Floats:
    """Put a hull on the floor at a radius and an angle.

    Args:
        polar: Radius [m] and angle [rad], shape (..., 2).
        corners: Shape (..., n, 3) [m].
        orientation: Quaternion (x, y, z, w), shape (..., 4).

    Returns:
        The center of mass, shape (..., 3) [m].
    """
    upwards = rotation_matrix(orientation)[..., 2, :]
    rest = -np.einsum("...ni,...i->...n", corners, upwards).min(axis=-1)
    return on_the_floor(polar, 2.0 * np.stack([rest, rest, rest], axis=-1))


def about_z(yaw: Value, *, rest: Floats) -> Floats:
    """Turn an orientation about the vertical, shape (..., 4).

    Args:
        yaw: Angle, shape (...) [rad].
        rest: Quaternion (x, y, z, w).
    """
    angle = np.asarray(yaw, dtype=np.float64)[..., None] * [0.0, 0.0, 1.0]
    return canonical(quaternion_product(from_rotation_vector(angle), rest))


def yaw_of(name: str) -> Exogenous:
    """Declare by how much something is turned about the vertical from how it rests [rad]."""
    circle = Box(-np.pi, np.pi)
    return Exogenous(
        name=f"{name}.yaw",
        unit="rad",
        bounds=circle,
        a=circle,
        b=circle,
        doc="How far it is turned about the vertical from the way it rests.",
    )


@lru_cache(maxsize=32)
def _hull(corners: bytes) -> Hull:
    return hull_of(np.frombuffer(corners).reshape(-1, 3))


def hull_filled(
    corners: Floats,
    position: Floats,
    orientation: Floats,
    goal_corners: Floats,
    goal_position: Floats,
    goal_orientation: Floats,
) -> float:
    """Compute the fraction of a hull that another one fills, in [0, 1].

    Args:
        corners: Of the block, shape (n, 3) [m].
        position: Its center of mass, shape (3,) [m].
        orientation: Its quaternion (x, y, z, w).
        goal_corners: Of the goal, shape (m, 3) [m].
        goal_position: Shape (3,) [m].
        goal_orientation: Quaternion.
    """
    block, goal = _hull(corners.tobytes()), _hull(goal_corners.tobytes())
    shared = hull_overlap(block, position, orientation, goal, goal_position, goal_orientation)
    return min(1.0, shared / goal.volume)


def hull_aligned(*poses: Floats) -> float:
    """Compute the predecessor's overlap of two hulls: that of the axis-aligned boxes around them.

    Args:
        poses: As in ``hull_filled``.
    """
    boxes: list[Floats] = []
    for corners, position, orientation in (poses[:3], poses[3:]):
        turned = corners @ rotation_matrix(orientation).T
        low, high = turned.min(axis=0), turned.max(axis=0)
        boxes += [high - low, position + (low + high) / 2.0, np.array(numbers.IDENTITY)]
    return aabb_overlap_fraction(*(box[None] for box in boxes))


def rest_height(hull: Hull, orientation: Quaternion = numbers.IDENTITY) -> float:
    """Give the height of the center of a hull on the floor [m].

    Args:
        hull: The shape.
        orientation: Quaternion (x, y, z, w).
    """
    return depth(np.zeros(3), np.array(orientation), np.array(hull.vertices))


def level(size: str, hull: Hull | None, rest: Quaternion) -> Bound:
    """Give the height of the center of a body on the floor, as a bound of a space.

    Args:
        size: Name of the variable that holds the edge lengths of a box, which is upright.
        hull: The shape, if it is no box.
        rest: How a hull rests: quaternion (x, y, z, w).
    """
    return numbers.half_height(size) if hull is None else rest_height(hull, rest)


def block_spaces(
    size: str,
    *,
    airborne: bool,
    hull: Hull | None = None,
    rest: Quaternion = numbers.IDENTITY,
) -> tuple[Box, Box]:
    """Give the spaces A and B of the cylindrical position of a block.

    Args:
        size: Name of the variable that holds the edge lengths of a box.
        airborne: Whether blocks may begin in the air, as in the predecessor.
        hull: The shape, if it is no box.
        rest: How a hull rests: quaternion (x, y, z, w).
    """
    low = level(size, hull, rest)
    tops = (numbers.HEIGHT_A, numbers.HEIGHT_B) if airborne else (low, low)
    a, b = (
        numbers.cylindrical(radii, low, top)
        for radii, top in zip((numbers.RADIUS_A, numbers.RADIUS_B), tops, strict=True)
    )
    return a, b


def start_place(option: str, place: Place, below: float) -> tuple[float, float, float]:
    """Say where a block begins: x and y of its center, and the height of its lowest point [m].

    Args:
        option: Its name, for the error.
        place: x and y, for a block on the floor, or x, y and z of the center [m].
        below: How far it reaches below its center [m].

    Raises:
        UnknownOption: These are not two or three numbers, or it would reach below the floor.
    """
    point = _checked(option, place)
    height = point[2] - below if len(point) == 3 else 0.0
    if height < -1e-6:
        raise UnknownOption(option, place, ("x, y", f"x, y and z >= {below:g} [m]"))
    return point[0], point[1], max(height, 0.0)


def floor_place(option: str, place: Place, height: float) -> tuple[float, float]:
    """Read x and y of something that stands on the floor [m].

    Args:
        option: Its name, for the error.
        place: x and y, or x, y and z of the center [m].
        height: The only z it can have [m].

    Raises:
        UnknownOption: These are not two or three numbers, or it would not stand on the floor.
    """
    point = _checked(option, place)
    if len(point) == 3 and abs(point[2] - height) > 1e-6:
        raise UnknownOption(option, place, ("x, y", f"x, y, {height:g} [m]: it is on the floor"))
    return point[0], point[1]


def unit_quaternion(option: str, orientation: Quaternion) -> Quaternion:
    """Read an orientation as a unit quaternion (x, y, z, w) with w >= 0.

    Raises:
        UnknownOption: These are not four numbers, or they are all zero.
    """
    given = finite_numbers(orientation)
    if given is None or given.shape != (4,) or not given.any():
        raise UnknownOption(option, orientation, ("a quaternion x, y, z, w",))
    x, y, z, w = canonical(given).tolist()
    return x, y, z, w


def turn_of(option: str, orientation: Quaternion, hull: Hull | None) -> Quaternion:
    """Read how a body begins turned; a hull is turned from the way its points were given.

    Raises:
        UnknownOption: See ``unit_quaternion``.
    """
    turn = unit_quaternion(option, orientation)
    if hull is None:
        return turn
    x, y, z, w = canonical(quaternion_product(turn, hull.axes)).tolist()
    return x, y, z, w


def _checked(option: str, place: Place) -> tuple[float, ...]:
    point = finite_numbers(place)
    if point is None or point.shape not in ((2,), (3,)):
        raise UnknownOption(option, place, ("x, y", "x, y, z [m]"))
    return tuple(point.tolist())


MASS = "blocks_mass"

MOST_PARTS = 512
"""Of how many parts block and goal are kept for when they come again: they are immutable, and most
structures of a family have them."""

Mechanism = tuple[tuple[str, ...], Function]
"""Parents, and the function of them."""


def blocks_mass(default: float) -> Exogenous:
    """Declare the mass that all blocks share.

    Args:
        default: Without an intervention [kg].
    """
    return numbers.SHARED_MASSES.root(
        MASS, default, "Mass of every block, unless a block is given another one."
    )


def part_size(name: str, size: Mechanism) -> Derived:
    """Declare the edge lengths of a block that is a part of something [m].

    Args:
        name: Of the block or goal.
        size: Where they come from.
    """
    return numbers.PART_SIZES.derived(f"{name}.size", *size, "Full edge lengths.")


def part_tool(name: str, *, size: Mechanism, spawn: Mechanism, airborne: bool) -> ToolBlock:
    """Describe a block that is a part of something.

    Args:
        name: Of the block.
        size: Where its edge lengths come from.
        spawn: Where it begins: further causes than its size and orientation, and the function of
            all of them. When one of them changes, the block is put there again.
        airborne: Whether its spaces reach into the air, as in the predecessor.
    """
    causes, start = spawn
    a, b = block_spaces(f"{name}.size", airborne=airborne)
    return ToolBlock(
        name,
        size=part_size(name, size),
        mass=block_mass(f"{name}.mass", MASS),
        spawn=start,
        spawn_from=causes,
        spawn_again=True,
        a=a,
        b=b,
    )


def part_goal(
    name: str, *, size: Mechanism, position: Mechanism, orientation: Mechanism | None = None
) -> GoalBlock:
    """Describe the goal of a block that is a part of something. It has no spaces of its own.

    Args:
        name: Of the goal.
        size: Where its edge lengths come from.
        position: Where its center comes from.
        orientation: Where its quaternion comes from; it is upright if None.
    """
    turned = orientation or ((), None)
    pose = (
        goal_position(name, parents=position[0], mechanism=position[1]),
        goal_orientation(name, parents=turned[0], mechanism=turned[1]),
    )
    return GoalBlock(name, size=part_size(name, size), pose=pose, yaw=False)
