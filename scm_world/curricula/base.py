"""The elements of curricula: values that return a plan for an episode that begins."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, final

import numpy as np
from pydantic import PlainSerializer, PlainValidator, ValidationError

from scm_world._arguments import one_of
from scm_world._types import Value
from scm_world.errors import ScmWorldError, UnknownOption, UnreadableFile
from scm_world.graph import SCM, NoiseKey, flatten
from scm_world.queries.plans import Plan, as_act, targets
from scm_world.variables import Draw, Function, Intervention, Noise, Time
from scm_world.variables.spaces import Frozen, problems_of
from scm_world.world.compiled_task import CompiledTask, beginning

STREAM = "curriculum"
"""First word of the noise of curricula."""


@final
@dataclass
class Progress:
    """How far the learner has come in the stages of an adaptive part.

    Attributes:
        level: The present stage.
        recent: Whether the last episodes of this stage were successes.
    """

    level: int = 0
    recent: deque[bool] = field(default_factory=deque)


@contextmanager
def state_read(source: str) -> Iterator[None]:
    """Refuse plain data that is no state of a curriculum.

    Args:
        source: The method whose result is expected.

    Raises:
        UnreadableFile: What is read inside is something else.
    """
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        said = f"{error} is missing" if isinstance(error, KeyError) else f"it is none ({error})"
        advice = f"give what {source} returned, of as many environments"
        raise UnreadableFile("the state of a curriculum", said, advice) from None


@final
@dataclass
class Memory:
    """The state of a curriculum between episodes.

    Attributes:
        episode: How many episodes have begun before the present one.
        stages: Progress of each adaptive part, by its key.
    """

    episode: int = 0
    stages: dict[str, Progress] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Write it as plain data."""
        stages = {k: {"level": p.level, "recent": [*p.recent]} for k, p in self.stages.items()}
        return {"episode": self.episode, "stages": stages}

    @classmethod
    def from_dict(cls, data: Any) -> Memory:
        """Read what ``as_dict`` wrote.

        Raises:
            UnreadableFile: It is something else.
        """
        with state_read("state()"):
            stages = {
                str(key): Progress(int(kept["level"]), deque(map(bool, kept["recent"])))
                for key, kept in data["stages"].items()
            }
            return cls(int(data["episode"]), stages)


@final
@dataclass(frozen=True)
class Situation:
    """The episode that begins, as a curriculum sees it.

    Attributes:
        episode: How many episodes the curriculum has seen begin before this one.
        memory: Of the curriculum: how far the learner has come.
        compiled: The structure of the episode.
        noise: Of the episode.
        number: Of the episode within that noise.
        time: The time of what has none of its own; None is the reset.
        first: Where bodies come and go: what decides that, which is asked for before all else,
            so that the rest finds the bodies that there will be; else None.
    """

    episode: int
    memory: Memory
    compiled: CompiledTask
    noise: Noise
    number: int
    time: Time | None = None
    first: frozenset[str] | None = None

    @property
    def model(self) -> SCM:
        """The variables that there are."""
        return self.compiled.model

    @property
    def step(self) -> int:
        """The control step for which it is asked; 0 is the reset."""
        return (self.time and self.time.start) or 0

    def uniform(self, key: str) -> float:
        """Draw a number in [0, 1) from a noise of the curriculum's own.

        Args:
            key: Of the noise; one key gives one number at one instant.
        """
        where: Any = {"episode": self.number, "step": self.step}
        return float(self.noise.uniforms(f"{STREAM}/{key}", n=1, **where)[0, 0])

    def generator(self, key: str) -> np.random.Generator:
        """Return a generator of random numbers of the curriculum's own; see ``uniform``."""
        where: Any = {"episode": self.number, "step": self.step}
        words = self.noise.uniforms(f"{STREAM}/{key}/generator", n=2, **where)[0] * 2.0**53
        return np.random.default_rng([int(word) for word in words])

    def natural(self, name: str) -> Value | None:
        """Return a variable at the beginning without interventions; None if it is computed."""
        row = beginning(self.compiled, NoiseKey(self.noise, self.number, origin=0))
        known = name in self.compiled.slices or name in self.compiled.static_names
        return np.array(row[name]) if known else None


class Part(Frozen):
    """A rule that says what is done in an episode. It is a value, with JSON without loss.

    Attributes:
        kind: Its name in a file.
    """

    KINDS: ClassVar[dict[str, type[Part]]] = {}

    kind: str

    if TYPE_CHECKING:  # as in ``Frozen``

        def __init__(self, **fields: Any) -> None: ...

    @classmethod
    def __pydantic_init_subclass__(cls, **options: Any) -> None:
        """Know the part by its kind, so that it can be read from a file."""
        super().__pydantic_init_subclass__(**options)
        default = cls.model_fields["kind"].default
        if isinstance(default, str):
            Part.KINDS[default] = cls

    def acts(self, situation: Situation) -> Mapping[str, Any]:
        """Return the interventions of the episode, as ``Plan`` takes them; none by default."""
        return {}

    @final
    def plan(self, situation: Situation) -> Plan:
        """Return the interventions of the episode; what has no time has that of the situation."""
        plan, time = Plan(self.acts(situation)), situation.time
        if time is None:
            return plan
        timed = {name: tuple(_at(act, time) for act in acts) for name, acts in plan.items()}
        return Plan.of(timed)

    def parts(self) -> tuple[Part, ...]:
        """List its parts."""
        return ()

    def walk(self) -> Iterator[Part]:
        """List it and all its parts, recursively."""
        yield self
        for part in self.parts():
            yield from part.walk()

    def live(self, memory: Memory, episode: int) -> Iterator[Part]:
        """List it and what may act in an episode, as far as its number and the stages say."""
        yield self
        for part in self.parts():
            yield from part.live(memory, episode)

    def check(self, compiled: CompiledTask) -> None:
        """Look for names that do not exist and values that are impossible, in a structure.

        Raises:
            UnknownVariable: A name stands for nothing.
            InterventionError: A region or a value is impossible.
        """

    @cached_property
    def key(self) -> str:
        """A word that sums up its content: two parts with one key have the same noise."""
        text = f"{self.kind}/{self.model_dump_json()}"
        return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()

    def functions(self) -> Iterator[Function]:
        """List the functions of the user's that it calls."""
        yield from ()


def _at(act: Any, time: Time) -> Any:
    return act if act.time is not None else act.model_copy(update={"time": time})


def over(model: SCM, *plans: Plan) -> Plan:
    """Put plans over one another: of two acts on one quantity at one time the later one counts."""
    found = dict(plans[0])
    for plan in plans[1:]:
        mine: dict[Time | None, set[str]] = {}
        for name, acts in plan.items():
            for act in acts:
                mine.setdefault(act.time, set()).update(targets(model, name))
        for name, acts in [*found.items()]:
            kept = tuple(
                act
                for act in acts
                if not mine.get(act.time, set()).issuperset(targets(model, name))
            )
            if len(kept) < len(acts):
                found.pop(name)
            if kept:
                found[name] = kept
        found |= {name: (*found.get(name, ()), *acts) for name, acts in plan.items()}
    return Plan.of(found)


def as_part(given: Any) -> Part:
    """Take a part, the plain data of one, or an intervention that is always done.

    Raises:
        UnknownOption: It is none of these.
    """
    if isinstance(given, Part):
        return given
    if not isinstance(given, Mapping):
        raise UnknownOption("part of a curriculum", given, ("a part, such as resample('*.mass')",))
    kind = given.get("kind")
    if not isinstance(kind, str):
        return Do(given)
    one_of("part of a curriculum", kind, Part.KINDS)
    try:
        return Part.KINDS[kind].model_validate(dict(given))
    except ScmWorldError:
        raise
    except (ValidationError, TypeError) as error:
        said = "; ".join(problems_of(error)) if isinstance(error, ValidationError) else str(error)
        allowed = (f"the data of one, which this is not: {said}",)
        raise UnknownOption("part of a curriculum", kind, allowed) from None


AnyPart = Annotated[
    Part,
    PlainValidator(as_part),
    PlainSerializer(lambda part: part.model_dump(mode="json"), return_type=dict),
]
"""A part; its ``kind`` says which."""


def words(option: str, given: Any) -> tuple[str, ...]:
    """Read names and patterns: one, or several.

    Raises:
        UnknownOption: One of them is no word.
    """
    names = tuple(given) if isinstance(given, Iterable) and not isinstance(given, str) else (given,)
    if not all(isinstance(name, str) for name in names):
        raise UnknownOption(option, given, ("a name or a pattern", "several of them"))
    return names


@final
class Do(Part):
    """Do always the same.

    Attributes:
        request: Interventions, by the name of the variable; each may have a time.

    Example:
        >>> Do({"tool_block": {"mass": 0.08}}).request["tool_block.mass"].value
        0.08
    """

    kind: Literal["do"] = "do"
    request: dict[str, Intervention]

    def __init__(self, request: Mapping[str, Any], **fields: Any) -> None:
        super().__init__(request=_acts_of(request), **fields)

    def acts(self, situation: Situation) -> Mapping[str, Any]:
        """Return the interventions; their draws have noises of their own."""
        return self._acts

    @cached_property
    def _acts(self) -> Plan:
        def own(act: Any) -> Any:
            if not isinstance(act, Draw) or act.stream:
                return act
            return act.model_copy(update={"stream": f"{STREAM}/{self.key}"})

        return Plan({name: own(act) for name, act in self.request.items()})

    def check(self, compiled: CompiledTask) -> None:
        """Look for names that do not exist and values that are impossible."""
        for name, act in self._acts.acts():
            if name not in compiled.entity_names:
                compiled.model.accept(name, act)

    def functions(self) -> Iterator[Function]:
        """List the functions of mechanisms."""
        for act in self.request.values():
            function = getattr(act, "function", None)
            if isinstance(function, Function):
                yield function


def _acts_of(request: Any) -> dict[str, Any]:
    """Read an intervention, as a user writes it or as a file has it: acts may be plain data."""
    if not isinstance(request, Mapping):
        return flatten(request)  # which says what is wrong
    data = {
        name: act
        for name, act in request.items()
        if isinstance(act, Mapping) and isinstance(act.get("kind"), str)
    }
    nested = flatten({name: act for name, act in request.items() if name not in data})
    return {name: as_act(value) for name, value in {**nested, **data}.items()}


def in_time(situation: Situation, time: Time | None) -> Situation:
    """Return a situation in which what has no time of its own has another one."""
    return replace(situation, time=time)
