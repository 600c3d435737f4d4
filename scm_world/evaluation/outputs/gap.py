"""By how much agents do better on one engine than on another, protocol by protocol."""

from __future__ import annotations

import math
from itertools import combinations
from typing import TYPE_CHECKING, Any

from scm_world.errors import UnknownOption
from scm_world.evaluation.outputs.looks import (
    Line,
    Looks,
    counted,
    lines_of,
    metric_words,
    protocol_words,
)
from scm_world.evaluation.outputs.strips import Strips
from scm_world.evaluation.results import Evaluation
from scm_world.evaluation.statistics import Interval
from scm_world.output.canvas import INK, save
from scm_world.output.locations import Location

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

POINT, BETWEEN = 0.2, 0.3  # [inches]: of a point, and between the points of two protocols

Gaps = dict[tuple[str, str, str, str], Interval]
"""By one engine, the other, agent and protocol."""


def gaps_of(evaluation: Evaluation, metric: str | None = None) -> Gaps:
    """Estimate all gaps between engines, of the agents that acted on both in a protocol.

    Raises:
        UnknownOption: There is one engine only, or an agent did not play the same episodes on both.
    """
    metric = evaluation.metric(metric)
    if len(evaluation.engines) < 2:
        allowed = ("an evaluation on two engines or more, such as backend='mujoco,bullet'",)
        raise UnknownOption("engines of a gap", ", ".join(evaluation.engines), allowed)
    found: Gaps = {}
    for agent in evaluation.agents:
        mine = evaluation.only(agent=agent)
        for protocol in mine.protocols:
            here = mine.only(protocol=protocol)
            for one, other in combinations(evaluation.engines, 2):
                if {one, other} <= set(here.engines):
                    found[one, other, agent, protocol] = here.gap(one, other, protocol, metric)
    return found


def draw_gap(evaluation: Evaluation, path: Location | str, metric: str | None = None) -> None:
    """Draw the gap between engines in each protocol, with paired 95 % intervals.

    Args:
        evaluation: On two engines or more; each pair of them gets its panels.
        path: Of the PNG. The same evaluation gives the same bytes.
        metric: One of ``METRICS``.

    Raises:
        UnknownOption: There is one engine only, no such metric, or an agent did not play the same
            episodes on both.
        UnwritableFolder: There is no such folder, no room, or no permission.
    """
    save(gap_figure(evaluation, gaps_of(evaluation, metric), metric), path)


def gap_figure(evaluation: Evaluation, gaps: Gaps, metric: str | None = None) -> Figure:
    """Draw gaps that are known already."""
    metric = evaluation.metric(metric)
    said, looks = metric_words(metric), Looks(lines_of(evaluation))
    agents, pairs = evaluation.agents, list(combinations(evaluation.engines, 2))
    strips = Strips(
        protocol_words(evaluation),
        len(agents) * POINT + BETWEEN,
        repeat=len(pairs),
        title=f"{evaluation.task}: gap between engines, {said}",
        note=f"Paired differences of the same episodes, with 95 % intervals; {counted(evaluation)}."
        " Where an interval excludes 0, the engine makes a difference.",
        handles=_key(looks),
    )
    panels = list(strips.panels())
    each = len(panels) // len(pairs)
    ends = [end for one in gaps.values() for end in _ends(one)]
    for number, (ax, protocols) in enumerate(panels):
        _panel(ax, pairs[number // each], protocols, looks, gaps)
        reach = 1.15 * max([abs(end) for end in ends], default=0.0) or 1.0
        ax.set_ylim(-reach, reach)
    return strips.sheet.figure


def _key(looks: Looks) -> list[Any]:
    from matplotlib.lines import Line2D

    return [Line2D([], [], label=agent, **_style(looks, agent)) for agent in looks.agents]


def _style(looks: Looks, agent: str) -> dict[str, Any]:
    return looks.line(Line(agent, looks.engines[0])) | {"linestyle": "none"}


def _panel(ax: Axes, pair: tuple[str, str], protocols: list[str], looks: Looks, gaps: Gaps) -> None:
    ax.axhline(0.0, color=INK, lw=0.9, zorder=1.5, gid="line 0")
    ax.set_ylabel(f"{pair[0]} minus {pair[1]}", size=9, color=INK, parse_math=False)
    step = 0.8 / len(looks.agents)
    for place, protocol in enumerate(protocols):
        for number, agent in enumerate(looks.agents):
            one = gaps.get((*pair, agent, protocol))
            if one is None:
                continue
            x = place + (number - (len(looks.agents) - 1) / 2) * step
            style = _style(looks, agent)
            ax.plot([x], [one.value], gid=f"{agent}|{protocol}", **style)
            if not math.isnan(one.width):
                ax.vlines(x, one.low, one.high, color=style["color"], lw=1.4)


def _ends(one: Interval) -> tuple[float, ...]:
    return (one.value,) if math.isnan(one.width) else (one.low, one.high)
