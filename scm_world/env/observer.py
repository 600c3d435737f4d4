"""Observations: a choice of parts, put together for the present structure."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any, final

import gymnasium
import numpy as np
from numpy.typing import ArrayLike

from scm_world._arguments import finite_numbers, one_of, true_or_false, whole_number
from scm_world._patterns import as_names, fits, fitting, is_pattern
from scm_world._types import Floats, Observation
from scm_world.env.history import History
from scm_world.env.pictures import Pixels
from scm_world.env.vector import KEYPOINTS, WIDE, ObservedPart, Vector, bounds, spread
from scm_world.errors import InterventionError, UnknownOption
from scm_world.policies.cards import CONTEXTS, EVERY, context_of
from scm_world.tasks import Observed
from scm_world.tasks.model import REWARD
from scm_world.tasks.rewards import FRACTION, SUCCESS, TERMINATED
from scm_world.variables import Linear
from scm_world.world import Simulation
from scm_world.world.compiled_task import CompiledTask
from scm_world.world.mechanisms import Rows, places

BOUND = 10.0
"""Goals that saturate are positions [m], sizes [m] and unit quaternions; beyond they saturate."""


@final
class GoalVectors:
    """The two goal vectors of a structure.

    Attributes:
        names: The variables that have to be computed.
        size: How many numbers each vector has.
        bound: Numbers beyond it saturate in observations.
        spaces: Of ``achieved_goal`` and of ``desired_goal``: 64-bit floats of their true shapes,
            so that a reward that is computed from them is exact.
    """

    def __init__(self, declaration: CompiledTask) -> None:
        goal, where = declaration.task.goal, declaration.where
        self.names = (*goal.achieved, *goal.desired)
        self._sides = tuple(
            places(where[name] for name in side) for side in (goal.achieved, goal.desired)
        )
        self.size = self._sides[0].size
        self.bound = BOUND if declaration.task.observation.saturates else WIDE
        self.spaces: dict[str, gymnasium.Space[Any]] = {
            name: gymnasium.spaces.Box(-self.bound, self.bound, (side.size,), np.float64)
            for name, side in zip(("achieved_goal", "desired_goal"), self._sides, strict=True)
        }
        reward = declaration.model.declared("reward")
        self._terms = [parent.name for parent in reward.all_parents]
        self._weights = getattr(reward.equation, "weights", ())
        self._measures, self._has_warned = goal.measures, False

    def read(self, now: Rows) -> tuple[Floats, Floats]:
        """Return the achieved and the desired goal, of one world or of several."""
        numbers, (achieved, desired) = now.numbers, self._sides
        if numbers.ndim == 1:
            return numbers.take(achieved), numbers.take(desired)
        return numbers[:, achieved], numbers[:, desired]

    def observe(self, now: Rows) -> dict[str, Floats]:
        """Return both vectors, by name."""
        pair = zip(self.spaces, self.read(now), strict=True)
        return {name: np.clip(goal, -self.bound, self.bound) for name, goal in pair}

    def reward(self, achieved: ArrayLike, desired: ArrayLike) -> Floats:
        """Compute the part of the reward that goals alone decide; see ``goal_reward``."""
        both: tuple[Any, Any] = finite_numbers(achieved), finite_numbers(desired)
        for name, goal in zip(self.spaces, both, strict=True):
            if goal is None or goal.shape[-1:] != (self.size,):
                given = achieved if name == "achieved_goal" else desired
                allowed = (f"finite numbers of shape (..., {self.size})",)
                raise UnknownOption(name.replace("_", " "), given, allowed)
        try:
            have, want = np.broadcast_arrays(*both)
        except ValueError:
            shapes = [np.shape(goal) for goal in both]
            raise UnknownOption("shape of desired goals", shapes[1], (str(shapes[0]),)) from None
        total = np.zeros(have.shape[:-1])
        for name, weight in zip(self._terms, self._weights, strict=True):
            if name in self._measures:
                total = total + weight * self._measures[name](have, want)
            elif not self._has_warned:
                self._has_warned = True
                gymnasium.logger.warn(
                    f"compute_reward leaves out {name!r} and every other dense term, which the "
                    "rewards of steps contain; make the environment with "
                    "task_options={'weights': 'sparse'}"
                )
        return total


MODES = ("structured", "full", "pixel", "custom")

LONGEST = 1_000
"""Most pairs of a history."""

FAILED = "failed"
"""What ``info`` calls an episode that ends since its world failed, with ``on_failure``."""


def check_options(how: Mapping[str, Any]) -> None:
    """Refuse options of an observation that do not exist, or do not go together."""
    mode, keypoints = how["observation_mode"], how["keypoints"]
    one_of("observation_mode", mode, MODES)
    context, _ = context_of(how["context"])
    flags = ("normalize_actions", "normalize_observations", "goal_env")
    for option in (*flags, "stack_images", "stack_history"):
        true_or_false(option, how[option])
    steps = whole_number("history", how["history"], least=0, most=LONGEST)
    if how["stack_history"] and not steps:
        raise UnknownOption("stack_history", True, ("False without history", "True with history=k"))
    if keypoints is not False:
        one_of("keypoints", keypoints, ("view",))
    if bool(as_names(how["observe"])) != (mode == "custom"):
        allowed = ("names with observation_mode='custom'", "nothing in the other modes")
        raise UnknownOption("observe", how["observe"], allowed)
    pictures = mode == "pixel"
    if pictures and steps:
        stacks = "0 with pictures: gymnasium.wrappers.FrameStackObservation(env, k) stacks them"
        raise UnknownOption("history", steps, (stacks,))
    if pictures and (how["include"] or keypoints or context == "observation"):
        raise UnknownOption("appendix of a picture", "numbers", ("context='privileged'",))
    if how["pad"] is not None and (pictures or keypoints):
        raise UnknownOption("pad", how["pad"], ("None with pictures and keypoints",))
    for option in () if pictures else ("cameras", "image_size", "stack_images"):
        if how[option] is not None and how[option] is not False:
            usual = "the default without observation_mode='pixel'"
            raise UnknownOption(option, how[option], (usual,))


@final
class Observer:
    """The observation and the info of one structure.

    Args:
        world: That is observed.
        declaration: The compiled structure.
        how: The options of the environment; see ``ScmWorldEnv``.
        largest: The structure whose bodies have places in the vector.
        ends: The least and the greatest number of each part of an action.

    Attributes:
        goals: Those of the structure, if it has some.
        names: The variables that the observation is made of.
        parts: The observed variables, by name, except goals.
        space: In which all observations lie.
        layout: Where each variable stands in the vector, and with ``history`` in each of its pairs.
        history: Empty, with which the last pairs are observed; None without ``history``.
        observe: Given the present values of one world or of several, the observation without its
            ``history``.
        appended: The parameters that the option ``context`` adds to the vector.
        needed: The variables that have to be computed.
        together: Whether several worlds can be observed in one call.
        outcomes: Columns of reward, end of the episode, success and fractional success; None of
            what there is not.
    """

    def __init__(
        self,
        world: Simulation,
        declaration: CompiledTask,
        how: Mapping[str, Any],
        largest: CompiledTask,
        ends: tuple[Floats, Floats],
    ) -> None:
        self.goals = GoalVectors(declaration) if declaration.task.goal.achieved else None
        if how["goal_env"]:
            _check_goals(declaration, self.goals)
        self._main: Vector | Pixels
        if how["observation_mode"] == "pixel":
            self._main = Pixels(
                world, how["cameras"], how["image_size"], stacked=how["stack_images"]
            )
        else:
            self._main = _vector(world, declaration, how, largest)
        self.parts: dict[str, Vector | Pixels] = {"observation": self._main}
        self.appended = self._main.appended if isinstance(self._main, Vector) else ()
        if context_of(how["context"])[0] == "privileged":
            about = _parts(world, largest, _context(largest, how), sensed=False)
            self.parts["context"] = Vector(world, declaration, about, how)
        self._shown = self.goals if how["goal_env"] else None
        self.observe: Callable[[Rows], Observation] = self._main.observe
        if len(self.parts) > 1 or self._shown is not None:
            self.observe = self._by_name
        spaces: dict[str, Any] = {name: part.space for name, part in self.parts.items()}
        self.layout, self.history = self._main.layout, None
        if steps := how["history"]:
            shown = self._main.space, self.layout
            self.history = History(*shown, ends, steps, stacked=bool(how["stack_history"]))
            spaces, self.layout = spaces | self.history.spaces, self.history.layout
        spaces |= {} if self._shown is None else self._shown.spaces
        self.space: gymnasium.Space[Any] = spaces["observation"]
        if len(spaces) > 1:
            self.space = gymnasium.spaces.Dict(spaces)
        where, terms = declaration.where, declaration.task.weights
        listed = (REWARD, TERMINATED, *terms, FRACTION, SUCCESS)
        columns = {name: where[name].start for name in listed if name in where}
        self._terms = [(name, columns[name]) for name in terms]
        self.outcomes = [columns.get(name) for name in (REWARD, TERMINATED, SUCCESS, FRACTION)]
        goals = () if self.goals is None else self.goals.names
        names = [name for part in self.parts.values() for name in part.names]
        self.names = (*names, *(() if self._shown is None else goals))
        self.needed = tuple(dict.fromkeys((*names, *goals, *columns)))
        self.together = all(part.together for part in self.parts.values())
        self._tells_failures = how["on_failure"] == "truncate"

    def _by_name(self, now: Rows) -> Observation:
        found = {name: part.observe(now) for name, part in self.parts.items()}
        return found if self._shown is None else found | self._shown.observe(now)

    def outcome(self, now: Rows) -> tuple[Any, Any, dict[str, Any]]:
        """Return the reward, whether the episode ends, and the info: of several worlds columns."""
        numbers = now.numbers
        info: dict[str, Any] = {}
        take: Callable[[Any], Any] = numbers.item if numbers.ndim == 1 else numbers.T.__getitem__
        reward, ended, success, fraction = self.outcomes
        if success is not None:
            info["is_success"] = info["success"] = take(success) != 0.0
        if fraction is not None:
            info["fractional_success"] = take(fraction)
        if self.goals is not None:
            info["achieved_goal"], info["desired_goal"] = self.goals.read(now)
        info["reward_terms"] = terms = {}
        for name, column in self._terms:  # quicker than a comprehension of one or two
            terms[name] = take(column)
        if self._tells_failures:
            info[FAILED] = False if numbers.ndim == 1 else np.zeros(len(numbers), bool)
        return take(reward), ended is not None and take(ended) != 0.0, info

    @property
    def info_shapes(self) -> dict[str, tuple[int, ...]]:
        """The shape of each entry of ``info``, without ``reward_terms``, which is a dictionary."""
        goals = {} if self.goals is None else self.goals.spaces
        _, _, success, fraction = self.outcomes
        flags = {"is_success": success, "success": success, "fractional_success": fraction}
        return {
            **{name: () for name, column in flags.items() if column is not None},
            **{name: space.shape or () for name, space in goals.items()},
            **({FAILED: ()} if self._tells_failures else {}),
        }


def _check_goals(declaration: CompiledTask, goals: GoalVectors | None) -> None:
    """Refuse goals that do not decide success and a part of the reward."""
    task, reward = declaration.task, declaration.model.declared("reward")
    allowed = ""
    if goals is None:
        allowed = f"{task.name} has no goals"
    elif getattr(task, "success", None) is not None:
        allowed = f"goals do not decide the success of this {task.name}"
    elif not isinstance(reward.equation, Linear):
        allowed = "the reward is not Linear in terms: Measured(mechanism=Linear(…))"
    if allowed:
        raise UnknownOption("goal_env", True, (f"False: {allowed}",))


def _context(declaration: CompiledTask, how: Mapping[str, Any]) -> list[str]:
    """List the parameters of a context: an intervention can set them."""
    model, (_, wanted) = declaration.model, context_of(how["context"])
    known = [name for name in declaration.static_names if model.declared(name).settable]
    for one in wanted if wanted != EVERY else ():
        if not any(fits(name, (one,)) for name in known):
            raise UnknownOption("context", one, (*CONTEXTS, *known))
    return [name for name in known if fits(name, wanted)]


def published(world: Simulation, declaration: CompiledTask) -> dict[str, Observed]:
    """Return the parts of the structured observation, by variable."""
    length = world.max_episode_length * world.options.control_period
    end = length if world.options.given_length is None else float(world.options.given_length)
    return {
        part.variable: replace(part, published=part.published or (0.0, end))
        for part in declaration.task.observation.rows
    }


def _names(world: Simulation, declaration: CompiledTask, how: Mapping[str, Any]) -> list[str]:
    mode = how["observation_mode"]
    names, more = (
        [
            name
            for one in as_names(how[option])
            for name in (fitting(one, declaration.model, option) if is_pattern(one) else (one,))
        ]
        for option in ("observe", "include")
    )
    if mode != "custom":
        names += published(world, declaration)
    if mode == "full":
        names += [name for name in declaration.model if name not in declaration.parts]
    return list(dict.fromkeys((*names, *more)))


def _vector(
    world: Simulation, declaration: CompiledTask, how: Mapping[str, Any], largest: CompiledTask
) -> Vector:
    names = _names(world, largest, how)
    for name in {*_names(world, declaration, how)} - {*names}:
        message = f"{name!r} has no place in the observation: pad={how['pad']} is too small"
        raise InterventionError(message, variable=name)
    parts, view = _parts(world, largest, names), None
    if how["keypoints"]:
        view = declaration.task.observation.view
        if not declaration.task.goal.tools or view is None:
            allowed = ("False: the task has no blocks, or no boxes",)
            raise UnknownOption("keypoints", how["keypoints"], allowed)
        reach = np.full(view[1], 4.0)  # [m], [rad]
        parts.append(ObservedPart(KEYPOINTS, -reach, reach))
    if context_of(how["context"])[0] == "observation":
        rest = [name for name in _context(largest, how) if name not in names]
        parts += _parts(world, largest, rest, sensed=False)
    return Vector(world, declaration, parts, how, view)


def _parts(
    world: Simulation, declaration: CompiledTask, names: Iterable[str], *, sensed: bool = True
) -> list[ObservedPart]:
    """Return variables with the bounds of the structured observation, or those they declare.

    States of a model scale by the bounds they declare, and do not saturate: joint limits are soft.
    """
    known = published(world, declaration)
    soft = frozenset[str]()
    if not declaration.task.observation.saturates:
        soft = frozenset(declaration.slices)
    parts = []
    for name in names:
        low, high = bounds(declaration.model, name)
        observed, shape = known.get(name), declaration.model.declared(name).shape
        saturates = name not in soft or (observed is not None and observed.low is not None)
        if observed is not None and world.options.conventions.published:
            low, high = (spread(side, shape) for side in observed.published or ())
        elif observed and observed.low is not None and observed.high is not None:
            low, high = spread(observed.low, shape), spread(observed.high, shape)
        parts.append(ObservedPart(name, low, high, sensed, saturates))
    return parts
