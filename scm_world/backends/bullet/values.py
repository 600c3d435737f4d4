"""Parameters and states as Python's own numbers, which is what the engine speaks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from scm_world.errors import EngineFailure, UnknownOption
from scm_world.models.scene import ParameterKey, Parameters, Structure

Values = dict[ParameterKey, Any]
"""All parameters, or some: numbers, or lists of them. Neither they nor their values are ever
changed in place."""


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
        value = np.asarray(parameters[key], dtype=np.float64).tolist()
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


def arrays(parameters: Values) -> Parameters:
    """Turn plain numbers into parameters of a scene."""
    return {key: np.array(value) for key, value in parameters.items()}


def state_of(structure: Structure, plain: list[float]) -> Any:
    """Turn plain numbers into a state."""
    return structure.empty_state().with_vector(np.array(plain))
