"""Boxes that stand in the way and that nothing moves."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import final

from scm_world._types import Floats, Value
from scm_world.models import ParameterKey
from scm_world.tasks.composition import Entity
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger.entities.blocks import color, coordinates, object_type
from scm_world.variables import Box, Exogenous, Variable

STATIC_CUBOID = 10  # the published type id

QUANTITIES = {
    "size": "size",
    "friction": "friction",
    "color": "color",
    "cartesian_position": "position",
    "orientation": "orientation",
}
"""The quantities of an obstacle, and what the scene calls them. All of them are parameters."""


@final
class Obstacle(Entity):
    """A box that nothing moves. Its pose is a parameter: it holds until the reset.

    Args:
        name: Prefix of its variables.
        size: The declaration of ``<name>.size`` [m].
        position: Of ``<name>.cartesian_position``: a root, or where a mechanism puts it [m].
    """

    def __init__(self, name: str, *, size: Variable, position: Variable) -> None:
        self.name = name
        self._size, self._position = size, position

    @property
    def is_obstacle(self) -> bool:
        """An obstacle it is."""
        return True

    def _v(self, quantity: str) -> str:
        return f"{self.name}.{quantity}"

    def variables(self) -> Iterable[Variable]:
        """Declare type, size, friction, color and pose."""
        yield object_type(self._v("type"), STATIC_CUBOID)
        yield self._size
        yield self._position
        yield numbers.ORIENTATIONS.root(
            self._v("orientation"),
            numbers.IDENTITY,
            "Orientation as a unit quaternion (x, y, z, w).",
        )
        yield numbers.FRICTION.root(
            self._v("friction"),
            numbers.SURFACE_FRICTION,
            "Friction of its surface; a contact has the product of two frictions.",
        )
        yield color(self._v("color"), (0.0, 0.0, 0.0))
        yield from coordinates(self.name, a=None, b=None, yaw=False)

    def parameters(self) -> Mapping[str, ParameterKey]:
        """Say which variable sets which physical parameter."""
        return {self._v(ours): (self.name, its) for ours, its in QUANTITIES.items()}


def wall_on_the_floor(size: Floats) -> Floats:
    """Put a box on the floor in the middle of the arena.

    Args:
        size: Edge lengths, shape (..., 3) [m].

    Returns:
        The center, shape (..., 3) [m].
    """
    center: Value = size * [0.0, 0.0, 0.5]
    return center


def obstacle_size(
    name: str, default: tuple[float, float, float], *, a: Box | None = None, b: Box | None = None
) -> Exogenous:
    """Declare the edge lengths of an obstacle [m]."""
    return replace(numbers.OBSTACLE_SIZES, a=a, b=b).root(name, default, "Full edge lengths.")
