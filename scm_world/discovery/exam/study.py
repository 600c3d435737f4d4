"""An exam from beginning to end: learners on subjects, in a folder that can be gone on with."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from threading import Event
from typing import Any, final

from scm_world.discovery.exam.html import write_report
from scm_world.discovery.exam.pictures import draw_budget
from scm_world.discovery.exam.results import Cell, Exam, Truth, read_cell, write_json, write_whole
from scm_world.discovery.exam.runs import Job, Runner, shown_name, source_for
from scm_world.discovery.exam.subjects import TaskView, check_subject
from scm_world.discovery.exam.tables import write_tables
from scm_world.discovery.learners.registry import SOURCES, learner
from scm_world.errors import MissingExtra, UnknownOption, UnreadableFile
from scm_world.queries.experiments.versions import versions
from scm_world.queries.progress import Progress
from scm_world.world.start import whole_number

FORMAT = "scm_world/study/1"
SHARES = (8, 4, 2, 1)
"""A single budget N is spent as N/8, N/4, N/2 and N, so that there is a curve."""


@final
@dataclass(frozen=True)
class Study:
    """What is examined.

    Attributes:
        subjects: Tasks, families with a size (``"er2:20"``), files of models.
        learners: By name.
        data: Kinds of data; what each learner can make most of if empty.
        budgets: How many rows, episodes or experiments a learner may use; of a single one, shares
            are tried, too.
        seeds: How many: models, data and learners are drawn anew with each.
        view: How tasks are looked at.
        timeout: Of a run [s]; None for no limit.
        standardised: Whether the largest budget is also run on standardised data.

    Raises:
        UnknownOption: Something does not exist, or a learner cannot use a kind of data.
        MissingExtra: A learner is not installed.
    """

    subjects: tuple[str, ...]
    learners: tuple[str, ...]
    data: tuple[str, ...] = ()
    budgets: tuple[int, ...] = (1000,)
    seeds: int = 3
    view: TaskView = field(default_factory=TaskView)
    timeout: float | None = 300.0
    standardised: bool = True

    def __post_init__(self) -> None:
        """Check everything that can be seen beforehand."""
        for what in ("subjects", "learners", "budgets"):
            if not getattr(self, what):
                raise UnknownOption(what, "none", ("one or more",))
        for name in self.subjects:
            check_subject(name)
        for budget in self.budgets:
            whole_number("budget", budget, least=1)
        whole_number("seeds", self.seeds, least=1)
        for kind in self.data:
            if kind not in SOURCES:
                raise UnknownOption("kind of data", kind, SOURCES)
        for name in self.learners:
            chosen = learner(name)
            if not chosen.is_installed:
                raise MissingExtra(chosen.package, chosen.extra)
            for kind in self.data:
                source_for(chosen, kind)

    @property
    def spent(self) -> tuple[int, ...]:
        """The budgets that are run, in order."""
        if len(self.budgets) > 1:
            return tuple(sorted(set(self.budgets)))
        only = self.budgets[0]
        return tuple(sorted({max(1, only // share) for share in SHARES}))

    def jobs(self, folder: Path | None) -> Iterator[tuple[Job, ...]]:
        """List the runs, those of one subject and seed together."""
        for name in self.subjects:
            for seed in range(self.seeds):
                yield tuple(self._jobs(name, seed, folder))

    def _jobs(self, name: str, seed: int, folder: Path | None) -> Iterator[Job]:
        place = None if folder is None else folder / "data" / slug(shown_name(name, self.view))
        for who in self.learners:
            chosen = learner(who)
            for kind in self.data or (None,):
                source = source_for(chosen, kind)
                for budget in self.spent:
                    last = budget == self.spent[-1]
                    for even in (False, True):
                        if even and not (last and self.standardised and source != "paired"):
                            continue
                        yield Job(
                            name, who, source, budget, self.spent[-1], seed, even, self.view, place
                        )

    def as_dict(self) -> dict[str, Any]:
        """Write it as plain data."""
        return {"format": FORMAT, **asdict(self)}


def slug(name: str) -> str:
    """Turn a name into one of a file, another one for each name.

    Example:
        >>> slug("er2:20"), slug("pcmci+")
        ('er2_20-7b9c', 'pcmci_-0bd1')
    """
    plain = re.sub(r"[^A-Za-z0-9.-]", "_", name)
    mark = hashlib.sha256(name.encode()).hexdigest()[:4]
    return plain if plain == name else f"{plain}-{mark}"


def cell_path(folder: Path, job: Job) -> Path:
    """Say where the result of a run is kept."""
    even = "-standardised" if job.standardised else ""
    run = f"{slug(job.learner)}-{job.data}-{job.budget}-seed{job.seed}{even}.json"
    return folder / "cells" / slug(job.truth_name) / run


def examine(
    study: Study, out: Path | str, *, workers: int = 1, progress: Progress | None = None
) -> Exam:
    """Let learners sit an exam, and write down how they did.

    Every run is a file of its own in the folder, written whole or not at all; so are the shards of
    the data. Interrupted, even killed, the same call goes on where it was: at most the runs that
    were going on are lost.

    Args:
        study: What is examined.
        out: Folder: new, empty, or one of the same study.
        workers: Processes that run learners; the graphs found do not depend on how many.
        progress: Told after each run.

    Returns:
        All results, which are also written as ``results.csv``, ``results.md``, ``budget.png`` and
        ``report.html``.

    Raises:
        UnreadableFile: The folder is one of another study, or a file in it is damaged.
        ScmWorldError: A subject cannot be made, or data cannot be collected or written.
    """
    folder = Path(out)
    _begun(study, folder)
    groups = list(study.jobs(folder))
    total = sum(map(len, groups))
    cells: list[Cell] = []
    truths: dict[str, Truth] = {}
    runners: list[Runner] = []
    stopped = Event()

    def told(cell: Cell) -> None:
        cells.append(cell)
        if progress is not None:
            progress(len(cells), total)

    def work(jobs: Sequence[Job]) -> None:
        runner = Runner(study.timeout)
        runners.append(runner)
        try:
            if stopped.is_set():
                return
            truth = runner.truth(jobs[0])
            truths.setdefault(truth.name, truth) if jobs[0].seed else truths.update(
                {truth.name: truth}
            )
            for job in jobs:
                if stopped.is_set():
                    return
                told(_ran(runner, folder, job))
        finally:
            runner.stop()

    with ThreadPoolExecutor(max(1, workers)) as pool:
        futures = [pool.submit(work, jobs) for jobs in groups]
        try:
            for future in futures:
                future.result()
        except BaseException:
            stopped.set()
            for future in futures:
                future.cancel()
            for runner in runners:
                runner.interrupt()
            raise
    ordered = {shown_name(n, study.view): truths[shown_name(n, study.view)] for n in study.subjects}
    exam = Exam(ordered, tuple(cells), {"study": study.as_dict(), "versions": versions()})
    return written(exam, folder)


def _ran(runner: Runner, folder: Path, job: Job) -> Cell:
    """Read the result of a run, or run it and write it."""
    path = cell_path(folder, job)
    if path.exists():
        return read_cell(path)
    cell = runner.run(job)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(cell, path)
    return cell


def _begun(study: Study, folder: Path) -> None:
    """Begin a folder, or check that it is one of the same study."""
    head = json.loads(json.dumps({**study.as_dict(), "versions": versions()}))
    path = folder / "study.json"
    if not path.exists():
        if folder.exists() and any(folder.iterdir()):
            advice = "give an empty folder, or one of an earlier exam"
            raise UnreadableFile(str(folder), "it holds something else", advice)
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(json.dumps(head, indent=1) + "\n", path)
        return
    try:
        there = json.loads(path.read_text(encoding="utf-8"))
        different = [key for key in head if there[key] != head[key]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        advice = "give another folder"
        raise UnreadableFile(str(path), f"it describes no exam: {error}", advice) from None
    if different:
        reason = f"it is one of another exam: {', '.join(different)} differ"
        raise UnreadableFile(str(folder), reason, "give another folder")


def written(exam: Exam, folder: Path) -> Exam:
    """Write the table, the picture and the report."""
    write_json(exam, folder / "exam.json")
    write_tables(exam, folder)
    draw_budget(exam, folder / "budget.png")
    write_report(exam, folder / "report.html")
    return exam
