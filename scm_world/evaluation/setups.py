"""The description of an evaluation: who acts where, in which protocols, how often."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from hashlib import blake2b
from typing import Any, NamedTuple, final

import numpy as np

from scm_world._arguments import plain
from scm_world._fingerprint import fingerprint
from scm_world.env import ScmWorldEnv
from scm_world.errors import ModelError, UnknownOption
from scm_world.evaluation.protocols import Protocol
from scm_world.policies.agents import Agent
from scm_world.policies.cards import FORM
from scm_world.tasks import Task, make_task

SHARD = 25
"""Episodes that are played and written in one piece."""


@final
class Shard(NamedTuple):
    """Consecutive episodes of one agent on one backend in one protocol: ``first`` to ``stop``."""

    agent: str
    run: int
    engine: str
    protocol: str
    seed: int
    first: int
    stop: int


@final
@dataclass(frozen=True)
class Setup:
    """An evaluation before it is run.

    Attributes:
        task: Name of the task, or a task.
        options: Options of the environment that all agents share, without task and backend. Those
            of ``FORM`` among them are for the agents that do not say how they were trained.
        agents: The agents, by name and training run.
        engines: Names of the backends.
        protocols: The protocols, by name.
        seeds: Seeds of the noise.
        n: Episodes of each protocol, for each seed.
        versions: Versions of everything that decides the results, by backend.
        unrelated: By agent, the variables from which no directed path leads to the score or to what
            it observes; of agents that may read the whole world nothing is known.
        steps: Whether the reward of each control step is kept.
    """

    task: Task | str
    options: Mapping[str, Any]
    agents: Mapping[tuple[str, int], Agent]
    engines: tuple[str, ...]
    protocols: Mapping[str, Protocol]
    seeds: tuple[int, ...]
    n: int
    versions: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    unrelated: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    steps: bool = False

    @cached_property
    def made(self) -> Task:
        """The task itself."""
        if isinstance(self.task, Task):
            return self.task
        return make_task(self.task, **(self.options.get("task_options") or {}))

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the task that was made of a name."""
        return {name: value for name, value in self.__dict__.items() if name != "made"}

    def env(self, engine: str, agent: Agent | None = None) -> ScmWorldEnv:
        """Make the environment on a backend, with the options of an agent."""
        options = dict(self.options)
        if (form := form_of(agent)) is not None:
            options = {name: v for name, v in options.items() if name not in FORM} | form
        return ScmWorldEnv(self.task, backend=engine, **options)

    def shards(self) -> list[Shard]:
        """List everything that has to be played; compared episodes are near one another.

        Episodes of one draw are played one after another.
        """
        sizes = {p.name: max(SHARD // p.repeats, 1) * p.repeats for p in self.protocols.values()}
        return [
            Shard(*who, engine, protocol, seed, first, min(first + size, self.n))
            for protocol, size in sizes.items()
            for seed in self.seeds
            for first in range(0, self.n, size)
            for engine in self.engines
            for who in self.agents
        ]

    def key(self, shard: Shard) -> str:
        """Return a digest of everything that decides the episodes of a shard."""
        agent = self.agents[shard.agent, shard.run]
        about = {name: value for name, value in agent.about.items() if name != "path"}
        content = {
            "place": self.place,
            "agent": [shard.agent, shard.run, about, form_of(agent)],
            "engine": dict(self.versions[shard.engine]),
            "protocol": self.protocols[shard.protocol].as_dict(),
            "episodes": [shard.engine, shard.seed, shard.first, shard.stop],
        }
        text = json.dumps(content, sort_keys=True)
        return blake2b(text.encode(), digest_size=12).hexdigest()

    @cached_property
    def place(self) -> dict[str, Any]:
        """Task, options and fingerprint as plain data."""
        given = {} if isinstance(self.task, str) else self.task.given
        options = {name: value for name, value in self.options.items() if name != "task_options"}
        parts = {f"option {name!r}": value for name, value in sorted(options.items())}
        data = {
            "task": self.task if isinstance(self.task, str) else self.task.name,
            "arguments": {name: value for name, value in given.items() if name != "model"},
            "fingerprint": fingerprint({**self.made.__fingerprint__(), **parts}),
            "env": dict(self.options),
        }
        try:
            found: dict[str, Any] = json.loads(json.dumps(data, default=_plain, allow_nan=False))
            return found
        except (TypeError, ValueError) as error:
            raise ModelError([f"the environment cannot be written down: {error}"]) from None

    def about(self) -> dict[str, Any]:
        """Return the description as plain data."""
        agents = []
        for (name, run), agent in self.agents.items():
            one = {"agent": name, "run": run, "policy": dict(agent.about)}
            form = form_of(agent)
            agents.append(one if form is None else {**one, "env": form})
        return {
            **self.place,
            "engines": list(self.engines),
            "agents": agents,
            "protocols": [protocol.as_dict() for protocol in self.protocols.values()],
            "seeds": list(self.seeds),
            "n": self.n,
            "versions": {engine: dict(found) for engine, found in self.versions.items()},
            "unrelated": {agent: list(names) for agent, names in self.unrelated.items()},
        }


def form_of(agent: Agent | None) -> dict[str, Any] | None:
    """Return the options of the environment that are an agent's own; None if it brings none."""
    return None if agent is None or agent.card is None else agent.card.unusual(FORM)


def several(option: str, given: object) -> tuple[Any, ...]:
    """Return one or several values, also from a text with commas."""
    if isinstance(given, str):
        given = [word.strip() for word in given.split(",")]
    given = plain(given)
    found = tuple(given) if isinstance(given, Iterable) else (given,)
    if not found or any(one in found[:place] for place, one in enumerate(found)):
        raise UnknownOption(option, given, ("one or several, each once",))
    return found


def _plain(value: Any) -> Any:
    dump = getattr(value, "model_dump", None)
    if callable(dump):
        return dump(mode="json")
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if callable(value):
        return f"{value.__module__}:{value.__qualname__}"
    raise TypeError(f"{value!r} is not plain data")
