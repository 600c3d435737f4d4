"""Boxes that stand in the way and that nothing moves."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from scm_world._types import Floats
from scm_world.tasks.composition import Entity
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger.entities.blocks import ZERO, coordinates, looks
from scm_world.tasks.trifinger.entities.goals import goal_orientation, goal_position
from scm_world.tasks.trifinger.hardware import ARENA_HALF_WIDTH, ARENA_HEIGHT
from scm_world.variables import Box, Function, Integers, Variable


def obstacle(name: str, *, size: Variable, position: Variable) -> Entity:
    """Describe a box that nothing moves. Its pose is a parameter: it holds until the reset.

    Args:
        name: Prefix of its variables.
        size: The declaration of ``<name>.size`` [m].
        position: Of ``<name>.cartesian_position``: a root, or where a mechanism puts it [m].
    """
    kind, paint = looks(name, "obstacle", ZERO)
    friction = numbers.FRICTION.declare(
        f"{name}.friction",
        numbers.SURFACE_FRICTION,
        "Friction of its surface; a contact has the product of two frictions.",
    )
    own = (kind, size, position, goal_orientation(name), friction, paint)
    return Entity(name, (*own, *coordinates(name, yaw=False)), kind="obstacle")


COUNT = "number_of_obstacles"
PLACES = "obstacle_places"
MOST = 10
_ANGLE = np.pi * (3.0 - np.sqrt(5.0))  # the golden angle: places never line up


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
    yield numbers.Range(bounds, space, space, "m", (MOST, 3)).declare(
        PLACES,
        tuple(np.stack([x, y, height], axis=-1).ravel().tolist()),
        "Where the centers of the obstacles are.",
    )


def scattered(count: int) -> Iterable[Entity]:
    """List the scattered boxes that there are."""
    for index, name in enumerate(obstacle_names(count)):
        size = numbers.OBSTACLE_SIZES.declare(
            f"{name}.size", numbers.OBSTACLE_SIZE, "Full edge lengths."
        )
        where = Function(place, constants={"index": float(index)})
        position = goal_position(name, parents=(PLACES,), mechanism=where)
        yield obstacle(name, size=size, position=position)
