"""Values to set and actions to take, for suites that try everything."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from scm_world._types import Floats, Value
from scm_world.errors import Infeasible, OutOfBounds, SeveralProblems
from scm_world.tasks.trifinger import hardware
from scm_world.variables import Box, Categories, Integers, Rotations
from scm_world.variables.reserved import CONTROL_INDEX
from scm_world.world import Audit, World


def quantities(world: World) -> list[str]:
    """Name every parameter and state that can be set, each in its own coordinates."""
    model = world.model
    return [
        name
        for name in model
        if model.declared(name).settable
        and model.declared(name).role != "action"
        and model.target(name) == name
        and name != CONTROL_INDEX
    ]


def nearby(world: World, name: str) -> Iterator[Value]:
    """Give other possible values of a variable, near the present one."""
    variable, value = world.model.declared(name), world[name]
    match variable.bounds:
        case Box() as box:
            low, high = box.bounds(variable.shape, world.values())
            inwards = 0.02 * (low + 0.37 * (high - low) - value)
            yield value + inwards
            yield value + 0.02 * (low - value)
            first = np.zeros(variable.shape)
            first.flat[0] = inwards.flat[0]
            yield from (value + first, value - first)
        case Integers(high=most):
            yield np.where(value < most, value + 1, value - 1)
        case Categories(members=members):
            yield np.asarray(next(member for member in members if member != value))
        case Rotations():
            for angle in (0.1, 0.02):  # [rad]
                yield np.array([0.0, 0.0, np.sin(angle / 2.0), np.cos(angle / 2.0)])
        case _:
            raise ValueError(f"{name} has no bounds to choose from")


def moved(world: World, name: str) -> tuple[Value, Audit]:
    """Give a variable the first nearby value that is feasible: blocks may touch one another.

    Returns:
        The value, and what became of it.
    """
    *others, last = nearby(world, name)
    for value in others:
        try:
            return value, world.do({name: value})
        except (Infeasible, OutOfBounds, SeveralProblems):
            continue
    return last, world.do({name: last})


def command(world: World, generator: np.random.Generator) -> Floats:
    """Draw an action: anywhere in its range, now and then at its ends, or near the rest pose."""
    low, high = world.action_low, world.action_high
    match generator.integers(4):
        case 0:
            return np.asarray(np.where(generator.random(9) < 0.5, low, high))
        case 1 if world.action_mode == "joint_positions":
            return np.asarray(np.array(hardware.REST) + generator.uniform(-0.8, 0.8, 9))
        case _:
            return np.asarray(generator.uniform(low, high))
