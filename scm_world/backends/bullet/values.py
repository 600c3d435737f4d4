"""Parameters and states as Python's own numbers, which is what the engine speaks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import final

import numpy as np

from scm_world.errors import EngineFailure, UnknownOption
from scm_world.models.scene import ParameterKey, Parameters
from scm_world.scene.scene import Structure, parameter_keys
from scm_world.scene.state import BLOCK_SIZE, ROBOT_SIZE, PhysicalState

Plain = float | list[float]
"""The value of a parameter."""

Values = dict[ParameterKey, Plain]
"""All parameters, or some. Neither they nor their values are ever changed in place."""

UNIT = 1e-12  # a quaternion whose squared norm is this near to 1 is taken as it is


@final
@dataclass(frozen=True)
class Instant:
    """A canonical state: the engine's world is a function of these values.

    Attributes:
        structure: The bodies.
        parameters: All of them.
        state: The numbers of a ``PhysicalState``.
    """

    structure: Structure
    parameters: Values
    state: list[float]


def number(parameters: Values, key: ParameterKey) -> float:
    """Give a parameter that is one number."""
    value = parameters[key]
    if isinstance(value, list):
        raise EngineFailure(f"{'.'.join(key)} must be one number, got {value}", "bullet")
    return value


def numbers(parameters: Values, key: ParameterKey) -> list[float]:
    """Give a parameter that is several numbers."""
    value = parameters[key]
    if isinstance(value, float):
        raise EngineFailure(f"{'.'.join(key)} must be several numbers, got {value}", "bullet")
    return value


def known(there: Mapping[ParameterKey, object], keys: Iterable[ParameterKey]) -> list[ParameterKey]:
    """Pass keys on that the scene has.

    Raises:
        UnknownOption: It does not have one of them.
    """
    keys = list(keys)
    for key in keys:
        if key not in there:
            raise UnknownOption("parameter", ".".join(key), map(".".join, there))
    return keys


def some(there: Mapping[ParameterKey, object], parameters: Parameters) -> Values:
    """Turn parameters that the scene has into plain numbers.

    Raises:
        UnknownOption: It does not have one of them.
        EngineFailure: One is not finite.
    """
    plain: Values = {}
    for key in known(there, parameters):
        value: Plain = np.asarray(parameters[key], dtype=np.float64).tolist()
        if not math.isfinite(value if isinstance(value, float) else sum(value)):
            raise EngineFailure(f"{'.'.join(key)} must be finite, got {value}", "bullet")
        plain[key] = value
    return plain


def complete(structure: Structure, parameters: Parameters) -> Values:
    """Turn all parameters of a structure into plain numbers.

    Raises:
        UnknownOption: One is missing.
        EngineFailure: One is not finite.
    """
    wanted = known(parameters, parameter_keys(structure))
    return some(parameters, {key: parameters[key] for key in wanted})


def state(structure: Structure, given: PhysicalState) -> list[float]:
    """Turn a state into plain numbers, with unit quaternions whose w is not negative.

    Raises:
        ValueError: It is a state of another number of blocks.
        EngineFailure: A number is not finite.
    """
    if given.n_blocks != len(structure.blocks):
        raise ValueError(f"expected a state of {len(structure.blocks)} blocks, got {given!r}")
    numbers: list[float] = given.vector.tolist()
    if not math.isfinite(sum(numbers)):
        raise EngineFailure(f"a state must be finite, got {given!r}", "bullet")
    for start in range(ROBOT_SIZE + 3, len(numbers), BLOCK_SIZE):
        turn = numbers[start : start + 4]
        square = sum(part * part for part in turn)
        scale = 1.0 if abs(square - 1.0) < UNIT or square == 0.0 else math.sqrt(square)
        scale = -scale if turn[3] < 0.0 else scale
        numbers[start : start + 4] = [part / scale for part in turn]
    return numbers


def light(here: Instant, there: Instant) -> bool:
    """Tell whether one world becomes another without setting a state.

    That is so if only parameters change that live bodies can take on.
    """
    return (
        here.structure == there.structure
        and here.state[:18] == there.state[:18]
        and here.state[ROBOT_SIZE:] == there.state[ROBOT_SIZE:]
        and all(here.parameters[key] == there.parameters[key] for key in heavy(here.structure))
    )


def heavy(structure: Structure) -> Iterator[ParameterKey]:
    """List the parameters that need new bodies, or new contacts."""
    yield ("robot", "height")
    hulls = dict(structure.hulls)
    for name in structure.blocks:
        if name not in hulls:
            yield (name, "size")
    for name in structure.obstacles:
        yield from ((name, quantity) for quantity in ("size", "position", "orientation"))


def arrays(parameters: Values) -> Parameters:
    """Turn plain numbers into parameters of a scene."""
    return {key: np.array(value) for key, value in parameters.items()}


def physical(structure: Structure, numbers: list[float]) -> PhysicalState:
    """Turn plain numbers into a state."""
    return PhysicalState(len(structure.blocks), np.array(numbers))
