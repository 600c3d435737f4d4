"""Options: their kinds, groups that several commands have, and their help.

The help of an option stands in the docstring of its command, or here if several have it.
"""

from __future__ import annotations

import copy
import inspect
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_type_hints

import typer

from scm_world.cli import console
from scm_world.cli.arguments import engine_of, open_system, parse_assignments, tag
from scm_world.errors import UnknownOption
from scm_world.runs.files import Location

if TYPE_CHECKING:
    from scm_world.queries import SCM, World


# --- kinds of options -----------------------------------------------------------------------------

Text = str | None
Count = Annotated[int, typer.Option(min=1)]
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
System = Annotated[
    str,
    typer.Argument(
        metavar="SYSTEM",
        help="A task (see 'scm-world list'), a model.xml or model.urdf, the model.json of an SCM, "
        "or module:name of a function or an SCM.",
    ),
]
Assignments = Annotated[
    list[str],
    typer.Argument(
        metavar="NAME=VALUE...",
        help="Interventions. A value is a number, a list 1,2,3, shift:0.1, scale:2 or draw:A; "
        "between two ends draw:0.1,0.2, scale:draw:0.8,1.2, or scale:shared:0.8,1.2, one draw for "
        "all. A name may be a pattern, such as '*.damping'.",
    ),
]


# --- groups ---------------------------------------------------------------------------------------


@dataclass
class Opening:
    """Options that say how a system is opened."""

    backend: Backend = None
    preset: Annotated[str | None, typer.Option(show_default="fast")] = None
    resolution: Annotated[str | None, typer.Option(show_default="vector")] = None
    option: Pairs = None

    @property
    def settings(self) -> dict[str, str | None]:
        """Settings of a world."""
        return {name: getattr(self, name) for name in ("backend", "preset", "resolution")}


@dataclass
class Asked(Opening):
    """Options of a command that asks a system something, and writes its answer."""

    seed: NotNegative = 0
    out: Out = None

    def folder(self, command: str, task: str, used: str) -> Location:
        """Return the folder for the results."""
        words = (command, tag(task), used, f"seed{self.seed}", *(self.option or ()))
        return console.results_folder(self.out, *words, self.resolution)

    def about(self, form: str, task: str, engine: str) -> dict[str, Any]:
        """Return what a result says of every question: its arguments, and the versions."""
        from scm_world.queries.experiments.versions import versions

        return {
            "format": f"scm_world/{form}",
            "task": task,
            "arguments": self.option or (),
            "preset": self.preset,
            "seed": self.seed,
            "backend": engine.partition(" ")[0],
            "versions": versions(engine if engine != "equations" else ""),
        }

    @contextmanager
    def open(self, command: str, task: str) -> Iterator[tuple[World | SCM, Location]]:
        """Open a system, and find the folder for the results."""
        with open_system(task, self.option, **self.settings) as system:
            yield system, self.folder(command, task, engine_of(system).partition(" ")[0])


@dataclass
class EpisodeOptions:
    """Options of episodes."""

    steps: Count = 25
    policy: Annotated[str | None, typer.Option(show_default="random; still without a backend")] = (
        None
    )

    def setting(self, system: World | SCM) -> dict[str, Any]:
        """Return who acts, and how long; nothing acts in a world only if that is asked for."""
        from scm_world.policies.scripted import NAMED

        if self.policy not in (None, "still", *NAMED):
            raise UnknownOption("policy", self.policy, (*NAMED, "still"))
        usual = "random" if hasattr(system, "backend") else None
        policy = usual if self.policy is None else self.policy
        return {
            "policy": None if policy == "still" else policy,
            "steps": self.steps if system.graph.is_temporal else 0,
        }


@dataclass
class Varied(EpisodeOptions):
    """Options of many episodes."""

    nature: Pairs = None

    def setting(self, system: World | SCM) -> dict[str, Any]:
        """Return who acts, how long, and what varies."""
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


# --- help -----------------------------------------------------------------------------------------

SHARED = {
    "option": "Argument of the task or model, such as num_of_levels=2 or control_dt=0.01.",
    "backend": "Physics backend: mujoco, bullet, step or fake; see 'scm-world list'.",
    "preset": "Physics time step of the TriFinger: fast or precise.",
    "resolution": "Nodes of the TriFinger's graph: vector, finger or joint.",
    "seed": "Seed of every random choice.",
    "steps": "Control steps of an episode.",
    "policy": "random, still or mpc; of the TriFinger also feedback, or sweep: the fingertips go "
    "to the middle.",
    "nature": "Context distribution: what varies between episodes, such as gravity=draw:A.",
    "outcome": "Outcome, such as reward or sum:reward.",
    "out": "Folder for the results, or a URL such as s3://bucket/run.",
    "shard": "Episodes in one file.",
    "size": "Height and width of a picture in pixels.",
    "croissant": "Write README.md and croissant.json, too, by which Hugging Face and mlcroissant "
    "find the Parquet files.",
    "at_least": "Leave out edges whose largest effect is weaker, in units of its free motion.",
    "strict": "Exit 1 unless the graph is confirmed, edge by edge.",
    "trust": "Package whose functions may be called because results name them.",
    "executor": "What runs independent episodes: serial, process or ray.",
    "workers": "How many run at the same time; 0 for as many as there are cores.",
    "address": "Address of a Ray cluster, or 'auto'; without it, Ray is started on this machine.",
}
"""Help of the options that several commands have, where a docstring has no other one."""


def command(function: Callable[..., None]) -> Callable[..., None]:
    """Return a command for typer: its options are those of the function and of their groups.

    The help of options comes from the ``Args`` of the function's docstring, or from ``SHARED``.
    """
    text, _, described = (inspect.getdoc(function) or "").partition("\n\nArgs:\n")
    found = re.findall(r"^ {4}(\w+): (.*(?:\n {6,}.*)*)", described, flags=re.MULTILINE)
    helps = SHARED | {name: " ".join(said.split()) for name, said in found}
    hints = get_type_hints(function, include_extras=True)
    groups: dict[str, Any] = {n: kind for n, kind in hints.items() if is_dataclass(kind)}
    options: list[tuple[str, Any, Any]] = []
    for name, parameter in inspect.signature(function).parameters.items():
        if name not in groups:
            options.append((name, hints[name], parameter.default))
            continue
        inside = get_type_hints(groups[name], include_extras=True)
        options += [(one.name, inside[one.name], one.default) for one in fields(groups[name])]

    def run(**given: Any) -> None:
        for name, group in groups.items():
            given[name] = group(**{one.name: given.pop(one.name) for one in fields(group)})
        function(**given)

    made = []
    for name, hint, default in options:
        kind, *extra = get_args(hint) if hasattr(hint, "__metadata__") else (hint,)
        option = copy.copy(extra[0]) if extra else typer.Option()
        if isinstance(option, typer.models.OptionInfo):
            flag = name.strip("_").replace("_", "-")
            option.param_decls = option.param_decls or (f"--{flag}",)
            option.help = option.help or helps[name]
            if "list" in str(kind):
                option.help += " Repeat it for more."
                option.metavar = option.metavar or flag.upper()
        else:
            option.help = helps.get(name, option.help)
        given: Any = Annotated[kind, option]
        kwargs = {"default": default, "annotation": given}
        made.append(inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, **kwargs))
    run.__signature__ = inspect.Signature(made)  # type: ignore[attr-defined] # read by typer
    run.__doc__ = text
    return run
