"""Discover every task on every engine with several seeds: one JSON line for each run.

``python benchmarks/seeds.py --seeds 5`` takes one to four minutes for each task, engine and seed.
What is in the file already is not run again, so that it can be interrupted and taken up;
``--table`` prints the file as Markdown.
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from scm_world import World, discover
from scm_world.tasks import TASKS, make_task

SMALL: dict[str, dict[str, Any]] = {
    "stacked_blocks": {"num_of_levels": 2, "max_level_width": 0.075},
    "creative_stacked_blocks": {"num_of_levels": 3, "max_level_width": 0.04},
}
"""Arguments of tasks whose blocks are many by default: as few as show every edge."""

KEY = ("task", "engine", "preset", "seed", "probes")
COLUMNS = (
    *KEY,
    "declared",
    "shd",
    "recall",
    "undeclared",
    "missed",
    "floor",
    "rollouts",
    "seconds",
)


def run(task: str, engine: str, preset: str, seed: int, probes: int) -> dict[str, Any]:
    """Discover one task once, and give the row of the table."""
    world = World(make_task(task, **SMALL.get(task, {})), backend=engine, preset=preset)
    report = discover(world, probes=probes, seed=seed)
    world.close()
    return {
        **dict(zip(KEY, (task, engine, preset, seed, probes), strict=True)),
        "arguments": SMALL.get(task, {}),
        "declared": len(report.declared),
        "shd": report.score.shd,
        "recall": report.score.recall,
        "undeclared": len(report.score.undeclared),
        "missed": len(report.score.missed),
        "edges": [list(edge) for edge in (*report.score.undeclared, *report.score.missed)],
        "floor": report.floor,
        "inert": report.inert,
        "weakest": min((e.size for e in report.edges if e.status != "unseen"), default=0.0),
        "rollouts": report.rollouts,
        "seconds": round(report.seconds, 1),
        "versions": report.versions,
    }


def rows(path: Path) -> list[dict[str, Any]]:
    """Read what is in a file; a last line that was cut off is left out."""
    lines = path.read_text().splitlines() if path.exists() else []
    return [json.loads(line) for line in lines if line.endswith("}}")]


def markdown(found: list[dict[str, Any]]) -> Iterator[str]:
    """Write rows as a table."""
    yield f"| {' | '.join(COLUMNS)} |"
    yield "|---" * len(COLUMNS) + "|"
    for row in found:
        yield f"| {' | '.join(_cell(row[column]) for column in COLUMNS)} |"


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def main() -> None:
    """Run what is asked for and not yet there."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--probes", type=int, default=40)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--engines", nargs="+", default=["mujoco", "bullet"])
    parser.add_argument("--presets", nargs="+", default=["fast"])
    parser.add_argument("--file", type=Path, default=Path("seeds.jsonl"))
    parser.add_argument("--table", action="store_true", help="print the file, run nothing")
    asked = parser.parse_args()
    if not asked.table:
        done = {tuple(row[name] for name in KEY) for row in rows(asked.file)}
        every = itertools.product(asked.tasks, asked.engines, asked.presets, range(asked.seeds))
        for key in every:
            if (*key, asked.probes) not in done:
                row = run(*key, asked.probes)
                with asked.file.open("a") as file:
                    file.write(json.dumps(row) + "\n")
                print(*(f"{name} {_cell(row[name])}" for name in COLUMNS), flush=True)
    print("\n".join(markdown(rows(asked.file))))


if __name__ == "__main__":
    main()
