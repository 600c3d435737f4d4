"""Goals: places where something should be. They are never bodies."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import final

import numpy as np

from scm_world._types import Floats, Values
from scm_world.geometry import from_cylindrical, rotation_matrix
from scm_world.geometry.hulls import Hull
from scm_world.models import GoalRegion
from scm_world.tasks.composition import Entity
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger.entities.blocks import color, coordinates, object_type, same
from scm_world.variables import Box, Exogenous, Function, Variable

SILHOUETTE_CUBOID = 20
SILHOUETTE_SPHERE = 21
SILHOUETTE_MESH = 23


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


def turned_on_the_floor(polar: Floats, size: Floats, orientation: Floats) -> Floats:
    """Put a turned box on the floor at a radius and an angle: its lowest point touches it.

    Args:
        polar: Radius [m] and angle [rad], shape (..., 2).
        size: Edge lengths, shape (..., 3) [m].
        orientation: Quaternion (x, y, z, w), shape (..., 4).

    Returns:
        The center, shape (..., 3) [m].
    """
    height = (np.abs(rotation_matrix(orientation)[..., 2, :]) * size).sum(axis=-1, keepdims=True)
    return on_the_floor(polar, np.broadcast_to(height, (*height.shape[:-1], 3)))


def goal_position(
    name: str,
    *,
    parents: tuple[str, ...] = (),
    mechanism: Function | None = None,
    default: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Variable:
    """Declare the center of a goal: a root, or where a mechanism puts it [m]."""
    quantity, doc = f"{name}.cartesian_position", "Position of the center."
    if mechanism is None:
        return numbers.POSITIONS.root(quantity, default, doc)
    return numbers.POSITIONS.derived(quantity, parents, mechanism, doc)


def goal_orientation(
    name: str,
    *,
    parents: tuple[str, ...] = (),
    mechanism: Function | None = None,
    default: tuple[float, float, float, float] = numbers.IDENTITY,
) -> Variable:
    """Declare the orientation of a goal: a root, or what a mechanism makes it."""
    quantity, doc = f"{name}.orientation", "Orientation as a unit quaternion (x, y, z, w)."
    if not parents:
        return numbers.ORIENTATIONS.root(quantity, default, doc)
    return numbers.ORIENTATIONS.derived(quantity, parents, mechanism or Function(same), doc)


def polar(name: str, default: tuple[float, float], *, a: Box, b: Box) -> Exogenous:
    """Declare radius and angle of something that stands on the floor [m, rad]."""
    return Exogenous(
        name=f"{name}.polar",
        unit="m, rad",
        shape=(2,),
        bounds=numbers.POLAR_BOUNDS,
        a=a,
        b=b,
        default=default,
        doc="Radius and angle of its center; the height follows from the size.",
    )


class _Goal(Entity):
    """What boxes, hulls and spheres have in common."""

    def _v(self, quantity: str) -> str:
        return f"{self.name}.{quantity}"

    def _silhouette(self, shape: str, values: Values, hull: Hull | None = None) -> GoalRegion:
        return GoalRegion(
            name=self.name,
            shape=shape,
            size=values[self._v("size")],
            position=values[self._v("cartesian_position")],
            orientation=values[self._v("orientation")],
            color=values[self._v("color")],
            hull=hull,
        )


@final
class GoalBlock(_Goal):
    """A place that a block should fill.

    Args:
        name: Prefix of its variables.
        size: The declaration of ``<name>.size`` [m].
        pose: Those of ``<name>.cartesian_position`` and ``<name>.orientation``, and of causes
            that belong to this goal alone.
        a: Space A of the cylindrical position.
        b: Space B of it.
        yaw: Whether turns about z are in the spaces of the rotation vector.
        hull: Its shape, if it is no box.
        inverse: Cartesian position where a cylindrical one is set.
    """

    def __init__(
        self,
        name: str,
        *,
        size: Variable,
        pose: Iterable[Variable],
        a: Box | None = None,
        b: Box | None = None,
        yaw: bool = True,
        hull: Hull | None = None,
        inverse: Callable[[Floats], Floats] = from_cylindrical,
    ) -> None:
        self.name = name
        self._size, self._pose = size, tuple(pose)
        self._inverse = inverse
        self._a, self._b, self._yaw = a, b, yaw
        self._shape = hull

    def variables(self) -> Iterable[Variable]:
        """Declare place, orientation, size and color."""
        kind = SILHOUETTE_CUBOID if self._shape is None else SILHOUETTE_MESH
        yield object_type(self._v("type"), kind)
        yield self._size
        yield from self._pose
        yield color(self._v("color"), numbers.GOAL_COLOR)
        yield from coordinates(
            self.name, a=self._a, b=self._b, yaw=self._yaw, inverse=self._inverse
        )

    def goal(self, values: Values) -> GoalRegion:
        """Describe the silhouette."""
        return self._silhouette("box" if self._shape is None else "hull", values, self._shape)


@final
class GoalSphere(_Goal):
    """A ball that a fingertip should reach.

    Args:
        name: Prefix of its variables.
        position: Default center [m].
        radius: Default radius [m].
        tint: Default color.
    """

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
        yield goal_position(self.name, default=self._position)
        yield goal_orientation(self.name)
        yield color(self._v("color"), self._tint)
        low = numbers.half_height(self._v("size"))
        yield from coordinates(
            self.name,
            a=numbers.cylindrical(numbers.RADIUS_A, low, numbers.HEIGHT_A),
            b=numbers.cylindrical(numbers.RADIUS_B, low, numbers.HEIGHT_B),
        )

    def goal(self, values: Values) -> GoalRegion:
        """Describe the silhouette."""
        return self._silhouette("sphere", values)
