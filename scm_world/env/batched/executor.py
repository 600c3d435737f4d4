"""What holds many environments, wherever and however they are simulated."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Integers
from scm_world.env.batched.buffers import Buffers, Form
from scm_world.env.copies import EnvSnapshot
from scm_world.env.environment import ScmWorldEnv
from scm_world.errors import ActionError, ScmWorldError, UnknownOption
from scm_world.variables.subsets import AnyRegion
from scm_world.work.threads import cores
from scm_world.world import Audit

TOGETHER = ("mujoco", "step")
"""Engines that step many worlds in one call."""

EXECUTORS = ("native", "processes", "loop")


class EnvExecutor(Protocol):
    """Many environments that are made alike, each with its own parameters, noise and clock.

    Each does, bit for bit, what it would do alone. Whatever happens to one of them is in its row
    of the buffers afterwards. ``reset``, ``do`` and ``restore`` happen in all of those that are
    named or in none; so does what makes one unlike the others (see ``Form.check``). The message
    of an error says in which environment it happened.

    Attributes:
        num_envs: How many there are.
        form: What they have in common.
        buffers: What they said last; one object for the life of the executor.
    """

    num_envs: int
    form: Form
    buffers: Buffers

    def reset(
        self,
        which: NDArray[Any],
        seeds: Sequence[int | None],
        options: Sequence[Mapping[str, Any] | None],
    ) -> None:
        """Begin an episode in some of them; rewards and flags of the buffers stay.

        Args:
            which: Which ones, shape (n,), bool.
            seeds: One for each environment, as in ``ScmWorldEnv.reset``.
            options: Also.
        """

    def step(self, which: NDArray[Any], actions: NDArray[Any]) -> None:
        """Advance some of them one control step.

        If an action is not finite, none moves. If one fails as it is stepped, all others are one
        step further, and the first error is raised.

        Args:
            which: Which ones, shape (n,), bool.
            actions: Shape (n, n_actions), 64-bit floats; those of the others are not looked at.
        """

    def do(
        self, requests: Mapping[int, Mapping[str, Any]], space: AnyRegion | None = None
    ) -> dict[int, Audit]:
        """Intervene in some of them, by index, as ``ScmWorldEnv.do`` does."""

    def snapshot(self, indices: Sequence[int]) -> list[EnvSnapshot]:
        """Save some of them."""

    def restore(self, snapshots: Mapping[int, EnvSnapshot]) -> None:
        """Take some of them to a snapshot; it may be that of another one."""

    def call(self, indices: Sequence[int], name: str, *args: Any, **kwargs: Any) -> list[Any]:
        """Call a method of some of them; what cannot be called is given as it is."""

    def attribute(self, indices: Sequence[int], name: str) -> list[Any]:
        """Look an attribute of some of them up."""

    def assign(self, name: str, values: Mapping[int, Any]) -> None:
        """Set an attribute of some of them."""

    def close(self) -> None:
        """Free everything they hold. The buffers can still be read."""


def check_actions(rows: Integers, actions: NDArray[Any], first: int = 0) -> None:
    """Refuse actions that are not finite, before anything moves.

    Args:
        rows: Who is stepped, shape (m,).
        actions: Shape (n, n_actions).
        first: The number of the first one in messages.

    Raises:
        ActionError: With the number of the environment.
    """
    bad = rows[~np.isfinite(actions[rows]).all(axis=1)]
    if len(bad):
        row = int(bad[0])
        said = f"an action is finite numbers, got {actions[row]!r}"
        raise located(ActionError(said, actions[row]), first + row)


def located(error: ScmWorldError, index: int) -> ScmWorldError:
    """Say in an error in which environment it happened.

    Example:
        >>> print(located(ScmWorldError("the block is in the table"), 3))
        environment 3: the block is in the table
    """
    error.args = (f"environment {index}: {error}",)
    return error


def make_executor(
    executor: str | None,
    make: Callable[[], ScmWorldEnv],
    num_envs: int,
    *,
    backend: str,
    threads: int | None = None,
    workers: int | None = None,
) -> EnvExecutor:
    """Make what simulates many environments.

    Args:
        executor: Its name; the fastest one for the backend if None.
        make: Makes one environment.
        num_envs: How many.
        backend: Name of the engine.
        threads: Of the native executor.
        workers: Processes of the executor that has some.

    Raises:
        UnknownOption: There is no such executor, or an option is not one of it.
    """
    kind = executor if executor is not None else fastest(backend, num_envs, workers=workers)
    if kind not in EXECUTORS:
        raise UnknownOption("executor", kind, EXECUTORS)
    for option, value, owner in (("threads", threads, "native"), ("workers", workers, "processes")):
        if value is not None and kind != owner:
            raise UnknownOption(
                option, value, (f"None with executor={kind!r}", f"any with {owner!r}")
            )
    if kind == "processes":
        from scm_world.env.batched.processes import ProcessExecutor

        return ProcessExecutor(make, num_envs, workers=workers)
    if kind == "native":
        from scm_world.env.batched.native import NativeExecutor

        return NativeExecutor(make, num_envs, threads=threads)
    from scm_world.env.batched.loop import LoopExecutor

    return LoopExecutor(make, num_envs)


def fastest(backend: str, num_envs: int, *, workers: int | None) -> str:
    """Name the executor that is fastest, which is the one with processes if their number is asked.

    A process of a pool starts none of its own.
    """
    if backend in TOGETHER and workers is None:
        return "native"
    several = num_envs > 1 and cores() > 1 and not multiprocessing.current_process().daemon
    return "processes" if workers is not None or (backend == "bullet" and several) else "loop"
