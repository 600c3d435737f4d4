"""Parts of curricula: interventions of an episode, their times, and which of several parts act.

A part is a value, made by the functions of this module; each refuses wrong arguments with
``UnknownOption`` or ``ModelError`` where it is made. An intervention, a plan, or a function of the
``Situation`` may stand for a part.

Source:
    CausalWorld 1.2, ``intervention_actors``, for ``published_actor``.
"""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial, wraps
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, TypeVar, final
from weakref import WeakKeyDictionary

import numpy as np
from pydantic import (
    BeforeValidator,
    Field,
    NonNegativeInt,
    PlainSerializer,
    PlainValidator,
    PositiveInt,
    ValidationInfo,
    create_model,
    model_validator,
)
from scipy.spatial.transform import Rotation, Slerp

from scm_world._arguments import one_of, real_number
from scm_world._types import Floats, Value
from scm_world.curricula.targets import regions
from scm_world.errors import ModelError, UnknownOption, UnknownVariable, blamed
from scm_world.graph import SCM, NoiseKey, flatten
from scm_world.queries.plans import Plan, targets
from scm_world.variables import (
    SOFT,
    Distribution,
    Draw,
    Function,
    Hard,
    Intervention,
    Noise,
    Rotations,
    Subset,
    Time,
)
from scm_world.variables.kinds import SPACES, SpaceName
from scm_world.variables.spaces import Frozen, refuse_infinite
from scm_world.world.compiled_task import CompiledTask, beginning

STREAM = "curriculum"
"""First word of the noise streams of curricula."""


class Progress(NamedTuple):
    """How far the learner has come in a part with stages.

    Attributes:
        level: The present stage.
        recent: Whether the last episodes of this stage were successes.
    """

    level: NonNegativeInt = 0
    recent: tuple[bool, ...] = ()


@final
@dataclass(frozen=True)
class Situation:
    """The episode that begins, as a curriculum sees it.

    Attributes:
        episode: Number of the episode within the curriculum, from 0.
        stages: Progress in each part with stages, by its key.
        compiled: The structure of the episode.
        noise: The noise of the episode.
        number: Number of the episode within that noise.
        step: The control step of the part that is asked; 0 is the reset.
        first: The variables that decide which bodies exist, where only these are asked for: the
            plan for them comes first, and the rest is asked for the bodies that follow; else None.
        key: The key of the part that is asked.
        staged: The keys of the parts with stages that were asked.
    """

    episode: int
    stages: Mapping[str, Progress]
    compiled: CompiledTask
    noise: Noise
    number: int
    step: int = 0
    first: frozenset[str] | None = None
    key: str = ""
    staged: set[str] = field(default_factory=set)

    @property
    def model(self) -> SCM:
        """The variables of the episode."""
        return self.compiled.model

    def named(self, request: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return a request in which variables take the place of the patterns that they fit."""
        if self.first is None:
            return self.model.named(request)
        return self.model.named(request, [], among=[n for n in self.model if n in self.first])

    def uniform(self, key: str) -> float:
        """Return a random number in [0, 1): one for each name of a stream and control step."""
        return float(self._uniforms(key, 1)[0])

    def generator(self, key: str) -> np.random.Generator:
        """Return a generator of random numbers; see ``uniform``."""
        words = self._uniforms(f"{key}/generator", 2) * 2.0**53
        return np.random.default_rng([int(word) for word in words])

    def _uniforms(self, key: str, n: int) -> Floats:
        where: Any = {"episode": self.number, "step": self.step}
        drawn: Floats = self.noise.uniforms(f"{STREAM}/{key}", n=n, **where)[0]
        return drawn


# --- what a part is -------------------------------------------------------------------------------

Acts = Mapping[str, Any]
"""Interventions, as ``Plan`` takes them."""
Rule = Callable[[Situation], Acts]
"""A function of the episode that returns its interventions."""


class Part(Frozen):
    """A rule with its arguments: immutable, hashable and JSON-serialisable.

    Attributes:
        kind: Its name in a file.
    """

    KINDS: ClassVar[dict[str, type[Part]]] = {}
    RULE: ClassVar[Callable[..., Rule]]

    kind: str

    @model_validator(mode="after")
    def _has_rule(self) -> Part:
        self._rule()  # it checks the arguments
        return self

    def _rule(self) -> Rule:
        fields = {name: getattr(self, name) for name in type(self).model_fields if name != "kind"}
        return self.RULE(*fields.pop("of", ()), **fields)

    def plan(self, situation: Situation) -> Plan:
        """Return the interventions of an episode, by the names of its variables."""
        plan = Plan(self._rule()(replace(situation, key=self.key)))
        return Plan.of(dict(situation.named(plan)))

    @cached_property
    def key(self) -> str:
        """A hash of the content: two parts with one key have the same noise."""
        text = f"{self.kind}/{self.model_dump_json()}"
        return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()

    def __hash__(self) -> int:
        return hash(self.key)


def kind(name: str) -> Callable[[Callable[..., Rule]], Callable[..., Part]]:
    """Return a decorator: what a function of this kind returns is a part, with a name in files.

    The function returns a rule. Its arguments are the fields of the part, checked and written as
    their annotations say; several parts are ``*of``.
    """

    def decorate(function: Callable[..., Rule]) -> Callable[..., Part]:
        signature = inspect.signature(function, eval_str=True)
        fields: dict[str, Any] = {"kind": (Literal[name], name)}
        for one in signature.parameters.values():
            default = ... if one.default is one.empty else one.default
            fields[one.name] = OF if one.name == "of" else (one.annotation, default)
        made: Any = create_model(name, __base__=Part, __module__=function.__module__, **fields)
        made.__qualname__ = f"{function.__name__}.part"  # where pickle finds it
        made.RULE = staticmethod(function)
        Part.KINDS[name] = made

        @wraps(function)
        def make(*given: Any, **named: Any) -> Part:
            found: Part = made(**signature.bind_partial(*given).arguments, **named)
            return found

        vars(make)["part"] = made
        return make

    return decorate


Kind = TypeVar("Kind", bound=Frozen)


def nested(value: Any, kind: type[Kind]) -> Iterator[Kind]:
    """List the values of a kind in a declaration: itself, then those in its fields."""
    inner: Iterable[Any] = ()
    if isinstance(value, Frozen):
        inner = (getattr(value, name) for name in type(value).model_fields)
    elif isinstance(value, Mapping):
        inner = value.values()
    elif isinstance(value, tuple):
        inner = value
    if isinstance(value, kind):
        yield value
    for one in inner:
        yield from nested(one, kind)


def as_part(given: Any) -> Part:
    """Return a part: itself, from plain data, of a function, or of a fixed intervention."""
    if isinstance(given, Part):
        return given
    fields: Any = given
    if callable(given):
        fields = {"kind": "follow", "function": given}
    elif not isinstance(given, Mapping):
        raise UnknownOption("part of a curriculum", given, ("a part, such as resample('*.mass')",))
    elif not isinstance(given.get("kind"), str):
        fields = {"kind": "do", "request": given}
    one_of("part of a curriculum", fields["kind"], Part.KINDS)
    try:
        return Part.KINDS[fields["kind"]](**fields)
    except TypeError as error:  # of an intervention in a file that lacks its value
        raise ModelError([f"{fields['kind']}: {error}"]) from None


def words(option: str, given: Any) -> tuple[str, ...]:
    """Return names and patterns as a tuple; one may be given by itself."""
    names = tuple(given) if isinstance(given, Iterable) and not isinstance(given, str) else (given,)
    if not all(isinstance(name, str) for name in names):
        raise UnknownOption(option, given, ("a name or a pattern", "several of them"))
    return names


def _words(given: Any, info: ValidationInfo) -> tuple[str, ...]:
    return words(str(info.field_name), given)


AnyPart = Annotated[
    Part,
    PlainValidator(as_part),
    PlainSerializer(lambda part: part.model_dump(mode="json"), return_type=dict),
]
"""A part; its ``kind`` says which."""
OF = Annotated[tuple[AnyPart, ...], Field(min_length=1)], Field((), validate_default=True)
Words = Annotated[tuple[str, ...], BeforeValidator(_words)]
"""Names and patterns; one may be given by itself."""

# --- interventions --------------------------------------------------------------------------------


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
    """Return interventions as plain data, in a list where a variable has several.

    A draw always has its stream there: the noise of a part is a function of this text.
    """
    found = {name: [act.model_dump(mode="json") for act in acts] for name, acts in request.items()}
    for act in (act for acts in found.values() for act in acts if act["kind"] == "draw"):
        act.setdefault("stream", None)
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
        return {name: tuple(_own(act, situation) for act in acts) for name, acts in request.items()}

    return acts


def _own(act: Any, situation: Situation) -> Any:
    """Return an intervention whose draws have a noise stream of their own."""
    if isinstance(act, SOFT) and isinstance(act.by, Draw):
        return act.model_copy(update={"by": _own(act.by, situation)})
    if not isinstance(act, Draw) or act.stream:
        return act
    return act.model_copy(update={"stream": f"{STREAM}/{situation.key}"})


def _source(given: Any, info: ValidationInfo) -> Any:
    """Refuse values that are neither a space nor a distribution, and boxes without ends."""
    option = str(info.field_name)
    if not (isinstance(given, Frozen | dict) or (isinstance(given, str) and given in SPACES)):
        raise UnknownOption(option, given, (*SPACES, "a Subset", "a distribution"))
    refuse_infinite(option, given)
    return given


Source = Annotated[SpaceName | Subset | Distribution, BeforeValidator(_source)]

SIZES = (".size", "block_size", "_dims")
POSITIONS = (".cylindrical_position",)
_DRAWS: WeakKeyDictionary[CompiledTask, dict[tuple[str, bool], Plan]] = WeakKeyDictionary()
"""The draws of each part, by its key, in a structure; without and with ``Situation.first``."""


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
            kept[word] = Plan.of({n: (_own(Draw(one), situation),) for n, one in found.items()})
        if not exclusive:
            return kept[word]
        without = SIZES if situation.uniform(situation.key) < 0.5 else POSITIONS
        return {name: acts for name, acts in kept[word].items() if not name.endswith(without)}

    return acts


poses = partial(resample, "@poses")
"""Draw positions and orientations of the blocks; further arguments as of ``resample``."""
physics = partial(resample, "@physics")
"""Draw masses, frictions, gravity and all else that changes how bodies move."""
looks = partial(resample, "@looks")
"""Draw colors, lights and cameras."""
joints = partial(resample, "@joints")
"""Draw the positions of the joints."""
everything = partial(resample, "@everything")
"""Draw every variable that has the space, except the settings of the engine."""


@kind("goal")
def goals(space: SpaceName = "A", besides: Words = ()) -> Rule:
    """Draw a new goal, as the task draws goals.

    Args:
        space: ``"A"``, ``"B"`` or ``"A|B"``.
        besides: Names of the goal's causes that keep their values.
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
        return {n: _own(act, situation) for n, act in drawn.items() if n not in besides}

    return acts


def _setting(given: Any) -> dict[str, Any]:
    flat = {} if given is None else flatten(given)
    return {name: np.ravel(v).tolist() if np.ndim(v) else v for name, v in flat.items()}


Setting = Annotated[dict[str, float | tuple[float, ...]], BeforeValidator(_setting)]


@kind("interpolate")
def interpolate(
    stop: Setting,
    start: Setting = {},  # noqa: B006 # pydantic copies it
    *,
    episodes: PositiveInt,
    first: NonNegativeInt = 0,
) -> Rule:
    """Interpolate from one setting to another, in equal steps from episode to episode.

    Whole numbers are rounded, categories change in the middle, and a quaternion turns about one
    axis, the shorter way round.

    Args:
        stop: The values at the end, by variable.
        start: The values at the beginning; by default those of an episode without interventions.
        episodes: Number of episodes from the beginning to the end.
        first: The episode in which it begins.

    Example:
        >>> interpolate({"block.size": [0.09, 0.09, 0.09]}, episodes=1_000).episodes
        1000
    """
    for name in start.keys() - stop.keys():
        raise UnknownOption("start", name, stop)

    def acts(situation: Situation) -> Acts:
        share = min(max((situation.episode - first) / episodes, 0.0), 1.0)
        begin, end = situation.named(start), situation.named(stop)
        names = [n for n in end if situation.first is None or n in situation.first]
        return {
            name: _between(situation, name, begin.get(name), end[name], share) for name in names
        }

    return acts


def _between(situation: Situation, name: str, start: Any, stop: Any, share: float) -> Value:
    model, compiled = situation.model, situation.compiled
    variable = model.declared(name)

    def checked(given: Any) -> Value:
        act: Any = model.accept(name, Hard(given if variable.shape else float(np.squeeze(given))))
        return np.asarray(act.value)

    other = checked(stop)
    if start is not None:
        one = checked(start)
    elif name in compiled.slices or name in compiled.static_names:
        key = NoiseKey(situation.noise, situation.number, origin=0)
        one = np.array(beginning(compiled, key)[name])
    else:
        allowed = (f"a value for {name!r}, which is computed from others",)
        raise UnknownOption("start of an interpolation", None, allowed)
    if isinstance(variable.bounds, Rotations):
        turn = Slerp([0.0, 1.0], Rotation.from_quat([one, other]))(share)
        return np.asarray(variable.bounds.nearest(turn.as_quat()))
    if variable.dtype == "categorical":
        return one if share < 0.5 else other
    between = (1.0 - share) * one + share * other
    return np.asarray(np.rint(between).astype(np.int64) if variable.dtype != "real" else between)


def _function(given: Any) -> Any:
    is_new = callable(given) and not isinstance(given, Function)
    return Function(given) if is_new else given


@kind("follow")
def follow(function: Annotated[Function, BeforeValidator(_function)]) -> Rule:
    """Follow the plan that a function of the episode returns.

    Args:
        function: Takes the ``Situation``, and returns interventions by name, which may have times,
            or None. Random numbers come from ``situation.generator(key)``. Where bodies come and
            go it is called twice: first for the variables that decide that, then for all.
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
    """Act at the beginning of every episode; so does a part without a time of its own."""
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
def _during(
    part: AnyPart,
    first: NonNegativeInt = 0,
    stop: PositiveInt | None = None,
    period: PositiveInt = 1,
) -> Rule:
    if stop is not None and stop <= first:
        raise UnknownOption("stop", stop, (f"any whole number from {first + 1} on",))

    def acts(situation: Situation) -> Acts:
        late = situation.episode - first
        is_within = late >= 0 and (stop is None or situation.episode < stop)
        return part.plan(situation) if is_within and late % period == 0 else {}

    return acts


def during(episodes: range, part: Any) -> Part:
    """Act in some episodes only, which count from 0.

    Args:
        episodes: ``range(first, stop)`` or ``range(first, stop, period)``.
        part: A part, or an intervention.
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
def in_turn(*of: Part, each: PositiveInt = 1) -> Rule:
    """Do one part after another, ``each`` for so many episodes, and again from the first one."""
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

    Example:
        >>> weighted((3.0, {"floor_friction": 0.4}), (1.0, {})).weights
        (3.0, 1.0)
    """
    if not all(isinstance(pair, tuple | list) and len(pair) == 2 for pair in pairs):
        raise UnknownOption("weighted", pairs, ("pairs of a weight and a part",))
    weights = [real_number("weight", weight) for weight, _ in pairs]
    return _weighted(*(part for _, part in pairs), weights=weights)


@kind("stages")
def stages(
    *of: Part,
    up: Annotated[float, Field(gt=0.0, le=1.0)] = 0.8,
    down: Annotated[float, Field(ge=0.0)] | None = None,
    window: PositiveInt = 100,
) -> Rule:
    """Do the first part, and the next one once the learner succeeds.

    Args:
        of: Parts, or interventions, from the first stage on.
        up: Share of successes from which the next stage begins, in (0, 1].
        down: Share of successes down from which the stage before comes back; never if None.
        window: How many episodes of a stage count.

    Example:
        >>> stages({}, {"tool_block.mass": 0.08}, up=0.9, window=50).window
        50
    """
    if down is not None and down >= up:
        raise UnknownOption("down", down, (f"a share from 0 up to less than {up:g}", "None"))

    def acts(situation: Situation) -> Acts:
        situation.staged.add(situation.key)
        return of[situation.stages.get(situation.key, Progress()).level].plan(situation)

    return acts


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
