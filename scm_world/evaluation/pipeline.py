"""Playing all episodes of an evaluation: in parallel, resumable, the same bits every time."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any, final

import pandas

from scm_world._arguments import typed
from scm_world.env import ScmWorldEnv
from scm_world.evaluation.episodes import REWARDS, Row, scored_episode
from scm_world.evaluation.preparation import prepare
from scm_world.evaluation.results import Evaluation, padded
from scm_world.evaluation.setups import Setup, Shard, form_of
from scm_world.queries.progress import Progress
from scm_world.runs.files import Location
from scm_world.runs.pool import Pool, pool_of
from scm_world.runs.study import Study
from scm_world.tasks import AnySource


@final
@dataclass
class ShardRunner:
    """Runs shards one after another; keeps environments for the next one."""

    setup: Setup
    environments: dict[str, ScmWorldEnv] = field(default_factory=dict)  # by engine and form

    def __call__(self, shard: Shard) -> list[Row]:
        """Play all episodes of a shard, on its backend and with the options of its agent."""
        who = shard.agent, shard.run
        agent, protocol = self.setup.agents[who], self.setup.protocols[shard.protocol]
        key = json.dumps([shard.engine, form_of(agent)], sort_keys=True)
        if key not in self.environments:
            self.environments[key] = self.setup.env(shard.engine, agent)
        env = self.environments[key]
        how: dict[str, Any] = {"seed": shard.seed, "who": who, "steps": self.setup.steps}
        return [
            scored_episode(env, agent, protocol, episode=episode, **how)
            for episode in range(shard.first, shard.stop)
        ]

    def close(self) -> None:
        """Free the engines."""
        for env in self.environments.values():
            env.close()
        self.environments.clear()


@typed
def evaluate(
    policy: object,
    protocols: object = None,
    *,
    task: AnySource | None = None,
    n: int = 200,
    seeds: int | str | Sequence[int | str] = 0,
    backend: str | Sequence[str] | None = None,
    env: Mapping[str, Any] | None = None,
    workers: int | None = None,
    engine: Pool | str | None = None,
    out: Location | str | None = None,
    trusted: Sequence[str] | None = None,
    progress: Progress | None = None,
    repeats: int | None = None,
    steps: bool = False,
) -> Evaluation:
    """Find out how well policies do in protocols.

    Every episode is a paired one: number i of a protocol has the same draws for every policy and
    on every engine. The results depend neither on the number of workers nor on interruptions.

    Args:
        policy: A policy; a list of policies, one for each training run of an agent; or either by
            the name of the agent. See ``as_agent`` for the kinds of policies.
        protocols: Names (``"P0,P5"``, ``"P2@100"`` for within the episodes), patterns,
            ``Protocol``, or several; all of the task if None.
        task: Name, or a task, its class or its function; if None the one that the policies were
            trained for, else pushing.
        n: Episodes of each protocol, for each seed.
        seeds: Seeds of the noise, one or several.
        backend: One of ``backends()``, or several; the usual one of the task if None.
        env: Options of the environment, such as ``{"frame_skip": 3}``. A trained policy brings
            those that it was trained with. Observations and the meaning of actions are each agent's
            own; such options are for the agents that bring none.
        workers: How many shards of 25 episodes are played at the same time. None is one, in this
            process; with an engine it is as many as there are cores. Other processes play
            policies that can be pickled or are named by a text.
        engine: The executor: ``"serial"``, ``"process"``, ``"ray"``, the address of a cluster,
            or a ``Pool``.
        out: Folder, or a URL, for finished shards; the same call resumes there after an
            interruption, and adds policies, protocols, engines or episodes to it.
        trusted: Packages whose functions may be named as policies; any if None.
        progress: Called with how many episodes are done, and how many there are.
        repeats: For how many episodes in a row each draw of each protocol holds, for agents that
            remember; that of each protocol if None. ``n`` is a multiple of it.
        steps: Whether the reward of each control step is kept, for ``Evaluation.since``.

    Returns:
        The table of all episodes, with its estimates.

    Raises:
        UnknownOption: An argument names something that does not exist, or contradicts the
            training of a policy.
        EvaluationError: A policy gave no action, or an intervention was refused, with the place;
            all other shards are played and safe by then.
        EngineFailure: Three workers ended over one shard.
        UnreadableFile: Another process is writing to the folder, or a file in it is damaged.

    Example:
        >>> found = evaluate("still", "P0,P5", n=2, backend="fake", env={"max_episode_length": 3})
        >>> len(found), found.protocols
        (4, ('P0', 'P5'))
    """
    setup = prepare(policy, protocols, task, n, seeds, backend, env, trusted, repeats, steps)
    kind, read, write = (".parquet", _unpacked, _packed) if steps else (".json", _read, _written)
    cells = {f"parts/{setup.key(shard)}{kind}": shard for shard in setup.shards()}
    planned = sum(shard.stop - shard.first for shard in cells.values())
    tell = progress or (lambda *_: None)
    found: dict[str, list[Row]] = {}
    done = 0
    with pool_of(engine, workers) as pool:
        sent = "task with several workers (the text 'module:function' is one, too)"
        pool.check(sent, setup.task)
        for (name, _), agent in setup.agents.items():
            pool.check(f"policy {name!r} with several workers", agent.policy)
        with Study(out, "evaluation", {}) as study, closing(ShardRunner(setup)) as runner:
            tell(0, planned)
            for name, played in study.map(cells, runner, read=read, write=write, pool=pool):
                found[name] = played
                done += len(played)
                tell(done, planned)
    frame = pandas.DataFrame([row for name in cells for row in found[name]])
    policies = {who: agent.policy for who, agent in setup.agents.items()}
    made = None if isinstance(setup.task, str) else setup.task
    rewards = padded(frame.pop(REWARDS)) if steps else None
    return Evaluation(setup.about(), frame, policies, made, rewards)


def _read(data: bytes) -> list[Row]:
    return [{**row, "hash": str(row["hash"])} for row in json.loads(data)]


def _written(rows: list[Row]) -> bytes:
    return (json.dumps(rows) + "\n").encode()


def _unpacked(data: bytes) -> list[Row]:
    found: Any = pandas.read_parquet(io.BytesIO(data)).to_dict("records")
    return list[Row](found)


def _packed(rows: list[Row]) -> bytes:
    content = io.BytesIO()
    pandas.DataFrame(rows).to_parquet(content, compression="zstd", index=False)
    return content.getvalue()
