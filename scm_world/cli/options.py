"""Options and values as they are typed, and the systems that they name.

The help of an option stands in the docstring of its command, or here if several have it.
"""

from __future__ import annotations

import copy
import inspect
import json
import math
import os
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_type_hints

import typer

import scm_world as sw
from scm_world.cli import console
from scm_world.errors import ConflictingTargets, UnknownOption, reading
from scm_world.runs.files import Location, read_text

if TYPE_CHECKING:
    from scm_world.tasks import WorldSource

# --- kinds of options -----------------------------------------------------------------------------


def secret(path: str | None) -> str | None:
    """Return the secret that is in a file, or, without a file, in ``SCM_LAB_KEY``."""
    if path is None:
        return os.environ.get("SCM_LAB_KEY")
    with reading(path, "give a text file with a secret of at least 16 characters"):
        return read_text(path).strip()


Text = str | None
Count = Annotated[int, typer.Option(min=1)]
Shard = Annotated[int | None, typer.Option(min=1)]
NotNegative = Annotated[int, typer.Option(min=0)]
Amount = Annotated[float, typer.Option(min=0.0)]
N = Annotated[int, typer.Option("-n", "--n", min=1)]
Words = list[str] | None
Pairs = Annotated[list[str] | None, typer.Option(metavar="NAME=VALUE")]
Outcomes = Annotated[
    list[str] | None, typer.Option(metavar="HOW:NAME", show_default="the usual ones")
]
Backend = Annotated[str | None, typer.Option(show_default="that of the task")]
ManyWorkers = Annotated[int | None, typer.Option(min=0, show_default="as many as there are cores")]
Out = Annotated[str | None, typer.Option(metavar="PATH", show_default="under scm-world-results")]
System = Annotated[str, typer.Argument(metavar="SYSTEM")]
Key = Annotated[str | None, typer.Option(metavar="FILE", callback=secret)]
Assignments = Annotated[list[str], typer.Argument(metavar="NAME=VALUE...")]

HELP = {
    "task": "A task (see 'scm-world list'), a model.xml or model.urdf, the model.json of an SCM, "
    "or module:name of a function or an SCM.",
    "assignments": "Interventions. A value is a number, a list 1,2,3, shift:0.1, scale:2 or "
    "draw:A; between two ends draw:0.1,0.2, scale:draw:0.8,1.2, or scale:shared:0.8,1.2, one draw "
    "for all. A name may be a pattern, such as '*.damping'.",
    "option": "Argument of the task or model, such as num_of_levels=2 or control_dt=0.01.",
    "backend": "Physics backend: mujoco, bullet, step or fake; see 'scm-world list'.",
    "preset": "Physics time step of the TriFinger: fast or precise.",
    "resolution": "Nodes of the TriFinger's graph: vector, finger or joint.",
    "seed": "Seed of every random choice.",
    "steps": "Control steps of an episode.",
    "policy": "random, still or mpc; of the TriFinger also feedback, or sweep: the fingertips go "
    "to the middle.",
    "nature": "Context distribution: variation between episodes, such as gravity=draw:A.",
    "outcome": "Outcome, such as reward or sum:reward.",
    "out": "Folder for the results, or a URL such as s3://bucket/run.",
    "key": "File with a secret of at least 16 characters, for private questions; without it, "
    "SCM_LAB_KEY has the secret.",
    "shard": "Episodes in one file; of worlds 500, or as many as the engine steps best together.",
    "size": "Height and width of a picture in pixels.",
    "croissant": "Write README.md and croissant.json, too, by which Hugging Face and mlcroissant "
    "find the Parquet files.",
    "at_least": "Leave out edges whose largest effect is weaker, in units of its free motion.",
    "strict": "Exit 1 unless the graph is confirmed, edge by edge.",
    "trust": "Package whose functions may be called because results name them.",
    "executor": "Executor of independent episodes: serial, process or ray.",
    "workers": "How many run at the same time; 0 for as many as there are cores.",
    "address": "Address of a Ray cluster, or 'auto'; without it, Ray is started on this machine.",
    "observations": "Observations of the policy: plain; privileged: with every causal parameter; "
    "of PPO also critic: with them for the value alone.",
    "changes": "Any other field, such as worlds=16, network.hidden=[64,64], env.frame_skip=5, or "
    "trials.protocols=[] for no evaluations; the value is JSON or a word.",
    "quiet": "Print the result only.",
}
"""Help of the options that several commands have, where a docstring has no other one."""


def command(function: Callable[..., None]) -> Callable[..., None]:
    """Return a command for typer: its options are those of the function and of their groups.

    A group is a dataclass, of which the function has an argument. The help of options comes from
    the ``Args`` of its docstring, of the function's, or from ``HELP``.
    """
    own = _arguments(function)
    kinds = {name: kind for name, kind, _ in own if isinstance(kind, type) and is_dataclass(kind)}
    text, helps = "", HELP
    for one in (*kinds.values(), function):
        text, _, described = (inspect.getdoc(one) or "").partition("\n\nArgs:\n")
        found = re.findall(r"^ {4}(\w+): (.*(?:\n {6,}.*)*)", described, flags=re.MULTILINE)
        helps = helps | {name: " ".join(said.split()) for name, said in found}
    groups = {name: _arguments(kind) for name, kind in kinds.items()}
    made = []
    for name, hint, default in (one for each in own for one in groups.get(each[0], [each])):
        kind, *extra = get_args(hint) if hasattr(hint, "__metadata__") else (hint,)
        option = copy.copy(extra[0]) if extra else typer.Option()
        option.help = helps[name]
        if isinstance(option, typer.models.OptionInfo):
            flag = name.strip("_").replace("_", "-")
            option.param_decls = option.param_decls or (f"--{flag}",)
            if kind in (int, int | None):
                option.parser = _whole(option.param_decls[-1], option.min, option.max)
                option.metavar = option.metavar or "INTEGER"
            if "list" in str(kind):
                option.help += " Repeat it for more."
                option.metavar = option.metavar or flag.upper()
        given = {"default": default, "annotation": Annotated[kind, option]}
        made.append(inspect.Parameter(name, KEYWORD, **given))

    def run(**given: object) -> None:
        for name, options in groups.items():
            given[name] = kinds[name](**{one: given.pop(one) for one, _, _ in options})
        function(**given)

    run.__signature__ = inspect.Signature(made)  # type: ignore[attr-defined] # read by typer
    run.__doc__ = text
    return run


def _whole(flag: str, least: float | None, most: float | None) -> Callable[[object], int]:
    """Return the reader of an option that is a whole number, such as 100 or 1e2."""
    low, high = -math.inf if least is None else least, math.inf if most is None else most
    upper = "on" if most is None else f"to {most}"
    limits = "" if least is None else f" from {least} {upper}"

    def read(given: object) -> int:
        value = parse_value(str(given), f"'{flag}'")
        if type(value) is int and low <= value <= high:
            return value
        raise refused(str(given), f"expected a whole number{limits}", f"'{flag}'")

    return read


def _arguments(made: Callable[..., object]) -> list[tuple[str, Any, Any]]:
    """Return name, type and default of the arguments of a function or dataclass."""
    hints = get_type_hints(made, include_extras=True)
    found = inspect.signature(made).parameters.items()
    return [(name, hints[name], parameter.default) for name, parameter in found]


# --- values ---------------------------------------------------------------------------------------

HINT, KEYWORD = "'NAME=VALUE...'", inspect.Parameter.KEYWORD_ONLY
WORDS = {"true": True, "false": False, "none": None}


def refused(text: str, why: str, hint: str = HINT) -> typer.BadParameter:
    """Return the error of a text that cannot be read."""
    return typer.BadParameter(f"{text!r}: {why}", param_hint=hint)


def parse_value(text: str, hint: str = HINT) -> Any:
    """Read a text: an intervention, JSON, a list without brackets, or a word.

    Example:
        >>> parse_value("0.05"), parse_value("0, 0, -5"), parse_value("True"), parse_value("linear")
        (0.05, [0, 0, -5], True, 'linear')
        >>> parse_value("1e6"), parse_value("1.0")
        (1000000, 1.0)
        >>> parse_value("shift:0.1"), parse_value("scale:draw:0.8,1.2").by.source.describe()
        (Shift(kind='shift', by=0.1), '0.8 to 1.2')
        >>> parse_value("scale:shared:0.8,1.2").shared
        True
    """
    if not text.strip():
        raise refused(text, "expected a value", hint)
    *how, last = text.split(":")
    value = _plain(last)
    ends = value if isinstance(value, list) else [value]
    try:
        match [word.strip().lower() for word in how]:
            case ["draw"]:
                return sw.Draw(*ends)
            case ["shift" | "scale" as kind]:
                return (sw.Shift if kind == "shift" else sw.Scale)(value)
            case ["shift" | "scale" as kind, "draw" | "shared" as drawn]:
                relative = sw.Shift if kind == "shift" else sw.Scale
                return relative(sw.Draw(*ends), shared=drawn == "shared")
            case [kind] if (own := sw.Draw.kinds.get(kind)) and own.__module__[:10] != "scm_world.":
                return own(*ends)
    except (TypeError, ValueError):
        wanted = "draw:A, draw:B, draw:A|B or two ends, draw:0.8,1.2"
        if how[0].strip().lower() != "draw":
            wanted = "numbers, or two ends of a draw, as in scale:draw:0.8,1.2 (shared:0.8,1.2)"
        raise refused(text, f"expected {wanted}", hint) from None
    return _plain(text)


def _plain(text: str) -> Any:
    bare = text.strip()
    for read in (json.loads, float):
        with suppress(ValueError):
            value = read(bare)
            is_whole = isinstance(value, float) and "." not in bare and value.is_integer()
            return int(value) if is_whole else value  # 1e6, 1_000
    listed = bare.startswith("[") and bare.endswith("]")
    if listed or "," in bare:
        return [_plain(part) for part in (bare[1:-1] if listed else bare).split(",")]
    return WORDS.get(bare.lower(), bare)


def parse_assignments(
    texts: Iterable[str] | None,
    hint: str = HINT,
    read: Callable[[str, str], Any] = parse_value,
) -> dict[str, Any]:
    """Return the values of ``name=value`` texts by name; ``hint`` is their option, for messages."""
    request: dict[str, Any] = {}
    for text in texts or ():
        name, equals, value = text.partition("=")
        name = name.strip()
        if not equals or not name:
            raise refused(text, "expected name=value, for example floor_friction=0.4", hint)
        if name in request:
            raise ConflictingTargets((name, name), name)
        request[name] = read(value, hint)
    return request


def parse_outcome(text: str) -> sw.Outcome:
    """Return the outcome of a text: ``name``, ``name[2]`` or ``how:name``."""
    before, _, name = text.rpartition(":")
    component = re.fullmatch(r"(.+)\[(\d+)\]", name)
    if component is None:
        return sw.Outcome(name, before or "final")
    return sw.Outcome(component[1], before or "final", int(component[2]))


def split(text: str) -> list[str]:
    """Return the words of a text with commas between them, each once."""
    return list(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))


# --- systems --------------------------------------------------------------------------------------


def load_system(
    name: str, option: Sequence[str] | None = None, backend: str | None = None
) -> WorldSource:
    """Read a source; print notes about a file."""
    from scm_world.tasks import read_source

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # they are among the notes
        source = read_source(name, task_arguments(option))
    made = source.made
    notes = getattr(getattr(made, "system", None), "notes", ())
    console.say(*(f"note: {note}" for note in notes), stderr=True)
    if isinstance(made, sw.ModelTask):
        from scm_world.backends.mujoco.fidelity import fidelity

        found = fidelity(made.system, backend or "mujoco")
        console.say(*(f"note: {note}" for note in found.notes), f"fidelity: {found}", stderr=True)
    return source


def task_arguments(option: Iterable[str] | None) -> dict[str, Any]:
    """Return the arguments of a task that ``--option`` has; lists are tuples there."""
    given = parse_assignments(option, "'--option'")
    return {name: tuple(v) if isinstance(v, list) else v for name, v in given.items()}


def tag(name: str) -> str:
    """Return the name of a system in titles and folders: of a file, its stem.

    Example:
        >>> tag("pushing"), tag("C:/models/cartpole.xml"), tag("my.worlds:cartpole")
        ('pushing', 'cartpole', 'my.worlds-cartpole')
    """
    if name.lower().endswith((".xml", ".mjcf", ".urdf")):
        return Path(name).stem
    home, colon, function = name.rpartition(":")
    return f"{Path(home).stem if home.endswith('.py') else home}-{function}" if colon else name


# --- groups ---------------------------------------------------------------------------------------


@dataclass
class Opening:
    """Options that say how a system is opened."""

    backend: Backend = None
    preset: Annotated[str | None, typer.Option(show_default="fast")] = None
    resolution: Annotated[str | None, typer.Option(show_default="vector")] = None
    option: Pairs = None

    def settings(
        self, made: WorldSource | sw.World | None = None, space: str | None = None
    ) -> dict[str, Any]:
        """Return the settings of a world; refuse them for a causal model without a backend."""
        names = ("backend", "preset", "resolution")
        given = {name: getattr(self, name) for name in names} | {"space": space}
        found = {name: value for name, value in given.items() if value is not None}
        for setting, value in found.items():
            if made is not None and made.backend is None:
                allowed = ("left out: a causal model without a backend has none",)
                raise UnknownOption(f"--{setting}", value, allowed)
        return found


@dataclass
class Asked(Opening):
    """Options of a command that asks a system something, and writes its answer."""

    seed: NotNegative = 0
    out: Out = None

    def folder(self, command: str, task: str, used: str) -> Location:
        """Return the folder for the results."""
        words = (command, tag(task), used, f"seed{self.seed}", *(self.option or ()))
        return console.results_folder(self.out, *words, self.resolution)

    @contextmanager
    def open(self, command: str, task: str) -> Iterator[tuple[sw.World, Location, str]]:
        """Open a world or a causal model; yield it, the folder for the results, and its engine."""
        made = load_system(task, self.option, self.backend)
        settings = self.settings(made)
        with sw.World(made, **settings) as system:
            engine = getattr(system, "engine", "equations")
            yield system, self.folder(command, task, engine.partition(" ")[0]), engine

    def answer(self, form: str, task: str, engine: str, /, **found: object) -> dict[str, object]:
        """Return an answer with its arguments and the versions."""
        from scm_world.queries.experiments.versions import versions

        return {
            "format": f"scm_world/{form}",
            "task": task,
            "arguments": self.option or (),
            "preset": self.preset,
            "seed": self.seed,
            "backend": engine.partition(" ")[0],
            "versions": versions(engine if engine != "equations" else ""),
            **found,
        }


@dataclass
class EpisodeOptions:
    """Options of episodes."""

    steps: Count = 25
    policy: Annotated[str | None, typer.Option(show_default="random; still without a backend")] = (
        None
    )

    def setting(self, system: sw.World) -> dict[str, Any]:
        """Return the policy and the control steps; without a policy only if that is asked for."""
        from scm_world.policies.scripted import NAMED

        if self.policy not in (None, "still", *NAMED):
            raise UnknownOption("policy", self.policy, (*NAMED, "still"))
        usual = None if system.backend is None else "random"
        policy = usual if self.policy is None else self.policy
        return {
            "policy": None if policy == "still" else policy,
            "steps": self.steps if system.graph.is_temporal else 0,
        }


@dataclass
class Varied(EpisodeOptions):
    """Options of many episodes."""

    nature: Pairs = None

    def setting(self, system: sw.World) -> dict[str, Any]:
        """Return the policy, the control steps, and the context distribution."""
        nature = parse_assignments(self.nature, "'--nature'")
        return {**super().setting(system), "nature": nature}


@dataclass
class Jobs:
    """Options of independent jobs."""

    workers: Annotated[
        int | None,
        typer.Option(min=0, show_default="1; with --executor as many as there are cores"),
    ] = None
    executor: Annotated[
        str | None,
        typer.Option("--executor", "--engine", show_default="process; with one worker serial"),
    ] = None
    address: Annotated[str | None, typer.Option(metavar="HOST:PORT")] = None

    @contextmanager
    def open(self, what: str, folder: Location, files: str, named: str) -> Iterator[dict[str, Any]]:
        """Open a pool; print where it works, its progress, and after Ctrl-C which files are safe.

        Yields:
            Arguments of the function that does the work.
        """
        from scm_world.runs.pool import Pool
        from scm_world.runs.processes import cores

        if self.address is not None and self.executor != "ray":
            allowed = (f"None with the executor {self.executor}; 'ray' has one",)
            raise UnknownOption("address", self.address, allowed)
        count = self.workers or None
        if self.executor is None:
            count = 1 if self.workers is None else (self.workers or cores())
        with (
            console.resumable(folder, files, named),
            Pool(self.address or self.executor, count) as pool,
        ):
            console.say(f"the work is done {pool.where}", stderr=True)
            with console.progress(what) as tell:
                yield {"out": folder, "engine": pool, "progress": tell}


@dataclass
class ManyJobs(Jobs):
    """Options of independent jobs that have all cores without being asked."""

    workers: ManyWorkers = 0
