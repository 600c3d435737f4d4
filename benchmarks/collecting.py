"""Measure collections: episodes in rows beside episodes one after another.

``python -m benchmarks.collecting [--episodes N] [--out FILE]`` writes how many episodes of
``collect`` take a second of CPU time, in files, and the ratio of both ways, each the fastest of
several turns in alternation; and how long an episode takes in the engine, and beside it.
"""

from __future__ import annotations

import argparse
import platform
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import scm_world as sw
from benchmarks import as_json
from benchmarks.rows import engine_time, spent
from scm_world.discovery.data import Design, collect, default_causes
from scm_world.queries import twins
from scm_world.queries.experiments.versions import versions

TURNS = 3
SYSTEMS: dict[str, Callable[[], Any]] = {
    "pushing, fake": lambda: sw.World("pushing", backend="fake"),
    "pushing, mujoco": lambda: sw.World("pushing"),
    "er2:20, equations": lambda: sw.World("er2:20"),
}


def measured(system: Any, n: int) -> dict[str, float]:
    """Measure collections of ``n`` episodes with single targets."""
    is_world = system.backend is not None
    targets = default_causes(system) if is_world else tuple(system.model)
    design = Design("single", targets, "A" if is_world else 1.0)
    how: Any = {"steps": 25} if is_world else {}

    def collected() -> None:
        with tempfile.TemporaryDirectory() as folder:
            collect(system, design, n, out=Path(folder) / "data", workers=1, **how)

    def one_by_one() -> None:
        with (
            mock.patch.object(twins, "LEAST", 10**9),  # no batch is worth it
            mock.patch.object(twins.Twins, "_solved_together", return_value=None),
        ):
            collected()

    collected()
    ways = {"in rows": collected, "one after another": one_by_one}
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(TURNS):
        for name, call in ways.items():
            times[name].append(spent(call))
    best = {name: min(values) for name, values in times.items()}
    found = {f"{name} [episodes/CPU s]": 1e3 * n / value for name, value in best.items()}
    found["ratio"] = best["one after another"] / best["in rows"]
    if is_world:
        engine = engine_time(twins.twins_of(system)._rows, collected) / n
        found |= {"engine [ms]": engine, "beside it [ms]": best["in rows"] / n - engine}
    return found


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("collecting.json"))
    given = parser.parse_args()
    results = {}
    for title, opened in SYSTEMS.items():
        results[title] = measured(opened(), given.episodes)
        print(title + "".join(f"   {k} {v:,.2f}" for k, v in results[title].items()), flush=True)
    about = {"machine": platform.machine(), "episodes": given.episodes, **versions("mujoco")}
    given.out.write_text(as_json({"about": about, "results": results}, 2) + "\n")
    print(f"\nwritten to {given.out}")


if __name__ == "__main__":
    main()
