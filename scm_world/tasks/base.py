"""What a task is: what stands in the world, what is shared, and what counts."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, final

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.entities import Entity
from scm_world.errors import UnknownOption
from scm_world.scene import trifinger
from scm_world.variables import Box, Function, Linear, Measured, Parent, Variable

SUCCESS = 0.9  # the fraction of the goal that counts as fulfilled


@final
@dataclass(frozen=True)
class Conventions:
    """Where the predecessor's choices differ from ours.

    Attributes:
        name: ``"scm_world"`` or ``"causal_world"``.
        aligned_boxes: Overlap of axis-aligned hulls, not capped, instead of the exact one.
        reward_times_dt: Rewards multiplied by the control period.
        extra_step: Episodes one step longer than their length.
        published_observation: The published normalisation of observations, which values may
            leave, and a time feature in seconds minus steps where a length is given.
        distance_as_reward: In reaching, the mean tip error itself is added to the reward.
    """

    name: str
    aligned_boxes: bool = False
    reward_times_dt: bool = False
    extra_step: bool = False
    published_observation: bool = False
    distance_as_reward: bool = False


CONVENTIONS = {
    "scm_world": Conventions("scm_world"),
    "causal_world": Conventions("causal_world", True, True, True, True, True),
}


def conventions(name: str) -> Conventions:
    """Look conventions up by their name.

    Raises:
        UnknownOption: There are none of this name.
    """
    try:
        return CONVENTIONS[name]
    except KeyError:
        raise UnknownOption("conventions", name, CONVENTIONS) from None


@final
@dataclass(frozen=True)
class Observed:
    """A part of the structured observation.

    Attributes:
        variable: What is observed.
        low: Lower bound of each component; the declared one if None.
        high: Upper bound.
        published: Lower and upper bound of the predecessor's normalisation.
    """

    variable: str
    published: tuple[Any, Any]
    low: Any = None
    high: Any = None


class Task(ABC):
    """A goal family.

    Attributes:
        name: Of the task.
        seconds: Length of an episode [s].
        weights: Weight of each reward term, by the name of its variable.
    """

    name: ClassVar[str]
    seconds: ClassVar[float]
    weights: Mapping[str, float]

    @abstractmethod
    def entities(self) -> Iterable[Entity]:
        """List what stands in the world besides the robot and the stage."""

    def shared(self) -> Iterable[Variable]:
        """Declare causes that several entities have in common."""
        return ()

    @abstractmethod
    def readouts(self, conventions: Conventions) -> Iterable[Variable]:
        """Declare reward terms, fractional success and success."""

    @abstractmethod
    def observed(self) -> Iterable[Observed]:
        """List what follows the 28 common numbers of the observation."""

    @abstractmethod
    def goals(self, values: Values) -> tuple[Floats, Floats]:
        """Give what is achieved and what is desired, two arrays of one shape."""

    @abstractmethod
    def solution(self, values: Values) -> dict[str, Value]:
        """Give an intervention after which the goal is fulfilled."""


def term(
    name: str, function: Callable[..., Any], parents: Iterable[str | Parent], doc: str
) -> Measured:
    """Declare a reward term."""
    return Measured(name=name, parents=tuple(parents), mechanism=Function(function), doc=doc)


def above(value: float, *, threshold: float) -> int:
    """Tell whether a number lies above a threshold, as 0 or 1."""
    return int(value > threshold)


def reward(weights: Mapping[str, float]) -> Measured:
    """Declare the reward: the weighted sum of the terms whose weight is not zero."""
    used = {name: weight for name, weight in weights.items() if weight != 0.0}
    return Measured(
        name="reward",
        parents=tuple(used),
        mechanism=Linear(weights=tuple(used.values())),
        doc="Weighted sum of the reward terms.",
    )


HEAD = (
    Observed("joint_positions", (trifinger.JOINT_LOW, trifinger.JOINT_HIGH), low=-3.3, high=3.3),
    Observed("joint_velocities", (-50.0, 50.0)),
    Observed(
        "end_effector_positions", ((-0.5, -0.5, 0.0) * 3, (0.5, 0.5, 0.5) * 3), low=-1.0, high=1.0
    ),
)
"""What every observation begins with, after the time that is left."""

_CARTESIAN = ((-0.5, -0.5, 0.0), (0.5, 0.5, 0.5))
_SPACE = {"low": -1.0, "high": 1.0}


def observe_tool(name: str) -> Iterable[Observed]:
    """List the 17 numbers of a movable block."""
    yield Observed(f"{name}.type", (1, 1), low=0.0, high=30.0)
    yield Observed(f"{name}.size", (0.03, 0.1))
    yield Observed(f"{name}.cartesian_position", _CARTESIAN, **_SPACE)
    yield Observed(f"{name}.orientation", (-10.0, 10.0), **_SPACE)
    yield Observed(f"{name}.linear_velocity", (-0.5, 0.5))
    yield Observed(f"{name}.angular_velocity", (-np.pi, np.pi))


def observe_goal(name: str) -> Iterable[Observed]:
    """List the 11 numbers of a goal block."""
    yield Observed(f"{name}.type", (20, 20), low=0.0, high=30.0)
    yield Observed(f"{name}.size", (0.03, 0.1))
    yield Observed(f"{name}.cartesian_position", _CARTESIAN, **_SPACE)
    yield Observed(f"{name}.orientation", (-10.0, 10.0), **_SPACE)


def observe_position(name: str) -> Iterable[Observed]:
    """List the three numbers of a goal that is a point."""
    yield Observed(f"{name}.cartesian_position", _CARTESIAN, **_SPACE)


UNIT = Box(0.0, 1.0)
