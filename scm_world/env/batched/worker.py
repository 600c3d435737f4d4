"""What a process of an executor holds: some of its environments, and the memory that all share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, final

import numpy as np

from scm_world.env.batched.buffers import Allocate, Buffers, Form
from scm_world.env.batched.loop import LoopExecutor
from scm_world.env.batched.memory import Allocator, answer_signal, shared
from scm_world.env.environment import ScmWorldEnv

STEP, RESET = b"s", b"r"
DONE, MORE = b".", b"+"

Said = tuple[Any, list[dict[str, Any]] | None]
"""The answer to a call, and what there is in ``info`` that is no number."""


@final
class SharedBuffers:
    """What lies in shared memory: the buffers, and what the environments are to do next.

    Args:
        form: What the environments have in common.
        size: How many there are.
        allocate: Cuts arrays out of the memory, in the same order in every process.

    Attributes:
        buffers: What they said last.
        which: Those that are stepped or reset, shape (n,).
        actions: Shape (n, n_actions).
    """

    def __init__(self, form: Form, size: int, allocate: Allocate) -> None:
        self.buffers = Buffers.empty(form, size, allocate)
        self.which = allocate((size,), np.bool_)
        self.actions = allocate((size, *(form.action_space.shape or ())), np.float64)


@final
class EnvWorker:
    """Environments with adjacent numbers, in a process of their own.

    Args:
        make: Makes one environment.
        size: How many are here.
        first: The index of the first one in the whole executor.
    """

    def __init__(self, make: Callable[[], ScmWorldEnv], size: int, first: int) -> None:
        self._where = slice(first, first + size)
        self._executor = LoopExecutor(make, size, first=first)
        self._none = [None] * size
        self._error: BaseException | None = None

    def form(self) -> Said:
        """Tell what the environments have in common."""
        return self._executor.form, None

    def attach(self, place: Path, signal: str, total: int) -> Said:
        """Write into shared memory from now on, and answer a signal.

        Args:
            place: Where they are.
            signal: Its name.
            total: How many environments there are in all processes.
        """
        mine = SharedBuffers(self._executor.form, total, Allocator(shared(place)))
        self._executor.buffers = mine.buffers.part(self._where)
        self._which, self._actions = mine.which[self._where], mine.actions[self._where]
        answer_signal(place, signal, self._serve)
        return None, None

    def _serve(self, asked: bytes) -> bytes:
        """Step or reset what the shared buffers say; what goes wrong is raised by ``more``."""
        try:
            if asked == STEP:
                self._executor.step(self._which, self._actions)
            else:
                self._executor.reset(self._which, self._none, self._none)
        except BaseException as error:  # else nobody would answer
            self._error = error
        return DONE if self._error is None and not any(self._executor.buffers.extras) else MORE

    def more(self) -> Said:
        """Tell what a byte cannot."""
        error, self._error = self._error, None
        if error is not None:
            raise error
        return None, self._extras()

    def tell(self, method: str, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Said:
        """Call a method of the executor that is here."""
        return getattr(self._executor, method)(*args, **kwargs), self._extras()

    def _extras(self) -> list[dict[str, Any]] | None:
        extras = self._executor.buffers.extras
        return extras if any(extras) else None
