"""Tasks with arguments from the command line: ``--option num_of_levels=2``."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, get_args, get_type_hints

import typer

from scm_world.cli.assignments import parse_assignments
from scm_world.errors import ModelError, ScmWorldError, UnknownOption
from scm_world.graph import scm as graph
from scm_world.queries import SCM
from scm_world.tasks import TASKS, Task, make_task
from scm_world.tasks.factories import load_factory
from scm_world.tasks.model import FILES

_HINT = "'--option'"
_WORDS = {"true": True, "false": False}
_NO_NUMBERS = ("shape", "terms")  # what is made of them cannot be written on a command line


def build(name: str, arguments: Sequence[str] = ()) -> Task:
    """Create a task.

    Args:
        name: Of the task.
        arguments: What differs from its defaults, each as ``name=value``.

    Raises:
        UnknownOption: There is no such task or argument, or the value is not allowed.
        ConflictingTargets: An argument is given twice.
        BadParameter: An argument cannot be read.

    Example:
        >>> build("towers", ["number_of_blocks_in_tower=1,1,2"]).tools()
        ('tool_level_0_col_0_row_0', 'tool_level_1_col_0_row_0')
    """
    read = parse_assignments(arguments, _HINT)
    given = {key: _value(key, value) if name in TASKS else value for key, value in read.items()}
    known = tuple(_arguments(TASKS[name])) if name in TASKS else ()
    for key in given if known else ():
        if key not in known:
            raise UnknownOption(f"argument of {name}", key, known)
    try:
        return make_task(name, **given)
    except (TypeError, ValueError) as error:
        if isinstance(error, ScmWorldError) and not (arguments and isinstance(error, ModelError)):
            raise
        raise typer.BadParameter(f"{', '.join(arguments)}: {error}", param_hint=_HINT) from None


def system(name: str, arguments: Sequence[str] = ()) -> Task | SCM:
    """Create a task, or the causal model that ``module:function`` gives; see ``build``."""
    made = None
    if ":" in name:
        with suppress(Exception):  # ``build`` raises it again, and says what is wrong
            made = load_factory(name)(**parse_assignments(arguments, _HINT))
    return SCM(made) if isinstance(made, graph.SCM) else build(name, arguments)


def backend_of(backend: str | None, name: str, arguments: Sequence[str] | None) -> str:
    """Give the backend that was asked for, or that of a task."""
    own = ":" in name and name not in TASKS
    if backend or not own:
        return backend or Task.backend
    made = system(name, arguments or ())
    return "equations" if isinstance(made, SCM) else made.backend


def tag(name: str) -> str:
    """Shorten the name of a task for titles and folders: of a file, its stem.

    Example:
        >>> tag("pushing"), tag("models/cartpole.xml"), tag("my.worlds:cartpole")
        ('pushing', 'cartpole', 'my.worlds-cartpole')
    """
    home, colon, function = name.rpartition(":")
    if colon:
        return f"{Path(home).stem if home.endswith('.py') else home}-{function}"
    return Path(name).stem if name.lower().endswith(FILES) else name


def suffix(arguments: Iterable[str]) -> str:
    """Write arguments as the end of the name of a folder.

    Example:
        >>> suffix(["num_of_levels=2", "tower_center=[0, 0.1]"])
        '-num_of_levels=2-tower_center=0_0.1'
    """
    return "".join("-" + re.sub(r"[^\w.=-]+", "_", text).strip("_") for text in arguments).replace(
        "=_", "="
    )


def _arguments(task: type[Task]) -> Iterator[str]:
    """Name what the constructor of a task takes, without what numbers cannot say."""
    hints = get_type_hints(task.__init__)
    for parameter in list(inspect.signature(task).parameters.values()):
        if parameter.kind is inspect.Parameter.VAR_KEYWORD:
            common = get_args(hints[parameter.name])[0]
            names: Iterable[str] = get_type_hints(common)
        else:
            names = (parameter.name,)
        yield from (name for name in names if name not in _NO_NUMBERS)


def _value(name: str, value: Any) -> Any:
    """Turn lists into tuples, and accept words where there are words to choose from."""
    match value:
        case list() if all(isinstance(part, int | float) for part in value):
            return tuple(value)
        case int() | float():
            return value
        case str() if name == "weights" or value.lower() in _WORDS:
            return _WORDS.get(value.lower(), value)
    raise typer.BadParameter(f"{name}: expected numbers, got {value!r}", param_hint=_HINT)
