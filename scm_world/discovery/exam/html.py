"""The report of an exam: one HTML file that needs nothing else, and no network."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

from scm_world.discovery.exam.html_style import SCRIPT, STYLE, verdicts
from scm_world.discovery.exam.pictures import budget_png
from scm_world.discovery.exam.results import Cell, Exam, Truth
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
from scm_world.output.durable import write_whole
from scm_world.output.locations import Location
from scm_world.output.pages import Entry, facts, folded, page, picture, section, table

PICTURES = 150  # runs: of an exam with more of them, only one per learner and subject is drawn
TEXTS = 3  # of the first columns of the summary; the others are numbers
NAMED = 25  # wrong edges of a kind that are named in words
SHORT = ("shd", "f1", "precision", "recall")  # scores beside a single run


def write_report(exam: Exam, path: Location | str) -> None:
    """Write the report: tables, the picture of the budgets, and the graphs side by side.

    Of each learner on each subject the first seed of the largest budget is drawn, and the other
    runs stand below it: drawn if the exam has at most 150 runs, in words otherwise. The same exam
    gives the same bytes, whatever the order of its cells.

    Args:
        exam: Any exam; it may have no finished run.
        path: Of the HTML file.
    """
    parts = [
        _summary(exam),
        _budget(exam),
        signs(),
        *(_subject(exam, name, number) for number, name in enumerate(exam.subjects)),
        section("about", "About this exam", facts(exam.about)),
    ]
    subjects = [(f"s{number}", name) for number, name in enumerate(exam.subjects)]
    whole = page(
        "Exam of learners",
        parts,
        lead=f"{exam.counted}.",
        contents=[("summary", "Summary"), ("budget", "Budget"), *subjects],
        early_style=verdicts(),
        extra_style=STYLE,
        extra_script=SCRIPT,
    )
    write_whole(whole, path)


# --- all subjects ---------------------------------------------------------------------------------


def _summary(exam: Exam) -> str:
    titles = [*HEADS, *(column.title for column in COLUMNS)]
    lines: list[list[Entry]] = []
    for rows in by_subject(exam).values():
        bold = best(rows)
        for number, row in enumerate(rows):
            numbers = (_number(row, c, (number, c.key) in bold) for c in COLUMNS)
            lines.append([*_heads(row), *numbers])
    whole = table(titles, lines, left=TEXTS, sortable=True)
    return section("summary", "Summary", f"<p>{escape(NOTE)}</p>{whole}")


def _heads(row: Row) -> Iterable[Entry]:
    """Give the first entries of a row."""
    for head, text in zip(HEADS, row.heads, strict=True):
        yield Entry(text, by=str(row.done) if head == "done" else None)


def _number(row: Row, column: Column, is_best: bool) -> Entry:
    spread = row.spreads.get(column.key)
    value = "" if spread is None else f"{spread.mean:.6g}"
    return Entry(row.text(column), by=value, looks="best" if is_best else "")


def _budget(exam: Exam) -> str:
    alt = (
        "Line charts: SHD and F1 against the budget, two panels per subject, a line per learner. "
        "The numbers are those of the summary."
    )
    caption = (
        "Means; bars from the lowest to the highest seed. Lines are moved a little aside, so that "
        "they do not hide one another."
    )
    inside = picture(budget_png(exam), alt, caption)
    return section("budget", "Scores against the budget", inside)


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
    inside = f"<p>{size}. {hint}</p>{facts(truth.about)}{legend()}{board.shared()}{''.join(parts)}"
    return section(f"s{number}", name, inside)


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
        more = folded(f"{len(others)} other runs", inside)
    if own:
        more += folded(f"{len(own)} runs on other graphs", _list(own, links))
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
    named = facts(dict(_named(links)))
    return folded("Wrong edges in words", named) if named else ""


def _named(links: Sequence[Link]) -> Iterable[tuple[str, str]]:
    for kind in WRONG:
        found = [link.words for link in links if link.verdict == kind]
        more = f"; … and {len(found) - NAMED} more" if len(found) > NAMED else ""
        if found:
            yield kind, "; ".join(found[:NAMED]) + more


def _list(cells: Iterable[Cell], links: Links) -> str:
    """Write runs in words: their scores and their edges, counted."""
    titles = ["budget", "seed", "status", *(column.title for column in _short()), "edges"]
    lines: list[list[str | Entry]] = []
    for cell in cells:
        scores = [_score(cell, column) for column in _short()]
        said = _counted(links[cell.key]) if cell.key in links else cell.message
        last = Entry(said, looks="w")
        lines.append([str(cell.budget), str(cell.seed), cell.status, *scores, last])
    return table(titles, lines)
