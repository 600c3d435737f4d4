"""The table and the picture of a benchmark."""

from __future__ import annotations

import math
from itertools import combinations, product
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.special import stdtrit

from scm_world.discovery.learners.registry import baselines
from scm_world.queries.samples import difference
from scm_world.runs.canvas import MARKERS, PALETTE, blank, styled

if TYPE_CHECKING:
    import pandas
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
    and the largest number, ``_n`` is how many there are, ``_from`` and ``_to`` are the ends of the
    95 % interval of the mean (Student's t over seeds, cut off at 0, of rates also at 1; NaN for a
    single seed). ``shd_standardised`` is the SHD of the standardised runs, which count for nothing
    else. ``seeds`` is how many were started, ``done``, ``timeout`` and ``failed`` are how they
    ended. Trivial baselines follow the learners, oracles with access to the simulator come last.
    """
    frame = result.to_dataframe()
    scaled, done = frame.standardised.astype(bool), frame.status == "done"
    scores = [column.key for column in COLUMNS if column.key in frame]
    numbers = frame[scores].astype(float).where(done & ~scaled, math.nan)
    if "shd" in scores and scaled.any():
        numbers[STANDARDISED] = frame.shd.astype(float).where(done & scaled)
    keys = [frame[key] for key in KEYS]
    means = numbers.groupby(keys).agg(["mean", "min", "max", "count", "sem"])
    names = {"mean": "", "min": "_low", "max": "_high", "count": "_n", "sem": "_from"}
    means.columns = [f"{score}{names[what]}" for score, what in means.columns]
    rates = {column.key for column in COLUMNS if column.digits}
    for score in numbers:
        reach = stdtrit(means[f"{score}_n"] - 1.0, 0.975) * means[f"{score}_from"]
        means[f"{score}_from"] = (means[score] - reach).clip(lower=0.0)
        means[f"{score}_to"] = (means[score] + reach).clip(upper=1.0 if score in rates else None)
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


def comparison(result: BenchmarkResult) -> Any:
    """Compare learners from data by F1, seed by seed: each pair, and each with the best baseline.

    Returns:
        A frame with a row for each problem, kind of data, budget and pair: ``learner`` and
        ``other``, their mean F1 over the common seeds, the mean ``difference`` with its 95 %
        interval ``low`` to ``high`` (of the differences in each seed; NaN for one seed), how many
        ``seeds`` there are, whether the other one is ``trivial``, and the ``verdict``.
    """
    import pandas

    keys = [*KEYS[:2], "budget"]
    columns = [*keys, "learner", "other", "f1", "f1_other", "difference", "low", "high", "seeds"]
    frame, rows = result.to_dataframe().reindex(columns=[*KEYS, "seed", "standardised", "f1"]), []
    kept = frame.f1.notna() & ~frame.standardised.astype(bool) & (frame.data != "paired")
    for key, cell in frame[kept].groupby(keys, sort=False):
        f1 = cell.pivot(index="seed", columns="learner", values="f1").astype(float)
        trivial = f1[[who for who in f1 if who in baselines()]]
        learners = [who for who in f1 if who not in trivial]
        best = [] if trivial.empty else [trivial.mean().idxmax()]
        for one, other in (*combinations(learners, 2), *product(learners, best)):
            a, b = f1[[one, other]].dropna().to_numpy().T
            if len(a):
                apart, low, high = a.mean() - b.mean(), math.nan, math.nan
                if len(a) > 1:
                    apart, low, high, _ = map(float, difference(a, b, paired=True))
                same = low <= 0.0 <= high or apart == 0.0 or len(a) == 1
                verdict = "no difference is shown" if same else "better" if apart > 0 else "worse"
                numbers = a.mean(), b.mean(), apart, low, high, len(a)
                rows.append((*key, one, other, *numbers, other in best, verdict))
    return pandas.DataFrame(rows, columns=[*columns, "trivial", "verdict"])


def trivial_answers(result: BenchmarkResult) -> list[str]:
    """List for which problems and data no learner is better than the best trivial baseline."""
    found, rows = [], comparison(result)
    rows = rows[rows.trivial & (rows.budget == rows.budget.max())]
    for (name, data), each in rows.groupby(KEYS[:2], sort=False):
        best = each.loc[each.difference.idxmax()]
        if best.difference <= 0.0:
            ends = "" if math.isnan(best.low) else f" [{best.low:.2f}, {best.high:.2f}]"
            found.append(
                f"{name}, {data}: a trivial answer is best: {best.other} has a mean F1 of "
                f"{best.f1_other:.2f}, {best.learner} of {best.f1:.2f}; difference "
                f"{best.difference:.2f}{ends} over {best.seeds} seeds. These scores do not show "
                "that anything was learned."
            )
    return found


ENDS = ("done", "timeout", "failed")
"""How a run can end."""


def text(row: pandas.Series[Any], column: ScoreColumn) -> str:
    """Write a mean of a summary, and how many seeds have the number if not all have it.

    F1 is followed by its 95 % interval over the seeds.
    """
    value = row.get(column.key)
    if value is None or math.isnan(value):
        return "–"
    if column.digits is not None:
        said = f"{value:.{column.digits}f}"
    else:
        is_round = abs(value) >= 1000 or float(value).is_integer()
        said = f"{value:.0f}" if is_round else f"{value:.3g}"
    if column.key == "f1" and row.f1_from < row.f1_to:
        said += f" [{row.f1_from:.2f}, {row.f1_to:.2f}]"
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
        figure.legend(
            handles.values(), handles.keys(), loc="outside lower center", ncols=3, handlelength=3.6
        )
    return figure
