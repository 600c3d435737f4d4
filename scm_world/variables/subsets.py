"""Parts of the parameter space: which variables may vary, and where each of them may lie.

The training and the evaluation space of a study are two such values::

    training = A["tool_block.*", "goal_block.*"]
    evaluation = training * B["*.mass"]  # the masses alone are held out
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from fnmatch import fnmatchcase
from typing import Any, final

from scm_world.errors import UnknownOption
from scm_world.variables.kinds import SPACES, SpaceName
from scm_world.variables.spaces import Frozen, Space, refuse_infinite

Region = SpaceName | Space
"""A declared space by its name, or a custom set."""


@final
class Subset(Frozen):
    """A part of the parameter space.

    Every part names variables by a pattern (``*`` and ``?`` stand for any letters) and says where
    they may lie: in a declared space by its name, in a custom set, or nowhere (None): then
    they are not to be set. For each variable the last part counts whose pattern fits its name; a
    variable that none fits is not to be set.

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

    def __init__(self, parts: Any = (), **fields: Any) -> None:
        if isinstance(parts, str):
            parts = {"*": parts}
        pairs = parts.items() if isinstance(parts, Mapping) else parts
        super().__init__(parts=tuple(_pair(pair) for pair in pairs), **fields)

    def region(self, name: str) -> Region | None:
        """Return where a variable may lie; None where it is not to be set."""
        for pattern, region in reversed(self.parts):
            if fnmatchcase(name, pattern):
                return region
        return None

    def __getitem__(self, patterns: str | tuple[str, ...]) -> Subset:
        """Restrict it to the variables that patterns name."""
        wanted = _patterns(patterns)
        only = {pattern: region for pattern, region in self.parts if pattern == "*"}
        if len(self.parts) != 1 or not only:
            raise UnknownOption(
                "restriction of",
                self,
                (
                    "A",
                    "B",
                    "AB: one region for all",
                ),
            )
        return Subset([(pattern, only["*"]) for pattern in wanted])

    def __mul__(self, other: Subset) -> Subset:
        """Return the product of two parts; where both name a variable, the second one counts."""
        return Subset((*self.parts, *other.parts))

    def __sub__(self, patterns: str | tuple[str, ...]) -> Subset:
        """Leave variables out: they are not to be set."""
        return Subset((*self.parts, *((pattern, None) for pattern in _patterns(patterns))))

    def swap(self, patterns: str | tuple[str, ...], other: Subset | str | Space) -> Subset:
        """Return a subset in which some variables have other regions.

        Args:
            patterns: Names of variables, or patterns.
            other: Where they lie there: another part of the parameter space, or a region.
        """
        where = other if isinstance(other, Subset) else Subset({"*": other})
        return self * where[patterns]

    def unused(self, names: Iterable[str]) -> Iterator[str]:
        """List the patterns that fit none of some names."""
        known = tuple(names)
        for pattern, _ in self.parts:
            if not any(fnmatchcase(name, pattern) for name in known):
                yield pattern

    def __str__(self) -> str:
        return " × ".join(f"{_region(region)}[{pattern}]" for pattern, region in self.parts)


def _pair(pair: Any) -> tuple[str, Any]:
    pattern, region = pair
    if isinstance(region, str) and region not in SPACES:
        raise UnknownOption(f"region of {pattern}", region, (*SPACES, "a set, such as a Box"))
    refuse_infinite(f"region of {pattern}", region)
    return pattern, region


def _patterns(given: str | tuple[str, ...]) -> tuple[str, ...]:
    return (given,) if isinstance(given, str) else tuple(given)


def _region(region: Region | None) -> str:
    if region is None:
        return "∅"
    return region if isinstance(region, str) else repr(region)


A = Subset("A")
"""The training space of every variable."""
B = Subset("B")
"""The held-out space of every variable."""
AB = Subset("A|B")
"""The union of the two."""

AnyRegion = SpaceName | Subset
"""A space that interventions have to lie in."""


def as_region(option: str, given: Any) -> AnyRegion | None:
    """Read the space that interventions have to lie in: a name, a subset, or its parts.

    Args:
        option: Its name, for the error.
        given: ``"A"``, ``"B"``, ``"A|B"``, a ``Subset``, its patterns and regions, or None.

    Raises:
        UnknownOption: It is none of these.
    """
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
