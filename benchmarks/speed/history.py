"""Figures over releases: ``benchmarks/history.jsonl`` has a line for each release and machine."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from benchmarks.speed.goals import GOALS
from benchmarks.speed.tables import machine, put
from scm_world.runs.canvas import MARKERS, PALETTE, blank, save, styled
from scm_world.runs.files import write_whole

Row = dict[str, Any]
BUSY = 0.25
"""The largest load of a core before a run that is recorded."""


def read(path: Path) -> list[Row]:
    """Read the lines, oldest first; none if there is no file."""
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    return [json.loads(line) for line in text.splitlines()]


def record(about: Row, results: Mapping[str, Any], *, quick: bool, path: Path) -> list[Row]:
    """Add the figures of all goals; a line of the same release and machine is replaced.

    Args:
        about: The machine and versions, as in ``results.json``.
        results: What was measured in one run.
        quick: Whether the figures are rough.
        path: The file.
    """
    found = {goal.title: goal.measured(results) for goal in GOALS}
    asked = ("git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty")
    row = {
        "version": about["versions"]["scm-world"],
        "commit": subprocess.run(asked, check=True, capture_output=True, text=True).stdout.strip(),  # noqa: S603 # our own words
        "machine": machine(about),
        "date": datetime.now(UTC).date().isoformat(),
        "quick": quick,
        "figures": {name: round(value, 4) for name, value in found.items() if value is not None},
    }
    same = ("version", "machine")
    rows = [old for old in read(path) if any(old[key] != row[key] for key in same)] + [row]
    lines = "".join(json.dumps(one, ensure_ascii=False) + "\n" for one in rows)
    write_whole(path, lines.encode())
    return rows


@styled
def draw(rows: list[Row], path: Path) -> None:
    """Draw each figure over versions, one curve for each machine; the goal is dashed."""
    versions = list(dict.fromkeys(row["version"] for row in rows))
    machines = list(dict.fromkeys(row["machine"] for row in rows))
    shown = [goal for goal in GOALS if any(goal.title in row["figures"] for row in rows)]
    height = -(-len(shown) // 3)
    figure = blank(16, 2.2 * height + 1, layout="constrained")
    axes = figure.subplots(height, 3, squeeze=False)
    for axis in axes.flat[len(shown) :]:
        axis.set_visible(False)
    for goal, axis in zip(shown, axes.flat, strict=False):
        for name, color, marker in zip(machines, PALETTE * 9, MARKERS * 9, strict=False):
            mine = [r for r in rows if r["machine"] == name and goal.title in r["figures"]]
            x = [versions.index(row["version"]) for row in mine]
            axis.plot(x, [r["figures"][goal.title] for r in mine], marker=marker, color=color)
        axis.axhline(goal.least if goal.most is None else goal.most, linestyle="--", color="gray")
        axis.set_title(goal.title.replace("`", ""), loc="left", fontsize=8)
        axis.set_xticks(range(len(versions)), versions)
    figure.legend(axes[0, 0].lines[: len(machines)], machines, loc="outside lower left")
    save(figure, path)


def publish(rows: list[Row], page: Path, picture: Path) -> None:
    """Draw the picture, and show it on the page."""
    draw(rows, picture)
    count = f"{len(rows)} run{'s' * (len(rows) != 1)}"
    about = f"Figures of {count} over releases, one curve a machine; goals are dashed."
    put(f"![{about}](../images/{picture.name})\n\n{about}", page, "history")
