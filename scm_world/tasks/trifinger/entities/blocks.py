"""Blocks that can be moved."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any, final

import numpy as np

from scm_world._types import Floats
from scm_world.geometry.coordinates import from_cylindrical, to_cylindrical
from scm_world.geometry.hulls import Hull
from scm_world.geometry.rotations import from_rotation_vector, to_rotation_vector
from scm_world.models import ParameterKey
from scm_world.tasks.composition import Entity, StateDeclaration
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger.entities.block_world import lowest_point
from scm_world.variables import Box, Derived, Exogenous, Fixed, Function, Variable

CUBOID = 1  # the published type ids
MESH = 2


def standing(size: Floats, orientation: Floats, *, place: Floats) -> Floats:
    """Stand a block on the floor.

    Args:
        size: Edge lengths, shape (3,) [m].
        orientation: Quaternion (x, y, z, w).
        place: x and y of the center, and the height of the lowest point, shape (3,) [m].

    Returns:
        The center, shape (3,) [m].
    """
    return np.array([place[0], place[1], place[2] + lowest_point(size, orientation)])


def constantly(*_: Floats, value: Floats) -> Floats:
    """Return a constant; parents do not matter."""
    return value


def keep_lowest_point(position: Floats, *parents: Floats) -> Floats:
    """Raise or lower the center so that the lowest point stays where it was.

    A block that grows does not sink into the floor, and one that shrinks does not hang above it.

    Args:
        position: Of the center, shape (3,) [m].
        parents: Size, orientation and what else moves it, before; then the same after.
    """
    size, orientation = parents[:2]
    new_size, new_orientation = parents[len(parents) // 2 :][:2]
    lift = lowest_point(new_size, new_orientation) - lowest_point(size, orientation)
    return np.array([position[0], position[1], position[2] + lift])


_KEEP, _CYLINDRICAL = Function(keep_lowest_point), Function(to_cylindrical)
_TO_VECTOR, _FROM_VECTOR = Function(to_rotation_vector), Function(from_rotation_vector)


def coordinates(
    entity: str,
    *,
    a: Box | None,
    b: Box | None,
    orientation: bool = True,
    yaw: bool = True,
    inverse: Callable[[Floats], Floats] = from_cylindrical,
) -> Iterable[Variable]:
    """Declare the other coordinates of a pose: cylindrical position and rotation vector.

    Args:
        entity: Prefix.
        a: Space A of the cylindrical position.
        b: Space B of it.
        orientation: Whether there is an orientation.
        yaw: Whether A and B of the rotation vector are the turns about z, or there are none.
        inverse: Cartesian position where a cylindrical one is set.
    """
    yield Derived(
        name=f"{entity}.cylindrical_position",
        unit="m, rad, m",
        shape=(3,),
        a=a,
        b=b,
        parents=(f"{entity}.cartesian_position",),
        mechanism=_CYLINDRICAL,
        inverse=inverse,
        doc="Position as radius, angle and height; setting it sets the Cartesian position.",
    )
    if orientation:
        yield Derived(
            name=f"{entity}.euler_orientation",
            unit="rad",
            shape=(3,),
            a=numbers.YAW if yaw else None,
            b=numbers.YAW if yaw else None,
            parents=(f"{entity}.orientation",),
            mechanism=_TO_VECTOR,
            inverse=_FROM_VECTOR,
            doc="Orientation as a rotation vector; setting it sets the quaternion.",
        )


@final
class ToolBlock(Entity):
    """A block that the robot may move.

    Args:
        name: Prefix of its variables.
        size: The declaration of ``<name>.size``; see ``block_size``.
        mass: Of ``<name>.mass``; see ``block_mass``.
        place: x, y of the center at the start and height of its lowest point [m].
        spawn: Instead of ``place``: how it stands at the start as a function of its size, its
            orientation and of what ``spawn_from`` names. Setting one of those puts it there
            again.
        spawn_from: Further causes of the place at the start.
        spawn_again: Whether a size that is set does so too; else the block then keeps its lowest
            point.
        a: Space A of the cylindrical position.
        b: Space B of it.
        hull: Its shape, if it is no box. The size is then a constant.
        orientation: How it begins turned: quaternion (x, y, z, w).
        carry: Instead of keeping the lowest point of a box: where its center goes as it is turned
            or changes its size.
    """

    def __init__(
        self,
        name: str,
        *,
        size: Variable,
        mass: Variable,
        place: tuple[float, float, float] = (0.0, 0.0, 0.0),
        spawn: Function | None = None,
        spawn_from: tuple[str, ...] = (),
        spawn_again: bool = False,
        a: Box | None = None,
        b: Box | None = None,
        hull: Hull | None = None,
        orientation: tuple[float, float, float, float] = numbers.IDENTITY,
        carry: Function | None = None,
    ) -> None:
        self.name = name
        self._size, self._mass = size, mass
        self._spawn = spawn or Function(standing, constants={"place": place})
        self._spawn_from = spawn_from
        self._restart = (*spawn_from, self._v("size")) if spawn_again else spawn_from
        self._again = self._restart if spawn_again else ()
        self._a, self._b = a, b
        self._hull, self._orientation, self._carry = hull, orientation, carry or _KEEP

    @property
    def is_block(self) -> bool:
        """A block it is."""
        return True

    @property
    def hull(self) -> Hull | None:
        """The shape of a block that is no box."""
        return self._hull

    def _v(self, quantity: str) -> str:
        return f"{self.name}.{quantity}"

    def variables(self) -> Iterable[Variable]:
        """Declare type, size, mass, friction, color and the other coordinates of the pose."""
        yield object_type(self._v("type"), CUBOID if self._hull is None else MESH)
        yield self._size
        yield self._mass
        yield numbers.BLOCK_FRICTIONS.root(
            self._v("friction"),
            numbers.BLOCK_FRICTION,
            "Friction of its surface; a contact has the product of two frictions.",
        )
        yield color(self._v("color"), numbers.BLOCK_COLOR)
        yield from coordinates(self.name, a=self._a, b=self._b)

    def states(self) -> Iterable[StateDeclaration]:
        """Declare pose and velocities."""
        position, orientation = self._v("cartesian_position"), self._v("orientation")
        linear, angular = self._v("linear_velocity"), self._v("angular_velocity")
        yield StateDeclaration(
            position,
            "m",
            (3,),
            numbers.POSITION_BOUNDS,
            (0.0, 0.0, 0.0),
            "Position of the center.",
            on_set=(self._v("size"), orientation, *self._spawn_from),
            start=self._spawn,
            carry=self._carry,
            restart=self._restart,
        )
        yield StateDeclaration(
            orientation,
            "1",
            (4,),
            numbers.QUATERNION_BOUNDS,
            self._orientation,
            "Orientation as a unit quaternion (x, y, z, w) with w >= 0.",
            **self._respawn(numbers.IDENTITY),
        )
        yield StateDeclaration(
            linear,
            "m/s",
            (3,),
            numbers.LINEAR_VELOCITY_BOUNDS,
            (0.0, 0.0, 0.0),
            "Velocity of the center.",
            **self._respawn((0.0, 0.0, 0.0)),
        )
        yield StateDeclaration(
            angular,
            "rad/s",
            (3,),
            numbers.ANGULAR_VELOCITY_BOUNDS,
            (0.0, 0.0, 0.0),
            "Angular velocity in the world frame.",
            **self._respawn((0.0, 0.0, 0.0)),
        )

    def _respawn(self, value: tuple[float, ...]) -> dict[str, Any]:
        """Say that a state is as it was at the start when the block is put there again."""
        if not self._again:
            return {}
        start = Function(constantly, constants={"value": value})
        return {"on_set": self._again, "start": start, "restart": self._again}

    def parameters(self) -> Mapping[str, ParameterKey]:
        """Say which variable sets which physical parameter."""
        own = ("mass", "friction", "color") if self._hull else ("mass", "size", "friction", "color")
        return {self._v(quantity): (self.name, quantity) for quantity in own}


def same(parent: Floats) -> Floats:
    """Copy the value of the parent."""
    return parent


_COPY = Function(same)


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
    doc = "Full edge lengths."
    if size_from is None:
        return kind.root(name, default, doc)
    return kind.derived(name, (size_from,), _COPY, doc)


def block_mass(
    name: str, mass_from: str | None = None, *, default: float = numbers.BLOCK_MASS
) -> Variable:
    """Declare the mass of a block: a root, or the copy of a shared cause.

    Args:
        name: Of the variable.
        mass_from: The variable that it copies.
        default: Of a root [kg].
    """
    kind, doc = numbers.BLOCK_MASSES, "Mass; the inertia of the solid follows from it."
    if mass_from is None:
        return kind.root(name, default, doc)
    return kind.derived(name, (mass_from,), _COPY, doc)


def hull_size(name: str, size: tuple[float, float, float]) -> Fixed:
    """Declare the edge lengths of the box around a hull, which cannot change [m]."""
    return Fixed(
        name=name,
        unit="m",
        shape=(3,),
        value=size,
        doc="Edge lengths of the box around the shape, in its own frame.",
    )


def object_type(name: str, value: int) -> Fixed:
    """Declare the published id of the kind of object, which cannot change."""
    return Fixed(
        name=name,
        dtype="categorical",
        bounds=numbers.TYPE_BOUNDS,
        value=value,
        doc="Published id of the kind of object.",
    )


def color(name: str, default: tuple[float, float, float]) -> Exogenous:
    """Declare a color. Space A is dark and B is bright, as in the paper."""
    return numbers.COLOR.root(name, default, "Red, green and blue; nothing physical depends on it.")
