"""A study from beginning to end, in a folder that can be gone on with."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import final

from scm_world.errors import EngineFailure, ModelError, UnknownOption, in_one_line
from scm_world.evaluation.reporting import write_outputs
from scm_world.output.durable import locked, made
from scm_world.training.study.actors import check_actors, evaluate_actor
from scm_world.training.study.cells import ALGOS, CURRICULA, Cell, Study
from scm_world.training.study.costs import HOUR
from scm_world.training.study.pictures import draw
from scm_world.training.study.published import figure
from scm_world.training.study.records import begin, read_record
from scm_world.training.study.runs import (
    FAILED,
    Hand,
    Job,
    Outcome,
    Tell,
    Trainer,
    progress_of,
    usual_trainer,
)
from scm_world.training.study.scores import OVERALL, Findings, Row
from scm_world.training.study.tables import write_tables
from scm_world.work.executors import Executor, Serial, opened

REPORTS = "reports"


@final
@dataclass(frozen=True)
class Reproduction:
    """What a study gave.

    Attributes:
        outcomes: How the cells ended that were asked for.
        rows: All numbers of the figure.
        files: What was written.
        notes: What could not be.
    """

    outcomes: tuple[Outcome, ...]
    rows: tuple[Row, ...]
    files: tuple[Path, ...]
    notes: tuple[str, ...]

    @property
    def overall(self) -> tuple[Row, ...]:
        """Of each kind of training, the mean over all protocols."""
        return tuple(row for row in self.rows if row.protocol == OVERALL)

    @property
    def failed(self) -> tuple[Outcome, ...]:
        """The cells that failed."""
        return tuple(outcome for outcome in self.outcomes if outcome.status == FAILED)


def reproduce(
    study: Study,
    out: Path | str,
    *,
    table: str | None = None,
    hours: float | None = None,
    actors: Path | str | None = None,
    workers: int | None = None,
    engine: Executor | str | None = None,
    trainer: Trainer | None = None,
    pictures: bool = True,
    tell: Tell | None = None,
) -> Reproduction:
    """Train and evaluate a study, and write the published figures beside what it gave.

    Whatever is finished is kept, and the same call goes on, also after a kill. What else was done
    in the folder before stands in the tables, too.

    Args:
        study: What is trained and evaluated.
        out: Folder: new, empty, or of a study with the same preset, scale, engine, policy and
            conventions.
        table: Name of the published figure that is filled; that of the study's tasks if None.
        hours: After how much time on the clock to stop; what was begun can be gone on with.
        actors: Folder with the archives of the published actors, which are evaluated, too.
        workers: How many cells are done at the same time.
        engine: What does them; see ``engine_of``.
        trainer: Trains; that of this package if None.
        pictures: Whether radars and reports are drawn, too.
        tell: Told how far a cell is; where it is done in another process, that it is over.

    Raises:
        UnknownOption: There is no such figure, or no such number of hours.
        UnreadableFile: The folder holds something else, a file in it is damaged, somebody else is
            writing to it, or an archive of an actor is not the published one.
        MissingExtra: Nothing can be trained: Stable-Baselines3 is not installed.
    """
    folder, until = Path(out), _until(hours)
    tasks = study.tasks if table is None else figure(table)
    known = {} if actors is None else check_actors(study, Path(actors))
    if trainer is None and any(read_record(folder, cell) is None for cell in study.cells()):
        trainer = usual_trainer()  # it is missing before any time is spent
    with opened(engine, workers) as executor:
        begin(study, folder)
        with locked(folder):
            jobs = [Job(cell, study, folder, until) for cell in study.cells()]
            outcomes = _done(jobs, executor, trainer, tell)
            for path, actor in known.items():
                job = Job(Cell(*actor.key, 0), study, folder, until)
                evaluate_actor(actor, path, job, progress_of(job, "published actor", tell))
            whole = replace(study, tasks=tasks, algos=ALGOS, curricula=CURRICULA)
            found = Findings.read(whole, folder)
            files, notes = _drawn(found, folder) if pictures else ((), ())
            tables = write_tables(found, folder, notes)
    return Reproduction(outcomes, found.table, (*tables, *files), notes)


def _until(hours: float | None) -> float | None:
    if hours is None:
        return None
    if not 0.0 < hours < math.inf:
        raise UnknownOption("hours", hours, ("more than 0",))
    return time.time() + hours * HOUR


def _done(
    jobs: Sequence[Job], executor: Executor, trainer: Trainer | None, tell: Tell | None
) -> tuple[Outcome, ...]:
    executor.check("trainer", trainer)
    is_here = isinstance(executor, Serial)
    make = partial(Hand, trainer, tell if is_here else None)
    found: dict[int, Outcome] = {}
    lost = ""
    try:
        for place, outcome in executor.run(make, jobs):
            found[place] = outcome
            if tell is not None and not is_here:
                tell(outcome.cell, outcome.status, len(found), len(jobs))
    except EngineFailure as error:  # processes ended over a cell, again and again
        lost = in_one_line(error)
    return tuple(
        found.get(place, Outcome(job.cell, FAILED, lost)) for place, job in enumerate(jobs)
    )


def _drawn(found: Findings, folder: Path) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Draw pictures and reports; say what cannot be."""
    files: list[Path] = []
    notes: list[str] = []
    for task in found.study.tasks:
        for algo in found.study.algos:
            picture = folder / f"{task}-{algo}.png"
            if draw(found, task, algo, picture):
                files.append(picture)
            try:
                files += _report(found, task, algo, folder)
            except ModelError as error:
                notes.append(f"no report of {task}, {algo}: {in_one_line(error)}")
    return tuple(files), tuple(notes)


def _report(found: Findings, task: str, algo: str, folder: Path) -> tuple[Path, ...]:
    merged = found.merged(task, algo)
    if merged is None:
        return ()
    place = folder / REPORTS / f"{task}-{algo}"
    made(place)
    write_outputs(merged, place)
    return (place / "report.html",)
