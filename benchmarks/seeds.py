"""Discover every task on every engine and preset with several seeds, and print one row for each.

``python benchmarks/seeds.py [N]`` takes a few minutes.
"""

from __future__ import annotations

import sys

from scm_world import discover
from scm_world.tasks import TASKS


def main(seeds: int = 5) -> None:
    """Print a table in Markdown."""
    columns = [
        "task",
        "engine",
        "preset",
        "seed",
        "edges",
        "SHD",
        "recall",
        "undeclared",
        "floor",
        "rollouts",
    ]
    print(f"| {' | '.join(columns)} |")
    print("|---" * len(columns) + "|")
    for task in TASKS:
        for backend in ("mujoco", "bullet"):
            for preset in ("fast", "precise"):
                for seed in range(seeds):
                    r = discover(task, backend=backend, preset=preset, seed=seed)
                    s = r.score
                    print(
                        f"| {task} | {backend} | {preset} | {seed} | {len(r.declared)} | {s.shd} "
                        f"| {s.recall:.4f} | {len(s.undeclared)} | {r.floor:g} | {r.rollouts} |",
                        flush=True,
                    )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
