"""Work for other processes: it must be importable there."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scm_world.errors import ActionError
from scm_world.runs.processes import THREADS


class Fussy(Exception):
    """An error that cannot be read again: its constructor wants two things."""

    def __init__(self, one: str, other: str) -> None:
        super().__init__(f"{one} and {other}")


@dataclass(frozen=True)
class Task:
    """A job.

    Attributes:
        number: What it is about.
        what: What happens, see ``do``.
        folder: Where each try leaves a file.
    """

    number: int
    what: str = "square"
    folder: Path | None = None


class Adder:
    """Work that remembers."""

    def __init__(self) -> None:
        self.total = 0

    def __call__(self, number: int) -> tuple[int, int]:
        """Add a number; return the process and the sum."""
        self.total += number
        return os.getpid(), self.total


def do(task: Task) -> Any:
    """Do a task."""
    tries = 0
    if task.folder is not None:
        tries = len(list(task.folder.glob(f"try-{task.number}-*")))
        (task.folder / f"try-{task.number}-{tries}-{os.getpid()}").touch()
    match task.what:
        case "die":
            os.kill(os.getpid(), signal.SIGKILL)
        case "leave":
            os._exit(1)
        case "refuse":
            raise ActionError(f"no {task.number}", task.number)
        case "fuss":
            raise Fussy("this", "that")
        case "secret":
            return lambda: 0
        case "sleep":
            time.sleep(600.0)
        case "sleep once" if tries == 0:
            time.sleep(600.0)
        case "press Ctrl-C":
            os.kill(os.getppid(), signal.SIGINT)
            time.sleep(600.0)
        case "threads":
            return {name: os.environ.get(name) for name in THREADS}
        case "product":
            rng = np.random.default_rng(task.number)
            return (rng.normal(size=(300, 4000)) @ rng.normal(size=(4000, 300))).tobytes()
    return task.number**2


def tries(folder: Path) -> dict[int, int]:
    """Count how often each task was begun, by its number."""
    numbers = [int(path.name.split("-")[1]) for path in folder.glob("try-*")]
    return {number: numbers.count(number) for number in numbers}


def pids(folder: Path, number: int | None = None) -> list[int]:
    """List the processes that began a task, or any."""
    found = sorted(folder.glob(f"try-{'*' if number is None else number}-*"))
    return [int(path.name.split("-")[3]) for path in found]
