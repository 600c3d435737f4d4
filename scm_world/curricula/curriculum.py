"""What a curriculum is: a function of the episode that returns a plan, as a value with files."""

from __future__ import annotations

import hashlib
import json
from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar, Union, final

import numpy as np
from pydantic import NonNegativeInt, PlainSerializer, PlainValidator

from scm_world._arguments import one_of, typed
from scm_world._types import Floats
from scm_world.errors import ModelError, UnknownOption, reading
from scm_world.graph import SCM
from scm_world.queries.plans import Plan
from scm_world.queries.world import World
from scm_world.runs.files import read_text
from scm_world.tasks.rewards import SUCCESS
from scm_world.variables import Function, Noise
from scm_world.variables.mechanisms import check_portable, check_trusted
from scm_world.variables.spaces import Frozen
from scm_world.world import Simulation
from scm_world.world.compiled_task import CompiledTask

FORMAT = "scm_world/curriculum/2"
STREAM = "curriculum"
"""First word of the noise streams of curricula."""

Acts = Mapping[str, Any]
"""Interventions, as ``Plan`` takes them."""
Part = Union["Curriculum", Acts, Callable[["Situation"], Acts | None], None]
"""A curriculum, interventions, or a function of the episode; None does nothing."""
Kind = TypeVar("Kind", bound=Frozen)


class Progress(NamedTuple):
    """How far the learner has come in a curriculum with stages.

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
        staged: The parts with stages that were asked, by their key.
    """

    episode: int
    stages: Mapping[str, Progress]
    compiled: CompiledTask
    noise: Noise
    number: int
    step: int = 0
    first: frozenset[str] | None = None
    key: str = ""
    staged: dict[str, Any] = field(default_factory=dict)

    @property
    def model(self) -> SCM:
        """The variables of the episode."""
        return self.compiled.model

    @typed
    def uniform(self, key: str) -> float:
        """Return a random number in [0, 1): one for each name of a stream and control step."""
        return float(self._uniforms(key, 1)[0])

    @typed
    def generator(self, key: str) -> np.random.Generator:
        """Return a generator of random numbers; see ``uniform``."""
        words = self._uniforms(f"{key}/generator", 2) * 2.0**53
        return np.random.default_rng([int(word) for word in words])

    def _uniforms(self, key: str, n: int) -> Floats:
        stream = f"{STREAM}/{key}"
        drawn: Floats = self.noise.uniforms(stream, n=n, episode=self.number, step=self.step)[0]
        return drawn


class Curriculum(Frozen):
    """A rule that returns the interventions of an episode, made by the functions of this package.

    It is immutable, hashable and JSON-serialisable. Curricula are parts of others.

    Attributes:
        kind: Its name in a file.

    Example:
        >>> from scm_world.curricula import during, resample, together
        >>> curriculum = together(
        ...     resample("goal_block.polar"),
        ...     during(range(1_000, 5_000), resample("*.mass", "B")),
        ... )
        >>> [part.kind for part in curriculum.of]
        ['resample', 'during']
    """

    kind: str

    def __init__(self, *given: object, **fields: object) -> None:
        names = [name for name in type(self).model_fields if name != "kind"]
        if given and names[0] == "of":  # as many parts as there are
            names, given = ["of"], (given,)
        super().__init__(**dict(zip(names[: len(given)], given, strict=True)), **fields)

    @abstractmethod
    def acts(self, situation: Situation) -> Acts:
        """Return the interventions of an episode; the key of the situation is that of the part."""

    def parts(self) -> list[Curriculum]:
        """Return it and the curricula within it."""
        return [*nested(self, Curriculum)]  # type: ignore[type-abstract] # mypy excludes these

    @typed
    def plan(self, situation: Situation) -> Plan:
        """Return the interventions of an episode, by the names of its variables."""
        plan, first = Plan(self.acts(replace(situation, key=self.key))), situation.first
        if first is None:
            return plan.named(situation.model)
        return plan.named(situation.model, [name for name in situation.model if name in first], [])

    @cached_property
    def key(self) -> str:
        """A hash of the content: two curricula with one key have the same noise."""
        text = f"{self.kind}/{self.model_dump_json()}"
        return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()

    def __hash__(self) -> int:
        return hash(self.key)

    @typed
    def check(self, world: Simulation | World) -> None:
        """Refuse names that do not exist and regions that are impossible.

        Where variables decide which bodies exist, names are looked up at each reset instead: they
        may be those of bodies that come.

        Args:
            world: The world whose structure episodes begin with.

        Raises:
            InterventionError: A name or a region does not fit.
            UnknownOption: The task does not say what success is, or has no goals.
        """
        parts = self.parts()
        if SUCCESS not in world.model and any(part.kind == "stages" for part in parts):
            allowed = (f"a task with {SUCCESS!r}, as success=(function, 'hinge.position', …)",)
            raise UnknownOption("task for a curriculum with stages", world.task.name, allowed)
        if len(world.structures.head):
            return
        for part in (part for part in parts if part.kind in ("do", "resample", "goal")):
            for name, act in part.plan(Situation(0, {}, world.compiled, Noise(0), 0)).acts():
                world.model.accept(name, act)

    def as_dict(self) -> dict[str, Any]:
        """Write it as plain data.

        Raises:
            ModelError: It calls a function that cannot be found again under its name, or has a
                number that is not finite.
        """
        check_portable(nested(self, Function))
        for part in self.parts():
            Plan(getattr(part, "request", None)).as_dict()
        return {"format": FORMAT, **self.model_dump(mode="json")}

    def to_json(self) -> str:
        """Write it as JSON; errors as in ``as_dict``."""
        return json.dumps(self.as_dict(), indent=2, allow_nan=False)

    @classmethod
    def load(cls, path: Path | str, *, trusted: Sequence[str] = ()) -> Curriculum:
        """Read a file with the text of ``to_json``.

        Args:
            path: The file.
            trusted: Packages other than this one whose functions may be called.

        Raises:
            UnreadableFile: It is not a curriculum, or it calls a function outside of those
                packages.
        """
        with reading(path, "give a file with the text of Curriculum.to_json()"):
            return read_from(_of_kind, json.loads(read_text(path)), form=FORMAT, trusted=trusted)


def as_curriculum(given: object) -> Curriculum:
    """Return a curriculum: itself, of plain data, a function, or interventions; None does nothing.

    Example:
        >>> as_curriculum({"floor_friction": 0.4}).kind
        'do'
    """
    if isinstance(given, Curriculum):
        return given
    if callable(given):
        return _of_kind(kind="follow", function=given)
    data = {} if given is None else given
    if not isinstance(data, Mapping):
        raise UnknownOption("part of a curriculum", given, ("a part, such as resample('*.mass')",))
    if "format" in data:
        return read_from(_of_kind, data, form=FORMAT, trusted=())
    return _of_kind(**data) if isinstance(data.get("kind"), str) else _of_kind("do", request=data)


def _of_kind(kind: object = None, **fields: object) -> Curriculum:
    kinds = {one.model_fields["kind"].default: one for one in Curriculum.__subclasses__()}
    one_of("part of a curriculum", kind, kinds)
    return kinds[kind](**fields)


AnyPart = Annotated[
    Curriculum,
    PlainValidator(as_curriculum),
    PlainSerializer(lambda part: part.model_dump(mode="json"), return_type=dict),
]
"""A curriculum within a declaration; its ``kind`` says which."""


def read_from(
    build: Callable[..., Kind], data: object, *, form: str, trusted: Sequence[str]
) -> Kind:
    """Build a value of the fields that were written as plain data, with its ``"format"``.

    Raises:
        ModelError: It is something else, or it calls a function outside of the trusted packages.
    """
    what = form.split("/")[1]
    if not isinstance(data, Mapping) or data.get("format") != form:
        raise ModelError([f"not a {what}: expected the format {form!r}; write it again"])
    try:
        made = build(**{name: value for name, value in data.items() if name != "format"})
    except (TypeError, ValueError) as error:
        said = error.problems if isinstance(error, ModelError) else (str(error),)
        raise ModelError([f"not a {what}: {one}" for one in said]) from None
    check_trusted(nested(made, Function), trusted)
    return made


def nested(value: object, kind: type[Kind]) -> Iterator[Kind]:
    """List the values of a kind in a declaration: itself, then those in its fields."""
    inner: Iterable[object] = ()
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
