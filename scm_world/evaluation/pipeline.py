"""Playing all episodes of an evaluation: in parallel, resumable, the same bits every time."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field
from functools import partial
from hashlib import blake2b
from typing import Any, final

from scm_world.errors import DAMAGED, UnknownOption, UnreadableFile
from scm_world.evaluation.episodes import METRICS, EpisodeRow, EpisodeRunner, Hook
from scm_world.evaluation.preparation import prepare
from scm_world.evaluation.results import Evaluation, frame_of
from scm_world.evaluation.setups import Setup, Shard, form_of
from scm_world.output.durable import locked, made, write_whole
from scm_world.output.reading import read_text
from scm_world.output.remote import Location, located
from scm_world.queries.progress import Progress, Tell, clock
from scm_world.tasks import Task
from scm_world.work.executors import Executor, Serial, opened

PART = "scm_world/evaluation-part/1"
"""Format of the file of a finished shard."""


@final
@dataclass
class ShardRunner:
    """Runs shards one after another; keeps environments for the next one.

    Attributes:
        setup: Of the evaluation.
    """

    setup: Setup
    runners: dict[str, EpisodeRunner] = field(default_factory=dict)  # by engine and form

    def __call__(self, shard: Shard) -> list[EpisodeRow]:
        """Play all episodes of a shard."""
        return [self.play(shard, episode) for episode in range(shard.first, shard.stop)]

    def play(self, shard: Shard, episode: int, hooks: Sequence[Hook] = ()) -> EpisodeRow:
        """Play one episode of it."""
        return self.runner(shard).play(
            self.setup.agents[shard.agent, shard.run],
            self.setup.protocols[shard.protocol],
            seed=shard.seed,
            episode=episode,
            who=(shard.agent, shard.run),
            hooks=hooks,
        )

    def runner(self, shard: Shard) -> EpisodeRunner:
        """Return the runner of a shard: its backend, and the options of its agent."""
        agent = self.setup.agents[shard.agent, shard.run]
        key = json.dumps([shard.engine, form_of(agent)], sort_keys=True)
        if key not in self.runners:
            self.runners[key] = EpisodeRunner(self.setup.env(shard.engine, agent))
        return self.runners[key]

    def close(self) -> None:
        """Free the engines."""
        for runner in self.runners.values():
            runner.close()
        self.runners.clear()


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
    out: Location | str | None = None,
    trusted: Sequence[str] | None = None,
    progress: Progress | None = None,
    tell: Tell | None = None,
) -> Evaluation:
    """Find out how well policies do in protocols.

    Every episode is a paired one: number i of a protocol has the same draws for every policy and
    on every engine. The results depend neither on the number of workers nor on interruptions.

    Args:
        policy: A policy; a list of policies, one for each training run of an agent; or either by
            the name of the agent. What a policy can be is said at ``as_agent``.
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
        out: Folder, or a URL, for what is finished; the same call resumes there after an
            interruption, and adds policies, protocols, engines or episodes to it.
        trusted: Packages whose functions may be named as policies; any if None.
        progress: Called with how many episodes are done, and how many there are.
        tell: Called with a line after each protocol: its scores, and how much time is left.

    Returns:
        The table of all episodes, and what follows from it.

    Raises:
        UnknownOption: Something is asked for that does not exist, or that contradicts what a
            policy was trained with.
        EvaluationError: A policy gave no action, or an intervention was refused, with the place;
            all other shards are played and safe by then.
        EngineFailure: Three workers ended over one shard.
        UnreadableFile: Another process is writing to the folder, or a file in it is damaged.

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
        opened(engine, workers) as executor,
        locked(folder) if folder is not None else nullcontext(),
    ):
        rows = played(setup, executor, folder=folder, progress=progress, tell=tell)
    policies = {who: agent.policy for who, agent in setup.agents.items()}
    return Evaluation(setup.about(), frame_of(rows), policies)


def played(
    setup: Setup,
    executor: Executor | None = None,
    *,
    folder: Location | None = None,
    progress: Progress | None = None,
    tell: Tell | None = None,
) -> list[EpisodeRow]:
    """Play what has not been played, and give all rows in their order.

    Args:
        setup: Of the evaluation.
        executor: Plays the shards; this process if None.
        folder: For what is finished.
        progress: Called with how many episodes are done, and how many there are.
        tell: Called with a line after each protocol.
    """
    shards = setup.shards()
    keys = [setup.key(shard) if folder is not None else "" for shard in shards]
    found: dict[int, list[EpisodeRow]] = {}
    for place, (shard, key) in enumerate(zip(shards, keys, strict=True)):
        about = setup.agents[shard.agent, shard.run].about
        noisy = about.get("repeats") == "no"  # it may act otherwise by now
        if folder is not None and not noisy:
            kept = read_part(folder, key, shard.stop - shard.first)
            if kept is not None:
                found[place] = kept

    planned = sum(shard.stop - shard.first for shard in shards)
    before, begun = sum(map(len, found.values())), time.perf_counter()

    def tell_progress(protocol: str | None = None) -> None:
        done = sum(map(len, found.values()))
        if progress is not None:
            progress(done, planned)
        mine = [place for place, shard in enumerate(shards) if shard.protocol == protocol]
        if tell is not None and mine and found.keys() >= {*mine}:
            spent = time.perf_counter() - begun
            left = spent / (done - before) * (planned - done)
            tell(line_of([row for place in mine for row in found[place]], left))

    tell_progress()
    missing = [place for place in range(len(shards)) if place not in found]
    with opened(executor) as player:
        if not isinstance(player, Serial):
            try:
                player.check("task with several workers", setup.task)
            except UnknownOption as error:
                allowed = (
                    "a name, a file or 'module:function' for a function that makes it",
                    f"workers=None ({error})",
                )
                given = setup.made.name
                raise UnknownOption("task with several workers", given, allowed) from error
        for (name, _), agent in setup.agents.items():
            player.check(f"policy {name!r} with several workers", agent.policy)
        make = partial(ShardRunner, setup)
        for index, rows in player.run(make, [shards[place] for place in missing]):
            place = missing[index]
            found[place] = rows
            if folder is not None:
                write_part(folder, keys[place], rows)
            tell_progress(shards[place].protocol)
    return [row for place in range(len(shards)) for row in found[place]]


def line_of(rows: Sequence[EpisodeRow], left: float) -> str:
    """Say in a line what the episodes of a protocol gave, and how much time is left [s].

    Example:
        >>> row = EpisodeRow("mine", 0, "mujoco", "P0", 0, 0, 250, {"success": 1.0})
        >>> line_of([row, row], 75.0)
        'P0, 2 episodes: success mine 1.000; about 1:15 left'
    """
    metric = next(name for name in METRICS if name in rows[0].scores)
    several = len({row.engine for row in rows}) > 1
    scores: dict[str, list[float]] = {}
    for row in rows:
        name = f"{row.agent} on {row.engine}" if several else row.agent
        scores.setdefault(name, []).append(row.scores[metric])
    means = ", ".join(f"{name} {sum(one) / len(one):.3f}" for name, one in scores.items())
    time_left = f"about {clock(left)} left" if left else "all is played"
    what = f"{rows[0].protocol}, {len(rows)} episodes: {metric.replace('_', ' ')} {means}"
    return f"{what}; {time_left}"


def write_part(folder: Location, key: str, rows: Sequence[EpisodeRow]) -> None:
    """Write the episodes of a shard, by its key in the folder of the evaluation."""
    plain = [asdict(row) for row in rows]
    text = json.dumps({"format": PART, "key": key, "sum": _sum(plain), "rows": plain})
    write_whole(text + "\n", made(folder / "parts") / f"{key}.json")


def read_part(folder: Location, key: str, count: int) -> list[EpisodeRow] | None:
    """Read the episodes of a shard, of which there are ``count``; None if it was not played."""
    path = folder / "parts" / f"{key}.json"
    advice = "delete this file; its episodes are then played again"
    try:
        data = json.loads(read_text(path))
        found = (data["format"], data["key"], data["sum"], len(data["rows"]))
        if found != (PART, key, _sum(data["rows"]), count):
            raise ValueError("its content is not what was written")
        return [EpisodeRow(**row) for row in data["rows"]]
    except FileNotFoundError:
        return None
    except DAMAGED as error:
        raise UnreadableFile(str(path), f"it is damaged ({error})", advice) from None


def _sum(rows: Any) -> str:
    text = json.dumps(rows, sort_keys=True)
    return blake2b(text.encode(), digest_size=12).hexdigest()
