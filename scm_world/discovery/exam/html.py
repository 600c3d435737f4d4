"""The report of an exam: one HTML file that needs nothing else, and no network."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

from scm_world.discovery.exam.html_style import SCRIPT, style
from scm_world.discovery.exam.pictures import budget_png
from scm_world.discovery.exam.results import Cell, Exam, Truth, write_whole
from scm_world.discovery.exam.side_by_side import WRONG, Link, compare
from scm_world.discovery.exam.side_by_side_drawing import Board, legend, signs
from scm_world.discovery.exam.tables import (
    COLUMNS,
    HEADS,
    NONE,
    NOTE,
    Column,
    Row,
    best,
    by_subject,
)

PICTURES = 150  # runs: of an exam with more of them, only one per learner and subject is drawn
NAMED = 25  # wrong edges of a kind that are named in words
SHORT = ("shd", "f1", "precision", "recall")  # scores beside a single run


def write_report(exam: Exam, path: Path | str) -> None:
    """Write the report: tables, the picture of the budgets, and the graphs side by side.

    Of each learner on each subject the first seed of the largest budget is drawn, and the other
    runs stand below it: drawn if the exam has at most 150 runs, in words otherwise. The same exam
    gives the same bytes, whatever the order of its cells.

    Args:
        exam: Any exam; it may have no finished run.
        path: Of the HTML file.
    """
    title = "Exam of learners"
    parts = [
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">',
        f"<title>{title}</title><style>{style()}</style></head><body>",
        f"<header><h1>{title}</h1><p>{escape(exam.counted)}.</p></header>",
        f"<nav aria-label='Contents'><ul>{''.join(_contents(exam))}</ul></nav><main>",
        _summary(exam),
        _budget(exam),
        signs(),
        *(_subject(exam, name, number) for number, name in enumerate(exam.subjects)),
        _about(exam),
        f"</main><script>{SCRIPT}</script></body></html>\n",
    ]
    write_whole("\n".join(parts), path)


def _contents(exam: Exam) -> Iterable[str]:
    yield '<li><a href="#summary">Summary</a></li><li><a href="#budget">Budget</a></li>'
    for number, name in enumerate(exam.subjects):
        yield f'<li><a href="#s{number}">{escape(name)}</a></li>'


# --- all subjects ---------------------------------------------------------------------------------


def _summary(exam: Exam) -> str:
    left = 3  # of the first columns are text
    titles = [*HEADS, *(column.title for column in COLUMNS)]
    heads = "".join(
        f'<th scope="col"{_left(i < left)}>{title}</th>' for i, title in enumerate(titles)
    )
    lines: list[str] = []
    for rows in by_subject(exam).values():
        bold = best(rows)
        for number, row in enumerate(rows):
            facts = "".join(
                f"<td{_left(i < left)}{_value(row, i)}>{escape(text)}</td>"
                for i, text in enumerate(row.heads)
            )
            numbers = "".join(_number(row, c, (number, c.key) in bold) for c in COLUMNS)
            lines.append(f"<tr>{facts}{numbers}</tr>")
    return (
        f'<section id="summary"><h2>Summary</h2><p>{escape(NOTE)}</p><div class="wide">'
        f'<table class="sort"><thead><tr>{heads}</tr></thead>'
        f"<tbody>{''.join(lines)}</tbody></table></div></section>"
    )


def _left(is_text: bool) -> str:
    return ' class="l"' if is_text else ""


def _value(row: Row, column: int) -> str:
    """Give what a column is sorted by, where it is not its text."""
    return f' data-v="{row.done}"' if HEADS[column] == "done" else ""


def _number(row: Row, column: Column, is_best: bool) -> str:
    spread = row.spreads.get(column.key)
    value = "" if spread is None else f"{spread.mean:.6g}"
    mark = ' class="best"' if is_best else ""
    return f'<td{mark} data-v="{value}">{escape(row.text(column))}</td>'


def _budget(exam: Exam) -> str:
    alt = (
        "Line charts: SHD and F1 against the budget, two panels per subject, a line per learner. "
        "The numbers are those of the summary."
    )
    data = b64encode(budget_png(exam)).decode()
    return (
        f'<section id="budget"><h2>Scores against the budget</h2><figure><img alt="{alt}" '
        f'src="data:image/png;base64,{data}"><figcaption>Means; bars from the lowest to the '
        "highest seed. Lines are moved a little aside, so that they do not hide one another."
        "</figcaption></figure></section>"
    )


def _about(exam: Exam) -> str:
    return f'<section id="about"><h2>About this exam</h2>{_facts(exam.about)}</section>'


def _facts(about: dict[str, object]) -> str:
    lines = "".join(
        f"<dt>{escape(str(key))}</dt><dd>{escape(_words(value))}</dd>"
        for key, value in about.items()
    )
    return f"<dl>{lines}</dl>" if lines else ""


def _words(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, default=str)


# --- one subject ----------------------------------------------------------------------------------


def _subject(exam: Exam, name: str, number: int) -> str:
    truth, cells = exam.subjects[name], exam.cells_of(name)
    links = {c.key: compare(exam.truth_of(c), c.found) for c in cells if c.found is not None}
    board = Board(truth, f"s{number}", max(map(len, links.values()), default=0))
    drawn = len(exam.cells) <= PICTURES
    groups: dict[tuple[str, str, bool], list[Cell]] = {}
    for cell in cells:
        groups.setdefault((cell.learner, cell.data, cell.standardised), []).append(cell)
    parts = [_learner(truth, board, group, links, drawn) for group in groups.values()]
    size = f"{len(truth.names)} variables, {len(truth.edges)} declared edges"
    if truth.left_out:
        size += f", {len(truth.left_out)} pairs not scored"
    hint = "Point at an edge to read its names; in a graph that has the focus, use ← and →."
    return (
        f'<section id="s{number}"><h2>{escape(name)}</h2><p>{size}. {hint}</p>'
        f"{_facts(truth.about)}{legend()}{board.shared()}{''.join(parts)}</section>"
    )


Links = dict[tuple[str, str, str, bool, int, int], tuple[Link, ...]]


def _learner(truth: Truth, board: Board, cells: Sequence[Cell], links: Links, drawn: bool) -> str:
    """Show one run, and the others below it."""
    shown = [cell for cell in cells if cell.declared is None] or list(cells)
    largest = max(cell.budget for cell in shown)
    first = next(cell for cell in shown if cell.budget == largest)
    own = [cell for cell in cells if cell.declared is not None]
    others = [cell for cell in cells if cell is not first and cell not in own]
    kind = f"{first.learner}, {first.data}" + (", standardised" if first.standardised else "")
    more = ""
    if others:
        inside = (
            "".join(f"<h4>{_run(cell)}</h4>{_pair(truth, board, cell, links)}" for cell in others)
            if drawn
            else _list(others, links)
        )
        more = f"<details><summary>{len(others)} other runs</summary>{inside}</details>"
    if own:
        inside = _list(own, links)
        more += f"<details><summary>{len(own)} runs on other graphs</summary>{inside}</details>"
    return (
        f"<h3>{escape(kind)}</h3><p>{_run(first)}</p>{_pair(truth, board, first, links)}"
        f"{_wrong(links.get(first.key, ()))}{more}"
    )


def _run(cell: Cell) -> str:
    said = [f"budget {cell.budget}", f"seed {cell.seed}"]
    said += [f"{column.title} {_score(cell, column)}" for column in _short()]
    return escape(", ".join(said))


def _short() -> Iterable[Column]:
    return (column for column in COLUMNS if column.key in SHORT)


def _score(cell: Cell, column: Column) -> str:
    value = cell.scores.get(column.key)
    if value is None:
        return NONE
    return f"{value:.2f}" if column.fraction else f"{value:g}"


def _pair(truth: Truth, board: Board, cell: Cell, links: Links) -> str:
    """Put the declared and the found graph side by side."""
    width = board.size[0]
    frame = f'<figure style="flex:1 1 {0.6 * width:.0f}px;max-width:{width + 14:.0f}px">'
    left = board.declared(f"Declared graph of {truth.name}, {len(truth.edges)} edges")
    if cell.key not in links:
        why = escape(f"{cell.status}: {cell.message}" if cell.message else cell.status)
        right = f'<p class="none">No graph. {why}</p>'
    else:
        counted = _counted(links[cell.key])
        title = f"Graph that {cell.learner} found for {truth.name}: {counted}"
        drawing = board.found(links[cell.key], title)
        right = f"{drawing}<figcaption>Found: {counted}</figcaption><output></output>"
    return (
        f'<div class="pair">{frame}{left}<figcaption>Declared</figcaption></figure>'
        f"{frame}{right}</figure></div>"
    )


def _counted(links: Sequence[Link]) -> str:
    verdicts = [link.verdict for link in links]
    kinds = ("correct", *WRONG, "unscored")
    return ", ".join(f"{verdicts.count(k)} {k}" for k in kinds if k in verdicts) or "no edge"


def _wrong(links: Sequence[Link]) -> str:
    """Name the wrong edges, for those who cannot see or point."""
    named = "".join(f"<dt>{kind}</dt><dd>{escape(text)}</dd>" for kind, text in _named(links))
    if not named:
        return ""
    return f"<details><summary>Wrong edges in words</summary><dl>{named}</dl></details>"


def _named(links: Sequence[Link]) -> Iterable[tuple[str, str]]:
    for kind in WRONG:
        found = [link.words for link in links if link.verdict == kind]
        more = f"; … and {len(found) - NAMED} more" if len(found) > NAMED else ""
        if found:
            yield kind, "; ".join(found[:NAMED]) + more


def _list(cells: Iterable[Cell], links: Links) -> str:
    """Write runs in words: their scores and their edges, counted."""
    titles = ["budget", "seed", "status", *(column.title for column in _short())]
    heads = "".join(f'<th scope="col">{title}</th>' for title in [*titles, "edges"])
    lines = []
    for cell in cells:
        facts = [str(cell.budget), str(cell.seed), cell.status]
        facts += [_score(cell, column) for column in _short()]
        said = _counted(links[cell.key]) if cell.key in links else cell.message
        texts = "".join(f"<td>{escape(fact)}</td>" for fact in facts)
        lines.append(f'<tr>{texts}<td class="w">{escape(said)}</td></tr>')
    return f"<table><thead><tr>{heads}</tr></thead><tbody>{''.join(lines)}</tbody></table>"
