"""Many worlds behind Gymnasium's vector interface."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, final

import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from scm_world._arguments import one_of, whole_number
from scm_world.env.arguments import RESETS, limited, refuse_unknown, reset_options
from scm_world.env.batched.asking import (
    MASK,
    actions_of,
    chosen_of,
    index_of,
    masked,
    options_of,
    seeds_of,
    spread,
)
from scm_world.env.batched.buffers import gymnasium_infos
from scm_world.env.batched.loop import LoopExecutor, located
from scm_world.env.batched.native import NativeExecutor
from scm_world.env.batched.processes import ProcessExecutor
from scm_world.env.copies import EnvSnapshot
from scm_world.env.environment import ScmWorldEnv
from scm_world.errors import ActionError, NotReset, SnapshotMismatch, UnknownOption
from scm_world.tasks import Task
from scm_world.variables.subsets import AnyRegion
from scm_world.work.processes import cores
from scm_world.world import Audit

Stepped = tuple[Any, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]


@final
@dataclass(frozen=True)
class VectorSnapshot:
    """An instant of many environments. It can be pickled.

    Attributes:
        worlds: One snapshot for each.
        ended: Which of them are done, and are reset with the next step.
    """

    worlds: tuple[EnvSnapshot, ...]
    ended: tuple[bool, ...]


class ScmWorldVectorEnv(VectorEnv[Any, Any, Any]):
    """Vectorised environments, each with its own parameters, noise and clock.

    Made by ``gymnasium.make_vec("scm_world/Pushing-v0", num_envs=64)``. What comes out is, bit
    for bit, what Gymnasium's ``SyncVectorEnv`` makes of as many single environments, whichever
    executor simulates them and however many threads or processes it has. Environments of one batch
    are observed alike: what would change which bodies exist in one of them is refused.

    Args:
        num_envs: How many.
        autoreset_mode: When one that is done is reset: ``"NextStep"``, ``"SameStep"`` or
            ``"Disabled"``, as in Gymnasium.
        copy: Give observations that are yours; else the next step overwrites them.
        executor: ``"loop"``: one after another in this process; ``"processes"``: several processes;
            ``"native"``: many in one call of the backend; None: the fastest that there is.
        threads: Of the native executor; as many as there are cores if None.
        workers: How many processes; as many as there are cores if None.
        member: Makes one of them from the options: something that can do what a ``ScmWorldEnv``
            can. Not with the native executor.
        options: Of ``ScmWorldEnv``.

    Raises:
        UnknownOption: An option does not exist, or does not go with the others.

    Example:
        >>> envs = ScmWorldVectorEnv(3, task="pushing", backend="fake")
        >>> observations, infos = envs.reset(seed=0)
        >>> print(envs.do({1: {"floor_friction": 0.4}})[1])
        floor_friction = 0.4, engine reports 0.4
        >>> envs.step(envs.action_space.sample())[0].shape
        (3, 56)
        >>> envs.close()
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        copy: bool = True,
        executor: str | None = None,
        threads: int | None = None,
        workers: int | None = None,
        member: Callable[..., Any] = ScmWorldEnv,
        **options: Any,
    ) -> None:
        if member is ScmWorldEnv:
            refuse_unknown(options, ScmWorldEnv, ScmWorldVectorEnv)
        self.num_envs = whole_number("num_envs", num_envs, least=1)
        self.autoreset_mode = _mode(autoreset_mode)
        self.copy = copy
        make = partial(member, **options)
        usual = getattr(options.get("task"), "backend", Task.backend)
        backend = str(options.get("backend") or usual)
        self.executor = make_executor(
            executor, make, self.num_envs, backend=backend, threads=threads, workers=workers
        )
        form = self.executor.form
        self.metadata = {**form.metadata, "autoreset_mode": self.autoreset_mode}
        self.render_mode = form.render_mode
        self.single_observation_space = form.observation_space
        self.single_action_space = form.action_space
        self.observation_space = batch_space(form.observation_space, self.num_envs)
        self.action_space = batch_space(form.action_space, self.num_envs)
        self._action_size = int(np.prod(form.action_space.shape or ()))
        self._all = range(self.num_envs)
        self._nothing = [None] * self.num_envs, [None] * self.num_envs  # seeds and options
        self._everyone = np.ones(self.num_envs, bool)
        self._begun = np.zeros(self.num_envs, bool)
        self._ended = np.zeros(self.num_envs, bool)

    # --- Gymnasium's part -------------------------------------------------------------------------

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in all environments, or in some; all of those are reset, or none.

        Args:
            seed: Of the first environment, the next one gets the next number; or a list.
            options: ``"reset_mask"``: which ones, shape (n,), bool; ``"do"`` and ``"episode"``
                as in ``ScmWorldEnv.reset``: one for all, a list, or a mapping by index.

        Raises:
            UnknownOption: Another key, or something of the wrong length.
            InterventionError: The intervention was refused.
        """
        given = reset_options(options, (*RESETS, MASK))
        which = masked(given.pop(MASK, None), self.num_envs)
        wishes = options_of(given, which)
        self.executor.reset(which, seeds_of(seed, self.num_envs), wishes)
        self._begun |= which
        self._ended &= ~which
        return self._observations(), self._infos(which)

    def step(self, actions: Any) -> Stepped:
        """Advance all environments one control step.

        If an action is refused, none moves. If one environment fails as it is stepped, all others
        are one step further; ``present`` shows them. All executors do so.

        Args:
            actions: Shape (n, n_actions).

        Raises:
            ActionError: Another shape, a number that is not finite, or one of them is done and
                nothing resets it.
            NotReset: One of them has no episode yet.
        """
        buffers, stepping = self.executor.buffers, self._stepping(actions)
        given = actions_of(actions, stepping, self._action_size)
        begun = ~stepping  # the next episode takes the place of a step
        if begun.any():
            self.executor.reset(begun, *self._nothing)
            self._ended &= stepping
        self.executor.step(stepping, given)
        if begun.any():
            buffers.rewards[begun] = 0.0
            buffers.terminations[begun] = buffers.truncations[begun] = False
        ended = buffers.terminations | buffers.truncations
        infos: dict[str, Any] = {}
        if self.autoreset_mode is not AutoresetMode.SAME_STEP:
            self._ended = ended
        elif ended.any():
            infos = self._final(ended)
            self.executor.reset(ended, *self._nothing)
        flags = buffers.terminations.copy(), buffers.truncations.copy()
        infos |= self._infos(self._everyone)
        return self._observations(), buffers.rewards.copy(), *flags, infos

    @property
    def spec(self) -> EnvSpec | None:
        """What Gymnasium knows of it; ``max_episode_steps`` is the length of its episodes."""
        return self.__dict__.get("spec")

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self.__dict__["spec"] = limited(spec, self.get_attr("limit")[0])

    def _stepping(self, actions: Any) -> NDArray[np.bool_]:
        """Tell which environments take a step."""
        if not self._begun.all():
            raise located(NotReset(), int(np.argmin(self._begun)))
        if not self._ended.any():
            return self._everyone
        if self.autoreset_mode is AutoresetMode.DISABLED:
            done = ", ".join(map(str, np.flatnonzero(self._ended)))
            advice = "reset them first with options={'reset_mask': terminations | truncations}"
            raise ActionError(f"environments that are done take no step: {done}; {advice}", actions)
        return ~self._ended

    def _final(self, ended: NDArray[np.bool_]) -> dict[str, Any]:
        """Keep what is seen last of episodes that ended."""
        shown = np.full(self.num_envs, None, dtype=object)
        for index in np.flatnonzero(ended).tolist():
            shown[index] = self.executor.buffers.observation(index)
        return {
            "final_obs": shown,
            "_final_obs": ended.copy(),
            "final_info": self._infos(ended),
            "_final_info": ended.copy(),
        }

    def render(self) -> tuple[Any, ...]:
        """Draw every environment."""
        return self.call("render")

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method of every environment; what cannot be called is given as it is."""
        return tuple(self.executor.call(self._all, name, *args, **kwargs))

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Look an attribute of every environment up."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of every environment.

        Args:
            name: Of the attribute.
            values: A list or tuple with one for each, or one for all.

        Raises:
            UnknownOption: A list of another length.
        """
        given = values if isinstance(values, list | tuple) else [values] * self.num_envs
        if len(given) != self.num_envs:
            raise UnknownOption(f"list for {name}", values, (f"one of length {self.num_envs}",))
        self.executor.assign(name, dict(enumerate(given)))

    @property  # type: ignore[misc] # read only in Gymnasium's own kinds too
    def np_random(self) -> Any:
        """Gymnasium's generators of the environments, a tuple."""
        return self.get_attr("np_random")

    @property
    def np_random_seed(self) -> Any:
        """Gymnasium's seeds of the environments, a tuple."""
        return self.get_attr("np_random_seed")

    def close_extras(self, **kwargs: Any) -> None:
        """Free what simulates."""
        self.executor.close()

    # --- interventions and snapshots -------------------------------------------------------

    def do(self, requests: Any, *, space: AnyRegion | None = None) -> dict[int, Audit]:
        """Intervene now, in all environments that are named or in none.

        Args:
            requests: An intervention for all of them, a list with one or None for each, or a
                mapping by index.
            space: In which every target must lie.

        Returns:
            What it did, by the index of the environment. ``present`` shows how they look then.

        Raises:
            InterventionError: One of them refused; the message says which. Nothing has changed.
        """
        return self.executor.do(spread("do", requests, self.num_envs), space)

    def present(self) -> tuple[Any, dict[str, Any]]:
        """Give observations and infos of the present, as after an intervention."""
        return self._observations(), self._infos(self._everyone)

    def snapshot(self) -> VectorSnapshot:
        """Save everything that decides the future of the episodes.

        Raises:
            NotReset: One of them has none yet.
        """
        worlds = self.executor.snapshot(self._all)
        return VectorSnapshot(tuple(worlds), tuple(self._ended.tolist()))

    def restore(self, snapshot: VectorSnapshot | Mapping[int, EnvSnapshot]) -> None:
        """Go back to a snapshot, bit for bit.

        Args:
            snapshot: Of as many environments; or those of single ones, by the index of the
                environment that goes there.

        Raises:
            SnapshotMismatch: It is none, or one of another task or backend, or of another number.
        """
        if not isinstance(snapshot, VectorSnapshot | Mapping):
            raise SnapshotMismatch(f"{snapshot!r} is no snapshot; give what snapshot() returned")
        if isinstance(snapshot, VectorSnapshot):
            if len(snapshot.worlds) != self.num_envs:
                there, here = len(snapshot.worlds), self.num_envs
                raise SnapshotMismatch(f"it is one of {there} environments, and here are {here}")
            wanted, ended = dict(enumerate(snapshot.worlds)), snapshot.ended
        else:
            wanted = {index_of(key, self.num_envs): one for key, one in snapshot.items()}
            ended = tuple((self._ended & [i not in wanted for i in self._all]).tolist())
        self.executor.restore(wanted)
        self._begun[list(wanted)] = True
        self._ended = np.array(ended)

    def branch(self, source: int, into: Any = None) -> None:
        """Copy the state of one environment into others: from here on they are its counterfactuals.

        They have its noise too, so that they differ by nothing but what is done to them. Reset
        with a seed, they have one of their own again.

        Args:
            source: Index of the one that is copied.
            into: Indices, or a mask of shape (n,), of those that become like it; all if None.

        Raises:
            NotReset: It has no episode.
            UnknownOption: There is no such environment.
        """
        number = index_of(source, self.num_envs)
        chosen = self._all if into is None else chosen_of(into, self.num_envs)
        others = [index for index in chosen if index != number]
        (snapshot,) = self.executor.snapshot([number])
        self.executor.restore(dict.fromkeys(others, snapshot))
        self._begun[others] = True
        self._ended[others] = self._ended[number]

    def _observations(self) -> Any:
        shown = self.executor.buffers.observations
        if not self.copy:
            return shown
        if isinstance(shown, dict):
            return {name: part.copy() for name, part in shown.items()}
        return shown.copy()

    def _infos(self, which: NDArray[np.bool_]) -> dict[str, Any]:
        """Give the infos of some of them, in Gymnasium's form: each with a mask."""
        return gymnasium_infos(self.executor.buffers.infos, which)


def _mode(given: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(given)
    except ValueError:
        modes = [mode.value for mode in AutoresetMode]
        raise UnknownOption("autoreset_mode", given, modes) from None


TOGETHER = ("mujoco", "step")
"""Engines that step many worlds in one call."""

EXECUTORS = ("native", "processes", "loop")


def make_executor(
    executor: str | None,
    make: Callable[[], ScmWorldEnv],
    num_envs: int,
    *,
    backend: str,
    threads: int | None = None,
    workers: int | None = None,
) -> LoopExecutor | ProcessExecutor:
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
    one_of("executor", kind, EXECUTORS)
    for option, value, owner in (("threads", threads, "native"), ("workers", workers, "processes")):
        if value is not None and kind != owner:
            raise UnknownOption(
                option, value, (f"None with executor={kind!r}", f"any with {owner!r}")
            )
    if kind == "processes":
        return ProcessExecutor(make, num_envs, workers=workers)
    if kind == "native":
        return NativeExecutor(make, num_envs, threads=threads)
    return LoopExecutor(make, num_envs)


def fastest(backend: str, num_envs: int, *, workers: int | None) -> str:
    """Name the executor that is fastest, which is the one with processes if their number is asked.

    A process of a pool starts none of its own.
    """
    if backend in TOGETHER and workers is None:
        return "native"
    several = num_envs > 1 and cores() > 1 and not multiprocessing.current_process().daemon
    return "processes" if workers is not None or (backend == "bullet" and several) else "loop"
