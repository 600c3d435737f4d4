"""One run of an exam: a learner, a subject, a budget, a seed; in a process of its own."""

from __future__ import annotations

import hashlib
import math
import re
import time
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, final

import numpy as np

from scm_world.discovery.data import Dataset
from scm_world.discovery.exam.results import Cell, Truth, as_text
from scm_world.discovery.exam.subjects import Subject, TaskView, subject
from scm_world.discovery.learners.found import Found
from scm_world.discovery.learners.registry import Learner, learn, learner
from scm_world.discovery.metrics import effect_rmse, evaluate
from scm_world.errors import EngineFailure, MissingExtra, UnknownOption, in_one_line
from scm_world.output.locations import Location
from scm_world.tasks import TASKS
from scm_world.work.processes import PROCESS, Ended, TookTooLong, Worker

LONGEST = 1e6  # [s] that can be waited for at once


@final
@dataclass(frozen=True)
class Job:
    """What to run.

    Attributes:
        subject: Name of the subject, as ``subject`` takes it.
        learner: Name of the learner.
        data: ``"see"``, ``"do"`` or ``"paired"``.
        budget: Of the learner.
        most: Largest budget of the exam: so much is collected.
        seed: Of the model (of a family), the data and the learner.
        standardised: Whether columns are standardised.
        view: How a task is looked at.
        folder: Where collected data are kept; nowhere if None.
    """

    subject: str
    learner: str
    data: str
    budget: int
    most: int
    seed: int
    standardised: bool = False
    view: TaskView = field(default_factory=TaskView)
    folder: Location | None = None

    def cell(self, **what: Any) -> Cell:
        """Write down how it ended."""
        return Cell(
            subject=self.truth_name,
            learner=self.learner,
            data=self.data,
            budget=self.budget,
            seed=self.seed,
            standardised=self.standardised,
            **what,
        )

    @property
    def truth_name(self) -> str:
        """Name of the subject as it is shown."""
        return shown_name(self.subject, self.view)


def shown_name(name: str, view: TaskView) -> str:
    """Name a subject as it is shown.

    Example:
        >>> shown_name("pushing", TaskView("step")), shown_name("er2:20", TaskView())
        ('pushing/step', 'er2:20')
    """
    if name in TASKS:
        return f"{name}/step" if view.view == "step" else name
    return Path(name).stem if name.endswith(".json") else name


def slug(name: str) -> str:
    """Turn a name into one of a file, another one for each name.

    Example:
        >>> slug("er2:20"), slug("pcmci+")
        ('er2_20-45d3', 'pcmci_-be55')
    """
    plain = re.sub(r"[^A-Za-z0-9.-]", "_", name)
    mark = hashlib.sha256(name.encode()).hexdigest()[:4]
    return plain if plain == name else f"{plain}-{mark}"


def source_for(chosen: Learner, wanted: str | None) -> str:
    """Say which data a learner is given.

    Args:
        chosen: The learner.
        wanted: The kind of data; the richest one that it takes if None.

    Raises:
        UnknownOption: It cannot use this kind.
    """
    if wanted is None:
        return chosen.takes[-1]
    fits = wanted in chosen.takes or (wanted == "do" and "see" in chosen.takes)
    if not fits:
        raise UnknownOption(f"data for {chosen.name}", wanted, chosen.takes)
    return wanted


# --- the work itself ----------------------------------------------------------------------------


@final
class Bench:
    """Runs jobs one after another, and keeps the last subject and its data for the next one."""

    def __init__(self) -> None:
        self._key: tuple[Any, ...] = ()
        self._subject: Subject | None = None
        self._data: dict[str, Dataset] = {}
        self._test: list[Dataset | None] = []

    def truth(self, job: Job) -> Truth:
        """Give the graph of a job's subject, and collect its data."""
        made = self._of(job)
        if job.data != "paired":
            self._rows(job, made)
        return made.truth

    def run(self, job: Job) -> Cell:
        """Run a job; what goes wrong in a learner is written down in the cell."""
        made = self._of(job)
        table = None if job.data == "paired" else self._rows(job, made)
        started = time.perf_counter()
        try:
            return self._ran(job, made, table)
        except MissingExtra:
            raise
        except Exception as error:  # of whatever kind: learners are not all ours
            seconds = time.perf_counter() - started
            return job.cell(status="failed", message=in_one_line(error), seconds=seconds)

    def _ran(self, job: Job, made: Subject, table: Dataset | None) -> Cell:
        chosen = learner(job.learner)
        if table is None:
            found = learn(chosen, made.apparatus(job.seed), seed=job.seed, budget=job.budget)
        else:
            found = learn(chosen, table, seed=job.seed)
        own = made.truth.edges if job.seed else None
        cell = job.cell(
            found=found.restricted(made.truth.names),
            scores=self._scores(made, found, table, even=job.standardised, seed=job.seed),
            seconds=found.seconds,
            experiments=found.experiments,
            bound=found.bound,
            declared=own if own != self._shown(job) else None,
        )
        as_text(cell)  # what cannot be written has failed
        return cell

    def _of(self, job: Job) -> Subject:
        key = (job.subject, job.seed, repr(job.view))
        if self._subject is None or key != self._key:
            if self._subject is not None:
                self._subject.close()
            self._subject = subject(job.subject, seed=job.seed, view=job.view)
            self._key, self._data, self._test = key, {}, []
        return self._subject

    def _shown(self, job: Job) -> Any:
        """Give the edges of the graph that stands for all seeds."""
        if job.seed == 0:
            return None
        first = subject(job.subject, seed=0, view=job.view) if ":" in job.subject else self._subject
        return None if first is None else first.truth.edges

    def _rows(self, job: Job, made: Subject) -> Dataset:
        if job.data not in self._data:
            where = None if job.folder is None else job.folder / f"{job.data}-seed{job.seed}"
            options: dict[str, Any] = {}
            if where is not None and made.truth.about["kind"] != "model":
                written = "parquet" if find_spec("pyarrow") else "csv"
                options = {"out": where, "format": written}
            self._data[job.data] = made.data(job.data, job.most, job.seed, **options)
        whole = self._data[job.data]
        each = len(whole) / len(np.unique(whole.episode))
        part = whole.first(math.ceil(job.budget / each))
        return part.standardised() if job.standardised else part

    def _scores(
        self, made: Subject, found: Found, table: Dataset | None, *, even: bool, seed: int
    ) -> dict[str, float | int | None]:
        truth = made.truth
        compared = evaluate(found, truth.edges, names=truth.names, pairs=truth.pairs)
        plain = {k: v for k, v in compared.as_dict().items() if isinstance(v, int | float | None)}
        scores: dict[str, float | int | None] = {**plain, "sid": compared.sid}
        if table is not None and not even:
            scores["effect_rmse"] = self._predicted(made, found, table, seed)
        return scores

    def _predicted(self, made: Subject, found: Found, table: Dataset, seed: int) -> float | None:
        if not self._test:
            self._test.append(made.test(seed))
        test = self._test[0]
        return None if test is None else effect_rmse(found, table, test).rmse


# --- processes ----------------------------------------------------------------------------------


@final
class Runner:
    """A process that runs jobs, and is replaced by another one if a job takes too long.

    Args:
        timeout: Of a job [s]; None for no limit.
    """

    def __init__(self, timeout: float | None = None) -> None:
        self._timeout = None if timeout is None else min(timeout, LONGEST)
        self._worker = Worker(Bench)
        self._ready: set[tuple[str, int, str]] = set()

    def run(self, job: Job) -> Cell:
        """Run a job; a learner that takes its process with it has failed.

        Raises:
            ScmWorldError: The subject cannot be made, or the learner is not installed.
        """
        if (job.subject, job.seed, job.data) not in self._ready:
            self.truth(job)  # what is collected is not part of the time of a learner
        try:
            cell: Cell = self._worker.ask("run", job, timeout=self._timeout)
        except TookTooLong:
            self._ready.clear()
            said = f"stopped after {self._timeout:g} s"
            return job.cell(status="timeout", message=said, seconds=float(self._timeout or 0.0))
        except Ended as ended:
            self._ready.clear()
            if ended.was_interrupted:
                raise EngineFailure(str(ended), PROCESS) from None
            return job.cell(status="failed", message=str(ended))
        return cell

    def truth(self, job: Job) -> Truth:
        """Give the graph of a job's subject, and collect its data, however long that takes.

        Raises:
            ScmWorldError: The subject cannot be made, or its data cannot be collected or written.
        """
        try:
            truth: Truth = self._worker.ask("truth", job)
        except Ended as ended:
            self._ready.clear()
            raise EngineFailure(f"{job.subject}: {ended}", PROCESS) from None
        self._ready.add((job.subject, job.seed, job.data))
        return truth

    def __call__(self, job: Job) -> Cell:
        """Run a job; see ``run``."""
        return self.run(job)

    def interrupt(self) -> None:
        """End the process from another thread; who waits for an answer gets an error."""
        self._worker.interrupt()

    def stop(self) -> None:
        """End the process."""
        self._worker.stop()
        self._ready.clear()

    close = stop
