"""``scm-world variables``: every variable of a task as a table, on screen or as Markdown."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
import typer
from rich.text import Text

from scm_world.cli.console import console, table
from scm_world.cli.tasks import build
from scm_world.tasks import TASKS
from scm_world.variables import (
    Affine,
    Box,
    Categories,
    Derived,
    Either,
    Exogenous,
    Fixed,
    Integers,
    Measured,
    Rotations,
    Space,
    Switch,
    Variable,
    names,
)
from scm_world.world import World

HEADINGS = ("variable", "unit", "shape", "role", "default", "possible", "A", "B", "follows", "")

DO = {
    "parameter": "holds until the reset",
    "state": "is set at this instant; physics carries it on",
    "readout": "is not possible; intervene on a cause",
    "action": "takes the place of the policy's command until the reset",
}
"""What ``do`` means for each role."""


@final
@dataclass(frozen=True)
class Row:
    """One line of the table: a variable, or several that are declared alike."""

    name: str
    cells: tuple[str, ...]


def rows(variables: Iterable[Variable]) -> list[Row]:
    """Describe variables; those that differ in their numbers only share a line."""
    found: dict[Row, None] = {}
    for variable in variables:
        found[Row(_pattern(variable.name), tuple(map(_pattern, _cells(variable))))] = None
    return list(found)


def _pattern(text: str) -> str:
    text = re.sub(r"(finger_|goal_)(60|120|300)\b", r"\1F", text)
    text = re.sub(r"finger_(60|120|300)_", "finger_F_", text)
    return re.sub(r"(level|col|row|num|tool|goal|block|obstacle)_\d+", r"\1_N", text)


def _cells(variable: Variable) -> tuple[str, ...]:
    return (
        "" if variable.unit == "1" else variable.unit,
        "×".join(map(str, variable.shape)),
        "constant" if isinstance(variable, Fixed) else variable.role,
        _default(variable),
        _space(variable.bounds),
        _space(variable.a),
        _space(variable.b),
        _follows(variable),
        variable.doc,
    )


def _default(variable: Variable) -> str:
    match variable:
        case Exogenous(default=value) | Fixed(value=value):
            return _numbers(value)
        case Measured(default=value, start=None) if value is not None:
            return _numbers(value)
    return ""


def _follows(variable: Variable) -> str:
    if not isinstance(variable, Derived | Measured):
        return ""
    if isinstance(variable, Measured) and variable.mechanism is None:
        chosen = [p for p in variable.parents if p.when != "contact"]
        own = [f"{p.name}{' (set)' if p.when == 'set' else ''}" for p in chosen]
        return _shortened([*own, "contacts"])
    return _shortened(list(names(variable.all_parents)))


def _shortened(causes: list[str]) -> str:
    alike = list(dict.fromkeys(map(_pattern, causes)))
    return ", ".join(alike[:8]) + (", …" if len(alike) > 8 else "")


def _numbers(value: object) -> str:
    flat = [f"{x:.6g}" for x in np.ravel(np.asarray(value, dtype=float))]
    if len(flat) > 1 and len(set(flat)) == 1:
        return f"{flat[0]} each"
    if len(flat) > 12:
        return f"{len(flat)} numbers"
    return ", ".join(flat)


def _space(space: Space | None) -> str:
    match space:
        case None:
            return ""
        case Box(low=low, high=high):
            return f"[{_bound(low)}] … [{_bound(high)}]"
        case Integers(low=low, high=high):
            return f"{low} … {high}, whole"
        case Categories(members=members):
            return ", ".join(map(str, members))
        case Rotations():
            return "unit quaternions"
        case Either(first=first, second=second):
            return f"{_space(first)} or {_space(second)}"


def _bound(bound: object) -> str:
    if not isinstance(bound, tuple):
        return _part(bound)
    parts = [_part(part) for part in bound]
    if len(parts) > 3 and parts == parts[:3] * (len(parts) // 3):
        parts = [*parts[:3], "…"]
    return ", ".join(parts)


def _part(part: object) -> str:
    match part:
        case Affine(parent=parent, index=index, scale=scale, offset=offset):
            place = "" if index is None else f"[{index}]"
            factor = "" if scale == 1.0 else f"{scale:g} "
            return f"{factor}{parent}{place}" + (f" + {offset:g}" if offset else "")
        case Switch(parent=parent, below=below, above=above, at=at):
            return f"{below:.4g} if {parent} < {at:g} else {above:.4g}"
    return f"{part:.6g}"


def sections(
    tasks: Iterable[str], arguments: Sequence[str] = ()
) -> Iterator[tuple[str, list[Row]]]:
    """Describe what all tasks have in common, then what each has besides."""
    models = {}
    for name in tasks:
        world = World(build(name, arguments), backend="fake")
        models[name] = rows(world.model.variables)
        world.close()
    common = [row for row in next(iter(models.values())) if all(row in m for m in models.values())]
    if len(models) > 1:
        yield "every task", common
    for name, found in models.items():
        yield name, [row for row in found if len(models) == 1 or row not in common]


def markdown() -> str:
    """Write the tables of all tasks down: the text of ``docs/variables.md``."""
    lines = [
        "# Variables",
        "",
        "Every variable of every task, as it is declared; written by `scm-world variables all "
        "--markdown`. The tables show the structure that each task begins with; `F` stands for a "
        "finger (60, 120, 300) and `N` for a number. *Possible* is what physics allows; A is the "
        "training space and B the held-out one. *Follows* lists the causes: one control step "
        "earlier for states, at once for everything else; `(set)` marks a cause that acts when "
        "something is set, and *contacts* stands for every physical quantity of the world.",
        "",
        "What `do` means depends on the role:",
        "",
        *(f"* **{role}**: {meaning}." for role, meaning in DO.items()),
        "",
    ]
    for title, found in sections(TASKS):
        lines += [f"## {title}", "", "| " + " | ".join(HEADINGS) + " |"]
        lines += ["|" + "---|" * len(HEADINGS)]
        lines += ["| " + " | ".join((f"`{row.name}`", *row.cells)) + " |" for row in found]
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


def run(task: str, arguments: Sequence[str] = (), *, as_markdown: bool) -> None:
    """Print the tables."""
    if as_markdown:
        typer.echo(markdown(), nl=False)
        return
    for title, found in sections(TASKS if task == "all" else (task,), arguments):
        made = table(*HEADINGS[:5], "A", "B", title=title)
        for row in found:
            unit, shape, role, default, _, a, b, _, _ = row.cells
            made.add_row(Text(row.name), unit, shape, role, default, a, b)
        console().print(made)
