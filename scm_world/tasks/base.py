"""Tasks: a system, its goal, its observation, and how it is experimented with."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Self, final

import numpy as np

from scm_world._arguments import finite_numbers, one_of, scalar, whole_number
from scm_world._types import ArrayLike, Floats, Value, Values
from scm_world.backends import Backend
from scm_world.errors import UnknownOption
from scm_world.graph import SCM
from scm_world.tasks.composition import Composition
from scm_world.variables import Box, Draw, Integers, Variable
from scm_world.variables.kinds import SpaceName

if TYPE_CHECKING:
    from scm_world.world import Simulation as Simulation

TIME = "time_left_for_task"
OVERLAP = "published_overlap"

Symmetries = Iterable[tuple[Values, Sequence[int]]]
Scenario = tuple[Callable[..., tuple[dict[str, Value], Any]], Callable[..., Floats], int | None]


@final
@dataclass(frozen=True)
class Observed:
    """A part of the structured observation.

    Attributes:
        variable: Its name.
        published: Lower and upper bound of the predecessor's normalisation; None for the time that
            is left, which ends with the episode.
        low: Lower bound of each component; the declared one if None.
        high: Upper bound.
    """

    variable: str
    published: tuple[ArrayLike, ArrayLike] | None = None
    low: ArrayLike | None = None
    high: ArrayLike | None = None


@final
@dataclass(frozen=True)
class Observation:
    """The observed and measured variables of a task, in one of its structures.

    Attributes:
        rows: The parts of the structured observation, in order.
        saturates: Whether observed states and goals are clipped to the bounds they declare.
        view: The scene in a frame of its own: names of variables, the number of components, and a
            function of the values; None if the task has no such readout.
        symmetries: A function of values and of the names that are wanted. It lists the scenes in
            which the same behaviour is right: the values of these variables, and for each number of
            an action there its number in the present scene.
        measured: Outcomes of experiments by default; all states, reward and success if None.
        moving: Further outcomes where every instant is measured.
    """

    rows: tuple[Observed, ...] = ()
    saturates: bool = False
    view: tuple[tuple[str, ...], int, Callable[[Values], Floats]] | None = None
    symmetries: Callable[[Values, Iterable[str]], Symmetries] | None = None
    measured: tuple[str, ...] | None = None
    moving: tuple[str, ...] = ()


@final
@dataclass(frozen=True)
class Goal:
    """What a task asks for, in one of its structures.

    Attributes:
        achieved: Variables whose numbers should become those of ``desired``.
        desired: Their goals, as many numbers together.
        causes: The variables that a new goal is drawn for.
        measures: Functions of the two vectors, shapes (..., n), with values of shape (...): the
            reward terms that they decide, such as ``success``, and ``published_overlap``, the
            fractional success of CausalWorld 1.2.
        closeness: The score that planners maximise: names of variables, and a function of their
            values, shapes (..., *shape), with values (...); minus the distance of the vectors if
            None.
        tools: Boxes that should be moved.
        targets: Goals, each with the box that its solution puts there.
    """

    achieved: tuple[str, ...] = ()
    desired: tuple[str, ...] = ()
    causes: tuple[str, ...] = ()
    measures: Mapping[str, Callable[[Floats, Floats], Any]] = field(default_factory=dict)
    closeness: tuple[tuple[str, ...], Callable[..., Any]] | None = None
    tools: tuple[str, ...] = ()
    targets: Mapping[str, str] = field(default_factory=dict)

    def vectors(self, values: Values) -> tuple[Floats, Floats]:
        """Return the achieved and the desired vector, which have one shape."""
        achieved, desired = (
            np.concatenate([np.empty(0), *(np.ravel(values[name]) for name in names)])
            for names in (self.achieved, self.desired)
        )
        return achieved, desired


@dataclass(frozen=True)
class Conventions:
    """Choices of an environment that go together.

    Attributes:
        name: ``"scm_world"`` or ``"causal_world"``.
        published: Whether they are those of CausalWorld 1.2: rewards multiplied by the control
            period, episodes one step longer than their length, the published normalisation of
            observations, which values may leave, and a time feature in seconds minus steps where a
            length is given.
    """

    name: str = "scm_world"
    published: bool = False

    def adapt(self, variables: Iterable[Variable]) -> Iterable[Variable]:
        """Return the variables with the spaces of these conventions."""
        return variables


def some_numbers(option: str, given: object, sizes: tuple[int, ...], *allowed: str) -> list[float]:
    """Return an argument of so many finite numbers, or refuse it with what is allowed."""
    numbers = finite_numbers(given)
    if numbers is None or numbers.ndim != 1 or len(numbers) not in sizes:
        raise UnknownOption(option, given, allowed)
    return [*map(float, numbers)]


def checked(
    option: str, value: object, allowed: Box | Integers, *, shape: tuple[int, ...] = ()
) -> Any:
    """Return an argument that lies within the bounds of the variable whose default it is."""
    number = finite_numbers(value)
    if number is None or number.shape != shape or not allowed.contains(number):
        many = f"{shape[0]} numbers: " if shape else "a number: "
        raise UnknownOption(option, value, (many + allowed.describe(),))
    return scalar(value)


@final
@dataclass(frozen=True)
class Options:
    """How a world is commanded, and how time and variables are cut.

    Attributes:
        preset: Numerical settings, one of the task's ``choices`` like the next three.
        action_mode: How the system is commanded.
        resolution: How finely variables are cut.
        conventions: Those of scm_world or of its predecessor.
        frame_skip: Length of a control step in units of the task.
        control_period: The same [s].
        given_length: Length of an episode in control steps, if one was given.
        steps: Length of an episode in control steps; 0 until the structure is known.
    """

    preset: str
    action_mode: str
    resolution: str
    conventions: Conventions
    frame_skip: int
    control_period: float
    given_length: int | None
    steps: int = 0

    @classmethod
    def checked(
        cls,
        task: Task,
        *,
        frame_skip: int | None,
        max_episode_length: int | None,
        **chosen: str | None,
    ) -> Options:
        """Return checked options, the others by name; None stands for the default of the task.

        Raises:
            UnknownOption: A name does not exist, or a number is not a positive whole number.
        """
        skip = task.frame_skip if frame_skip is None else frame_skip
        skip = whole_number("frame_skip", skip, least=1)
        if max_episode_length is not None:
            max_episode_length = whole_number("max_episode_length", max_episode_length, least=1)
        asked: dict[str, Any] = {}
        for option, value in chosen.items():
            allowed = task.choices[option]
            asked[option] = next(iter(allowed)) if value is None else value
            one_of(option, asked[option], allowed)
        asked["conventions"] = task.choices["conventions"][asked["conventions"]]
        asked |= {"frame_skip": skip, "control_period": task.time_unit * skip}
        return cls(**asked, given_length=max_episode_length)


class Task(ABC):
    """A system and its goal.

    An instance describes one structure. Where variables decide which entities there are (levels,
    counts), they are declared in ``shared`` and named in ``decided_by``; ``arrange`` turns their
    values into a ``plan``, and everything else follows from ``self.plan``. ``TriFingerTask`` is the
    base of goal families of the block-building robot, ``ModelTask`` that of any other model.

    Attributes:
        name: Name of the task.
        choices: For each of ``action_mode`` (how the system is commanded), ``preset`` (numerical
            settings), ``resolution`` (how finely its variables are cut) and ``conventions`` the
            values, of which the first is the default; conventions by their names.
        conventions: The conventions that hold.
        time_unit: The unit of ``frame_skip`` [s].
        frame_skip: Default length of a control step.
        seconds: Length of an episode [s].
        weights: Weight of each reward term, by the name of its variable.
        goal: The variables that are achieved and desired, and their measures.
        observation: The observed and measured variables.
        decided_by: The shared variables that decide which entities there are.
        plan: The structure, from ``arrange``; None where that is always the same.
        absent: Entities that an intervention took away.
        n_actions: Number of components of an action, where it is the same in every mode.
        policies: Scripted policies of the task, by name.
        training: Fields of its learning recipe, such as ``{"steps": 200_000}``; those of an
            algorithm under its name. The others have their usual values.
        backend: Default backend.
        generated_graph: Whether edges follow from structure, so that some may never show.
        noise_floors: The largest effect on each state of what the backend remembers beside them.
        given: The arguments of the task.
        is_named: Whether every argument was given by name, so that a file can hold them.
    """

    given: dict[str, Any]
    is_named: bool

    name: str
    conventions: Conventions = Conventions()
    choices: ClassVar[dict[str, Any]] = {
        "resolution": ("declared",),
        "conventions": {
            "scm_world": conventions,
            "causal_world": Conventions("causal_world", published=True),
        },
    }
    time_unit: float
    frame_skip: int
    seconds: Any
    weights: Mapping[str, float] = {}  # a constant
    decided_by: ClassVar[tuple[str, ...]] = ()
    plan: Hashable = None
    absent: frozenset[str] = frozenset()
    n_actions: ClassVar[int | None] = None
    policies: ClassVar[Mapping[str, Callable[[], Any]]] = {}
    training: ClassVar[Mapping[str, Any]] = {}
    backend: ClassVar[str] = "mujoco"
    generated_graph: bool = False
    noise_floors: Mapping[str, float] = {}  # a constant

    def __new__(cls, *args: object, **given: object) -> Self:
        """Keep the arguments of the task, so that a file can hold them."""
        task = super().__new__(cls)
        task.given = dict(given)
        task.is_named = not args
        return task

    def __fingerprint__(self) -> dict[str, Any]:
        """Return what decides the task: its class, its arguments and the compiled model."""
        given = {f"argument {n!r}": v for n, v in sorted(self.given.items()) if n != "model"}
        system = getattr(self, "system", None)
        physics = {} if system is None else {"physics": system}
        return {"class of the task": type(self), **given, **physics}

    @property
    def goal(self) -> Goal:
        """The goal; an empty one where the reward alone counts."""
        return Goal()

    @property
    def observation(self) -> Observation:
        """The observed and measured variables."""
        return Observation()

    @abstractmethod
    def compose(self, options: Options) -> tuple[Composition, list[Variable]]:
        """Declare all variables, and their meaning to a backend."""

    def on(self, backend: Backend) -> Self:
        """Return the same task as far as a backend can realise it."""
        return self

    def arrange(self, values: Values) -> Hashable:
        """Return the plan that follows from the variables of ``decided_by``."""
        return None

    def at(
        self, plan: Hashable, conventions: Conventions, absent: frozenset[str] = frozenset()
    ) -> Self:
        """Return the same task with another structure, or under other conventions."""
        other = copy.copy(self)
        other.plan, other.conventions, other.absent = plan, conventions, absent
        return other

    def shared(self) -> Iterable[Variable]:
        """Declare causes that several entities have in common; the same for every plan."""
        return ()

    def solution(self, values: Values) -> dict[str, Value]:
        """Return an intervention that fulfils the goal; an empty one without a goal."""
        return {}

    def groups(
        self, model: SCM, spaced: Sequence[Variable], bodies: Collection[str]
    ) -> dict[str, list[str]]:
        """Return the groups of variables that curricula know by a word, such as ``"poses"``.

        ``"unphysical"`` are those that ``@physics`` leaves out. Given are all variables, the roots
        and states that have a space, and the bodies that move.
        """
        return {}

    def sample_goal(self, space: SpaceName = "A") -> dict[str, Any]:
        """Return the intervention that draws a new goal, for ``reset(do=…)`` or ``do``.

        Args:
            space: ``"A"``, ``"B"`` or ``"A|B"``.
        """
        return {name: Draw(space) for name in self.goal.causes}

    def idle(self, world: Simulation) -> Floats:
        """Return the idle action, shape (n_actions,): zero, or the nearest one in the range."""
        low, high = world.action_low, world.action_high
        return np.asarray(np.clip(np.zeros(len(low)), low, high))

    def scenarios(self, world: Simulation) -> Sequence[Scenario]:
        """List kinds of states in which causes show; none: those of any system.

        Returns:
            Of each: ``prepare(world, rng)``, which returns values to set in a world that has just
            been reset, and something for ``act(world, something, rng)``, which returns an action;
            and the number of control steps before experiments, drawn from 0 to 2 if None. ``rng``
            has ``uniform(low, high, n)``.
        """
        return ()

    def nearby(self, values: Values) -> Iterable[dict[str, Value]]:
        """List interventions that change the structure a little: one entity more, one fewer.

        By default each whole number of ``decided_by`` is changed by one.
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
