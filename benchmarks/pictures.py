"""How many pairs of pictures there are in a second: one camera, 64 x 64, in one run.

Goal: 1,000 pairs a second on two cores, so 2 ms of processor time for each pair. Three factors of
pushing, of which one is drawn again: where the block lies, and two colors. Measured are:

- the processor time of a pair in this process, the median over rounds, and its parts;
- pairs a second with one and two processes, once they have started: from the first quarter of the
  files to the last one. Whoever else uses the machine makes this slower: the load is noted.

::

    python -m benchmarks.pictures --out benchmarks/pictures.json
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

from scm_world import Draw, World
from scm_world.backends.renderer import picture, png
from scm_world.cli.console import as_json
from scm_world.discovery.data import triplets
from scm_world.queries.experiments.versions import versions

FACTORS = ("tool_block.cylindrical_position", "tool_block.color", "goal_block.color")
PAIRS, ROUNDS, SHARD = 400, 7, 250
GOAL = 1000.0  # pairs a second on two cores


def processor(world: World, folder: str) -> list[float]:
    """Measure the processor time of a pair in each round [ms]."""
    found = []
    for number in range(ROUNDS + 1):
        begun = time.process_time()
        triplets(world, FACTORS, PAIRS, f"{folder}/round{number}")
        found.append((time.process_time() - begun) / PAIRS * 1e3)
    return found[1:]


def parts(world: World) -> dict[str, float]:
    """Measure what a pair consists of [ms]: two interventions, two scenes, pictures and files."""
    spent = dict.fromkeys(("reset and do", "scenes", "drawing", "encoding"), 0.0)
    drawn = {name: Draw("A") for name in FACTORS}
    for episode in range(PAIRS):
        for which in range(2):
            begun = time.process_time()
            if which:
                world.do({FACTORS[episode % 3]: Draw("A")})
            else:
                world.reset(seed=0, episode=episode, do=drawn)
            done = time.process_time()
            scene = world.scene()
            seen = time.process_time()
            rgb = picture(scene, None, (64, 64))
            painted = time.process_time()
            png(rgb)
            times = (begun, done, seen, painted, time.process_time())
            for name, start, stop in zip(spent, times, times[1:], strict=False):
                spent[name] += (stop - start) / PAIRS * 1e3
    return spent


def speed(world: World, workers: int, n: int, folder: str) -> float:
    """Measure the pairs a second, once all processes have started."""
    told: list[tuple[float, int]] = []
    triplets(
        world,
        FACTORS,
        n,
        f"{folder}/{workers}",
        shard=SHARD,
        workers=workers,
        progress=lambda done, _: told.append((time.perf_counter(), done)),
    )
    (start, first), (stop, last) = told[len(told) // 4], told[-1]
    return (last - first) / (stop - start)


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=12_000, help="for the speed of processes")
    parser.add_argument("--out", type=Path, help="file for the results")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, World("pushing") as world:
        rounds = processor(world, folder)
        pair = statistics.median(rounds)
        found: dict[str, Any] = {
            "processor time of a pair [ms]": pair,
            "least and most of the rounds [ms]": [min(rounds), max(rounds)],
            "pairs a second of processor time, two cores": 2e3 / pair,
            "parts of a pair [ms]": parts(world),
        }
        for workers in (1, 2):
            rate = speed(world, workers, given.pairs, folder)
            found[f"pairs a second, processes: {workers}"] = rate
        load = os.getloadavg()[0]
        found |= {
            "goal": GOAL,
            "load": load,
            "cores": os.cpu_count(),
            "machine": platform.machine(),
        }
        found["versions"] = versions(world.engine)
    for name, value in found.items():
        print(f"{name}: {value}")
    if given.out is not None:
        given.out.write_bytes(as_json(found))


if __name__ == "__main__":
    main()
