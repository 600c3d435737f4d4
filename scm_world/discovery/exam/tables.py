"""The scores of an exam as tables: every run as CSV, means and ranges as Markdown."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Literal, final

from scm_world.discovery.exam.results import Cell, Exam, Number
from scm_world.output.durable import write_whole
from scm_world.output.locations import Location, located

NONE = "–"


@final
@dataclass(frozen=True)
class Column:
    """A number that is shown of every group of runs.

    Attributes:
        key: Its name among the scores, or ``"seconds"``, ``"experiments"``, ``"bound"``.
        title: At the head of the column.
        better: Which way is better, if any.
        fraction: Whether it lies in [0, 1] and is written with two digits.
    """

    key: str
    title: str
    better: Literal["less", "more", ""] = ""
    fraction: bool = False


STANDARDISED = "shd_standardised"
COLUMNS = (
    Column("shd", "SHD", "less"),
    Column(STANDARDISED, "SHD standardised", "less"),
    Column("f1", "F1", "more", fraction=True),
    Column("precision", "precision", "more", fraction=True),
    Column("recall", "recall", "more", fraction=True),
    Column("auprc", "AUPRC", "more", fraction=True),
    Column("auroc", "AUROC", "more", fraction=True),
    Column("sid", "SID", "less"),
    Column("effect_rmse", "effect RMSE", "less"),
    Column("seconds", "seconds"),
    Column("experiments", "experiments"),
    Column("bound", "bound"),
)
HEADS = ("subject", "data", "learner", "budget", "done")
FACTS = ("subject", "learner", "data", "budget", "seed", "standardised", "status", "message")
COSTS = ("seconds", "experiments", "bound")
NOTE = (
    "Mean over the seeds that were done, and [lowest, highest]; (n = …) where not every seed that "
    f"was started has the number; {NONE} where none has. Bold: the best of the subject among those "
    "that all seeds have. The bound is the fewest experiments that can do in theory."
)


@final
@dataclass(frozen=True)
class Spread:
    """Some numbers in short: their mean, the smallest, the largest, and how many they are."""

    mean: float
    low: float
    high: float
    count: int

    @classmethod
    def of(cls, values: Iterable[Number]) -> Spread | None:
        """Take numbers together; what is missing does not count.

        Example:
            >>> Spread.of([1, None, 4])
            Spread(mean=2.5, low=1.0, high=4.0, count=2)
            >>> Spread.of([None]) is None
            True
        """
        known = [float(value) for value in values if value is not None]
        if not known:
            return None
        return cls(sum(known) / len(known), min(known), max(known), len(known))


@final
@dataclass(frozen=True)
class Row:
    """The runs of a learner on a subject with one kind of data and one budget.

    Attributes:
        subject: Name of the subject.
        data: ``"see"``, ``"do"`` or ``"paired"``.
        learner: Name of the learner.
        budget: Episodes or control steps.
        standardised: Whether all numbers are of standardised data, as there are no others.
        seeds: How many runs there are.
        timeout: How many of them ran out of time.
        failed: How many of them failed.
        spreads: By key of a column; those that exist.
    """

    subject: str
    data: str
    learner: str
    budget: int
    standardised: bool
    seeds: int
    timeout: int
    failed: int
    spreads: dict[str, Spread]

    @property
    def done(self) -> int:
        """How many runs have a result."""
        return self.seeds - self.timeout - self.failed

    @property
    def heads(self) -> tuple[str, str, str, str, str]:
        """What stands before the numbers."""
        data = self.data + (", standardised" if self.standardised else "")
        ends = [f"{self.done} of {self.seeds}"]
        ends += [f"{self.timeout} timed out"] * (self.timeout > 0)
        ends += [f"{self.failed} failed"] * (self.failed > 0)
        return (self.subject, data, self.learner, str(self.budget), ", ".join(ends))

    def text(self, column: Column) -> str:
        """Write one number."""
        spread = self.spreads.get(column.key)
        if spread is None:
            return NONE
        low, high = _written(spread.low, column), _written(spread.high, column)
        text = _written(spread.mean, column) + (f" [{low}, {high}]" if low != high else "")
        return text + (f" (n = {spread.count})" if spread.count < self.seeds else "")


def _written(value: float, column: Column) -> str:
    if column.fraction:
        return f"{value:.2f}"
    whole = abs(value) >= 1000 or value.is_integer()
    return f"{value:.0f}" if whole else f"{value:.3g}"


def table_rows(exam: Exam) -> tuple[Row, ...]:
    """Take the seeds together.

    Returns:
        A row per subject, kind of data, learner and budget, in this order.
    """
    place = {name: number for number, name in enumerate(exam.subjects)}

    def key(cell: Cell) -> tuple[int, str, str, int]:
        return (place[cell.subject], cell.data, cell.learner, cell.budget)

    return tuple(_row(list(cells)) for _, cells in groupby(sorted(exam.ordered, key=key), key))


def _row(cells: Sequence[Cell]) -> Row:
    scaled = [cell for cell in cells if cell.standardised]
    shown = [cell for cell in cells if not cell.standardised] or scaled
    done = [cell for cell in shown if cell.is_done]
    spreads = {c.key: Spread.of(_number(cell, c.key) for cell in done) for c in COLUMNS}
    spreads[STANDARDISED] = Spread.of(_number(cell, "shd") for cell in scaled if cell.is_done)
    first, ends = shown[0], [cell.status for cell in shown]
    return Row(
        subject=first.subject,
        data=first.data,
        learner=first.learner,
        budget=first.budget,
        standardised=first.standardised,
        seeds=len(shown),
        timeout=ends.count("timeout"),
        failed=ends.count("failed"),
        spreads={name: spread for name, spread in spreads.items() if spread is not None},
    )


def _number(cell: Cell, key: str) -> Number:
    costs: dict[str, Number] = {name: getattr(cell, name) for name in COSTS}
    return costs[key] if key in costs else cell.scores.get(key)


def best(rows: Sequence[Row]) -> frozenset[tuple[int, str]]:
    """Find the best numbers of one subject.

    A mean over fewer seeds than were started is not compared: the hard ones may be missing.

    Returns:
        Number of the row and key of the column; several if they are equally good, none if all are.
    """
    found: set[tuple[int, str]] = set()
    for column in COLUMNS:
        means = {
            number: row.spreads[column.key].mean
            for number, row in enumerate(rows)
            if column.key in row.spreads and row.spreads[column.key].count == row.seeds
        }
        if column.better and len(set(means.values())) > 1:
            top = min(means.values()) if column.better == "less" else max(means.values())
            found |= {(number, column.key) for number, mean in means.items() if mean == top}
    return frozenset(found)


def by_subject(exam: Exam) -> dict[str, list[Row]]:
    """Give the rows of each subject, of those without any as well."""
    rows: dict[str, list[Row]] = {name: [] for name in exam.subjects}
    for row in table_rows(exam):
        rows[row.subject].append(row)
    return rows


# --- files ----------------------------------------------------------------------------------------


def write_tables(exam: Exam, folder: Location | str) -> tuple[Location, Location]:
    """Write ``results.csv``, a line per run, and ``results.md``, the means.

    A missing number is an empty field of the one, and a dash in the other.

    Returns:
        The two files.
    """
    place = located(folder)
    table, summary = place / "results.csv", place / "results.md"
    write_whole(_csv(exam), table)
    write_whole(_markdown(exam), summary)
    return table, summary


def _csv(exam: Exam) -> str:
    known = [column.key for column in COLUMNS]
    given = {name for cell in exam.cells for name in cell.scores}
    scores = [key for key in known if key in given] + sorted(given - set(known))
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([*FACTS, *COSTS, *scores])
    for cell in exam.ordered:
        facts = [getattr(cell, name) for name in (*FACTS, *COSTS)]
        writer.writerow([*facts, *(cell.scores.get(name) for name in scores)])
    return stream.getvalue()


def _markdown(exam: Exam) -> str:
    lines = ["# Results of the exam", "", f"{exam.counted}. {NOTE}"]
    for name, rows in by_subject(exam).items():
        truth = exam.subjects[name]
        size = f"{len(truth.names)} variables, {len(truth.edges)} edges"
        lines += ["", f"## {_safe(name)}", "", size, ""]
        lines += _table(rows) if rows else ["No runs."]
    return "\n".join(lines) + "\n"


def _table(rows: Sequence[Row]) -> Iterable[str]:
    titles = [*HEADS[1:], *(column.title for column in COLUMNS)]
    yield _line(titles)
    yield _line("---" if title in HEADS[1:3] else "---:" for title in titles)
    bold = best(rows)
    for number, row in enumerate(rows):
        numbers = (
            f"**{row.text(column)}**" if (number, column.key) in bold else row.text(column)
            for column in COLUMNS
        )
        yield _line([*map(_safe, row.heads[1:]), *numbers])


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _safe(text: str) -> str:
    """Take from a text what means something in Markdown."""
    escaped = re.sub(r"([\\|*`\[\]])", r"\\\1", " ".join(text.split()))
    return escaped.replace("&", "&amp;").replace("<", "&lt;")
