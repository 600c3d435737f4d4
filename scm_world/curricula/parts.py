"""Kinds of curricula: the interventions of an episode, their times, and the parts that act.

Each refuses wrong arguments with ``UnknownOption`` or ``ModelError``. Where a part is
expected, interventions, a plan, or a function of the ``Situation`` may stand for it.
"""
# ruff: noqa: D102 # the base class describes acts

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Annotated, Any, Literal, final
from weakref import WeakKeyDictionary

from pydantic import (
    BeforeValidator,
    Field,
    PlainSerializer,
    PlainValidator,
    PositiveInt,
    ValidationInfo,
    model_validator,
)

from scm_world._patterns import as_names
from scm_world.curricula.curriculum import (
    STREAM,
    Acts,
    AnyPart,
    Curriculum,
    Part,
    Progress,
    Situation,
)
from scm_world.curricula.targets import regions
from scm_world.errors import UnknownOption, UnknownVariable, blamed
from scm_world.graph import SCM
from scm_world.queries.plans import Plan, targets
from scm_world.variables import Distribution, Draw, Function, Intervention, Subset, Time
from scm_world.variables.kinds import SPACES, SpaceName
from scm_world.variables.spaces import Frozen, refuse_infinite
from scm_world.world.compiled_task import CompiledTask

Make = Callable[..., Curriculum]
"""Takes the attributes of a part by name or in their order, or as many parts as there are."""

# --- interventions --------------------------------------------------------------------------------


Words = Annotated[tuple[str, ...], BeforeValidator(as_names)]
"""Names and patterns; one may be given by itself."""


def own(act: object, situation: Situation) -> Any:
    """Return an intervention; its draws have a noise stream of the part that is asked."""
    stream = f"{STREAM}/{situation.key}"

    def streamed(_: str, draw: Draw) -> Draw:
        return draw if draw.stream else draw.model_copy(update={"stream": stream})

    return act.redrawn("", streamed) if isinstance(act, Intervention) else act


def _request(given: Mapping[str, object] | None) -> Mapping[str, object]:
    """Return interventions by dotted name; those of a file stay plain data."""
    acts = {
        name: value if isinstance(value, list | tuple) else [value]
        for name, value in (given.items() if isinstance(given, dict) else ())
    }
    every_one = [act for several in acts.values() for act in several]
    is_data = all(isinstance(act, dict) and isinstance(act.get("kind"), str) for act in every_one)
    return acts if every_one and is_data else dict(Plan(given))


def _written(request: Mapping[str, tuple[Any, ...]]) -> dict[str, Any]:
    """Return interventions as plain data, in a list where a variable has several.

    A draw always has its stream there: the noise of a part is a function of this text.
    """
    found = {name: [act.model_dump(mode="json") for act in acts] for name, acts in request.items()}
    for act in (act for acts in found.values() for act in acts if act["kind"] == "draw"):
        act.setdefault("stream", None)
    return {name: acts if len(acts) != 1 else acts[0] for name, acts in found.items()}


@final
class Do(Curriculum):
    """Do the same in every episode: interventions by variable, each of which may have a time."""

    kind: Literal["do"] = "do"
    request: Annotated[
        dict[str, tuple[Intervention, ...]],
        BeforeValidator(_request),
        PlainSerializer(_written, return_type=dict),
    ]

    def acts(self, situation: Situation) -> Acts:
        return {n: tuple(own(act, situation) for act in acts) for n, acts in self.request.items()}


def _source(given: object, info: ValidationInfo) -> object:
    """Refuse values that are neither a space nor a distribution, and boxes without ends."""
    option = str(info.field_name)
    if not (isinstance(given, Frozen | dict) or (isinstance(given, str) and given in SPACES)):
        raise UnknownOption(option, given, (*SPACES, "a Subset", "a distribution"))
    refuse_infinite(option, given)
    return given


SIZES = (".size", "block_size", "_dims")
POSITIONS = (".cylindrical_position",)
_DRAWS: WeakKeyDictionary[CompiledTask, dict[tuple[str, bool], Plan]] = WeakKeyDictionary()
"""The draws of each part, by its key, in a structure; without and with ``Situation.first``."""


@final
class Resample(Curriculum):
    """Draw variables again.

    Attributes:
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

    kind: Literal["resample"] = "resample"
    what: Annotated[Words, Field(min_length=1)]
    space: Annotated[SpaceName | Subset | Distribution, BeforeValidator(_source)] = "A"
    besides: Words = ()
    exclusive: bool = False

    def acts(self, situation: Situation) -> Acts:
        kept = _DRAWS.setdefault(situation.compiled, {})
        word, first = (situation.key, situation.first is None), situation.first
        if word not in kept:
            found = regions(situation.compiled, self.what, self.space, self.besides, first)
            kept[word] = Plan._of({n: (own(Draw(one), situation),) for n, one in found.items()})
        if not self.exclusive:
            return kept[word]
        without = SIZES if situation.uniform(situation.key) < 0.5 else POSITIONS
        return {name: acts for name, acts in kept[word].items() if not name.endswith(without)}


resample: Make = Resample
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


@final
class Goals(Curriculum):
    """Draw a new goal, as the task draws goals.

    Attributes:
        space: ``"A"``, ``"B"`` or ``"A|B"``.
        besides: Names of the goal's causes that keep their values.
    """

    kind: Literal["goal"] = "goal"
    space: SpaceName = "A"
    besides: Words = ()

    def acts(self, situation: Situation) -> Acts:
        task = situation.compiled.task
        drawn = task.sample_goal(self.space)
        if not drawn:
            allowed = (f"a task with goals; draw variables of {task.name} by resample",)
            raise UnknownOption("task for goals", task.name, allowed)
        for name in self.besides:
            if name not in drawn:
                raise UnknownVariable(name, drawn)
        return {n: own(act, situation) for n, act in drawn.items() if n not in self.besides}


goals: Make = Goals


@final
class Follow(Curriculum):
    """Follow the plan that a function of the episode returns.

    Attributes:
        function: Takes the ``Situation``, and returns interventions by name, which may have times,
            or None. Random numbers come from ``situation.generator(key)``. Where bodies come and
            go it is called twice: first for the variables that decide that, then for all.
    """

    kind: Literal["follow"] = "follow"
    function: Annotated[
        Function,
        BeforeValidator(lambda given: Function(given) if callable(given) else given),
    ]

    def acts(self, situation: Situation) -> Acts:
        with blamed(f"the function {self.function.reference!r} of a curriculum"):
            given = self.function.bind()(situation)
        if not isinstance(given, Mapping | None):
            raise UnknownOption("intervention of a function", given, ("values by name", "None"))
        return given or {}


follow: Make = Follow

# --- when -----------------------------------------------------------------------------------------

RESET = Time(at=0)


@final
class Timed(Curriculum):
    """Act at a time within every episode; an intervention with a time of its own keeps it.

    Attributes:
        time: As that of an intervention: a ``Time``, or its fields, such as ``{"every": 50}`` or
            ``{"when": Contact("tool_block", "floor")}``.
        part: A part, or an intervention.
    """

    kind: Literal["timed"] = "timed"
    time: Time
    part: AnyPart

    def acts(self, situation: Situation) -> Acts:
        plan, due = self.part.plan(replace(situation, step=self.time.start or 0)), self.time
        return plan._each(lambda act: act if act.time else act.model_copy(update={"time": due}))


timed: Make = Timed


def at_step(step: int, part: Part) -> Curriculum:
    """Act after a number of control steps of every episode; 0 is the reset, as without a time."""
    return timed(Time(at=step), part)


def _range(given: object) -> range:
    """Read a range of episodes; in a file it is a list of its three numbers."""
    episodes = range(*given) if isinstance(given, list) else given
    if isinstance(episodes, range) and episodes.step > 0 <= episodes.start and len(episodes):
        return episodes
    allowed = ("a range such as range(1_000, 5_000)", "range(first, stop, period)")
    raise UnknownOption("episodes", given, allowed)


@final
class During(Curriculum):
    """Act in some episodes only.

    Attributes:
        episodes: ``range(first, stop)`` or ``range(first, stop, period)``; they count from 0.
        part: A part, or an intervention.
    """

    kind: Literal["during"] = "during"
    episodes: Annotated[
        range,
        PlainValidator(_range),
        PlainSerializer(lambda given: [given.start, given.stop, given.step], return_type=list[int]),
    ]
    part: AnyPart

    def acts(self, situation: Situation) -> Acts:
        return self.part.plan(situation) if situation.episode in self.episodes else {}


def during(episodes: range, part: Part) -> During:
    """Return a part that acts in a range of episodes only; see ``During``."""
    if not isinstance(episodes, range):  # a list would be read as the three numbers of a range
        raise UnknownOption("episodes", episodes, ("a range such as range(1_000, 5_000)",))
    return During(episodes=episodes, part=part)


# --- which ----------------------------------------------------------------------------------------

Parts = Annotated[tuple[AnyPart, ...], Field(min_length=1)]


@final
class Together(Curriculum):
    """Do several parts; of two on one quantity at one time the later one counts.

    A shift or scale acts on the variable as the parts before it leave it.

    Example:
        >>> both = together({"floor_friction": 0.4}, {"tool_block.mass": 0.03})
        >>> [list(part.request) for part in both.of]
        [['floor_friction'], ['tool_block.mass']]
    """

    kind: Literal["together"] = "together"
    of: Parts

    def acts(self, situation: Situation) -> Acts:
        layers: list[Acts] = [{}]
        for part in self.of:
            plan = part.plan(situation)
            for own in (*(layer for _, layer in plan.context), Plan(dict(plan))):
                layers = stacked(situation.model, layers, own)
        *below, top = layers
        found = Plan(top)
        for layer in reversed(below):
            found = found.over(layer, "curriculum")
        return found


together: Make = Together


def stacked(model: SCM, layers: list[Acts], plan: Acts) -> list[Acts]:
    """Return layers with the plan of a further part: soft interventions on them lie above."""
    known = {target for layer in layers for name in layer for target in targets(model, name)}
    soft = {
        name: acts
        for name, acts in plan.items()
        if not known.isdisjoint(targets(model, name)) and any(act.is_soft for act in acts)
    }
    hard = {name: acts for name, acts in plan.items() if name not in soft}
    # A replacement ends what lies above it, at its time.
    above = [over(model, layer, hard, keep=False) for layer in layers[1:]]
    found = [over(model, layers[0], hard), *(layer for layer in above if layer)]
    return [*found, soft] if soft else found


def over(model: SCM, below: Acts, plan: Acts, *, keep: bool = True) -> Acts:
    """Return interventions with a plan over them: at its times it alone sets its quantities."""
    if not below:
        return plan if keep else {}
    mine: dict[Time, set[str]] = {}
    for name, acts in plan.items():
        for act in acts:
            mine.setdefault(act.time or RESET, set()).update(targets(model, name))
    found: dict[str, Any] = {}
    for name, acts in below.items():
        its = set(targets(model, name))
        found[name] = tuple(act for act in acts if not its <= mine.get(act.time or RESET, set()))
    if keep:
        found |= {name: (*found.get(name, ()), *acts) for name, acts in plan.items()}
    return {name: acts for name, acts in found.items() if acts}


@final
class Stages(Curriculum):
    """Do the first part, and the next one once the learner succeeds.

    Attributes:
        of: Parts, or interventions, from the first stage on.
        up: Share of successes from which the next stage begins, in (0, 1].
        down: Share of successes down from which the stage before comes back; never if None.
        window: How many episodes of a stage count.

    Example:
        >>> stages({}, {"tool_block.mass": 0.08}, up=0.9, window=50).window
        50
    """

    kind: Literal["stages"] = "stages"
    of: Parts
    up: Annotated[float, Field(gt=0.0, le=1.0)] = 0.8
    down: Annotated[float, Field(ge=0.0)] | None = None
    window: PositiveInt = 100

    @model_validator(mode="after")
    def _check(self) -> Stages:
        if self.down is not None and self.down >= self.up:
            allowed = (f"a share from 0 up to less than {self.up:g}", "None")
            raise UnknownOption("down", self.down, allowed)
        return self

    def acts(self, situation: Situation) -> Acts:
        situation.staged[situation.key] = self
        return self.of[situation.stages.get(situation.key, Progress()).level].plan(situation)

    def after(self, progress: Progress, *, success: bool) -> Progress:
        """Return the progress after one more episode in which the stages acted."""
        level, recent = progress.level, (*progress.recent, success)[-self.window :]
        share = sum(recent) / self.window
        is_down = self.down is not None and share <= self.down
        step = 1 if share >= self.up else -1 if is_down else 0
        after = min(max(level + step, 0), len(self.of) - 1)
        is_kept = len(recent) < self.window or after == level
        return Progress(level, recent) if is_kept else Progress(after)


stages: Make = Stages
