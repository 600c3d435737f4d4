"""Parts of curricula that go from one setting to another, and those that a user writes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Literal, final

import numpy as np
from pydantic import Field

from scm_world._arguments import whole_number
from scm_world._types import Value
from scm_world.curricula.base import Acts, Part, acts_of
from scm_world.curricula.situations import Situation
from scm_world.errors import UnknownOption
from scm_world.geometry.rotations import (
    from_rotation_vector,
    quaternion_inverse,
    quaternion_product,
    to_rotation_vector,
)
from scm_world.graph import flatten
from scm_world.variables import Function, Rotations, Variable
from scm_world.variables.kinds import AsMechanism
from scm_world.variables.mechanisms import Linear
from scm_world.world.compiled_task import CompiledTask


@final
class Interpolate(Part):
    """Go from one setting to another, in equal steps from episode to episode.

    Whole numbers are rounded, categories change in the middle, and a quaternion turns about one
    axis, the shorter way round.

    Attributes:
        stop: Where it ends, by variable.
        start: Where it begins; what the variable would be without it, if nothing is given.
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
        fields["start"] = _plain("start", fields.get("start", {}))
        fields["episodes"] = whole_number("episodes", fields.get("episodes"), least=1)
        fields["first"] = whole_number("first", fields.get("first", 0), least=0)
        super().__init__(stop=_plain("stop", stop), **fields)  # type: ignore[call-arg]
        for name in self.start.keys() - self.stop.keys():
            raise UnknownOption("start", name, self.stop)

    def acts(self, situation: Situation) -> Acts:
        """Give the values between the two."""
        if not situation.due:
            return {}
        share = min(max((situation.episode - self.first) / self.episodes, 0.0), 1.0)
        names = [n for n in self.stop if situation.first is None or n in situation.first]
        return {name: self._between(situation, name, share) for name in names}

    def _between(self, situation: Situation, name: str, share: float) -> Value:
        variable = situation.compiled.model.declared(name)
        begin = self.start.get(name)
        if begin is None:
            usual = situation.initial.get(name)
            one = situation.world[name] if usual is None else usual
        else:
            one = variable.array(begin)
        other = variable.array(self.stop[name])
        if isinstance(variable.bounds, Rotations):
            return _turned(one, other, share)
        if variable.dtype == "categorical":
            return one if share < 0.5 else other
        between = (1.0 - share) * one + share * other
        return np.asarray(
            np.rint(between).astype(np.int64) if variable.dtype != "real" else between
        )

    def names(self) -> Iterator[str]:
        """List what it sets."""
        yield from self.stop

    def declared(self, declaration: CompiledTask) -> None:
        """Look for names that do not exist and ends that a variable cannot reach."""
        model = declaration.model
        for name, stop in self.stop.items():
            for given in (self.start.get(name), stop):
                if given is not None:
                    model.accept(name, _shaped(model.declared(name), given))


def _turned(one: Value, other: Value, share: float) -> Value:
    """Turn from one quaternion towards another, by a share of the angle between them."""
    turn = to_rotation_vector(quaternion_product(other, quaternion_inverse(one)))
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
    """Do what a function says.

    Attributes:
        function: Takes the ``Situation``, and gives an intervention: acts or values by name.
            Random numbers come from ``situation.generator(key)``. Where bodies come and go it is
            asked twice: first for what decides that, then for the rest.

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
        super().__init__(function=named, **fields)  # type: ignore[call-arg]
        if isinstance(self.function, Linear):
            raise UnknownOption("function of a curriculum", self.function, ("a Function",))

    def acts(self, situation: Situation) -> Acts:
        """Ask the function, where it is due.

        Raises:
            UnknownOption: It gave no intervention.
        """
        if not situation.due:
            return {}
        function: Any = self.function.bind()
        given = function(situation)
        if given is None:
            return {}
        if not isinstance(given, Mapping):
            raise UnknownOption("intervention of a function", given, ("values by name", "None"))
        return acts_of(given)

    def names(self) -> Iterator[str]:
        """Say that it may set anything."""
        yield "*"

    def functions(self) -> Iterator[Function]:
        """Give the function."""
        if isinstance(self.function, Function):
            yield self.function
