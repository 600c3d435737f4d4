"""The adapter to Stable-Baselines3 and the vector environment below it, in turns.

It is run by the interpreter that has the library; see ``adapter.py``.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

from benchmarks.speed.batches import FEW, NAMES, STEPS, WORLDS, running_side, vector
from benchmarks.speed.scenes import PUSHING, SEED, actions
from benchmarks.speed.subprocesses import answer
from benchmarks.speed.timing import MICRO, Settings, in_turns, medians
from scm_world.training.sb3 import make_sb3

ROUNDS = 9


def adapted(given: Any, worlds: int, infos: tuple[str, ...] | None) -> Callable[[], float]:
    """Give what steps all worlds through the adapter, and the time for each world's step [µs]."""
    envs = make_sb3(NAMES[PUSHING.task], worlds, infos=infos, threads=1)

    def live() -> float:
        envs.seed(SEED)
        envs.reset()
        started = time.process_time()
        for action in given:
            envs.step(action)
        return (time.process_time() - started) / (len(given) * worlds) * MICRO

    return live


def added(settings: Settings) -> dict[str, float]:
    """Measure what the adapter adds to a step of a world on one thread [µs]."""
    worlds = FEW if settings.quick else WORLDS
    given = actions(settings.steps(STEPS), worlds)
    envs = vector(PUSHING, worlds, threads=1, autoreset_mode="SameStep")
    sides = {
        "below": running_side(envs, given, time.process_time),
        "adapter": adapted(given, worlds, ("is_success",)),
        "with every info": adapted(given, worlds, None),
    }
    rows = in_turns(sides, settings.rounds(ROUNDS))
    over = {
        name: [a - b for a, b in zip(rows[name], rows["below"], strict=True)]
        for name in ("adapter", "with every info")
    }
    times, more = medians(rows), medians(over)
    return {
        "added to a step of a world [µs]": more["adapter"],
        "added with every info [µs]": more["with every info"],
        "a step of a world below [µs]": times["below"],
    }


if __name__ == "__main__":
    answer(added(Settings(quick=sys.argv[1] == "1")))
