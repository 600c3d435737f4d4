"""Sources: whatever a world can be made of, and the one function that reads it."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import os
import sys
import zlib
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias, TypeVar

from scm_world._arguments import enter, takes, typed
from scm_world._plugins import Plugins
from scm_world.errors import FunctionFailure, ModelError, UnknownOption, UnreadableFile, blamed
from scm_world.graph import SCM, from_json
from scm_world.models import Model
from scm_world.runs.files import read_text
from scm_world.tasks.base import Task
from scm_world.tasks.equations import EquationTask
from scm_world.tasks.families import FAMILIES, PHYSICS, family, is_family
from scm_world.tasks.model import ModelTask
from scm_world.tasks.step import StepTask
from scm_world.tasks.trifinger.base import TriFingerTask
from scm_world.tasks.trifinger.building import Building, Towers
from scm_world.tasks.trifinger.general import General
from scm_world.tasks.trifinger.reaching import Reaching
from scm_world.tasks.trifinger.single import PickAndPlace, Picking, Pushing
from scm_world.tasks.trifinger.stacking2 import Stacking2
from scm_world.tasks.trifinger.walls import CreativeStackedBlocks, StackedBlocks

FILES = (".xml", ".mjcf", ".urdf")
"""How the names of files end that are models."""

NAMES = (
    *(f"{name}:N" for name in (*FAMILIES, *PHYSICS)),
    *("FILE.json", "FILE.xml", "FILE.urdf", "module:name"),
)
"""Names of sources besides those of tasks."""
SOURCES = (
    "a task or its class",
    "a function that returns it",
    "a model: its path or XML text, a mujoco.MjSpec, or a mujoco.MjModel",
    "a step function of four arguments",
    "an SCM",
    *NAMES,
)

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
    registers it is imported there: put it at the top level of that module. What an installed
    package declares as an entry point of the group ``scm_world.tasks`` is known everywhere.

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


def tasks() -> Plugins[type[Task]]:
    """Return all tasks that ``make_task`` knows: of this package, then the others."""

    def declared(name: str, found: Any) -> type[Task]:
        kind: type[Task] = register(found)
        if kind.name != name:
            raise ModelError([f"the name of {kind.__name__} is {kind.name!r}, not {name!r}"])
        return kind

    return Plugins("tasks", {**TASKS, **_REGISTERED}, declared)


def models() -> Plugins[Any]:
    """Return the models that installed packages declare: sources of other kinds than a name.

    Entry points of the group ``scm_world.models`` are files, texts, functions or causal models,
    as ``read_source`` takes them.
    """

    def declared(name: str, found: Any) -> Any:
        if _is_saved(found):
            return partial(_saved, os.fspath(found))
        if not (callable(found) or _is_physical(found) or _causal(found) is not None):
            raise UnknownOption(f"model {name!r}", found, ("a file, a text, a function or an SCM",))
        return found

    return Plugins("models", {}, declared)


def is_named(source: str) -> bool:
    """Return whether a text names a task or a model, or may be a file or ``"module:name"``."""
    return source in tasks() or source in models() or is_model(source) or ":" in source


class WorldSource(NamedTuple):
    """What a source holds.

    Attributes:
        made: A task, or a causal model without a backend.
        plan: Interventions that hold in every episode: those of a world that a function returns,
            and the mechanisms of the family ``"servo:N"``.
        settings: Options of a world that is the source, where they are not the usual ones.
    """

    made: Task | SCM
    plan: Mapping[str, Any] = MappingProxyType({})
    settings: Mapping[str, Any] = MappingProxyType({})

    @property
    def backend(self) -> str | None:
        """Name of the engine that it usually has; None for a causal model."""
        return None if isinstance(self.made, SCM) else self.made.backend

    def task(self) -> Task:
        """Return the task; that of a causal model has its ``Action`` variables and its reward.

        Raises:
            UnknownOption: It holds interventions or options of a world, which a task cannot keep.
            ModelError: It holds a causal model in which nothing acts.
        """
        if self.plan:
            allowed = ("its task, and start= of an environment", "the source of a World")
            raise UnknownOption("task, with interventions of a world", [*self.plan], allowed)
        if self.settings:
            allowed = ("world.task, with these options beside it", "the source of a World")
            raise UnknownOption("task, with options of a world", dict(self.settings), allowed)
        return EquationTask(self.made) if isinstance(self.made, SCM) else self.made


AnySource: TypeAlias = Any
"""See ``read_source``, which checks it; MuJoCo's own classes ship no types."""


@typed
def read_source(
    source: AnySource, options: Mapping[str, Any] = MappingProxyType({})
) -> WorldSource:
    """Read what a world is made of.

    Args:
        source: One of

            - the name of a task (``tasks()``), a task, its class, or a function that returns one;
            - the name of a model that an installed package declares (``models()``);
            - a model: the path of an MJCF or URDF file, its text, a ``mujoco.MjSpec``, a
              ``mujoco.MjModel`` or a ``Model``;
            - a step function, which takes four arguments;
            - a causal model: an ``SCM``, a world of its equations, or a JSON file that
              ``scm_world.graph.to_json`` wrote; with options of ``EquationTask`` (``actions``,
              ``reward``, …) a task;
            - a family of problems with a size: ``"er2:20"``, ``"servo:10"``;
            - ``"module:name"``, of a module or of a Python file, for any of the others.
        options: Arguments of the task, of ``ModelTask`` for a model, of ``StepTask`` for a step
            function, of a function that makes any of these; or ``seed`` of a family.

    Raises:
        UnknownOption: The source is unknown, or does not take an option.
        FunctionFailure: A function, or its module, raised an error.
        UnreadableFile: A JSON file does not exist, or holds no model.
        ModelError: A model cannot be read.
    """
    found = made_from(source, options)
    if isinstance(found, WorldSource):
        return found
    if isinstance(found, Task | SCM):
        return WorldSource(found)
    found = getattr(found, "one", found)  # of many worlds
    made = getattr(found, "task", None) or getattr(found, "model", None)  # of a world
    if not isinstance(made, Task | SCM):
        raise UnknownOption("source of a world", found, (*tasks(), *SOURCES))
    return WorldSource(made, getattr(found, "plan", {}), getattr(found, "settings", {}))


def made_from(source: AnySource, options: Mapping[str, Any] = MappingProxyType({})) -> Any:
    """Return what a source makes: a task, a causal model, or whatever its function returns."""
    if _is_saved(source):
        source = os.fspath(source)
    is_name = isinstance(source, str) and not is_model(source)
    name = source if is_name else getattr(source, "__name__", f"a {type(source).__name__}")
    found = _named(source) if is_name else source
    if is_step(found, options):
        return StepTask(found, **options)
    if callable(found):
        rest: Mapping[str, Any] = {}
        if options and takes(found, **options) is False:  # what it makes may take them
            rest = {n: options[n] for n in EquationTask.options() if n in options}
            options = {n: value for n, value in options.items() if n not in rest}
        if options and takes(found, **options) is False:
            known = inspect.signature(found)
            try:
                known.bind_partial(**options)
            except TypeError:
                allowed = [*known.parameters] or ("left out: there are no arguments",)
                raise UnknownOption(f"options of {name}", [*options], allowed) from None
        with blamed(name):
            found, options = found(**options), rest
        if _is_saved(found):
            found = _saved(os.fspath(found))
    if _is_physical(found):
        return ModelTask(found, **options)
    if options and (model := _causal(found)) is not None:
        return WorldSource(EquationTask(model, **options), getattr(found, "plan", {}))
    if options:
        allowed = ("left out, with a source that is made already",)
        raise UnknownOption(f"options of {name}", [*options], allowed)
    return found


def _named(name: str) -> Any:
    """Return what a name stands for, not made yet."""
    if name in (known := tasks()):
        return known[name]
    if is_family(name):
        return partial(family, name)
    if _is_saved(name):
        return partial(_saved, name)
    if ":" in name:
        return load_named(name, "task")
    if name in (more := models()):
        return more[name]
    raise UnknownOption("task", name, (*known, *more, *NAMES))


def _is_saved(source: object) -> bool:
    """Return whether something is the path of a causal model's file."""
    return isinstance(source, str | PathLike) and str(os.fspath(source)).lower().endswith(".json")


def is_causal(source: object) -> bool:
    """Return whether something is, or is the name of, a causal model that is made already."""
    if isinstance(source, str) and not is_model(source) and source not in tasks():
        if source in models():
            return _causal(models()[source]) is not None
        if ":" in source and not (is_family(source) or _is_saved(source)):
            source = load_named(source, "task")
        else:
            return _is_saved(source) or (is_family(source) and source.partition(":")[0] in FAMILIES)
    if _is_saved(source):
        return True
    return _causal(source) is not None


def _causal(source: object) -> SCM | None:
    """Return a causal model, or that of a world of equations; None of anything else."""
    source = getattr(source, "one", source)
    made = getattr(source, "task", None) or getattr(source, "model", None)
    return next((one for one in (source, made) if isinstance(one, SCM)), None)


def _saved(path: str, /) -> SCM:
    """Read a causal model that ``to_json`` wrote."""
    try:
        return from_json(read_text(Path(path)))
    except (OSError, ValueError) as error:
        advice = "give a file that scm_world.graph.to_json wrote"
        raise UnreadableFile(path, " ".join(str(error).split()), advice) from None


def _is_physical(found: object) -> bool:
    """Return whether something is a model of bodies."""
    if isinstance(found, str):
        return is_model(found)
    return isinstance(found, Model | PathLike) or type(found).__name__ in ("MjSpec", "MjModel")


def is_step(found: object, options: Mapping[str, Any]) -> bool:
    """Return whether something can be called with four arguments, and not with options only."""
    if isinstance(found, type) or not callable(found):
        return False
    return takes(found, *range(4)) is True and takes(found, **options) is False


def make_task(source: AnySource, **options: object) -> Task:
    """Return a task, or make it; for a model or a step function, its task.

    Args:
        source: See ``read_source``.
        options: Likewise.

    Raises:
        Those of ``read_source``, and:
        UnknownOption: The source is a causal model without a backend, or a world with interventions
            in ``given``, which a task cannot keep.
    """
    return read_source(source, options).task()


def is_model(source: str) -> bool:
    """Return whether a text is that of a model, or names a file that is one."""
    return source.lstrip().startswith("<") or source.lower().endswith(FILES)


def load_named(reference: str, what: str) -> Any:
    """Import an object of a module, also of the present folder, or of a file.

    A file is run again only if it has changed.

    Raises:
        UnknownOption: The module or file does not exist, or has nothing of this name.
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
        taken = getattr(sys.modules.get(module_name), "__scm_world_state__", state)
        if taken[0] != state[0]:  # by another file of this name
            module_name += f"_{zlib.crc32(state[0].encode()):08x}"
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
