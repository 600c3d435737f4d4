"""A bag of jobs: which of them wait, which were lost, and which cannot be done."""

from __future__ import annotations

import reprlib
from collections import Counter, deque
from collections.abc import Sequence
from typing import Generic, TypeVar, final

from scm_world.errors import EngineFailure

Job = TypeVar("Job")

TRIES = 3  # of a job whose process ends: it may have been killed for another one's sake
SHOWN = 5  # failed jobs that an error lists


@final
class Bag(Generic[Job]):
    """Jobs, and the places of those that wait.

    A job that fails, or that takes its process with it again and again, is put aside. Those that
    were put aside are told of when nothing else is left to do: no job is in another one's way.

    Args:
        jobs: All of them.
        engine: What does them, for errors.
    """

    def __init__(self, jobs: Sequence[Job], engine: str) -> None:
        self.jobs = jobs
        self.waiting = deque(range(len(jobs)))
        self._engine = engine
        self._lost = Counter[int]()
        self._aside: dict[int, Exception] = {}

    def put_back(self, number: int, ended: Exception) -> None:
        """Let a job whose process has ended wait once more, behind the others.

        Args:
            number: Of the job.
            ended: What is known of the end; after the last try it is the fault of the job.
        """
        self._lost[number] += 1
        if self._lost[number] < TRIES:
            self.waiting.append(number)
            return
        said = f"{self.name(number)}, was tried {TRIES} times, and then {ended}"
        self._aside[number] = EngineFailure(said, self._engine)

    def put_aside(self, number: int, error: Exception) -> None:
        """Remember that a job failed: as it gives the same every time, it is not tried again."""
        error.add_note(f"in {self.name(number)}")
        self._aside[number] = error

    def name(self, number: int) -> str:
        """Say which job it is.

        Example:
            >>> Bag(["wash", "dry"], "process").name(1)
            "job 1, 'dry'"
        """
        return f"job {number}, {reprlib.repr(self.jobs[number])}"

    def settle(self) -> None:
        """Say what could not be done, once all the rest is.

        Raises:
            Exception: Of the first job that was put aside; the others are notes.
        """
        if not self._aside:
            return
        first, *others = sorted(self._aside)
        error = self._aside[first]
        for number in others[:SHOWN]:
            other = self._aside[number]
            error.add_note(f"so did {self.name(number)}: {type(other).__name__}: {other}")
        if len(others) > SHOWN:
            error.add_note(f"and {len(others) - SHOWN} more")
        error.add_note(f"{len(self.jobs) - len(self._aside)} of {len(self.jobs)} jobs are done")
        raise error
