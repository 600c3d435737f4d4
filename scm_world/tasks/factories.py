"""Functions named by a text: ``"module:function"`` or ``"file.py:function"``."""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from scm_world.errors import FunctionFailure, UnknownOption, blamed
from scm_world.graph import SCM

FILES = (".xml", ".mjcf", ".urdf")
"""How the names of files end that are models."""


def is_model(source: str) -> bool:
    """Return whether a text is that of a model, or names a file that is one."""
    return source.lstrip().startswith("<") or source.lower().endswith(FILES)


def load_factory(reference: str) -> Callable[..., Any]:
    """Import a function, as ``load_named`` does; for a causal model, return one that returns it."""
    found = load_named(reference, "task")
    if isinstance(found, SCM):
        return lambda: found
    if not callable(found):
        raise UnknownOption("task", reference, ("a function or an SCM",))
    made: Callable[..., Any] = found
    return made


def load_named(reference: str, what: str) -> Any:
    """Import an object of a module, also of the present folder, or of a file.

    A file is run again only if it has changed.

    Raises:
        UnknownOption: There is no such module or file, or nothing of this name in it.
        FunctionFailure: The module raised an error.
    """
    home, _, name = reference.rpartition(":")
    if not home or not name:
        raise UnknownOption(what, reference, ("module:name, or file.py:name",))
    if home.endswith(".py"):
        path = Path(home)
        if not path.is_file():
            raise UnknownOption(what, reference, (f"a file that exists, not {home}",))
        module_name = f"scm_world_factory_{path.stem}"
        state = str(path.resolve()), path.stat().st_mtime_ns, path.stat().st_size
        module: Any = sys.modules.get(module_name)
        if getattr(module, "__scm_world_state__", None) != state:
            spec: Any = importlib.util.spec_from_file_location(module_name, path)
            module = importlib.util.module_from_spec(spec)
            sys.modules[module_name] = module
            with blamed(home):
                spec.loader.exec_module(module)
            module.__scm_world_state__ = state
    else:
        here = os.getcwd()
        sys.path.insert(0, here)
        try:
            with blamed(home):
                module = importlib.import_module(home)
        except FunctionFailure as error:
            if isinstance(error.__cause__, ModuleNotFoundError):
                raise UnknownOption(what, reference, (f"a module: {error.__cause__}",)) from error
            raise
        finally:
            sys.path.remove(here)
    if not hasattr(module, name):
        offered = [n for n, v in vars(module).items() if callable(v) and not n.startswith("_")]
        raise UnknownOption(f"function in {home}", name, offered)
    return getattr(module, name)


def refuse_untrusted(task: str, trusted: Sequence[str] | None) -> None:
    """Refuse to run a function that a file, not a user, names as its task.

    Args:
        task: The text of the file. Registered tasks and models run no code, nor does ``ModelTask``.
        trusted: Packages whose functions may be called, without ``.py``, or whole references; any
            if None.

    Raises:
        UnknownOption: With what to do.
    """
    home, colon, _ = task.rpartition(":")
    package = Path(home).stem if home.endswith(".py") else home.partition(".")[0]
    if trusted is None or not colon or is_model(task):
        return
    if package in trusted or task in ("scm_world.tasks.model:ModelTask", *trusted):
        return
    allowed = (f"task={task!r}, or trusted={(package,)}, to run its code",)
    raise UnknownOption("task that a file names", task, allowed)
