"""Measure one intervention in the rows of many worlds, beside one world after another.

``python -m benchmarks.rows [--worlds N] [--out FILE]`` writes CPU times [ms] of equal requests, and
their ratio, each the fastest of several turns in alternation. The time of the engine, which writes
the parameters of each world and reads them back, is measured by itself.
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
    kept = {name: getattr(engine, name) for name in ("apply", "parameters")}

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
    worlds.reset(seed=0)
    still = np.zeros((n, worlds.world(0).compiled.n_actions))
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
                worlds.world(row).do(each[row])

        times: dict[str, list[float]] = {"together": [], "engine": [], "alone": []}
        for _ in range(TURNS):
            for name, call in (("together", together), ("alone", alone)):
                worlds.reset(seed=0)
                worlds.step(still)
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
    return found


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=1024)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("rows.json"))
    given = parser.parse_args()
    results = {f"pushing, {one}": measured(one, given.worlds) for one in ("fake", "mujoco")}
    for title, figures in results.items():
        print(f"\n{title}, {given.worlds:,} worlds")
        for name, values in figures.items():
            print(f"  {name:<22}" + "".join(f"{k} {v:,.2f}   " for k, v in values.items()))
    about = {"machine": platform.machine(), "worlds": given.worlds, **versions()}
    given.out.write_text(as_json({"about": about, "results": results}) + "\n")
    print(f"\nwritten to {given.out}")


if __name__ == "__main__":
    main()
