"""A policy that plans: model-predictive control with the causal model itself.

It searches by the cross-entropy method: sampling, keeping the best, sampling around them.

Source:
    Rubinstein, *The cross-entropy method for combinatorial and continuous optimization*, 1999; with
    noise that is correlated in time, elites that are kept, and a mean that is shifted, as in
    Pinneri et al., *Sample-efficient cross-entropy method for real-time planning*, CoRL 2020.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final
from weakref import WeakKeyDictionary

import numpy as np

from scm_world._arguments import one_of, real_number, true_or_false, typed, whole_number
from scm_world._types import Floats
from scm_world.errors import UnknownOption
from scm_world.graph import flatten
from scm_world.policies.planning.model import PlanningModel, Score, as_score, nearness
from scm_world.variables import Noise, Normal
from scm_world.world import CausalSystem, Simulation, Snapshot

Objective = str | Mapping[str, float] | Score | None
"""The name of a variable, weights by name, a score, or the usual one."""

KEPT = 0.3
"""Share of the elites that take part in the next round again."""


@typed
def action_range(world: CausalSystem) -> tuple[Floats, Floats]:
    """Return the lower and upper end of all actions, shape (n_actions,) each.

    An action without an end is drawn from [-1, 1], or as far beyond the end that it has.
    """
    low, high = world.action_low, world.action_high
    low = np.where(np.isfinite(low), low, np.minimum(-1.0, high - 2.0))
    high = np.where(np.isfinite(high), high, np.maximum(1.0, low + 2.0))
    return low, high


@typed
@final
@dataclass(frozen=True)
class Search:
    """The numbers of a search.

    Attributes:
        samples: Sequences of actions in each round.
        horizon: Their length in control steps.
        iterations: Rounds.
        elites: How many of the best ones the next round is drawn around; a sixth of the samples if
            None.
        spread: Standard deviation of the first round, as a share of half the range of an action.
        color: How much noise is correlated in time: its power falls with this power of the
            frequency. 0 is white noise, 2 that of a random walk.
        momentum: Share of the old mean and standard deviation in the new ones.

    Raises:
        UnknownOption: A number is wrong, or out of its range.
    """

    samples: int = 48
    horizon: int = 12
    iterations: int = 2
    elites: int | None = None
    spread: float = 0.1
    color: float = 3.0
    momentum: float = 0.1

    def __post_init__(self) -> None:
        for name, least in (("samples", 2), ("horizon", 1), ("iterations", 1)):
            whole_number(name, getattr(self, name), least=least)
        if self.elites is not None and whole_number("elites", self.elites, least=1) > self.samples:
            raise UnknownOption("elites", self.elites, (f"1 to {self.samples}, the samples",))
        for name, high in (("spread", 10.0), ("color", 10.0), ("momentum", 1.0)):
            real_number(name, getattr(self, name), least=0.0, most=high)

    @property
    def n_elites(self) -> int:
        """How many samples are elites."""
        return self.elites or max(1, self.samples // 6)

    def noise(self, noise: Noise, stream: str, n: int, *, episode: int, step: int) -> Floats:
        """Draw noise of variance one, correlated in time, shape (samples, horizon, n)."""
        length = self.horizon
        frequencies = np.fft.rfftfreq(length)
        frequencies[0] = 1.0 / length
        size = frequencies ** (-0.5 * self.color)
        counts = np.full(len(size), 4.0)  # a frequency stands for its negative one, too
        counts[0] = 1.0
        if length % 2 == 0:
            counts[-1] = 1.0
        size *= length / math.sqrt(float((counts * size**2).sum()))
        shape = (self.samples, n, 2, len(size))
        drawn = noise.draw(Normal(), stream, shape, {}, episode=episode, step=step)[0]
        waves = (drawn[:, :, 0] + 1j * drawn[:, :, 1]) * size
        return np.asarray(np.fft.irfft(waves, length, axis=-1)).swapaxes(1, 2)


@final
class CrossEntropy:
    """Tries sequences of actions out in copies of the world, and does the beginning of the best.

    Every ``every`` control steps it searches again, from the present and from the rest of its
    last plan. It reads the state of the world, not an observation. What
    it does follows from the world, its noise, ``seed``, and the steps of the episode at which it
    was asked: a world that is restored in the middle of an episode has no last plan. How many
    threads there are does not matter. One instance serves any number of episodes and worlds.

    Args:
        objective: The quantity that is summed over the control steps of a plan: the name of a
            variable such as ``"reward"``, weights by name, or a ``Score``; if None, how near
            everything is to its goal, see ``nearness``, or the reward where there are no goals.
        terminal: Value of the last state of a plan, added to its rewards; nothing if None.
        every: For how many control steps a plan is followed.
        do: What the planner wrongly believes, as in ``World.do``: ``{"tool_block.friction": 0.2}``.
            With None it plans with the true model.
        backend: The backend that it plans with, by name; that of the world if None.
        foresees: Whether it knows the noise that is still to come.
        seed: Seed of the sampling.
        threads: Threads of the backend; as many as there are cores if None.
        numbers: Numbers of the search: ``samples``, ``horizon``, ``iterations`` …; see ``Search``.

    Raises:
        UnknownOption: A number is wrong or out of range; ``do`` is not a mapping; ``foresees`` is
            neither True nor False.

    Example:
        >>> from scm_world.queries import World
        >>> world = World("reaching", backend="fake")
        >>> policy = CrossEntropy(samples=4, elites=2, horizon=3)
        >>> len(world.rollout(policy, steps=2))
        2
    """

    def __init__(
        self,
        *,
        objective: Objective = None,
        terminal: Objective = None,
        every: int = 2,
        do: Mapping[str, Any] | None = None,
        backend: str | None = None,
        foresees: bool = False,
        seed: int = 0,
        threads: int | None = None,
        **numbers: object,
    ) -> None:
        known = tuple(Search.__dataclass_fields__)
        for name in numbers:
            one_of("option of a planner", name, known)
        self.search = Search(**numbers)  # type: ignore[arg-type] # it checks them
        self.objective = None if objective is None else as_score(objective)
        self.terminal = None if terminal is None else as_score(terminal)
        self.every = whole_number("every", every, least=1)
        if self.every > self.search.horizon:
            raise UnknownOption("every", every, (f"1 to {self.search.horizon}, the horizon",))
        self.do, self.backend = flatten({} if do is None else do), backend
        self.foresees = true_or_false("foresees", foresees)
        self.seed = whole_number("seed", seed, least=0)
        self.threads = None if threads is None else whole_number("threads", threads, least=1)
        self._programs: WeakKeyDictionary[Simulation, _WorldPlans] = WeakKeyDictionary()

    def __getstate__(self) -> dict[str, Any]:
        """Copy and pickle without the plans under way."""
        return {name: value for name, value in vars(self).items() if name != "_programs"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Forget the last plan."""
        self.__dict__.update(state, _programs=WeakKeyDictionary())

    def __call__(self, world: Simulation) -> Floats:
        """Return the action of the present step."""
        program = self._programs.get(world)
        if program is None or program.plan != world.compiled.plan:  # other bodies are there
            program = self._programs[world] = _WorldPlans(self, world)
        return program.action(world)


@final
class _WorldPlans:
    """The plans for one world of a structure, episode after episode."""

    def __init__(self, policy: CrossEntropy, world: Simulation) -> None:
        self._policy, self.plan = policy, world.compiled.plan
        self._objective = policy.objective or nearness(world.task)
        self._terminal = policy.terminal
        names = (*self._objective.names, *(self._terminal.names if self._terminal else ()))
        self._model = PlanningModel(
            world,
            policy.search.samples,
            names,
            backend=policy.backend,
            do=policy.do,
            foresees=policy.foresees,
            threads=policy.threads,
        )
        self._at: tuple[int, int, int] | None = None
        self._version = -1
        self._ahead: list[Floats] = []
        self._mean = self._kept = np.empty(0)

    def action(self, world: Simulation) -> Floats:
        """Return the action of the present step; search where no plan is followed any more."""
        seed, episode, index = world.noise.seed, world.episode, world.index
        goes_on = self._at == (seed, episode, index)
        if not (goes_on and self._ahead and self._version == world.version):
            if goes_on:  # begin with the rest of the last plan; its last action is kept
                passed = self._policy.every - len(self._ahead)
                rows = np.minimum(np.arange(len(self._mean)) + passed, len(self._mean) - 1)
                found = self._searched(world, self._mean[rows], self._kept[:, rows])
            else:
                still = np.tile(world.task.idle(world), (self._policy.search.horizon, 1))
                found = self._searched(world, still, still[None][:0])
            self._ahead = [*found[: self._policy.every]]
        self._at, self._version = (seed, episode, index + 1), world.version
        return self._ahead.pop(0).copy()

    def _searched(self, world: Simulation, mean: Floats, kept: Floats) -> Floats:
        """Return the best sequence that was tried, shape (horizon, n_actions).

        The first round is drawn around ``mean``, of the same shape; ``kept`` sequences, the best
        first, are tried again. The last mean is tried, too; it and the elites are where the next
        search begins.
        """
        self._model.do = self._policy.do  # which an adaptive agent replaces
        setting, present = self._policy.search, self._model.present(world)
        low, high = action_range(world)
        std = np.broadcast_to(0.5 * setting.spread * (high - low), mean.shape)
        best, highest = mean, -np.inf
        for number in range(setting.iterations):
            stream, n = f"planning {self._policy.seed}, round {number}", world.compiled.n_actions
            where = {"episode": world.episode, "step": world.index}
            tried = mean + std * setting.noise(world.noise, stream, n, **where)
            tried[0] = mean
            again = kept[: min(math.ceil(KEPT * setting.n_elites), setting.samples - 1)]
            tried[1 : 1 + len(again)] = again
            tried = np.clip(tried, low, high)
            scores = self._scores(present, tried)
            order = np.argsort(-scores, kind="stable")[: setting.n_elites]
            kept = tried[order]
            if number == 0 or scores[order[0]] > highest:
                best, highest = kept[0], float(scores[order[0]])
            old = setting.momentum
            mean = old * mean + (1.0 - old) * kept.mean(axis=0)
            std = old * std + (1.0 - old) * kept.std(axis=0)
        middle = np.clip(mean, low, high)
        self._mean, self._kept = mean, kept
        if float(self._scores(present, middle[None])[0]) > highest:
            best = middle
        return best

    def _scores(self, present: Snapshot, actions: Floats) -> Floats:
        values = self._model.rollouts(present, actions)
        shape = actions.shape[:2]
        total: Floats = self._objective.of(values, shape).sum(axis=1)
        if self._terminal is not None:
            last = {name: value[:, -1] for name, value in values.items()}
            total = total + self._terminal.of(last, shape[:1])
        return total
