"""Parts of curricula that act: draws, interpolations between settings, functions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Literal, final
from weakref import WeakKeyDictionary

import numpy as np
from pydantic import Field

from scm_world._arguments import one_of, whole_number
from scm_world._types import Value
from scm_world.curricula.base import STREAM, Part, Situation, words
from scm_world.curricula.targets import matching
from scm_world.errors import InterventionError, UnknownOption, UnknownVariable, blamed
from scm_world.geometry.rotations import (
    from_rotation_vector,
    quaternion_product,
    to_rotation_vector,
)
from scm_world.graph import flatten
from scm_world.queries.plans import Plan
from scm_world.variables import (
    Box,
    Continuous,
    Cylinder,
    Discrete,
    Distribution,
    Draw,
    Function,
    Normal,
    Rotations,
    Subset,
    Variable,
)
from scm_world.variables.checks import check_draw, check_region
from scm_world.variables.kinds import SPACES, AsMechanism, SpaceName
from scm_world.variables.mechanisms import Linear
from scm_world.variables.spaces import Frozen, refuse_infinite
from scm_world.world.compiled_task import CompiledTask


@final
class Resample(Part):
    """Draw variables again; ``resample`` in a sentence.

    Attributes:
        what: Names, patterns with ``*``, or groups such as ``"@looks"``; one or several.
        space: Where they are drawn from: ``"A"``, ``"B"``, ``"A|B"``, a distribution such as a
            ``Box``, or a ``Subset``, which may have another region for each of them.
        besides: Patterns of what is left as it is.
        exclusive: Whether a fair coin decides if sizes or positions of blocks are drawn, as the
            predecessor has it, instead of both.

    Raises:
        UnknownOption: A name is no word, or there is no such space.

    Example:
        >>> Resample(["*.mass", "floor_friction"], "B").space
        'B'
    """

    kind: Literal["resample"] = "resample"
    what: tuple[str, ...]
    space: SpaceName | Subset | Distribution = "A"
    besides: tuple[str, ...] = ()
    exclusive: bool = False

    def __init__(self, what: Any, space: Any = "A", **fields: Any) -> None:
        fields["besides"] = words("besides", fields.get("besides", ()))
        if not (isinstance(space, Frozen | dict) or space in SPACES):
            raise UnknownOption("space", space, (*SPACES, "a Subset", "a distribution"))
        refuse_infinite("space", space)
        named = words("what", what)
        if not named:
            raise UnknownOption("what", what, ("a name or a pattern", "several of them"))
        super().__init__(what=named, space=space, **fields)

    def acts(self, situation: Situation) -> Mapping[str, Any]:
        """Return the draws, which are the same whenever a structure comes again."""
        kept = _DRAWS.setdefault(situation.compiled, {})
        word = (self.key, situation.first is None)
        if word not in kept:
            stream = f"{STREAM}/{self.key}"
            regions = self.targets(situation.compiled, situation.first).items()
            draws = {name: (Draw(region, stream=stream),) for name, region in regions}
            kept[word] = Plan.of(draws)
        if not self.exclusive:
            return kept[word]
        without = _SIZES if situation.uniform(self.key) < 0.5 else _POSITIONS
        return {name: acts for name, acts in kept[word].items() if not name.endswith(without)}

    def check(self, compiled: CompiledTask) -> None:
        """Look for names that do not exist and regions that are impossible."""
        self.targets(compiled)

    def targets(
        self, compiled: CompiledTask, among: frozenset[str] | None = None
    ) -> dict[str, SpaceName | Distribution]:
        """Name the variables, each with the region that it is drawn from.

        A variable that a pattern names has to have the region; of a group, those are left out
        that have none.

        Args:
            compiled: The structure.
            among: Look for these only, and do without patterns that name none; for all if None.

        Raises:
            UnknownVariable: A pattern names nothing.
            InterventionError: A variable does not have the space, or the region is impossible.
        """
        left_out = set(self._matching(compiled, self.besides, among))
        found: dict[str, SpaceName | Distribution] = {}
        for pattern in self.what:
            for name in self._matching(compiled, (pattern,), among):
                variable = compiled.model.declared(name)
                region = self._region(name)
                missing = isinstance(region, str) and variable.space(region) is None
                if name in left_out or region is None or (missing and pattern.startswith("@")):
                    continue
                _check(variable, region)
                found[name] = region
        return found

    def _matching(
        self, compiled: CompiledTask, patterns: tuple[str, ...], among: frozenset[str] | None
    ) -> tuple[str, ...]:
        if among is None:
            return matching(compiled, patterns)
        found: list[str] = []
        for pattern in patterns:
            try:
                found += matching(compiled, (pattern,))
            except UnknownVariable:  # perhaps it names what is there afterwards
                continue
        return tuple(name for name in found if name in among)

    def _region(self, name: str) -> SpaceName | Distribution | None:
        return self.space.region(name) if isinstance(self.space, Subset) else self.space


_SIZES = (".size", "block_size", "_dims")
_POSITIONS = (".cylindrical_position",)
_DRAWS: WeakKeyDictionary[CompiledTask, dict[tuple[str, bool], Plan]] = WeakKeyDictionary()


def _check(variable: Variable, region: SpaceName | Distribution) -> None:
    """Refuse a region in which a variable cannot lie."""
    if variable.dtype != "real" and isinstance(region, Box | Cylinder | Normal | Continuous):
        raise InterventionError(
            f"{variable.name!r} is a whole number, and {region!r} has others; draw it from "
            "Integers(low, high), Categories([…]) or a declared space",
            variable=variable.name,
            value=region,
        )
    if isinstance(region, Normal | Cylinder | Continuous | Discrete):
        check_draw(variable, Draw(region))
    else:
        check_region(variable, region)


@final
class NewGoal(Part):
    """Draw a new goal, as the task draws goals; ``goals`` in a sentence.

    Attributes:
        space: ``"A"``, ``"B"`` or ``"A|B"``.
        besides: Causes of the goal that are left as they are.

    Raises:
        UnknownOption: There is no such space.
    """

    kind: Literal["goal"] = "goal"
    space: SpaceName = "A"
    besides: tuple[str, ...] = ()

    def __init__(self, space: Any = "A", **fields: Any) -> None:
        one_of("space", space, SPACES)
        fields["besides"] = words("besides", fields.get("besides", ()))
        super().__init__(space=space, **fields)

    def acts(self, situation: Situation) -> Mapping[str, Any]:
        """Return the draws of the goal's causes."""
        stream = f"{STREAM}/{self.key}"
        drawn = situation.compiled.task.sample_goal(self.space)
        return {
            name: act.model_copy(update={"stream": stream}) if isinstance(act, Draw) else act
            for name, act in drawn.items()
            if name not in self.besides
        }

    def check(self, compiled: CompiledTask) -> None:
        """Look for causes that the goal does not have.

        Raises:
            UnknownOption: The task has no goals.
        """
        causes, task = compiled.task.sample_goal(self.space), compiled.task.name
        if not causes:
            allowed = (f"a task with goals; draw variables of {task} by resample",)
            raise UnknownOption("task for goals", task, allowed)
        for name in self.besides:
            if name not in causes:
                raise UnknownVariable(name, causes)


@final
class Interpolate(Part):
    """Go from one setting to another, in equal steps from episode to episode; ``interpolate``.

    Whole numbers are rounded, categories change in the middle, and a quaternion turns about one
    axis, the shorter way round.

    Attributes:
        stop: Where it ends, by variable.
        start: Where it begins; its value in an episode without interventions if not given.
        episodes: After how many episodes it is there.
        first: In which episode it begins.

    Raises:
        UnknownOption: Something begins that does not end, a value is no number, or a number of
            episodes is none.

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
        fields["start"] = _plain("start", fields.get("start") or {})
        fields["episodes"] = whole_number("episodes", fields.get("episodes"), least=1)
        fields["first"] = whole_number("first", fields.get("first", 0), least=0)
        super().__init__(stop=_plain("stop", stop), **fields)
        for name in self.start.keys() - self.stop.keys():
            raise UnknownOption("start", name, self.stop)

    def acts(self, situation: Situation) -> Mapping[str, Any]:
        """Return the values between the two."""
        share = min(max((situation.episode - self.first) / self.episodes, 0.0), 1.0)
        names = [n for n in self.stop if situation.first is None or n in situation.first]
        return {name: self._between(situation, name, share) for name in names}

    def _between(self, situation: Situation, name: str, share: float) -> Value:
        variable = situation.compiled.model.declared(name)
        begin = self.start.get(name)
        one = situation.natural(name) if begin is None else variable.array(begin)
        if one is None:
            allowed = (f"a value for {name!r}, which is computed from others",)
            raise UnknownOption("start of an interpolation", None, allowed)
        other = variable.array(self.stop[name])
        if isinstance(variable.bounds, Rotations):
            return _turned(one, other, share)
        if variable.dtype == "categorical":
            return one if share < 0.5 else other
        between = (1.0 - share) * one + share * other
        return np.asarray(
            np.rint(between).astype(np.int64) if variable.dtype != "real" else between
        )

    def check(self, compiled: CompiledTask) -> None:
        """Look for names that do not exist and ends that a variable cannot reach."""
        model = compiled.model
        for name, stop in self.stop.items():
            for given in (self.start.get(name), stop):
                if given is not None:
                    model.accept(name, _shaped(model.declared(name), given))


def _turned(one: Value, other: Value, share: float) -> Value:
    """Turn from one quaternion towards another, by a share of the angle between them."""
    back = one * np.array([-1.0, -1.0, -1.0, 1.0]) / np.sum(one * one)  # the inverse of one
    turn = to_rotation_vector(quaternion_product(other, back))
    between = quaternion_product(from_rotation_vector(share * turn), one)
    return np.asarray(Rotations().nearest(between))


def _shaped(variable: Variable, given: Any) -> Any:
    fits = np.size(given) == int(np.prod(variable.shape)) and np.ndim(given)
    return np.reshape(given, variable.shape) if fits else given


def _plain(option: str, request: Mapping[str, Any]) -> dict[str, Any]:
    flat = flatten(request)
    try:
        return {
            name: tuple(map(float, np.ravel(value))) if np.ndim(value) else float(value)
            for name, value in flat.items()
        }
    except (TypeError, ValueError):
        allowed = ("numbers and arrays of numbers, by variable",)
        raise UnknownOption(f"{option} of an interpolation", request, allowed) from None


@final
class Follow(Part):
    """Follow the plan that a function returns; ``follow`` in a sentence.

    Attributes:
        function: Takes the ``Situation``, and returns a plan of the episode: values or
            interventions by name, which may have times; None for nothing. Random numbers come from
            ``situation.generator(key)``. Where bodies come and go it is asked twice: first for
            what decides that, then for all.

    Raises:
        UnknownOption: It is no function.
    """

    kind: Literal["follow"] = "follow"
    function: AsMechanism

    def __init__(self, function: Any, **fields: Any) -> None:
        if not (callable(function) or isinstance(function, Function | str | dict)):
            allowed = ("a function of the situation", "its name: 'module:name'")
            raise UnknownOption("function of a curriculum", function, allowed)
        named = Function(function) if isinstance(function, str) else function
        super().__init__(function=named, **fields)
        if isinstance(self.function, Linear):
            raise UnknownOption("function of a curriculum", self.function, ("a Function",))

    def acts(self, situation: Situation) -> Mapping[str, Any]:
        """Ask the function.

        Raises:
            UnknownOption: It gave no intervention.
            FunctionFailure: It raised an error.
        """
        function: Any = self.function
        with blamed(f"the function {function.reference!r} of a curriculum"):
            given = function.bind()(situation)
        if given is None:
            return {}
        if not isinstance(given, Mapping):
            raise UnknownOption("intervention of a function", given, ("values by name", "None"))
        return given

    def functions(self) -> Iterator[Function]:
        """Give the function."""
        if isinstance(self.function, Function):
            yield self.function


resample, goals, interpolate, follow = Resample, NewGoal, Interpolate, Follow


def poses(space: Any = "A") -> Resample:
    """Draw where the blocks are, and how they are turned."""
    return Resample("@poses", space)


def physics(space: Any = "A") -> Resample:
    """Draw masses, frictions, gravity and all else that changes how things move."""
    return Resample("@physics", space)


def looks(space: Any = "A") -> Resample:
    """Draw colors, lights and cameras."""
    return Resample("@looks", space)


def joints(space: Any = "A") -> Resample:
    """Draw where the fingers are."""
    return Resample("@joints", space)


def everything(space: Any = "A", *, besides: Any = ()) -> Resample:
    """Draw every variable that has the space, except the settings of the engine."""
    return Resample("@everything", space, besides=besides)
