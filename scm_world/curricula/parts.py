"""The kinds of parts: what is done in an episode, when, and which of several parts act.

Source:
    CausalWorld 1.2, ``intervention_actors``, for ``published_actor``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any
from weakref import WeakKeyDictionary

import numpy as np
from pydantic import BeforeValidator, PlainSerializer, ValidationInfo
from scipy.spatial.transform import Rotation, Slerp

from scm_world._arguments import one_of, real_number
from scm_world._types import Value
from scm_world.curricula.base import (
    STREAM,
    Acts,
    AnyPart,
    Count,
    Index,
    Part,
    Progress,
    Rule,
    Situation,
    Words,
    as_part,
    kind,
)
from scm_world.curricula.targets import regions
from scm_world.errors import UnknownOption, UnknownVariable, blamed
from scm_world.graph import SCM, NoiseKey, flatten
from scm_world.queries.plans import Plan, targets
from scm_world.variables import (
    Distribution,
    Draw,
    Function,
    Intervention,
    Rotations,
    Subset,
    Time,
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


# --- when -----------------------------------------------------------------------------------------

RESET = Time(at=0)


@kind("timed")
def _timed(time: Time, part: AnyPart) -> Rule:
    def acts(situation: Situation) -> Acts:
        plan = part.plan(replace(situation, step=time.start or 0))
        return {
            name: tuple(act if act.time else act.model_copy(update={"time": time}) for act in acts)
            for name, acts in plan.items()
        }

    return acts


def at_reset(part: Any) -> Part:
    """Act at the beginning of every episode; so does what has no time of its own.

    Example:
        >>> at_reset({"floor_friction": 0.4}).time
        Time(at=0)
    """
    return _timed(RESET, part)


def at_step(step: int, part: Any) -> Part:
    """Act after a number of control steps of every episode; 0 is the reset."""
    return _timed(Time(at=step), part)


def every(steps: int, part: Any, *, first: int = 0) -> Part:
    """Act again and again within every episode.

    Args:
        steps: Control steps from one time to the next.
        part: A part, or an intervention.
        first: The first control step at which it acts; 0 is the reset.
    """
    return _timed(Time(every=steps, at=first), part)


def when(event: Any, part: Any) -> Part:
    """Act at the first control step of every episode at which an event occurs.

    Args:
        event: ``Contact(first, second)`` or ``Reaches(name, above=…)``.
        part: A part, or an intervention.
    """
    return _timed(Time(when=event), part)


@kind("during")
def _during(part: AnyPart, first: Index = 0, stop: Count | None = None, period: Count = 1) -> Rule:
    if stop is not None and stop <= first:
        raise UnknownOption("stop", stop, (f"any whole number from {first + 1} on",))

    def acts(situation: Situation) -> Acts:
        episode = situation.episode
        is_within = first <= episode and (stop is None or episode < stop)
        return part.plan(situation) if is_within and (episode - first) % period == 0 else {}

    return acts


def during(episodes: range, part: Any) -> Part:
    """Act in some episodes only, which count from 0.

    Args:
        episodes: ``range(first, stop)`` or ``range(first, stop, period)``.
        part: A part, or an intervention.

    Raises:
        UnknownOption: It is not a range of whole numbers from 0 on, or an empty one.

    Example:
        >>> during(range(10, 20, 5), {"floor_friction": 0.4}).period
        5
    """
    usable = isinstance(episodes, range) and episodes.step > 0 <= episodes.start
    if not (usable and len(episodes)):
        allowed = ("a range such as range(1_000, 5_000)", "range(first, stop, period)")
        raise UnknownOption("episodes", episodes, allowed)
    return _during(part, episodes.start, episodes.stop, episodes.step)


# --- which ----------------------------------------------------------------------------------------


@kind("together")
def together(*of: Part) -> Rule:
    """Do several parts; of two on one quantity at one time the later one counts.

    Raises:
        UnknownOption: There is no part.

    Example:
        >>> both = together({"floor_friction": 0.4}, {"tool_block.mass": 0.03})
        >>> [list(part.request) for part in both.of]
        [['floor_friction'], ['tool_block.mass']]
    """

    def acts(situation: Situation) -> Acts:
        found: Acts = {}
        for part in of:
            found = over(situation.model, found, part.plan(situation))
        return found

    return acts


def over(model: SCM, below: Acts, plan: Acts) -> Acts:
    """Return interventions with a plan over them: at its times it alone sets its quantities."""
    if not below:
        return plan
    mine: dict[Time, set[str]] = {}
    for name, acts in plan.items():
        for act in acts:
            mine.setdefault(act.time or RESET, set()).update(targets(model, name))
    found: dict[str, Any] = {}
    for name, acts in below.items():
        its = set(targets(model, name))
        found[name] = tuple(act for act in acts if not its <= mine.get(act.time or RESET, set()))
    found |= {name: (*found.get(name, ()), *acts) for name, acts in plan.items()}
    return {name: acts for name, acts in found.items() if acts}


@kind("in_turn")
def in_turn(*of: Part, each: Count = 1) -> Rule:
    """Do one part after another, and again from the first one.

    Args:
        of: Parts, or interventions.
        each: How many episodes each of them lasts.

    Raises:
        UnknownOption: There is no part, or ``each`` is not a positive whole number.

    Example:
        >>> in_turn({"gravity": [0.0, 0.0, -9.8]}, {}, each=10).each
        10
    """
    return lambda situation: of[situation.episode // each % len(of)].plan(situation)


@kind("weighted")
def _weighted(*of: Part, weights: tuple[float, ...]) -> Rule:
    if len(weights) != len(of) or min(weights) <= 0.0:
        raise UnknownOption("weights", weights, ("a positive number for each part",))

    def acts(situation: Situation) -> Acts:
        ends = np.cumsum(weights)
        drawn = replace(situation, step=0).uniform(situation.key) * ends[-1]
        place = int(np.searchsorted(ends, drawn, side="right"))
        return of[min(place, len(of) - 1)].plan(situation)  # a product may round up

    return acts


def weighted(*pairs: Any) -> Part:
    """Do one of several parts, drawn in each episode.

    Args:
        pairs: A weight and a part each; probabilities are in proportion to the weights.

    Raises:
        UnknownOption: There is no pair, or a weight is not a positive number.

    Example:
        >>> weighted((3.0, {"floor_friction": 0.4}), (1.0, {})).weights
        (3.0, 1.0)
    """
    for pair in pairs:
        if not isinstance(pair, tuple | list) or len(pair) != 2:
            raise UnknownOption("weighted", pair, ("pairs of a weight and a part",))
    weights = [real_number("weight", weight) for weight, _ in pairs]
    return _weighted(*(part for _, part in pairs), weights=weights)


@kind("stages")
def stages(*of: Part, up: float = 0.8, down: float | None = None, window: Count = 100) -> Rule:
    """Do the first part, and the next one once the learner succeeds.

    Args:
        of: Parts, or interventions, from the first stage on.
        up: Share of successes from which the next stage begins, in (0, 1].
        down: Share of successes down from which the stage before comes back; never if None.
        window: How many episodes of a stage count.

    Raises:
        UnknownOption: There is no part, a share is out of range, or ``down`` is not below ``up``.

    Example:
        >>> stages({}, {"tool_block.mass": 0.08}, up=0.9, window=50).window
        50
    """
    if not 0.0 < up <= 1.0:
        raise UnknownOption("up", up, ("a share above 0 and up to 1",))
    if down is not None and not 0.0 <= down < up:
        raise UnknownOption("down", down, (f"a share from 0 up to less than {up:g}", "None"))

    def acts(situation: Situation) -> Acts:
        situation.staged.add(situation.key)
        level = situation.memory.stages.get(situation.key, Progress()).level
        return of[level].plan(situation)

    return acts


def progressed(part: Any, before: Progress, *, success: bool) -> Progress:
    """Return the progress in stages after one more episode."""
    recent = (*before.recent, success)[-part.window :]
    share, step = sum(recent) / part.window, 0
    if len(recent) == part.window:
        is_down = part.down is not None and share <= part.down
        step = 1 if share >= part.up else -1 if is_down else 0
    level = min(max(before.level + step, 0), len(part.of) - 1)
    return Progress(level, recent if level == before.level else ())


# --- the predecessor's actors ---------------------------------------------------------------------

PROPERTIES = {
    "floor": "floor_friction",
    "robot": "robot_finger_*.mass",
    "stage": "stage_friction",
    "tool": "tool_*.mass",
}
"""The variables of each group of physical properties."""


def published_actor(
    name: str,
    *,
    space: SpaceName = "A|B",
    group: str = "tool",
    positions: bool = True,
    orientations: bool = True,
) -> Part:
    """Return the part that does what an actor of the predecessor does.

    Args:
        name: Its name in files of the predecessor. ``random_actor`` draws everything, and a coin
            decides whether sizes or positions are drawn; ``joints_actor`` draws the joints from
            their space (there from anywhere, so that most draws were refused).
        space: The active space; ``"A|B"`` is the default there.
        group: The physical properties: ``"robot"``, ``"stage"``, ``"floor"`` or ``"tool"``.
        positions: Whether the pose actor draws positions.
        orientations: Whether it draws orientations.

    Raises:
        UnknownOption: There is no such actor, group or space.

    Example:
        >>> published_actor("visual_actor", space="A").what
        ('*color',)
    """
    one_of("group", group, PROPERTIES)
    chosen = (positions, "cylindrical_position"), (orientations, "euler_orientation")
    pose = [f"tool_*.{quantity}" for is_drawn, quantity in chosen if is_drawn]
    actors = {
        "base_actor": as_part({}),
        "goal_actor": goals(space),
        "joints_actor": joints(space),
        "physical_properties_actor": resample(PROPERTIES[group], space),
        "random_actor": resample("@published", space, exclusive=True),
        "rigid_pose_actor": resample(pose, space) if pose else as_part({}),
        "visual_actor": resample("*color", space),
    }
    one_of("actor", name, actors)
    return actors[name]
