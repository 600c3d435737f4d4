"""Figures of evaluations: bars, radars, profiles, gaps between engines, causes.

Each function returns a matplotlib figure; ``save`` writes it, with the same bytes for the same
evaluation. matplotlib is loaded when one is drawn.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from scm_world.errors import UnknownOption
from scm_world.evaluation.outputs.labels import (
    Comparison,
    Gaps,
    Line,
    beside,
    causes_of,
    comparisons_of,
    counted,
    framed,
    gaps_of,
    is_flat,
    is_fraction,
    lines_of,
    looks_of,
    metric_words,
    protocol_words,
    scores_of,
)
from scm_world.evaluation.results import Evaluation
from scm_world.evaluation.statistics import Cause, Causes, Interval
from scm_world.output.canvas import INK, PALETTE, blank, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ALPHA = 0.05
"""Effects with a corrected p-value up to this are marked."""
BAR = 0.16  # [inches] of a bar, and of a line of text
MOST_BARS = 60  # in a column of panels
MOST_CAUSES = 10  # variables in a panel, unless more of them have an effect
SURE, UNSURE = PALETTE[0], "#aab2bd"
SIGNS: Mapping[str, str] = {"up": "▲", "down": "▼", "unclear": "?"}
PAPER = {"fc": "white", "ec": "none", "pad": 0.6}


# --- by protocol ------------------------------------------------------------------------------


@styled
def bars_figure(evaluation: Evaluation, metric: str | None = None) -> Figure:
    """Draw the mean score in each protocol, a bar for each agent and engine.

    Whiskers are 95 % intervals; a bar has none if the data say nothing about it. Where an agent
    did not act in a protocol there is a dash. ``metric`` is one of ``METRICS``.

    Raises:
        UnknownOption: There is no such metric.
    """
    from matplotlib.patches import Patch

    metric = evaluation.metric(metric)
    looks, scores = looks_of(lines_of(evaluation)), scores_of(evaluation, metric)
    words = protocol_words(evaluation)
    across = min(len(words), math.ceil(len(words) * len(looks) / MOST_BARS))
    figure, panels, row = _rows(words, len(looks), across, 1)
    seen = [0.0, *(end for one in scores.values() for end in one.ends)]
    seen += [1.0] if is_fraction(metric) else []
    room = 0.06 * ((max(seen) - min(seen)) or 1.0)
    for ax, protocols in panels:
        ax.set_xlim(min(seen) - room * (min(seen) < 0.0), max(seen) + 2.5 * room)
        ax.set_xlabel(metric_words(metric))
        for x in (0.0, 1.0) if is_fraction(metric) else (0.0,):
            ax.axvline(x, color=INK, lw=0.9, zorder=1.5, gid=f"line {x:g}")
        for place, protocol in enumerate(protocols):
            for number, (line, look) in enumerate(looks.items()):
                y = place + (number - (len(looks) - 1) / 2) * BAR / row
                one = scores.get((line, protocol))
                if one is None:
                    ax.text(0.0, y, " –", va="center_baseline", size=7)
                    continue
                gid = f"{line.agent}|{line.engine}|{protocol}"
                ax.barh(y, one.value, 0.9 * BAR / row, gid=gid, **look.bar)
                if not math.isnan(one.width):
                    for color, wide in (("white", 2.4), (INK, 1.1)):  # it is seen on black, too
                        ax.hlines(
                            y, one.low, one.high, gid=f"{color} interval {gid}", zorder=3,
                            color=color, lw=wide,
                        )  # fmt: skip
                end = max(0.0, *one.ends)
                beside(ax, end, y, _number(one.value), size=7, bbox=PAPER)
    return framed(
        figure,
        f"{evaluation.task}: {metric_words(metric)}",
        f"Means of {counted(evaluation)}, with 95 % intervals.",
        [Patch(label=look.label, **look.bar) for look in looks.values()],
    )


@styled
def gap_figure(
    evaluation: Evaluation, metric: str | None = None, gaps: Gaps | None = None
) -> Figure:
    """Draw the gap between engines in each protocol, with paired 95 % intervals.

    Each pair of engines gets a panel. ``gaps`` are given if they are known already.

    Raises:
        UnknownOption: There is one engine only, no such metric, or an agent did not play the same
            episodes on both.
    """
    from matplotlib.lines import Line2D

    metric = evaluation.metric(metric)
    gaps = gaps_of(evaluation, metric) if gaps is None else gaps
    pairs, words = list(combinations(evaluation.engines, 2)), protocol_words(evaluation)
    agents = [Line(agent, "") for agent in evaluation.agents]
    looks = {
        line.agent: {**look.line, "linestyle": "none", "label": look.label}
        for line, look in looks_of(agents).items()
    }
    figure, panels, row = _rows(words, len(agents), 1, len(pairs))
    reach = 1.15 * max([abs(end) for one in gaps.values() for end in one.ends], default=0.0) or 1.0
    for pair, (ax, protocols) in zip(pairs, panels, strict=True):
        ax.axvline(0.0, color=INK, lw=0.9, zorder=1.5)
        ax.set_xlim(-reach, reach)
        ax.set_xlabel(f"{pair[0]} minus {pair[1]}")
        for place, protocol in enumerate(protocols):
            for number, (agent, style) in enumerate(looks.items()):
                y = place + (number - (len(looks) - 1) / 2) * BAR / row
                if (one := gaps.get((*pair, agent, protocol))) is not None:
                    _point(ax, one, y, f"{agent}|{protocol}", **style)
    return framed(
        figure,
        f"{evaluation.task}: gap between engines, {metric_words(metric)}",
        f"Paired differences of the same episodes, with 95 % intervals; {counted(evaluation)}. "
        "Where an interval excludes 0, the engine makes a difference.",
        [Line2D([], [], **style) for style in looks.values()],
    )


def _rows(
    words: Mapping[str, str], count: int, across: int, repeat: int
) -> tuple[Figure, list[tuple[Axes, list[str]]], float]:
    """Make panels with a row for each protocol.

    Args:
        words: What varies, by protocol.
        count: Bars or points of a protocol.
        across: In how many panels side by side protocols are parted.
        repeat: How many such panels there are.

    Returns:
        The figure; panels with their protocols, that of number i at y = i; height of a row
        [inches].
    """
    labels = {p: "\n".join([*textwrap.wrap(p, 36), *textwrap.wrap(doc, 36)])
              for p, doc in words.items()}  # fmt: skip
    each = math.ceil(len(words) / across)
    parts = [list(words)[i : i + each] for i in range(0, len(words), each)]
    lines = max(label.count("\n") + 1 for label in labels.values())
    row = max(count, lines) * BAR + 0.12
    size = (4.2 * max(len(parts), repeat) + 2.4, each * row + 0.5)
    figure = blank(*size, layout="constrained")
    axes = figure.subplots(1, len(parts) * repeat, squeeze=False, sharey=repeat > 1)[0]
    for ax, part in zip(axes, parts * repeat, strict=True):
        ax.set_yticks(range(len(part)), [labels[protocol] for protocol in part])
        ax.set_ylim(each - 0.5, -0.5)
        ax.grid(visible=False, axis="y")
        for edge in range(1, len(part)):
            ax.axhline(edge - 0.5, color="#e6e9ee", lw=0.8, zorder=0.5)
    return figure, list(zip(axes, parts * repeat, strict=True)), row


def _point(ax: Axes, one: Interval, y: float, gid: str, **style: Any) -> None:
    ax.plot([one.value], [y], gid=gid, clip_on=False, zorder=3, **style)
    if not math.isnan(one.width):
        ax.hlines(y, one.low, one.high, color=style["color"], lw=1.5, clip_on=False)


def _number(value: float) -> str:
    digits = 2 if abs(value) < 10.0 else 1 if abs(value) < 100.0 else 0
    return f"{value:z.{digits}f}".replace("-", "−")


# --- profiles ---------------------------------------------------------------------------------


@styled
def profile_figure(
    evaluation: Evaluation,
    metric: str | None = None,
    found: Mapping[str, Comparison] | None = None,
) -> Figure:
    """Draw the share of scores above each threshold, and who is better with what probability.

    For each engine one panel of profiles with their 95 % bands, and with several agents one of
    pairs. Where every agent has several training runs a score is that of a run in a protocol, else
    that of an episode; the figure says which. ``found`` are comparisons that are known already.

    Raises:
        UnknownOption: There is no such metric, or agents have not played the same protocols, or one
            episode only.
    """
    from matplotlib.lines import Line2D

    metric = evaluation.metric(metric)
    found = comparisons_of(evaluation, metric) if found is None else found
    looks = looks_of(lines_of(evaluation))
    most = max(len(one.better) for one in found.values())
    size = (13.0 if most else 6.2, len(found) * max(4.2, 0.3 * most + 0.6))
    figure = blank(*size, layout="constrained")
    axes = figure.subplots(len(found), 2 if most else 1, squeeze=False)
    for (engine, one), row in zip(found.items(), axes, strict=True):
        _profiles(row[0], one, {a: looks[Line(a, engine)].line for a in one.profiles})
        row[0].set_xlabel(f"threshold of the {metric_words(metric)}")
        row[0].set_title(f"on {engine}" if len(found) > 1 else "", loc="left", weight="bold")
        if one.better:
            _improvement(row[1], one)
    unit = {"runs": "a run", "episodes": "an episode"}
    over = " and ".join(sorted({f"of {unit[one.over]} in a protocol" for one in found.values()}))
    note = f"Left: share of the scores {over} that are higher; bands are 95 % intervals."
    if most:
        note += " Right: probability that the first agent scores higher, a tie counts half."
    handles = [Line2D([], [], label=look.label, **look.line) for look in looks.values()]
    return framed(figure, f"{evaluation.task}: {metric_words(metric)}", note, handles)


def _profiles(ax: Axes, found: Comparison, styles: Mapping[str, Mapping[str, Any]]) -> None:
    for agent, one in found.profiles.items():
        style = {**styles[agent], "markevery": 0.12, "markersize": 4.0}
        ax.plot(one.thresholds, one.share, drawstyle="steps-post", gid=agent, **style)
        band = {"color": style["color"], "alpha": 0.16, "lw": 0, "gid": f"band {agent}"}
        ax.fill_between(one.thresholds, one.low, one.high, step="post", **band)
    ax.set_ylim(-0.03, 1.03)
    ax.set_ylabel("share of scores above it")
    ax.set_box_aspect(0.65)
    ax.set_anchor("N")


def _improvement(ax: Axes, found: Comparison) -> None:
    ax.axvline(0.5, color=INK, lw=0.9, zorder=1.5)
    ax.set_xlim(0.0, 1.0)
    ax.set_xlabel("probability that the first one scores higher")
    ax.set_yticks(
        range(len(found.better)), [textwrap.fill(" > ".join(pair), 40) for pair in found.better]
    )
    ax.set_ylim(len(found.better) - 0.5, -0.5)
    ax.grid(visible=False, axis="y")
    for y, (pair, one) in enumerate(found.better.items()):
        color = SURE if one.excludes(0.5) else "#6b7686"
        _point(ax, one, y, " > ".join(pair), color=color, marker="o", linestyle="none")
        beside(ax, 1.0, y, str(one))


# --- causes -----------------------------------------------------------------------------------


@styled
def causes_figure(
    evaluation: Evaluation,
    agent: str | None = None,
    engine: str | None = None,
    metric: str | None = None,
    found: Mapping[str, Causes] | None = None,
) -> Figure:
    """Draw what each varied variable does to the score, the strongest one above.

    A bar is the share of the score's variance that a variable explains, with its 95 % interval. It
    is blue with a star if the effect is significant (Holm p at most 0.05 within the protocol). To
    its right stands how much higher the score is in the upper third of the drawn values than in the
    lower third: ▲ if it rises, ▼ if it falls. Agent and engine need not be named if there is only
    one; ``found`` are effects by protocol that are known already.

    Raises:
        UnknownOption: There is no such agent, engine or metric, or it has to be named.
    """
    metric = evaluation.metric(metric)
    agent, engine = evaluation.the("agent", agent), evaluation.the("engine", engine)
    found = causes_of(evaluation, Line(agent, engine), metric) if found is None else found
    words = protocol_words(evaluation)
    note = (
        "Share of the score's variance that a variable explains, with 95 % intervals. Blue with a "
        "star: it has an effect (Holm p ≤ 0.05). Right: mean score with high values minus that "
        "with low ones, ▲ it rises, ▼ it falls with the value, ? unclear."
    )
    panels: dict[str, tuple[Sequence[Cause], str]] = {}
    for protocol, one in found.items():
        shown = one.ranked()[: max(MOST_CAUSES, len(one.found(ALPHA)))]
        if is_flat(one):
            note += f" All episodes had the same score in {protocol}."
        elif shown:
            panels[protocol] = shown, _rest(one, shown)
        else:
            note += f" {protocol}: {_rest(one, shown) or 'nothing varies'}."
    across = 2 if len(panels) > 1 else 1
    parts = [list(panels)[i : i + across] for i in range(0, len(panels), across)]
    rows = [max(len(panels[name][0]) for name in part) for part in parts]
    height = sum(0.3 * n + 1.0 for n in rows) or 0.1
    figure = blank(6.6 * across, height, layout="constrained")
    grid = figure.add_gridspec(len(parts) or 1, across, height_ratios=rows or [1])
    for number, (name, (causes, rest)) in enumerate(panels.items()):
        ax = figure.add_subplot(grid[divmod(number, across)])
        _causes(ax, causes, rows[number // across], name)
        ax.set_title(
            textwrap.fill(f"{name}: {words[name]}".removesuffix(": "), 70),
            loc="left",
            weight="bold",
        )
        ax.set_xlabel("\n".join(["share of variance", *textwrap.wrap(rest, 90)]))
    said = metric_words(metric)
    title = f"{evaluation.task}: what the {said} of {agent} on {engine} depends on"
    return framed(figure, title, note, ())


def _causes(ax: Axes, causes: Sequence[Cause], rows: int, protocol: str) -> None:
    ax.set_xlim(0.0, 1.0)
    ax.set_yticks(range(len(causes)), [textwrap.fill(cause.variable, 34) for cause in causes])
    ax.set_ylim(rows - 0.5, -0.5)
    ax.grid(visible=False, axis="y")
    for y, cause in enumerate(causes):
        sure = cause.p_holm <= ALPHA
        gid = f"{protocol}|{cause.variable}"
        ax.barh(y, cause.share.value, 0.6, color=SURE if sure else UNSURE, gid=gid)
        ax.hlines(y, cause.share.low, cause.share.high, color=INK, lw=1.0, clip_on=False)
        column = cause.column
        text = f"{SIGNS[column.direction]} {column.contrast.value:+z.2f} "
        text = (text + column.name.removeprefix(cause.variable)).rstrip() + (" *" if sure else "")
        beside(ax, 1.0, y, text, weight="bold" if sure else "normal")


def _rest(found: Causes, shown: Sequence[Cause]) -> str:
    """Return in words what is not drawn."""
    said = []
    if hidden := found.ranked()[len(shown) :]:
        most = max(cause.share.value for cause in hidden)
        said.append(f"{len(hidden)} more explain {most:.2f} or less each, none significantly")
    if found.left_out:
        name, reason = next(iter(found.left_out.items()))
        more = f", and {len(found.left_out) - 1} more" if len(found.left_out) > 1 else ""
        said.append(f"left out: {name} ({reason}){more}")
    return "; ".join(said)


@styled
def radar_figure(evaluation: Evaluation, metric: str | None = None) -> Figure:
    """Draw the mean scores as polygons, with bands of their 95 % intervals.

    A line is open where its agent did not act in a protocol.

    Raises:
        UnknownOption: There are fewer than three protocols, or there is no such metric.
    """
    from matplotlib.lines import Line2D

    metric = evaluation.metric(metric)
    words, looks = protocol_words(evaluation), looks_of(lines_of(evaluation))
    if len(words) < 3:
        allowed = ("three protocols or more; bars_figure draws fewer",)
        raise UnknownOption("protocols of a radar", ", ".join(words), allowed)
    scores = scores_of(evaluation, metric)
    seen = [end for one in scores.values() for end in one.ends]
    low, high = min(seen), max(seen)
    room = 0.05 * ((high - low) or 1.0)
    fraction = is_fraction(metric)
    limits = (min(0.0, low), max(1.0, high)) if fraction else (low - room, high + room)
    figure = blank(*[max(5.0, 0.25 * len(words))] * 2)
    ax: Any = figure.add_axes((0.0, 0.0, 1.0, 1.0), projection="polar")
    turns = np.linspace(0.0, 2.0 * np.pi, len(words) + 1)
    ax.set_theta_zero_location("N")
    ax.set_theta_direction(-1)
    ax.set_xticks(turns[:-1], [textwrap.fill(name, 16) for name in words], weight="bold")
    ax.set_ylim(*limits)
    ax.set_rlabel_position(180.0 / len(words))
    ax.tick_params(axis="x", pad=12)
    ax.tick_params(axis="y", labelsize=7)
    for line, look in looks.items():
        ring = [scores.get((line, protocol)) for protocol in (*words, next(iter(words)))]
        known = [one or Interval(math.nan, math.nan, math.nan, 0.0, 0) for one in ring]
        gid, style = f"{line.agent}|{line.engine}", look.line
        ax.plot(turns, [one.value for one in known], gid=gid, clip_on=False, zorder=3, **style)
        lows, highs = ([f(one.ends) for one in known] for f in (min, max))
        band = {"color": style["color"], "alpha": 0.16, "lw": 0, "gid": f"band {gid}"}
        ax.fill_between(turns, lows, highs, **band)
    note = f"Means of {counted(evaluation)}; bands are 95 % intervals. "
    note += "; ".join(f"{name}: {doc}" for name, doc in words.items() if doc)
    handles = [Line2D([], [], label=look.label, **look.line) for look in looks.values()]
    beyond = 0.4 + 0.15 * max(len(textwrap.wrap(name, 16)) for name in words)
    return framed(figure, f"{evaluation.task}: {metric_words(metric)}", note, handles, beyond)
