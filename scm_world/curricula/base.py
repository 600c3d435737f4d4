"""Parts of curricula: values that return a plan for an episode that begins."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, TypeVar, final

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    NonNegativeInt,
    PlainSerializer,
    PlainValidator,
    ValidationInfo,
    create_model,
    model_validator,
)

from scm_world._arguments import one_of, whole_number
from scm_world._types import Floats
from scm_world.errors import ModelError, UnknownOption
from scm_world.graph import SCM
from scm_world.queries.plans import Plan
from scm_world.variables import Noise
from scm_world.variables.spaces import Frozen
from scm_world.world.compiled_task import CompiledTask

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


class Memory(Frozen):
    """The state of a curriculum between episodes.

    Attributes:
        episode: Number of the episode, from 0.
        stages: Progress in each part with stages, by its key.
    """

    episode: NonNegativeInt
    stages: dict[str, Progress]


@final
@dataclass(frozen=True)
class Situation:
    """The episode that begins, as a curriculum sees it.

    Attributes:
        memory: The number of the episode, and how far the learner has come.
        compiled: The structure of the episode.
        noise: The noise of the episode.
        number: Number of the episode within that noise.
        step: The control step of the part that is asked; 0 is the reset.
        first: The variables that decide which bodies exist, where only these are asked for: the
            plan for them comes first, and the rest is asked for the bodies that follow; else None.
        key: The key of the part that is asked.
        staged: The keys of the parts with stages that were asked.
    """

    memory: Memory
    compiled: CompiledTask
    noise: Noise
    number: int
    step: int = 0
    first: frozenset[str] | None = None
    key: str = ""
    staged: set[str] = field(default_factory=set)

    @property
    def episode(self) -> int:
        """Number of the episode within the curriculum."""
        return self.memory.episode

    @property
    def model(self) -> SCM:
        """The variables of the episode."""
        return self.compiled.model

    def uniform(self, key: str) -> float:
        """Return a random number in [0, 1).

        Args:
            key: Name of the noise stream; one name gives one number at one control step.
        """
        return float(self._uniforms(key, 1)[0])

    def generator(self, key: str) -> np.random.Generator:
        """Return a generator of random numbers; see ``uniform``."""
        words = self._uniforms(f"{key}/generator", 2) * 2.0**53
        return np.random.default_rng([int(word) for word in words])

    def _uniforms(self, key: str, n: int) -> Floats:
        where: Any = {"episode": self.number, "step": self.step}
        drawn: Floats = self.noise.uniforms(f"{STREAM}/{key}", n=n, **where)[0]
        return drawn


Acts = Mapping[str, Any]
"""Interventions, as ``Plan`` takes them."""
Rule = Callable[[Situation], Acts]
"""A function of the episode that returns its interventions."""


class Part(Frozen):
    """A rule with its arguments: immutable and JSON-serialisable.

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
        """Return the interventions of an episode."""
        return Plan(self._rule()(replace(situation, key=self.key)))

    @cached_property
    def key(self) -> str:
        """A hash of the content: two parts with one key have the same noise."""
        text = f"{self.kind}/{self.model_dump_json()}"
        return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


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
            fields[one.name] = _OF if one.name == "of" else (one.annotation, default)
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
    """Return a part: itself, from plain data, of a function, or of a fixed intervention.

    Raises:
        UnknownOption: It is none of these.
        ModelError: A field of the plain data is missing or wrong.
    """
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


# --- types of fields ------------------------------------------------------------------------------


def words(option: str, given: Any) -> tuple[str, ...]:
    """Return names and patterns as a tuple; one may be given by itself.

    Raises:
        UnknownOption: One of them is not text.
    """
    names = tuple(given) if isinstance(given, Iterable) and not isinstance(given, str) else (given,)
    if not all(isinstance(name, str) for name in names):
        raise UnknownOption(option, given, ("a name or a pattern", "several of them"))
    return names


def _words(given: Any, info: ValidationInfo) -> tuple[str, ...]:
    return words(str(info.field_name), given)


def _whole(least: int) -> BeforeValidator:
    def read(given: Any, info: ValidationInfo) -> int:
        return whole_number(str(info.field_name), given, least=least)

    return BeforeValidator(read)


def _some(parts: tuple[Part, ...]) -> tuple[Part, ...]:
    if not parts:
        raise UnknownOption("parts", (), ("one part or more",))
    return parts


AnyPart = Annotated[
    Part,
    PlainValidator(as_part),
    PlainSerializer(lambda part: part.model_dump(mode="json"), return_type=dict),
]
"""A part; its ``kind`` says which."""
_OF = Annotated[tuple[AnyPart, ...], AfterValidator(_some)], Field((), validate_default=True)
Words = Annotated[tuple[str, ...], BeforeValidator(_words)]
"""Names and patterns; one may be given by itself."""
Index = Annotated[int, _whole(0)]
"""A whole number from 0 on."""
Count = Annotated[int, _whole(1)]
"""A whole number from 1 on."""
