"""Where the time of a control step goes in an evaluation, for ``evaluation.py``."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

from benchmarks.evaluation_policy import Mlp
from scm_world.env import ScmWorldEnv
from scm_world.evaluation.episodes import Hook, ScoreHook, scored_episode
from scm_world.evaluation.protocols import Protocol, protocols_of
from scm_world.policies.agents import as_agent
from scm_world.world import Snapshot


class Recorder:
    """A policy that remembers what it saw and did."""

    def __init__(self) -> None:
        self._policy = Mlp()
        self.observations: list[Any] = []
        self.actions: list[Any] = []

    def __call__(self, observation: Any) -> Any:
        """Act as the network does."""
        self.observations.append(observation)
        self.actions.append(self._policy(observation))
        return self.actions[-1]


class Beginning(Hook):
    """Keeps the beginning of an episode."""

    def begin(self, env: ScmWorldEnv, observation: Any) -> None:
        """Save the world after the reset."""
        self.snapshot: Snapshot = env.world.snapshot()


def shares(task: str, episodes: int) -> dict[str, float]:
    """Split the time of a control step, on average over all protocols [µs of the processor].

    Args:
        task: Name of a task.
        episodes: Of each protocol; one more is played before, which warms up.
    """
    env = ScmWorldEnv(task)
    total: Counter[str] = Counter()
    for number in range(episodes + 1):
        for protocol in protocols_of(task):
            found = split(env, protocol, number)
            if number > 0:
                total.update(found)
    env.close()
    mean = {name: value / total["steps"] * 1e6 for name, value in total.items() if name != "steps"}
    rest = mean["episode"] - mean["env.step"] - mean["policy"] - mean["fingerprint"]
    return {**mean, "reset, interventions, the rest": rest}


def split(env: ScmWorldEnv, protocol: Protocol, episode: int) -> dict[str, float]:
    """Play an episode, and then its parts alone, from the same beginning."""
    recorder, beginning = Recorder(), Beginning()
    scored_episode(env, as_agent(recorder), protocol, seed=0, episode=episode, hooks=[beginning])
    world, actions = env.world, recorder.actions
    commands = [env.actions.command(action) for action in actions]
    player = as_agent(Mlp())

    def raw(command: Any) -> None:
        world.backend.step(command, world.substeps)

    found = {
        "steps": float(len(actions)),
        "episode": busy(
            lambda _: scored_episode(env, player, protocol, seed=0, episode=episode), [None]
        ),
        "policy": busy(player.act, recorder.observations),
    }
    world.restore(beginning.snapshot)
    found["env.step"] = busy(env.step, actions)
    world.restore(beginning.snapshot)
    found["physics, in env.step"] = busy(raw, commands)
    world.restore(beginning.snapshot)
    measured = ScoreHook()
    measured.begin(env, None)
    found["fingerprint"] = busy(lambda action: measured.choose(None, action), actions)
    found["fingerprint"] += busy(lambda _: measured.after(None, 0.0, {}), actions)
    return found


def busy(function: Callable[[Any], Any], given: Iterable[Any]) -> float:
    """Call a function with one thing after another; give the seconds of the processor."""
    started = time.process_time()
    for one in given:
        function(one)
    return time.process_time() - started
