"""Playing all episodes of an evaluation: in parallel, resumable, the same bits every time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, final

from scm_world.evaluation.arena import Arena, Row
from scm_world.evaluation.parts import read_part, write_part
from scm_world.evaluation.policies import Player, as_player
from scm_world.evaluation.results import Evaluation
from scm_world.evaluation.setups import Setup, Shard, prepare
from scm_world.evaluation.tables import columns_of
from scm_world.output.durable import locked
from scm_world.queries.progress import Progress
from scm_world.tasks import Task
from scm_world.work.pool import Pool
from scm_world.work.processes import pickled


@final
@dataclass
class Bench:
    """Plays shards one after another, and keeps what it has made for the next one.

    Attributes:
        setup: Of the evaluation.
        trusted: Packages whose functions may be policies.
    """

    setup: Setup
    trusted: Sequence[str] | None = None
    arenas: dict[str, Arena] = field(default_factory=dict)
    players: dict[int, Player] = field(default_factory=dict)

    def __call__(self, shard: Shard) -> list[Row]:
        """Play all episodes of a shard."""
        return [self.play(shard, episode) for episode in range(shard.first, shard.stop)]

    def play(self, shard: Shard, episode: int, watch: Any = None) -> Row:
        """Play one episode of it."""
        seat = self.setup.seats[shard.seat]
        return self.arena(shard.engine).play(
            self.player(shard.seat),
            self.setup.protocols[shard.protocol],
            seed=shard.seed,
            episode=episode,
            who=(seat.agent, seat.run),
            watch=watch,
        )

    def arena(self, engine: str) -> Arena:
        """Give where episodes of an engine happen."""
        if engine not in self.arenas:
            self.arenas[engine] = Arena(self.setup.place.env(engine))
        return self.arenas[engine]

    def player(self, seat: int) -> Player:
        """Give who acts."""
        if seat not in self.players:
            self.players[seat] = as_player(self.setup.seats[seat].policy, trusted=self.trusted)
        return self.players[seat]

    def close(self) -> None:
        """Free the engines."""
        for arena in self.arenas.values():
            arena.close()
        self.arenas.clear()


def evaluate(
    policy: Any,
    protocols: Any = None,
    *,
    task: Task | str = "pushing",
    n: int = 200,
    seeds: Any = 0,
    backend: Any = "mujoco",
    env: Mapping[str, Any] | None = None,
    workers: int = 1,
    out: Path | str | None = None,
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
        task: Name, or a task.
        n: Episodes of each protocol, for each seed.
        seeds: Of the noise, one or several.
        backend: ``"mujoco"``, ``"bullet"``, or both.
        env: Options of the environment, such as ``{"frame_skip": 3}``.
        workers: Processes; with more than one, policies have to be picklable or named by a text.
        out: Folder for what is finished; the same call goes on there after an interruption, and
            adds policies, protocols, engines or episodes to it.
        trusted: Packages whose functions may be named as policies; any if None.
        progress: Told how many episodes are done, and how many there are.

    Returns:
        The table of all episodes, and what follows from it.

    Raises:
        UnknownOption: Something is asked for that does not exist.
        EvaluationError: A policy gave no action, or an intervention was refused, with the place.
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
    folder = None if out is None else Path(out)
    with locked(folder) if folder is not None else nullcontext():
        rows = played(setup, workers=workers, folder=folder, trusted=trusted, progress=progress)
    policies = {(seat.agent, seat.run): seat.policy for seat in setup.seats}
    return Evaluation(setup.about(), columns_of(rows), policies)


def played(
    setup: Setup,
    *,
    workers: int = 1,
    folder: Path | None = None,
    trusted: Sequence[str] | None = None,
    progress: Progress | None = None,
) -> list[Row]:
    """Play what has not been played, and give all rows in their order."""
    shards = setup.shards()
    keys = [setup.key(shard) if folder is not None else "" for shard in shards]
    found: dict[int, list[Row]] = {}
    for place, (shard, key) in enumerate(zip(shards, keys, strict=True)):
        noisy = setup.seats[shard.seat].about.get("repeats") == "no"  # who may be another by now
        count = shard.stop - shard.first
        kept = None if folder is None or noisy else read_part(folder, key, count)
        if kept is not None:
            found[place] = kept
    missing = [place for place in range(len(shards)) if place not in found]
    tell = _teller(progress, sum(shard.stop - shard.first for shard in shards))
    tell(found)
    with _bench(setup, workers, trusted) as pool:
        for index, rows in pool.run([shards[place] for place in missing]):
            place = missing[index]
            found[place] = rows
            if folder is not None:
                write_part(folder, keys[place], rows)
            tell(found)
    return [row for place in range(len(shards)) for row in found[place]]


def _teller(progress: Progress | None, total: int) -> Any:
    def tell(found: Mapping[int, list[Row]]) -> None:
        if progress is not None:
            progress(sum(map(len, found.values())), total)

    return tell


@contextmanager
def _bench(
    setup: Setup, workers: int, trusted: Sequence[str] | None
) -> Iterator[Pool[Shard, list[Row]]]:
    """Open a pool of processes, or work in this one."""
    inline = workers == 1
    if not inline:
        for seat in setup.seats:
            pickled(f"policy {seat.agent!r} with several workers", seat.policy)
    bench = Bench(setup, trusted)
    make = (lambda: bench) if inline else partial(Bench, setup, trusted)
    try:
        with Pool(make, workers, inline=inline) as pool:
            yield pool
    finally:
        bench.close()
