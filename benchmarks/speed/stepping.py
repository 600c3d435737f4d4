"""A control step: the environment, with its log, and the engine alone, in turns."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from benchmarks.speed.scenes import ENGINES, SEED, Case, actions, bare, cases, commands
from benchmarks.speed.timing import MICRO, Settings, busy, in_turns, medians, ratio
from scm_world.evaluation.recording import Recorder

STEPS, ROUNDS = 250, 15


def stepping(settings: Settings) -> dict[str, Any]:
    """Time a step of every scene on both engines [µs of the processor]."""
    return {
        engine: {case.name: step(case, engine, settings) for case in cases(settings)}
        for engine in ENGINES
    }


def step(case: Case, engine: str, settings: Settings) -> dict[str, float]:
    """Compare three ways to live through the same episode.

    Each begins at a reset with the same seed and takes the same actions, so that the engine does
    the same work, bit for bit.
    """
    plain, logged = case.env(engine), Recorder(case.env(engine))
    given = actions(case.steps(settings.steps(STEPS)))
    told, engine_alone = commands(plain, given), bare(plain)

    def episode(env: Any, act: Callable[[Any], Any], sequence: Any) -> Callable[[], float]:
        def live() -> float:
            env.reset(seed=SEED)
            return busy(act, sequence) / len(sequence) * MICRO

        return live

    sides = {
        "raw": episode(plain, engine_alone, told),
        "step": episode(plain, plain.step, given),
        "logged": episode(logged, logged.step, given),
    }
    slow = engine == "bullet" or case.blocks > 10
    rows = in_turns(sides, settings.rounds(ROUNDS // 2 if slow else ROUNDS))
    plain.close()
    logged.close()
    times = medians(rows)
    return {
        "blocks": case.blocks,
        "env.step [µs]": times["step"],
        "raw physics [µs]": times["raw"],
        "with the log [µs]": times["logged"],
        "share of raw": ratio(rows, "raw", "step"),
        "share of raw, with the log": ratio(rows, "raw", "logged"),
    }
