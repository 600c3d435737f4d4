"""Random interventions, valid and invalid ones: what a world has to survive."""

from __future__ import annotations

from typing import Any

import numpy as np

from scm_world.variables import (
    Box,
    Categories,
    Draw,
    Integers,
    Normal,
    Rotations,
    Scale,
    Shift,
    Variable,
)
from scm_world.world import World

BAD: tuple[Any, ...] = (
    None,
    "x",
    float("nan"),
    float("inf"),
    [],
    [1.0, 2.0],
    {"x": 1.0},
    1e300,
    -1e300,
    True,
)
"""Values that no variable can have."""


def spread(variable: Variable, generator: np.random.Generator) -> Any:
    """Draw a value somewhere in, at, or just outside the bounds of a variable."""
    match variable.bounds:
        case Box() as box if not box.parents():
            low, high = box.bounds(variable.shape, {})
            return low + (high - low) * generator.uniform(-0.02, 1.02, variable.shape)
        case Integers(low=low, high=high):
            highest = min(high, low + 200)
            return generator.integers(low - 1, highest + 2, variable.shape).tolist()
        case Categories(members=members):
            return int(generator.choice([*members, -1]))
        case Rotations():
            value = generator.normal(size=variable.shape)
            return value / np.linalg.norm(value)
        case _:
            return 0.1 * generator.normal(size=variable.shape)


def random_request(
    world: World, generator: np.random.Generator, *, most: int = 3
) -> dict[str, Any]:
    """Draw a request to a world.

    Args:
        world: In an episode.
        generator: Of the choices.
        most: How many targets it has at most.
    """
    request: dict[str, Any] = {}
    match generator.integers(12):
        case 0:
            request = world.task.sample_goal(("A", "B", "A|B")[generator.integers(3)])
        case 1:
            nearby = list(world.task.nearby(world.values()))
            request = dict(nearby[generator.integers(len(nearby))]) if nearby else {}
    names = list(world.model)
    chosen = generator.choice(names, size=int(generator.integers(1, most + 1)), replace=True)
    if request and generator.random() < 0.7:  # mostly what changes the goal or the structure alone
        return request
    return request | {str(name): _value(world, str(name), generator) for name in chosen}


def _value(world: World, name: str, generator: np.random.Generator) -> Any:
    variable = world.model.declared(name)
    match generator.integers(8):
        case 0:
            return BAD[generator.integers(len(BAD))]
        case 1:
            return Shift(float(generator.normal(scale=0.01)))
        case 2:
            return Scale(float(generator.uniform(-0.1, 2.0)))
        case 3:
            return Draw(("A", "B", "A|B")[generator.integers(3)])
        case 4:
            return Draw(Normal(0.0, 0.05))
        case 5 | 6 if variable.dtype == "real":
            return world[name] + 0.01 * generator.normal(size=variable.shape)
        case _:
            return spread(variable, generator)
