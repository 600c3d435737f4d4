"""Arguments of an environment, read and checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from scm_world._types import Floats
from scm_world.errors import ActionError, UnknownOption
from scm_world.tasks import Task, make_task
from scm_world.world import World
from scm_world.world.structures import StructureCache


def finite(size: int) -> str:
    """Say what an action of so many numbers is, for messages."""
    return "a finite number" if size == 1 else f"{size} finite numbers"


def doubles(action: Any, size: int) -> Floats:
    """Read an action.

    Args:
        action: What was given.
        size: How many numbers it should be, for the message.

    Raises:
        ActionError: It is no numbers.
    """
    try:
        return np.asarray(action, dtype=np.float64)
    except (TypeError, ValueError):
        raise ActionError(f"an action is {finite(size)}, got {action!r}", action) from None


def action_scale(world: World) -> tuple[Floats, Floats]:
    """Give what normalized actions stand for: ``middle + half * action``, shape (n_actions,) each.

    What has no two bounds keeps its unit.
    """
    low, high = world.action_low, world.action_high
    bounded = np.isfinite(low) & np.isfinite(high) & (low < high)
    low, high = np.where(bounded, low, -1.0), np.where(bounded, high, 1.0)
    return (low + high) / 2.0, (high - low) / 2.0


def names_of(option: str, given: Sequence[str]) -> tuple[str, ...]:
    """Read a list of names.

    Raises:
        UnknownOption: It is one text.
    """
    if isinstance(given, str):
        raise UnknownOption(option, given, (f"a list of names, such as [{given!r}]",))
    return tuple(given)


def made_task(
    task: Task | StructureCache | str, options: Mapping[str, Any] | None
) -> Task | StructureCache:
    """Make a task of a name, with its options; or take one, or its structures.

    Raises:
        UnknownOption: There are options for a task that is made.
    """
    if isinstance(task, str):
        return make_task(task, **(options or {}))
    if options:
        raise UnknownOption("task_options", dict(options), ("none, with a task that is made",))
    return task
