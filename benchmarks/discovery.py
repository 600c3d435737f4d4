"""Figures of discovery: ``python benchmarks/discovery.py PART``; parts are listed by ``--help``.

Results are written to ``benchmarks/discovery/PART.json``. Times are those of one core: start it
with ``OMP_NUM_THREADS=1 taskset -c 0``.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from scm_world.discovery.data import Dataset, Design, collect
from scm_world.discovery.learners import learn
from scm_world.discovery.learners.moving import paired, sparse_pooled, verified
from scm_world.discovery.learners.simulators import SCMSimulator
from scm_world.discovery.metrics import evaluate
from scm_world.discovery.problems import DONE, random_model
from scm_world.discovery.run import discover
from scm_world.queries.experiments.versions import versions

HERE = Path(__file__).parent / "discovery"


def table(name: str, seed: int, seen: int, each: int) -> tuple[Any, Dataset]:
    """Collect watched rows and some for each variable set to N(2, 1)."""
    scm = random_model(name, seed)
    targets = tuple(scm)
    n = seen + each * len(targets)
    design = Design("single", targets, DONE, seen / n)
    return scm, collect(scm, design, n, seed=seed)


def scored(name: str, learner: str, seeds: range, seen: int, each: int) -> dict[str, Any]:
    """Let a learner find the graphs of some seeds."""
    rows = []
    for seed in seeds:
        scm, data = table(name, seed, seen, each)
        found = learn(learner, data)
        s = evaluate(found, [edge.key for edge in scm.edges])
        rows.append((s.shd, s.false_discoveries, s.recall, s.sid, found.seconds))
    shd, false, recall, sid, seconds = map(list, zip(*rows, strict=True))
    return {
        "model": name,
        "learner": learner,
        "rows": f"{seen} + {each} each",
        "seeds": [seeds.start, seeds.stop - 1],
        "shd": shd,
        "mean_shd": float(np.mean(shd)),
        "exact": shd.count(0),
        "mean_false_discoveries": float(np.mean(false)),
        "mean_recall": float(np.mean(recall)),
        "sid": sid,
        "median_seconds": float(np.median(seconds)),
    }


def protocol() -> Any:
    """do_order on ER-2, with all and a tenth of the rows; and GIES on the first seeds, in turn."""
    found = [
        scored("er2:20", "do_order", range(20), 1000, 500),
        scored("er2:50", "do_order", range(20), 1000, 500),
        scored("er2:20", "do_order", range(20), 100, 50),
        scored("er2:50", "do_order", range(20), 100, 50),
        scored("sf2:20", "do_order", range(20), 1000, 500),
        scored("er2:100", "do_order", range(5), 1000, 500),
    ]
    ours, theirs = [], []
    for seed in range(10):  # one after another, so that both see the same machine
        one = range(seed, seed + 1)
        ours.append(scored("er2:20", "do_order", one, 1000, 500))
        theirs.append(scored("er2:20", "gies", one, 1000, 500))
    return found, [
        {
            "learner": rows[0]["learner"],
            "shd": [row["shd"][0] for row in rows],
            "median_seconds": float(np.median([row["median_seconds"] for row in rows])),
        }
        for rows in (ours, theirs)
    ]


KINDS = ("paired", "pooled", "coloring, one unit", "coloring, one unit, no pair left")


def moving() -> Any:
    """Paired, pooled and color by color: SHD and experiments."""
    found = []
    for name in ("er2:20", "er2:50", "er2:100", "sf2:100", "tanh4:20", "tanh4:50", "tanh4:100"):
        rows = []
        for seed in range(20):
            scm = random_model(name, seed)
            truth = [edge.key for edge in scm.edges]
            kinds = (
                paired(SCMSimulator(scm, seed), budget=1),
                sparse_pooled(SCMSimulator(scm, seed), seed=seed),
                verified(
                    SCMSimulator(scm, seed), declared=truth, seed=seed, units=1, thorough=False
                ),
                verified(SCMSimulator(scm, seed), declared=truth, seed=seed, units=1),
            )
            rows.append([(f.experiments, f.bound, evaluate(f, truth).shd) for f in kinds])
        for number, kind in enumerate(KINDS):
            used, bound, shd = zip(*(row[number] for row in rows), strict=True)
            found.append(
                {
                    "model": name,
                    "learner": kind,
                    "mean_used": float(np.mean(used)),
                    "most_used": max(used),
                    "mean_bound": float(np.mean(bound)),
                    "largest_shd": max(shd),
                }
            )
    return found


def steps() -> Any:
    """One-step graphs of tasks by paired experiments, on both engines."""
    found = []
    for task in ("pushing", "stacking2"):
        for backend in ("mujoco", "bullet"):
            report = discover(task, backend=backend, probes=40)
            found.append(
                {
                    "task": task,
                    "backend": backend,
                    "shd": report.score.shd,
                    "edges": len(report.declared),
                    "rollouts": report.rollouts,
                    "floor": report.floor,
                    "seconds": report.seconds,
                }
            )
    return found


PARTS: dict[str, Callable[[], Any]] = {"protocol": protocol, "moving": moving, "steps": steps}


def main() -> None:
    """Run one part, print it and write it down."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=PARTS)
    part = parser.parse_args().part
    started = time.perf_counter()
    found = {"part": part, "versions": versions(), "results": PARTS[part]()}
    found["seconds"] = time.perf_counter() - started
    text = json.dumps(found, indent=1, default=str)
    HERE.mkdir(exist_ok=True)
    (HERE / f"{part}.json").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
