"""Where the time of a control step goes."""

from __future__ import annotations

from collections import Counter
from typing import Any
from unittest.mock import patch

from benchmarks.speed.batches import FEW, WORLDS, vector
from benchmarks.speed.scenes import ENGINES, GENERAL, PUSHING, SEED, Case, actions
from benchmarks.speed.stopwatch import Stopwatch
from benchmarks.speed.timing import MICRO, Settings
from scm_world.env import ScmWorldEnv
from scm_world.world.mechanisms import Rows

STEPS, BATCH_STEPS, EPISODES = 250, 20, 10
PHYSICS, REST = "physics", "the rest"
PARTS = (PHYSICS, "reading the state", "mechanisms", "observation", "info", "command", REST)
"""The rest is ``env.step`` and ``World.advance`` themselves: clocks, rewards, checks."""


def profiling(settings: Settings) -> dict[str, Any]:
    """Split the time of a control step: of one environment, and of each world of a batch [µs]."""
    found = {
        engine: {case.name: split(case, engine, settings) for case in (PUSHING, GENERAL)}
        for engine in ENGINES
    }
    worlds = FEW if settings.quick else WORLDS
    found["batch on MuJoCo"] = {
        f"{worlds} of {case.name}": split_batch(case, worlds, settings)
        for case in (PUSHING, GENERAL)
    }
    return found


def split(case: Case, engine: str, settings: Settings) -> dict[str, float]:
    """Time every part of a step in some episodes; the mean over all steps [µs]."""
    env, watch = case.env(engine), Stopwatch()
    watched(env, watch)
    given = actions(settings.steps(STEPS))
    found = lived(env, watch, given, settings.rounds(EPISODES))
    env.close()
    return found


def split_batch(case: Case, worlds: int, settings: Settings) -> dict[str, float]:
    """Time every part of a step of many worlds on one thread; the mean for each world [µs]."""
    envs, watch = vector(case, worlds, threads=1), Stopwatch()
    given = actions(settings.steps(BATCH_STEPS), worlds)
    envs.step(given[0])  # makes what is watched
    watched_batch(envs, watch)
    found = lived(envs, watch, given, settings.rounds(EPISODES))
    envs.close()
    return {part: value / worlds for part, value in found.items()}


def lived(env: Any, watch: Stopwatch, given: Any, episodes: int) -> dict[str, float]:
    """Run some episodes; the mean time of every part of a step [µs]."""
    total: Counter[str] = Counter()
    with patch.object(Rows, "evaluate", watch.timed("mechanisms", Rows.evaluate)):
        for episode in range(episodes + 1):
            env.reset(seed=SEED)
            watch.clear()
            for action in given:
                env.step(action)
            if episode > 0:  # the first one fills caches
                total.update(watch.spent())
    return {part: total[part] / (episodes * len(given)) * MICRO for part in PARTS}


def watched(env: ScmWorldEnv, watch: Stopwatch) -> None:
    """Put a watch on every part of a step."""
    world: Any = env.world
    places: dict[str, tuple[Any, str]] = {
        PHYSICS: (world.backend, "step"),
        "reading the state": (world.backend, "read"),
        "observation": (env.observer, "observe"),
        "info": (env.observer, "outcome"),
        "command": (world.compiled, "clipped"),
        REST: (env, "step"),
    }
    for part, (owner, name) in places.items():
        setattr(owner, name, watch.timed(part, getattr(owner, name)))


def watched_batch(envs: Any, watch: Stopwatch) -> None:
    """Put a watch on every part of a step of a batch.

    Its engine reads the states itself; observations, rewards and infos are written together.
    """
    inner = envs.unwrapped
    places: list[tuple[str, Any, str]] = [
        (PHYSICS, inner._batch._engine, "step"),
        ("observation", inner, "_take"),
        ("command", inner, "_commanded"),
        (REST, inner, "step"),
    ]
    for part, owner, name in places:
        setattr(owner, name, watch.timed(part, getattr(owner, name)))
