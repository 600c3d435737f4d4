"""Scores against the budget, as one picture. matplotlib is loaded when it is drawn."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, final

from scm_world.discovery.exam.results import Exam
from scm_world.discovery.exam.tables import Row, by_subject, table_rows
from scm_world.output.canvas import FAINT, INK, PALETTE, blank, save, small_png
from scm_world.output.locations import Location

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

MARKERS = "osD^vPX*<>ph"
DASHES: Mapping[str, Any] = {"see": (0, (1.5, 1.5)), "do": "solid", "paired": (0, (5, 2))}
ACROSS = 4  # subjects side by side
BAND, PANEL = 4.3, 4.0  # [inches]: height and width of the panels of a subject
TOP, KEY, LEFT = 0.55, 0.26, 0.75  # [inches]: above all, a line of the legend, left of all
DODGE = 0.16  # of the way to the next budget, that lines are moved apart
TICKS = 6  # budgets that are written below an axis
LONGEST = 34  # letters of a title above a panel

Way = tuple[str, str, bool]
"""Learner, kind of data, whether standardised: what a line stands for."""


@final
class _Looks:
    """How each line looks: color and marker say the learner, dashes the kind of data."""

    def __init__(self, rows: Iterable[Row]) -> None:
        kept = list(rows)
        self.ways: list[Way] = sorted({_way(row) for row in kept})
        self._learners = sorted({way[0] for way in self.ways})
        self._counts = {
            way: tuple(sum(getattr(r, what) for r in kept if _way(r) == way) for what in _ENDS)
            for way in self.ways
        }

    def style(self, way: Way) -> dict[str, Any]:
        """Give the arguments of a line."""
        number = self._learners.index(way[0])
        return {
            "color": PALETTE[number % len(PALETTE)],
            "marker": MARKERS[number % len(MARKERS)],
            "linestyle": DASHES[way[1]],
            "markersize": 6.0,
            "linewidth": 1.5,
        }

    def label(self, way: Way) -> str:
        """Name a line, and say how many of its runs it shows."""
        done, seeds = self._counts[way]
        some = f" ({done} of {seeds} runs)" if done < seeds else ""
        return f"{way[0]}, {way[1]}{', standardised' if way[2] else ''}{some}"

    def aside(self, way: Way) -> float:
        """Give the place of a line among the others, in [-1/2, 1/2]."""
        return (self.ways.index(way) + 0.5) / len(self.ways) - 0.5


_ENDS = ("done", "seeds")


def _way(row: Row) -> Way:
    return (row.learner, row.data, row.standardised)


def draw_budget(exam: Exam, path: Location | str) -> None:
    """Draw SHD and F1 against the budget, two panels per subject.

    Bars reach from the lowest to the highest seed. Runs that were not done are not drawn; the
    legend says how many were.

    Args:
        exam: Any exam; one without a finished run gives empty panels that say so.
        path: Of the PNG.
    """
    save(_figure(exam), path)


def budget_png(exam: Exam) -> bytes:
    """Draw the same with few colors, for a page that holds its pictures in itself."""
    return small_png(_figure(exam))


def _figure(exam: Exam) -> Figure:
    rows = by_subject(exam)
    looks = _Looks(table_rows(exam))
    across = max(1, min(ACROSS, len(rows)))
    bands = max(1, math.ceil(len(rows) / across))
    width = max(8.0, PANEL * across + LEFT)
    columns = _key_columns(looks, width)
    below = KEY * (math.ceil(len(looks.ways) / columns) + 1)
    height = BAND * bands + TOP + below
    figure = blank()
    figure.set_size_inches(width, height)
    grid = figure.add_gridspec(
        bands, across, left=LEFT / width, right=1 - 0.15 / width, top=1 - TOP / height,
        bottom=(below + 0.55) / height, hspace=0.3, wspace=0.28,
    )  # fmt: skip
    for number, (name, found) in enumerate(rows.items()):
        band, column = divmod(number, across)
        inner = grid[band, column].subgridspec(2, 1, hspace=0.08)
        upper = figure.add_subplot(inner[0])
        lower = figure.add_subplot(inner[1], sharex=upper)
        _subject(upper, lower, name, found, looks)
    _legend(figure, looks, columns)
    if not rows:
        figure.text(0.5, 0.5, "no subjects", ha="center", color=INK)
    return figure


def _key_columns(looks: _Looks, width: float) -> int:
    """Count how many entries of the legend stand side by side."""
    longest = max((len(looks.label(way)) for way in looks.ways), default=1)
    return max(1, min(5, int(width / (0.085 * longest + 0.75))))


def _legend(figure: Figure, looks: _Looks, columns: int) -> None:
    from matplotlib.lines import Line2D

    handles: list[Line2D] = [
        Line2D([], [], label=f" {looks.label(way)}", **looks.style(way)) for way in looks.ways
    ]
    if handles:
        made = figure.legend(
            handles=handles, ncol=columns, loc="lower center", frameon=False, fontsize=10,
            handlelength=3.6,
        )  # fmt: skip
        for text in made.get_texts():
            text.set_parse_math(False)


def _subject(upper: Axes, lower: Axes, name: str, rows: Sequence[Row], looks: _Looks) -> None:
    """Draw the two panels of a subject."""
    title = name if len(name) <= LONGEST else f"{name[: LONGEST - 1]}…"
    upper.set_title(title, fontsize=12, weight="bold", color=INK, parse_math=False)
    budgets = sorted({row.budget for row in rows})
    for ax, key, label in ((upper, "shd", "SHD (0 is best)"), (lower, "f1", "F1 (1 is best)")):
        ax.set_ylabel(label, fontsize=10, color=INK)
        ax.grid(color=FAINT, lw=0.5)
        ax.tick_params(colors=INK, labelsize=9)
        ax.set_axisbelow(True)
        for way in looks.ways:
            _line(ax, [row for row in rows if _way(row) == way], key, looks, budgets)
        if not ax.lines:
            place: dict[str, Any] = {"ha": "center", "va": "center", "transform": ax.transAxes}
            ax.text(0.5, 0.5, "no finished run", color=INK, **place)
    _axes(upper, lower, budgets)


def _line(ax: Axes, rows: Sequence[Row], key: str, looks: _Looks, budgets: Sequence[int]) -> None:
    known = [(row, row.spreads[key]) for row in rows if key in row.spreads]
    if not known:
        return
    way = _way(known[0][0])
    factor = math.exp(2 * DODGE * _gap(budgets) * looks.aside(way))
    means = [spread.mean for _, spread in known]
    ends = [
        [mean - spread.low for mean, (_, spread) in zip(means, known, strict=True)],
        [spread.high - mean for mean, (_, spread) in zip(means, known, strict=True)],
    ]
    at = [_x(row.budget) * factor for row, _ in known]
    ends = [[max(end, 0.0) for end in side] for side in ends]
    ax.errorbar(at, means, yerr=ends, elinewidth=1.0, capsize=2.5, **looks.style(way))


def _gap(budgets: Sequence[int]) -> float:
    """Give the smallest way from a budget to the next one, as a logarithm."""
    return min((math.log(b / a) for a, b in pairwise(map(_x, budgets))), default=1.0)


def _x(budget: int) -> float:
    """Give the place of a budget; nothing at all is drawn at a half, as there is no log of 0."""
    return max(float(budget), 0.5)


def _axes(upper: Axes, lower: Axes, budgets: Sequence[int]) -> None:
    lower.set_xscale("log")
    lower.minorticks_off()
    step = max(1, math.ceil(len(budgets) / TICKS))
    shown = budgets[::step]
    lower.set_xticks([_x(budget) for budget in shown], [str(budget) for budget in shown])
    upper.tick_params(labelbottom=False)
    lower.set_xlabel("budget", fontsize=10, color=INK)
    if budgets:
        first, last = _x(budgets[0]), _x(budgets[-1])
        room = max((last / first) ** 0.12, math.exp(1.4 * DODGE * _gap(budgets)))
        room = room if last > first else 2.0
        lower.set_xlim(first / room, last * room)
    top = max([1.0, upper.get_ylim()[1]] if upper.lines else [1.0])
    upper.set_ylim(-0.04 * top, top)
    lower.set_ylim(-0.04, 1.04)
