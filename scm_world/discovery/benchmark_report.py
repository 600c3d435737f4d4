"""Tables, the picture and the report of a benchmark."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from itertools import groupby
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, final

from scm_world.discovery.benchmarks import BenchmarkResult, Run
from scm_world.discovery.learners.found import Found
from scm_world.discovery.problems import GroundTruth
from scm_world.output.canvas import FAINT, PALETTE, blank, save, small_png
from scm_world.output.durable import write_whole
from scm_world.output.locations import Location
from scm_world.output.pages import Entry, facts, folded, page, picture, section, table
from scm_world.queries.experiments.effects import EdgeKey

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


class Column(NamedTuple):
    """A number that is shown of every group of runs: its key, its title, which way is better."""

    key: str
    title: str
    better: Literal["less", "more", ""] = ""
    digits: int | None = None


STANDARDISED = "shd_standardised"
COLUMNS = (
    Column("shd", "SHD", "less"),
    Column(STANDARDISED, "SHD standardised", "less"),
    Column("f1", "F1", "more", 2),
    Column("precision", "precision", "more", 2),
    Column("recall", "recall", "more", 2),
    Column("auprc", "AUPRC", "more", 2),
    Column("auroc", "AUROC", "more", 2),
    Column("sid", "SID", "less"),
    Column("effect_rmse", "effect RMSE", "less"),
    Column("seconds", "seconds"),
    Column("experiments", "experiments"),
    Column("bound", "bound"),
)

# --- tables ---------------------------------------------------------------------------------------


class Spread(NamedTuple):
    """The mean of some numbers, the smallest, the largest, and how many they are."""

    mean: float
    low: float
    high: float
    n: int


@final
@dataclass(frozen=True)
class Row:
    """The runs of a learner on a problem with one kind of data and one budget.

    Attributes:
        problem: Name of the problem.
        data: Kind of data.
        learner: Name of the learner.
        budget: Rows, episodes or experiments.
        standardised: Whether all numbers are of standardised data, as there are no others.
        statuses: How the runs ended.
        spreads: By key of a column; those that exist.
    """

    problem: str
    data: str
    learner: str
    budget: int
    standardised: bool
    statuses: tuple[str, ...]
    spreads: dict[str, Spread]

    @property
    def line(self) -> str:
        """What a line of the picture stands for."""
        return f"{self.learner}, {self.data}" + ", standardised" * self.standardised

    @property
    def heads(self) -> tuple[str, str, str, str, str]:
        """What stands before the numbers."""
        ended = [f"{self.statuses.count('done')} of {len(self.statuses)}"]
        for status, words in (("timeout", "timed out"), ("failed", "failed")):
            if status in self.statuses:
                ended.append(f"{self.statuses.count(status)} {words}")
        data = self.data + ", standardised" * self.standardised
        return (self.problem, data, self.learner, str(self.budget), ", ".join(ended))

    def text(self, column: Column) -> str:
        """Write one number."""
        spread = self.spreads.get(column.key)
        if spread is None:
            return NONE
        low, high = number(spread.low, column), number(spread.high, column)
        text = number(spread.mean, column) + (f" [{low}, {high}]" if low != high else "")
        return text + (f" (n = {spread.n})" if spread.n < len(self.statuses) else "")


def number(value: float | None, column: Column) -> str:
    """Write a number with the digits of its column."""
    if value is None:
        return NONE
    if column.digits is not None:
        return f"{value:.{column.digits}f}"
    return f"{value:.0f}" if abs(value) >= 1000 or float(value).is_integer() else f"{value:.3g}"


def summary(result: BenchmarkResult) -> dict[str, list[Row]]:
    """Take the seeds together.

    Returns:
        By problem a row per kind of data, learner and budget, in this order.
    """
    rows: dict[str, list[Row]] = {name: [] for name in result.problems}

    def key(run: Run) -> tuple[str, str, str, int]:
        return (run.problem, run.data, run.learner, run.budget)

    for _, group in groupby(sorted(result.runs, key=key), key):
        runs = list(group)
        scaled = [run for run in runs if run.standardised]
        shown = [run for run in runs if not run.standardised] or scaled
        spreads = {
            STANDARDISED: _spread(run.scores.get("shd") for run in scaled if run.status == "done")
        }
        for column in COLUMNS:
            if column.key != STANDARDISED:
                values = (run.record.get(column.key) for run in shown if run.status == "done")
                spreads[column.key] = _spread(values)
        first = shown[0]
        statuses = tuple(run.status for run in shown)
        known = {name: spread for name, spread in spreads.items() if spread is not None}
        rows[first.problem].append(
            Row(first.problem, first.data, first.learner, first.budget, first.standardised,
                statuses, known)
        )  # fmt: skip
    return rows


def _spread(values: Iterable[float | None]) -> Spread | None:
    known = [float(value) for value in values if value is not None]
    return Spread(sum(known) / len(known), min(known), max(known), len(known)) if known else None


def best(rows: Sequence[Row]) -> set[tuple[int, str]]:
    """Find the best numbers of one problem.

    A mean over fewer seeds than were started is not compared: the hard ones may be missing.

    Returns:
        Number of the row and key of the column; several if they are equally good, none if all are.
    """
    found: set[tuple[int, str]] = set()
    for column in COLUMNS:
        means = {
            at: row.spreads[column.key].mean
            for at, row in enumerate(rows)
            if column.key in row.spreads and row.spreads[column.key].n == len(row.statuses)
        }
        if column.better and len(set(means.values())) > 1:
            top = min(means.values()) if column.better == "less" else max(means.values())
            found |= {(at, column.key) for at, mean in means.items() if mean == top}
    return found


def counted(result: BenchmarkResult) -> str:
    """Say how many runs there are and how they ended."""
    ends = [run.status for run in result.runs]
    return (
        f"{len(result.problems)} problem{'s' * (len(result.problems) != 1)}, "
        f"{len({run.learner for run in result.runs})} learners, "
        f"{len(ends)} runs: {ends.count('done')} done, "
        f"{ends.count('timeout')} timed out, {ends.count('failed')} failed"
    )


def write_files(result: BenchmarkResult, folder: Location) -> None:
    """Write ``results.csv``, ``results.md``, ``budget.png`` and ``report.html``.

    A missing number is an empty field of the first, and a dash in the second.
    """
    write_whole(_csv(result), folder / "results.csv")
    write_whole(_markdown(result), folder / "results.md")
    save(draw_budgets(result), folder / "budget.png")
    write_whole(report(result), folder / "report.html")


def _csv(result: BenchmarkResult) -> str:
    given = {name for run in result.runs for name in run.scores}
    shown = [column.key for column in COLUMNS if column.key in given]
    stream = io.StringIO()
    names = [*FACTS, *COSTS, *shown, *sorted(given - set(shown))]
    writer = csv.DictWriter(stream, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(result.records)
    return stream.getvalue()


def _markdown(result: BenchmarkResult) -> str:
    lines = ["# Results of the benchmark", "", f"{counted(result)}. {NOTE}"]
    for name, rows in summary(result).items():
        truth, bold = result.problems[name], best(rows)
        size = f"{len(truth.names)} variables, {len(truth.edges)} edges"
        lines += ["", f"## {_safe(name)}", "", size, ""]
        if not rows:
            lines.append("No runs.")
            continue
        titles = [*HEADS[1:], *(column.title for column in COLUMNS)]
        lines.append(f"| {' | '.join(titles)} |")
        lines.append(f"|{'|'.join('---' if t in HEADS[1:3] else '---:' for t in titles)}|")
        for at, row in enumerate(rows):
            numbers = (
                f"**{row.text(c)}**" if (at, c.key) in bold else row.text(c) for c in COLUMNS
            )
            lines.append(f"| {' | '.join([*map(_safe, row.heads[1:]), *numbers])} |")
    return "\n".join(lines) + "\n"


def _safe(text: str) -> str:
    """Escape what means something in Markdown."""
    escaped = re.sub(r"([\\|*`\[\]])", r"\\\1", " ".join(text.split()))
    return escaped.replace("&", "&amp;").replace("<", "&lt;")


# --- the picture ----------------------------------------------------------------------------------

MARKERS = "osD^vPX*<>ph"
DASHES = {"observational": ":", "interventional": "-", "paired": "--"}
ACROSS = 4  # problems side by side


def draw_budgets(result: BenchmarkResult) -> Figure:
    """Draw SHD and F1 against the budget, two panels per problem.

    Bars reach from the lowest to the highest seed. Runs that were not done are not drawn; the
    legend says how many were.
    """
    rows = summary(result)
    every = [row for found in rows.values() for row in found]
    names = sorted({row.line for row in every})
    learners = sorted({row.learner for row in every})
    across = max(1, min(ACROSS, len(rows)))
    bands = max(1, math.ceil(len(rows) / across))
    figure = blank()
    figure.set_size_inches(max(8.0, 4.0 * across), 4.3 * bands + 0.4 + 0.26 * len(names) / 2)
    figure.set_layout_engine("constrained")
    axes = figure.subplots(2 * bands, across, squeeze=False)
    for ax in axes.flat:
        ax.set_visible(False)
    handles: dict[str, Any] = {}
    for at, (name, found) in enumerate(rows.items()):
        pair = axes[2 * (at // across) : 2 * (at // across) + 2, at % across]
        pair[0].set_title(name if len(name) <= 34 else f"{name[:33]}…", parse_math=False)
        for ax, key, label in zip(pair, ("shd", "f1"), ("SHD (0 is best)", "F1 (1 is best)"),
                                  strict=True):  # fmt: skip
            ax.set_visible(True)
            for line in names:
                mine = [row for row in found if row.line == line and key in row.spreads]
                aside = (names.index(line) + 0.5) / len(names) - 0.5
                style = learners.index(mine[0].learner) if mine else 0
                if mine:
                    handles[line] = _line(ax, mine, key, 1.0 + 0.1 * aside, style)
            _finish(ax, label, sorted({row.budget for row in found}))
            top = 1.04 if key == "f1" else max(1.0, ax.get_ylim()[1])
            ax.set_ylim(-0.04 * top, top)
    labels = [_label(line, [row for row in every if row.line == line]) for line in handles]
    if handles:
        legend = figure.legend(
            handles.values(), labels, ncols=2, loc="outside lower center", frameon=False,
            handlelength=3.6,
        )  # fmt: skip
        for text in legend.get_texts():
            text.set_parse_math(False)
    return figure


def _line(ax: Axes, rows: Sequence[Row], key: str, aside: float, style: int) -> Any:
    """Draw the means of one learner, a little aside so that lines do not hide one another."""
    spreads = [row.spreads[key] for row in rows]
    return ax.errorbar(
        [max(row.budget, 0.5) * aside for row in rows],
        [spread.mean for spread in spreads],
        yerr=[
            [max(spread.mean - spread.low, 0.0) for spread in spreads],
            [max(spread.high - spread.mean, 0.0) for spread in spreads],
        ],
        color=PALETTE[style % len(PALETTE)],
        marker=MARKERS[style % len(MARKERS)],
        linestyle=DASHES[rows[0].data],
        capsize=2.5,
    )


def _finish(ax: Axes, label: str, budgets: Sequence[int]) -> None:
    ax.set_ylabel(label)
    ax.grid(color=FAINT, lw=0.5)
    ax.set_axisbelow(True)
    ax.set_xscale("log")
    ax.minorticks_off()
    shown = budgets[:: max(1, math.ceil(len(budgets) / 6))]
    ax.set_xticks([max(b, 0.5) for b in shown], [str(b) for b in shown])
    ax.set_xlabel("budget")
    if not ax.lines:
        ax.text(0.5, 0.5, "no finished run", ha="center", va="center", transform=ax.transAxes)


def _label(line: str, rows: Sequence[Row]) -> str:
    statuses = [status for row in rows for status in row.statuses]
    done = statuses.count("done")
    return line + (f" ({done} of {len(statuses)} runs)" if done < len(statuses) else "")


# --- the report -----------------------------------------------------------------------------------

VERDICTS = {
    "correct": ("●", "true and found", "#0072B2"),
    "missing": ("−", "true, not found", "#B34700"),
    "extra": ("+", "found, not true", "#B0508C"),
    "reversed": ("⇄", "found the other way round", "#00785A"),
    "undirected": ("?", "true, found without direction", "#222222"),
    "unscored": ("∘", "not scored", "#6B7280"),
}
"""The sign in a matrix, what it means, and its color; each sign alone is enough."""
NAMED = 25  # wrong edges of a kind that are named in words
STYLE = (
    "table.graph td,table.graph th{padding:0;width:14px;min-width:14px;height:14px;font-size:10px;"
    "line-height:14px;text-align:center;border:1px solid #dde1e7;white-space:nowrap}"
    "table.graph tbody th{text-align:right;padding:0 4px}"
    "table.graph thead th{writing-mode:vertical-rl;text-align:left;padding:4px 0;height:auto}"
    "table.graph td{font-size:13px;font-weight:bold;cursor:default}"
    + "".join(f".{name}{{color:{color}}}" for name, (_, _, color) in VERDICTS.items())
)


class Link(NamedTuple):
    """An edge and its verdict; one without direction has its true direction, if it has one."""

    cause: str
    effect: str
    lag: int
    verdict: str
    directed: bool = True

    @property
    def words(self) -> str:
        """Cause, effect and lag in words.

        Example:
            >>> Link("x", "y", 1, "extra").words
            'x → y, t−1'
        """
        between = "→" if self.directed else "—"
        return f"{self.cause} {between} {self.effect}" + f", t−{self.lag}" * (self.lag > 0)


def compare(truth: GroundTruth, found: Found) -> list[Link]:
    """Compare an estimated graph with the true one, edge by edge.

    Args:
        truth: The true graph.
        found: Over the same variables; others of it are left out.

    Returns:
        One link per edge, sorted. A reversed edge is one link, in the direction that was found.

    Example:
        >>> edges = (("x", "y", 0), ("y", "z", 0))
        >>> truth = GroundTruth(name="chain", names=("x", "y", "z"), edges=edges)
        >>> links = compare(truth, Found.of_edges(["x", "y", "z"], [("y", "x", 0), ("x", "z", 1)]))
        >>> [(link.words, link.verdict) for link in links]
        [('x → z, t−1', 'extra'), ('y → x', 'reversed'), ('y → z', 'missing')]
    """
    kept = found.restricted(truth.names)
    missing, directed = set(truth.edges), set(kept.directed)
    links: list[Link] = []
    for one, other in kept.undirected:
        ways: list[EdgeKey] = [(one, other, 0), (other, one, 0)]
        known = next((way for way in ways if way in missing), None)
        verdict = "extra" if known is None else "undirected"
        links.append(Link(*(known or ways[0]), verdict, directed=False))
        missing -= set(ways)
    for cause, effect, lag in directed:
        key, back = (cause, effect, lag), (effect, cause, lag)
        if key in missing:
            verdict = "correct"
        elif lag == 0 and back in missing and back not in directed:
            verdict = "reversed"
        else:
            verdict = "extra"
        links.append(Link(*key, verdict))
        missing -= {back} if verdict == "reversed" else {key}
    links += [Link(*key, "missing") for key in missing]
    apart = {frozenset(pair) for pair in truth.unscored}
    return sorted(
        link._replace(verdict="unscored") if {*link[:2]} in apart else link for link in links
    )


def report(result: BenchmarkResult) -> str:
    """Write the report as one HTML page that needs no network.

    It has the tables, the picture of the budgets, and of each learner on each problem, at the
    largest budget with the first seed, the estimated graph compared with the true one.
    """
    alt = (
        "Line charts: SHD and F1 against the budget, two panels per problem, a line per learner. "
        "The numbers are those of the summary."
    )
    caption = "Means; bars from the lowest to the highest seed."
    drawn = picture(small_png(draw_budgets(result)), alt, caption)
    parts = [_summary(result), section("budget", "Scores against the budget", drawn)]
    contents = [("summary", "Summary"), ("budget", "Budget")]
    for at, name in enumerate(result.problems):
        parts.append(section(f"s{at}", name, _problem(result, name)))
        contents.append((f"s{at}", name))
    parts.append(section("about", "About this benchmark", facts(result.settings)))
    lead = f"{counted(result)}."
    return page("Benchmark of learners", parts, lead=lead, contents=contents, extra_style=STYLE)


def _summary(result: BenchmarkResult) -> str:
    lines: list[list[Entry]] = []
    for rows in summary(result).values():
        bold = best(rows)
        for at, row in enumerate(rows):
            done = Entry(row.heads[-1], by=str(row.statuses.count("done")))
            line = [*map(Entry, row.heads[:-1]), done]
            for column in COLUMNS:
                spread = row.spreads.get(column.key)
                value = "" if spread is None else f"{spread.mean:.6g}"
                looks = "best" if (at, column.key) in bold else ""
                line.append(Entry(row.text(column), by=value, looks=looks))
            lines.append(line)
    titles = [*HEADS, *(column.title for column in COLUMNS)]
    whole = table(titles, lines, left=3, sortable=True)
    return section("summary", "Summary", f"<p>{escape(NOTE)}</p>{whole}")


def _problem(result: BenchmarkResult, name: str) -> str:
    truth = result.problems[name]
    size = f"{len(truth.names)} variables, {len(truth.edges)} true edges"
    if truth.unscored:
        size += f", {len(truth.unscored)} pairs not scored"
    legend = "".join(
        f'<li><b class="{verdict}">{sign}</b> {verdict}: {words}</li>'
        for verdict, (sign, words, _) in VERDICTS.items()
    )
    inside = f"<p>{size}. Rows are causes, columns are effects; a digit is the lag.</p>"
    inside += f'{facts(truth.about)}<ul class="legend">{legend}</ul>'
    groups: dict[tuple[str, str, bool], Run] = {}
    for run in result.runs:
        if run.problem == name:
            key = (run.learner, run.data, run.standardised)
            groups[key] = max(groups.get(key, run), run, key=lambda r: (r.budget, -r.seed))
    for (who, data, even), run in groups.items():
        inside += f"<h3>{escape(f'{who}, {data}' + ', standardised' * even)}</h3>"
        inside += _run(result.truth_of(run), run)
    return inside


def _run(truth: GroundTruth, run: Run) -> str:
    said = f"budget {run.budget}, seed {run.seed}"
    if run.found is None:
        why = f"{run.status}: {run.message}" if run.message else run.status
        return f"<p>{escape(f'{said}. No graph: {why}')}</p>"
    for column in COLUMNS:
        if column.key in ("shd", "f1", "precision", "recall"):
            said += f", {column.title} {number(run.scores.get(column.key), column)}"
    links = compare(truth, run.found)
    named = {}
    for verdict in ("missing", "extra", "reversed", "undirected"):
        words = [link.words for link in links if link.verdict == verdict]
        more = f"; … and {len(words) - NAMED} more" if len(words) > NAMED else ""
        if words:
            named[f"{len(words)} {verdict}"] = "; ".join(words[:NAMED]) + more
    listed = folded("Wrong edges in words", facts(named)) if named else ""
    return f"<p>{escape(said)}</p>{matrix(truth.names, links)}{listed}"


def matrix(names: Sequence[str], links: Iterable[Link]) -> str:
    """Write compared edges as a table: a sign and the lag where a cause meets an effect."""
    cells: dict[tuple[str, str], list[Link]] = {}
    for link in links:
        for cell in [link[:2]] if link.directed else [link[:2], link[1::-1]]:
            cells.setdefault(cell, []).append(link)
    lines = []
    for cause in names:
        line = [f'<tr><th scope="row">{escape(cause)}</th>']
        for effect in names:
            found = cells.get((cause, effect), [])
            title = escape("; ".join(f"{link.words}: {link.verdict}" for link in found))
            signs = "".join(
                f'<b class="{link.verdict}">{VERDICTS[link.verdict][0]}{link.lag or ""}</b>'
                for link in found
            )
            line.append(f'<td title="{title}">{signs}</td>' if found else "<td></td>")
        lines.append("".join(line) + "</tr>")
    heads = "".join(f'<th scope="col">{escape(name)}</th>' for name in names)
    head = f"<thead><tr><td></td>{heads}</tr></thead>"
    body = f"<tbody>{''.join(lines)}</tbody>"
    return f'<div class="wide"><table class="graph">{head}{body}</table></div>'
