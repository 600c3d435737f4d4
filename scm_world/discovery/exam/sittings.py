"""Running all runs of an exam: in threads that have a process each, or on another engine."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from functools import partial
from threading import Event
from typing import final

from scm_world.discovery.exam.results import Cell, Truth, read_cell, write_json
from scm_world.discovery.exam.runs import Job, Runner, slug
from scm_world.discovery.exam.subjects import subject
from scm_world.errors import UnreadableFile
from scm_world.output.durable import made
from scm_world.output.locations import Location
from scm_world.queries.progress import Progress
from scm_world.work.executors import Executor, Processes


def cell_path(folder: Location, job: Job) -> Location:
    """Say where the result of a run is kept."""
    even = "-standardised" if job.standardised else ""
    run = f"{slug(job.learner)}-{job.data}-{job.budget}-seed{job.seed}{even}.json"
    return folder / "cells" / slug(job.truth_name) / run


@final
class Sitting:
    """What is done in an exam so far.

    Args:
        groups: The runs, those of one subject and seed together.
        folder: Of the exam.
        timeout: Of a run [s]; None for no limit.
        progress: Told after each run.

    Attributes:
        cells: What is done, in the order in which it was.
        truths: Of the subjects; of a family, that of the first seed.
    """

    def __init__(
        self,
        groups: Sequence[Sequence[Job]],
        folder: Location,
        timeout: float | None,
        progress: Progress | None,
    ) -> None:
        self.cells: list[Cell] = []
        self.truths: dict[str, Truth] = {}
        self._groups, self._folder, self._timeout = groups, folder, timeout
        self._progress, self._total = progress, sum(map(len, groups))
        self._runners: list[Runner] = []
        self._stopped = Event()

    def hold(self, executor: Executor) -> None:
        """Do all runs that are not done yet.

        Processes of this machine share the data of a subject: the runs of one subject and seed
        follow each other in one of them. Elsewhere each worker collects what it needs by itself,
        so that nothing but the results has to travel.
        """
        if isinstance(executor, Processes):
            self._in_threads(executor.workers)
        else:
            self._on(executor)

    # --- elsewhere ----------------------------------------------------------------------------

    def _on(self, executor: Executor) -> None:
        missing: list[Job] = []
        for jobs in self._groups:
            first = jobs[0]
            if first.truth_name not in self.truths:
                with closing(subject(first.subject, seed=first.seed, view=first.view)) as known:
                    self.truths[first.truth_name] = known.truth
            for job in jobs:
                cell = self._kept(job)
                if cell is None:
                    missing.append(job)
                else:
                    self._tell(cell)
        sent = [replace(job, folder=None) for job in missing]
        for place, cell in executor.run(partial(Runner, self._timeout), sent):
            self._keep(missing[place], cell)

    # --- in threads ---------------------------------------------------------------------------

    def _in_threads(self, workers: int) -> None:
        with ThreadPoolExecutor(workers) as pool:
            futures = [pool.submit(self._work, jobs) for jobs in self._groups]
            try:
                for future in futures:
                    future.result()
            except BaseException:
                self._stop()
                raise

    def _work(self, jobs: Sequence[Job]) -> None:
        """Do the runs of one subject and seed in a process of their own."""
        runner = Runner(self._timeout)
        self._runners.append(runner)
        try:
            for job in jobs:
                if self._stopped.is_set():
                    return
                if job is jobs[0]:
                    truth = runner.truth(job)
                    if job.seed == 0 or truth.name not in self.truths:
                        self.truths[truth.name] = truth
                cell = self._kept(job)
                if cell is None:
                    self._keep(job, runner.run(job))
                else:
                    self._tell(cell)
        finally:
            runner.stop()

    def _stop(self) -> None:
        """End all processes; runs that have not begun are not done."""
        self._stopped.set()
        for runner in tuple(self._runners):
            runner.interrupt()

    # --- results ------------------------------------------------------------------------------

    def _kept(self, job: Job) -> Cell | None:
        """Read the result of a run; None if it was not done."""
        path = cell_path(self._folder, job)
        if not path.exists():
            return None
        cell = read_cell(path)
        if cell.key != job.cell(status="failed").key:
            reason, advice = "it is of another run", "delete it, and this run is done again"
            raise UnreadableFile(str(path), reason, advice)
        return cell

    def _keep(self, job: Job, cell: Cell) -> None:
        """Write the result of a run."""
        path = cell_path(self._folder, job)
        made(path.parent)
        write_json(cell, path)
        self._tell(cell)

    def _tell(self, cell: Cell) -> None:
        self.cells.append(cell)
        if self._progress is not None:
            self._progress(len(self.cells), self._total)
