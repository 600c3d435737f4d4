"""What shards cost: overhead, efficiency, and whether workers may be killed while they work.

Three measurements, each on every engine of work:

- overhead: shards that do nothing. Goal: 5 ms each with processes, 10 ms with Ray.
- efficiency: shards that take one second each, waiting, so that it does not matter who else uses
  the machine: the share of the time of the workers that was spent in shards.
- killed: so many interventional episodes of a step function, in shards, on a Ray cluster of two
  nodes on this machine, each with one worker, of which one is killed (SIGKILL) again and again, at
  random; every file must be the one of a run in this process.

    python benchmarks/shards.py --episodes 100000
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import signal
import statistics
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import scm_world as sw
from scm_world.discovery.data import Design, collect
from scm_world.runs.pool import Pool
from scm_world.variables import Normal

TARGETS = ("leak", "inlet")


# --- shards that measure --------------------------------------------------------------------------


def nothing(job: int) -> int:
    """Do a shard that costs nothing by itself."""
    return job


def second(job: int) -> int:
    """Take a second."""
    time.sleep(1.0)
    return job


def overhead(pool: Pool, shards: int) -> dict[str, float]:
    """Measure shards that do nothing, once the first results are there."""
    times = [time.perf_counter() for _ in pool.run(nothing, range(shards))]
    times = times[min(pool.workers, shards - 2) :]
    gaps = [after - before for before, after in pairwise(times)]
    return {
        "ms per shard": 1e3 * statistics.mean(gaps),
        "median ms between results": 1e3 * statistics.median(gaps),
    }


def efficiency(pool: Pool, shards: int) -> dict[str, float]:
    """Measure shards of a second: their seconds over those of the workers."""
    for count, _ in enumerate(pool.run(second, range(shards + pool.workers)), 1):
        if count == pool.workers:  # all of them have begun
            begun = time.perf_counter()
    seconds = time.perf_counter() - begun
    return {"seconds": seconds, "efficiency": shards / (pool.workers * seconds)}


# --- killed ---------------------------------------------------------------------------------------


def workers_of_ray() -> list[int]:
    """List the processes of Ray that are at work for this one."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            name = (entry / "cmdline").read_bytes().split(b"\0")[0]
        except OSError:
            continue
        if name.startswith(b"ray::_answered"):
            found.append(int(entry.name))
    return found


@contextmanager
def killing(every: float, seed: int) -> Iterator[list[int]]:
    """Kill a worker again and again; the list says which."""
    killed: list[int] = []
    rng, stop = random.Random(seed), threading.Event()  # noqa: S311 # nothing secret

    def kill() -> None:
        while not stop.wait(every * rng.uniform(0.5, 1.5)):
            there = workers_of_ray()
            if there:
                pid = rng.choice(there)
                os.kill(pid, signal.SIGKILL)
                killed.append(pid)

    thread = threading.Thread(target=kill)
    thread.start()
    try:
        yield killed
    finally:
        stop.set()
        thread.join()


def digest(folder: Path) -> tuple[str, int]:
    """Sum up all files of a folder, and count them."""
    total, files = hashlib.sha256(), sorted(folder.iterdir())
    for path in files:
        total.update(path.name.encode() + b"\0" + path.read_bytes())
    return total.hexdigest(), len(files)


def tank(parameters: Any, state: Any, action: Any, noise: Any) -> Any:
    """Return the level of a tank [m] 0.1 s later."""
    flow = parameters["inlet"] * action["inflow"] - parameters["leak"] * state["level"]
    return {"level": state["level"] + 0.1 * flow + noise["level"]}


def collected(out: Path, episodes: int, shard: int, engine: Pool | None) -> Any:
    """Collect interventional episodes of a tank, of five control steps each."""
    design = Design("half", TARGETS, observational_fraction=0.3)
    spaces = {"leak": sw.Box(0.0, 2.0), "inlet": sw.Box(0.5, 1.5)}
    world = sw.World(
        tank,
        parameters=[sw.Exogenous(name=n, default=1.0, bounds=a, a=a) for n, a in spaces.items()],
        states=[sw.Measured(name="level", unit="m", default=1.0)],
        actions=[sw.Action(name="inflow", unit="m/s", bounds=sw.Box(0.0, 1.0))],
        control_dt=0.1,
        noise={"level": Normal(0.0, 0.01)},
    )
    return collect(world, design, episodes, out=out, shard=shard, steps=5, seed=7, engine=engine)


def killed(episodes: int, shard: int, every: float) -> dict[str, Any]:
    """Collect on two nodes of Ray while workers are killed, and here; compare the files."""
    from ray.cluster_utils import Cluster

    os.environ["RAY_worker_niceness"] = "0"  # noqa: SIM112 # or others on the machine go first
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    cluster.add_node(num_cpus=1)
    with tempfile.TemporaryDirectory() as folder:
        here, there = Path(folder) / "here", Path(folder) / "there"
        with Pool(cluster.address) as ray, killing(every, seed=0) as dead:
            where, begun = ray.where, time.perf_counter()
            table = collected(there, episodes, shard, ray)
            seconds = time.perf_counter() - begun
        begun = time.perf_counter()
        collected(here, episodes, shard, None)
        alone = time.perf_counter() - begun
        sums = digest(here), digest(there)
    cluster.shutdown()
    numbers = table.episode
    return {
        "episodes": episodes,
        "shards": -(-episodes // shard),
        "where": where,
        "workers killed": len(dead),
        "lost": episodes - len(set(numbers.tolist())) - len(table.about.get("refused", {})),
        "twice": len(numbers) - len(set(numbers.tolist())),
        "byte-identical to the run in one process": sums[0] == sums[1],
        "sha256": sums[1][0][:16],
        "episodes per second on Ray": episodes / seconds,
        "episodes per second in one process": episodes / alone,
    }


# --- all ------------------------------------------------------------------------------------------


def main() -> None:
    """Measure, and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=100_000, help="0 to leave this out")
    parser.add_argument("--shard", type=int, default=250, help="episodes in a shard")
    parser.add_argument("--shards", type=int, default=2_000, help="that do nothing; 0: leave out")
    parser.add_argument("--seconds", type=int, default=20, help="shards of a second; 0: leave out")
    parser.add_argument("--workers", type=int, default=2, help="of processes, and of Ray")
    parser.add_argument("--every", type=float, default=60.0, help="seconds between two kills")
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    chosen = parser.parse_args()
    found: dict[str, Any] = {}
    for name in ("serial", "process", "ray"):
        workers = 1 if name == "serial" else chosen.workers
        with Pool(name, workers=workers) as pool:
            print(f"{name}: {pool.where}", flush=True)
            if chosen.shards:
                found[f"{name}, overhead"] = overhead(pool, chosen.shards)
            if chosen.seconds:
                found[f"{name}, efficiency"] = efficiency(pool, chosen.seconds)
    if chosen.episodes:
        found["killed"] = killed(chosen.episodes, chosen.shard, chosen.every)
    text = json.dumps(found, indent=1)
    print(text)
    if chosen.out is not None:
        chosen.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
