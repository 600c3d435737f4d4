"""What a task is: what stands in the world, what is shared, and what counts."""

from __future__ import annotations

import copy
import inspect
from abc import ABC, abstractmethod
from collections.abc import Hashable, Iterable, Mapping
from typing import Any, ClassVar, Self, Unpack

import numpy as np

from scm_world._types import ArrayLike, Floats, Value, Values
from scm_world.entities import Entity
from scm_world.errors import UnknownOption
from scm_world.scene import trifinger
from scm_world.tasks import shaping
from scm_world.tasks.arguments import numbers_of
from scm_world.tasks.conventions import CONVENTIONS, Conventions
from scm_world.tasks.observed import Observed
from scm_world.tasks.rewards import Common, further_terms, resolve
from scm_world.variables import Draw, Integers, Measured, Variable
from scm_world.variables.kinds import SpaceName


class Task(ABC):
    """A goal family.

    An instance describes one structure: the entities there are. Where variables decide how many
    (levels, counts), they are declared in ``shared`` and named in ``decided_by``; ``arrange``
    turns their values into a ``plan``, and every other method reads ``self.plan``.

    Attributes:
        name: Of the task.
        default_weights: Weight of every dense reward term, in order, and of
            ``fractional_success``.
        paper_weights: Where the published training runs differ.
        ready_terms: Further reward terms, by name in the option ``terms``.
        decided_by: The shared variables that decide what stands in the world.
        goal_causes: The variables that a new goal is drawn for.
        plan: What stands in the world, as ``arrange`` has it; None where that is always the same.
        absent: Entities that an intervention took away.
        conventions: Ours or the predecessor's.
        weights: Weight of each reward term, by the name of its variable.
        terms: Reward terms that were asked for.
        start: Where the robot begins, shape (9,) [rad].
        given: What it was made with.
    """

    given: dict[str, Any]
    is_named: bool

    name: ClassVar[str]
    default_weights: ClassVar[Mapping[str, float]]
    paper_weights: ClassVar[Mapping[str, float]] = {}
    ready_terms: ClassVar[tuple[Measured, ...]] = shaping.ROBOT
    decided_by: ClassVar[tuple[str, ...]] = ()
    goal_causes: ClassVar[tuple[str, ...]] = ()
    rest: ClassVar[tuple[float, ...]] = trifinger.REST
    plan: Hashable = None
    absent: frozenset[str] = frozenset()
    conventions: Conventions = CONVENTIONS["scm_world"]

    def __new__(cls, *args: Any, **given: Any) -> Self:
        """Remember what the task was made with, so that it can be made again from a file."""
        task = super().__new__(cls)
        task.given = dict(given)
        task.is_named = not args  # every argument has its name
        return task

    def __init__(self, **common: Unpack[Common]) -> None:
        unknown = sorted(common.keys() - Common.__annotations__.keys())
        if unknown:
            raise UnknownOption(f"option of {self.name}", unknown[0], self.arguments())
        self.terms = further_terms(common.get("terms", ()), self.default_weights, self.ready_terms)
        self.weights = resolve(self.default_weights, self.paper_weights, common, self.terms)
        given = common.get("joint_positions")
        joints = numbers_of(self.rest if given is None else given)
        if joints is None or joints.shape != (trifinger.N_JOINTS,):
            raise UnknownOption("joint_positions", given, ("nine angles [rad]",))
        self.start = tuple(joints.tolist())

    @classmethod
    def arguments(cls) -> tuple[str, ...]:
        """Name the arguments of the constructor, those of this family first."""
        own = [vars(kind)["__init__"] for kind in cls.__mro__ if "__init__" in vars(kind)]
        given = [p for init in own[:-1] for p in inspect.signature(init).parameters.values()]
        names = [parameter.name for parameter in given if parameter.kind is parameter.KEYWORD_ONLY]
        return tuple(dict.fromkeys((*names, *Common.__annotations__)))

    @property
    @abstractmethod
    def seconds(self) -> float:
        """Length of an episode [s]."""

    def arrange(self, values: Values) -> Hashable:
        """Say what stands in the world, given the variables of ``decided_by``."""
        return None

    def at(
        self, plan: Hashable, conventions: Conventions, absent: frozenset[str] = frozenset()
    ) -> Self:
        """Give the same task with another structure, or under other conventions."""
        other = copy.copy(self)
        other.plan, other.conventions, other.absent = plan, conventions, absent
        return other

    @abstractmethod
    def entities(self) -> Iterable[Entity]:
        """List what stands in the world besides the robot and the stage."""

    def shared(self) -> Iterable[Variable]:
        """Declare causes that several entities have in common; the same for every plan."""
        return ()

    @abstractmethod
    def readouts(self) -> Iterable[Variable]:
        """Declare reward terms, fractional success and success."""

    @abstractmethod
    def observed(self) -> Iterable[Observed]:
        """List what follows the 28 common numbers of the observation."""

    @abstractmethod
    def goal_names(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Name the variables that say what is achieved, and those that say what is desired."""

    def goals(self, values: Values) -> tuple[Floats, Floats]:
        """Give what is achieved and what is desired, two vectors of one shape."""
        achieved, desired = (
            np.concatenate([np.ravel(values[name]) for name in names])
            for names in self.goal_names()
        )
        return achieved, desired

    @abstractmethod
    def fraction(self, achieved: ArrayLike, desired: ArrayLike) -> Floats:
        """Compute the fractional success of vectors as ``goals`` gives them.

        Args:
            achieved: Shape (..., n).
            desired: Shape (..., n).

        Returns:
            Shape (...).
        """

    @abstractmethod
    def fulfilled(self, fraction: ArrayLike) -> Any:
        """Tell whether a fractional success counts as success, shape (...)."""

    @abstractmethod
    def solution(self, values: Values) -> dict[str, Value]:
        """Give an intervention after which the goal is fulfilled."""

    def nearby(self, values: Values) -> Iterable[dict[str, Value]]:
        """List interventions that change what stands in the world a little: one more, one fewer.

        Experiments use them. Here each whole number of ``decided_by`` is changed by one.
        """
        declared = {variable.name: variable for variable in self.shared()}
        for name in self.decided_by:
            bounds = declared[name].bounds
            if isinstance(bounds, Integers):
                yield from ({name: other} for other in _counts(values[name], bounds))

    def sample_goal(self, space: SpaceName = "A") -> dict[str, Any]:
        """Give the intervention that draws a new goal, for ``reset(do=…)`` or ``do``.

        Args:
            space: Where from: ``"A"``, ``"B"`` or ``"A|B"``.
        """
        return {name: Draw(space) for name in self.goal_causes}


def _counts(present: Value, bounds: Integers) -> Iterable[Value]:
    """Change one whole number by one, upward first, the last component first."""
    for step in (1, -1):
        for index in reversed(range(np.size(present))):
            other = np.array(present)
            other.reshape(-1)[index] += step
            if bounds.contains(other):
                yield other
