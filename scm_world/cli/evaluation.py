"""``scm-world evaluate`` and ``scm-world explain``."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, final

from rich.text import Text

from scm_world.cli.assignments import parse_assignments
from scm_world.cli.console import (
    RESULTS,
    check_writable,
    console,
    keep_whole,
    show,
    table,
    written,
)
from scm_world.cli.questions import shown_episodes
from scm_world.cli.tasks import build, suffix
from scm_world.errors import UnknownOption
from scm_world.evaluation import METRICS, Evaluation, check, evaluate, why
from scm_world.evaluation.files import CODECS
from scm_world.evaluation.outputs import write_outputs
from scm_world.evaluation.parts import FOLDER

INTERRUPTED = 130
SHOWN = 8  # variables that are listed
_WORDS = {"true": True, "false": False, "none": None}


@final
@dataclass(frozen=True)
class Options:
    """What is evaluated, as it was typed.

    Attributes:
        policies: With commas between them.
        task: Name of the task.
        protocols: With commas between them; None for all.
        n: Episodes of each protocol, for each seed.
        seeds: With commas between them.
        backends: With commas between them.
        env: Options of the environment, each as ``name=value``.
        arguments: Of the task, likewise.
        metric: Score that is shown.
        workers: Processes; 0 for as many as there are cores.
        form: ``"parquet"`` or ``"csv"``.
        videos: Whether episodes are filmed.
    """

    policies: str
    task: str
    protocols: str | None
    n: int
    seeds: str
    backends: str
    env: tuple[str, ...]
    arguments: tuple[str, ...]
    metric: str
    workers: int
    form: str
    videos: bool

    def folder(self) -> Path:
        """Name the folder of the results."""
        names = "-".join(policies_of(self.policies))
        about = suffix((*self.arguments, *self.env))
        return RESULTS / f"evaluate-{names}-{self.task}{about}"

    def environment(self) -> dict[str, Any]:
        """Read the options of the environment, and the arguments of the task."""
        given = parse_assignments(self.env, "'--env'")
        found = {k: _WORDS.get(v, v) if isinstance(v, str) else v for k, v in given.items()}
        if self.arguments:
            found["task_options"] = dict(build(self.task, self.arguments).given)
        return found


def policies_of(text: str) -> dict[str, list[str]]:
    """Read policies: ``NAME=POLICY`` or ``POLICY``, with commas; ``A+B`` are runs of one.

    Example:
        >>> policies_of("mine=a.onnx+b.onnx,random")
        {'mine': ['a.onnx', 'b.onnx'], 'random': ['random']}
    """
    found: dict[str, list[str]] = {}
    for word in (part.strip() for part in text.split(",")):
        name, equals, given = word.partition("=")
        runs = (given if equals else word).split("+")
        label = name.strip() if equals else Path(runs[0]).stem.replace(":", ".")
        if not word or not all(runs) or not label or label in found:
            allowed = ("names or files, each once; NAME=POLICY gives a name",)
            raise UnknownOption("policy", text, allowed)
        found[label] = runs
    return found


def run(options: Options, *, out: Path | None) -> int:
    """Evaluate, print a table, write everything; return the exit code."""
    _check(options)
    sys.path.insert(0, str(Path.cwd()))  # for a policy of one's own, beside where this is called
    folder = out or options.folder()
    check_writable(folder, folder=True)
    terminal = console()
    try:
        with shown_episodes() as progress:
            found = evaluate(
                policies_of(options.policies),
                options.protocols,
                task=options.task,
                n=options.n,
                seeds=_seeds(options.seeds),
                backend=options.backends,
                env=options.environment(),
                workers=options.workers or os.cpu_count() or 1,
                out=folder,
                progress=progress,
            )
    except KeyboardInterrupt:
        safe = len(list((folder / FOLDER).glob("*.json")))
        said = f"interrupted: {safe} files are safe in {folder}; the same command goes on"
        terminal.print(said, soft_wrap=True)
        return INTERRUPTED
    files = found.save(folder, kind=options.form)
    with shown_episodes() as progress:
        more = write_outputs(
            found, folder, metric=options.metric, videos=options.videos, progress=progress
        )
    for made in _tables(found, options.metric):
        terminal.print(keep_whole(made, terminal, 0))
    written(terminal, *files, *more)
    return 0


def _check(options: Options) -> None:
    """Refuse what could not be shown or written in the end."""
    if options.metric not in METRICS:
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
    made = table("protocol", "varied", *heads, title=title)
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
    made = table("protocol", *found.agents, title=f"{one} minus {other}, the same draws on both")
    for protocol in found.protocols:
        gaps = (found.gap(one, other, protocol, metric, agent=agent) for agent in found.agents)
        made.add_row(protocol, *(Text(str(gap)) for gap in gaps))
    return made


# --- again, and why ----------------------------------------------------------------------------


def _policy(text: str | None) -> Any:
    return None if text is None else policies_of(text)


def check_again(path: Path, episodes: int, policy: str | None) -> int:
    """Play a part of some results again; return the exit code."""
    sys.path.insert(0, str(Path.cwd()))
    results = Evaluation.load(path)
    trusted = _own(results)
    with shown_episodes() as progress:
        found = check(
            results, episodes=episodes, policy=_policy(policy), trusted=trusted, progress=progress
        )
    terminal = console()
    for line in found.wrong:
        terminal.print(Text(line), soft_wrap=True)
    said = "the same bits in all of them" if found else f"{len(found.wrong)} differ"
    chosen = f"{found.episodes} of {len(results)} episodes, chosen with seed {found.seed}"
    terminal.print(f"played again: {chosen}: {said}", soft_wrap=True)
    return 0 if found else 1


def _own(results: Evaluation) -> tuple[str, ...]:
    """Name the packages of policies that are functions: who checks results has them at hand."""
    policies = [agent["policy"] for agent in results.about["agents"]]
    names = [str(one["name"]) for one in policies if one.get("kind") == "function"]
    return tuple({name.partition(":")[0].partition(".")[0] for name in names})


@final
@dataclass(frozen=True)
class Where:
    """Which results are explained.

    Attributes:
        path: Folder or file.
        agent: Who acted, if there are several.
        engine: On which engine, if there are several.
        metric: Score that is explained.
    """

    path: Path
    agent: str | None
    engine: str | None
    metric: str


def show_causes(where: Where, protocol: str | None) -> int:
    """Print for each protocol what its variables did to the score; return the exit code."""
    results = Evaluation.load(where.path)
    agent, engine = results.the("agent", where.agent), results.the("engine", where.engine)
    terminal = console()
    for name in results.protocols if protocol is None else (protocol,):
        found = results.causes(name, where.metric, agent=agent, engine=engine)
        if not found.causes:
            continue
        score = results.score(name, where.metric, agent=agent, engine=engine)
        made = table(
            "variable",
            "share of variance",
            "p (Holm)",
            "upper - lower third",
            title=f"{name}: {agent} on {engine}, {where.metric.replace('_', ' ')} {score}",
        )
        for cause in found.ranked()[:SHOWN]:
            column = cause.column
            of = "" if column.name == cause.variable else f" ({column.name})"
            made.add_row(
                cause.variable,
                Text(str(cause.share)),
                f"{cause.p_holm:.3g}",
                Text(f"{column.contrast}{of}"),
            )
        if len(found.causes) > SHOWN:
            made.add_row(f"and {len(found.causes) - SHOWN} more", "", "", "")
        terminal.print(keep_whole(made, terminal, 0))
    return 0


def show_otherwise(where: Where, protocol: str, episode: int, versus: str | None) -> int:
    """Print what an episode would have been; return the exit code."""
    sys.path.insert(0, str(Path.cwd()))
    results = Evaluation.load(where.path)
    with shown_episodes() as progress:
        found = why(
            results,
            protocol,
            episode,
            agent=where.agent,
            engine=where.engine,
            metric=where.metric,
            versus=versus,
            trusted=_own(results),
            progress=progress,
        )
    title = f"{protocol}, episode {episode}: {where.metric.replace('_', ' ')} {found.score:.3g}"
    made = table("had it been", "instead of", "score", "success", title=title)
    for other in found.others:
        made.add_row(
            Text(f"{other.variable} = {show(other.would_be)}"),
            show(other.was),
            f"{other.would_score:.3g} ({other.gain:+.3g})",
            "yes" if other.would_succeed else "no",
        )
    for name, reason in found.left_out.items():
        made.add_row(Text(name), "", "left out", Text(reason))
    terminal = console()
    terminal.print(made)
    return 0
