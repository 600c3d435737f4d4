"""Whether the cost grows as a straight line, with steps and with worlds."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from benchmarks.speed.scenes import GENERAL, PUSHING, SEED, Case, actions
from benchmarks.speed.timing import MICRO, MILLI, Settings

PIECES, PIECE = 40, 100  # of a long run, and control steps in each


def growing(settings: Settings) -> dict[str, Any]:
    """Fit a line to the time of a long run over its steps, on MuJoCo.

    The number of worlds is in the section of batches.
    """
    return {f"steps: {case.name}": over_steps(case, settings) for case in (PUSHING, GENERAL)}


def over_steps(case: Case, settings: Settings) -> dict[str, float]:
    """Step for a long time, episode after episode."""
    env = case.env("mujoco")
    given = actions(settings.steps(PIECE))
    spent = [0.0]
    for _ in range(PIECES):
        started = time.process_time()
        for action in given:
            if env.step(action)[3]:
                env.reset(seed=SEED)
        spent.append(spent[-1] + time.process_time() - started)
    env.close()
    steps = np.arange(PIECES + 1) * len(given)
    half = PIECES // 2
    return {
        **line(steps, spent, "a step [µs]", MICRO),
        "second half to first": (spent[-1] - spent[half]) / spent[half],
    }


def line(x: ArrayLike, y: ArrayLike, title: str, unit: float) -> dict[str, float]:
    """Fit a line, and say how much of the variance it leaves."""
    across, up = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    slope, offset = np.polyfit(across, up, 1)
    left = up - slope * across - offset
    return {
        title: float(slope) * unit,
        "at zero [ms]": float(offset) * MILLI,
        "R²": 1.0 - float(left.var() / up.var()),
    }
