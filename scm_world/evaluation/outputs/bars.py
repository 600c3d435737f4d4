"""Mean scores as bars, with intervals: any number of agents, engines and protocols."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from scm_world.evaluation.outputs.looks import (
    Looks,
    Scores,
    counted,
    intervals,
    lines_of,
    metric_words,
    protocol_words,
)
from scm_world.evaluation.outputs.sheets import PLAIN, text_size
from scm_world.evaluation.outputs.strips import Strips, value_axis
from scm_world.evaluation.results import Evaluation
from scm_world.evaluation.statistics import Interval
from scm_world.output.canvas import INK, save
from scm_world.output.locations import Location

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BAR, WIDE = 0.16, 0.4  # [inches]: least and largest width of a bar
BETWEEN = 0.28  # [inches] between the bars of two protocols
NUMBER = 7.0  # [points]


def draw_bars(evaluation: Evaluation, path: Location | str, metric: str | None = None) -> None:
    """Draw the mean score in each protocol, a bar for each agent and engine.

    Whiskers are 95 % intervals; a bar has none if the data say nothing about it. Where an agent
    did not act in a protocol there is a dash.

    Args:
        evaluation: Any.
        path: Of the PNG. The same evaluation gives the same bytes.
        metric: One of ``METRICS``.

    Raises:
        UnknownOption: There is no such metric.
        UnwritableFolder: There is no such folder, no room, or no permission.
    """
    save(bars_figure(evaluation, metric), path)


def bars_figure(evaluation: Evaluation, metric: str | None = None) -> Figure:
    """Draw the same for a page."""
    metric = evaluation.metric(metric)
    said = metric_words(metric)
    looks, scores = Looks(lines_of(evaluation)), intervals(evaluation, metric)
    count = len(looks.lines)
    strips = Strips(
        protocol_words(evaluation),
        count * BAR + BETWEEN,
        title=f"{evaluation.task}: {said}",
        note=f"Means of {counted(evaluation)}, with 95 % intervals.",
        handles=looks.bar_key(),
    )
    width = min(WIDE, (strips.slot - BETWEEN) / count)
    numbered = width >= max(text_size(_number(one), NUMBER)[0] + 0.04 for one in scores.values())
    ends = [end for one in scores.values() for end in _ends(one)]
    for ax, protocols in strips.panels():
        value_axis(ax, metric, said, ends)
        for place, protocol in enumerate(protocols):
            _group(ax, place, protocol, looks, scores, width / strips.slot, numbered)
    return strips.sheet.figure


def _group(
    ax: Axes,
    place: int,
    protocol: str,
    looks: Looks,
    scores: Scores,
    width: float,
    numbered: bool,
) -> None:
    """Draw the bars of a protocol."""
    for number, line in enumerate(looks.lines):
        x = place + (number - (len(looks.lines) - 1) / 2) * width
        one = scores.get((line, protocol))
        if one is None:
            ax.text(x, 0.0, "–", ha="center", va="bottom", size=NUMBER, **PLAIN)
            continue
        gid = f"{line.agent}|{line.engine}|{protocol}"
        ax.bar(x, one.value, 0.9 * width, gid=gid, **looks.bar(line))
        if not math.isnan(one.width):
            _whisker(ax, x, width / 5, one, gid)
        if numbered:
            up = one.value >= 0.0
            ax.annotate(
                _number(one), (x, max(_ends(one)) if up else min(_ends(one))), ha="center",
                xytext=(0, 2 if up else -2), va="bottom" if up else "top", size=NUMBER,
                textcoords="offset points", **PLAIN,
            )  # fmt: skip


def _whisker(ax: Axes, x: float, half: float, one: Interval, gid: str) -> None:
    """Draw an interval, with a white rim so that it is seen on black."""
    for color, wide in (("white", 2.4), (INK, 1.1)):
        looks: dict[str, Any] = {"color": color, "lw": wide, "zorder": 3}
        ax.vlines(x, one.low, one.high, gid=f"{color} interval {gid}", **looks)
        ax.hlines([one.low, one.high], x - half, x + half, **looks)


def _number(one: Interval) -> str:
    digits = 2 if abs(one.value) < 10.0 else 1 if abs(one.value) < 100.0 else 0
    return f"{one.value:z.{digits}f}".replace("-", "−")


def _ends(one: Interval) -> tuple[float, ...]:
    """Give value and known ends."""
    return (one.value,) if math.isnan(one.width) else (one.value, one.low, one.high)
