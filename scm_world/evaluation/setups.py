"""What an evaluation consists of: who acts where, in which protocols, how often."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from hashlib import blake2b
from typing import Any, final

import gymnasium
import numpy as np

from scm_world._arguments import one_of, whole_number
from scm_world._fingerprint import fingerprint
from scm_world.backends import backends
from scm_world.env import ENV_OPTIONS, ScmWorldEnv
from scm_world.errors import ModelError, SnapshotMismatch, UnknownOption
from scm_world.evaluation.agents import (
    AgentRun,
    in_form,
    load_agents,
    shared_options,
    task_for,
)
from scm_world.evaluation.episodes import EpisodeRunner, unrelated
from scm_world.evaluation.protocols import Protocol, chosen, protocols_of
from scm_world.policies.cards import FORM
from scm_world.queries.experiments.versions import versions
from scm_world.tasks import Task, make_task, tasks

SHARD = 25
"""Episodes that are played and written in one piece."""

_MINE = ("task", "backend", "render_mode")
"""Options of the environment that an evaluation sets by itself."""


@final
@dataclass(frozen=True)
class EvaluationPlace:
    """Where episodes are run.

    Attributes:
        task: Name, or a task.
        options: Of the environment, without task and backend.
    """

    task: Task | str
    options: Mapping[str, Any] = field(default_factory=dict)

    def env(self, engine: str, form: Mapping[str, Any] | None = None) -> ScmWorldEnv:
        """Make the environment on an engine.

        Args:
            engine: Its name.
            form: Options of the agent that acts in it; see ``in_form``.
        """
        return ScmWorldEnv(self.task, backend=engine, **in_form(self.options, form))

    @cached_property
    def made(self) -> Task:
        """The task itself."""
        if isinstance(self.task, Task):
            return self.task
        return make_task(self.task, **(self.options.get("task_options") or {}))

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the task that was made of a name."""
        return {name: value for name, value in self.__dict__.items() if name != "made"}

    @property
    def name(self) -> str:
        """Name of the task."""
        return self.task if isinstance(self.task, str) else self.task.name

    def about(self) -> dict[str, Any]:
        """Say what it is, as plain data.

        Raises:
            ModelError: Something of it cannot be written down.
        """
        given = {} if isinstance(self.task, str) else self.task.given
        options = {name: value for name, value in self.options.items() if name != "task_options"}
        parts = {f"option {name!r}": value for name, value in sorted(options.items())}
        data = {
            "task": self.name,
            "arguments": {name: value for name, value in given.items() if name != "model"},
            "fingerprint": fingerprint({**self.made.__fingerprint__(), **parts}),
            "env": dict(self.options),
        }
        try:
            found: dict[str, Any] = json.loads(json.dumps(data, default=_plain, allow_nan=False))
            return found
        except (TypeError, ValueError) as error:
            raise ModelError([f"the environment cannot be written down: {error}"]) from None


@final
@dataclass(frozen=True)
class Shard:
    """Some episodes in a row of one policy on one backend in one protocol.

    Attributes:
        agent: Place of the policy among the policies.
        engine: Name of the engine.
        protocol: Place of the protocol among the protocols.
        seed: Of the noise.
        first: Number of the first episode.
        stop: Number after the last one.
    """

    agent: int
    engine: str
    protocol: int
    seed: int
    first: int
    stop: int


@final
@dataclass(frozen=True)
class Setup:
    """An evaluation before it is run.

    Attributes:
        place: Where.
        agents: Who.
        engines: On which engines.
        protocols: What is done.
        seeds: Of the noise.
        n: Episodes of each protocol, for each seed.
        versions: Of everything that decides the results, by engine.
        unrelated: By agent, the variables from which no directed path leads to the score or to what
            it observes; of agents that may read the whole world nothing is known.
    """

    place: EvaluationPlace
    agents: tuple[AgentRun, ...]
    engines: tuple[str, ...]
    protocols: tuple[Protocol, ...]
    seeds: tuple[int, ...]
    n: int
    versions: Mapping[str, Mapping[str, str]]
    unrelated: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def env(self, shard: Shard) -> ScmWorldEnv:
        """Make the environment of a shard: on its backend, in the form of its agent."""
        return self.place.env(shard.engine, self.agents[shard.agent].form)

    def where(self, shard: Shard) -> str:
        """Name this environment; it is the same one for agents of the same form."""
        return json.dumps([shard.engine, self.agents[shard.agent].form], sort_keys=True)

    def shards(self) -> list[Shard]:
        """List everything that has to be played; what is compared with one another is near."""
        return [
            Shard(agent_run, engine, protocol, seed, first, min(first + SHARD, self.n))
            for protocol in range(len(self.protocols))
            for seed in self.seeds
            for first in range(0, self.n, SHARD)
            for engine in self.engines
            for agent_run in range(len(self.agents))
        ]

    def shard_of(self, row: Mapping[str, Any]) -> Shard:
        """Give the shard of one episode alone.

        Args:
            row: At least agent, run, engine, protocol, seed and episode.

        Raises:
            SnapshotMismatch: There is no such agent, run or protocol.
        """
        agents = [(agent_run.agent, agent_run.run) for agent_run in self.agents]
        names = [protocol.name for protocol in self.protocols]
        who = (row["agent"], row["run"])
        if who not in agents or row["protocol"] not in names:
            where = ", ".join(f"{name} {row[name]}" for name in ("agent", "run", "protocol"))
            raise SnapshotMismatch(f"{where}: what is given has no such agent, run or protocol")
        episode = row["episode"]
        agent_run, protocol = agents.index(who), names.index(row["protocol"])
        return Shard(agent_run, row["engine"], protocol, row["seed"], episode, episode + 1)

    def key(self, shard: Shard) -> str:
        """Sum up everything that decides what a shard gives."""
        agent_run = self.agents[shard.agent]
        content = {
            "place": self.place.about(),
            "agent": agent_run.identity(),
            "engine": dict(self.versions[shard.engine]),
            "protocol": self.protocols[shard.protocol].as_dict(),
            "episodes": [shard.engine, shard.seed, shard.first, shard.stop],
        }
        text = json.dumps(content, sort_keys=True)
        return blake2b(text.encode(), digest_size=12).hexdigest()

    def about(self) -> dict[str, Any]:
        """Say what it is, as plain data."""
        return {
            **self.place.about(),
            "engines": list(self.engines),
            "agents": [agent_run.as_dict() for agent_run in self.agents],
            "protocols": [protocol.as_dict() for protocol in self.protocols],
            "seeds": list(self.seeds),
            "n": self.n,
            "versions": {engine: dict(found) for engine, found in self.versions.items()},
            "unrelated": {agent: list(names) for agent, names in self.unrelated.items()},
        }


def prepare(
    policy: Any,
    protocols: Any,
    *,
    task: Task | str | None,
    n: int,
    seeds: Any,
    backend: Any,
    env: Mapping[str, Any] | None,
    trusted: Sequence[str] | None,
) -> Setup:
    """Check everything that can be checked before the first episode.

    Args:
        policy: A policy; a list of policies, one for each training run; or either by the name of
            the agent.
        protocols: See ``chosen``.
        task: Name, or a task; if None the one that the policies were trained for, else pushing.
        n: Episodes of each protocol, for each seed.
        seeds: One or several; also as a text with commas.
        backend: One backend or several.
        env: Options of the environment.
        trusted: Packages whose functions may be policies, if named by a text.

    Raises:
        ScmWorldError: What is wrong, by name.
    """
    loaded = load_agents(policy, trusted)
    for agent in loaded:
        about, path = agent.about, str(agent.about.get("path", ""))
        learned = path.endswith(".zip") and "library" in about
        learned = learned or (hasattr(agent.player.policy, "predict") and "sha256" not in about)
        if learned and agent.player.made_for is None and not {*FORM} & {*(env or {})}:
            gymnasium.logger.warn(
                f"{agent.agent!r} does not say how it observes and acts; it acts here with the "
                "defaults of gymnasium.make, and recipes train with other actions: give "
                "env={'action_mode': …} as in its training, or a file that export_sb3 has written"
            )
    trained = [(agent.agent, agent.player.made_for) for agent in loaded]
    task = task_for(task, trained, trusted or ())
    if not isinstance(task, Task | str):
        raise UnknownOption("task", task, tasks())
    if not isinstance(env, Mapping | None):
        raise UnknownOption("env", env, ("options of the environment, by name",))
    allowed = [name for name in ENV_OPTIONS if name not in _MINE]
    for name in env or {}:
        one_of("option of the environment", name, allowed)
    place = EvaluationPlace(task, shared_options(env, trained))
    made = place.made  # refuses a task that is not there
    engines = _several("backend", backend)
    for engine in engines:
        if not isinstance(engine, str) or engine not in backends():
            raise UnknownOption("backend", engine, backends())
    wanted = chosen(protocols, protocols_of(made, engines[0]))
    count = whole_number("n", n, least=1)
    given = (
        int(s) if isinstance(s, str) and s.isdecimal() else s for s in _several("seeds", seeds)
    )
    noises = tuple(whole_number("seed", seed, least=0) for seed in given)
    for noise in noises:
        if noise >= 2**63:
            raise UnknownOption("seed", noise, ("any whole number below 2**63",))
    found: dict[str, dict[str, str]] = {}
    agents: tuple[AgentRun, ...] = ()
    silent: dict[str, tuple[str, ...]] = {}
    for engine in engines:
        runner = EpisodeRunner(place.env(engine))
        try:
            for protocol in wanted:
                runner.try_out(protocol, seed=noises[0])
            found[engine] = versions(runner.env.world.engine)
            for agent in loaded if len(agents) < len(loaded) else ():  # on the first backend
                own = runner.env if agent.form is None else place.env(engine, agent.form)
                try:
                    agents += (agent.tried_out(own),)
                    silent[agent.agent] = unrelated(own, agent.about)
                finally:
                    if own is not runner.env:
                        own.close()
        finally:
            runner.close()
    setup = Setup(place, agents, engines, wanted, noises, count, found, silent)
    setup.about()  # refuses what cannot be written down, before any time is spent
    return setup


def task_of(policy: Any, trusted: Sequence[str] | None = None) -> str:
    """Name the default task of policies.

    Args:
        policy: As in ``prepare``.
        trusted: Packages whose functions may be policies, if named by a text.

    Raises:
        ScmWorldError: A policy cannot be read, or they were trained for several tasks.
    """
    agents = [(agent.agent, agent.player.made_for) for agent in load_agents(policy, trusted)]
    return str(task_for(None, agents, trusted or ()))


def _several(option: str, given: Any) -> tuple[Any, ...]:
    if isinstance(given, str):
        given = [word.strip() for word in given.split(",")]
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
    raise TypeError(f"{value!r} is no plain data")
