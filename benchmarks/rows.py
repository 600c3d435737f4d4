"""Measure many worlds in rows: opening, resets, and one intervention beside single worlds.

``python -m benchmarks.rows [--worlds N] [--many N] [--out FILE]`` writes CPU times [ms]: of equal
requests in rows and in one world after another, and their ratio, each the fastest of several turns
in alternation; and of what a great many worlds without physics cost. The time of the engine, which
writes the parameters of each world and reads them back, is measured by itself.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import scm_world as sw
from benchmarks import as_json
from scm_world.queries.experiments.versions import versions

TURNS = 7
REQUESTS: dict[str, Callable[[int], dict[str, Any]]] = {
    "one value": lambda n: {"tool_block.mass": 0.05},
    "a value for each": lambda n: {"tool_block.mass": np.linspace(0.02, 0.09, n)},
    "a draw": lambda n: {"tool_block.mass": sw.Draw("A")},
    "a draw of a factor": lambda n: {"tool_block.mass": sw.Scale(sw.Draw(0.8, 1.2))},
}


def spent(call: Callable[[], Any]) -> float:
    """Return the CPU time of one call [ms]."""
    started = time.process_time()
    call()
    return 1e3 * (time.process_time() - started)


def engine_time(worlds: Any, call: Callable[[], Any]) -> float:
    """Return the CPU time that a call spends in the engine [ms]."""
    engine, total = worlds._engine, 0.0
    calls = ("build", "restore", "snapshot", "read", "apply", "parameters", "step")
    kept = {name: getattr(engine, name) for name in calls}

    def timed(name: str) -> Callable[..., Any]:
        def inner(*args: Any) -> Any:
            nonlocal total
            started = time.process_time()
            try:
                return kept[name](*args)
            finally:
                total += 1e3 * (time.process_time() - started)

        return inner

    for name in kept:
        setattr(engine, name, timed(name))
    call()
    for name in kept:
        delattr(engine, name)
    return total


def measured(backend: str, n: int) -> dict[str, dict[str, float]]:
    """Measure each request in ``n`` worlds of pushing."""
    worlds: Any = sw.World("pushing", backend=backend, num_worlds=n)
    singles: Any = sw.World("pushing", backend=backend, num_worlds=n)  # used one after another
    for both in (worlds, singles):
        both.reset(seed=0)
    still = np.zeros((n, worlds.compiled.n_actions))
    found = {}
    for title, request in REQUESTS.items():
        asked = request(n)
        each = [
            {name: act[row] if isinstance(act, np.ndarray) else act for name, act in asked.items()}
            for row in range(n)
        ]

        def together(asked: Any = asked) -> None:
            worlds.do(asked)

        def alone(each: Any = each) -> None:
            for row in range(n):
                singles.world(row).do(each[row])

        times: dict[str, list[float]] = {"together": [], "engine": [], "alone": []}
        for _ in range(TURNS):
            for name, call in (("together", together), ("alone", alone)):
                for both in (worlds, singles):
                    both.reset(seed=0)
                    both.step(still)
                times[name].append(spent(call))
            worlds.reset(seed=0)
            worlds.step(still)
            times["engine"].append(engine_time(worlds, together))
        best = {name: min(values) for name, values in times.items()}
        found[title] = {
            "together [ms]": best["together"],
            "of it the engine [ms]": best["engine"],
            "one after another [ms]": best["alone"],
            "ratio": best["alone"] / best["together"],
        }
    worlds.close()
    singles.close()
    return found


def of_many(n: int) -> dict[str, dict[str, float]]:
    """Measure what ``n`` worlds of pushing without physics cost in all."""
    worlds: Any = None

    def opened() -> None:
        nonlocal worlds
        worlds = sw.World("pushing", backend="fake", num_worlds=n)

    found = {"opening": {"together [ms]": spent(opened)}}
    model, compiled = worlds.model, worlds.compiled
    free = [name for name in compiled.static_names if not compiled.moves_bodies(name)]
    free = [n for n in free if model.declared(n).a is not None and n not in compiled.bundles]
    every = {name: sw.Draw("A") for name in free if model.declared(name).dtype == "real"}
    still = np.zeros((n, compiled.n_actions))
    calls: dict[str, Callable[[], Any]] = {
        "the first reset": lambda: worlds.reset(seed=0),
        "a reset": lambda: worlds.reset(seed=0),
        "a reset of one in eight": lambda: worlds.reset(where=np.arange(n) % 8 == 0),
        "a step": lambda: worlds.step(still),
        "a draw of one mass": lambda: worlds.do({"tool_block.mass": sw.Draw("A")}),
        f"a reset with draws of {len(every)} parameters": lambda: worlds.reset(seed=0, do=every),
        "all values": worlds.values,
    }
    for title, call in calls.items():
        found[title] = {"together [ms]": spent(call)}
        if title != "the first reset":
            found[title]["of it the engine [ms]"] = engine_time(worlds, call)
    worlds.close()
    return found


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=1024)
    parser.add_argument("--many", type=int, default=16_384)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("rows.json"))
    given = parser.parse_args()
    results = {
        f"pushing, {one}, {given.worlds:,} worlds": measured(one, given.worlds)
        for one in ("fake", "mujoco")
    }
    results[f"pushing, fake, {given.many:,} worlds"] = of_many(given.many)
    for title, figures in results.items():
        print(f"\n{title}")
        for name, values in figures.items():
            print(f"  {name:<40}" + "".join(f"{k} {v:,.2f}   " for k, v in values.items()))
    about = {"machine": platform.machine(), "worlds": given.worlds, **versions()}
    given.out.write_text(as_json({"about": about, "results": results}) + "\n")
    print(f"\nwritten to {given.out}")


if __name__ == "__main__":
    main()
