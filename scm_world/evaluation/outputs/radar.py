"""Radars of mean scores: an axis for each protocol, the first one up."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from scm_world.errors import UnknownOption
from scm_world.evaluation.outputs.comparisons import Scores, scores_of
from scm_world.evaluation.outputs.labels import (
    Line,
    counted,
    is_fraction,
    lines_of,
    metric_words,
    protocol_words,
)
from scm_world.evaluation.outputs.style import Look, framed, looks_of
from scm_world.evaluation.results import Evaluation
from scm_world.evaluation.statistics import Interval
from scm_world.output.canvas import blank, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.projections.polar import PolarAxes

SHARED = 6  # lines in one radar; with more of them each agent has a radar of its own
ON_RIM = 16  # protocols whose descriptions stand around a radar; those of more are listed below it


@styled
def radar_figure(evaluation: Evaluation, metric: str | None = None) -> Figure:
    """Draw the mean scores as polygons, with bands of their 95 % intervals.

    Up to six lines share a radar. With more of them every agent has a radar of its own; none is
    left out. A line is open where its agent did not act in a protocol.

    Args:
        evaluation: With three protocols or more.
        metric: One of ``METRICS``.

    Raises:
        UnknownOption: There are fewer protocols, or there is no such metric.
    """
    from matplotlib.lines import Line2D

    metric = evaluation.metric(metric)
    words, looks = protocol_words(evaluation), looks_of(lines_of(evaluation))
    if len(words) < 3:
        allowed = ("three protocols or more; bars_figure draws fewer",)
        raise UnknownOption("protocols of a radar", ", ".join(words), allowed)
    scores = scores_of(evaluation, metric)
    groups = {"": list(looks)}
    if len(looks) > SHARED:
        groups = {a: [line for line in looks if line.agent == a] for a in evaluation.agents}
    seen = [end for one in scores.values() for end in one.ends]
    low, high = min(seen), max(seen)
    room = 0.05 * ((high - low) or 1.0)
    fraction = is_fraction(metric)
    limits = (min(0.0, low), max(1.0, high)) if fraction else (low - room, high + room)
    note = f"Means of {counted(evaluation)}; bands are 95 % intervals."
    labels = {p: (textwrap.wrap(p, 16), textwrap.wrap(doc, 20)) for p, doc in words.items()}
    if len(groups) > 1 or len(words) > ON_RIM:
        note += " " + "; ".join(f"{name}: {doc}" for name, doc in words.items() if doc)
        labels = {p: (name, []) for p, (name, _) in labels.items()}
    tall = max(0.18 * len(name) + 0.15 * len(doc) for name, doc in labels.values())
    wide = 0.1 * max(len(line) for name, doc in labels.values() for line in (*name, *doc))
    # Neighbors near the top, of which both lie to the right, lie their height below one another.
    radius = max(2.4 if len(groups) == 1 else 1.25, tall * len(words) ** 2 / 59.0)
    across = math.ceil(math.sqrt(len(groups)))
    down = math.ceil(len(groups) / across)
    beyond = tall + 0.25
    step = (2.0 * radius + 2.0 * wide + 0.5, 2.0 * radius + 2.0 * beyond + 0.3)
    width, height = (across - 1) * step[0] + 2.0 * radius, (down - 1) * step[1] + 2.0 * radius
    figure = blank(width, height)
    for number, (name, lines) in enumerate(groups.items()):
        left, top = number % across * step[0], height - number // across * step[1]
        place = (left / width, (top - 2 * radius) / height, 2 * radius / width, 2 * radius / height)
        ax: Any = figure.add_axes(place, projection="polar")
        _radar(ax, lines, scores, labels, looks, limits)
        if name:
            ax.set_title(textwrap.fill(name, 30), weight="bold", pad=72 * (beyond - 0.05))
    handles = [Line2D([], [], label=look.label, **look.line) for look in looks.values()]
    title = f"{evaluation.task}: {metric_words(metric)}"
    return framed(figure, title, note, handles, beyond + (0.3 if len(groups) > 1 else 0.0))


def _radar(
    ax: PolarAxes,
    lines: Sequence[Line],
    scores: Scores,
    labels: Mapping[str, tuple[list[str], list[str]]],
    looks: Mapping[Line, Look],
    limits: tuple[float, float],
) -> None:
    from matplotlib.ticker import MaxNLocator

    angles = np.linspace(0.0, 2.0 * np.pi, len(labels), endpoint=False)
    ax.set_theta_zero_location("N")
    ax.set_theta_direction(-1)
    ax.set_xticks(angles, [])
    ax.set_ylim(*limits)
    ax.set_rlabel_position(180.0 / len(angles))
    every = MaxNLocator(5).tick_values(*limits)
    ax.set_yticks([tick for tick in every if limits[0] < tick <= limits[1]])
    ax.tick_params(axis="y", labelsize=7)
    for line in lines:
        ring = [scores.get((line, protocol)) for protocol in (*labels, next(iter(labels)))]
        known = [one or Interval(math.nan, math.nan, math.nan, 0.0, 0) for one in ring]
        turns, gid = [*angles, 2.0 * np.pi], f"{line.agent}|{line.engine}"
        style = looks[line].line
        ax.plot(turns, [one.value for one in known], gid=gid, clip_on=False, zorder=3, **style)
        low, high = ([f(one.ends) for one in known] for f in (min, max))
        band = {"color": style["color"], "alpha": 0.16, "lw": 0, "gid": f"band {gid}"}
        ax.fill_between(turns, low, high, **band)
    for angle, (name, doc) in zip(angles, labels.values(), strict=True):
        right, up = math.sin(angle), math.cos(angle)
        align = "center" if abs(right) < 0.05 else "left" if right > 0.0 else "right"
        below, above = 11.0 * len(doc), 13.0 * len(name)  # [points]
        middle = 7.0 * up + 0.5 * up * (below + above) + 0.5 * (below - above)
        for text, va, size, weight in ((name, "bottom", 10, "bold"), (doc, "top", 8, "normal")):
            ax.annotate(
                "\n".join(text), (angle, limits[1]), xytext=(7.0 * right, middle), va=va, ha=align,
                textcoords="offset points", size=size, weight=weight, annotation_clip=False,
            )  # fmt: skip
