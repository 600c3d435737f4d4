"""What an environment was made with: as it is, as plain data, and made again."""

from __future__ import annotations

import inspect
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scm_world.env import IDS, MODEL_ID, ScmWorldEnv
from scm_world.env.start import asked
from scm_world.errors import ModelError, SnapshotMismatch, UnknownOption
from scm_world.tasks import Task, tasks
from scm_world.tasks.factories import load_factory
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


def refuse_untrusted(text: str, trusted: Sequence[str] | None) -> None:
    """Refuse to run a function that a file names, as ``"module:function"`` for a task.

    Args:
        text: The task.
        trusted: Packages whose functions may be called, without ``.py``; any if None.

    Raises:
        UnknownOption: With what to do.
    """
    home, colon, _ = text.rpartition(":")
    package = Path(home).stem if home.endswith(".py") else home.partition(".")[0]
    if colon and trusted is not None and package not in trusted:
        allowed = (f"task={text!r}, or trusted={(package,)}, to run what is in there",)
        raise UnknownOption("task that a file names", text, allowed)


def remade(made_with: Mapping[str, Any], task: Task | str | None = None) -> ScmWorldEnv:
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
    if isinstance(task, Task):
        arguments |= {"task": task, "task_options": None}
    elif task is not None:
        arguments["task"] = task
    return ScmWorldEnv(**arguments)


def gym_arguments(made_with: Mapping[str, Any]) -> dict[str, Any]:
    """Give the arguments with which Gymnasium makes an environment again, its ``id`` included.

    Args:
        made_with: As plain data; see ``as_data``.

    Raises:
        ModelError: There is no id, as the task is registered with this package alone.
    """
    name = named(made_with["task"])
    for id_, task in IDS.items():
        if task == name:
            return {"id": id_, **made_with}
    if name in tasks():
        problem = f"the task {name!r} has no id with Gymnasium; there are {', '.join(IDS)}"
        raise ModelError([problem])
    options = made_with.get("task_options") or {}
    rest = {key: value for key, value in made_with.items() if key != "task"}
    return {"id": MODEL_ID, **rest, "model": name, "task_options": options}


def reference(task: Task) -> str:
    """Name a task by a text from which it can be made again, with its arguments.

    Raises:
        ModelError: There is none: its class can only be found in the program that runs.
    """
    kind = type(task)
    if tasks().get(task.name) is kind:
        return task.name
    text = f"{kind.__module__}:{kind.__qualname__}"
    try:
        found = None if kind.__module__ == "__main__" else load_factory(text)
    except (ImportError, UnknownOption):
        found = None
    if found is not kind:
        raise ModelError(
            [
                f"the task {task.name!r} cannot be named in a file: its class {text} is found in "
                "no module; put the class or a function that makes it into a module, and give "
                "task='module:name'"
            ]
        )
    return text


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
        arguments |= {"task": reference(task), "task_options": task.given or None}
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
