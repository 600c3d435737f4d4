"""Blocks, obstacles and goals: solids with a pose, and how they stand on the floor."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from scm_world._types import Floats, Value
from scm_world.geometry.coordinates import from_cylindrical, to_cylindrical
from scm_world.geometry.hulls import Hull
from scm_world.geometry.rotations import (
    canonical,
    from_rotation_vector,
    quaternion_product,
    rotation_matrix,
    to_rotation_vector,
)
from scm_world.tasks.composition import Entity
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger.catalogue import IDENTITY, ZERO, Causes, Constants, Numbers
from scm_world.tasks.trifinger.hardware import ARENA_HALF_WIDTH, ARENA_HEIGHT
from scm_world.variables import Box, Categories, Fixed, Function, Integers, Variable

Place = tuple[float, float] | tuple[float, float, float]
"""x and y of a center on the floor, or x, y and z [m]."""

Quaternion = tuple[float, float, float, float]
Spaces = tuple[Box | None, Box | None]

# --- standing on the floor ------------------------------------------------------------------------


def lowest_point(size: Floats, orientation: Floats, *corners: Floats) -> float:
    """Compute how far a body reaches below its center [m].

    Args:
        size: Edge lengths of a box, shape (3,) [m].
        orientation: Quaternion (x, y, z, w).
        corners: Those of a hull, shape (n, 3) [m]; none for a box.
    """
    if corners:
        return -float((corners[0] @ rotation_matrix(orientation)[2]).min())
    x, y, z, w = orientation.tolist()
    length, width, height = size.tolist()
    row = (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))
    return 0.5 * float(abs(row[0]) * length + abs(row[1]) * width + abs(row[2]) * height)


def stand(size: Floats, orientation: Floats, *corners: Floats, place: Floats) -> Floats:
    """Stand a body on the floor: compute its center, shape (3,) [m]; see ``lowest_point``.

    ``place`` is x and y of the center, and the height of the lowest point, shape (3,) [m].
    """
    return np.array([place[0], place[1], place[2] + lowest_point(size, orientation, *corners)])


def keep_lowest_point(position: Floats, *parents: Floats, form: float = 2.0) -> Floats:
    """Raise or lower the center so that the lowest point stays where it was.

    A block that grows does not sink into the floor, and one that shrinks does not hang above it.

    Args:
        position: Place of the center, shape (3,) [m].
        parents: What ``lowest_point`` takes and what else moves it, before; then the same after.
        form: How many of them ``lowest_point`` takes.
    """
    before, after = parents[: len(parents) // 2], parents[len(parents) // 2 :]
    lift = lowest_point(*after[: int(form)]) - lowest_point(*before[: int(form)])
    return np.array([position[0], position[1], position[2] + lift])


def turned_on_the_floor(polar: Floats, size: Floats, orientation: Floats) -> Floats:
    """Put a turned box on the floor: compute its center, shape (..., 3) [m].

    It is at a radius [m] and an angle [rad], shape (..., 2), and its lowest point is on the floor.
    """
    height = (np.abs(rotation_matrix(orientation)[..., 2, :]) * size).sum(axis=-1)
    return _at(polar, height / 2.0)


def hull_on_the_floor(polar: Floats, corners: Floats, orientation: Floats) -> Floats:
    """Put a hull on the floor at a radius [m] and an angle [rad]; see ``turned_on_the_floor``.

    ``corners`` are those of the hull, shape (..., n, 3) [m].
    """
    upwards = rotation_matrix(orientation)[..., 2, :]
    return _at(polar, -np.einsum("...ni,...i->...n", corners, upwards).min(axis=-1))


def _at(polar: Floats, height: Floats) -> Floats:
    """Compute a center, shape (..., 3) [m], from radius [m] and angle [rad], and its height [m]."""
    radius, angle = polar[..., 0], polar[..., 1]
    planar = radius * np.cos(angle), radius * np.sin(angle)
    return np.stack(np.broadcast_arrays(*planar, height), axis=-1)


def about_z(yaw: Value, *, rest: Floats) -> Floats:
    """Turn a quaternion about the vertical by an angle [rad], shape (..., 4)."""
    angle = np.asarray(yaw, dtype=np.float64)[..., None] * [0.0, 0.0, 1.0]
    return canonical(quaternion_product(from_rotation_vector(angle), rest))


# --- declarations ---------------------------------------------------------------------------------


def block_size(
    name: str, causes: Causes | None = None, *, default: tuple[float, ...] = numbers.BLOCK_SIZE
) -> Variable:
    """Declare the full edge lengths of a block [m]: a root, or what follows from causes."""
    return numbers.BLOCK_SIZES.either(name, default, causes)


def position(
    name: str, causes: Causes | None = None, constants: Constants = None, *, default: Numbers = ZERO
) -> Variable:
    """Declare the center of a goal or obstacle [m]: a root, or what follows from causes."""
    return numbers.POSITIONS.either(f"{name}.cartesian_position", default, causes, constants)


def orientation(
    name: str,
    causes: Causes | None = None,
    constants: Constants = None,
    *,
    default: Numbers = IDENTITY,
) -> Variable:
    """Declare the quaternion of a goal or obstacle: a root, or what follows from causes."""
    return numbers.ORIENTATIONS.either(f"{name}.orientation", default, causes, constants)


def coordinates(
    name: str,
    *,
    spaces: Spaces = (None, None),
    yaw: bool = True,
    inverse: Callable[[Floats], Floats] = from_cylindrical,
) -> Iterable[Variable]:
    """Declare the other coordinates of a pose: cylindrical position and rotation vector.

    Args:
        name: Prefix.
        spaces: A and B of the cylindrical position.
        yaw: Whether the rotation vector has A and B: the turns about z.
        inverse: Cartesian position where a cylindrical one is set.
    """
    yield numbers.Range(None, *spaces, "m, rad, m", (3,)).derived(
        f"{name}.cylindrical_position",
        (to_cylindrical, f"{name}.cartesian_position"),
        "Position as radius, angle and height; setting it sets the Cartesian position.",
        inverse=inverse,
    )
    yield (numbers.YAWS if yaw else replace(numbers.YAWS, a=None, b=None)).derived(
        f"{name}.euler_orientation",
        (to_rotation_vector, f"{name}.orientation"),
        inverse=from_rotation_vector,
    )


KINDS = {
    "block": ((1, 2), (1.0, 0.0, 0.0)),
    "obstacle": ((10, 10), ZERO),
    "goal": ((20, 23), numbers.GOAL_COLOR),
    "sphere": ((21, 21), numbers.GOAL_COLOR),
}
"""The published ids of kinds of objects, of boxes and of those with another shape; their color."""


def body(
    kind: str,
    name: str,
    *own: Variable,
    states: Iterable[Variable] = (),
    color: tuple[float, float, float] | None = None,
    hull: Hull | None = None,
    **how: Any,
) -> Entity:
    """Describe a block, an obstacle or a goal.

    Args:
        kind: One of ``KINDS``.
        name: Prefix of its variables.
        own: Declarations of its size, of its pose unless physics moves it, and of what else it has.
        states: Declarations of what physics moves.
        color: Default color; that of its kind if None.
        hull: Its shape, if it is not a box or a ball.
        how: Arguments of ``coordinates``.
    """
    types, usual = KINDS[kind]
    published = Fixed(
        name=f"{name}.type",
        dtype="categorical",
        bounds=Categories((1, 2, 10, 20, 21, 23)),
        value=types[hull is not None],
        doc="Published id of the kind of object.",
    )
    paint = numbers.COLOR.root(f"{name}.color", usual if color is None else color)
    variables = (published, *own, paint, *coordinates(name, **how), *states)
    if kind == "sphere":
        return Entity(name, variables, kind="goal", shape=kind)
    return Entity(name, variables, kind=kind, hull=hull)


def constantly(*_: Floats, value: Floats) -> Floats:
    """Return a constant; parents do not matter."""
    return value


def tool(
    name: str,
    size: Variable,
    mass: Variable,
    *,
    start: Function,
    start_from: tuple[str, ...] = (),
    start_again: bool = False,
    turn: Quaternion = IDENTITY,
    hull: Hull | None = None,
    **how: Any,
) -> Entity:
    """Describe a block that the robot may move.

    Args:
        name: Prefix of its variables.
        size: The declaration of ``<name>.size``; a constant if it is a hull.
        mass: The declaration of ``<name>.mass``.
        start: Where it stands at the start: a function of its size, its orientation and of
            ``start_from``. Setting one of those puts it there again.
        start_from: Further causes of the place at the start; the corners of a hull come first.
        start_again: Whether a size that is set does so too; else the block then keeps its lowest
            point.
        turn: How it begins turned: quaternion (x, y, z, w).
        hull: Its shape, if it is not a box.
        how: Arguments of ``coordinates``.
    """
    restart = (*start_from, size.name) if start_again else start_from
    friction = numbers.BLOCK_FRICTIONS.root(f"{name}.friction", 1.0)
    place = numbers.POSITIONS.state(
        f"{name}.cartesian_position",
        ZERO,
        on_set=(size.name, f"{name}.orientation", *start_from),
        start=start,
        carry=Function(keep_lowest_point, constants={} if hull is None else {"form": 3.0}),
        restart=restart,
    )
    states, again = [place], dict[str, Any]()
    for what, kind, default in (
        ("orientation", numbers.TURNS, turn),
        ("linear_velocity", numbers.LINEAR_VELOCITIES, ZERO),
        ("angular_velocity", numbers.ANGULAR_VELOCITIES, ZERO),
    ):
        if start_again:  # as at the start
            begin = Function(constantly, constants={"value": default})
            again = {"on_set": restart, "start": begin, "restart": restart}
        states.append(kind.state(f"{name}.{what}", default, **again))
    return body("block", name, size, mass, friction, states=states, hull=hull, **how)


# --- obstacles: boxes that nothing moves; their pose holds until the reset ------------------------

COUNT = "number_of_obstacles"
PLACES = "obstacle_places"
MOST = 10
_ANGLE = np.pi * (3.0 - np.sqrt(5.0))  # the golden angle: places never line up


def obstacle(name: str, size: Variable, place: Variable) -> Entity:
    """Describe an obstacle by the declarations of its size and of its position."""
    friction = numbers.FRICTION.root(
        f"{name}.friction", numbers.SURFACE_FRICTION, numbers.BLOCK_FRICTIONS.doc
    )
    return body("obstacle", name, size, place, orientation(name), friction, yaw=False)


def obstacle_names(count: int) -> tuple[str, ...]:
    """Name the first of the small boxes that are scattered over the arena."""
    return tuple(f"obstacle_{index}" for index in range(count))


def place(places: Floats, *, index: float) -> Floats:
    """Return one of the places, shape (..., 3) [m]."""
    return places[..., int(index), :]


def scattering(default: int) -> Iterable[Variable]:
    """Declare how many scattered boxes there are, ``default`` of them, and where they are.

    Raises:
        UnknownOption: The number is out of bounds.
    """
    some = Integers(1, 5)
    counts = numbers.Range(Integers(0, MOST), some, some, dtype="integer")
    yield counts.option(COUNT, default, "How many small boxes are in the way.")
    index = np.arange(MOST)  # between the fingers and above the blocks
    radius, height = 0.05 + 0.008 * index, 0.16 + 0.004 * index
    x, y = radius * np.cos(_ANGLE * index), radius * np.sin(_ANGLE * index)
    inside, top = ARENA_HALF_WIDTH - 0.005, ARENA_HEIGHT - 0.005
    space = Box((-inside, -inside, 0.005) * MOST, (inside, inside, top) * MOST)
    bounds = Box(*(end * MOST for end in numbers.POSITION_ENDS))
    yield numbers.Range(bounds, space, space, "m", (MOST, 3)).root(
        PLACES,
        tuple(np.stack([x, y, height], axis=-1).ravel().tolist()),
        "Where the centers of the obstacles are.",
    )


def scattered(count: int) -> Iterable[Entity]:
    """List the scattered boxes that there are."""
    for index, name in enumerate(obstacle_names(count)):
        size = numbers.OBSTACLE_SIZES.root(f"{name}.size", numbers.OBSTACLE_SIZE)
        yield obstacle(name, size, position(name, (place, PLACES), {"index": float(index)}))
