"""Many environments in several processes, which share the memory of what they say."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import whole_number
from scm_world.env.batched.buffers import Form
from scm_world.env.batched.executor import check_actions
from scm_world.env.batched.memory import Allocator, Signal, meeting_place, share
from scm_world.env.batched.worker import DONE, RESET, STEP, EnvWorker, SharedBuffers
from scm_world.env.copies import EnvSnapshot
from scm_world.env.environment import ScmWorldEnv
from scm_world.errors import EngineFailure, UnknownOption
from scm_world.variables.subsets import AnyRegion
from scm_world.work.processes import PROCESS, Ended, Worker
from scm_world.work.threads import cores
from scm_world.world import Audit

ANEW = "make the environments anew"


@final
class ProcessExecutor:
    """Environments in several processes: how engines without threads use all cores.

    Each process has some neighbors, and writes what they say into memory that all share; so do
    actions come to it. Only what is no number goes through a pipe. What comes out does not
    depend on the number of processes.

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
        self._signals: list[Signal] = []
        self._lost = ""
        self._end = weakref.finalize(self, _stop, self._workers, self._signals)
        try:
            self._share()
        except BaseException:
            self._end()
            raise

    def _share(self) -> None:
        """Start the processes, and let all of them write into one memory."""
        everyone = range(len(self._workers))
        self.form: Form = self._ask(dict.fromkeys(everyone, ("form",)))[0]
        needed = Allocator()
        SharedBuffers(self.form, self.num_envs, needed)
        with meeting_place() as place:
            self._shared = SharedBuffers(
                self.form, self.num_envs, Allocator(share(place, needed.size))
            )
            self._signals.extend(Signal(place, str(k)) for k in everyone)
            self._ask({k: ("attach", place, str(k), self.num_envs) for k in everyone})
        self.buffers = self._shared.buffers

    def reset(
        self,
        which: NDArray[Any],
        seeds: Sequence[int | None],
        options: Sequence[Mapping[str, Any] | None],
    ) -> None:
        """Begin an episode in some of them."""
        busy = self._busy(which)
        if any(seed is not None for seed in seeds) or any(options):
            parts = {k: self._parts[k] for k in busy}
            self._all_or_none(
                "reset", {k: (which[mine], seeds[mine], options[mine]) for k, mine in parts.items()}
            )
        else:
            self._shared.which[:] = which
            self._signal_all(RESET, busy)

    def step(self, which: NDArray[Any], actions: NDArray[Any]) -> None:
        """Advance some of them one control step."""
        check_actions(np.flatnonzero(which), actions)
        self._shared.which[:] = which
        self._shared.actions[:] = actions
        self._signal_all(STEP, self._busy(which))

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
        self._ask({k: ("tell", "assign", (name, mine), {}) for k, mine in parts.items()})

    def close(self) -> None:
        """End the processes."""
        self._lost = self._lost or f"the environments are closed; {ANEW}"
        self._end()

    # --- who has what -----------------------------------------------------------------------------

    def _busy(self, which: NDArray[Any]) -> list[int]:
        """List the processes that have some of these environments."""
        if which.all():
            return list(range(len(self._parts)))
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
        answers = self._ask(
            {k: ("tell", method, ([*mine], *args), kwargs) for k, mine in parts.items()}
        )
        found = {
            self._parts[k].start + local: one
            for k, mine in parts.items()
            for local, one in zip(mine, answers[k], strict=True)
        }
        return [found[index] for index in indices]

    # --- asking -----------------------------------------------------------------------------------

    def _signal_all(self, what: bytes, busy: Sequence[int]) -> None:
        """Let some processes step or reset; resets happen in all of them or in none."""
        if self._lost:
            raise EngineFailure(self._lost, PROCESS)
        try:
            for k in busy:
                self._signals[k].send(what)
            said = {k: self._signals[k].answer() for k in busy}
        except BaseException as error:
            self._give_up(f"they were interrupted by {type(error).__name__}")
            raise
        rest = [k for k in busy if said[k] != DONE]
        if rest:
            _, errors = self._answers(dict.fromkeys(rest, ("more",)))
            if errors and what == RESET:
                self._undo(set(busy) - errors.keys())
            _raise_first(errors)

    def _all_or_none(self, method: str, given: Mapping[int, tuple[Any, ...]]) -> dict[int, Any]:
        """Ask for something that each process does wholly or not at all, and so do all of them."""
        calls: dict[int, tuple[Any, ...]]
        calls = {k: ("tell", method, args, {}) for k, args in given.items()}
        answers, errors = self._answers(calls)
        if errors:
            self._undo(answers)
        _raise_first(errors)
        return answers

    def _undo(self, where: Iterable[int]) -> None:
        self._ask(dict.fromkeys(where, ("tell", "undo", (), {})))

    def _ask(self, calls: Mapping[int, tuple[Any, ...]]) -> dict[int, Any]:
        """Ask some processes at once, and give what they say."""
        answers, errors = self._answers(calls)
        _raise_first(errors)
        return answers

    def _answers(
        self, calls: Mapping[int, tuple[Any, ...]]
    ) -> tuple[dict[int, Any], dict[int, Exception]]:
        """Ask some processes at once; whatever one of them says, the others are heard too.

        Args:
            calls: For each process, a method of its station, and the arguments.
        """
        if self._lost:
            raise EngineFailure(self._lost, PROCESS)
        answers: dict[int, Any] = {}
        errors: dict[int, Exception] = {}
        k = 0
        try:
            for k, (method, *given) in calls.items():
                try:
                    self._workers[k].begin(method, *given)
                except UnknownOption as error:  # an argument cannot be pickled
                    errors[k] = error
            for k in calls.keys() - errors.keys():
                try:
                    answers[k] = self._heard(k)
                except Ended:
                    raise
                except Exception as error:
                    errors[k] = error
        except Ended as error:
            raise self._give_up(f"{self._who(k)}: {error}") from None
        except BaseException as error:
            self._give_up(f"they were interrupted by {type(error).__name__}")
            raise
        return answers, errors

    def _heard(self, k: int) -> Any:
        answer, extras = self._workers[k].answer()
        if extras is not None:
            self.buffers.extras[self._parts[k]] = extras
        return answer

    def _who(self, k: int) -> str:
        return f"environments {self._parts[k].start} to {self._parts[k].stop - 1} are lost"

    def _give_up(self, reason: str) -> EngineFailure:
        """End all processes: some may be a step ahead of the others."""
        self._lost = f"{reason}; {ANEW}"
        self._end()
        return EngineFailure(self._lost, PROCESS)


def _raise_first(errors: Mapping[int, Exception]) -> None:
    if errors:
        raise errors[min(errors)]


def _stop(workers: Sequence[Worker], signals: list[Signal]) -> None:
    for worker in workers:
        worker.stop()
    while signals:
        signals.pop().close()
