"""What an environment was made with: as it is, as plain data, and made again."""

from __future__ import annotations

import inspect
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from scm_world.env import IDS, ScmWorldEnv
from scm_world.env.start import asked
from scm_world.errors import ModelError, SnapshotMismatch
from scm_world.tasks import Task
from scm_world.variables import Draw, Subset
from scm_world.variables.kinds import SPACES

WITHOUT: Mapping[str, Any] = {
    "start": None,
    "random_goal": None,
    "attempts": 1,
    "variables_space": None,
    "render_mode": None,
}
"""Arguments of an environment that repeats what was done in another one, and does nothing else."""


def environment(env: ScmWorldEnv) -> dict[str, Any]:
    """Give the arguments that an environment was made with."""
    made_with: Mapping[str, Any] = vars(env)["_ezpickle_kwargs"]
    return dict(made_with)


def named(task: Any) -> str:
    """Give the name of a task that is given by name or made."""
    return task.name if isinstance(task, Task) else str(task)


def remade(made_with: Mapping[str, Any], task: Task | None = None) -> ScmWorldEnv:
    """Make an environment again, for repeating what was done.

    Args:
        made_with: Arguments of the first one.
        task: In the place of its task.

    Raises:
        SnapshotMismatch: It has an argument of another version.
        UnknownOption: An argument is not accepted, such as a task that is not registered.
        EngineError: The engine is not installed.
    """
    arguments = {**made_with, **WITHOUT}
    unknown = arguments.keys() - inspect.signature(ScmWorldEnv.__init__).parameters.keys()
    if unknown:
        raise SnapshotMismatch(
            f"the recording is one of another version: environments have no option {min(unknown)!r}"
        )
    if task is not None:
        arguments |= {"task": task, "task_options": None}
    return ScmWorldEnv(**arguments)


def gym_id(made_with: Mapping[str, Any]) -> str:
    """Give the id under which Gymnasium makes environments with the same task.

    Raises:
        ModelError: There is none, as the task is not registered.
    """
    name = named(made_with["task"])
    for id_, task in IDS.items():
        if task == name:
            return id_
    raise ModelError([f"the task {name!r} has no id with Gymnasium; there are {', '.join(IDS)}"])


def as_data(made_with: Mapping[str, Any]) -> dict[str, Any]:
    """Write the arguments of an environment as plain data.

    Raises:
        ModelError: Some cannot be written.
    """
    arguments = dict(made_with)
    task = arguments["task"]
    problems = []
    if isinstance(task, Task):
        if not task.is_named:
            problems.append(f"give the arguments of {task.name!r} by name")
        arguments |= {"task": task.name, "task_options": task.given or None}
    if arguments.get("start"):
        arguments["start"] = {name: _text(act) for name, act in asked(arguments["start"]).items()}
    found: dict[str, Any] = {}
    for name, value in arguments.items():
        try:
            found[name] = json.loads(json.dumps(value, allow_nan=False, default=_plain))
        except (TypeError, ValueError) as error:
            problems.append(f"the argument {name!r} of the environment cannot be written: {error}")
    if problems:
        raise ModelError(problems)
    return found


def _text(act: Any) -> Any:
    """Give the text that stands for a draw from a space."""
    if not isinstance(act, Draw):
        return act
    return next((space for space in SPACES if act == Draw(space)), act)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Subset):
        return value.model_dump(mode="json")
    raise TypeError(f"{value!r} is no plain data")
