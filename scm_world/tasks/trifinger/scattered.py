"""Small boxes scattered over the arena, as many as a variable says."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from scm_world._types import Floats
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger.entities.obstacles import Obstacle, obstacle_size
from scm_world.tasks.trifinger.hardware import ARENA_HALF_WIDTH, ARENA_HEIGHT
from scm_world.variables import Box, Exogenous, Function, Integers, Variable

COUNT = "number_of_obstacles"
PLACES = "obstacle_places"
MOST = 10
_ANGLE = np.pi * (3.0 - np.sqrt(5.0))  # the golden angle: places never line up


def obstacle_names(count: int) -> tuple[str, ...]:
    """Name the first obstacles."""
    return tuple(f"obstacle_{index}" for index in range(count))


def place(places: Floats, *, index: float) -> Floats:
    """Pick one of the places, shape (..., 3) [m].

    Args:
        places: Shape (..., n, 3) [m].
        index: Which.
    """
    return places[..., int(index), :]


def scattering(default: int) -> Iterable[Variable]:
    """Declare how many obstacles there are and where they are.

    Args:
        default: How many there are without an intervention.
    """
    yield Exogenous(
        name=COUNT,
        dtype="integer",
        bounds=Integers(0, MOST),
        a=Integers(1, 5),
        b=Integers(1, 5),
        default=default,
        doc="How many small boxes are in the way.",
    )
    index = np.arange(MOST)  # between the fingers and above the blocks
    radius, height = 0.05 + 0.008 * index, 0.16 + 0.004 * index
    x, y = radius * np.cos(_ANGLE * index), radius * np.sin(_ANGLE * index)
    places = np.stack([x, y, height], axis=-1)
    arena = (ARENA_HALF_WIDTH - 0.005, ARENA_HALF_WIDTH - 0.005)
    low, high = (-arena[0], -arena[1], 0.005), (*arena, ARENA_HEIGHT - 0.005)
    space = Box(low * MOST, high * MOST)
    yield Exogenous(
        name=PLACES,
        unit="m",
        shape=(MOST, 3),
        bounds=Box((-0.24, -0.24, 0.0) * MOST, (0.24, 0.24, 0.5) * MOST),
        a=space,
        b=space,
        default=tuple(places.ravel().tolist()),
        doc="Where the centers of the obstacles are.",
    )


def scattered(count: int) -> Iterable[Obstacle]:
    """List the obstacles that there are."""
    for index, name in enumerate(obstacle_names(count)):
        position = numbers.POSITIONS.derived(
            f"{name}.cartesian_position",
            (PLACES,),
            Function(place, constants={"index": float(index)}),
            "Position of the center.",
        )
        yield Obstacle(
            name,
            size=obstacle_size(f"{name}.size", numbers.OBSTACLE_SIZE),
            position=position,
        )
