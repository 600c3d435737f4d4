"""What ``scm-world do`` prints and writes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.text import Text

from scm_world._types import Value
from scm_world.cli.console import keep_whole, plain, show, staged, table, written
from scm_world.cli.intervene import Outcome, Row
from scm_world.cli.tasks import tag
from scm_world.models import Model
from scm_world.output.locations import Location
from scm_world.queries.experiments.versions import versions
from scm_world.variables import Draw, Hard, Scale, Shift

if TYPE_CHECKING:
    from rich.console import Console

FORMAT = "scm_world/do/1"
SAME = "="
PICTURES = ("before.png", "after.png", "scene.png")
DIVIDER = 4  # [pixels] between two pictures


def save(outcome: Outcome, folder: Location) -> None:
    """Write result.json and the pictures, all of them or none."""
    from scm_world.backends.renderer import write_png

    with staged(folder) as draft:
        shown = _pictures(outcome)
        if shown:
            white = np.full((shown[0].shape[0], DIVIDER, 3), 255, dtype=np.uint8)
            both = np.concatenate([shown[0], white, shown[1]], axis=1)
            for name, picture in zip(PICTURES, (*shown, both), strict=True):
                write_png(draft / name, picture)
        text = json.dumps(as_dict(outcome), indent=1, allow_nan=False)
        (draft / "result.json").write_text(text + "\n")


def _pictures(outcome: Outcome) -> list[Any]:
    """Draw the scenes before and after; a step function has nothing to draw."""
    from scm_world.backends.renderer import automatic_camera, picture
    from scm_world.backends.step import StepModel

    scenes = outcome.before, outcome.after
    if isinstance(outcome.before.structure, StepModel):
        return []
    foreign = isinstance(outcome.before.structure, Model)
    camera = automatic_camera(*scenes) if foreign else None
    return [picture(scene, camera, samples=2) for scene in scenes]


def as_dict(outcome: Outcome) -> dict[str, Any]:
    """Write a result as plain data."""
    audit = outcome.audit
    targets = {
        name: {
            "requested": _data(entry.requested),
            "applied": entry.applied,
            "read_back": entry.read_back,
        }
        for name, entry in audit.targets.items()
    }
    found: dict[str, Any] = plain(
        {
            "format": FORMAT,
            **asdict(outcome.options),
            "audit": targets,
            "followed": _changes(audit.followed),
            "engine": _changes(audit.engine),
            "came": list(audit.came),
            "went": list(audit.went),
            "variables": {row.name: _row(row) for row in outcome.rows},
            "moved_without_a_path": list(outcome.astray),
            "versions": versions(outcome.engine),
        }
    )
    return found


def _row(row: Row) -> dict[str, Any]:
    return {
        "unit": row.unit,
        "descendant": row.follows,
        "moved": row.moved,
        "before": row.before,
        "at_once": row.at_once,
        "after": row.after,
        "without": row.alone,
        "difference": row.difference,
    }


def _changes(changes: Mapping[str, tuple[Value, Value]]) -> dict[str, Any]:
    return {name: {"before": old, "after": new} for name, (old, new) in changes.items()}


def _data(request: Any) -> Any:
    if isinstance(request, Hard | Shift | Scale | Draw):
        return request.model_dump(mode="json")
    return request


def report(terminal: Console, outcome: Outcome, folder: Location, *, show_all: bool) -> None:
    """Print the audit, what moved, and where the files are."""
    _print_audit(terminal, outcome)
    _print_rows(terminal, outcome, show_all=show_all)
    if outcome.astray:
        names = ", ".join(outcome.astray)
        line = f"MOVED WITHOUT A DECLARED PATH FROM A TARGET: {names}. The graph is wrong."
        terminal.print(Text(line, style="bold white on red"))
    there = [name for name in PICTURES if (folder / name).exists()]
    written(terminal, *(folder / name for name in (*there, "result.json")))


def _print_audit(terminal: Console, outcome: Outcome) -> None:
    options = outcome.options
    title = f"do() in {tag(options.task)} on {outcome.engine}, seed {options.seed}"
    made = table("target", "requested", "applied", "engine reports", title=title)
    for name, entry in outcome.audit.targets.items():
        back = "-" if entry.read_back is None else show(entry.read_back)
        held = "at every step" if entry.applied is None else show(entry.applied)
        made.add_row(Text(name, style="bold"), _words(entry.requested), held, back)
    terminal.print(made)
    for label, changes in (
        ("followed at once", outcome.audit.followed),
        ("engine, inertia [kg m²]", outcome.audit.engine),
    ):
        for name, (old, new) in changes.items():
            values = (show(value, per_line=9) for value in (old, new))
            terminal.print(Text.assemble((f"{label}: ", "bold"), name, " ", " -> ".join(values)))
    for label, names in (("new", outcome.audit.came), ("gone", outcome.audit.went)):
        if names:
            terminal.print(Text.assemble((f"{label}: ", "bold"), ", ".join(names)))
    terminal.print()


def _words(request: Any) -> str:
    match request:
        case Shift() | Scale():
            return f"{request.kind} by {show(request.by)}"
        case Draw():
            return f"draw from {request.source}"
        case Hard():
            return show(request.value)
    return show(request)


def _print_rows(terminal: Console, outcome: Outcome, *, show_all: bool) -> None:
    """Write one row per descendant that moved, or per descendant."""
    steps = outcome.options.steps
    end = f"after {steps} steps"
    headers = ("descendant", "unit", "before", "right after", end, "without the do()")
    follow = [row for row in outcome.rows if row.follows]
    made = table(*headers, "difference", title="What followed")
    for row in follow:
        if row.moved or show_all:
            made.add_row(*_cells(row))
    terminal.print(keep_whole(made, terminal, 0, 6))
    still = sum(not row.moved for row in follow)
    others = len(outcome.rows) - len(follow)
    lines = [f"{still} of {len(follow)} descendants did not move{_hint(still, show_all)}"]
    if not outcome.astray:
        lines.append(f"none of the {others} other variables moved")
    terminal.print(Text("; ".join(lines) + "."))


def _hint(still: int, show_all: bool) -> str:
    return " (--all shows them)" if still and not show_all else ""


def _cells(row: Row) -> list[Text]:
    at_once = SAME if np.array_equal(row.at_once, row.before) else show(row.at_once)
    alone = SAME if np.array_equal(row.alone, row.after) else show(row.alone)
    style = "bold" if row.difference > 0.0 else "dim"
    cells = [Text(show(row.before)), Text(at_once), Text(show(row.after)), Text(alone)]
    return [Text(row.name), Text(row.unit), *cells, Text(f"{row.difference:.3g}", style=style)]
