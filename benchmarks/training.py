"""How many control steps PPO learns from in a second, beside the predecessor's environment alone.

    python -m benchmarks.training --predecessor PYTHON

needs the extra ``train``, and an interpreter that has CausalWorld 1.2 (it is made if none is
named). Both take turns. Training is the whole command: worlds, network, optimizer, log; the first
rounds, in which things are compiled, do not count.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import statistics
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.speed.predecessor import Predecessor, found_or_made
from benchmarks.speed.scenes import PUSHING, SEED, actions
from scm_world.training.loop import train
from scm_world.training.recipe import Recipe, recipe

STEPS, ROUNDS = 100_000, 5
EPISODE = 250  # control steps
LARGE = {"n_steps": 32, "batch_size": 2048, "worlds": 128}
HERE = Path(__file__).parent


def ours(how: Recipe, threads: int) -> dict[str, float]:
    """Train for a while.

    Args:
        how: The recipe.
        threads: Of the engine and of torch.

    Returns:
        Control steps per second, by the clock on the wall and by that of the processor.
    """
    with TemporaryDirectory() as folder:
        train(how, out=Path(folder) / "run", seed=SEED, threads=threads)
        with (Path(folder) / "run" / "progress.csv").open(encoding="utf-8") as file:
            rows = [{k: float(v or "nan") for k, v in row.items()} for row in csv.DictReader(file)]
    first, last = rows[len(rows) // 5], rows[-1]
    steps = last["time/total_timesteps"] - first["time/total_timesteps"]
    clocks = {"wall_s": "time/time_elapsed", "cpu_s": "time/cpu_seconds"}
    return {name: steps / (last[clock] - first[clock]) for name, clock in clocks.items()}


def theirs(its: Predecessor) -> float:
    """Give the control steps per CPU-second of the predecessor's environment alone."""
    return 1e6 / float(its.ask("step", actions=actions(EPISODE).tolist()))


def measured(python: str, rounds: int, steps: int) -> dict[str, Any]:
    """Let all sides take turns.

    Args:
        python: An interpreter that has CausalWorld.
        rounds: How often.
        steps: Of training each time.
    """
    quiet: dict[str, Any] = {"steps": steps, "trials": {"protocols": [], "episodes": 1}}
    recipes = {
        "tuned": recipe("pushing", **quiet),
        "256-256, 128 worlds": recipe("pushing", **quiet, **LARGE),
        "128-128, 128 worlds": recipe("pushing", **quiet, **LARGE, network={"hidden": (128, 128)}),
    }
    cores = os.cpu_count() or 1
    its = Predecessor(python)
    its.ask("make", task=PUSHING.task, options={}, seed=SEED)
    rows: dict[str, list[float]] = {}
    for _ in range(rounds):
        alone = theirs(its)
        rows.setdefault("predecessor [steps/CPU-s]", []).append(alone)
        for name, how in recipes.items():
            one, all_ = ours(how, 1), ours(how, cores)
            figures = {
                "one thread [steps/CPU-s]": one["cpu_s"],
                "one thread: ratio": one["cpu_s"] / alone,
                f"{cores} cores [steps/s]": all_["wall_s"],
                f"{cores} cores: ratio": all_["wall_s"] / alone,
            }
            for what, figure in figures.items():
                rows.setdefault(f"{name}, {what}", []).append(figure)
    its.close()
    return {name: statistics.median(row) for name, row in rows.items()}


def main() -> None:
    """Measure, print, and write ``training.json``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--predecessor", metavar="PYTHON", help="interpreter with CausalWorld")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--steps", type=int, default=STEPS)
    asked = parser.parse_args()
    python = asked.predecessor or found_or_made()
    if python is None:
        raise SystemExit("without the predecessor there is nothing to compare with")
    found = measured(python, asked.rounds, asked.steps)
    for name, figure in found.items():
        print(f"{name:55} {figure:10.1f}")
    (HERE / "training.json").write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
