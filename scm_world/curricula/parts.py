"""What a curriculum is made of: values that say what is done in a situation."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal, final

import numpy as np
from pydantic import Field, PlainSerializer, PlainValidator

from scm_world.curricula.situations import STREAM, Situation
from scm_world.curricula.targets import matching
from scm_world.errors import InterventionError, UnknownOption, UnknownVariable
from scm_world.graph import flatten
from scm_world.queries.timed import as_act
from scm_world.variables import Draw, Function, Intervention, Rotations, Subset
from scm_world.variables.checks import check_region
from scm_world.variables.kinds import SPACES, AsMechanism, SpaceName
from scm_world.variables.mechanisms import Linear
from scm_world.variables.spaces import Frozen, Space
from scm_world.world.declaration import Declaration

Acts = dict[str, Any]
"""An intervention: acts by the name of the variable."""


class Part(Frozen):
    """A rule that says what is done in a situation. It is a value, with JSON without loss.

    Attributes:
        kind: Its name in a file.
    """

    KINDS: ClassVar[dict[str, type[Part]]] = {}

    kind: str

    @classmethod
    def __pydantic_init_subclass__(cls, **options: Any) -> None:
        """Know the part by its kind, so that it can be read from a file."""
        super().__pydantic_init_subclass__(**options)
        default = cls.model_fields["kind"].default
        if isinstance(default, str):
            Part.KINDS[default] = cls

    def acts(self, situation: Situation) -> Acts:
        """Say what is done now; nothing, mostly."""
        return {}

    def parts(self) -> tuple[Part, ...]:
        """List what it is made of."""
        return ()

    def walk(self) -> Iterator[Part]:
        """List it and everything that it is made of."""
        yield self
        for part in self.parts():
            yield from part.walk()

    @property
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
            if kind not in Part.KINDS:
                raise UnknownOption("part of a curriculum", kind, Part.KINDS)
            return Part.KINDS[kind].model_validate(given)
        return Do(given)
    raise UnknownOption("part of a curriculum", given, ("a part, such as resample('*.mass')",))


AnyPart = Annotated[
    Part,
    PlainValidator(as_part),
    PlainSerializer(lambda part: part.model_dump(mode="json"), return_type=dict),
]
"""A part of any kind, told apart by its ``kind``."""


def _names(given: Any) -> Any:
    return (given,) if isinstance(given, str) else tuple(given)


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
        flat = {name: as_act(value) for name, value in flatten(request).items()}
        super().__init__(request=flat, **fields)  # type: ignore[call-arg]

    def acts(self, situation: Situation) -> Acts:
        """Give the intervention."""
        return dict(self.request) if situation.due else {}

    def functions(self) -> Iterator[Function]:
        """List the functions of mechanisms."""
        for act in self.request.values():
            function = getattr(act, "function", None)
            if isinstance(function, Function):
                yield function


@final
class Resample(Part):
    """Draw variables anew.

    Attributes:
        what: Names of variables, patterns, or groups such as ``@goals``.
        space: Where they are drawn from: a declared space, a set, or a part of the parameter
            space, which may have another region for each of them.
        besides: Patterns of what is left as it is.
        exclusive: Whether a fair coin decides if sizes or positions of blocks are drawn, as the
            predecessor has it, instead of both.

    Example:
        >>> Resample("*.mass", space="B").what
        ('*.mass',)
    """

    kind: Literal["resample"] = "resample"
    what: tuple[str, ...]
    space: SpaceName | Subset | Space = "A"
    besides: tuple[str, ...] = ()
    exclusive: bool = False

    def __init__(self, what: Any, **fields: Any) -> None:
        fields["besides"] = _names(fields.get("besides", ()))
        if isinstance(fields.get("space"), str) and fields["space"] not in SPACES:
            raise UnknownOption("space", fields["space"], (*SPACES, "a Subset", "a Box"))
        super().__init__(what=_names(what), **fields)  # type: ignore[call-arg]

    def acts(self, situation: Situation) -> Acts:
        """Draw, where it is due."""
        if not situation.due:
            return {}
        targets = self.targets(situation.declaration)
        if self.exclusive:
            without = _SIZES if situation.uniform(self.key) < 0.5 else _POSITIONS
            targets = {n: r for n, r in targets.items() if not n.endswith(without)}
        stream = f"{STREAM}/{self.key}"
        return {name: Draw(region, stream=stream) for name, region in targets.items()}

    def targets(self, declaration: Declaration) -> dict[str, SpaceName | Space]:
        """Name the variables, each with the region that it is drawn from.

        A variable that a pattern names has to have the region; of a group, those are left out
        that have none.

        Raises:
            UnknownVariable: A pattern names nothing.
            InterventionError: A variable does not have the space, or the region is impossible.
        """
        model = declaration.model
        left_out = set(matching(declaration, self.besides))
        found: dict[str, SpaceName | Space] = {}
        for pattern in self.what:
            for name in matching(declaration, (pattern,)):
                variable = model.declared(name)
                region = self._region(name)
                missing = isinstance(region, str) and variable.space(region) is None
                if name in left_out or region is None or (missing and pattern.startswith("@")):
                    continue
                check_region(variable, region)
                found[name] = region
        return found

    def _region(self, name: str) -> SpaceName | Space | None:
        return self.space.region(name) if isinstance(self.space, Subset) else self.space


_SIZES = (".size", "block_size", "_dims")
_POSITIONS = (".cylindrical_position",)


@final
class Goal(Part):
    """Draw a new goal, as the task draws goals.

    Attributes:
        space: Where from.
        besides: Causes of the goal that are left as they are.
    """

    kind: Literal["goal"] = "goal"
    space: SpaceName = "A"
    besides: tuple[str, ...] = ()

    def acts(self, situation: Situation) -> Acts:
        """Draw, where it is due."""
        if not situation.due:
            return {}
        stream = f"{STREAM}/{self.key}"
        drawn = situation.declaration.task.sample_goal(self.space)
        return {
            name: act.model_copy(update={"stream": stream}) if isinstance(act, Draw) else act
            for name, act in drawn.items()
            if name not in self.besides
        }


@final
class Interpolate(Part):
    """Go from one setting to another, in equal steps from episode to episode.

    Attributes:
        stop: Where it ends, by variable.
        start: Where it begins; what the variable would be without it, if nothing is given.
        episodes: After how many episodes it is there.
        first: In which episode it begins.

    Example:
        >>> Interpolate({"block.size": [0.09, 0.09, 0.09]}, episodes=1_000).episodes
        1000
    """

    kind: Literal["interpolate"] = "interpolate"
    stop: dict[str, float | tuple[float, ...]]
    start: dict[str, float | tuple[float, ...]] = Field(default_factory=dict)
    episodes: int
    first: int = 0

    def __init__(self, stop: Mapping[str, Any], **fields: Any) -> None:
        fields["start"] = _plain(fields.get("start", {}))
        super().__init__(stop=_plain(stop), **fields)  # type: ignore[call-arg]
        if self.episodes < 1:
            raise UnknownOption("episodes", self.episodes, ("any whole number from 1 on",))
        for name in self.start.keys() - self.stop.keys():
            raise UnknownOption("start", name, self.stop)

    def acts(self, situation: Situation) -> Acts:
        """Give the values between the two."""
        if not situation.due:
            return {}
        share = min(max((situation.episode - self.first) / self.episodes, 0.0), 1.0)
        return {name: self._between(situation, name, share) for name in self.stop}

    def _between(self, situation: Situation, name: str, share: float) -> Any:
        variable = situation.declaration.model.declared(name)
        begin = self.start.get(name)
        one = situation.world[name] if begin is None else variable.array(begin)
        other = variable.array(self.stop[name])
        if isinstance(variable.bounds, Rotations):
            other = other if float(np.dot(one, other)) >= 0.0 else -other
        between = (1.0 - share) * one + share * other
        if isinstance(variable.bounds, Rotations):
            between = variable.bounds.nearest(between)
        if variable.dtype == "categorical":
            between = one if share < 0.5 else other
        return np.rint(between).astype(np.int64) if variable.dtype != "real" else between


def _plain(request: Mapping[str, Any]) -> dict[str, Any]:
    flat = flatten(request)
    return {
        name: tuple(np.ravel(value).tolist()) if np.ndim(value) else float(value)
        for name, value in flat.items()
    }


@final
class Follow(Part):
    """Do what a function says.

    Attributes:
        function: Takes the ``Situation``, and gives an intervention: acts or values by name.
            Random numbers come from ``situation.generator(key)``.
    """

    kind: Literal["follow"] = "follow"
    function: AsMechanism

    def __init__(self, function: Any, **fields: Any) -> None:
        super().__init__(function=function, **fields)  # type: ignore[call-arg]

    def acts(self, situation: Situation) -> Acts:
        """Ask the function, where it is due.

        Raises:
            UnknownOption: It gave no intervention.
        """
        if not situation.due:
            return {}
        given = self.function.bind()(situation)
        if given is None:
            return {}
        if not isinstance(given, Mapping):
            raise UnknownOption("intervention of a function", given, ("values by name", "None"))
        return {name: as_act(value) for name, value in flatten(given).items()}

    def functions(self) -> Iterator[Function]:
        """Give the function."""
        if not isinstance(self.function, Linear):
            yield self.function


def check_names(parts: Iterable[Part], declaration: Declaration) -> None:
    """Look for names that do not exist, before any episode begins.

    Args:
        parts: All of a curriculum.
        declaration: Of the structure in which episodes begin.

    Raises:
        InterventionError: A name stands for nothing, or a region is impossible.
    """
    model = declaration.model
    for part in parts:
        if isinstance(part, Resample):
            part.targets(declaration)
        names = {**getattr(part, "stop", {}), **getattr(part, "request", {})}
        for name in names:
            if name not in model and name not in declaration.entity_names:
                raise UnknownVariable(name, model)
            if isinstance(part, Interpolate):
                _check_end(part, name, declaration)


def _check_end(part: Interpolate, name: str, declaration: Declaration) -> None:
    """Refuse an end that a variable cannot reach."""
    for given in (part.start.get(name), part.stop[name]):
        if given is not None:
            model = declaration.model
            shaped = np.reshape(given, model.declared(name).shape) if np.ndim(given) else given
            try:
                model.accept(name, shaped)
            except InterventionError:
                raise
