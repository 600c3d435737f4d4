"""Work for other processes: it must be importable there."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scm_world.errors import ActionError
from scm_world.work.processes import THREADS


class Fussy(Exception):
    """An error that cannot be read again: its constructor wants two things."""

    def __init__(self, one: str, other: str) -> None:
        super().__init__(f"{one} and {other}")


class Bench:
    """Something that remembers."""

    def __init__(self, start: int = 0) -> None:
        self.total = start

    def add(self, number: int) -> int:
        """Add up all numbers it was given."""
        self.total += number
        return self.total

    def pid(self) -> int:
        """Tell which process it is in."""
        return os.getpid()

    def settings(self) -> dict[str, str | None]:
        """Tell how many threads libraries may use."""
        return {name: os.environ.get(name) for name in THREADS}

    def product(self, seed: int) -> bytes:
        """Multiply numbers, so many that BLAS would use threads."""
        return product(seed)

    def sleep(self) -> None:
        """Take longer than any test."""
        time.sleep(600.0)

    def press_ctrl_c(self) -> None:
        """Interrupt the process that asks, while it waits."""
        os.kill(os.getppid(), signal.SIGINT)
        self.sleep()

    def leave(self, code: int) -> None:
        """End the process."""
        os._exit(code)

    def refuse(self, why: str) -> None:
        """Raise an error of ours."""
        raise ActionError(why, {"torque": 3})

    def stumble(self) -> None:
        """Raise an error of Python."""
        raise KeyError("b")

    def fuss(self) -> None:
        """Raise an error that cannot travel."""
        raise Fussy("this", "that")

    def secret(self) -> Any:
        """Give what cannot travel."""
        return lambda: 0

    def error(self) -> Exception:
        """Give an error, which is not to raise it."""
        return EOFError("only shown")


def product(seed: int) -> bytes:
    """Multiply two matrices; the last bits depend on the number of threads."""
    rng = np.random.default_rng(seed)
    return (rng.normal(size=(300, 4000)) @ rng.normal(size=(4000, 300))).tobytes()


def no_bench() -> Bench:
    """Fail to make one."""
    raise ActionError("there is no room", None)


@dataclass(frozen=True)
class Task:
    """A job.

    Attributes:
        number: What it is about.
        what: What happens: ``"square"``, ``"product"``, ``"die"``, ``"refuse"``, ``"sleep"`` or
            ``"sleep once"``.
        folder: Where each try leaves a file.
    """

    number: int
    what: str = "square"
    folder: Path | None = None


def make(marks: Path | None = None) -> Callable[[Task], Any]:
    """Give what does tasks; leaves a file, so that it can be counted."""
    if marks is not None:
        (marks / f"made-{os.getpid()}-{time.monotonic_ns()}").touch()
    return do


def do(task: Task) -> Any:
    """Do a task."""
    tries = 0
    if task.folder is not None:
        tries = len(list(task.folder.glob(f"try-{task.number}-*")))
        (task.folder / f"try-{task.number}-{tries}-{os.getpid()}").touch()
    match task.what:
        case "die":
            os.kill(os.getpid(), signal.SIGKILL)
        case "refuse":
            raise ActionError(f"no {task.number}", task.number)
        case "sleep":
            time.sleep(600.0)
        case "sleep once" if tries == 0:
            time.sleep(600.0)
        case "product":
            return product(task.number)
    return task.number**2
