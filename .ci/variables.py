"""Print ``docs/variables.md``: ``python .ci/variables.py > docs/variables.md``."""

from __future__ import annotations

import re
import sys

import numpy as np

from scm_world.queries import World
from scm_world.tasks import TASKS
from scm_world.variables import Derived, Exogenous, Fixed, Measured, Variable, names

HEADINGS = ("variable", "unit", "shape", "role", "default", "possible", "A", "B", "follows", "")
DO = {
    "parameter": "holds until the reset",
    "state": "is set at this instant; physics carries it on",
    "readout": "is not possible; intervene on a cause",
    "action": "takes the place of the policy's command until the reset",
}
"""What ``do`` means for each role."""


def variables_page() -> str:
    """Return the tables of all tasks as Markdown: the text of ``docs/variables.md``."""
    lines = [
        "# Variables",
        "",
        "Every variable of every task, as it is declared; written by `.ci/variables.py`. "
        "The tables show the structure that each task begins with; `F` stands for a "
        "finger (60, 120, 300) and `N` for a number. *Possible* is what physics allows; A is the "
        "training space and B the held-out one. *Follows* lists the causes: one control step "
        "earlier for states, at lag 0 for everything else; `(set)` marks a cause that acts when "
        "something is set, and *contacts* stands for every physical quantity of the world.",
        "",
        "What `do` means depends on the role:",
        "",
        *(f"* **{role}**: {meaning}." for role, meaning in DO.items()),
        "",
    ]
    found: dict[str, list[tuple[str, ...]]] = {}
    for name in TASKS:
        with World(name, backend="fake") as world:
            found[name] = list(dict.fromkeys(map(_row, world.model.variables)))
    common = [row for row in next(iter(found.values())) if all(row in f for f in found.values())]
    sections = {"every task": common}
    sections |= {name: [row for row in rows if row not in common] for name, rows in found.items()}
    for title, rows in sections.items():
        lines += [f"## {title}", "", "| " + " | ".join(HEADINGS) + " |"]
        lines += ["|" + "---|" * len(HEADINGS)]
        lines += ["| " + " | ".join((f"`{name}`", *cells)) + " |" for name, *cells in rows]
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


def _row(variable: Variable) -> tuple[str, ...]:
    """Describe a variable; those that differ in the numbers of their names only are alike."""
    default, causes = "", list[str]()
    match variable:
        case Exogenous(default=value) | Fixed(value=value):
            default = _numbers(value)
        case Measured(default=value, start=None) if value is not None:
            default = _numbers(value)
    if isinstance(variable, Measured) and variable.mechanism is None:
        chosen = [p for p in variable.parents if p.when != "contact"]
        causes = [f"{p.name}{' (set)' if p.when == 'set' else ''}" for p in chosen] + ["contacts"]
    elif isinstance(variable, Derived | Measured):
        causes = list(names(variable.all_parents))
    causes = list(dict.fromkeys(map(_pattern, causes)))
    spaces = (variable.bounds, variable.a, variable.b)
    cells = (
        variable.name,
        "" if variable.unit == "1" else variable.unit,
        "×".join(map(str, variable.shape)),
        "constant" if isinstance(variable, Fixed) else variable.role,
        default,
        *("" if space is None else space.describe() for space in spaces),
        ", ".join(causes[:8]) + (", …" if len(causes) > 8 else ""),
        variable.doc,
    )
    return tuple(map(_pattern, cells))


def _pattern(text: str) -> str:
    text = re.sub(r"(finger_|goal_)(60|120|300)(?=_|\b)", r"\1F", text)
    return re.sub(r"(level|col|row|num|tool|goal|block|obstacle)_\d+", r"\1_N", text)


def _numbers(value: object) -> str:
    flat = [f"{x:.6g}" for x in np.ravel(np.asarray(value, dtype=float))]
    if len(flat) > 1 and len(set(flat)) == 1:
        return f"{flat[0]} each"
    return ", ".join(flat) if len(flat) <= 12 else f"{len(flat)} numbers"


if __name__ == "__main__":
    sys.stdout.write(variables_page())
