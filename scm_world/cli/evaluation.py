"""``scm-world evaluate``."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, final

from rich.markup import escape
from rich.text import Text

from scm_world.cli.assignments import parse_assignments
from scm_world.cli.console import (
    RESULTS,
    check_writable,
    console,
    keep_whole,
    table,
    written,
)
from scm_world.cli.questions import shown_episodes
from scm_world.cli.tasks import build, suffix
from scm_world.cli.working import Work
from scm_world.errors import UnknownOption
from scm_world.evaluation import METRICS, Evaluation, evaluate
from scm_world.evaluation.files import CODECS
from scm_world.evaluation.players import NAMES
from scm_world.evaluation.reporting import write_outputs
from scm_world.evaluation.setups import task_of
from scm_world.evaluation.shards import FOLDER
from scm_world.output.locations import Location

INTERRUPTED = 130
_WORDS = {"true": True, "false": False, "none": None}


@final
@dataclass(frozen=True)
class Options:
    """What is evaluated, as it was typed.

    Attributes:
        policies: With commas between them.
        task: Name of the task; None for the one that the policies were trained for.
        protocols: With commas between them; None for all.
        n: Episodes of each protocol, for each seed.
        seeds: With commas between them.
        backends: With commas between them.
        env: Options of the environment, each as ``name=value``.
        arguments: Of the task, likewise.
        metric: Score that is shown.
        work: Where the episodes are played.
        form: ``"parquet"`` or ``"csv"``.
        videos: Whether episodes are filmed.
    """

    policies: str
    task: str | None
    protocols: str | None
    n: int
    seeds: str
    backends: str
    env: tuple[str, ...]
    arguments: tuple[str, ...]
    metric: str | None
    work: Work
    form: str
    videos: bool

    def folder(self) -> Path:
        """Name the folder of the results."""
        names = "-".join(policies_of(self.policies))
        about = suffix((*self.arguments, *self.env))
        return RESULTS / f"evaluate-{names}-{self.as_task()}{about}"

    def environment(self) -> dict[str, Any]:
        """Read the options of the environment, and the arguments of the task."""
        given = parse_assignments(self.env, "'--env'")
        found = {k: _WORDS.get(v, v) if isinstance(v, str) else v for k, v in given.items()}
        if self.arguments:
            found["task_options"] = dict(build(self.as_task(), self.arguments).given)
        return found

    def as_task(self) -> str:
        """Name the task, also if it was not typed."""
        return self.task or task_of(policies_of(self.policies))


def policies_of(text: str) -> dict[str, list[str]]:
    """Read policies: ``NAME=POLICY`` or ``POLICY``, with commas; ``A+B`` are runs of one.

    Example:
        >>> policies_of("mine=a.onnx+b.onnx,random")
        {'mine': ['a.onnx', 'b.onnx'], 'random': ['random']}
    """
    found: dict[str, list[str]] = {}
    for word in (part.strip() for part in text.split(",")):
        name, equals, given = word.partition("=")
        is_path = word not in NAMES and Path(word).exists()  # which may have any letters
        if is_path:
            name, equals, given = "", "", word
        runs = [word] if is_path else (given if equals else word).split("+")
        label = name.strip() if equals else _label(runs[0])
        if not word or not all(runs) or not label or label in found:
            allowed = ("names or files, each once; NAME=POLICY gives a name",)
            raise UnknownOption("policy", text, allowed)
        found[label] = runs
    return found


def _label(policy: str) -> str:
    """Name an agent after a file, a folder, or a function."""
    is_folder = Path(policy).is_dir()
    if ":" in policy and not is_folder:
        return policy.replace(":", ".")
    return Path(policy).resolve().name if is_folder else Path(policy).stem


def run(options: Options, *, out: Location | None) -> int:
    """Evaluate, print a table, write everything; return the exit code."""
    _check(options)
    sys.path.insert(0, str(Path.cwd()))  # for a policy of one's own, beside where this is called
    options = replace(options, task=options.as_task())
    folder = out or options.folder()
    check_writable(folder, folder=True)
    terminal = console()
    try:
        with options.work.begun() as executor, shown_episodes() as progress:
            found = evaluate(
                policies_of(options.policies),
                options.protocols,
                task=options.task,
                n=options.n,
                seeds=_seeds(options.seeds),
                backend=options.backends,
                env=options.environment(),
                engine=executor,
                out=folder,
                progress=progress,
            )
    except KeyboardInterrupt:
        safe = len(list((folder / FOLDER).glob("*.json")))
        said = f"interrupted: {safe} files are safe in {folder}; the same command goes on"
        terminal.print(said, soft_wrap=True)
        return INTERRUPTED
    metric = options.metric or next(name for name in METRICS if name in found.metrics)
    files = found.save(folder, kind=options.form)
    with shown_episodes() as progress:
        more = write_outputs(found, folder, metric=metric, videos=options.videos, progress=progress)
    for made in _tables(found, metric):
        terminal.print(keep_whole(made, terminal, 0))
    written(terminal, *files, *more)
    return 0


def _check(options: Options) -> None:
    """Refuse what could not be shown or written in the end."""
    if options.metric not in (None, *METRICS):
        raise UnknownOption("metric", options.metric, METRICS)
    if options.form not in CODECS:
        raise UnknownOption("format", options.form, CODECS)
    if options.form == "parquet" and find_spec("pyarrow") is None:
        allowed = ("csv", "parquet after: pip install 'scm-world[data]'")
        raise UnknownOption("format", "parquet", allowed)
    if options.videos and find_spec("moviepy") is None:
        needed = ("none, or after: pip install 'scm-world[video]'",)
        raise UnknownOption("videos", "--videos", needed)


def _seeds(text: str) -> tuple[int, ...]:
    words = [word.strip() for word in text.split(",")]
    if not all(word.isdecimal() for word in words):
        raise UnknownOption("seeds", text, ("whole numbers with commas between them",))
    return tuple(map(int, words))


def _tables(found: Evaluation, metric: str) -> Iterable[Any]:
    """Write down the scores, and the gaps between engines."""
    title = f"{metric.replace('_', ' ')} in {found.task}, with 95 % intervals"
    doers = [(agent, engine) for engine in found.engines for agent in found.agents]
    heads = [agent if len(found.engines) == 1 else f"{agent}, {engine}" for agent, engine in doers]
    made = table("protocol", "varied", *map(escape, heads), title=title)
    docs = {one["name"]: one.get("doc", "") for one in found.about["protocols"]}
    for protocol in found.protocols:
        scores = (
            str(found.score(protocol, metric, agent=agent, engine=engine))
            for agent, engine in doers
        )
        made.add_row(protocol, Text(docs.get(protocol, "")), *map(Text, scores))
    yield made
    if len(found.engines) == 2:
        yield _gaps(found, metric)


def _gaps(found: Evaluation, metric: str) -> Any:
    one, other = found.engines
    made = table(
        "protocol", *map(escape, found.agents), title=f"{one} minus {other}, the same draws on both"
    )
    for protocol in found.protocols:
        gaps = (found.gap(one, other, protocol, metric, agent=agent) for agent in found.agents)
        made.add_row(protocol, *(Text(str(gap)) for gap in gaps))
    return made
