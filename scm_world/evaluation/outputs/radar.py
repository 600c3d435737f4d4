"""Mean scores as a radar: an axis for each protocol, the first one up."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, final

import numpy as np

from scm_world._types import Floats
from scm_world.errors import UnknownOption
from scm_world.evaluation.outputs.looks import (
    Line,
    Looks,
    Scores,
    counted,
    intervals,
    is_fraction,
    lines_of,
    metric_words,
    protocol_words,
)
from scm_world.evaluation.outputs.sheets import GAP, MARGIN, Sheet, balanced, text_size, wrapped
from scm_world.evaluation.results import Evaluation
from scm_world.evaluation.statistics import Interval
from scm_world.output.canvas import INK, save
from scm_world.output.locations import Location

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.projections.polar import PolarAxes

TOGETHER = 6  # lines in one radar; with more of them each agent has its own
LARGE, SMALL = 2.4, 1.25  # [inches]: least radius of one radar, and of one of several
NAME, DOC, RING = 10.0, 8.0, 7.0  # [points]
WORDS = 1.3  # [inches]: width of what varies, beside its axis
WIDEST = 20.0  # [inches] of radars side by side
OUT = 0.1  # [inches] from the outer ring to the names


def draw_radar(evaluation: Evaluation, path: Location | str, metric: str | None = None) -> None:
    """Draw the mean scores as polygons, with bands of their 95 % intervals.

    Up to six lines share a radar. With more of them every agent has a radar of its own; none is
    left out. A line is open where its agent did not act in a protocol.

    Args:
        evaluation: With three protocols or more.
        path: Of the PNG. The same evaluation gives the same bytes.
        metric: One of ``METRICS``.

    Raises:
        UnknownOption: There are fewer protocols, or there is no such metric.
        UnwritableFolder: There is no such folder, no room, or no permission.
    """
    save(radar_figure(evaluation, metric), path)


def radar_figure(evaluation: Evaluation, metric: str | None = None) -> Figure:
    """Draw the same for a page."""
    metric = evaluation.metric(metric)
    said, words = metric_words(metric), protocol_words(evaluation)
    if len(words) < 3:
        allowed = ("three protocols or more; draw_bars draws fewer",)
        raise UnknownOption("protocols of a radar", ", ".join(words), allowed)
    looks, scores = Looks(lines_of(evaluation)), intervals(evaluation, metric)
    groups = {"": looks.lines}
    note = f"Means of {counted(evaluation)}; bands are 95 % intervals."
    if len(looks.lines) > TOGETHER:
        groups = {a: [line for line in looks.lines if line.agent == a] for a in looks.agents}
        note += " " + "; ".join(f"{name}: {doc}" for name, doc in words.items() if doc)
        words = dict.fromkeys(words, "")
    return radars(
        groups,
        scores,
        words,
        looks=looks,
        title=f"{evaluation.task}: {said}",
        note=note,
        limits=_limits(scores, metric),
    )


def radars(
    groups: Mapping[str, Sequence[Line]],
    scores: Scores,
    words: Mapping[str, str],
    *,
    looks: Looks,
    title: str,
    note: str = "",
    limits: tuple[float, float] = (0.0, 1.0),
) -> Figure:
    """Draw radars side by side.

    Args:
        groups: The lines of each radar, by its name.
        scores: Of the lines, by line and protocol.
        words: What stands below the name of each protocol.
        looks: Of all lines.
        title: Above all.
        note: Small, below the title.
        limits: Score at the centers and at the rims.
    """
    rim = _rim(words, LARGE if len(groups) == 1 else SMALL)
    titles = {name: wrapped(name, rim.width - 0.2, NAME, bold=True) for name in groups}
    head = max(text_size(t, NAME, bold=True)[1] + GAP if t else 0.0 for t in titles.values())
    across = max(1, min(math.ceil(math.sqrt(len(groups))), int(WIDEST / rim.width)))
    down = math.ceil(len(groups) / across)
    sheet = Sheet(
        across * rim.width + 2 * MARGIN, down * (rim.height + head),
        title=title, note=note, handles=looks.line_key(),
    )  # fmt: skip
    left = (sheet.width - across * rim.width) / 2
    for number, (name, lines) in enumerate(groups.items()):
        row, column = divmod(number, across)
        x, y = left + column * rim.width, row * (rim.height + head)
        if titles[name]:
            middle = x + rim.width / 2
            place = {"ha": "center", "va": "top", "size": NAME, "weight": "bold"}
            sheet.write(middle, sheet.up(y), titles[name], **place)
        _radar(sheet, rim, (x, y + head), lines, looks, scores, limits)
    return sheet.figure


# --- the rim ----------------------------------------------------------------------------------


@final
@dataclass(frozen=True)
class Label:
    """The name of an axis, with its box around the center of the radar [inches], y upward."""

    protocol: str
    name: str
    doc: str
    left: float
    bottom: float
    width: float
    height: float
    align: str

    def meets(self, other: Label) -> bool:
        """Tell whether two boxes come too near to one another."""
        room = 0.04
        return (
            self.left < other.left + other.width + room
            and other.left < self.left + self.width + room
            and self.bottom < other.bottom + other.height + room
            and other.bottom < self.bottom + self.height + room
        )


@final
@dataclass(frozen=True)
class Rim:
    """A radius [inches], and the names around it."""

    radius: float
    labels: tuple[Label, ...]

    @property
    def reach(self) -> tuple[float, float]:
        """How far the names go from the center: to a side, and up or down."""
        sides = [max(-label.left, label.left + label.width) for label in self.labels]
        ends = [max(-label.bottom, label.bottom + label.height) for label in self.labels]
        return max(self.radius, *sides) + GAP, max(self.radius, *ends) + GAP

    @property
    def width(self) -> float:
        """Of a panel [inches]."""
        return 2 * self.reach[0]

    @property
    def height(self) -> float:
        """Of a panel [inches]."""
        return 2 * self.reach[1]


def _rim(words: Mapping[str, str], least: float) -> Rim:
    """Find the smallest radius at which no two names meet."""
    texts = {
        name: (balanced(name, WORDS, NAME, bold=True), balanced(doc, WORDS, DOC))
        for name, doc in words.items()
    }
    sizes = {name: _size(*text) for name, text in texts.items()}
    radius = least
    while True:
        labels = tuple(
            _label(name, number / len(texts), radius, texts[name], sizes[name])
            for number, name in enumerate(texts)
        )
        if not any(one.meets(other) for one, other in combinations(labels, 2)):
            return Rim(radius, labels)
        radius *= 1.08


def _size(name: str, doc: str) -> tuple[float, float]:
    wide, high = text_size(name, NAME, bold=True)
    below = text_size(doc, DOC) if doc else (0.0, 0.0)
    return max(wide, below[0]), high + (below[1] + 0.04 if doc else 0.0)


def _label(
    protocol: str, turn: float, radius: float, texts: tuple[str, str], size: tuple[float, float]
) -> Label:
    """Put a name outside of the rim, at a part of a turn clockwise from the top."""
    right, up = math.sin(2 * math.pi * turn), math.cos(2 * math.pi * turn)
    align = "center" if abs(right) < 0.05 else "left" if right > 0.0 else "right"
    width, height = size
    x = (radius + OUT) * right
    left = {"center": x - width / 2, "left": x, "right": x - width}[align]
    bottom = (radius + OUT) * up + (up - 1.0) * height / 2
    return Label(protocol, *texts, left, bottom, width, height, align)


# --- a radar ----------------------------------------------------------------------------------


def _limits(scores: Scores, metric: str) -> tuple[float, float]:
    """Give the score at the center and that at the rim."""
    ends = [
        end
        for one in scores.values()
        for end in (one.value, one.low, one.high)
        if not math.isnan(end)
    ]
    if is_fraction(metric):
        return min(0.0, *ends), max(1.0, *ends)
    low, high = min(ends), max(ends)
    room = 0.05 * ((high - low) or 1.0)
    return low - room, high + room


def _radar(
    sheet: Sheet,
    rim: Rim,
    corner: tuple[float, float],
    lines: Sequence[Line],
    looks: Looks,
    scores: Scores,
    limits: tuple[float, float],
) -> None:
    """Draw one radar; its corner is the upper left one [inches]."""
    x, y = corner[0] + rim.width / 2, corner[1] + rim.height / 2
    ax: PolarAxes = sheet.axes(
        x - rim.radius, y - rim.radius, 2 * rim.radius, 2 * rim.radius, projection="polar"
    )  # type: ignore[assignment]
    ax.set_theta_zero_location("N")
    ax.set_theta_direction(-1)
    angles = np.linspace(0.0, 2 * np.pi, len(rim.labels), endpoint=False)
    ax.set_xticks(angles, [])
    ax.set_ylim(*limits)
    ax.set_rlabel_position(180.0 / len(angles))
    _rings(ax, limits)
    for line in lines:
        _polygon(
            ax, angles, [scores.get((line, label.protocol)) for label in rim.labels], looks, line
        )
    for label in rim.labels:
        at = {"left": label.left, "right": label.left + label.width}
        middle = x + at.get(label.align, label.left + label.width / 2)
        top = sheet.up(y) + label.bottom + label.height
        place = {"ha": label.align, "va": "top"}
        sheet.write(middle, top, label.name, size=NAME, weight="bold", **place)
        if label.doc:
            below = sheet.up(y) + label.bottom
            place = {"ha": label.align, "va": "bottom"}
            sheet.write(middle, below, label.doc, size=DOC, **place)


def _rings(ax: PolarAxes, limits: tuple[float, float]) -> None:
    from matplotlib.ticker import MaxNLocator

    if limits == (0.0, 1.0):
        ticks = [0.2, 0.4, 0.6, 0.8, 1.0]
    else:
        every = MaxNLocator(5).tick_values(*limits)
        ticks = [float(tick) for tick in every if limits[0] < tick <= limits[1]]
    ax.set_yticks(ticks, [f"{tick:g}".replace("-", "−") for tick in ticks])
    for text in ax.get_yticklabels():
        text.set_fontsize(RING)
        text.set_color(INK)
    ax.spines["polar"].set_color("#8a94a3")


def _polygon(
    ax: PolarAxes, angles: Floats, found: list[Interval | None], looks: Looks, line: Line
) -> None:
    """Draw a closed line and its band."""
    turns = [*angles, 2 * np.pi]
    ring = [*found, found[0]]
    values = [math.nan if one is None else one.value for one in ring]
    low = [math.nan if one is None else np.nan_to_num(one.low, nan=one.value) for one in ring]
    high = [math.nan if one is None else np.nan_to_num(one.high, nan=one.value) for one in ring]
    gid = f"{line.agent}|{line.engine}"
    style = looks.line(line)
    ax.plot(turns, values, gid=gid, clip_on=False, zorder=3, **style)
    ax.fill_between(turns, low, high, color=style["color"], alpha=0.16, lw=0, gid=f"band {gid}")
