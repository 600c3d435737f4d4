"""What a curriculum is made of: values that say what is done in a situation."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Protocol, TypeVar, final

import numpy as np
from pydantic import PlainSerializer, PlainValidator, ValidationError

from scm_world._arguments import one_of
from scm_world._types import Value
from scm_world.errors import ModelError, ScmWorldError, UnknownOption, UnreadableFile
from scm_world.graph import flatten
from scm_world.queries.plans import as_act
from scm_world.variables import Draw, Function, Intervention, Noise
from scm_world.variables.mechanisms import check_trusted
from scm_world.variables.spaces import Frozen, problems_of
from scm_world.world import Simulation
from scm_world.world.compiled_task import CompiledTask

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
        return {
            "episode": self.episode,
            "stages": {
                key: {"level": kept.level, "recent": list(kept.recent)}
                for key, kept in self.stages.items()
            },
        }

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
    """An instant at which a curriculum may intervene.

    Attributes:
        world: At this instant; a part looks at it and leaves it alone.
        episode: How many episodes the curriculum has seen begin before this one.
        step: The control step within the episode; 0 is the reset.
        memory: Of the curriculum.
        due: Whether what has no time of its own acts now.
        first: Where bodies come and go: what decides that, which is asked for before all else,
            so that the rest finds the bodies that there are then; else None.
        initial: Values at the beginning of the episode, before anything was done, of what parts
            ask for.
    """

    world: Simulation
    episode: int
    step: int
    memory: Memory
    due: bool
    first: frozenset[str] | None = None
    initial: Mapping[str, Value] = field(default_factory=dict)

    @property
    def compiled(self) -> CompiledTask:
        """The structure that there is."""
        return self.world.compiled

    def values(self) -> Mapping[str, Value]:
        """Give the present value of every variable."""
        return self.world.values()

    def uniform(self, key: str) -> float:
        """Draw a number in [0, 1) from a noise of the curriculum's own.

        Args:
            key: Of the noise; one key gives one number at one instant.
        """
        noise: Noise = self.world.noise
        where: Any = {"episode": self.world.episode, "step": self.step}
        return float(noise.uniforms(f"{STREAM}/{key}", n=1, **where)[0, 0])

    def generator(self, key: str) -> np.random.Generator:
        """Give a generator of random numbers of the curriculum's own; see ``uniform``."""
        noise: Noise = self.world.noise
        where: Any = {"episode": self.world.episode, "step": self.step}
        words = noise.uniforms(f"{STREAM}/{key}/generator", n=2, **where)[0] * 2.0**53
        return np.random.default_rng([int(word) for word in words])


Acts = dict[str, Any]
"""An intervention: acts by the name of the variable."""


class Part(Frozen):
    """A rule that says what is done in a situation. It is a value, with JSON without loss.

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

    def acts(self, situation: Situation) -> Acts:
        """Return the interventions of now; none by default."""
        return {}

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

    def declared(self, declaration: CompiledTask) -> None:
        """Look for names that do not exist and values that are impossible, in a structure.

        Raises:
            UnknownVariable: A name stands for nothing.
            InterventionError: A region or a value is impossible.
        """

    def names(self) -> Iterator[str]:
        """List the names and patterns of what it sets, as far as they are known beforehand."""
        yield from ()

    @cached_property
    def key(self) -> str:
        """A word that sums up its content: two parts with one key have the same noise."""
        text = f"{self.kind}/{self.model_dump_json()}"
        return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()

    def functions(self) -> Iterator[Function]:
        """List the functions of the user's that it calls."""
        yield from ()


def as_part(given: Any) -> Part:
    """Take a part, the plain data of one, or an intervention that is always done.

    Raises:
        UnknownOption: It is none of these.
    """
    if isinstance(given, Part):
        return given
    if isinstance(given, Mapping):
        kind = given.get("kind")
        if isinstance(kind, str):
            return _from_file(kind, given)
        return Do(given)
    raise UnknownOption("part of a curriculum", given, ("a part, such as resample('*.mass')",))


def _from_file(kind: str, given: Mapping[str, Any]) -> Part:
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


def acts_of(request: Mapping[str, Any]) -> Acts:
    """Read an intervention, as a user writes it or as a file has it.

    Args:
        request: Values and acts by name, dotted or nested; an act may be plain data.

    Raises:
        UnknownOption: It is no mapping, or something in it is no intervention.
    """
    if not isinstance(request, Mapping):
        return flatten(request)  # which says what is wrong
    data = {n: act for n, act in request.items() if _is_data(act)}
    nested = flatten({n: act for n, act in request.items() if n not in data})
    return {name: as_act(value) for name, value in {**nested, **data}.items()}


def _is_data(act: Any) -> bool:
    """Tell an act that was written down from the quantities of an entity."""
    return isinstance(act, Mapping) and isinstance(act.get("kind"), str)


@final
class Do(Part):
    """Do always the same.

    Attributes:
        request: Interventions, by the name of the variable.

    Example:
        >>> Do({"tool_block": {"mass": 0.08}}).request["tool_block.mass"].value
        0.08
    """

    kind: Literal["do"] = "do"
    request: dict[str, Intervention]

    def __init__(self, request: Mapping[str, Any], **fields: Any) -> None:
        super().__init__(request=acts_of(request), **fields)

    def acts(self, situation: Situation) -> Acts:
        """Give the intervention; its draws have noises of their own."""
        return dict(self._acts) if situation.due else {}

    @cached_property
    def _acts(self) -> Acts:
        own = {"stream": f"{STREAM}/{self.key}"}
        return {
            name: act.model_copy(update=own) if isinstance(act, Draw) and not act.stream else act
            for name, act in self.request.items()
        }

    def names(self) -> Iterator[str]:
        """List what it sets."""
        yield from self.request

    def declared(self, declaration: CompiledTask) -> None:
        """Look for names that do not exist and values that are impossible."""
        for name, act in self.request.items():
            if name not in declaration.entity_names:
                declaration.model.accept(name, act)

    def functions(self) -> Iterator[Function]:
        """List the functions of mechanisms."""
        for act in self.request.values():
            function = getattr(act, "function", None)
            if isinstance(function, Function):
                yield function


class HasPart(Protocol):
    """A value that is made of parts."""

    @property
    def part(self) -> Part:
        """All that is done."""


Made = TypeVar("Made", bound=HasPart)


def read_from(kind: type[Made], data: Any, *, form: str, trusted: Sequence[str]) -> Made:
    """Read a value that was written down as plain data.

    Args:
        kind: Of the value.
        data: Plain data.
        form: What its ``"format"`` has to be.
        trusted: Packages other than this one whose functions may be called.

    Raises:
        ModelError: It is something else, or it calls a function outside of those packages.
    """
    what = kind.__name__.lower()
    if not isinstance(data, Mapping) or data.get("format") != form:
        raise ModelError([f"not a {what}: expected the format {form!r}"])
    validate: Any = kind
    try:
        made: Made = validate.model_validate({k: v for k, v in data.items() if k != "format"})
    except ValidationError as error:
        raise ModelError([f"not a {what}: {said}" for said in problems_of(error)]) from None
    except (TypeError, ValueError) as error:
        said_ = error.problems if isinstance(error, ModelError) else (str(error),)
        raise ModelError([f"not a {what}: {one}" for one in said_]) from None
    check_trusted((f for part in made.part.walk() for f in part.functions()), trusted)
    return made
