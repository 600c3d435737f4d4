"""Tasks: goal families of the robot, models from files, and step functions."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

from scm_world._arguments import enter, typed
from scm_world.errors import UnknownOption, blamed
from scm_world.graph import SCM
from scm_world.tasks.base import TIME, Conventions, Goal, Observation, Observed, Options, Task
from scm_world.tasks.factories import is_model, load_factory
from scm_world.tasks.model import ModelTask
from scm_world.tasks.rewards import Common, term
from scm_world.tasks.step import StepTask
from scm_world.tasks.trifinger.base import HEAD, TriFingerTask
from scm_world.tasks.trifinger.building import Building, Towers
from scm_world.tasks.trifinger.conventions import CONVENTIONS
from scm_world.tasks.trifinger.general import General
from scm_world.tasks.trifinger.reaching import Reaching
from scm_world.tasks.trifinger.single import PickAndPlace, Picking, Pushing
from scm_world.tasks.trifinger.stacking2 import Stacking2
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
    """Register a custom task by its ``name``, for every place that takes the name of a task.

    It can decorate the class. New processes know it if the module that
    registers it is imported there: put it at the top level of that module.

    Args:
        kind: A class that passes ``scm_world.testing.task.TaskConformance``; every argument of it
            has a default.

    Returns:
        The same class.

    Raises:
        ModelError: It is not a class of tasks, methods are missing, it has no name or no weights,
            or an argument has no default.
        UnknownOption: Another one has this name.
    """

    def check(kind: type[Task]) -> Iterable[str]:
        if issubclass(kind, TriFingerTask) and not hasattr(kind, "default_weights"):
            yield f"{kind.__name__} has no default_weights; set them in the class"
        if issubclass(kind, Building) and not hasattr(kind, "piece"):
            yield f"{kind.__name__} has no piece; set it in the class"
        for parameter in inspect.signature(kind.__init__).parameters.values():
            if parameter.kind is parameter.KEYWORD_ONLY and parameter.default is parameter.empty:
                yield f"{kind.__name__} has no default for {parameter.name!r}"

    enter(_REGISTERED, kind, Task, what="task", taken=TASKS, check=check)
    return kind


def tasks() -> dict[str, type[Task]]:
    """Return all tasks that ``make_task`` knows: of this package, then those registered."""
    return {**TASKS, **_REGISTERED}


@typed
def make_task(name: str, **options: Any) -> Task:
    """Create a registered task, or that of a model.

    Args:
        name: One of ``tasks()``, XML text, a path to an MJCF or URDF file, or
            ``"module:function"`` for a function (of a module or a Python file) that returns a task
            or a model.
        options: Arguments of its constructor.

    Raises:
        UnknownOption: There is no such task.
        FunctionFailure: The function, or its module, raised an error.
    """
    if name in (known := tasks()):
        return known[name](**options)
    if is_model(name):
        return ModelTask(name, **options)
    if ":" in name:
        return made_by(load_factory(name), name, options)
    if name.endswith(".json"):
        raise _without_backend(name)
    raise UnknownOption("task", name, (*known, "file.xml", "file.urdf", "module:function"))


@typed
def made_by(factory: Callable[..., Any], name: str, options: Mapping[str, Any]) -> Task:
    """Return the task that a class or a function makes with options: a task, a model or a world."""
    with blamed(name):
        made = factory(**options)
    made = getattr(made, "task", made)  # of a world
    if isinstance(made, SCM):
        raise _without_backend(name)
    return made if isinstance(made, Task) else ModelTask(made)


def _without_backend(name: str) -> UnknownOption:
    commands = "discover, verify, graph, variables, effect, counterfactual or collect"
    allowed = ("a function that gives a task, a model or a world", commands)
    return UnknownOption("command for a causal model without a backend", name, allowed)


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
    "Goal",
    "ModelTask",
    "Observation",
    "Observed",
    "Options",
    "PickAndPlace",
    "Picking",
    "Pushing",
    "Reaching",
    "StackedBlocks",
    "Stacking2",
    "StepTask",
    "Task",
    "Towers",
    "TriFingerTask",
    "made_by",
    "make_task",
    "register",
    "tasks",
    "term",
]
