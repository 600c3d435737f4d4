"""Playing all episodes of an evaluation: in parallel, resumable, the same bits every time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, final

from scm_world.errors import UnreadableFile
from scm_world.evaluation.agents import AgentRun
from scm_world.evaluation.episodes import EpisodeRow, EpisodeRunner
from scm_world.evaluation.lockstep import Lockstep
from scm_world.evaluation.players import Player, as_player
from scm_world.evaluation.results import Evaluation
from scm_world.evaluation.setups import SHARD, Setup, Shard, prepare
from scm_world.evaluation.shards import read_part, write_part
from scm_world.evaluation.tables import columns_of
from scm_world.output.durable import locked
from scm_world.output.locations import Location, located
from scm_world.queries.progress import Progress
from scm_world.tasks import Task
from scm_world.work.executors import Executor, Serial, opened
from scm_world.work.threads import cores


@final
@dataclass
class ShardRunner:
    """Runs shards one after another; keeps environments and policies for the next one.

    Attributes:
        setup: Of the evaluation.
        trusted: Packages whose functions may be policies.
        threads: Of an engine that steps many worlds in one call; results do not depend on it.
    """

    setup: Setup
    trusted: Sequence[str] | None = None
    threads: int = 1
    runners: dict[str, EpisodeRunner] = field(default_factory=dict)  # by engine and form
    locksteps: dict[str, Lockstep] = field(default_factory=dict)
    players: dict[int, Player] = field(default_factory=dict)

    def __call__(self, shard: Shard) -> list[EpisodeRow]:
        """Play all episodes of a shard, side by side where that is faster."""
        agent_run, numbers = self.setup.agents[shard.agent], range(shard.first, shard.stop)
        rows = self.lockstep(shard).play(
            self.player(shard.agent),
            self.setup.protocols[shard.protocol],
            seed=shard.seed,
            episodes=numbers,
            who=(agent_run.agent, agent_run.run),
        )
        return rows or [self.play(shard, episode) for episode in numbers]

    def play(self, shard: Shard, episode: int, watch: Any = None) -> EpisodeRow:
        """Play one episode of it."""
        agent_run = self.setup.agents[shard.agent]
        return self.runner(shard).play(
            self.player(shard.agent),
            self.setup.protocols[shard.protocol],
            seed=shard.seed,
            episode=episode,
            who=(agent_run.agent, agent_run.run),
            watch=watch,
        )

    def runner(self, shard: Shard) -> EpisodeRunner:
        """Give where the episodes of a shard happen: on its engine, in the form of its agent."""
        key = self.setup.where(shard)
        if key not in self.runners:
            self.runners[key] = EpisodeRunner(self.setup.env(shard))
        return self.runners[key]

    def lockstep(self, shard: Shard) -> Lockstep:
        """Give where the episodes of a shard happen side by side."""
        key = self.setup.where(shard)
        if key not in self.locksteps:
            env, most = self.runner(shard).env, min(SHARD, self.setup.n)
            self.locksteps[key] = Lockstep(env, most, self.threads)
        return self.locksteps[key]

    def player(self, number: int) -> Player:
        """Give who acts.

        Raises:
            UnreadableFile: It is a file, and another one than it was when the evaluation began.
        """
        if number not in self.players:
            given = self.setup.agents[number]
            player = as_player(given.policy, trusted=self.trusted)
            _refuse_another(player, given)
            self.players[number] = player
        return self.players[number]

    def close(self) -> None:
        """Free the engines."""
        for lockstep in self.locksteps.values():
            lockstep.close()
        for runner in self.runners.values():
            runner.close()
        self.locksteps.clear()
        self.runners.clear()


def _refuse_another(player: Player, agent_run: AgentRun) -> None:
    """Refuse a file that was written anew meanwhile, as a training does it."""
    if isinstance(agent_run.policy, str | Path):
        then, now = (about.get("sha256") for about in (agent_run.about, player.about))
        if then != now:
            advice = "copy it if a training still writes it, and evaluate the copy"
            raise UnreadableFile(
                str(agent_run.policy), "it has changed since the evaluation began", advice
            )


def evaluate(
    policy: Any,
    protocols: Any = None,
    *,
    task: Task | str | None = None,
    n: int = 200,
    seeds: Any = 0,
    backend: Any = "mujoco",
    env: Mapping[str, Any] | None = None,
    workers: int | None = None,
    engine: Executor | str | None = None,
    address: str | None = None,
    out: Location | str | None = None,
    trusted: Sequence[str] | None = None,
    progress: Progress | None = None,
) -> Evaluation:
    """Find out how well policies do in protocols.

    Every episode is a paired one: number i of a protocol has the same draws for every policy and
    on every engine. The results depend neither on the number of workers nor on interruptions.

    Args:
        policy: A policy; a list of policies, one for each training run of an agent; or either by
            the name of the agent. What a policy can be is said at ``as_player``.
        protocols: Names (``"P0,P5"``, ``"P2@100"`` for within the episodes), patterns,
            ``Protocol``, or several; all of the task if None.
        task: Name, or a task; if None the one that the policies were trained for, else pushing.
        n: Episodes of each protocol, for each seed.
        seeds: Of the noise, one or several.
        backend: ``"mujoco"``, ``"bullet"``, or both.
        env: Options of the environment, such as ``{"frame_skip": 3}``. A trained policy brings
            those that it was trained with. What is observed and what actions mean is each agent's
            own; such options are for the agents that bring none.
        workers: How many shards of 25 episodes are played at the same time. None is one, in this
            process; with an engine it is as many as there are cores. Other processes play
            policies that can be pickled or are named by a text.
        engine: What plays them: ``"serial"``, ``"process"``, ``"ray"``, or an executor; see
            ``engine_of``.
        address: Of a Ray cluster.
        out: Folder, or a URL, for what is finished; the same call goes on there after an
            interruption, and adds policies, protocols, engines or episodes to it.
        trusted: Packages whose functions may be named as policies; any if None.
        progress: Told how many episodes are done, and how many there are.

    Returns:
        The table of all episodes, and what follows from it.

    Raises:
        UnknownOption: Something is asked for that does not exist, or that contradicts what a
            policy was trained with.
        EvaluationError: A policy gave no action, or an intervention was refused, with the place;
            all other shards are played and safe by then.
        EngineFailure: Three workers ended over one shard, or there is no cluster at the address.
        UnreadableFile: Somebody else is writing to the folder, or a file in it is damaged.

    Example:
        >>> found = evaluate("still", "P0,P5", n=2, backend="fake", env={"max_episode_length": 3})
        >>> len(found), found.protocols
        (4, ('P0', 'P5'))
    """
    setup = prepare(
        policy,
        protocols,
        task=task,
        n=n,
        seeds=seeds,
        backend=backend,
        env=env,
        trusted=trusted,
    )
    folder = None if out is None else located(out)
    with (
        opened(engine, workers, address) as executor,
        locked(folder) if folder is not None else nullcontext(),
    ):
        rows = played(setup, executor, folder=folder, trusted=trusted, progress=progress)
    policies = {(agent_run.agent, agent_run.run): agent_run.policy for agent_run in setup.agents}
    return Evaluation(setup.about(), columns_of(rows), policies)


def played(
    setup: Setup,
    executor: Executor | None = None,
    *,
    folder: Location | None = None,
    trusted: Sequence[str] | None = None,
    progress: Progress | None = None,
) -> list[EpisodeRow]:
    """Play what has not been played, and give all rows in their order.

    Args:
        setup: Of the evaluation.
        executor: Plays the shards; this process if None.
        folder: For what is finished.
        trusted: Packages whose functions may be policies.
        progress: Told how many episodes are done, and how many there are.
    """
    shards = setup.shards()
    keys = [setup.key(shard) if folder is not None else "" for shard in shards]
    found: dict[int, list[EpisodeRow]] = {}
    for place, (shard, key) in enumerate(zip(shards, keys, strict=True)):
        noisy = setup.agents[shard.agent].about.get("repeats") == "no"  # who may be another by now
        count = shard.stop - shard.first
        kept = None if folder is None or noisy else read_part(folder, key, count)
        if kept is not None:
            found[place] = kept
    missing = [place for place in range(len(shards)) if place not in found]
    tell = _teller(progress, sum(shard.stop - shard.first for shard in shards))
    tell(found)
    with opened(executor) as player:
        if not isinstance(player, Serial):
            setup.place.refuse_unsent(player)
        for agent_run in setup.agents:
            player.check(f"policy {agent_run.agent!r} with several workers", agent_run.policy)
        threads = cores() if isinstance(player, Serial) else 1  # workers share the cores
        make = partial(ShardRunner, setup, trusted, threads)
        for index, rows in player.run(make, [shards[place] for place in missing]):
            place = missing[index]
            found[place] = rows
            if folder is not None:
                write_part(folder, keys[place], rows)
            tell(found)
    return [row for place in range(len(shards)) for row in found[place]]


def _teller(progress: Progress | None, total: int) -> Any:
    def tell(found: Mapping[int, list[EpisodeRow]]) -> None:
        if progress is not None:
            progress(sum(map(len, found.values())), total)

    return tell
