"""Parameters and states as Python's own numbers, which is what the engine speaks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from scm_world.errors import EngineFailure, UnknownOption
from scm_world.models.scene import ParameterKey, Parameters, Structure
from scm_world.models.state import State

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
        state: The numbers of a ``State``, with unit quaternions.
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


def complete(parameters: Parameters, keys: Iterable[ParameterKey]) -> Values:
    """Turn all parameters of a structure into plain numbers.

    Args:
        parameters: Those of a scene.
        keys: Those that the structure has.

    Raises:
        UnknownOption: One is missing.
        EngineFailure: One is not finite.
    """
    wanted = known(parameters, keys)
    return some(parameters, {key: parameters[key] for key in wanted})


def plain_state(structure: Structure, given: State) -> list[float]:
    """Turn a state into plain numbers.

    Raises:
        ValueError: It is a state of another structure.
        EngineFailure: A number is not finite.
    """
    plain: list[float] = given.vector.tolist()
    if len(plain) != structure.layout.size:
        raise ValueError(f"expected a state of {structure.layout.size} numbers, got {given!r}")
    if not math.isfinite(sum(plain)):
        raise EngineFailure(f"a state must be finite, got {given!r}", "bullet")
    return plain


def normalize(state: list[float], rotations: Iterable[int]) -> None:
    """Scale the quaternions that begin at some places of a state to unit length, in place."""
    for start in rotations:
        turn = state[start : start + 4]
        square = sum(part * part for part in turn)
        if abs(square - 1.0) >= UNIT and square != 0.0:
            scale = math.sqrt(square)
            state[start : start + 4] = [part / scale for part in turn]


def arrays(parameters: Values) -> Parameters:
    """Turn plain numbers into parameters of a scene."""
    return {key: np.array(value) for key, value in parameters.items()}


def state_of(structure: Structure, plain: list[float]) -> Any:
    """Turn plain numbers into a state."""
    return structure.empty_state().with_vector(np.array(plain))
