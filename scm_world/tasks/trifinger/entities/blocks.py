"""Blocks that can be moved, and what they have in common with goals and obstacles."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, final

import numpy as np

from scm_world._types import Floats
from scm_world.geometry.coordinates import from_cylindrical, to_cylindrical
from scm_world.geometry.hulls import Hull
from scm_world.geometry.rotations import from_rotation_vector, rotation_matrix, to_rotation_vector
from scm_world.tasks.composition import Entity
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.variables import Box, Categories, Fixed, Function, Measured, Variable

TYPES = {"block": (1, 2), "obstacle": (10, 10), "goal": (20, 23), "sphere": (21, 21)}
"""The published ids of kinds of objects: of boxes, and of those with another shape."""

ZERO = (0.0, 0.0, 0.0)
Spaces = tuple[Box | None, Box | None]


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
        position: Of the center, shape (3,) [m].
        parents: What ``lowest_point`` takes and what else moves it, before; then the same after.
        form: How many of them ``lowest_point`` takes.
    """
    before, after = parents[: len(parents) // 2], parents[len(parents) // 2 :]
    lift = lowest_point(*after[: int(form)]) - lowest_point(*before[: int(form)])
    return np.array([position[0], position[1], position[2] + lift])


def constantly(*_: Floats, value: Floats) -> Floats:
    """Return a constant; parents do not matter."""
    return value


def looks(
    name: str, kind: str, color: tuple[float, float, float], hull: Hull | None = None
) -> tuple[Variable, Variable]:
    """Declare the type and the color of a body or goal."""
    published = Fixed(
        name=f"{name}.type",
        dtype="categorical",
        bounds=Categories((1, 2, 10, 20, 21, 23)),
        value=TYPES[kind][hull is not None],
        doc="Published id of the kind of object.",
    )
    return published, numbers.color(f"{name}.color", color)


_COORDINATES = (Function(to_cylindrical), Function(to_rotation_vector))
_FROM_VECTOR = Function(from_rotation_vector)


def coordinates(
    entity: str,
    *,
    spaces: Spaces = (None, None),
    yaw: bool = True,
    inverse: Callable[[Floats], Floats] = from_cylindrical,
) -> Iterable[Variable]:
    """Declare the other coordinates of a pose: cylindrical position and rotation vector.

    Args:
        entity: Prefix.
        spaces: A and B of the cylindrical position.
        yaw: Whether A and B of the rotation vector are the turns about z, or there are none.
        inverse: Cartesian position where a cylindrical one is set.
    """
    yield numbers.Range(None, *spaces, "m, rad, m", (3,)).declare(
        f"{entity}.cylindrical_position",
        None,
        "Position as radius, angle and height; setting it sets the Cartesian position.",
        (f"{entity}.cartesian_position",),
        _COORDINATES[0],
        inverse=inverse,
    )
    yield (numbers.YAWS if yaw else numbers.TURNS).declare(
        f"{entity}.euler_orientation",
        None,
        "Orientation as a rotation vector; setting it sets the quaternion.",
        (f"{entity}.orientation",),
        _COORDINATES[1],
        inverse=_FROM_VECTOR,
    )


@final
class ToolBlock(Entity):
    """A block that the robot may move.

    Args:
        name: Prefix of its variables.
        size: The declaration of ``<name>.size``; see ``block_size``.
        mass: Of ``<name>.mass``; see ``block_mass``.
        spawn: How it stands at the start as a function of its size, its orientation and of what
            ``spawn_from`` names. Setting one of those puts it there again.
        spawn_from: Further causes of the place at the start; the corners of a hull come first.
        spawn_again: Whether a size that is set does so too; else the block then keeps its lowest
            point.
        spaces: A and B of the cylindrical position.
        hull: Its shape, if it is not a box. The size is then a constant.
        orientation: How it begins turned: quaternion (x, y, z, w).
    """

    def __init__(
        self,
        name: str,
        *,
        size: Variable,
        mass: Variable,
        spawn: Function | None = None,
        spawn_from: tuple[str, ...] = (),
        spawn_again: bool = False,
        spaces: Spaces = (None, None),
        hull: Hull | None = None,
        orientation: tuple[float, float, float, float] = numbers.IDENTITY,
    ) -> None:
        restart = (*spawn_from, size.name) if spawn_again else spawn_from

        def moving(what: str, kind: numbers.Range, default: Any, doc: str) -> Measured:
            """Declare a state that is as at the start when the block is put there again."""
            if not spawn_again:
                return kind.state(f"{name}.{what}", default, doc)
            value = numbers.IDENTITY if what == "orientation" else default
            start = Function(constantly, constants={"value": value})
            how: dict[str, Any] = {"on_set": restart, "start": start, "restart": restart}
            return kind.state(f"{name}.{what}", default, doc, **how)

        kind, paint = looks(name, "block", numbers.BLOCK_COLOR, hull)
        friction = numbers.BLOCK_FRICTIONS.declare(
            f"{name}.friction",
            numbers.BLOCK_FRICTION,
            "Friction of its surface; a contact has the product of two frictions.",
        )
        place = numbers.POSITIONS.state(
            f"{name}.cartesian_position",
            ZERO,
            "Position of the center.",
            (size.name, f"{name}.orientation", *spawn_from),
            start=spawn or Function(stand, constants={"place": ZERO}),
            carry=Function(keep_lowest_point, constants={} if hull is None else {"form": 3.0}),
            restart=restart,
        )
        doc = "Orientation as a unit quaternion (x, y, z, w) with w >= 0."
        turn = moving("orientation", numbers.ORIENTATIONS, orientation, doc)
        doc = "Velocity of the center."
        slide = moving("linear_velocity", numbers.LINEAR_VELOCITIES, ZERO, doc)
        doc = "Angular velocity in the world frame."
        spin = moving("angular_velocity", numbers.ANGULAR_VELOCITIES, ZERO, doc)
        own = (kind, size, mass, friction, paint, *coordinates(name, spaces=spaces))
        super().__init__(name, (*own, place, turn, slide, spin), kind="block", hull=hull)


def block_size(
    name: str,
    size_from: str | None = None,
    *,
    default: tuple[float, float, float] = numbers.BLOCK_SIZE,
    spaces: bool = True,
) -> Variable:
    """Declare the size of a block: a root, or the copy of a shared cause.

    Args:
        name: Of the variable.
        size_from: The variable that it copies.
        default: Full edge lengths of a root [m].
        spaces: Whether it has the spaces A and B of a block.
    """
    kind = numbers.BLOCK_SIZES if spaces else replace(numbers.BLOCK_SIZES, a=None, b=None)
    return kind.declare(name, default, "Full edge lengths.", (size_from,) if size_from else ())


def block_mass(
    name: str, mass_from: str | None = None, *, default: float = numbers.BLOCK_MASS
) -> Variable:
    """Declare the mass of a block: a root, or the copy of a shared cause.

    Args:
        name: Of the variable.
        mass_from: The variable that it copies.
        default: Of a root [kg].
    """
    doc = "Mass; the inertia of the solid follows from it."
    return numbers.BLOCK_MASSES.declare(name, default, doc, (mass_from,) if mass_from else ())
