"""``scm-world collect``: a dataset from interventions, in a folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, final

import numpy as np

from scm_world.cli.assignments import parse_assignments
from scm_world.cli.console import check_writable, console, table, written
from scm_world.cli.questions import Circumstances, read_outcome, shown_episodes
from scm_world.cli.tasks import tag
from scm_world.cli.working import Work
from scm_world.discovery.data import Dataset, Design, collect, default_causes
from scm_world.discovery.data.folders import SIDECAR
from scm_world.discovery.data.recorded import settable
from scm_world.errors import UnknownOption
from scm_world.output.locations import Location
from scm_world.variables.kinds import SPACES

if TYPE_CHECKING:
    from scm_world.queries import Outcome, World
    from scm_world.work.executors import Executor

INTERRUPTED = 130
SHOWN = 12  # targets that are listed


@final
@dataclass(frozen=True)
class Options:
    """What to collect.

    Attributes:
        where: The world, who acts, and the seed.
        n: How many episodes.
        design: Name of the design.
        targets: Patterns of what is intervened on; the causes if there are none.
        causes: Patterns of the parameters that are written down; the usual ones if there are none.
        outcomes: What is measured, each as ``name``, ``name[2]`` or ``how:name``.
        values: The space that values are drawn from.
        observational_fraction: The share of episodes in which nothing is done.
        nature: What varies by itself, each as ``name=value``.
        every_step: Whether there is a row for each control step.
        shard: Episodes in a file.
        files: ``"parquet"`` or ``"csv"``.
        work: Where the episodes happen.
    """

    where: Circumstances
    n: int
    design: str
    targets: tuple[str, ...]
    causes: tuple[str, ...]
    outcomes: tuple[str, ...]
    values: str
    observational_fraction: float
    nature: tuple[str, ...]
    every_step: bool
    shard: int
    files: str
    work: Work


def run(options: Options, *, out: Location | None) -> int:
    """Collect, print a summary; return the exit code."""
    if options.values not in SPACES:
        raise UnknownOption("values", options.values, SPACES)
    check_files(options.files)
    where = options.where
    folder = out or where.folder(f"collect-{options.design}")
    check_writable(folder, folder=True)
    world = where.world()
    terminal = console()
    try:
        with options.work.begun() as executor, shown_episodes() as progress:
            found = _collected(world, options, folder, executor, progress)
    except KeyboardInterrupt:
        terminal.print(kept(folder, options.n, options.shard), soft_wrap=True)
        return INTERRUPTED
    finally:
        world.close()
    terminal.print(
        _summary(found, f"{tag(where.task)} on {found.about['engine']}, seed {where.seed}")
    )
    shards = list[Location](folder.glob("shard-*.*"))
    written(terminal, folder / SIDECAR, *sorted(shards, key=str)[:1])
    return 0


def check_files(kind: str) -> None:
    """Refuse files that could not be written in the end.

    Raises:
        UnknownOption: What writes Parquet is not installed.
    """
    if kind == "parquet" and find_spec("pyarrow") is None:
        allowed = ("csv", "parquet after: pip install 'scm-world[data]'")
        raise UnknownOption("format", "parquet", allowed)


def kept(folder: Location, episodes: int, shard: int) -> str:
    """Say what an interruption has left of episodes in shards."""
    safe, whole = len(list(folder.glob("shard-*.*"))), -(-episodes // shard)
    return f"interrupted: {safe} of {whole} files are safe in {folder}; the same command goes on"


def _collected(
    world: World, options: Options, folder: Location, executor: Executor, progress: Any
) -> Dataset:
    where, patterns = options.where, options.targets or options.causes
    targets: Sequence[str] = ()
    if options.design != "observational":
        targets = settable(world, patterns) if patterns else default_causes(world)
    return collect(
        world,
        Design(options.design, tuple(targets), options.values, options.observational_fraction),
        options.n,
        seed=where.seed,
        out=folder,
        shard=options.shard,
        format=options.files,
        progress=progress,
        engine=executor,
        steps=where.steps,
        policy=where.acts,
        nature=parse_assignments(options.nature, "'--nature'"),
        causes=options.causes or None,
        outcomes=[read_measure(text) for text in options.outcomes] or None,
        every_step=options.every_step,
    )


def read_measure(text: str) -> Outcome:
    """Read what is measured: its final value, or ``how:name``.

    Example:
        >>> print(read_measure("reward"), read_measure("sum:reward"))
        final reward sum reward
    """
    how, _, name = text.rpartition(":")
    return read_outcome(name, how or "final")


def _summary(found: Dataset, title: str) -> Any:
    """Write down how many rows there are, and how often each target was one."""
    made = table("", "episodes", "rows", title=f"Collected from {title}")
    _, first = np.unique(found.episode, return_index=True)
    made.add_row("all", str(len(first)), str(len(found)))
    targets = [found.regimes[number].targets for number in found.regime]
    begins = [targets[row] for row in first]
    made.add_row("nothing done", str(begins.count(())), str(targets.count(())))
    names = sorted({name for targets in begins for name in targets})
    for name in names[:SHOWN]:
        counts = (sum(name in row for row in rows) for rows in (begins, targets))
        made.add_row(f"do({name})", *map(str, counts))
    if len(names) > SHOWN:
        made.add_row(f"and {len(names) - SHOWN} more targets", "", "")
    made.add_row("columns", "", str(len(found.columns)))
    refused = found.about.get("refused", {})
    if refused:
        made.add_row("refused", str(len(refused)), f"see {SIDECAR}")
    return made
