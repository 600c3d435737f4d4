"""Many environments in this process, one after another."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Integers
from scm_world.env.batched.buffers import Buffers, Form
from scm_world.env.copies import EnvSnapshot
from scm_world.env.environment import ScmWorldEnv
from scm_world.errors import ActionError, NotReset, ScmWorldError
from scm_world.variables.subsets import AnyRegion
from scm_world.world import Audit

RESET = "the reset"
SNAPSHOT = "the snapshot"


class LoopExecutor:
    """Environments that are made alike, each with its own parameters, noise and clock; in turns.

    Each is bit-identical to an environment alone. Its result is in its row of the buffers
    afterwards. ``reset``, ``do`` and ``restore`` take effect in all environments that are named or
    in none; what makes one unlike the others is refused (see ``Form.check``). The message of an
    error names the environment. All other executors do the same.

    Args:
        make: Makes one of them.
        num_envs: How many.
        first: The number of the first one in messages, where these are a part of a larger executor.

    Attributes:
        num_envs: How many there are.
        form: What they have in common.
        buffers: What they said last.
        envs: The environments.
    """

    def __init__(self, make: Callable[[], ScmWorldEnv], num_envs: int, *, first: int = 0) -> None:
        self.num_envs = num_envs
        self._first = first
        lead = make()
        self.envs = [lead, *(lead.sibling() for _ in range(num_envs - 1))]
        self.form = Form.of(self.envs[0])
        self.buffers = Buffers.empty(self.form, num_envs)
        self._seen = [env.observation_space for env in self.envs]
        self._before: dict[int, EnvSnapshot] = {}

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

        def begin(index: int) -> None:
            given = options[index]
            chosen = None if given is None else dict(given)
            shown = self.envs[index].reset(seed=seeds[index], options=chosen)
            self._accept(index, _first_name((given or {}).get("do"), RESET))
            self.buffers.write(index, *shown)

        self._all_or_none(np.flatnonzero(which).tolist(), begin)

    def step(self, which: NDArray[Any], actions: NDArray[Any]) -> None:
        """Advance some of them one control step.

        If an action is not finite, none moves. If one fails as it is stepped, all others are one
        step further, and the first error is raised.

        Args:
            which: Which ones, shape (n,), bool.
            actions: Shape (n, n_actions), 64-bit floats; those of the others are not looked at.
        """
        buffers, rows = self.buffers, np.flatnonzero(which)
        check_actions(rows, actions, self._first)
        failed: ScmWorldError | None = None
        for index in rows.tolist():
            try:
                observation, reward, terminated, truncated, info = self.envs[index].step(
                    actions[index]
                )
            except ScmWorldError as error:
                failed = failed or located(error, self._first + index)
                continue
            buffers.rewards[index] = reward
            buffers.terminations[index] = terminated
            buffers.truncations[index] = truncated
            buffers.write(index, observation, info)
        if failed is not None:
            raise failed

    def do(
        self, requests: Mapping[int, Mapping[str, Any]], space: AnyRegion | None = None
    ) -> dict[int, Audit]:
        """Intervene in some of them, by index, as ``ScmWorldEnv.do`` does."""
        audits = {}

        def intervene(index: int) -> None:
            request = requests[index]
            audits[index] = self.envs[index].do(request, space=space)
            self._accept(index, _first_name(request, "this"))
            self._show(index)

        self._all_or_none(requests, intervene)
        return audits

    def snapshot(self, indices: Sequence[int]) -> list[EnvSnapshot]:
        """Save some of them."""
        taken, index = [], 0
        self._bring(indices)
        try:
            for index in indices:
                taken.append(self.envs[index].snapshot())
        except ScmWorldError as error:
            located(error, self._first + index)
            raise
        return taken

    def restore(self, snapshots: Mapping[int, EnvSnapshot]) -> None:
        """Take some of them to a snapshot; it may be that of another one."""

        def go(index: int) -> None:
            env = self.envs[index]
            env.restore(snapshots[index])
            shown = env.present()
            self._accept(index, SNAPSHOT)
            self.buffers.write(index, *shown)

        self._all_or_none(snapshots, go)

    def undo(self) -> None:
        """Take back what the last reset, intervention or restoration did."""
        for index, snapshot in self._before.items():
            self.envs[index].restore(snapshot)
            self._show(index)

    def call(self, indices: Sequence[int], name: str, *args: Any, **kwargs: Any) -> list[Any]:
        """Call a method of some of them; what cannot be called is given as it is."""
        found = self.attribute(indices, name)
        return [one(*args, **kwargs) if callable(one) else one for one in found]

    def attribute(self, indices: Sequence[int], name: str) -> list[Any]:
        """Look an attribute of some of them up."""
        self._bring(indices)
        return [self.envs[index].get_wrapper_attr(name) for index in indices]

    def assign(self, name: str, values: Mapping[int, Any]) -> None:
        """Set an attribute of some of them."""
        for index, value in values.items():
            self.envs[index].set_wrapper_attr(name, value)

    def close(self) -> None:
        """Free their engines. The buffers can still be read."""
        for env in self.envs:
            env.close()

    def _bring(self, indices: Iterable[int]) -> None:
        """Let environments be as they are now, before they are used; here they always are."""

    def _all_or_none(self, indices: Iterable[int], act: Callable[[int], None]) -> None:
        """Do something to some of them; if one refuses, all are as they were."""
        index, self._before = 0, {}
        self._bring(indices)
        try:
            for index in indices:
                with suppress(NotReset):  # then it has no episode that could be lost
                    self._before[index] = self.envs[index].snapshot()
                act(index)
        except BaseException as error:
            self.undo()
            if isinstance(error, ScmWorldError):
                located(error, self._first + index)
            raise

    def _show(self, index: int) -> None:
        self.buffers.write(index, *self.envs[index].present())

    def _accept(self, index: int, variable: str) -> None:
        """Refuse an environment that is not observed like the others any more."""
        env = self.envs[index]
        if env.observation_space is not self._seen[index]:
            self.form.check(env, variable)
            self._seen[index] = env.observation_space


def _first_name(request: Mapping[str, Any] | None, otherwise: str) -> str:
    return next(iter(request or ()), otherwise)


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
