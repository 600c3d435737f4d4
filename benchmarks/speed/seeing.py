"""Steps with pictures: three cameras, 128 x 128, and the goal seen by the same cameras."""

from __future__ import annotations

from typing import Any

from benchmarks.speed.scenes import ENGINES, SEED, Case, actions, cases
from benchmarks.speed.timing import MICRO, Settings, busy, in_turns, medians

STEPS, ROUNDS = 50, 5


def seeing(settings: Settings) -> dict[str, Any]:
    """Time a step with pictures of every scene on both engines, beside one without."""
    return {
        engine: {case.name: pictures(case, engine, settings) for case in cases(settings)}
        for engine in ENGINES
    }


def pictures(case: Case, engine: str, settings: Settings) -> dict[str, float]:
    """Let an environment with pictures and one without take turns."""
    given = actions(case.steps(settings.steps(STEPS)))
    envs = {
        "pixels": case.env(engine, observation_mode="pixel"),
        "numbers": case.env(engine),
    }

    def live(name: str) -> float:
        envs[name].reset(seed=SEED)
        return busy(envs[name].step, given) / len(given) * MICRO

    rows = in_turns(
        {name: lambda name=name: live(name) for name in envs},  # type: ignore[misc]
        settings.rounds(ROUNDS),
    )
    for env in envs.values():
        env.close()
    times = medians(rows)
    return {
        "blocks": case.blocks,
        "step with pixels [µs]": times["pixels"],
        "pictures alone [µs]": times["pixels"] - times["numbers"],
        "steps with pixels per second": MICRO / times["pixels"],
    }
