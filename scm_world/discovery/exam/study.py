"""An exam from beginning to end: learners on subjects, in a folder that can be gone on with."""

from __future__ import annotations

import hashlib
import inspect
import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, final

from scm_world.discovery.exam.html import write_report
from scm_world.discovery.exam.pictures import draw_budget
from scm_world.discovery.exam.results import Exam, write_json
from scm_world.discovery.exam.runs import Job, shown_name, slug, source_for
from scm_world.discovery.exam.sittings import Sitting
from scm_world.discovery.exam.subjects import VIEWS, TaskView, check_subject, subject, subject_mark
from scm_world.discovery.exam.tables import write_tables
from scm_world.discovery.learners.registry import SOURCES, Learner, learner
from scm_world.errors import MissingExtra, UnknownOption, UnreadableFile
from scm_world.output.durable import draft_of, locked, made, write_whole
from scm_world.output.locations import Location, located
from scm_world.queries.experiments.versions import versions
from scm_world.queries.policies import as_policy
from scm_world.queries.progress import Progress
from scm_world.tasks import TASKS
from scm_world.work.executors import Executor, opened
from scm_world.work.processes import PROCESS
from scm_world.world.start import whole_number

FORMAT = "scm_world/study/1"
PACKAGE = "scm_world"
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
        self._check_names_and_time()
        for budget in self.budgets:
            whole_number("budget", budget, least=1)
        whole_number("seeds", self.seeds, least=1)
        self._check_learners()

    def _check_learners(self) -> None:
        for kind in self.data:
            if kind not in SOURCES:
                raise UnknownOption("kind of data", kind, SOURCES)
        for chosen in map(learner, self.learners):
            if not chosen.is_installed:
                raise MissingExtra(chosen.package, chosen.extra)
            for kind in self.data:
                source_for(chosen, kind)
            for name in self.subjects:
                _check_fit(chosen, name)

    def _check_names_and_time(self) -> None:
        shown = tuple(shown_name(name, self.view) for name in self.subjects)
        for what, names in (("subjects", shown), ("learners", self.learners), ("data", self.data)):
            if len(set(names)) < len(names):
                raise UnknownOption(what, ", ".join(names), ("names, each of them once",))
        if self.timeout is not None and not 0.0 < self.timeout < math.inf:
            raise UnknownOption("timeout", self.timeout, ("seconds, more than 0", "None"))

    @property
    def spent(self) -> tuple[int, ...]:
        """The budgets that are run, in order."""
        if len(self.budgets) > 1:
            return tuple(sorted(set(self.budgets)))
        only = self.budgets[0]
        return tuple(sorted({max(1, only // share) for share in SHARES}))

    def jobs(self, folder: Location | None) -> Iterator[tuple[Job, ...]]:
        """List the runs, those of one subject and seed together."""
        for name in self.subjects:
            for seed in range(self.seeds):
                yield tuple(self._jobs(name, seed, folder))

    def _jobs(self, name: str, seed: int, folder: Location | None) -> Iterator[Job]:
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


def _check_fit(chosen: Learner, name: str) -> None:
    """Refuse a learner whose own experiments cannot be done on a subject.

    Raises:
        UnknownOption: With what can be done.
    """
    if chosen.claims:
        claims = ("a learner that is not handed the graph; 'coloring' checks one",)
        raise UnknownOption("learner in an exam", chosen.name, claims)
    if chosen.on == "worlds":
        bodies = ("a learner of variables; this one is of bodies: scm_world.discovery.learn(…)",)
        raise UnknownOption("learner in an exam", chosen.name, bodies)
    if chosen.on == "models" and name in TASKS:
        models = ("families of models and files of models", "'paired' for a task")
        raise UnknownOption(f"subject of {chosen.name}", name, models)


def examine(
    study: Study,
    out: Location | str,
    *,
    workers: int | None = None,
    engine: Executor | str | None = None,
    address: str | None = None,
    progress: Progress | None = None,
) -> Exam:
    """Let learners sit an exam, and write down how they did.

    Every run is a file of its own in the folder, written whole or not at all; so are the shards of
    the data. Interrupted, even killed, the same call goes on where it was: at most the runs that
    were going on are lost.

    Args:
        study: What is examined.
        out: Folder, or a URL: new, empty, or one of the same study.
        workers: How many runs are done at the same time; the graphs found do not depend on how
            many. None is one; with an engine it is as many as there are cores.
        engine: What does them: ``"process"``, ``"serial"``, ``"ray"``, or an executor; see
            ``engine_of``. A run has a process of its own on all of them, which ends when it takes
            too long. On Ray, each worker collects data for itself, and keeps no file of them.
        address: Of a Ray cluster.
        progress: Told after each run.

    Returns:
        All results, which are also written as ``results.csv``, ``results.md``, ``budget.png`` and
        ``report.html``.

    Raises:
        UnreadableFile: The folder is one of another study, a file in it is damaged, or another
            process is writing to it.
        ScmWorldError: A subject cannot be made, or data cannot be collected or written.
    """
    folder = located(out)
    if engine is None:
        engine, workers = PROCESS, 1 if workers is None else workers
    with opened(engine, workers, address) as executor:
        _begun(study, folder)
        with locked(folder):
            return _examined(study, folder, executor, progress)


def _examined(
    study: Study, folder: Location, executor: Executor, progress: Progress | None
) -> Exam:
    sitting = Sitting(list(study.jobs(folder)), folder, study.timeout, progress)
    sitting.hold(executor)
    names = [shown_name(name, study.view) for name in study.subjects]
    about = {"study": study.as_dict(), "versions": versions()}
    exam = Exam({n: sitting.truths[n] for n in names}, tuple(sitting.cells), about)
    return written(exam, folder)


def _begun(study: Study, folder: Location) -> None:
    """Begin a folder, or check that it is one of the same study."""
    marks = {name: subject_mark(name, study.view) for name in study.subjects}
    marks |= {name: _source_mark(learner(name)) for name in study.learners}
    head = json.loads(json.dumps({**study.as_dict(), "versions": versions(), "marks": marks}))
    path = folder / "study.json"
    if not path.exists():
        if folder.exists() and not _is_free(folder):
            advice = "give an empty folder, or one of an earlier exam"
            raise UnreadableFile(str(folder), "it holds something else", advice)
        if study.view.view not in VIEWS:
            raise UnknownOption("view", study.view.view, VIEWS)
        as_policy(study.view.acts)
        for name in study.subjects:
            subject(name, view=study.view).close()
        made(folder)
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


def _source_mark(chosen: Learner) -> str:
    """Give something that changes with a learner: its code, or the version of its library."""
    function = getattr(chosen.learn, "func", chosen.learn)
    try:
        file = inspect.getsourcefile(inspect.unwrap(function))
    except TypeError:
        file = None
    if file is None or function.__module__.partition(".")[0] == PACKAGE:
        return chosen.version or ""
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()[:16]


def _is_free(folder: Location) -> bool:
    """Tell whether a folder holds nothing, but for a beginning that was interrupted."""
    drafts = {draft_of(folder / "study.json").name}
    return folder.is_dir() and {path.name for path in folder.iterdir()} <= drafts


def written(exam: Exam, folder: Location) -> Exam:
    """Write the table, the picture and the report."""
    write_json(exam, folder / "exam.json")
    write_tables(exam, folder)
    draw_budget(exam, folder / "budget.png")
    write_report(exam, folder / "report.html")
    return exam
