"""Episodes that are played side by side, on an engine that steps many worlds in one call."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, final

import numpy as np

from scm_world.env import ScmWorldEnv
from scm_world.env.batched.buffers import FLAGS, FRACTION
from scm_world.env.batched.native import NativeExecutor
from scm_world.env.batched.reader import EnvLayout
from scm_world.evaluation.episodes import EpisodeRow, EpisodeRunner, RunningEpisode, Stepped, play
from scm_world.evaluation.players import Actions, Player
from scm_world.evaluation.protocols import Protocol

LONG = 0.1
"""Part of the time from which on asking a policy twice costs more than is gained here."""


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

    Only a policy whose actions follow from what it observed in the same episode can play several
    of them at once. Where that is not known of a policy, it is asked again: for each episode
    alone, for the same observations. If it acts in another way, or if asking it takes long, its
    episodes are played one after another from then on. With one thread all of them are: many
    worlds at once do not fit into its cache, and that costs as much as is gained.

    Args:
        env: One like those that are played in.
        most: How many episodes there are at the same time, at most.
        threads: Of the engine.
    """

    def __init__(self, env: ScmWorldEnv, most: int, threads: int) -> None:
        self._env, self._most, self._threads = env, most, threads
        self._executor: NativeExecutor | None = None
        self._runners: dict[int, EpisodeRunner] = {}
        self._apart: list[Player] = []  # who plays one episode at a time

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
        if not self._takes(player) or not 1 < len(episodes) <= self._most:
            return None
        try:
            began = time.perf_counter()
            running = self._begin(player, protocol, seed, episodes, who)
            play(_Rows(self._ready(), self._env.world.compiled.n_actions), running)
            played = time.perf_counter()
            is_alike = all(self._acts_alike_alone(player, episode_run) for episode_run in running)
        except Exception:  # whatever it was: it happens again in the runner, which tells the place
            self.close()
            return None
        now = time.perf_counter()
        if not is_alike or now - played > LONG * (now - began):
            self._apart.append(player)
        return [episode_run.row for episode_run in running] if is_alike else None

    def _takes(self, player: Player) -> bool:
        world = self._env.world
        return (
            self._threads > 1
            and world.backend.capabilities.batch
            and not len(world.structures.head)  # else bodies may come and go in some of them
            and not EnvLayout.of(self._env).is_partial
            and not any(player is one for one in self._apart)
            and player.parallel
        )

    def _begin(
        self,
        player: Player,
        protocol: Protocol,
        seed: int,
        episodes: range,
        who: tuple[str, int],
    ) -> list[RunningEpisode]:
        """Begin some episodes."""
        engine, running = self._env.world.backend.name, []
        for index, number in enumerate(episodes):
            with self._ready().alone(index) as env:
                runner = self._runners.setdefault(index, EpisodeRunner(env))
                turn, _ = runner.begin(protocol, seed=seed, episode=number)
                place = (*who, engine, protocol.name, seed, number)
                running.append(
                    RunningEpisode(env, player.twin(), turn, place, remembers=not player.is_plain)
                )
        return running

    def _acts_alike_alone(self, player: Any, episode_run: RunningEpisode) -> bool:
        """Tell whether a policy does what it did, with nobody else to act for."""
        if episode_run.seen is None:
            return True
        twin = player.twin()
        twin.begin(self._env)
        return all(
            twin.act(observation).tobytes() == action for observation, action in episode_run.seen
        )

    def _ready(self) -> NativeExecutor:
        if self._executor is None:
            self._executor = NativeExecutor(self._env.sibling, self._most, threads=self._threads)
        return self._executor

    def close(self) -> None:
        """Free the engines."""
        if self._executor is not None:
            self._executor.close()
        self._executor, self._runners = None, {}
