"""What an evaluation consists of: who acts where, in which protocols, how often."""

from __future__ import annotations

import inspect
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Any, final

import numpy as np

from scm_world.backends import BACKENDS
from scm_world.env import ScmWorldEnv
from scm_world.errors import ModelError, UnknownOption
from scm_world.evaluation.arena import Arena, turn_of
from scm_world.evaluation.benchmark import ROLES, protocols_of
from scm_world.evaluation.policies import Player, as_player
from scm_world.evaluation.protocols import Protocol, chosen
from scm_world.queries.experiments.versions import versions
from scm_world.tasks import Task
from scm_world.world.start import whole_number

SHARD = 25
"""Episodes that are played and written down at once."""

_MINE = ("task", "backend", "render_mode")
"""Options of the environment that an evaluation sets by itself."""

_TRIES = 25  # observations on which a policy without a file is tried out


@final
@dataclass(frozen=True)
class Seat:
    """A policy and what it is called.

    Attributes:
        agent: Name of the agent.
        run: Number of its training run.
        policy: What a user gave.
        about: What it is, as plain data.
    """

    agent: str
    run: int
    policy: Any
    about: Mapping[str, Any]


@final
@dataclass(frozen=True)
class Place:
    """Where episodes happen.

    Attributes:
        task: Name, or a task.
        options: Of the environment, besides task and engine.
    """

    task: Task | str
    options: Mapping[str, Any] = field(default_factory=dict)

    def env(self, engine: str) -> ScmWorldEnv:
        """Make the environment on an engine."""
        return ScmWorldEnv(self.task, backend=engine, **self.options)

    @property
    def name(self) -> str:
        """Name of the task."""
        return self.task if isinstance(self.task, str) else self.task.name

    def about(self) -> dict[str, Any]:
        """Say what it is, as plain data.

        Raises:
            ModelError: Something of it cannot be written down.
        """
        arguments = {} if isinstance(self.task, str) else self.task.given
        try:
            return json.loads(  # type: ignore[no-any-return]
                json.dumps(
                    {"task": self.name, "arguments": arguments, "env": dict(self.options)},
                    default=_plain,
                    allow_nan=False,
                )
            )
        except (TypeError, ValueError) as error:
            raise ModelError([f"the environment cannot be written down: {error}"]) from None


@final
@dataclass(frozen=True)
class Shard:
    """Some episodes in a row of one policy on one engine in one protocol.

    Attributes:
        seat: Place of the policy among the policies.
        engine: Name of the engine.
        protocol: Place of the protocol among the protocols.
        seed: Of the noise.
        first: Number of the first episode.
        stop: Number after the last one.
    """

    seat: int
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
        seats: Who.
        engines: On which engines.
        protocols: What is done.
        seeds: Of the noise.
        n: Episodes of each protocol, for each seed.
        versions: Of everything that decides the results, by engine.
    """

    place: Place
    seats: tuple[Seat, ...]
    engines: tuple[str, ...]
    protocols: tuple[Protocol, ...]
    seeds: tuple[int, ...]
    n: int
    versions: Mapping[str, Mapping[str, str]]

    def shards(self) -> list[Shard]:
        """List everything that has to be played; what is compared with one another is near."""
        return [
            Shard(seat, engine, protocol, seed, first, min(first + SHARD, self.n))
            for protocol in range(len(self.protocols))
            for seed in self.seeds
            for first in range(0, self.n, SHARD)
            for engine in self.engines
            for seat in range(len(self.seats))
        ]

    def key(self, shard: Shard) -> str:
        """Sum up everything that decides what a shard gives."""
        seat = self.seats[shard.seat]
        content = {
            "place": self.place.about(),
            "agent": [seat.agent, seat.run, dict(seat.about)],
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
            "agents": [
                {"agent": seat.agent, "run": seat.run, "policy": dict(seat.about)}
                for seat in self.seats
            ],
            "protocols": [protocol.as_dict() for protocol in self.protocols],
            "seeds": list(self.seeds),
            "n": self.n,
            "versions": {engine: dict(found) for engine, found in self.versions.items()},
        }


def prepare(
    policy: Any,
    protocols: Any,
    *,
    task: Task | str,
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
        task: Name, or a task.
        n: Episodes of each protocol, for each seed.
        seeds: One or several.
        backend: One engine or several.
        env: Options of the environment.
        trusted: Packages whose functions may be policies, if named by a text.

    Raises:
        ScmWorldError: What is wrong, by name.
    """
    options = dict(env or {})
    allowed = [name for name in inspect.signature(ScmWorldEnv).parameters if name not in _MINE]
    for name in options:
        if name not in allowed:
            raise UnknownOption("option of the environment", name, allowed)
    place = Place(task, options)
    engines = _several("backend", backend)
    for engine in engines:
        if engine not in BACKENDS:
            raise UnknownOption("backend", engine, BACKENDS)
    known = protocols_of(place.name) if place.name in ROLES else ()
    wanted = chosen(protocols, known)
    count = whole_number("n", n, least=1)
    noises = tuple(whole_number("seed", seed, least=0) for seed in _several("seeds", seeds))
    found: dict[str, dict[str, str]] = {}
    seats: tuple[Seat, ...] = ()
    for engine in engines:
        arena = Arena(place.env(engine))
        try:
            for protocol in wanted:
                turn_of(protocol, arena.env)
            found[engine] = versions(arena.env.world.engine)
            seats = seats or _seats(policy, arena, trusted)
        finally:
            arena.close()
    return Setup(place, seats, engines, wanted, noises, count, found)


def _several(option: str, given: Any) -> tuple[Any, ...]:
    if isinstance(given, str):
        given = [word.strip() for word in given.split(",")]
    listed = (given,) if isinstance(given, int | np.integer) else tuple(given)
    if not listed or len(set(listed)) != len(listed):
        raise UnknownOption(option, given, ("one or several, each once",))
    return listed


def _seats(policy: Any, arena: Arena, trusted: Sequence[str] | None) -> tuple[Seat, ...]:
    """Read who acts, and try the policies out."""
    named = policy if isinstance(policy, Mapping) else {None: policy}
    seats: list[Seat] = []
    for name, given in named.items():
        runs = given if _is_several(given) else [given]
        if not runs:
            raise UnknownOption(f"policies of {name}", given, ("one policy or more",))
        for run, one in enumerate(runs):
            player = as_player(one, trusted=trusted)
            agent = str(name) if name is not None else str(player.about["name"])
            about = {**player.about, **_traits(player, arena)}
            seats.append(Seat(agent if name is not None else _short(agent), run, one, about))
    names = [(seat.agent, seat.run) for seat in seats]
    if len(set(names)) != len(names):
        raise UnknownOption("agents", [name for name, _ in names], ("each name once",))
    return tuple(seats)


def _is_several(given: Any) -> bool:
    """Tell a list of policies from a list of numbers, which are actions."""
    return isinstance(given, list) and not (given and isinstance(given[0], list | float | int))


def _short(name: str) -> str:
    """Name an agent by the last part of a path, without what cannot stand in a file name."""
    last = name.replace("\\", "/").rstrip("/").rpartition("/")[2]
    return last.replace(",", " ") or name


def _traits(player: Player, arena: Arena) -> dict[str, str]:
    """Tell policies of one name apart by what they do, where no file says what they are.

    It also shows at once that a policy does not fit the environment.
    """
    env: Any = arena.env
    observation, _ = env.reset(seed=0)
    player.begin(env)
    action = player.act(observation)
    if "sha256" in player.about or player.about.get("kind") == "named":
        return {}
    found = blake2b(np.ascontiguousarray(action).tobytes(), digest_size=8)
    walk = np.random.default_rng(0)
    low, high = np.clip(env.action_space.low, -1e3, 1e3), np.clip(env.action_space.high, -1e3, 1e3)
    for _ in range(_TRIES):
        observation, *_, truncated, _ = env.step(walk.uniform(low, high).astype(np.float32))
        if truncated:
            break
        found.update(np.ascontiguousarray(player.act(observation)).tobytes())
    return {"traits": found.hexdigest()}


def _plain(value: Any) -> Any:
    dump = getattr(value, "model_dump", None)
    if callable(dump):
        return dump(mode="json")
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{value!r} is no plain data")
