"""The numbers of a study in tables: Markdown for people, CSV and JSON for programs."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from scm_world.evaluation import Interval, protocols_of
from scm_world.output.durable import write_whole
from scm_world.queries.experiments.versions import versions
from scm_world.training.study.cells import FORMAT, PRESETS, PROTOCOLS
from scm_world.training.study.published import Published, published
from scm_world.training.study.records import Record
from scm_world.training.study.scores import OVERALL, Findings, Row

NOT_RUN, UNKNOWN = "not run", "–"
NAMES = ("table.md", "table.csv", "table.json")
WHOLE = "Reproduction"
PARTIAL = "Partial budget, not a reproduction"
AS_PUBLISHED = {"preset": "paper", "conventions": PRESETS["paper"], "policy": "last"}
"""Options of a study whose scores are measured as the published ones are."""


def write_tables(found: Findings, folder: Path, notes: Sequence[str] = ()) -> tuple[Path, ...]:
    """Write all tables.

    Args:
        found: What is in the folder.
        folder: Where to.
        notes: Sentences for people.

    Raises:
        UnwritableFolder: There is no room, or no permission.
    """
    paths = tuple(folder / name for name in NAMES)
    write_whole(as_markdown(found, notes), paths[0])
    write_whole(as_csv(found), paths[1])
    write_whole(json.dumps(as_dict(found, notes), indent=1, allow_nan=False) + "\n", paths[2])
    return paths


# --- how much was done ------------------------------------------------------------------------


def lacks(found: Findings, task: str, algo: str, curriculum: int) -> list[str]:
    """Say what one group of trainings lacks of what was published.

    Returns:
        Nothing if it was trained and evaluated as much as that.
    """
    budget = published().budget
    group = [r for cell, r in found.records.items() if cell.group == (task, algo, curriculum)]
    if not group:
        return [NOT_RUN]
    evaluations = found.group(task, algo, curriculum)
    episodes = min(int(one.about["n"]) for one in evaluations.values())
    protocols = min(len({*PROTOCOLS} & {*one.protocols}) for one in evaluations.values())
    steps = min(record.steps for record in group)
    problems = []
    for name, its in AS_PUBLISHED.items():
        if (mine := found.study.head[name]) != its:
            problems.append(f"{name} {mine}, not the paper's")
    for what, here, there in (
        ("control steps", steps, budget.steps[algo]),
        ("seeds", len(group), budget.seeds),
        ("episodes of each protocol", episodes, budget.episodes),
        ("protocols", protocols, len(PROTOCOLS)),
    ):
        if here < there:
            share = f" ({here / there:.2g} of them)" if what == "control steps" else ""
            problems.append(f"{here:,} of {there:,} {what}{share}")
    return problems


def said(problems: Sequence[str]) -> str:
    """Say what ``lacks`` found, so that a part is never taken for the whole."""
    if list(problems) == [NOT_RUN]:
        return NOT_RUN
    return f"{PARTIAL}: {'; '.join(problems)}" if problems else WHOLE


# --- Markdown ---------------------------------------------------------------------------------


def as_markdown(found: Findings, notes: Sequence[str] = ()) -> str:
    """Write the tables for people: one for each task and algorithm."""
    known, study = published(), found.study
    lines = [
        f"# Figures of the paper: {', '.join(study.tasks)}",
        "",
        f"Fractional success at the end of an episode. Preset {study.preset}, "
        f"{study.scale:g} of its steps, conventions {study.rules}, engine {study.backend}, the "
        f"{study.policy} policy of each training. Intervals are of 95 %, over seeds, or, marked "
        "with an e, over the episodes of the only seed. IQM is the interquartile mean over the "
        f"same. Published actors act with the conventions {PRESETS['paper']}. What was published "
        "belongs to "
        f"{known.work}; “{UNKNOWN}” stands where a score is not known. Numbers in parentheses "
        "refer to the sources below.",
        "",
    ]
    sources = _sources(found.table)
    for task in study.tasks:
        for algo in study.algos:
            mine = [row for row in found.table if (row.task, row.algo) == (task, algo)]
            lines += _section(found, task, algo, mine, sources)
    lines += [
        "## Sources",
        "",
        *(f"{number}. {_source(known, name)}" for name, number in sources.items()),
        "",
    ]
    lines += [f"- {remark}" for remark in (*known.remarks, *notes)]
    return "\n".join(lines) + "\n"


def _section(
    found: Findings, task: str, algo: str, rows: Sequence[Row], sources: Mapping[str, int]
) -> list[str]:
    curricula = found.study.curricula
    columns = {c: [row for row in rows if row.curriculum == c] for c in curricula}
    heads, sides = ["protocol", "varied"], []
    for curriculum, mine in columns.items():
        kinds = ["ours", "IQM", "published"]
        kinds += ["published actor, here"] if any(row.actor for row in mine) else []
        heads += [f"curriculum {curriculum}: {kinds[0]}", *kinds[1:]]
        sides.append((mine, len(kinds)))
    docs = {protocol.name: protocol.doc for protocol in protocols_of(task)}
    lines = [f"## {task}, {algo.upper()}", ""]
    for curriculum in curricula:
        problems = lacks(found, task, algo, curriculum)
        lines.append(
            f"- curriculum {curriculum}: {said(problems)}{_made(found, task, algo, curriculum)}"
        )
    lines += ["", _line(heads), _line(["---"] * len(heads))]
    for place, protocol in enumerate((*PROTOCOLS, OVERALL)):
        known = published().difference(task, protocol)
        doc = docs.get(protocol, "mean of all protocols") + (f" ({known})" if known else "")
        cells = [protocol, doc]
        for mine, count in sides:
            cells += _entries(mine[place], sources)[:count]
        lines.append(_line(cells))
    return [*lines, ""]


def _made(found: Findings, task: str, algo: str, curriculum: int) -> str:
    """Say which trainings stand behind a column."""
    group = [
        r for cell, r in sorted(found.records.items()) if cell.group == (task, algo, curriculum)
    ]
    if not group:
        return ""
    seeds = ", ".join(str(record.cell.seed) for record in group)
    hours = sum(record.cpu_seconds for record in group) / 3600.0
    return f". Seeds {seeds}; {group[0].steps:,} steps each; {hours:.2f} CPU-hours of training."


def _entries(row: Row, sources: Mapping[str, int]) -> list[str]:
    ours, iqm = NOT_RUN, ""
    if row.ours is not None:
        ours = f"{row.ours.mean}{' e' if row.ours.over == 'episodes' else ''}"
        iqm = f"{row.ours.iqm.value:.2f}"
    there = UNKNOWN
    if row.published is not None:
        there = f"{row.published:.2f} ({sources[row.source]})"
    actor = NOT_RUN if row.actor is None else f"{row.actor} e"
    if row.actor is not None and row.original is not None:
        actor += f"; there {row.original:.3f} ({sources[_original(row)]})"
    return [ours, iqm, there, actor]


def _original(row: Row) -> str:
    actor = published().actor(row.task, row.algo, row.curriculum)
    return "" if actor is None else actor.source


def _sources(rows: Sequence[Row]) -> dict[str, int]:
    """Number the sources that a table refers to."""
    names = [row.source for row in rows if row.published is not None]
    names += [_original(row) for row in rows if row.actor and row.original is not None]
    return {name: number for number, name in enumerate(dict.fromkeys(names), start=1)}


def _source(known: Published, name: str) -> str:
    source = known.sources[name]
    return f"{source.what}; {source.how}, ±{source.tolerance:g}; {source.policies} policy each."


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


# --- CSV and JSON -----------------------------------------------------------------------------


def as_csv(found: Findings) -> str:
    """Write a row for each number of the figure."""
    stream = io.StringIO(newline="")
    listed = [_flat(found, row) for row in found.table]
    writer = csv.DictWriter(stream, list(listed[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(listed)
    return stream.getvalue()


def _flat(found: Findings, row: Row) -> dict[str, Any]:
    study, key = found.study, (row.task, row.algo, row.curriculum)
    group = [record for cell, record in found.records.items() if cell.group == key]
    ours = row.ours
    return {
        "task": row.task,
        "algo": row.algo,
        "curriculum": row.curriculum,
        "protocol": row.protocol,
        "status": NOT_RUN if ours is None else said(lacks(found, *key)),
        **_ends("mean", None if ours is None else ours.mean),
        **_ends("iqm", None if ours is None else ours.iqm),
        "interval_over": "" if ours is None else ours.over,
        "seeds": "" if ours is None else " ".join(map(str, ours.seeds)),
        "episodes": "" if ours is None else ours.episodes,
        "steps": min((record.steps for record in group), default=""),
        "published_steps": published().budget.steps[row.algo],
        "preset": study.preset,
        "scale": study.scale,
        "conventions": study.rules,
        "backend": study.backend,
        "published": "" if row.published is None else row.published,
        "source": row.source,
        **_ends("actor_here", row.actor),
        "actor_original": "" if row.original is None else row.original,
    }


def _ends(name: str, one: Interval | None) -> dict[str, Any]:
    if one is None:
        return {name: "", f"{name}_low": "", f"{name}_high": ""}
    return {name: one.value, f"{name}_low": one.low, f"{name}_high": one.high}


def as_dict(found: Findings, notes: Sequence[str] = ()) -> dict[str, Any]:
    """Give everything as plain data."""
    known = published()
    return {
        "format": FORMAT,
        "study": {**asdict(found.study), "conventions": found.study.rules},
        "versions": versions(),
        "trainings": [_training(record) for _, record in sorted(found.records.items())],
        "rows": [
            {name: None if value == "" else value for name, value in _flat(found, row).items()}
            for row in found.table
        ],
        "budget": known.budget.model_dump(mode="json"),
        "sources": {name: one.model_dump(mode="json") for name, one in known.sources.items()},
        "remarks": [*known.remarks, *notes],
    }


def _training(record: Record) -> dict[str, Any]:
    return {
        **asdict(record.cell),
        "steps": record.steps,
        "recipe_steps": record.whole,
        "cpu_seconds": record.cpu_seconds,
        "seconds": record.seconds,
    }
