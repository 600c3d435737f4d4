"""Options that several commands share, and how the help of all others is read.

The help of an option stands in the docstring of its command, or here if several have it.
"""

from __future__ import annotations

import copy
import inspect
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_type_hints

import typer

from scm_world.cli.console import progress, say
from scm_world.errors import ScmWorldError, UnknownOption
from scm_world.runs.files import Location, located

if TYPE_CHECKING:
    from scm_world.queries.progress import Progress
    from scm_world.runs.pool import Pool


# --- kinds of options -----------------------------------------------------------------------------

Text = str | None
Count = Annotated[int, typer.Option(min=1)]
NotNegative = Annotated[int, typer.Option(min=0)]
Amount = Annotated[float, typer.Option(min=0.0)]
N = Annotated[int, typer.Option("-n", "--n", min=1)]
Patterns = Annotated[list[str] | None, typer.Option(metavar="PATTERN")]
Pairs = Annotated[list[str] | None, typer.Option(metavar="NAME=VALUE")]
Do = Annotated[list[str] | None, typer.Option("--do", metavar="NAME=VALUE")]

System = Annotated[
    str,
    typer.Argument(
        metavar="SYSTEM",
        help="A task (see 'scm-world list'), a model.xml or model.urdf, the model.json of an SCM, "
        "or module:name of a function or an SCM.",
    ),
]
Systems = Annotated[
    str,
    typer.Argument(
        metavar="SYSTEM",
        help="A task, a model.xml, model.urdf or model.json, module:name, or 'all'.",
    ),
]
Assignments = Annotated[
    list[str],
    typer.Argument(
        metavar="NAME=VALUE...",
        help="Interventions. A value is a number, a list 1,2,3, shift:0.1, scale:2 or draw:A.",
    ),
]
Backend = Annotated[str | None, typer.Option(show_default="that of the task")]
Preset = Annotated[str | None, typer.Option(show_default="fast")]
Resolution = Annotated[str | None, typer.Option(show_default="vector")]
Policy = Annotated[str | None, typer.Option(show_default="random; still without a backend")]
Outcomes = Annotated[
    list[str] | None, typer.Option(metavar="HOW:NAME", show_default="the usual ones")
]
Trust = Annotated[list[str] | None, typer.Option(metavar="PACKAGE")]
Option = Pairs
Nature = Pairs
Changes = Annotated[list[str] | None, typer.Option("--set", metavar="NAME=VALUE")]
Seed = NotNegative
Steps = Count
Shard = Count
Files = Annotated[str, typer.Option("--format", help="Format of the table: parquet or csv.")]
Quiet = Annotated[bool, typer.Option("--quiet")]
Observations = Annotated[str | None, typer.Option(show_default="plain")]
Executor = Annotated[
    str | None,
    typer.Option("--executor", "--engine", show_default="process; with one worker serial"),
]
Workers = Annotated[
    int | None, typer.Option(min=0, show_default="1; with --executor as many as there are cores")
]
ManyWorkers = Annotated[int | None, typer.Option(min=0, show_default="as many as there are cores")]
Address = Annotated[str | None, typer.Option(metavar="HOST:PORT")]


def read_location(text: str) -> Location:
    """Return where results are, or are to be: a path or a URL.

    Raises:
        BadParameter: The URL cannot be reached from here; it says why.
    """
    try:
        return located(text)
    except ScmWorldError as error:
        raise typer.BadParameter(str(error)) from None


Out = Annotated[
    Any,  # a Location or None, which typer does not know
    typer.Option(parser=read_location, metavar="PATH", show_default="under scm-world-results"),
]

SHARED = {
    "option": "Argument of the task or model, such as num_of_levels=2 or control_dt=0.01; repeat "
    "it for more.",
    "backend": "Physics backend: mujoco, bullet, step or fake; see 'scm-world list'.",
    "preset": "Physics time step of the TriFinger: fast or precise.",
    "resolution": "Nodes of the TriFinger's graph: vector, finger or joint.",
    "seed": "Seed of every random choice.",
    "steps": "Control steps of an episode.",
    "policy": "random, still or mpc; of the TriFinger also feedback, or sweep: the fingertips go "
    "to the middle.",
    "nature": "Context distribution: what varies between episodes, such as gravity=draw:A; repeat "
    "it for more.",
    "outcome": "Outcome, such as reward or sum:reward; repeat it for more.",
    "out": "Folder for the results, or a URL such as s3://bucket/run.",
    "shard": "Episodes in one file.",
    "quiet": "Print the result only.",
    "trust": "Package whose functions may be called because results name them; repeat it for more.",
    "observations": "Observations of the policy: plain, or privileged: with every causal "
    "parameter.",
    "changes": "Any other field, such as network.hidden=[64,64] or env.frame_skip=5; the value is "
    "JSON or a word. Repeat it for more.",
    "executor": "What runs independent episodes: serial, process or ray.",
    "workers": "How many run at the same time; 0 for as many as there are cores.",
    "address": "Address of a Ray cluster, or 'auto'; without it, Ray is started on this machine.",
}
"""Help of the options that several commands have, where a docstring has no other one."""


def documented(command: Callable[..., None]) -> str:
    """Add to the options of a command the help texts of its docstring's Args, or of ``SHARED``.

    Returns:
        The help text of the command: the rest of the docstring.
    """
    text, _, described = (inspect.getdoc(command) or "").partition("\n\nArgs:\n")
    found = re.findall(r"^ {4}(\w+): (.*(?:\n {6,}.*)*)", described, flags=re.MULTILINE)
    helps = {name: " ".join(said.split()) for name, said in found}
    hints = get_type_hints(command, include_extras=True)
    for name in inspect.signature(command).parameters:
        kind, *given = get_args(hints[name]) if _is_annotated(hints[name]) else (hints[name],)
        flag = (f"--{name.replace('_', '-')}",) if kind is bool else ()
        option = copy.copy(given[0]) if given else typer.Option(*flag)
        option.help = helps.get(name) or option.help or SHARED.get(name)
        command.__annotations__[name] = Annotated[kind, option]
    return text


def _is_annotated(hint: Any) -> bool:
    return hasattr(hint, "__metadata__")


@contextmanager
def open_pool(
    executor: str | None, workers: int | None, address: str | None, what: str, *, lines: int = 0
) -> Iterator[tuple[Pool, Progress]]:
    """Open a pool, print in a line where it works, and show its progress.

    Args:
        executor: ``"serial"``, ``"process"``, ``"ray"``, or None.
        workers: How many; 0 for as many as there are cores, None for that with an executor and
            for one without.
        address: Address of a Ray cluster.
        what: See ``progress``; also ``lines``.
        lines: How many lines are printed where there is no terminal.

    Raises:
        UnknownOption: There is no such executor, or it cannot have so many workers.
    """
    from scm_world.runs.pool import Pool
    from scm_world.runs.processes import cores

    if address is not None and executor != "ray":
        allowed = (f"None with the executor {executor}; 'ray' has one",)
        raise UnknownOption("address", address, allowed)
    count = workers or None
    if executor is None:
        count = 1 if workers is None else (workers or cores())
    with Pool(address or executor, count) as pool:
        say(f"the work is done {pool.where}", stderr=True)
        with progress(what, lines=lines) as tell:
            yield pool, tell
