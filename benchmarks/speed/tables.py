"""The tables of ``docs/benchmarks/speed.md``, between two marks: goals, and the predecessor."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.speed.goals import GOALS, Figures

BEGIN, END = "<!-- speed: begin -->", "<!-- speed: end -->"
TITLES = {"mujoco": "MuJoCo", "bullet": "Bullet"}


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Write a table in markdown; nothing without rows."""
    body = [f"| {' | '.join(row)} |" for row in rows]
    return [f"| {' | '.join(head)} |", "|---" * len(head) + "|", *body, ""] if body else []


def number(value: float) -> str:
    """Write a number with three digits that count."""
    if abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"


def goals(results: Figures) -> list[str]:
    """List every goal, what was measured, and whether it is met."""
    rows = []
    for goal in GOALS:
        value = goal.measured(results)
        if value is None:
            shown, verdict = "not measured", ""
        else:
            shown = f"{value:,.{goal.digits}f}{goal.unit}"
            verdict = "met" if goal.met(value) else "**missed**"
        rows.append((goal.title, goal.bound(), shown, verdict))
    return table(("what", "goal", "measured", ""), rows)


def predecessor(results: Figures) -> list[str]:
    """Compare with the predecessor."""
    found = results.get("predecessor", {})
    rows = [
        (
            name,
            *(number(row[f"{side} [µs]"]) for side in ("predecessor", *TITLES)),
            *(number(row[f"{engine}: ratio"]) for engine in TITLES),
        )
        for name, row in found.items()
        if name != "versions"
    ]
    head = ("µs", "CausalWorld", *TITLES.values(), *(f"ratio, {t}" for t in TITLES.values()))
    return table(head, rows)


SECTIONS: dict[str, tuple[Callable[[Figures], list[str]], str]] = {
    "Goals": (goals, "Ratios are medians over rounds in which the sides take turns."),
    "Beside CausalWorld 1.2": (
        predecessor,
        "The same task, the same actions over their full range, from a reset on. Pictures are "
        "three of 128 × 128 and three of the goal.",
    ),
}


def machine(about: dict[str, Any]) -> str:
    """Name the kind of machine."""
    return f"{about['processor']}, {about['cores']} cores, {about['system']}"


def page(document: dict[str, Any]) -> str:
    """Write the tables.

    Args:
        document: ``about`` and ``results``, as in ``results.json``.
    """
    about, results = document["about"], document["results"]
    packages = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    lines = [f"Measured on {machine(about)}; {packages}.", ""]
    for title, (write, words) in SECTIONS.items():
        written = write(results)
        if written:
            lines += [f"## {title}", "", words, "", *written]
    return "\n".join(lines).rstrip()


def put(text: str, into: Path, mark: str = "speed") -> None:
    """Replace what stands between two marks of a page.

    Raises:
        ValueError: The page has no marks.
    """
    whole = into.read_text(encoding="utf-8")
    begin, end = (line.replace("speed", mark) for line in (BEGIN, END))
    before, found, rest_of_it = whole.partition(begin)
    _, closed, after = rest_of_it.partition(end)
    if not (found and closed):
        raise ValueError(f"{into} needs the lines {begin} and {end}")
    into.write_text(f"{before}{begin}\n\n{text}\n\n{end}{after}", encoding="utf-8")
