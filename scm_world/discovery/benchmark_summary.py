"""The table and the picture of a benchmark."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from scm_world.discovery.learners.registry import baselines
from scm_world.runs.canvas import PALETTE, blank, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from scm_world.discovery.benchmarks import BenchmarkResult

KEYS = ["problem", "data", "learner", "budget"]
"""The runs that differ in the seed only are one row of a summary."""
STANDARDISED = "shd_standardised"


class ScoreColumn(NamedTuple):
    """A number of every group of runs: its key, its title, its decimal places."""

    key: str
    title: str
    digits: int | None = None


COLUMNS = (
    ScoreColumn("shd", "SHD"),
    ScoreColumn(STANDARDISED, "SHD standardised"),
    ScoreColumn("f1", "F1", 2),
    ScoreColumn("precision", "precision", 2),
    ScoreColumn("recall", "recall", 2),
    ScoreColumn("auprc", "AUPRC", 2),
    ScoreColumn("auroc", "AUROC", 2),
    ScoreColumn("sid", "SID"),
    ScoreColumn("pag_distance", "PAG distance"),
    ScoreColumn("adjacency_f1", "adjacency F1", 2),
    ScoreColumn("head_f1", "heads F1", 2),
    ScoreColumn("tail_f1", "tails F1", 2),
    ScoreColumn("targets", "targets found", 2),
    ScoreColumn("variance_sortability", "varsortability", 2),
    ScoreColumn("r2_sortability", "R²-sortability", 2),
    ScoreColumn("seconds", "seconds"),
    ScoreColumn("experiments", "experiments"),
    ScoreColumn("bound", "bound"),
)


def summary(result: BenchmarkResult) -> Any:
    """Take the seeds together: a frame with a row per problem, kind of data, learner and budget.

    Each score is the mean over the seeds that were done; ``_low`` and ``_high`` are the smallest
    and the largest number, ``_n`` is how many there are. ``shd_standardised`` is the SHD of the
    standardised runs, which count for nothing else. ``seeds`` is how many were started, ``done``,
    ``timeout`` and ``failed`` are how they ended. Trivial baselines follow the learners, oracles
    with access to the simulator come last.
    """
    frame = result.to_dataframe()
    scaled, done = frame.standardised.astype(bool), frame.status == "done"
    scores = [column.key for column in COLUMNS if column.key in frame]
    numbers = frame[scores].astype(float).where(done & ~scaled, math.nan)
    if "shd" in scores and scaled.any():
        numbers[STANDARDISED] = frame.shd.astype(float).where(done & scaled)
    keys = [frame[key] for key in KEYS]
    means = numbers.groupby(keys).agg(["mean", "min", "max", "count"])
    names = {"mean": "", "min": "_low", "max": "_high", "count": "_n"}
    means.columns = [f"{score}{names[what]}" for score, what in means.columns]
    ends = frame[~scaled].groupby(KEYS)["status"]
    found = ends.agg(
        seeds="size", **{end: lambda column, end=end: (column == end).sum() for end in ENDS}
    )
    found = found.join(means).reset_index()
    found["oracle"] = found.data == "paired"
    found["baseline"] = found.learner.isin(baselines())
    found["place"] = found.problem.map({name: i for i, name in enumerate(result.problems)})
    order = ["place", "oracle", "data", "baseline", "learner", "budget"]
    return found.sort_values(order).drop(columns="place").reset_index(drop=True)


ENDS = ("done", "timeout", "failed")
"""How a run can end."""


def text(row: Any, column: ScoreColumn) -> str:
    """Write a mean of a summary, and how many seeds have the number if not all have it."""
    value = row.get(column.key)
    if value is None or math.isnan(value):
        return "–"
    if column.digits is not None:
        said = f"{value:.{column.digits}f}"
    else:
        is_round = abs(value) >= 1000 or float(value).is_integer()
        said = f"{value:.0f}" if is_round else f"{value:.3g}"
    count = int(row[f"{column.key}_n"])
    return said + (f" (n = {count})" if count < row.seeds else "")


def size(result: BenchmarkResult, name: str) -> str:
    """Return the size of the graph of a problem in words; a range where seeds differ."""
    first = result.problems[name]
    scores = [run.scores for run in result.runs if run.problem == name and run.scores]

    def many(key: str, of_first: int) -> str:
        counts = {int(found[key] or 0) for found in scores} or {of_first}
        return f"{min(counts)} to {max(counts)}" if len(counts) > 1 else f"{min(counts)}"

    said = f"{len(first.names)} variables, {many('true_edges', len(first.edges))} true edges"
    hidden = many("confounded", len(first.confounded))
    said += f", {hidden} pairs with hidden causes" * (hidden != "0")
    return said + f", {len(first.unscored)} pairs not scored" * bool(first.unscored)


# --- the picture ----------------------------------------------------------------------------------

MARKERS = "osD^vPX*<>ph"
DASHES = {"observational": ":", "interventional": "-", "paired": "--"}
GREY = "#8A8F98"  # of baselines
SCORES = (("shd", "SHD (0 is best)"), ("f1", "F1 (1 is best)"))


@styled
def draw_budgets(result: BenchmarkResult) -> Figure:
    """Draw SHD and F1 against the budget, a row of two panels per problem.

    Bars reach from the lowest to the highest seed; baselines are grey. Runs that were not done are
    not drawn; the legend says how many were.
    """
    rows, plain = summary(result), baselines()
    who = sorted(set(rows.learner), key=lambda name: (name in plain, name))
    lines = rows.groupby(["learner", "data"])[["done", "seeds"]].sum().reset_index()
    figure = blank(height=3.5 * max(1, len(result.problems)) + 0.4 + 0.12 * len(lines))
    figure.set_layout_engine("constrained")
    handles: dict[str, Any] = {}
    for at, name in enumerate(result.problems):
        for part, (key, label) in enumerate(SCORES):
            ax = figure.add_subplot(len(result.problems), 2, 2 * at + part + 1)
            ax.set(title=name, xlabel="budget", ylabel=label, xscale="log")
            for place, line in enumerate(lines.itertuples()):
                mine = (rows.problem == name) & (rows.learner == line.learner)
                of = rows[mine & (rows.data == line.data)]
                of = of[of[key].notna()] if key in of else of[:0]
                if of.empty:
                    continue
                style, grey = who.index(line.learner), line.learner in plain
                aside = 1.0 + 0.1 * ((place + 0.5) / len(lines) - 0.5)  # so that all are seen
                low, high = of[key] - of[f"{key}_low"], of[f"{key}_high"] - of[key]
                drawn = ax.errorbar(
                    np.maximum(of.budget, 0.5) * aside,
                    of[key],
                    yerr=np.maximum([low, high], 0.0),
                    color=GREY if grey else PALETTE[style % len(PALETTE)],
                    linewidth=0.8 if grey else None,
                    marker=MARKERS[style % len(MARKERS)],
                    linestyle=DASHES[line.data],
                    capsize=2.5,
                )
                some = f" ({line.done} of {line.seeds} runs)" if line.done < line.seeds else ""
                kind = " (oracle)" * (line.data == "paired") + " (baseline)" * grey
                handles[f"{line.learner}, {line.data}{kind}{some}"] = drawn
            top = 1.04 if key == "f1" else max(1.0, ax.get_ylim()[1])
            ax.set_ylim(-0.04 * top, top)
    if handles:
        below: Any = {"loc": "outside lower center", "ncols": 3, "handlelength": 3.6}
        figure.legend(handles.values(), handles.keys(), **below)
    return figure
