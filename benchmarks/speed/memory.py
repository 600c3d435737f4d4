"""What stays in memory: of worlds, of batches, and of many resets; and how long imports take."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.speed.batches import vector
from benchmarks.speed.scenes import ENGINES, GENERAL, PUSHING, Case, actions
from benchmarks.speed.subprocesses import ROOT, answer, asked
from benchmarks.speed.timing import Settings

MEGA, KILO = 1e6, 1e3  # bytes
WORLDS = (1, 16, 64)
RESETS, LOOKS = 10_000, 20  # how many of them, and how often the memory is read
STARTS = 7
MODULES = ("scm_world", "scm_world.env", "scm_world.graph")


def resident() -> float:
    """Give the memory of this process that is in use [bytes]."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return float(pages * os.sysconf("SC_PAGE_SIZE"))


def remembering(settings: Settings) -> dict[str, Any]:
    """Measure memory, every figure in a fresh process."""
    worlds = WORLDS[:2] if settings.quick else WORLDS
    resets = 500 if settings.quick else RESETS
    return {
        engine: {
            **{
                f"{case.name}: worlds [MB]": _per_world("worlds", case, engine, worlds)
                for case in ((PUSHING,) if settings.quick else (PUSHING, GENERAL))
            },
            **_beside(engine, worlds),
            "resets": asked("memory", "resets", PUSHING.name, engine, resets),
        }
        for engine in ENGINES
    }


def _beside(engine: str, worlds: tuple[int, ...]) -> dict[str, Any]:
    """Measure a batch in one process; and what pybullet takes for an empty world, on Bullet."""
    if engine == "mujoco":
        found = _per_world("batch", PUSHING, engine, worlds)
        return {f"{PUSHING.name}: a batch [MB]": found}
    empty = asked("memory", "clients", PUSHING.name, engine, worlds[1])
    return {"an empty client of pybullet [MB]": {"each": empty / MEGA}}


def _per_world(what: str, case: Case, engine: str, worlds: tuple[int, ...]) -> dict[str, float]:
    """Compare processes that hold different numbers of worlds."""
    found = {n: asked("memory", what, case.name, engine, n) for n in worlds}
    first = found[1]
    each = {n: (size - first) / (n - 1) for n, size in found.items() if n > 1}
    return {
        **{f"{n}, in all": size / MEGA for n, size in found.items()},
        **{f"{n}, each beyond the first": size / MEGA for n, size in each.items()},
    }


def worlds(case: Case, engine: str, number: int) -> float:
    """Hold some environments that have been used, and give the memory [bytes]."""
    envs = [case.env(engine) for _ in range(number)]
    for env in envs:
        for action in actions(5):
            env.step(action)
    return resident()


def batch(case: Case, engine: str, number: int) -> float:
    """Hold a vector environment that has been used, and give the memory [bytes]."""
    envs = vector(case, number, backend=engine, threads=1)
    for action in actions(5, number):
        envs.step(action)
    return resident()


def clients(case: Case, engine: str, number: int) -> float:
    """Connect to empty worlds of pybullet, and give the memory of each [bytes]."""
    import pybullet

    before = resident()
    for _ in range(number):
        pybullet.connect(pybullet.DIRECT)
    return (resident() - before) / number


def resets(case: Case, engine: str, number: int) -> dict[str, float]:
    """Reset very often with a step between, and fit a line to the memory.

    The first tenth does not count: allocators and caches fill.
    """
    env, action = case.env(engine), actions(1)[0]
    every, sizes, counts = max(1, number // LOOKS), list[float](), list[float]()
    for count in range(number):
        env.reset()  # the next episode
        env.step(action)
        if count >= number // 10 and count % every == 0:
            sizes.append(resident())
            counts.append(count)
    slope = float(np.polyfit(counts, sizes, 1)[0])
    return {
        "resets": number,
        "grown [kB]": (sizes[-1] - sizes[0]) / KILO,
        "slope [bytes/reset]": slope,
    }


def importing(settings: Settings) -> dict[str, float]:
    """Start Python and import, beside starting it alone, in turns; the best of several [s]."""
    programs = {"python": "pass", **{name: f"import {name}" for name in MODULES}}
    rows: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(settings.rounds(STARTS)):
        for name, program in programs.items():
            started = time.perf_counter()
            subprocess.run([sys.executable, "-c", program], check=True, cwd=ROOT)  # noqa: S603 # our own text
            rows[name].append(time.perf_counter() - started)
    best = {name: min(row) for name, row in rows.items()}
    return {f"{name} [s]": best[name] - best["python"] for name in MODULES}


def main() -> None:
    """Measure one thing, and print it."""
    what, name, engine, number = sys.argv[1:]
    case = next(case for case in (PUSHING, GENERAL) if case.name == name)
    measure: Any = {"worlds": worlds, "batch": batch, "clients": clients, "resets": resets}[what]
    answer(measure(case, engine, int(number)))


if __name__ == "__main__":
    main()
