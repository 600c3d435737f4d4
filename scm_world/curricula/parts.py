"""What is done in an episode: fixed interventions, draws, goals, interpolation, functions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any
from weakref import WeakKeyDictionary

import numpy as np
from pydantic import BeforeValidator, PlainSerializer, ValidationInfo
from scipy.spatial.transform import Rotation, Slerp

from scm_world._types import Value
from scm_world.curricula.base import (
    STREAM,
    Acts,
    Count,
    Index,
    Part,
    Rule,
    Situation,
    Words,
    kind,
)
from scm_world.curricula.targets import regions
from scm_world.errors import UnknownOption, UnknownVariable, blamed
from scm_world.graph import NoiseKey, flatten
from scm_world.queries.plans import Plan
from scm_world.variables import (
    Distribution,
    Draw,
    Function,
    Intervention,
    Rotations,
    Subset,
)
from scm_world.variables.kinds import SPACES, SpaceName
from scm_world.variables.spaces import Frozen, refuse_infinite
from scm_world.world.compiled_task import CompiledTask, beginning

# --- the same in every episode --------------------------------------------------------------------


def _request(given: Any) -> Any:
    """Return interventions by dotted name; those of a file stay plain data."""
    listed = {}
    if isinstance(given, dict):
        listed = {
            n: acts if isinstance(acts, list | tuple) else [acts] for n, acts in given.items()
        }
    acts = [act for acts in listed.values() for act in acts]
    is_data = acts and all(isinstance(a, dict) and isinstance(a.get("kind"), str) for a in acts)
    return listed if is_data else dict(Plan(given))


def _written(request: Mapping[str, tuple[Any, ...]]) -> dict[str, Any]:
    """Return interventions as plain data, in a list where a variable has several."""
    found = {name: [act.model_dump(mode="json") for act in acts] for name, acts in request.items()}
    return {name: acts if len(acts) != 1 else acts[0] for name, acts in found.items()}


Request = Annotated[
    dict[str, tuple[Intervention, ...]],
    BeforeValidator(_request),
    PlainSerializer(_written, return_type=dict),
]


@kind("do")
def do(request: Request) -> Rule:
    """Do the same in every episode.

    Args:
        request: Interventions by variable, each of which may have a time; or a plan.
    """

    def acts(situation: Situation) -> Acts:
        stream = f"{STREAM}/{situation.key}"
        return {name: tuple(_own(act, stream) for act in acts) for name, acts in request.items()}

    return acts


def _own(act: Any, stream: str) -> Any:
    """Return an intervention whose draws have a noise stream of their own."""
    if not isinstance(act, Draw) or act.stream:
        return act
    return act.model_copy(update={"stream": stream})


# --- draws ----------------------------------------------------------------------------------------


def _source(given: Any, info: ValidationInfo) -> Any:
    """Refuse what is neither a space nor a distribution, and boxes without ends."""
    option = str(info.field_name)
    if not (isinstance(given, Frozen | dict) or (isinstance(given, str) and given in SPACES)):
        raise UnknownOption(option, given, (*SPACES, "a Subset", "a distribution"))
    refuse_infinite(option, given)
    return given


Source = Annotated[SpaceName | Subset | Distribution, BeforeValidator(_source)]


@kind("resample")
def resample(
    what: Words, space: Source = "A", besides: Words = (), exclusive: bool = False
) -> Rule:
    """Draw variables again.

    Args:
        what: Names, patterns with ``*``, or groups such as ``"@looks"``; one or several.
        space: ``"A"``, ``"B"``, ``"A|B"``, a distribution such as a ``Box``, or a ``Subset``,
            which may have another region for each variable.
        besides: Names and patterns of the variables that keep their values.
        exclusive: Whether a fair coin decides if sizes or positions of blocks are drawn, as in the
            predecessor, instead of both.

    Raises:
        UnknownOption: A name is not text, or there is no such space.

    Example:
        >>> resample(["*.mass", "floor_friction"], "B").space
        'B'
    """
    if not what:
        raise UnknownOption("what", what, ("a name or a pattern", "several of them"))

    def acts(situation: Situation) -> Acts:
        kept = _DRAWS.setdefault(situation.compiled, {})
        word = (situation.key, situation.first is None)
        if word not in kept:
            found = regions(situation.compiled, what, space, besides, situation.first)
            stream = f"{STREAM}/{situation.key}"
            kept[word] = Plan.of({n: (Draw(one, stream=stream),) for n, one in found.items()})
        if not exclusive:
            return kept[word]
        without = SIZES if situation.uniform(situation.key) < 0.5 else POSITIONS
        return {name: acts for name, acts in kept[word].items() if not name.endswith(without)}

    return acts


SIZES = (".size", "block_size", "_dims")
POSITIONS = (".cylindrical_position",)
_DRAWS: WeakKeyDictionary[CompiledTask, dict[tuple[str, bool], Plan]] = WeakKeyDictionary()
"""The draws of each part, by its key, in a structure; without and with ``Situation.first``."""


def poses(space: Any = "A") -> Part:
    """Draw positions and orientations of the blocks."""
    return resample("@poses", space)


def physics(space: Any = "A") -> Part:
    """Draw masses, frictions, gravity and all else that changes how bodies move."""
    return resample("@physics", space)


def looks(space: Any = "A") -> Part:
    """Draw colors, lights and cameras."""
    return resample("@looks", space)


def joints(space: Any = "A") -> Part:
    """Draw the positions of the joints."""
    return resample("@joints", space)


def everything(space: Any = "A", *, besides: Any = ()) -> Part:
    """Draw every variable that has the space, except the settings of the engine."""
    return resample("@everything", space, besides=besides)


def _space(given: Any) -> Any:
    if not (isinstance(given, str) and given in SPACES):
        raise UnknownOption("space", given, SPACES)
    return given


@kind("goal")
def goals(space: Annotated[SpaceName, BeforeValidator(_space)] = "A", besides: Words = ()) -> Rule:
    """Draw a new goal, as the task draws goals.

    Args:
        space: ``"A"``, ``"B"`` or ``"A|B"``.
        besides: Names of the goal's causes that keep their values.

    Raises:
        UnknownOption: There is no such space.
    """

    def acts(situation: Situation) -> Acts:
        task = situation.compiled.task
        drawn = task.sample_goal(space)
        if not drawn:
            allowed = (f"a task with goals; draw variables of {task.name} by resample",)
            raise UnknownOption("task for goals", task.name, allowed)
        for name in besides:
            if name not in drawn:
                raise UnknownVariable(name, drawn)
        stream = f"{STREAM}/{situation.key}"
        return {name: _own(act, stream) for name, act in drawn.items() if name not in besides}

    return acts


# --- from episode to episode ----------------------------------------------------------------------


def _numbers(given: Any, info: ValidationInfo) -> dict[str, Any]:
    flat = flatten({} if given is None else given)
    try:
        return {
            name: tuple(map(float, np.ravel(value))) if np.ndim(value) else float(value)
            for name, value in flat.items()
        }
    except (TypeError, ValueError):
        allowed = ("numbers and arrays of numbers, by variable",)
        raise UnknownOption(f"{info.field_name} of an interpolation", given, allowed) from None


Setting = Annotated[dict[str, float | tuple[float, ...]], BeforeValidator(_numbers)]


@kind("interpolate")
def interpolate(
    stop: Setting,
    start: Setting = {},  # noqa: B006 # pydantic copies it
    *,
    episodes: Count,
    first: Index = 0,
) -> Rule:
    """Go from one setting to another, in equal steps from episode to episode.

    Whole numbers are rounded, categories change in the middle, and a quaternion turns about one
    axis, the shorter way round.

    Args:
        stop: The values at the end, by variable.
        start: The values at the beginning; by default those of an episode without interventions.
        episodes: Number of episodes from the beginning to the end.
        first: The episode in which it begins.

    Raises:
        UnknownOption: A variable begins and does not end, a value is not a number, or ``episodes``
            or ``first`` is not a whole number.

    Example:
        >>> interpolate({"block.size": [0.09, 0.09, 0.09]}, episodes=1_000).episodes
        1000
    """
    for name in start.keys() - stop.keys():
        raise UnknownOption("start", name, stop)

    def acts(situation: Situation) -> Acts:
        share = min(max((situation.episode - first) / episodes, 0.0), 1.0)
        names = [n for n in stop if situation.first is None or n in situation.first]
        return {
            name: _between(situation, name, start.get(name), stop[name], share) for name in names
        }

    return acts


def _between(situation: Situation, name: str, start: Any, stop: Any, share: float) -> Value:
    variable = situation.model.declared(name)
    for given in (stop, start):
        if given is not None and np.size(given) != np.prod(variable.shape):
            situation.model.accept(name, given)  # refuses it
    other = variable.array(stop)
    one = _natural(situation, name) if start is None else variable.array(start)
    if isinstance(variable.bounds, Rotations):
        turn = Slerp([0.0, 1.0], Rotation.from_quat([one, other]))(share)
        return np.asarray(variable.bounds.nearest(turn.as_quat()))
    if variable.dtype == "categorical":
        return one if share < 0.5 else other
    between = (1.0 - share) * one + share * other
    return np.asarray(np.rint(between).astype(np.int64) if variable.dtype != "real" else between)


def _natural(situation: Situation, name: str) -> Value:
    """Return the value of a variable at the beginning, without interventions."""
    compiled = situation.compiled
    if name not in compiled.slices and name not in compiled.static_names:
        allowed = (f"a value for {name!r}, which is computed from others",)
        raise UnknownOption("start of an interpolation", None, allowed)
    return np.array(
        beginning(compiled, NoiseKey(situation.noise, situation.number, origin=0))[name]
    )


def _function(given: Any) -> Any:
    if isinstance(given, Function) or (isinstance(given, dict) and given.get("kind") == "function"):
        return given
    if callable(given) or isinstance(given, str):
        return Function(given)
    allowed = ("a function of the situation", "its name: 'module:name'")
    raise UnknownOption("function of a curriculum", given, allowed)


@kind("follow")
def follow(function: Annotated[Function, BeforeValidator(_function)]) -> Rule:
    """Follow the plan that a function of the episode returns.

    Args:
        function: Takes the ``Situation``, and returns interventions by name, which may have times,
            or None. Random numbers come from ``situation.generator(key)``. Where bodies come and
            go it is called twice: first for the variables that decide that, then for all.

    Raises:
        UnknownOption: It is not a function.
    """

    def acts(situation: Situation) -> Acts:
        with blamed(f"the function {function.reference!r} of a curriculum"):
            given = function.bind()(situation)
        if not isinstance(given, Mapping | None):
            raise UnknownOption("intervention of a function", given, ("values by name", "None"))
        return given or {}

    return acts
