"""What a task is: what there is, what is observed, what counts, and how it is experimented with."""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self, final

import numpy as np

from scm_world._types import ArrayLike, Floats, Value, Values
from scm_world.backends import Backend
from scm_world.errors import UnknownOption
from scm_world.tasks.composition import Composition
from scm_world.tasks.conventions import CONVENTIONS, Conventions
from scm_world.variables import Box, Draw, Integers, Measured, Noise, Variable
from scm_world.variables.kinds import SpaceName

TIME = "time_left_for_task"


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


def numbers_of(value: Any) -> Floats | None:
    """Read finite real numbers; None if these are none."""
    try:
        found = np.asarray(value)
    except ValueError:  # a ragged list
        return None
    numeric = found.dtype.kind in "iuf" and np.isfinite(found).all()
    return found.astype(np.float64) if numeric else None


def checked(
    option: str, value: Any, allowed: Box | Integers, *, shape: tuple[int, ...] = ()
) -> Any:
    """Check an argument of a task against the bounds of the variable that it is the default of.

    Args:
        option: Its name.
        value: What was given.
        allowed: The bounds.
        shape: Of the variable.

    Returns:
        What was given.

    Raises:
        UnknownOption: It is no number, of another shape, or out of bounds.
    """
    number = numbers_of(value)
    if number is None or number.shape != shape or not allowed.contains(number):
        many = f"{shape[0]} numbers in " if shape else "a number in "
        raise UnknownOption(option, value, (many + allowed.describe(shape, {}),))
    return value


def checked_weight(name: str, weight: Any) -> float:
    """Check the weight of a reward term.

    Raises:
        UnknownOption: It is no finite number.
    """
    try:
        number = float(weight)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise UnknownOption(f"weight of {name}", weight, ("any finite number",))
    return number


_DRAWS = 96


@final
class Dice:
    """The random numbers of one probe state.

    They depend on seed, probe and attempt only, not on what was drawn before.

    Args:
        noise: The seed's noise.
        probe: Number of the probe state.
        attempt: Counts up where a choice was not feasible.
    """

    def __init__(self, noise: Noise, probe: int, attempt: int = 0) -> None:
        self._noise, self._probe, self._attempt = noise, probe, attempt
        self._numbers = self.of("probe", _DRAWS)
        self._used = 0

    def between(self, low: float, high: float, n: int | None = None) -> Any:
        """Draw one number, or an array of ``n``; at most 96 in all."""
        count = 1 if n is None else n
        drawn = self._numbers[self._used : self._used + count]
        self._used += count
        scaled = low + (high - low) * drawn
        return float(scaled[0]) if n is None else scaled

    def of(self, stream: str, n: int) -> Floats:
        """Draw numbers in [0, 1) that belong to a name, shape (n,)."""
        drawn = self._noise.uniforms(stream, n=n, episode=self._probe, step=self._attempt)
        found: Floats = drawn[0]
        return found


@final
@dataclass(frozen=True)
class Scenario:
    """A kind of probe state.

    Attributes:
        name: How the state comes about.
        prepare: Chooses what to set in a world that has just been reset. It may let the world run
            on before. What else it gives is handed to ``act``.
        act: Gives an action, shape (n_actions,).
        steps: How many control steps are taken before the experiments; drawn from 0 to 2 if None.
        fresh: Whether what was set counts as what was there: experiments then do not add up with
            it to one intervention, and are faster.
    """

    name: str
    prepare: Callable[[Any, Dice], tuple[dict[str, Value], Any]]
    act: Callable[[Any, Any, Dice], Floats]
    steps: int | None = None
    fresh: bool = False


class Blind(ABC):
    """A policy that ignores the state: all its actions are known beforehand."""

    @abstractmethod
    def ahead(self, world: Any, first: int, count: int) -> Floats:
        """Give the actions of some control steps.

        Args:
            world: As it is now. A policy asked for the first time may look at it.
            first: The first control step.
            count: How many.

        Returns:
            Shape (count, n_actions).
        """

    def __call__(self, world: Any) -> Floats:
        """Give the action of the present step."""
        action: Floats = self.ahead(world, world.index, 1)[0]
        return action


def kept_rows(actions: Floats, first: int, count: int) -> Floats:
    """Take rows of actions; after the last one it is kept."""
    found: Floats = actions[np.minimum(np.arange(first, first + count), len(actions) - 1)]
    return found


def action_range(world: Any) -> tuple[Floats, Floats]:
    """Return the lower and upper end of all actions, shape (n_actions,) each.

    An action without an end is drawn from [-1, 1], or as far beyond the end that it has.
    """
    low, high = world.action_low, world.action_high
    low = np.where(np.isfinite(low), low, np.minimum(-1.0, high - 2.0))
    high = np.where(np.isfinite(high), high, np.maximum(1.0, low + 2.0))
    return low, high


@final
@dataclass(frozen=True)
class Timing:
    """How a world is commanded and how time is cut.

    Attributes:
        action_mode: One of the task's ``action_modes``.
        preset: One of the task's ``presets``.
        control_period: Length of a control step [s].
        steps: Length of an episode in control steps.
        resolution: One of the task's ``resolutions``.
    """

    action_mode: str
    preset: str
    control_period: float
    steps: int
    resolution: str


class Task(ABC):
    """A system, and what counts in it.

    An instance describes one structure. Where variables decide what there is (levels, counts),
    they are declared in ``shared`` and named in ``decided_by``; ``arrange`` turns their values
    into a ``plan``, and every other method reads ``self.plan``. ``TriFingerTask`` is the base of
    goal families of the block-building robot, ``ModelTask`` that of any other model.

    Attributes:
        name: Of the task.
        action_modes: How the system can be commanded; the first is the default.
        presets: Numerical settings to choose from; the first is the default.
        resolutions: How finely its variables can be cut; the first is the default.
        time_unit: What ``frame_skip`` counts [s].
        frame_skip: Length of a control step, if none is asked for.
        seconds: Length of an episode [s].
        weights: Weight of each reward term, by the name of its variable.
        terms: Reward terms that were asked for.
        decided_by: The shared variables that decide what there is.
        goal_causes: The variables that a new goal is drawn for.
        head: What a structured observation begins with, after the time that is left.
        saturates: Whether observed states and goals are clipped to the bounds they declare.
        rest: Joint positions at the start of an episode, where the task has a robot.
        raised: Joint positions in which the robot is out of the way.
        policies: Scripted policies of its own, by name.
        training: Fields of a recipe with which it is learned, such as ``{"steps": 200_000}``;
            those of an algorithm under its name. The others are the usual ones.
        plan: What there is, as ``arrange`` has it; None where that is always the same.
        absent: Entities that an intervention took away.
        checks_functions: Whether what functions of users give is checked when a world begins.
        backend: Name of the backend that realises it, where none is asked for.
        generated_graph: Whether edges follow from structure, so that some may never show.
        conventions: Ours or the predecessor's.
        given: What it was made with.
    """

    given: dict[str, Any]
    is_named: bool

    name: str
    action_modes: tuple[str, ...]
    presets: tuple[str, ...]
    resolutions: tuple[str, ...] = ("declared",)
    time_unit: float
    frame_skip: int
    seconds: Any
    weights: Mapping[str, float] = {}  # a constant
    terms: tuple[Measured, ...] = ()
    decided_by: ClassVar[tuple[str, ...]] = ()
    goal_causes: ClassVar[tuple[str, ...]] = ()
    head: ClassVar[tuple[Observed, ...]] = ()
    saturates: ClassVar[bool] = False
    rest: ClassVar[tuple[float, ...]] = ()
    raised: ClassVar[tuple[float, ...]] = ()
    policies: ClassVar[Mapping[str, Callable[[], Any]]] = {}
    training: ClassVar[Mapping[str, Any]] = {}
    plan: Hashable = None
    checks_functions: ClassVar[bool] = False
    absent: frozenset[str] = frozenset()
    backend: ClassVar[str] = "mujoco"
    generated_graph: bool = False
    conventions: Conventions = CONVENTIONS["scm_world"]

    def __new__(cls, *args: Any, **given: Any) -> Self:
        """Keep the arguments of the task, so that it can be made again from a file."""
        task = super().__new__(cls)
        task.given = dict(given)
        task.is_named = not args  # every argument has its name
        return task

    def __fingerprint__(self) -> dict[str, Any]:
        """Return what decides the task: its class, its arguments, and what an engine compiles."""
        given = {f"argument {n!r}": v for n, v in sorted(self.given.items()) if n != "model"}
        system = getattr(self, "system", None)
        physics = {} if system is None else {"physics": system}
        return {"class of the task": type(self), **given, **physics}

    @abstractmethod
    def compose(self, timing: Timing) -> tuple[Composition, list[Variable]]:
        """Declare all variables, and say what they mean to an engine."""

    def on(self, backend: Backend) -> Self:
        """Give the same task as far as a backend can realise it."""
        return self

    def refusal(self, name: str) -> str | None:
        """Say why something of this name is no variable, where there is a reason."""
        return None

    def arrange(self, values: Values) -> Hashable:
        """Say what there is, given the variables of ``decided_by``."""
        return None

    def at(
        self, plan: Hashable, conventions: Conventions, absent: frozenset[str] = frozenset()
    ) -> Self:
        """Give the same task with another structure, or under other conventions."""
        other = copy.copy(self)
        other.plan, other.conventions, other.absent = plan, conventions, absent
        return other

    def shared(self) -> Iterable[Variable]:
        """Declare causes that several entities have in common; the same for every plan."""
        return ()

    def observed(self) -> Iterable[Observed]:
        """List what is observed, in order."""
        return ()

    def tools(self) -> tuple[str, ...]:
        """Name the boxes that should be moved."""
        return ()

    def targets(self) -> dict[str, str]:
        """Name the goals, each with the box that its solution puts there."""
        return {}

    def measured(self, *, every_step: bool = False) -> tuple[str, ...] | None:
        """Name what experiments measure by default; None for all states, reward and success.

        Args:
            every_step: Whether it is measured at every instant.
        """
        return None

    def closeness(self) -> tuple[tuple[str, ...], Callable[..., Any]] | None:
        """Return what planners maximise by default; None for the distance to the goal.

        Returns:
            Names of variables, and a function of their values, shapes (..., *shape), that gives
            numbers of shape (...). It can be pickled.
        """
        return None

    def goal_names(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Name the variables that say what is achieved, and those that say what is desired."""
        return (), ()

    def goals(self, values: Values) -> tuple[Floats, Floats]:
        """Give what is achieved and what is desired, two vectors of one shape."""
        achieved, desired = (
            np.concatenate([np.empty(0), *(np.ravel(values[name]) for name in names)])
            for names in self.goal_names()
        )
        return achieved, desired

    def fraction(self, achieved: ArrayLike, desired: ArrayLike) -> Floats:
        """Compute the fractional success of vectors as ``goals`` gives them.

        Args:
            achieved: Shape (..., n).
            desired: Shape (..., n).

        Returns:
            Shape (...).

        Raises:
            UnknownOption: The task has no goals.
        """
        raise UnknownOption("goals of", self.name, ("a task with goals",))

    def view(self) -> tuple[tuple[str, ...], int, Callable[[Values], Floats]] | None:
        """Describe what a hand sees of the system, if the task knows such a thing.

        Returns:
            Names of variables, how many numbers it is, and a function of their values that gives
            these numbers.
        """
        return None

    def symmetries(
        self, values: Values, names: Iterable[str]
    ) -> Iterable[tuple[Values, Sequence[int]]]:
        """List scenes in which the same is right as in this one, but for the order of actions.

        Args:
            values: Of the variables.
            names: Of those that are wanted.

        Returns:
            For each such scene the values of these variables, and which number of an action in
            the present scene each number of the action there is; none where there is no symmetry.
        """
        return ()

    def published_overlap(self, values: Values) -> float | None:
        """Compute the fractional success as CausalWorld 1.2 does; None if it has no such task."""
        return None

    def fulfilled(self, fraction: ArrayLike) -> Any:
        """Tell whether a fractional success counts as success, shape (...)."""
        return np.asarray(fraction) >= 1.0

    def solution(self, values: Values) -> dict[str, Value]:
        """Give an intervention after which the goal is fulfilled; none where there is no goal."""
        return {}

    def idle(self, world: Any) -> Floats:
        """Return the idle action: zero, or what is nearest to it.

        Args:
            world: In this task.

        Returns:
            Shape (n_actions,).
        """
        low, high = world.action_low, world.action_high
        return np.asarray(np.clip(np.zeros(len(low)), low, high))

    def scenarios(self, world: Any) -> Sequence[Scenario]:
        """List kinds of state in which experiments tell something; none: those of any system.

        Args:
            world: In this task, where an episode begins.
        """
        return ()

    def nearby(self, values: Values) -> Iterable[dict[str, Value]]:
        """List interventions that change what stands in the world a little: one more, one fewer.

        Experiments use them. Here each whole number of ``decided_by`` is changed by one.
        """
        declared = {variable.name: variable for variable in self.shared()}
        for name in self.decided_by:
            bounds = declared[name].bounds
            for step in (1, -1) if isinstance(bounds, Integers) else ():
                for index in reversed(range(np.size(values[name]))):
                    other = np.array(values[name])
                    other.reshape(-1)[index] += step
                    if bounds.contains(other):  # type: ignore[union-attr] # whole numbers
                        yield {name: other}

    def sample_goal(self, space: SpaceName = "A") -> dict[str, Any]:
        """Give the intervention that draws a new goal, for ``reset(do=…)`` or ``do``.

        Args:
            space: Where from: ``"A"``, ``"B"`` or ``"A|B"``.
        """
        return {name: Draw(space) for name in self.goal_causes}
