"""Time planning by the cross-entropy method beside the predecessor's.

::

    python benchmarks/planning.py --predecessor /path/to/environment/bin/python

Pushing, control steps of 10 × 4 ms, the same numbers of samples, steps and rounds, and actions
drawn from the same distribution (white noise, a quarter of the range). Both take turns in one run;
this package plans on one thread, too, so that seconds of the processor can be compared. It prints
what it finds and writes it as JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import time
from pathlib import Path
from typing import Any

from scm_world.policies.planning import CrossEntropy
from scm_world.queries import World
from scm_world.queries.experiments.versions import versions

HERE = Path(__file__).parent
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
NUMBERS = {"samples": 48, "horizon": 12, "iterations": 2, "elites": 8}


def its_plans(python: str, plans: int) -> dict[str, Any]:
    """Let the predecessor plan."""
    numbers = [f"--{name}={number}" for name, number in {**NUMBERS, "plans": plans}.items()]
    command = [python, str(HERE / "planning_predecessor.py"), *numbers]
    quiet = {**os.environ, **dict.fromkeys(THREADS, "1")}
    done = subprocess.run(  # noqa: S603 # our own script
        command, check=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=quiet
    )
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def our_plans(plans: int) -> list[list[float]]:
    """Plan from the beginning of an episode, after a plan that is not counted."""
    world = World("pushing")
    times = []
    for seed in range(plans + 1):
        policy = CrossEntropy(objective="reward", spread=0.5, color=0.0, threads=1, **NUMBERS)
        world.reset(seed=seed)
        policy(world)  # copies are made, and compiled code is read
        world.reset(seed=seed + 1)
        wall, busy = time.perf_counter(), time.process_time()
        policy(world)
        times.append([time.perf_counter() - wall, time.process_time() - busy])
    world.close()
    return times[1:]


def summary(times: list[list[float]]) -> dict[str, float]:
    """Give medians: seconds for a plan, and control steps in a second of the processor."""
    wall, busy = (statistics.median(column) for column in zip(*times, strict=True))
    steps = NUMBERS["samples"] * NUMBERS["horizon"] * NUMBERS["iterations"]
    return {"wall [s]": wall, "processor [s]": busy, "steps per processor second": steps / busy}


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--predecessor", required=True, help="its interpreter")
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--out", type=Path, default=HERE / "planning.json")
    asked = parser.parse_args()
    ours: list[list[float]] = []
    its: list[list[float]] = []
    found: dict[str, Any] = {}
    for _ in range(asked.turns):
        found = its_plans(asked.predecessor, 1)
        its += found["times"]
        ours += our_plans(3)
    result = {
        "numbers": NUMBERS,
        "load": os.getloadavg(),
        "ours": summary(ours),
        "predecessor": summary(its),
        "versions": {"ours": versions(), "predecessor": found["versions"]},
    }
    result["ratio, processor"] = (
        result["predecessor"]["processor [s]"] / result["ours"]["processor [s]"]
    )
    asked.out.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
