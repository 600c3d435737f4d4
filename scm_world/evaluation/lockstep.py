"""Episodes that are played side by side, on an engine that steps many worlds in one call."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from typing import Any, final

import numpy as np

from scm_world.env import ScmWorldEnv
from scm_world.env.batched.buffers import FLAGS
from scm_world.env.batched.native import NativeExecutor, plain_vectors
from scm_world.evaluation.episodes import EpisodeRow, EpisodeRunner, RunningEpisode, Stepped, play
from scm_world.evaluation.players import Actions, Player
from scm_world.evaluation.protocols import Protocol
from scm_world.tasks.rewards import FRACTION


@final
class _Rows:
    """Environments of a native batch; see ``Envs``."""

    def __init__(self, executor: NativeExecutor, n_actions: int) -> None:
        self._executor = executor
        self._actions = np.zeros((executor.num_envs, n_actions))

    def observation(self, row: int) -> Any:
        return self._executor.buffers.observation(row)

    def step(self, actions: Mapping[int, Actions]) -> Mapping[int, Stepped]:
        which = np.zeros(self._executor.num_envs, dtype=np.bool_)
        for row, action in actions.items():
            which[row], self._actions[row] = True, action
        self._executor.step(which, self._actions)
        buffers = self._executor.buffers
        infos: Mapping[str, Any] = buffers.infos
        fractions, successes = infos.get(FRACTION), infos.get(FLAGS[0])
        return {
            row: Stepped(
                float(buffers.rewards[row]),
                None if fractions is None else float(fractions[row]),
                None if successes is None else bool(successes[row]),
                bool(buffers.terminations[row] or buffers.truncations[row]),
            )
            for row in actions
        }

    def arrive(self, row: int, episode_run: RunningEpisode, *, over: bool) -> None:
        if over or not episode_run.is_due:
            episode_run.mark.look(self._executor.state(row))
            return
        with self._executor.alone(row) as env:
            episode_run.intervene(env)
            episode_run.mark.look()


@final
class Lockstep:
    """Runs episodes of one backend together, bit for bit as ``EpisodeRunner`` does one by one.

    Only a policy whose actions are known to follow from what it observed in the same episode can
    play several of them at once. With one thread no policy does: many worlds at once do not fit
    into its cache, and that costs as much as is gained.

    Args:
        env: One like those that are played in.
        most: How many episodes there are at the same time, at most.
        threads: Of the engine.
    """

    def __init__(self, env: ScmWorldEnv, most: int, threads: int) -> None:
        self._env, self._most, self._threads = env, most, threads
        self._executor: NativeExecutor | None = None
        self._runners: dict[int, EpisodeRunner] = {}

    def play(
        self,
        player: Player,
        protocol: Protocol,
        *,
        seed: int,
        episodes: range,
        who: tuple[str, int],
    ) -> list[EpisodeRow] | None:
        """Play some episodes.

        Args:
            player: Who acts.
            protocol: What is done.
            seed: Of the noise.
            episodes: Their numbers within the noise.
            who: Name and number of the run.

        Returns:
            A row for each; None if they have to be played one after another. That is so, too,
            where anything goes wrong: a runner says in which episode.
        """
        world = self._env.world
        if (
            not player.is_plain
            or self._threads < 2
            or not 1 < len(episodes) <= self._most
            or not world.backend.capabilities.batch
            or len(world.structures.head)  # bodies may come and go in some of them
            or plain_vectors(self._env)[1]
        ):
            return None
        if self._executor is None:
            self._executor = NativeExecutor(self._env.sibling, self._most, threads=self._threads)
        running = []
        try:
            for index, number in enumerate(episodes):
                with self._executor.alone(index) as env:
                    runner = self._runners.setdefault(index, EpisodeRunner(env))
                    turn, _ = runner.begin(protocol, seed=seed, episode=number)
                    place = (*who, world.backend.name, protocol.name, seed, number)
                    running.append(RunningEpisode(env, copy(player), turn, place))
            play(_Rows(self._executor, world.compiled.n_actions), running)
        except Exception:  # whatever it was: it happens again in the runner, which tells the place
            self.close()
            return None
        return [episode_run.row for episode_run in running]

    def close(self) -> None:
        """Free the engines."""
        if self._executor is not None:
            self._executor.close()
        self._executor, self._runners = None, {}
