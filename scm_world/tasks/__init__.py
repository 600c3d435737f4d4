"""Goal families: what stands in the world and what counts."""

from __future__ import annotations

from typing import Any

from scm_world.errors import UnknownOption
from scm_world.tasks.base import Task
from scm_world.tasks.building import Building
from scm_world.tasks.conventions import CONVENTIONS, Conventions, conventions
from scm_world.tasks.creative_stacked_blocks import CreativeStackedBlocks
from scm_world.tasks.general import General
from scm_world.tasks.observed import HEAD, TIME, Observed
from scm_world.tasks.pick_and_place import PickAndPlace
from scm_world.tasks.picking import Picking
from scm_world.tasks.pushing import Pushing
from scm_world.tasks.reaching import Reaching
from scm_world.tasks.rewards import Common, term
from scm_world.tasks.stacked_blocks import StackedBlocks
from scm_world.tasks.stacking2 import Stacking2
from scm_world.tasks.towers import Towers

TASKS: dict[str, type[Task]] = {
    task.name: task
    for task in (
        Reaching,
        Pushing,
        Picking,
        PickAndPlace,
        Stacking2,
        Towers,
        StackedBlocks,
        CreativeStackedBlocks,
        General,
    )
}
"""Every registered task, by name."""


def make_task(name: str, **options: Any) -> Task:
    """Create a registered task.

    Args:
        name: One of ``TASKS``.
        options: Arguments of its constructor.

    Raises:
        UnknownOption: There is no such task.
    """
    try:
        task = TASKS[name]
    except KeyError:
        raise UnknownOption("task", name, TASKS) from None
    return task(**options)


__all__ = [
    "CONVENTIONS",
    "HEAD",
    "TASKS",
    "TIME",
    "Building",
    "Common",
    "Conventions",
    "CreativeStackedBlocks",
    "General",
    "Observed",
    "PickAndPlace",
    "Picking",
    "Pushing",
    "Reaching",
    "StackedBlocks",
    "Stacking2",
    "Task",
    "Towers",
    "conventions",
    "make_task",
    "term",
]
