"""The predecessor's intervention actors, and the 4-tuples that say when they act.

Source:
    CausalWorld 1.2, ``intervention_actors`` and ``curriculum``.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from scm_world._arguments import one_of
from scm_world.curricula.base import Do, Part
from scm_world.curricula.combinations import AtStep, During, together
from scm_world.curricula.parts import Goal, Resample
from scm_world.errors import UnknownOption
from scm_world.variables.kinds import SPACES, SpaceName

ALL = ("@published",)
ACTORS = (
    "base_actor",
    "goal_actor",
    "joints_actor",
    "physical_properties_actor",
    "random_actor",
    "rigid_pose_actor",
    "visual_actor",
)
"""Their names in files of the predecessor."""


def published_actor(
    name: str,
    *,
    space: SpaceName = "A|B",
    group: str = "tool",
    positions: bool = True,
    orientations: bool = True,
) -> Part:
    """Give what an actor of the predecessor does.

    Args:
        name: One of ``ACTORS``. ``random_actor`` draws everything, and leaves it to a coin
            whether sizes or positions are drawn; ``joints_actor`` draws the joints from their
            space (there from anywhere, so that most draws were refused).
        space: The active space; ``"A|B"`` is the default there.
        group: Of the physical properties: ``"robot"``, ``"stage"``, ``"floor"`` or ``"tool"``.
        positions: Whether the pose actor draws positions.
        orientations: Whether it draws orientations.

    Raises:
        UnknownOption: There is no such actor, group or space.

    Example:
        >>> published_actor("visual_actor", space="A").what
        ('*color',)
    """
    one_of("space", space, SPACES)
    match name:
        case "base_actor":
            return Do({})
        case "goal_actor":
            return Goal(space=space)
        case "joints_actor":
            return Resample("@joints", space=space)
        case "physical_properties_actor":
            one_of("group", group, _PROPERTIES)
            return Resample(_PROPERTIES[group], space=space)
        case "random_actor":
            return Resample(ALL, space=space, exclusive=True)
        case "rigid_pose_actor":
            chosen = (positions, orientations)
            pairs = zip(chosen, ("cylindrical_position", "euler_orientation"), strict=True)
            return Resample([f"tool_*.{what}" for wanted, what in pairs if wanted], space=space)
        case "visual_actor":
            return Resample("*color", space=space)
    raise UnknownOption("actor", name, ACTORS)


_PROPERTIES = {
    "floor": "floor_friction",
    "robot": "robot_finger_*.mass",
    "stage": "stage_friction",
    "tool": "tool_*.mass",
}


def active(part: Any, actives: Iterable[float]) -> Part:
    """Let a part act when a 4-tuple says so.

    Args:
        part: What acts.
        actives: First episode, last episode (which counts), period in episodes, control step.

    Raises:
        UnknownOption: These are not four whole numbers, or out of order.

    Example:
        >>> active({"floor_friction": 0.4}, (0, 1e9, 2, 0)).part.period
        2
    """
    given = tuple(actives)
    whole = len(given) == 4 and all(_is_count(number) for number in given)
    if not whole or given[2] < 1 or given[1] < given[0]:
        allowed = ("(first episode, last episode, period, control step), whole numbers",)
        raise UnknownOption("actives", given, allowed)
    first, last, period, step = map(int, given)
    return AtStep(step, During(range(first, last + 1, period), part))


def _is_count(number: Any) -> bool:
    is_number = isinstance(number, int | float | np.integer) and not isinstance(number, bool)
    return is_number and 0 <= number < float("inf") and number == int(number)


def published_curriculum(
    actors: Iterable[Any], actives: Iterable[Iterable[float]], *, space: SpaceName = "A|B"
) -> Part:
    """Put actors and their 4-tuples together, as the predecessor's wrapper takes them.

    Args:
        actors: Names of ``ACTORS``, or parts.
        actives: A 4-tuple for each; see ``active``.
        space: The active space, for actors that are given by name.

    Raises:
        UnknownOption: There are not as many of both, or one is wrong.

    Example:
        >>> both = published_curriculum(["goal_actor"], [ALWAYS])
        >>> both.of[0].part.part.kind
        'goal'
    """
    parts, times = list(actors), list(actives)
    if len(parts) != len(times):
        allowed = (f"one for each of the {len(parts)} actors",)
        raise UnknownOption("number of actives", len(times), allowed)
    made = [published_actor(p, space=space) if isinstance(p, str) else p for p in parts]
    return together(*map(active, made, times))


ALWAYS = (0, 1e9, 1, 0)
"""At every reset."""
