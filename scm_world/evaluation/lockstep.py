"""Episodes that are played side by side, on an engine that steps many worlds in one call."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from scm_world.env import ScmWorldEnv
from scm_world.env.batched.inside import Inside
from scm_world.env.batched.native import NativeCrew
from scm_world.env.batched.sheet import FLAGS, FRACTION
from scm_world.evaluation.episodes import EpisodeRunner, Row, RunningEpisode
from scm_world.evaluation.players import Actions, Player
from scm_world.evaluation.protocols import Protocol

LONG = 0.1
"""Part of the time from which on asking a policy twice costs more than is gained here."""

Seen = list[tuple[Any, bytes]]
"""Every observation of an episode, and the action that followed."""


@final
@dataclass(frozen=True)
class Episodes:
    """Some episodes in a row.

    Attributes:
        who: Agent and run.
        protocol: What is done.
        seed: Of the noise.
        numbers: Of the episodes, within the noise.
    """

    who: tuple[str, int]
    protocol: Protocol
    seed: int
    numbers: range


@dataclass
class _Seat:
    """One of the episodes that are under way.

    Attributes:
        episode_run: What is kept of it.
        place: Agent, run, engine, protocol, seed and episode.
        seen: What is needed to ask the policy again, if that has to be done.
        success: Whether the last control step was a success, if the task says so.
    """

    episode_run: RunningEpisode
    place: tuple[str, int, str, str, int, int]
    seen: Seen | None
    success: bool | None = None

    def act(self, shown: Callable[[int], Any], row: int) -> Actions:
        """Let the player choose an action, shape (n,).

        Args:
            shown: Gives a copy of the observation of a row.
            row: Of this episode.
        """
        action = self.episode_run.act(shown(row))
        if self.seen is not None:
            self.seen.append((shown(row), action.tobytes()))
        return action

    @property
    def row(self) -> Row:
        """What is kept in the end."""
        return self.episode_run.row(self.place, success=self.success)


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
        self._crew: NativeCrew | None = None
        self._arenas: dict[int, EpisodeRunner] = {}
        self._apart: list[Player] = []  # who plays one episode at a time

    def play(self, player: Player, episodes: Episodes) -> list[Row] | None:
        """Play some episodes.

        Args:
            player: Who acts.
            episodes: Which ones.

        Returns:
            A row for each; None if they have to be played one after another. That is so, too,
            where anything goes wrong: a runner says in which episode.
        """
        if not self._takes(player) or not 1 < len(episodes.numbers) <= self._most:
            return None
        try:
            return self._played(player, episodes)
        except Exception:  # whatever it was: it happens again in the runner, which tells the place
            self.close()
            return None

    def _takes(self, player: Player) -> bool:
        world = self._env.world
        return (
            self._threads > 1
            and world.backend.capabilities.batch
            and not len(world.structures.head)  # else bodies may come and go in some of them
            and not Inside.of(self._env).is_partial
            and not any(player is one for one in self._apart)
            and player.parallel
        )

    def _played(self, player: Any, episodes: Episodes) -> list[Row] | None:
        began = time.perf_counter()
        seats = self._seats(player, episodes)
        self._go(seats)
        played = time.perf_counter()
        is_alike = all(self._acts_alike_alone(player, seat) for seat in seats)
        now = time.perf_counter()
        if not is_alike or now - played > LONG * (now - began):
            self._apart.append(player)
        return [seat.row for seat in seats] if is_alike else None

    def _seats(self, player: Any, episodes: Episodes) -> list[_Seat]:
        """Begin some episodes."""
        crew = self._ready()
        engine, seats = self._env.world.backend.name, []
        for index, number in enumerate(episodes.numbers):
            with crew.alone(index) as env:
                runner = self._arenas.setdefault(index, EpisodeRunner(env))
                turn, _ = runner.begin(episodes.protocol, seed=episodes.seed, episode=number)
                episode_run = RunningEpisode(env, player.twin(), turn)
            place = (*episodes.who, engine, episodes.protocol.name, episodes.seed, number)
            seats.append(_Seat(episode_run, place, None if player.is_plain else []))
        return seats

    def _go(self, seats: list[_Seat]) -> None:
        """Play episodes that have begun."""
        crew = self._ready()
        which = np.arange(crew.num_envs) < len(seats)
        actions = np.zeros((crew.num_envs, self._env.world.compiled.n_actions))
        while which.any():
            rows = np.flatnonzero(which).tolist()
            for row in rows:
                actions[row] = seats[row].act(crew.sheet.observation, row)
            crew.step(which, actions)
            self._note(seats, rows)
            which[rows] &= ~(crew.sheet.terminations | crew.sheet.truncations)[rows]
            for row in rows:
                if which[row] and seats[row].episode_run.is_due:
                    with crew.alone(row) as env:
                        seats[row].episode_run.intervene(env)
                        seats[row].episode_run.mark.look()
                else:
                    seats[row].episode_run.mark.look(crew.state(row))

    def _note(self, seats: list[_Seat], rows: list[int]) -> None:
        """Take down what a control step gave."""
        sheet = self._ready().sheet
        infos: Mapping[str, Any] = sheet.infos
        rewards = sheet.rewards.tolist()
        fractions, successes = infos.get(FRACTION), infos.get(FLAGS[0])
        for row in rows:
            fraction = None if fractions is None else float(fractions[row])
            seats[row].episode_run.stepped(rewards[row], fraction)
            seats[row].success = None if successes is None else bool(successes[row])

    def _acts_alike_alone(self, player: Any, seat: _Seat) -> bool:
        """Tell whether a policy does what it did, with nobody else to act for."""
        if seat.seen is None:
            return True
        twin = player.twin()
        twin.begin(self._env)
        return all(twin.act(observation).tobytes() == action for observation, action in seat.seen)

    def _ready(self) -> NativeCrew:
        if self._crew is None:
            self._crew = NativeCrew(self._env.sibling, self._most, threads=self._threads)
        return self._crew

    def close(self) -> None:
        """Free the engines."""
        if self._crew is not None:
            self._crew.close()
        self._crew, self._arenas = None, {}
