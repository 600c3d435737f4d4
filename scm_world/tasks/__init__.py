"""Goal families: what stands in the world and what counts."""

from __future__ import annotations

import inspect
from typing import Any, TypeVar

from scm_world.errors import ModelError, UnknownOption
from scm_world.tasks.base import TIME, Observed, Task, Timing
from scm_world.tasks.conventions import CONVENTIONS, Conventions, conventions
from scm_world.tasks.model import ModelTask, model_task
from scm_world.tasks.rewards import Common, term
from scm_world.tasks.step import StepTask
from scm_world.tasks.trifinger.base import HEAD, TriFingerTask
from scm_world.tasks.trifinger.building import Building
from scm_world.tasks.trifinger.general import General
from scm_world.tasks.trifinger.pick_and_place import PickAndPlace
from scm_world.tasks.trifinger.picking import Picking
from scm_world.tasks.trifinger.pushing import Pushing
from scm_world.tasks.trifinger.reaching import Reaching
from scm_world.tasks.trifinger.stacking2 import Stacking2
from scm_world.tasks.trifinger.towers import Towers
from scm_world.tasks.trifinger.walls import CreativeStackedBlocks, StackedBlocks

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
"""The tasks of this package, by name."""

_REGISTERED: dict[str, type[Task]] = {}

Kind = TypeVar("Kind", bound=type[Task])


def register(kind: Kind) -> Kind:
    """Make a task of one's own known by its ``name``, wherever a task is named by a text.

    It can decorate the class. Processes that are started anew know it if the module that
    registers it is imported there: put it at the top level of that module.

    Args:
        kind: A class that passes ``scm_world.testing.task.TaskConformance``; every argument of it
            has a default.

    Returns:
        The same class.

    Raises:
        ModelError: It is no class of tasks, methods are missing, it has no name or no weights, or
            an argument has no default.
        UnknownOption: Another one has this name.
    """
    if not (inspect.isclass(kind) and issubclass(kind, Task)):
        raise ModelError([f"{kind!r} is no class derived from scm_world.tasks.Task"])
    missing = sorted(getattr(kind, "__abstractmethods__", ()))
    problems = [f"{kind.__name__} does not define {method!r}" for method in missing]
    name = getattr(kind, "name", None)
    if not isinstance(name, str) or not name:
        problems.append(f"{kind.__name__} has no name; set name = 'mine' in the class")
    if issubclass(kind, TriFingerTask) and not hasattr(kind, "default_weights"):
        problems.append(f"{kind.__name__} has no default_weights; set them in the class")
    problems += [
        f"{kind.__name__} has no default for {parameter.name!r}"
        for parameter in inspect.signature(kind.__init__).parameters.values()
        if parameter.kind is parameter.KEYWORD_ONLY and parameter.default is parameter.empty
    ]
    if problems:
        raise ModelError(problems)
    if kind.name in TASKS or not _same(_REGISTERED.get(kind.name, kind), kind):
        raise UnknownOption("name of a task", kind.name, ("a name that is not taken",))
    _REGISTERED[kind.name] = kind
    return kind


def _same(one: type, other: type) -> bool:
    """Say whether two classes are one, or one whose module was run again."""
    return (one.__module__, one.__qualname__) == (other.__module__, other.__qualname__)


def tasks() -> dict[str, type[Task]]:
    """Give all tasks that ``make_task`` knows: of this package, then those registered."""
    return {**TASKS, **_REGISTERED}


def make_task(name: str, **options: Any) -> Task:
    """Create a registered task, or that of a model.

    Args:
        name: One of ``tasks()``, a path to an MJCF or URDF file, or ``"module:function"`` for a
            function that gives a task.
        options: Arguments of its constructor.

    Raises:
        UnknownOption: There is no such task.
    """
    task = tasks().get(name)
    if task is None:
        return model_task(name, options, tasks)
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
    "ModelTask",
    "Observed",
    "PickAndPlace",
    "Picking",
    "Pushing",
    "Reaching",
    "StackedBlocks",
    "Stacking2",
    "StepTask",
    "Task",
    "Timing",
    "Towers",
    "TriFingerTask",
    "conventions",
    "make_task",
    "register",
    "tasks",
    "term",
]
