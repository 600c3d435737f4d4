"""``scm-world discover … --learner``: learners examined on a task, a family or a model."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from scm_world.cli.console import RESULTS, check_writable, console, table, written
from scm_world.cli.questions import POLICIES
from scm_world.cli.tasks import build, suffix
from scm_world.cli.working import Work
from scm_world.discovery.exam.results import Exam
from scm_world.discovery.exam.runs import slug
from scm_world.discovery.exam.study import Study, examine
from scm_world.discovery.exam.subjects import VIEWS, TaskView
from scm_world.discovery.exam.tables import COLUMNS, HEADS, STANDARDISED, best, by_subject
from scm_world.errors import UnknownOption
from scm_world.output.locations import Location
from scm_world.tasks import TASKS

if TYPE_CHECKING:
    from scm_world.queries.progress import Progress

INTERRUPTED = 130
BRIEF = ("shd", STANDARDISED, "f1", "precision", "recall", "auprc", "sid", "experiments", "seconds")


@final
@dataclass(frozen=True)
class Options:
    """What is examined, as it was typed.

    Attributes:
        subjects: Tasks, families or files, with commas between them.
        learners: With commas between them.
        data: Kinds of data, with commas between them; None for the best of each learner.
        budget: Numbers with commas between them.
        seeds: How many.
        view: How tasks are looked at.
        timeout: Of a run [s]; 0 for no limit.
        work: Where the runs are done.
        arguments: Of the tasks, each as ``name=value``.
    """

    subjects: str
    learners: str
    data: str | None
    budget: str
    seeds: int
    view: TaskView
    timeout: float
    work: Work
    arguments: tuple[str, ...] = ()


def run(options: Options, *, out: Location | None) -> int:
    """Examine, print a table, write everything; return the exit code."""
    if ":" in options.learners:  # a learner of one's own, beside where the command is called
        sys.path.insert(0, str(Path.cwd()))
    study = study_of(options)
    names = "-".join(map(slug, (*study.subjects, *study.learners)))
    tasks = not TASKS.keys().isdisjoint(study.subjects)
    looked = f"-{options.view.view}" if tasks else ""
    folder = out or RESULTS / f"exam-{names}{looked}{suffix(options.arguments)}"
    check_writable(folder, folder=True)
    terminal = console()
    try:
        with options.work.begun(usual="process") as executor, shown_runs() as progress:
            exam = examine(study, folder, engine=executor, progress=progress)
    except KeyboardInterrupt:
        done = len(list(folder.glob("cells/*/*.json")))
        said = f"interrupted: {done} runs are safe in {folder}; the same command goes on"
        terminal.print(said, soft_wrap=True)
        return INTERRUPTED
    for name in exam.subjects:
        terminal.print(_table(exam, name))
    files = ("report.html", "results.md", "results.csv", "budget.png")
    written(terminal, *(folder / name for name in files))
    return 0


def study_of(options: Options) -> Study:
    """Read what was typed.

    Raises:
        UnknownOption: Something does not exist.
    """
    subjects = _split(options.subjects)
    arguments: dict[str, Any] = {}
    if options.arguments:
        if len(subjects) != 1 or subjects[0] not in TASKS:
            allowed = ("one task, if --option is given",)
            raise UnknownOption("subject", options.subjects, allowed)
        arguments = dict(build(subjects[0], options.arguments).given)
    view = options.view
    return Study(
        subjects=subjects,
        learners=_split(options.learners),
        data=_split(options.data or ""),
        budgets=tuple(map(_whole, _split(options.budget))),
        seeds=options.seeds,
        view=replace(view, arguments=arguments),
        timeout=options.timeout or None,
    )


def _split(text: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))


def _whole(text: str) -> int:
    if not text.isdecimal():
        raise UnknownOption("budget", text, ("whole numbers with commas between them",))
    return int(text)


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


def _table(exam: Exam, name: str) -> Any:
    """Write the means over seeds of one subject; the ranges are in ``results.md``."""
    from rich.text import Text

    truth = exam.subjects[name]
    title = f"{name}: {len(truth.names)} variables, {len(truth.edges)} declared edges"
    columns = [column for column in COLUMNS if column.key in BRIEF]
    made = table(*HEADS[1:], *(column.title for column in columns), title=title)
    rows = by_subject(exam)[name]
    bold = best(rows)
    for number, row in enumerate(rows):
        means = (row.text(column).partition(" [")[0] for column in columns)
        cells = [
            Text(mean, style="bold" if (number, column.key) in bold else "")
            for mean, column in zip(means, columns, strict=True)
        ]
        made.add_row(*row.heads[1:], *cells)
    return made


def view(
    name: str,
    causes: Sequence[str] | None,
    outcomes: Sequence[str] | None,
    policy: str,
    steps: int,
    sensor_noise: float,
    backend: str,
    preset: str | None,
) -> TaskView:
    """Put together how tasks are looked at.

    Raises:
        UnknownOption: There is no such view or policy.
    """
    if name not in VIEWS:
        raise UnknownOption("view", name, VIEWS)
    if policy not in (*POLICIES, "usual"):
        raise UnknownOption("policy", policy, (*POLICIES, "usual"))
    return TaskView(
        view=name,
        causes=tuple(causes) if causes else None,
        outcomes=tuple(outcomes) if outcomes else None,
        policy=None if policy == "still" else policy,
        steps=steps,
        sensor_noise=sensor_noise,
        options={"backend": backend, **({"preset": preset} if preset else {})},
    )
