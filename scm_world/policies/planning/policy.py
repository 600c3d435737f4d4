"""A policy that plans: model-predictive control with the causal model itself."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, final
from weakref import WeakKeyDictionary

import numpy as np

from scm_world._arguments import whole_number
from scm_world._types import Floats
from scm_world.errors import UnknownOption
from scm_world.graph import flatten
from scm_world.policies.planning.model import Model
from scm_world.policies.planning.scores import Score, as_score, nearness
from scm_world.policies.planning.search import Found, Search, search
from scm_world.tasks.base import action_range
from scm_world.world import World


@final
class CrossEntropy:
    """Tries sequences of actions out in copies of the world, and does the beginning of the best.

    Every ``every`` control steps it searches anew, from the present and from what is left of its
    last plan. It sees everything, since it looks at the world and not at an observation. What
    it does follows from the world, its noise, ``seed``, and the steps of the episode at which it
    was asked: a world that is restored in the middle of an episode has no last plan. How many
    threads there are does not matter. One instance serves any number of episodes and worlds.

    Args:
        objective: What is summed up over the control steps of a plan: the name of a variable such
            as ``"reward"``, weights by name, or a ``Score``; if None, how near everything is to
            its goal, see ``nearness``, and the reward where the task has no goals.
        terminal: What the end of a plan is worth besides; nothing if None.
        every: For how many control steps a plan is followed.
        do: What the planner wrongly believes, as in ``World.do``: ``{"tool_block.friction": 0.2}``.
            With None it plans with the true model.
        backend: The engine that it plans with, by name; that of the world if None.
        foresees: Whether it knows the noise that is still to come.
        seed: Of the sampling.
        threads: Of the engine; as many as there are cores if None.
        numbers: Of the search: ``samples``, ``horizon``, ``iterations`` …; see ``Search``.

    Raises:
        UnknownOption: A number is none, or out of its range; ``do`` is no mapping; ``foresees`` is
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
        objective: Any = None,
        terminal: Any = None,
        every: int = 2,
        do: Mapping[str, Any] | None = None,
        backend: str | None = None,
        foresees: bool = False,
        seed: int = 0,
        threads: int | None = None,
        **numbers: Any,
    ) -> None:
        self.search = _search(numbers)
        self.objective = None if objective is None else as_score(objective)
        self.terminal = None if terminal is None else as_score(terminal)
        self.every = whole_number("every", every, least=1)
        if self.every > self.search.horizon:
            raise UnknownOption("every", every, (f"1 to {self.search.horizon}, the horizon",))
        if not isinstance(foresees, bool):
            raise UnknownOption("foresees", foresees, ("True", "False"))
        self.do, self.backend, self.foresees = flatten(do or {}), backend, foresees
        self.seed = whole_number("seed", seed, least=0)
        self.threads = None if threads is None else whole_number("threads", threads, least=1)
        self._forget()

    def _forget(self) -> None:
        self._programs: WeakKeyDictionary[World, _Program] = WeakKeyDictionary()

    def __getstate__(self) -> dict[str, Any]:
        """Copy and pickle without what is going on."""
        return {name: value for name, value in vars(self).items() if name != "_programs"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Begin anew."""
        self.__dict__.update(state)
        self._forget()

    def __call__(self, world: World) -> Floats:
        """Give the action of the present step.

        Raises:
            UnknownVariable: The objective names a variable that does not exist.
            InterventionError: What is believed cannot be done to the present.
            ModelError: The objective gives no finite number for each step of each rollout.
        """
        program = self._programs.get(world)
        if program is None or not program.fits(world):
            program = self._programs[world] = _Program(self, world)
        return program.action(world)

    def score(self, world: World) -> tuple[Score, Score | None]:
        """Give what a plan in a world is worth: along the way, and at its end."""
        return self.objective or nearness(world.task), self.terminal


@final
class _Program:
    """The plans for one world, episode after episode."""

    def __init__(self, policy: CrossEntropy, world: World) -> None:
        self._policy, self._plan = policy, world.compiled.plan
        self._objective, self._terminal = policy.score(world)
        names = (*self._objective.names, *(self._terminal.names if self._terminal else ()))
        self._model = Model(
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

    def fits(self, world: World) -> bool:
        """Tell whether the same bodies are there."""
        return bool(world.compiled.plan == self._plan)

    def action(self, world: World) -> Floats:
        """Give the action of the present step."""
        goes_on = self._at == _place(world)
        if not (goes_on and self._ahead and self._version == world.version):
            self._found = self._searched(world, self._left() if goes_on else self._rest(world))
            self._ahead = [*self._found.actions[: self._policy.every]]
        seed, episode, index = _place(world)
        self._at, self._version = (seed, episode, index + 1), world.version
        return self._ahead.pop(0).copy()

    def _rest(self, world: World) -> Found:
        """Begin with staying where it is."""
        actions = np.tile(world.task.idle(world), (self._policy.search.horizon, 1))
        return Found(actions, -np.inf, actions, actions[None][:0])

    def _left(self) -> Found:
        """Begin with what is left of the last plan."""
        return self._found.later(self._policy.every - len(self._ahead))

    def _searched(self, world: World, start: Found) -> Found:
        setting, seed = self._policy.search, self._policy.seed
        present = self._model.present(world)

        def drawn(round_: int) -> Floats:
            stream = f"planning {seed}, round {round_}"
            n, noise = world.compiled.n_actions, world.noise
            return setting.noise(noise, stream, n, episode=world.episode, step=world.index)

        def evaluated(actions: Floats) -> Floats:
            values = self._model.rollouts(present, actions)
            shape = actions.shape[:2]
            total: Floats = self._objective.of(values, shape).sum(axis=1)
            if self._terminal is not None:
                last = {name: value[:, -1] for name, value in values.items()}
                total = total + self._terminal.of(last, shape[:1])
            return total

        return search(setting, evaluated, drawn, action_range(world), start)


def _place(world: World) -> tuple[int, int, int]:
    """Say which control step of which episode this is."""
    return world.noise.seed, world.episode, world.index


def _search(numbers: dict[str, Any]) -> Search:
    """Read the numbers of a search.

    Raises:
        UnknownOption: One of them does not exist.
    """
    known = tuple(Search.__dataclass_fields__)
    for name in numbers:
        if name not in known:
            raise UnknownOption("option of a planner", name, known)
    return Search(**numbers)
