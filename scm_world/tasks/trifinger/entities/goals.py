"""Goals: places where something should be. They are never bodies."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import final

import numpy as np

from scm_world._types import Floats
from scm_world.geometry import from_cylindrical, rotation_matrix
from scm_world.geometry.hulls import Hull
from scm_world.tasks.composition import Entity
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger.entities.blocks import ZERO, Spaces, coordinates, looks
from scm_world.variables import Box, Function, Variable


def on_the_floor(polar: Floats, height: Floats) -> Floats:
    """Compute a center, shape (..., 3) [m], from radius [m] and angle [rad], and its height [m]."""
    radius, angle = polar[..., 0], polar[..., 1]
    planar = radius * np.cos(angle), radius * np.sin(angle)
    return np.stack(np.broadcast_arrays(*planar, height), axis=-1)


def turned_on_the_floor(polar: Floats, size: Floats, orientation: Floats) -> Floats:
    """Put a turned box on the floor: compute its center, shape (..., 3) [m].

    It is at a radius [m] and an angle [rad], shape (..., 2), and its lowest point is on the floor.
    """
    height = (np.abs(rotation_matrix(orientation)[..., 2, :]) * size).sum(axis=-1)
    return on_the_floor(polar, height / 2.0)


def goal_position(
    name: str,
    *,
    parents: tuple[str, ...] = (),
    mechanism: Function | None = None,
    default: tuple[float, float, float] = ZERO,
) -> Variable:
    """Declare the center of a goal: a root, or where a mechanism puts it [m]."""
    doc = "Position of the center."
    return numbers.POSITIONS.declare(f"{name}.cartesian_position", default, doc, parents, mechanism)


def goal_orientation(
    name: str,
    *,
    parents: tuple[str, ...] = (),
    mechanism: Function | None = None,
    default: tuple[float, float, float, float] = numbers.IDENTITY,
) -> Variable:
    """Declare the orientation of a goal or obstacle: a root, a copy, or what a mechanism makes."""
    doc = "Orientation as a unit quaternion (x, y, z, w)."
    return numbers.ORIENTATIONS.declare(f"{name}.orientation", default, doc, parents, mechanism)


def polar(
    name: str, default: tuple[float, float], spaces: tuple[Box, Box] | None = None
) -> Variable:
    """Declare radius and angle of something on the floor [m, rad], with other spaces A and B."""
    kind = numbers.POLAR if spaces is None else replace(numbers.POLAR, a=spaces[0], b=spaces[1])
    doc = "Radius and angle of its center; the height follows from the size."
    return kind.declare(f"{name}.polar", default, doc)


@final
class GoalBlock(Entity):
    """A place that a block should fill.

    Args:
        name: Prefix of its variables.
        size: The declaration of ``<name>.size`` [m].
        pose: Those of ``<name>.cartesian_position`` and ``<name>.orientation``, and of causes
            that belong to this goal alone.
        spaces: A and B of the cylindrical position.
        yaw: Whether turns about z are in the spaces of the rotation vector.
        hull: Its shape, if it is not a box.
        inverse: Cartesian position where a cylindrical one is set.
    """

    def __init__(
        self,
        name: str,
        *,
        size: Variable,
        pose: Iterable[Variable],
        spaces: Spaces = (None, None),
        yaw: bool = True,
        hull: Hull | None = None,
        inverse: Callable[[Floats], Floats] = from_cylindrical,
    ) -> None:
        kind, paint = looks(name, "goal", numbers.GOAL_COLOR, hull)
        others = coordinates(name, spaces=spaces, yaw=yaw, inverse=inverse)
        super().__init__(name, (kind, size, *pose, paint, *others), kind="goal", hull=hull)


def goal_sphere(
    name: str, position: tuple[float, float, float], tint: tuple[float, float, float]
) -> Entity:
    """Describe a ball of 3 cm that a fingertip should reach: its default center [m] and color."""
    size = numbers.Range(Box(0.005, 0.2), unit="m", shape=(3,)).declare(
        f"{name}.size",
        (0.03,) * 3,
        "Diameter, three times; only pictures and the lowest height of A and B use it.",
    )
    kind, paint = looks(name, "sphere", tint)
    pose = goal_position(name, default=position), goal_orientation(name)
    spaces = numbers.places(numbers.half_height(size.name), airborne=True)
    own = (kind, size, *pose, paint, *coordinates(name, spaces=spaces))
    return Entity(name, own, kind="goal", shape="sphere")
