"""Many environments in several processes."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import whole_number
from scm_world.env.batched.buffers import Buffers, Form
from scm_world.env.batched.loop import LoopExecutor, check_actions
from scm_world.env.copies import EnvSnapshot
from scm_world.env.environment import ScmWorldEnv
from scm_world.errors import EngineFailure, UnknownOption
from scm_world.variables.subsets import AnyRegion
from scm_world.work.processes import PROCESS, Ended, Worker, cores
from scm_world.world import Audit

ANEW = "make the environments again"


@final
class EnvWorker:
    """Environments with adjacent numbers, in a process of their own.

    Args:
        make: Makes one environment.
        size: How many are here.
        first: The index of the first one in the whole executor.
    """

    def __init__(self, make: Callable[[], ScmWorldEnv], size: int, first: int) -> None:
        self._executor = LoopExecutor(make, size, first=first)

    def form(self) -> Form:
        """Return what the environments have in common."""
        return self._executor.form

    def buffers(self) -> Buffers:
        """Return what they said last."""
        return self._executor.buffers

    def tell(
        self, method: str, args: tuple[Any, ...], kwargs: Mapping[str, Any]
    ) -> tuple[Any, Buffers]:
        """Call a method of the executor that is here; return its answer and the buffers."""
        return getattr(self._executor, method)(*args, **kwargs), self._executor.buffers


@final
class ProcessExecutor:
    """Environments in several processes: how backends without threads use all cores.

    Each process has some neighbors. What comes out does not depend on the number of processes.
    The methods are those of ``LoopExecutor``.

    Args:
        make: Makes one environment; it can be pickled.
        num_envs: How many.
        workers: How many processes; as many as there are cores if None. Never more than
            environments.

    Attributes:
        num_envs: How many there are.
        form: What they have in common.
        buffers: What they said last.

    Raises:
        UnknownOption: ``make`` cannot be pickled, or ``workers`` is no number from 1 on.
        EngineFailure: A process ended. The executor is lost then.
    """

    def __init__(
        self, make: Callable[[], ScmWorldEnv], num_envs: int, workers: int | None = None
    ) -> None:
        count = whole_number("workers", cores() if workers is None else workers, least=1)
        count = min(count, num_envs)
        ends = [num_envs * k // count for k in range(count + 1)]
        self.num_envs = num_envs
        self._parts = [slice(start, end) for start, end in pairwise(ends)]
        self._home = np.repeat(np.arange(count), np.diff(ends)).tolist()
        self._workers = [
            Worker(partial(EnvWorker, make, part.stop - part.start, part.start))
            for part in self._parts
        ]
        self._lost = ""
        self._end = weakref.finalize(self, _stop, self._workers)
        try:
            for worker in self._workers:
                worker.begin("form")
            for worker in self._workers:
                self.form: Form = worker.answer()
        except Ended as error:
            self._end()
            raise EngineFailure(str(error), PROCESS) from None
        except BaseException:
            self._end()
            raise
        self.buffers = Buffers.empty(self.form, num_envs)

    def reset(
        self,
        which: NDArray[Any],
        seeds: Sequence[int | None],
        options: Sequence[Mapping[str, Any] | None],
    ) -> None:
        """Begin an episode in some of them."""
        parts = {k: self._parts[k] for k in self._busy(which)}
        self._all_or_none(
            "reset", {k: (which[mine], seeds[mine], options[mine]) for k, mine in parts.items()}
        )

    def step(self, which: NDArray[Any], actions: NDArray[Any]) -> None:
        """Advance some of them one control step."""
        check_actions(np.flatnonzero(which), actions)
        parts = {k: self._parts[k] for k in self._busy(which)}
        self._ask({k: ("step", which[mine], actions[mine]) for k, mine in parts.items()})

    def do(
        self, requests: Mapping[int, Mapping[str, Any]], space: AnyRegion | None = None
    ) -> dict[int, Audit]:
        """Intervene in some of them."""
        parts = self._split(requests)
        answers = self._all_or_none("do", {k: (mine, space) for k, mine in parts.items()})
        audits = {
            self._parts[k].start + local: audit
            for k, mine in answers.items()
            for local, audit in mine.items()
        }
        return {index: audits[index] for index in requests}

    def snapshot(self, indices: Sequence[int]) -> list[EnvSnapshot]:
        """Save some of them."""
        return self._listed(indices, "snapshot")

    def restore(self, snapshots: Mapping[int, EnvSnapshot]) -> None:
        """Take some of them to a snapshot."""
        parts = self._split(snapshots)
        self._all_or_none("restore", {k: (mine,) for k, mine in parts.items()})

    def call(self, indices: Sequence[int], name: str, *args: Any, **kwargs: Any) -> list[Any]:
        """Call a method of some of them; what cannot be called is given as it is."""
        return self._listed(indices, "call", name, *args, **kwargs)

    def attribute(self, indices: Sequence[int], name: str) -> list[Any]:
        """Look an attribute of some of them up."""
        return self._listed(indices, "attribute", name)

    def assign(self, name: str, values: Mapping[int, Any]) -> None:
        """Set an attribute of some of them."""
        parts = self._split(values)
        self._ask({k: ("assign", name, mine) for k, mine in parts.items()})

    def close(self) -> None:
        """End the processes."""
        self._lost = self._lost or f"the environments are closed; {ANEW}"
        self._end()

    def _busy(self, which: NDArray[Any]) -> list[int]:
        """List the processes that have some of these environments."""
        return [k for k, part in enumerate(self._parts) if which[part].any()]

    def _split(self, by_index: Mapping[int, Any]) -> dict[int, dict[int, Any]]:
        """Give each process its part, by the index that it uses."""
        parts: dict[int, dict[int, Any]] = {}
        for index, value in by_index.items():
            home = self._home[index]
            parts.setdefault(home, {})[index - self._parts[home].start] = value
        return parts

    def _listed(self, indices: Sequence[int], method: str, *args: Any, **kwargs: Any) -> list[Any]:
        """Ask for something of each of some environments."""
        parts = self._split(dict.fromkeys(indices))
        answers = self._ask({k: (method, [*mine], *args) for k, mine in parts.items()}, kwargs)
        found = {
            self._parts[k].start + local: one
            for k, mine in parts.items()
            for local, one in zip(mine, answers[k], strict=True)
        }
        return [found[index] for index in indices]

    def _all_or_none(self, method: str, given: Mapping[int, tuple[Any, ...]]) -> dict[int, Any]:
        """Ask for something that each process does wholly or not at all, and so do all of them."""
        return self._ask({k: (method, *args) for k, args in given.items()}, undo=True)

    def _ask(
        self,
        calls: Mapping[int, tuple[Any, ...]],
        kwargs: Mapping[str, Any] | None = None,
        *,
        undo: bool = False,
    ) -> dict[int, Any]:
        """Call some processes in parallel, and read all answers, also after an error.

        Args:
            calls: For each process a method of its executor, and the arguments.
            kwargs: Further arguments of all of them.
            undo: Whether it is taken back in all processes where one refuses it.

        Returns:
            What they say.
        """
        if self._lost:
            raise EngineFailure(self._lost, PROCESS)
        answers: dict[int, Any] = {}
        errors: dict[int, Exception] = {}
        k = 0
        try:
            for k, (method, *args) in calls.items():
                try:
                    self._workers[k].begin("tell", method, tuple(args), kwargs or {})
                except UnknownOption as error:  # an argument cannot be pickled
                    errors[k] = error
            for k in calls.keys() - errors.keys():
                try:
                    answers[k], shown = self._workers[k].answer()
                except Ended:
                    raise
                except Exception as error:
                    errors[k] = error
                    shown = self._workers[k].ask("buffers")
                self.buffers.put(self._parts[k], shown)
        except Ended as error:
            part = self._parts[k]
            self._give_up(f"environments {part.start} to {part.stop - 1} are lost: {error}")
            raise EngineFailure(self._lost, PROCESS) from None
        except BaseException as error:
            self._give_up(f"they were interrupted by {type(error).__name__}")
            raise
        if errors:
            if undo:
                self._ask(dict.fromkeys(answers, ("undo",)))
            raise errors[min(errors)]
        return answers

    def _give_up(self, reason: str) -> None:
        """End all processes: some may be a step ahead of the others."""
        self._lost = f"{reason}; {ANEW}"
        self._end()


def _stop(workers: Iterable[Worker]) -> None:
    for worker in workers:
        worker.stop()
