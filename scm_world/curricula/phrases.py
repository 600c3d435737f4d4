"""Words for parts of curricula, so that a curriculum reads like a sentence."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from scm_world.curricula.moves import Follow, Interpolate
from scm_world.curricula.parts import Goal, Resample
from scm_world.variables.kinds import SpaceName


def resample(what: Any, space: Any = "A", *, besides: Any = ()) -> Resample:
    """Draw variables anew.

    Args:
        what: Names, patterns with ``*``, or groups such as ``"@looks"``; one or several.
        space: ``"A"``, ``"B"``, ``"A|B"``, a distribution such as a ``Box``, or a ``Subset``.
        besides: What is left as it is, likewise.

    Raises:
        UnknownOption: There is no such space.

    Example:
        >>> resample(["*.mass", "floor_friction"], "B").space
        'B'
    """
    return Resample(what, space=space, besides=besides)


def goals(space: SpaceName = "A", *, besides: Any = ()) -> Goal:
    """Draw a new goal, as the task draws goals.

    Args:
        space: ``"A"``, ``"B"`` or ``"A|B"``.
        besides: Causes of the goal that are left as they are.

    Raises:
        UnknownOption: There is no such space.
    """
    return Goal(space, besides=besides)


def poses(space: Any = "A") -> Resample:
    """Draw where the blocks are, and how they are turned."""
    return resample("@poses", space)


def physics(space: Any = "A") -> Resample:
    """Draw masses, frictions, gravity and all else that changes how things move."""
    return resample("@physics", space)


def looks(space: Any = "A") -> Resample:
    """Draw colors, lights and cameras."""
    return resample("@looks", space)


def joints(space: Any = "A") -> Resample:
    """Draw where the fingers are."""
    return resample("@joints", space)


def everything(space: Any = "A", *, besides: Any = ()) -> Resample:
    """Draw every variable that has the space, except the settings of the engine."""
    return resample("@everything", space, besides=besides)


def interpolate(
    stop: Mapping[str, Any],
    *,
    episodes: int,
    start: Mapping[str, Any] | None = None,
    first: int = 0,
) -> Interpolate:
    """Go from one setting of a task to another, in equal steps from episode to episode.

    Args:
        stop: Where it ends, by variable.
        episodes: After how many episodes it is there.
        start: Where it begins; the defaults if None.
        first: In which episode it begins.

    Raises:
        UnknownOption: Something begins that does not end, or the number of episodes is none.
    """
    return Interpolate(stop, start=start or {}, episodes=episodes, first=first)


def follow(function: Any) -> Follow:
    """Do what a function of the situation says.

    Args:
        function: Takes a ``Situation`` and gives values or acts by name; or ``"module:name"``.
    """
    return Follow(function)
