"""One cell of a study: it is trained, then evaluated, and whatever is done already is kept."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol, final

from scm_world.errors import MissingExtra, UnreadableFile, in_one_line
from scm_world.evaluation import evaluate
from scm_world.evaluation.policies.weights import load_policy
from scm_world.queries.progress import Progress
from scm_world.training.recipe import Recipe
from scm_world.training.study.cells import POLICIES, Cell, Study
from scm_world.training.study.records import (
    Record,
    evaluation_of,
    is_evaluated,
    policy_of,
    read_evaluation,
    read_record,
    run_of,
    write_record,
)

DONE, FAILED, STOPPED = "done", "failed", "stopped"


class Trainer(Protocol):
    """Trains an agent: ``scm_world.training.loop.train``, or what stands for it."""

    def __call__(
        self,
        recipe: Recipe,
        *,
        out: Any,
        seed: int,
        backend: str,
        steps: int,
        threads: int,
        progress: Progress | None,
    ) -> Any:
        """Train, and leave ``policy.safetensors`` in the folder; go on with what is there.

        The card of the policy has ``steps``, ``wall_s`` and ``cpu_s``, from the first beginning.
        """


def usual_trainer() -> Trainer:
    """Give the trainer of this package.

    Raises:
        MissingExtra: Stable-Baselines3 is not installed.
    """
    if find_spec("stable_baselines3") is None:
        raise MissingExtra("stable-baselines3", "train")
    from scm_world.training.loop import train

    found: Trainer = train
    return found


class OutOfTime(Exception):
    """The time that was given for a study is over."""


@final
@dataclass(frozen=True)
class Job:
    """What is to be done.

    Attributes:
        cell: Which training.
        study: Of which study.
        folder: Of the study.
        until: When to stop, by ``time.time()`` [s]; never if None.
    """

    cell: Cell
    study: Study
    folder: Path
    until: float | None = None

    def check_time(self) -> None:
        """Stop if the time is over.

        Raises:
            OutOfTime: It is.
        """
        if self.until is not None and time.time() >= self.until:
            raise OutOfTime


@final
@dataclass(frozen=True)
class Outcome:
    """How a cell ended.

    Attributes:
        cell: Which one.
        status: ``"done"``, ``"failed"``, or ``"stopped"``: the time was over.
        message: Why it failed.
        seconds: That it took.
    """

    cell: Cell
    status: str
    message: str = ""
    seconds: float = 0.0


Tell = Callable[[Cell, str, int, int], None]
"""Told of a cell, of what is done with it, how much of that is done, and how much there is."""


@final
@dataclass(frozen=True)
class Hand:
    """Does cells.

    Attributes:
        trainer: Trains; that of this package if None.
        tell: Told how far a cell is.
    """

    trainer: Trainer | None = None
    tell: Tell | None = None

    def __call__(self, job: Job) -> Outcome:
        """Train and evaluate a cell; what goes wrong in it is written down in the outcome."""
        started = time.perf_counter()
        try:
            record = self._trained(job)
            self._evaluated(job, record)
        except OutOfTime:
            return Outcome(job.cell, STOPPED, seconds=time.perf_counter() - started)
        except Exception as error:  # of whatever kind: it must not stop the other cells
            took = time.perf_counter() - started
            return Outcome(job.cell, FAILED, in_one_line(error), took)
        return Outcome(job.cell, DONE, seconds=time.perf_counter() - started)

    def _trained(self, job: Job) -> Record:
        made = job.study.recipe(job.cell)
        plain = json.loads(made.to_json())
        kept = read_record(job.folder, job.cell)
        if kept is not None:
            _check(kept, plain, job.folder)
            return kept
        job.check_time()
        (self.trainer or usual_trainer())(
            made,
            out=run_of(job.folder, job.cell),
            seed=job.cell.seed,
            backend=job.study.backend,
            steps=job.study.steps(made),
            threads=1,  # more cores are for more cells
            progress=progress_of(job, "trained", self.tell),
        )
        last = load_policy(run_of(job.folder, job.cell) / POLICIES["last"]).about.card
        record = Record(
            job.cell,
            plain,
            steps=int(last["steps"]),  # type: ignore[arg-type] # JSON
            whole=made.steps,
            seconds=float(last["wall_s"]),  # type: ignore[arg-type] # JSON
            cpu_seconds=float(last["cpu_s"]),  # type: ignore[arg-type] # JSON
        )
        write_record(job.folder, record)
        return record

    def _evaluated(self, job: Job, record: Record) -> None:
        if is_evaluated(job.study, job.folder, record):
            return
        job.check_time()
        agent = f"{job.cell.algo.upper()} curriculum {job.cell.curriculum}"
        place = evaluation_of(job.folder, job.cell)
        evaluate_in(place, {agent: _policy(job)}, job, progress_of(job, "evaluated", self.tell))


def evaluate_in(
    place: Path,
    agent: Mapping[str, str],
    job: Job,
    progress: Progress,
    env: Mapping[str, Any] | None = None,
) -> None:
    """Evaluate as the study asks for it; protocols and episodes that are there already stay.

    Args:
        place: Folder of the evaluation.
        agent: The file of a policy, by the name of the agent.
        job: Says in which study, and in which task.
        progress: Told how many episodes are done.
        env: Options of the environment that the policy does not say itself.

    Raises:
        OutOfTime: The time is over; what is finished is kept.
    """
    study, before = job.study, read_evaluation(place)
    more = () if before is None else before.protocols
    found = evaluate(
        agent,
        tuple(dict.fromkeys((*study.protocols, *more))),
        task=job.cell.task,
        n=max(study.episodes, 0 if before is None else int(before.about["n"])),
        backend=study.backend,
        env=env,
        out=place,
        progress=progress,
    )
    found.save(place, kind=table_kind())


def progress_of(job: Job, what: str, tell: Tell | None) -> Progress:
    """Give what is told how far a cell is; it stops when the time is over.

    Raises:
        OutOfTime: When it is told of something that is not finished after that.
    """

    def progress(done: int, total: int) -> None:
        if tell is not None:
            tell(job.cell, what, done, total)
        if done < total:
            job.check_time()

    return progress


def _policy(job: Job) -> str:
    """Name the file of the policy that is evaluated.

    Raises:
        UnreadableFile: There is none.
    """
    path = policy_of(job.study, job.folder, job.cell)
    if not path.exists():
        advice = "delete the record of this training, and it is trained again"
        raise UnreadableFile(str(path), "the training left no such policy", advice)
    return str(path)


def table_kind() -> str:
    """Say how tables of episodes are written: as Parquet, where that can be written."""
    return "csv" if find_spec("pyarrow") is None else "parquet"


def _check(kept: Record, plain: Any, folder: Path) -> None:
    """Refuse what was trained by another recipe than the present one."""
    different = sorted(
        name for name in {*kept.recipe, *plain} if kept.recipe.get(name) != plain.get(name)
    )
    if different:
        reason = f"it was trained by another recipe: {', '.join(different)} differ"
        advice = f"delete it and {kept.cell.name}.json, or give another folder"
        raise UnreadableFile(str(run_of(folder, kept.cell)), reason, advice)
