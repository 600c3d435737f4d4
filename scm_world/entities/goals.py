"""Goals: places where something should be. They are never bodies."""

from __future__ import annotations

from collections.abc import Iterable
from typing import final

import numpy as np

from scm_world._types import Floats, Values
from scm_world.entities.base import Entity
from scm_world.entities.blocks import block_size, color, coordinates, object_type
from scm_world.scene import Goal
from scm_world.variables import Box, Derived, Exogenous, Variable
from scm_world.variables import catalogue as numbers

SILHOUETTE_CUBOID = 20
SILHOUETTE_SPHERE = 21


def on_the_floor(polar: Floats, size: Floats) -> Floats:
    """Put a box on the floor at a radius and an angle.

    Args:
        polar: Radius [m] and angle [rad], shape (..., 2).
        size: Edge lengths, shape (..., 3) [m].

    Returns:
        The center, shape (..., 3) [m].
    """
    radius, angle = polar[..., 0], polar[..., 1]
    center = np.empty((*np.broadcast_shapes(polar.shape[:-1], size.shape[:-1]), 3))
    center[..., 0] = radius * np.cos(angle)
    center[..., 1] = radius * np.sin(angle)
    center[..., 2] = size[..., 2] / 2.0
    return center


def _orientation(name: str) -> Exogenous:
    return Exogenous(
        name=name,
        shape=(4,),
        bounds=numbers.QUATERNION_BOUNDS,
        default=numbers.IDENTITY,
        doc="Orientation as a unit quaternion (x, y, z, w).",
    )


class _Goal(Entity):
    """What boxes and spheres have in common.

    Attributes:
        shape: ``"box"`` or ``"sphere"``.
    """

    shape: str

    def _v(self, quantity: str) -> str:
        return f"{self.name}.{quantity}"

    def goal(self, values: Values) -> Goal:
        """Describe the silhouette."""
        return Goal(
            name=self.name,
            shape=self.shape,
            size=values[self._v("size")],
            position=values[self._v("cartesian_position")],
            orientation=values[self._v("orientation")],
            color=values[self._v("color")],
        )


@final
class GoalBlock(_Goal):
    """A box on the floor that a block should fill.

    Args:
        name: Prefix of its variables.
        size_from: Variable that its size copies.
        polar: Default radius [m] and angle [rad] of its center.
        a: Space A of the cylindrical position.
        b: Space B of it.
    """

    shape = "box"

    def __init__(
        self, name: str, *, size_from: str, polar: tuple[float, float], a: Box, b: Box
    ) -> None:
        self.name = name
        self._size_from = size_from
        self._polar = polar
        self._a, self._b = a, b

    def variables(self) -> Iterable[Variable]:
        """Declare place, orientation, size and color."""
        yield object_type(self._v("type"), SILHOUETTE_CUBOID)
        yield block_size(self._v("size"), self._size_from)
        yield Exogenous(
            name=self._v("polar"),
            unit="m, rad",
            shape=(2,),
            bounds=numbers.POLAR_BOUNDS,
            a=numbers.POLAR_A,
            b=numbers.POLAR_B,
            default=self._polar,
            doc="Radius and angle of its center; the height follows from the size.",
        )
        yield Derived(
            name=self._v("cartesian_position"),
            unit="m",
            shape=(3,),
            bounds=numbers.POSITION_BOUNDS,
            parents=(self._v("polar"), self._v("size")),
            mechanism=on_the_floor,
            doc="Position of the center.",
        )
        yield _orientation(self._v("orientation"))
        yield color(self._v("color"), numbers.GOAL_COLOR)
        yield from coordinates(self.name, a=self._a, b=self._b)


@final
class GoalSphere(_Goal):
    """A ball that a fingertip should reach.

    Args:
        name: Prefix of its variables.
        position: Default center [m].
        radius: Default radius [m].
        tint: Default color.
    """

    shape = "sphere"

    def __init__(
        self,
        name: str,
        *,
        position: tuple[float, float, float],
        radius: float,
        tint: tuple[float, float, float],
    ) -> None:
        self.name = name
        self._position = position
        self._radius = radius
        self._tint = tint

    def variables(self) -> Iterable[Variable]:
        """Declare place, size and color."""
        yield object_type(self._v("type"), SILHOUETTE_SPHERE)
        yield Exogenous(
            name=self._v("size"),
            unit="m",
            shape=(3,),
            bounds=Box(0.005, 0.2),
            default=(2.0 * self._radius,) * 3,
            doc="Diameter, three times; only pictures and the lowest height of A and B use it.",
        )
        yield Exogenous(
            name=self._v("cartesian_position"),
            unit="m",
            shape=(3,),
            bounds=numbers.POSITION_BOUNDS,
            default=self._position,
            doc="Position of the center.",
        )
        yield _orientation(self._v("orientation"))
        yield color(self._v("color"), self._tint)
        low = numbers.half_height(self._v("size"))
        yield from coordinates(
            self.name,
            a=numbers.cylindrical(numbers.RADIUS_A, low, numbers.HEIGHT_A),
            b=numbers.cylindrical(numbers.RADIUS_B, low, numbers.HEIGHT_B),
        )
