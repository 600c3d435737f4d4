"""What is observed: a choice of parts, put together for the structure that there is."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, final

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from scm_world._arguments import one_of
from scm_world._types import Floats, Values
from scm_world.env.vector import (
    CORNERS,
    KEYPOINTS,
    WIDE,
    Layouts,
    ObservedPart,
    Vector,
    View,
    bounds,
    keypoints,
    spread,
)
from scm_world.errors import InterventionError, UnknownOption
from scm_world.models.camera import Camera
from scm_world.tasks import Observed
from scm_world.tasks.base import finite_numbers
from scm_world.variables import Linear
from scm_world.world import Simulation
from scm_world.world.compiled_task import CompiledTask
from scm_world.world.mechanisms import places

BOUND = 10.0
"""Goals that saturate are positions [m], sizes [m] and unit quaternions; beyond they saturate."""


@final
class Goals:
    """The two goal vectors of a structure.

    Args:
        declaration: Of the structure.

    Attributes:
        names: The variables that have to be computed.
        size: How many numbers each vector has.
        bound: Numbers beyond it saturate in observations.
        spaces: Of ``achieved_goal`` and of ``desired_goal``: 64-bit floats of their true shapes,
            so that a reward that is computed from them is exact.
    """

    def __init__(self, declaration: CompiledTask) -> None:
        goal = declaration.task.goal
        self.names = (*goal.achieved, *goal.desired)
        where = declaration.mechanisms.where
        self._sides = tuple(
            places(where[name] for name in side) for side in (goal.achieved, goal.desired)
        )
        self.size = self._sides[0].size
        self.bound = BOUND if declaration.task.observation.saturates else WIDE
        self.spaces: dict[str, gymnasium.Space[Any]] = {
            name: gymnasium.spaces.Box(-self.bound, self.bound, (side.size,), np.float64)
            for name, side in zip(("achieved_goal", "desired_goal"), self._sides, strict=True)
        }

    def read(self, world: Simulation) -> tuple[Floats, Floats]:
        """Give what is achieved and what is desired."""
        row, (achieved, desired) = world.row.numbers, self._sides
        return row.take(achieved), row.take(desired)

    def observe(self, world: Simulation) -> dict[str, Floats]:
        """Give both vectors, by name."""
        pair = zip(self.spaces, self.read(world), strict=True)
        return {name: np.clip(goal, -self.bound, self.bound) for name, goal in pair}


def goal_reward(world: Simulation) -> Callable[[ArrayLike, ArrayLike, Any], Any]:
    """Return what computes the part of the reward that goals alone decide.

    With ``weights="sparse"``, or where only ``fractional_success`` and ``success`` have weights,
    it is the reward of the step. Else the first call warns: goals do not decide dense terms.
    """
    reward: Any = world.model.declared("reward")
    if not isinstance(reward.mechanism, Linear):
        allowed = ("False", "a reward that is Linear in terms: Measured(mechanism=Linear(…))")
        raise UnknownOption("goal_env", True, allowed)
    warned = False

    def compute_reward(achieved: ArrayLike, desired: ArrayLike, info: Any = None) -> Any:
        """Compute the reward of having achieved one goal while another one was desired.

        Args:
            achieved: As in the observation, shape (..., n).
            desired: Shape (..., n).
            info: Not needed; learners give it.

        Returns:
            The weighted sum of the terms that goals alone decide, shape (...); times the control
            period under the conventions that say so.
        """
        nonlocal warned
        size = Goals(world.compiled).size

        def read(name: str, given: ArrayLike) -> Floats:
            goal = finite_numbers(given)
            if goal is None or goal.shape[-1:] != (size,):
                raise UnknownOption(name, given, (f"finite numbers of shape (..., {size})",))
            return goal

        have, want = read("achieved goal", achieved), read("desired goal", desired)
        try:
            shape = np.broadcast_shapes(have.shape[:-1], want.shape[:-1])
        except ValueError:
            allowed = (f"({', '.join(map(str, have.shape))}), as that of achieved goals",)
            raise UnknownOption("shape of desired goals", want.shape, allowed) from None
        node: Any = world.model.declared("reward")
        weights = zip((parent.name for parent in node.parents), node.mechanism.weights, strict=True)
        total, measures = np.zeros(shape), world.task.goal.measures
        for name, weight in weights:
            if name in measures:
                total = total + weight * measures[name](have, want)
            elif not warned:
                warned = True
                gymnasium.logger.warn(
                    f"compute_reward leaves out {name!r} and every other dense term, which the "
                    "rewards of steps contain; make the environment with "
                    "task_options={'weights': 'sparse'}"
                )
        return reward_scale(world) * total

    return compute_reward


def reward_scale(world: Simulation) -> float:
    """Give what rewards are multiplied by."""
    return world.options.control_period if world.options.conventions.published else 1.0


MODES = ("structured", "full", "pixel", "custom")
CONTEXTS = ("none", "observation", "privileged")

Observation = NDArray[Any] | dict[str, NDArray[Any]]


class Observer(Protocol):
    """Something that looks at a world.

    Attributes:
        names: The variables that have to be computed before it looks.
        space: In which all observations lie.
        layouts: Where each variable stands, in every vector that is observed.
    """

    names: tuple[str, ...]
    space: gymnasium.Space[Any]
    layouts: Layouts

    def observe(self, now: Values) -> Any:
        """Give the observation of the present values."""


@final
@dataclass(frozen=True)
class Observing:
    """How a world is observed; see ``ScmWorldEnv`` for the fields."""

    mode: str = "structured"
    names: Sequence[str] = ()
    include: Sequence[str] = ()
    context: str = "none"
    keypoints: bool | str = False
    cameras: Sequence[str | Camera] | None = None
    image_size: int | tuple[int, int] | None = None
    normalize: bool = True
    goals: bool = False
    pad: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        one_of("observation_mode", self.mode, MODES)
        one_of("context", self.context, CONTEXTS)
        if bool(self.names) != (self.mode == "custom"):
            allowed = ("names with observation_mode='custom'", "nothing in the other modes")
            raise UnknownOption("observe", list(self.names), allowed)
        pictures = self.mode == "pixel"
        appended = self.include or self.keypoints or self.context == "observation"
        if pictures and appended:
            raise UnknownOption("appendix of a picture", "numbers", ("context='privileged'",))
        if self.keypoints not in (False, True, "view"):
            raise UnknownOption("keypoints", self.keypoints, ("False", "True", "view"))
        if self.pad is not None and (pictures or self.keypoints):
            raise UnknownOption("pad", self.pad, ("None with pictures and keypoints",))
        for option in ("cameras", "image_size"):
            value = getattr(self, option)
            if value is not None and not pictures:
                allowed = ("any with observation_mode='pixel'", "None in the other modes")
                raise UnknownOption(option, value, allowed)


@final
class DictObserver:
    """Several observations in a dictionary.

    Args:
        world: That is observed.
        parts: By name.
        goals: What is achieved and what is desired, if that is asked for.
    """

    def __init__(self, world: Simulation, parts: dict[str, Observer], goals: Goals | None) -> None:
        self._world, self._parts, self._goals = world, parts, goals
        self.names = tuple(name for part in parts.values() for name in part.names)
        self.layouts: Layouts = {
            name: layout for name, part in parts.items() for layout in part.layouts.values()
        }
        spaces = {name: part.space for name, part in parts.items()}
        self.space: gymnasium.Space[Any] = gymnasium.spaces.Dict(
            spaces | (goals.spaces if goals else {})
        )

    def observe(self, now: Values) -> dict[str, NDArray[Any]]:
        """Give all of them."""
        found = {name: part.observe(now) for name, part in self._parts.items()}
        return found if self._goals is None else found | self._goals.observe(self._world)


def observer(
    world: Simulation,
    declaration: CompiledTask,
    how: Observing,
    goals: Goals | None,
    largest: CompiledTask,
) -> Observer:
    """Put together what is asked for."""
    main: Observer
    if how.goals and goals is None:
        raise UnknownOption("goal_env", True, (f"False: {declaration.task.name} has no goals",))
    if how.goals and getattr(declaration.task, "success", None) is not None:
        allowed = (f"False: goals do not decide the success of this {declaration.task.name}",)
        raise UnknownOption("goal_env", True, allowed)
    if how.mode == "pixel":
        from scm_world.env.pixels import Pixels

        main = Pixels(world, how.cameras, how.image_size)
    else:
        main = _vector(world, declaration, how, largest)
    parts: dict[str, Observer] = {"observation": main}
    if how.context == "privileged":
        about = _quiet(_parts(world, largest, context(largest)))
        parts["context"] = Vector(
            world, declaration, about, normalize=how.normalize, padded=how.pad is not None
        )
    return (
        DictObserver(world, parts, goals if how.goals else None)
        if len(parts) > 1 or how.goals
        else main
    )


def context(declaration: CompiledTask) -> tuple[str, ...]:
    """Name every parameter that an intervention can set: masses, frictions, sizes and goals."""
    model = declaration.model
    return tuple(name for name in declaration.static_names if model.declared(name).settable)


def published(world: Simulation, declaration: CompiledTask) -> dict[str, Observed]:
    """List the parts of the structured observation, by variable."""
    length = world.max_episode_length * world.options.control_period
    end = length if world.options.given_length is None else float(world.options.given_length)
    return {
        part.variable: replace(part, published=part.published or (0.0, end))
        for part in declaration.task.observation.rows
    }


def _names(world: Simulation, declaration: CompiledTask, how: Observing) -> list[str]:
    names = list(how.names if how.mode == "custom" else published(world, declaration))
    if how.mode == "full":
        names += [name for name in declaration.model if name not in declaration.parts]
    return list(dict.fromkeys((*names, *how.include)))


def _vector(
    world: Simulation, declaration: CompiledTask, how: Observing, largest: CompiledTask
) -> Vector:
    names = _names(world, largest, how)
    for name in () if declaration is largest else _names(world, declaration, how):
        if name not in names:
            message = f"{name!r} has no place in the observation: pad={how.pad} is too small"
            raise InterventionError(message, variable=name)
    parts = _parts(world, largest, names)
    points = _keypoints(declaration, how.keypoints) if how.keypoints else None
    if points is not None:
        reach = np.full(points[1], 1.0 if how.keypoints is True else 4.0)  # [m], [rad]
        parts.append(ObservedPart(KEYPOINTS, -reach, reach))
    if how.context == "observation":
        rest = [name for name in context(largest) if name not in names]
        parts += _quiet(_parts(world, largest, rest))
    padded = how.pad is not None
    return Vector(
        world, declaration, parts, normalize=how.normalize, keypoints=points, padded=padded
    )


def _parts(
    world: Simulation, declaration: CompiledTask, names: Iterable[str]
) -> list[ObservedPart]:
    """Give variables the bounds of the structured observation, or those they declare.

    States of a model scale by the bounds they declare, and do not saturate: joint limits are soft.
    """
    known = published(world, declaration)
    soft = frozenset[str]()
    if not declaration.task.observation.saturates:
        soft = frozenset(declaration.slices)
    as_published = world.options.conventions.published
    parts = []
    for name in names:
        low, high = bounds(declaration.model, name)
        observed, shape = known.get(name), declaration.model.declared(name).shape
        saturates = name not in soft or (observed is not None and observed.low is not None)
        if observed is not None and as_published:
            low, high = (spread(side, shape) for side in observed.published or ())
        elif observed is not None and observed.low is not None:
            low, high = spread(observed.low, shape), spread(observed.high, shape)
        parts.append(ObservedPart(name, low, high, saturates=saturates))
    return parts


def _quiet(parts: Iterable[ObservedPart]) -> list[ObservedPart]:
    return [replace(part, sensed=False) for part in parts]


def _keypoints(declaration: CompiledTask, asked: bool | str) -> View:
    goal, view = declaration.task.goal, declaration.task.observation.view
    if asked is True:
        view = keypoints((*goal.tools, *goal.targets))
    if not goal.tools or view is None:
        raise UnknownOption("keypoints", asked, ("False: the task has no blocks, or no boxes",))
    return view


__all__ = ["CORNERS", "Observation", "Observer", "Observing", "context", "observer", "published"]
