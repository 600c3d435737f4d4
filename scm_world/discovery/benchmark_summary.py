"""The table and the picture of a benchmark."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import groupby, product
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, final

import numpy as np

from scm_world.discovery.benchmarks import BenchmarkResult, BenchmarkRun
from scm_world.discovery.learners.registry import baselines
from scm_world.runs.canvas import PALETTE, blank, save, styled
from scm_world.runs.files import Location, write_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NONE = "–"
FACTS = ("problem", "learner", "data", "budget", "seed", "standardised", "status", "message")
COSTS = ("seconds", "experiments", "bound")
HEADS = ("problem", "data", "learner", "budget", "done")
NOTE = (
    "Mean over the seeds that were done, and [lowest, highest]; (n = …) where not every seed that "
    f"was started has the number; {NONE} where none has. Bold: the best of the problem among those "
    "that all seeds have. The bound is the fewest experiments that can do in theory."
)


class ScoreColumn(NamedTuple):
    """A number of every group of runs: its key, its title, which way is better."""

    key: str
    title: str
    better: Literal["less", "more", ""] = ""
    digits: int | None = None


ORACLES = (
    "Oracles with access to the simulator: they do their own experiments, with the same noise in "
    "both runs of a pair, which no table of data allows. They show what the physics determines and "
    "are not ranked among learners from data."
)
STANDARDISED = "shd_standardised"
COLUMNS = (
    ScoreColumn("shd", "SHD", "less"),
    ScoreColumn(STANDARDISED, "SHD standardised", "less"),
    ScoreColumn("f1", "F1", "more", 2),
    ScoreColumn("precision", "precision", "more", 2),
    ScoreColumn("recall", "recall", "more", 2),
    ScoreColumn("auprc", "AUPRC", "more", 2),
    ScoreColumn("auroc", "AUROC", "more", 2),
    ScoreColumn("sid", "SID", "less"),
    ScoreColumn("effect_rmse", "effect RMSE", "less"),
    ScoreColumn("pag_distance", "PAG distance", "less"),
    ScoreColumn("adjacency_f1", "adjacency F1", "more", 2),
    ScoreColumn("head_f1", "heads F1", "more", 2),
    ScoreColumn("tail_f1", "tails F1", "more", 2),
    ScoreColumn("targets", "targets found", "more", 2),
    ScoreColumn("variance_sortability", "varsortability", "", 2),
    ScoreColumn("r2_sortability", "R²-sortability", "", 2),
    ScoreColumn("seconds", "seconds"),
    ScoreColumn("experiments", "experiments"),
    ScoreColumn("bound", "bound"),
)
MARKED = ("pag_distance", "adjacency_f1", "head_f1", "tail_f1", "targets")
"""Of graphs with edge marks, and of unknown targets: shown where some run has them."""

# --- tables ---------------------------------------------------------------------------------------


class Spread(NamedTuple):
    """The mean of some numbers, the smallest, the largest, and how many they are."""

    mean: float
    low: float
    high: float
    n: int


@final
@dataclass(frozen=True)
class SummaryRow:
    """The runs of a learner on a problem with one kind of data and one budget.

    Attributes:
        run: One of them; standardised if there are no others.
        statuses: How the runs ended.
        spreads: By key of a column; those that exist.
        best: Keys of the columns in which no row of the problem is better.
    """

    run: BenchmarkRun
    statuses: tuple[str, ...]
    spreads: dict[str, Spread]
    best: set[str] = field(default_factory=set)

    @property
    def data(self) -> str:
        """The kind of data."""
        return self.run.data + ", standardised" * self.run.standardised

    @property
    def is_oracle(self) -> bool:
        """Whether the learner had the simulator instead of data."""
        return self.run.data == "paired"

    @property
    def is_baseline(self) -> bool:
        """Whether the learner is a trivial one."""
        return self.run.learner in baselines()

    @property
    def heads(self) -> tuple[str, str, str, str, str]:
        """The cells before the numbers."""
        ended = [f"{self.statuses.count('done')} of {len(self.statuses)}"]
        for status, words in (("timeout", "timed out"), ("failed", "failed")):
            if status in self.statuses:
                ended.append(f"{self.statuses.count(status)} {words}")
        run = self.run
        return (run.problem, self.data, run.learner, str(run.budget), ", ".join(ended))

    def text(self, column: ScoreColumn) -> str:
        """Write one number."""
        spread = self.spreads.get(column.key)
        if spread is None:
            return NONE
        low, high = number(spread.low, column), number(spread.high, column)
        text = number(spread.mean, column) + (f" [{low}, {high}]" if low != high else "")
        return text + (f" (n = {spread.n})" if spread.n < len(self.statuses) else "")


def number(value: float | None, column: ScoreColumn) -> str:
    """Write a number with the digits of its column."""
    if value is None:
        return NONE
    if column.digits is not None:
        return f"{value:.{column.digits}f}"
    return f"{value:.0f}" if abs(value) >= 1000 or float(value).is_integer() else f"{value:.3g}"


def summary(result: BenchmarkResult) -> dict[str, list[SummaryRow]]:
    """Take the seeds together: by problem a row per kind of data, learner and budget.

    The best of a column is the best mean over all seeds that were started: without one of them,
    the hard one may be missing. There are several if they are equally good, none if all are.
    Trivial baselines follow the learners. Oracles with access to the simulator come last, and are
    compared with one another only.
    """
    rows: dict[str, list[SummaryRow]] = {name: [] for name in result.problems}

    plain = baselines()

    def key(run: BenchmarkRun) -> tuple[str, str, bool, str, int]:  # "paired" is the last kind
        return (run.problem, run.data, run.learner in plain, run.learner, run.budget)

    for _, group in groupby(sorted(result.runs, key=key), key):
        runs = list(group)
        scaled = [run for run in runs if run.standardised]
        shown = [run for run in runs if not run.standardised] or scaled
        spreads = {}
        for column in COLUMNS:
            of, score = (scaled, "shd") if column.key == STANDARDISED else (shown, column.key)
            values = [run.record.get(score) for run in of if run.status == "done"]
            known = [float(value) for value in values if value is not None]
            if known:
                mean = sum(known) / len(known)
                spreads[column.key] = Spread(mean, min(known), max(known), len(known))
        statuses = tuple(run.status for run in shown)
        rows[shown[0].problem].append(SummaryRow(shown[0], statuses, spreads))
    for column in (column for column in COLUMNS if column.better):
        for found, is_oracle in product(rows.values(), (False, True)):
            whole = [
                row
                for row in found
                if row.is_oracle == is_oracle
                and column.key in row.spreads
                and row.spreads[column.key].n == len(row.statuses)
            ]
            means = {row.spreads[column.key].mean for row in whole}
            top = min(means, default=0) if column.better == "less" else max(means, default=0)
            for row in whole if len(means) > 1 else ():
                if row.spreads[column.key].mean == top:
                    row.best.add(column.key)
    return rows


def columns(rows: Iterable[SummaryRow]) -> list[ScoreColumn]:
    """Return the columns of a table of some rows."""
    there = {key for row in rows for key in row.spreads}
    return [column for column in COLUMNS if column.key in there or column.key not in MARKED]


def size(result: BenchmarkResult, name: str) -> str:
    """Say how large the graph of a problem is; a range where seeds have graphs of their own."""
    first = result.problems[name]
    truths = [first, *(result.truth_of(run) for run in result.runs if run.problem == name)]

    def many(counts: set[int]) -> str:
        return f"{min(counts)} to {max(counts)}" if len(counts) > 1 else f"{min(counts)}"

    text = f"{len(first.names)} variables, {many({len(t.edges) for t in truths})} true edges"
    hidden = {len(t.confounded) for t in truths}
    text += f", {many(hidden)} pairs with hidden causes" * any(hidden)
    return text + f", {len(first.unscored)} pairs not scored" * bool(first.unscored)


def write_files(result: BenchmarkResult, folder: Location) -> None:
    """Write ``results.csv`` and ``budget.png``; a missing number is empty."""
    write_whole(folder / "results.csv", _csv(result))
    save(draw_budgets(result), folder / "budget.png")


def _csv(result: BenchmarkResult) -> str:
    given = {name for run in result.runs for name in run.scores}
    shown = [column.key for column in COLUMNS if column.key in given]
    stream = io.StringIO()
    names = [*FACTS, *COSTS, *shown, *sorted(given - set(shown))]
    writer = csv.DictWriter(stream, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(result.records)
    return stream.getvalue()


# --- the picture ----------------------------------------------------------------------------------

MARKERS = "osD^vPX*<>ph"
DASHES = {"observational": ":", "interventional": "-", "paired": "--"}
GREY = "#8A8F98"  # of baselines
ACROSS = 4  # problems side by side
SCORES = (("shd", "SHD (0 is best)"), ("f1", "F1 (1 is best)"))


@styled
def draw_budgets(result: BenchmarkResult) -> Figure:
    """Draw SHD and F1 against the budget, two panels per problem.

    Bars reach from the lowest to the highest seed; baselines are grey. Runs that were not done are
    not drawn; the legend says how many were.
    """
    rows = summary(result)
    lines: dict[tuple[str, str], list[str]] = {}
    for row in (row for found in rows.values() for row in found):
        lines.setdefault((row.run.learner, row.data), []).extend(row.statuses)
    plain = baselines()
    who = sorted({learner for learner, _ in lines}, key=lambda name: (name in plain, name))
    across = max(1, min(ACROSS, len(rows)))
    bands = max(1, math.ceil(len(rows) / across))
    figure = blank(max(8.0, 4.0 * across), 4.3 * bands + 0.4 + 0.12 * len(lines))
    figure.set_layout_engine("constrained")
    axes = figure.subplots(2 * bands, across, squeeze=False)
    handles: dict[str, Any] = {}
    for at, (name, found) in enumerate(rows.items()):
        for part, (key, label) in enumerate(SCORES):
            ax = axes[2 * (at // across) + part, at % across]
            ax.set(title="" if part else f"{name[:33]}…" if len(name) > 34 else name)
            ax.set(xlabel="budget", ylabel=label, xscale="log")
            for place, line in enumerate(sorted(lines, key=lambda at: (who.index(at[0]), at[1]))):
                mine = [row for row in found if (row.run.learner, row.data) == line]
                mine = [row for row in mine if key in row.spreads]
                if mine:
                    aside = 1.0 + 0.1 * ((place + 0.5) / len(lines) - 0.5)
                    done, count = lines[line].count("done"), len(lines[line])
                    some = f" ({done} of {count} runs)" if done < count else ""
                    drawn = _line(ax, mine, key, aside, who.index(line[0]))
                    kind = " (oracle)" * mine[0].is_oracle + " (baseline)" * mine[0].is_baseline
                    handles[", ".join(line) + kind + some] = drawn
            budgets = sorted({row.run.budget for row in found})
            shown = budgets[:: max(1, math.ceil(len(budgets) / 6))]
            ax.minorticks_off()
            ax.set_xticks([max(budget, 0.5) for budget in shown], list(map(str, shown)))
            top = 1.04 if key == "f1" else max(1.0, ax.get_ylim()[1])
            ax.set_ylim(-0.04 * top, top)
            if not ax.lines:
                middle: Any = {"ha": "center", "va": "center", "transform": ax.transAxes}
                ax.text(0.5, 0.5, "no finished run", **middle)
    for ax in axes.flat:
        ax.set_visible(bool(ax.get_xlabel()))
    if handles:
        below: Any = {"loc": "outside lower center", "ncols": 2, "handlelength": 3.6}
        figure.legend(handles.values(), handles.keys(), **below)
    return figure


def _line(ax: Axes, rows: Sequence[SummaryRow], key: str, aside: float, style: int) -> Any:
    """Draw the means of one learner, a little aside so that lines do not hide one another."""
    mean, low, high, _ = zip(*(row.spreads[key] for row in rows), strict=True)
    return ax.errorbar(
        [max(row.run.budget, 0.5) * aside for row in rows],
        mean,
        yerr=np.maximum([np.subtract(mean, low), np.subtract(high, mean)], 0.0),
        color=GREY if rows[0].is_baseline else PALETTE[style % len(PALETTE)],
        linewidth=0.8 if rows[0].is_baseline else None,
        marker=MARKERS[style % len(MARKERS)],
        linestyle=DASHES[rows[0].run.data],
        capsize=2.5,
    )
