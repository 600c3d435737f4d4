"""The page: markdown tables of all figures, between two marks in ``docs/benchmarks/index.md``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.speed.goals import GOALS, Figures
from benchmarks.speed.parts import PARTS

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


STEPS = {
    "`env.step`": ("step", "env.step [µs]"),
    "engine alone": ("step", "raw physics [µs]"),
    "share": ("step", "share of raw"),
    "with the log": ("step", "with the log [µs]"),
    "its share": ("step", "share of raw, with the log"),
    "with pixels": ("pixels", "step with pixels [µs]"),
    "pixels per second": ("pixels", "steps with pixels per second"),
    "first build [ms]": ("build", "first [ms]"),
    "second [ms]": ("build", "second [ms]"),
}
DOS = ("mass", "friction", "pose", "size", "gravity", "color", "link mass")
CHANGES = {
    "`env.reset`": ("changes", "reset [µs]"),
    **{f"do: {name}": ("changes", f"do: {name} [µs]") for name in DOS},
    "snapshot": ("changes", "snapshot [µs]"),
    "restore": ("changes", "restore [µs]"),
}


def growth(results: Figures) -> list[str]:
    """Show every cost of a step and of building, scene by scene."""
    return _by_scene(results, "step", STEPS)


def changes(results: Figures) -> list[str]:
    """Show what resets, interventions and snapshots cost, scene by scene."""
    return _by_scene(results, "changes", CHANGES)


def _by_scene(results: Figures, section: str, columns: dict[str, tuple[str, str]]) -> list[str]:
    lines: list[str] = []
    for engine, title in TITLES.items():
        rows = [
            (scene, *(_cell(results, part, engine, scene, f) for part, f in columns.values()))
            for scene in results.get(section, {}).get(engine, {})
        ]
        lines += table((f"{title}, µs", *columns), rows)
    return lines


def _cell(results: Figures, section: str, engine: str, scene: str, figure: str) -> str:
    value = results.get(section, {}).get(engine, {}).get(scene, {}).get(figure)
    if value is None:
        return ""
    return f"{value:.3f}" if figure.startswith("share") else number(value)


def profile(results: Figures) -> list[str]:
    """Show where the time of a step goes."""
    found = results.get("profile", {})
    rows = []
    for engine, scenes in found.items():
        for scene, row in scenes.items():
            whole = sum(row.values())
            cells = (f"{number(row.get(part, 0.0))}" for part in PARTS)
            rows.append((f"{TITLES.get(engine, engine)}, {scene}", *cells, number(whole)))
    return table(("µs", *PARTS, "together"), rows)


def batches(results: Figures) -> list[str]:
    """Show what many worlds cost at once."""
    found = results.get("batch", {})
    rows = [
        (f"{TITLES[engine]}, {scene}: {name}", number(value))
        for engine in TITLES
        for scene, row in found.get(engine, {}).items()
        for name, value in row.items()
    ]
    rows += [
        (f"{name}: {figure}", f"{value:.4f}" if figure == "R²" else number(value))
        for name, row in found.items()
        if name.startswith("cost")
        for figure, value in row.items()
    ]
    return table((f"{found.get('worlds', 0)} worlds", ""), rows)


def rest(results: Figures) -> list[str]:
    """Show memory, imports, the adapter and the cost of long runs."""
    rows = []
    for engine, row in results.get("memory", {}).items():
        for name, values in row.items():
            shown = ", ".join(f"{key}: {number(value)}" for key, value in values.items())
            rows.append((f"{TITLES[engine]}, {name}", shown))
    for section in ("import", "adapter"):
        rows += [
            (f"{section} {name}", number(value)) for name, value in results.get(section, {}).items()
        ]
    for name, row in results.get("growth", {}).items():
        shown = ", ".join(f"{key}: {value:.4g}" for key, value in row.items())
        rows.append((f"MuJoCo, {name}", shown))
    return table(("what", ""), rows)


SECTIONS: dict[str, tuple[Callable[[Figures], list[str]], str]] = {
    "Goals": (goals, "Ratios are medians over rounds in which the sides take turns."),
    "Beside CausalWorld 1.2": (
        predecessor,
        "The same task, the same actions over their full range, from a reset on. Pictures are "
        "three of 128 × 128 and three of the goal.",
    ),
    "Scenes": (
        growth,
        "Control steps of 10 × 4 ms, random actions over their full range. *Engine alone* runs "
        "through the same episode without anything around it; the log is a `Recorder`. *First "
        "build* is construction and reset in a fresh process, after the imports.",
    ),
    "Resets, interventions, snapshots": (
        changes,
        "They come after control steps, with cold caches, as in use; in a tight loop they cost "
        "less. Snapshots are taken from the 30th step of an episode on: before its 20th step, "
        "Bullet only remembers what was done, and restores it by doing it again. In general, "
        "friction and gravity move the goals: the pile is dropped again.",
    ),
    "Where the time of a step goes": (
        profile,
        "Each part without those that it calls; the clock's own cost is taken off. *Mechanisms* "
        "are rewards and whatever else is computed from the state, *the rest* is the loop itself.",
    ),
    "Batches": (
        batches,
        "*Step of a world* and *raw physics* are times of the processor; the engine alone is a "
        "plain loop over as many scenes.",
    ),
    "Memory, imports, long runs": (
        rest,
        "Memory is what is resident; imports are beyond starting Python.",
    ),
}


def page(document: dict[str, Any]) -> str:
    """Write all tables.

    Args:
        document: ``about`` and ``results``, as in ``results.json``.
    """
    about, results = document["about"], document["results"]
    packages = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    machine = f"{about['processor']}, {about['cores']} cores, {about['system']}"
    lines = [f"Measured on {machine}; {packages}.", ""]
    lines += ["![what a step costs](../images/speed.png)", ""]
    for title, (write, words) in SECTIONS.items():
        written = write(results)
        if written:
            lines += [f"### {title}", "", words, "", *written]
    return "\n".join(lines).rstrip()


def put(text: str, into: Path) -> None:
    """Replace what stands between the marks of a page.

    Raises:
        ValueError: The page has no marks.
    """
    whole = into.read_text(encoding="utf-8")
    before, found, rest_of_it = whole.partition(BEGIN)
    _, closed, after = rest_of_it.partition(END)
    if not (found and closed):
        raise ValueError(f"{into} needs the lines {BEGIN} and {END}")
    into.write_text(f"{before}{BEGIN}\n\n{text}\n\n{END}{after}", encoding="utf-8")
