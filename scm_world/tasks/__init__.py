"""Goal families: what stands in the world and what counts."""

from __future__ import annotations

from typing import Any

from scm_world.errors import UnknownOption
from scm_world.tasks.base import Task
from scm_world.tasks.building import Building
from scm_world.tasks.conventions import CONVENTIONS, Conventions, conventions
from scm_world.tasks.observed import HEAD, TIME, Observed
from scm_world.tasks.pushing import Pushing
from scm_world.tasks.reaching import Reaching
from scm_world.tasks.rewards import Common, term

TASKS: dict[str, type[Task]] = {task.name: task for task in (Reaching, Pushing)}
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
    "Observed",
    "Pushing",
    "Reaching",
    "Task",
    "conventions",
    "make_task",
    "term",
]
