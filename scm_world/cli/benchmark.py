"""``scm-world discover … --learner``: a benchmark of learners."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scm_world.cli.console import RESULTS, check_writable, console, table, written
from scm_world.cli.questions import POLICIES
from scm_world.cli.tasks import build, suffix
from scm_world.cli.working import Work
from scm_world.discovery.benchmark_report import COLUMNS, HEADS, STANDARDISED, SummaryRow, summary
from scm_world.discovery.benchmarks import BenchmarkResult, benchmark, slug
from scm_world.discovery.problems import FAMILIES, GroundTruth, TaskView
from scm_world.errors import UnknownOption
from scm_world.output.locations import Location

if TYPE_CHECKING:
    from rich.console import Console

    from scm_world.queries.progress import Progress

INTERRUPTED = 130
BRIEF = ("shd", STANDARDISED, "f1", "precision", "recall", "auprc", "sid", "experiments", "seconds")


def run(
    problems: str,
    learners: str,
    data: str | None,
    budgets: str,
    seeds: int,
    view: TaskView,
    timeout: float,
    work: Work,
    arguments: tuple[str, ...],
    out: Location | None,
) -> int:
    """Run a benchmark, print a table, write everything; return the exit code.

    Args:
        problems: Names with commas between them, like learners, data and budgets.
        learners: Names.
        data: Kinds of data; None for the best of each learner.
        budgets: Numbers.
        seeds: How many.
        view: Of tasks and worlds.
        timeout: Of a run [s]; 0 for no limit.
        work: Where the runs are done.
        arguments: Of the task, each as ``name=value``.
        out: Folder for the results.
    """
    if ":" in learners:  # a custom learner, beside where the command is called
        sys.path.insert(0, str(Path.cwd()))
    names, who = _split(problems), _split(learners)
    worlds = [n for n in names if n.partition(":")[0] not in FAMILIES and not n.endswith(".json")]
    if view.policy not in (*POLICIES, "usual"):
        raise UnknownOption("policy", view.policy, (*POLICIES, "usual"))
    if view.policy == "still":
        view = replace(view, policy=None)
    if arguments:
        if len(names) != 1 or not worlds:
            allowed = ("one task, if --option is given",)
            raise UnknownOption("problem", problems, allowed)
        view = replace(view, arguments=dict(build(names[0], arguments).given))
    for budget in _split(budgets):
        if not budget.isdecimal():
            raise UnknownOption("budget", budget, ("whole numbers with commas between them",))
    looked = f"-{view.view}" if worlds else ""
    usual = f"benchmark-{'-'.join(map(slug, (*names, *who)))}{looked}{suffix(arguments)}"
    folder = out or RESULTS / usual
    check_writable(folder, folder=True)
    terminal = console()
    try:
        with work.begun(usual="process") as executor, shown_runs() as progress:
            result = benchmark(
                who,
                names,
                list(map(int, _split(budgets))),
                seeds,
                data=_split(data or ""),
                view=view,
                timeout=timeout or None,
                out=folder,
                engine=executor,
                progress=progress,
            )
    except KeyboardInterrupt:
        done = len(list(folder.glob("runs/*/*.json")))
        said = f"interrupted: {done} runs are safe in {folder}; the same command resumes"
        terminal.print(said, soft_wrap=True)
        return INTERRUPTED
    _print(terminal, result)
    files = ("report.html", "results.md", "results.csv", "budget.png")
    written(terminal, *(folder / name for name in files))
    return 0


def _print(terminal: Console, result: BenchmarkResult) -> None:
    """Print a table for each problem, then why runs were not done."""
    for name, rows in summary(result).items():
        terminal.print(_table(result.problems[name], rows))
    ended = Counter((r.learner, r.problem, r.message) for r in result.runs if r.status != "done")
    for (learner, problem, reason), runs in ended.items():
        said = f"{learner} on {problem}, not done in {runs} run(s): {' '.join(reason.split())}"
        terminal.print(said, soft_wrap=True, markup=False)


def _split(text: str) -> list[str]:
    return list(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))


@contextmanager
def shown_runs() -> Iterator[Progress]:
    """Show how many runs are done: a bar on a terminal, some plain lines elsewhere."""
    terminal = console(stderr=True)
    if not terminal.is_terminal:

        def plain(done: int, planned: int) -> None:
            if done == planned or done % max(1, planned // 10) == 0:
                terminal.print(f"run {done} of {planned}")

        yield plain
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    columns = ("runs", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=terminal, transient=True) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, planned: bar.update(task, completed=done, total=planned)


def _table(truth: GroundTruth, rows: list[SummaryRow]) -> Any:
    """Write the means over seeds of one problem; the ranges are in ``results.md``."""
    from rich.text import Text

    title = f"{truth.name}: {len(truth.names)} variables, {len(truth.edges)} true edges"
    columns = [column for column in COLUMNS if column.key in BRIEF]
    shown = table(*HEADS[1:], *(column.title for column in columns), title=title)
    for row in rows:
        means = (
            Text(row.text(c).partition(" [")[0], "bold" if c.key in row.best else "")
            for c in columns
        )
        shown.add_row(*row.heads[1:], *means)
    return shown
