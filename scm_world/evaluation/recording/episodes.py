"""One recorded episode of an environment."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats, Integers
from scm_world.env.observer import Observation
from scm_world.evaluation.policies.cards import RELATIVE, USUAL
from scm_world.queries.plans import Plan

Bools = NDArray[np.bool_]
ONLY = ""
"""Name of an observation that has no parts."""


@final
@dataclass(frozen=True)
class Recorded:
    """An episode of T control steps. What happened at an instant happened before its observation.

    Attributes:
        environment: What the environment was made with.
        seed: Of the noise.
        number: Of the episode within the noise.
        interventions: What was done, each with its control step, in the order of the doing.
        observations: Of the T + 1 instants.
        actions: Shape (T, 9), as the environment was given them.
        rewards: Shape (T,).
        terminations: Whether each step ended the episode, shape (T,).
        truncations: Whether each step ended it for lack of time, shape (T,).
        infos: What was kept of ``info``, by name, each of shape (T + 1,).
        states: A sum of the true state of each instant, shape (T + 1,).
    """

    environment: Mapping[str, Any] = field(repr=False)
    seed: int
    number: int
    interventions: tuple[tuple[int, Plan], ...]
    observations: tuple[Observation, ...] = field(repr=False)
    actions: NDArray[Any] = field(repr=False)
    rewards: Floats = field(repr=False)
    terminations: Bools = field(repr=False)
    truncations: Bools = field(repr=False)
    infos: Mapping[str, NDArray[Any]] = field(repr=False)
    states: Integers = field(repr=False)

    def __len__(self) -> int:
        """Give the number of control steps."""
        return len(self.rewards)

    def __eq__(self, other: object) -> bool:
        """Tell whether the same happened, bit for bit."""
        return (
            isinstance(other, Recorded)
            and self.interventions == other.interventions
            and self._summed().digest() == other._summed().digest()
        )

    def __hash__(self) -> int:
        return hash((self.seed, self.number, len(self)))

    @property
    def action_mode(self) -> str:
        """What the actions mean."""
        return str(self.environment["action_mode"])

    @property
    def normalized(self) -> bool:
        """Whether the actions are in units of the range of commands, or in SI units."""
        return bool(self.environment["normalize_actions"])

    @property
    def relative(self) -> dict[str, Any]:
        """Options of the environment that say what relative actions mean."""
        return {name: self.environment.get(name, USUAL[name]) for name in RELATIVE}

    def done_at(self, step: int) -> Iterator[Plan]:
        """List what was done at a control step, in order."""
        return (plan for at, plan in self.interventions if at == step)

    def sha256(self) -> str:
        """Sum up all that happened and all that was done.

        Raises:
            ModelError: A mechanism that was put in place is a function without a name.
        """
        found = self._summed()
        found.update(json.dumps(self.plans()).encode())
        return found.hexdigest()

    def _summed(self) -> hashlib._Hash:
        """Sum up all but what was done."""
        known = [self.seed, self.number, sorted(self.infos)]
        found = hashlib.sha256(json.dumps(known).encode())
        for observation in self.observations:
            for name, part in parts(observation).items():
                found.update(f"{name} {part.dtype.str} {part.shape}".encode() + part.tobytes())
        found.update(np.asarray(self.actions, dtype=np.float64).tobytes())
        for array in (self.rewards, self.terminations, self.truncations, self.states):
            found.update(array.tobytes())
        for name in sorted(self.infos):
            found.update(self.infos[name].tobytes())
        return found

    def plans(self) -> list[list[Any]]:
        """Write down what was done as plain data.

        Raises:
            ModelError: A mechanism that was put in place is a function without a name.
        """
        return [[step, plan.as_dict()] for step, plan in self.interventions]


def parts(observation: Observation) -> dict[str, NDArray[Any]]:
    """Give the arrays of an observation by name, in the order of their names.

    Example:
        >>> parts({"b": np.zeros(1), "a": np.ones(1)})
        {'a': array([1.]), 'b': array([0.])}
    """
    if isinstance(observation, dict):
        return {name: observation[name] for name in sorted(observation)}
    return {ONLY: observation}


def whole(arrays: Mapping[str, NDArray[Any]]) -> Observation:
    """Put an observation together from its parts."""
    return arrays[ONLY] if ONLY in arrays else dict(arrays)


def summed(vector: Floats) -> int:
    """Sum up a true state, as a whole number of 64 bits."""
    digest = hashlib.blake2b(vector.tobytes(), digest_size=8).digest()
    return int.from_bytes(digest, "little", signed=True)
