"""Parts of the parameter space: which variables may vary, and where each of them may lie.

The training and the evaluation space of a study are two such values::

    training = A["tool_block.*", "goal_block.*"]
    evaluation = training * B["*.mass"]  # the masses alone are held out
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, final

from scm_world._patterns import fits
from scm_world.errors import UnknownOption
from scm_world.variables.kinds import SPACES, SpaceName
from scm_world.variables.spaces import Frozen, Space, refuse_infinite

Region = SpaceName | Space
"""A declared space by its name, or a custom set."""


@final
class Subset(Frozen):
    """A subset of the parameter space: which variables may vary, and where each may lie.

    Every part has a pattern of names (``*`` and ``?`` stand for any letters) and their region: a
    declared space by its name, a custom set, or None if they are not to be set. For each variable
    the last part counts whose pattern fits its name; a variable that none fits is not to be set.

    Attributes:
        parts: Pairs of a pattern and a region, in their order.

    Example:
        >>> half = A["tool_block.*"] * B["goal_block.*"]
        >>> half.region("tool_block.mass"), half.region("goal_block.polar"), half.region("gravity")
        ('A', 'B', None)
        >>> swapped = A.swap("*.mass", B) - "joint_positions"
        >>> swapped.region("tool_block.mass"), swapped.region("joint_positions")
        ('B', None)
        >>> Subset.model_validate_json(swapped.model_dump_json()) == swapped
        True
    """

    parts: tuple[tuple[str, Region | None], ...]

    def __init__(
        self,
        parts: str | Mapping[str, object] | Iterable[tuple[str, object]] = (),
        **fields: object,
    ) -> None:
        if isinstance(parts, str):
            parts = {"*": parts}
        pairs = parts.items() if isinstance(parts, Mapping) else parts
        super().__init__(parts=tuple(_pair(pair) for pair in pairs), **fields)

    def region(self, name: str) -> Region | None:
        """Return where a variable may lie; None where it is not to be set."""
        for pattern, region in reversed(self.parts):
            if fits(name, (pattern,)):
                return region
        return None

    def __getitem__(self, patterns: str | tuple[str, ...]) -> Subset:
        """Restrict it to the variables that patterns name."""
        if len(self.parts) != 1 or self.parts[0][0] != "*":
            raise UnknownOption("restriction of", self, ("A", "B", "AB: one region for all"))
        return Subset([(pattern, self.parts[0][1]) for pattern in _patterns(patterns)])

    def __mul__(self, other: Subset) -> Subset:
        """Return the product of two parts; where both name a variable, the second one counts."""
        return Subset((*self.parts, *other.parts))

    def __sub__(self, patterns: str | tuple[str, ...]) -> Subset:
        """Exclude variables: they are not to be set."""
        return self * Subset([(pattern, None) for pattern in _patterns(patterns)])

    def swap(self, patterns: str | tuple[str, ...], other: Subset | str | Space) -> Subset:
        """Return a subset in which the named variables lie in another one, or in a region."""
        where = other if isinstance(other, Subset) else Subset({"*": other})
        return self * where[patterns]

    def unused(self, names: Iterable[str]) -> Iterator[str]:
        """List the patterns that fit none of some names."""
        known = tuple(names)
        for pattern, _ in self.parts:
            if not any(fits(name, (pattern,)) for name in known):
                yield pattern

    def __str__(self) -> str:
        regions = ("∅" if region is None else region for _, region in self.parts)
        words = (one if isinstance(one, str) else repr(one) for one in regions)
        return " × ".join(f"{word}[{self.parts[i][0]}]" for i, word in enumerate(words))


def _pair(pair: tuple[str, object]) -> tuple[str, Any]:
    pattern, region = pair
    if isinstance(region, str) and region not in SPACES:
        raise UnknownOption(f"region of {pattern}", region, (*SPACES, "a set, such as a Box"))
    return pattern, refuse_infinite(f"region of {pattern}", region)


def _patterns(given: str | tuple[str, ...]) -> tuple[str, ...]:
    return (given,) if isinstance(given, str) else tuple(given)


A = Subset("A")
"""The training space of every variable."""
B = Subset("B")
"""The held-out space of every variable."""
AB = Subset("A|B")
"""The union of the two."""

AnyRegion = SpaceName | Subset
"""A space that interventions have to lie in."""


def as_region(option: str, given: object) -> AnyRegion | None:
    """Read a space that interventions have to lie in: a name, a subset, or its parts, or None."""
    if given is None or isinstance(given, Subset) or (isinstance(given, str) and given in SPACES):
        return given
    if isinstance(given, Mapping) and given.keys() == {"parts"}:
        given = given["parts"]
    if isinstance(given, Mapping | list | tuple):
        try:
            return Subset(given)
        except (TypeError, ValueError) as error:
            raise UnknownOption(option, given, (f"patterns with regions; {error}",)) from None
    raise UnknownOption(option, given, (*SPACES, "a Subset, or patterns with regions"))
