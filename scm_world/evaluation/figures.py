"""Figures of evaluations: bars, radars and performance profiles.

Each function returns a matplotlib figure; ``save`` writes it, with the same bytes for the same
evaluation. matplotlib is loaded when one is drawn. Lines of equal scores lie on one another, so the
first one is the widest and their markers are at different places.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any, final

import numpy as np

from scm_world._arguments import one_of
from scm_world.errors import UnknownOption
from scm_world.evaluation.episodes import LAST, METRICS
from scm_world.evaluation.results import Evaluation
from scm_world.evaluation.statistics import Interval, performance_profile
from scm_world.runs.canvas import INK, PALETTE, blank, save, styled
from scm_world.runs.files import Location, located, removed

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BAR = 0.16  # [inches] of a bar, and of a line of text
PAPER = {"fc": "white", "ec": "none", "pad": 0.6}
HATCHES = ("", "////", "....", "xxxx")
MARKERS = "osD^vPX*<>ph"
WIDEST, THINNEST = 4.5, 1.2  # [points] of the first and the last line
DASHES: Sequence[Any] = ("solid", (0, (5, 2)), (0, (1.5, 1.5)), (0, (6, 2, 1.5, 2)))


WORDS: Mapping[str, str] = {
    "last_fractional_success": "fractional success at the end",
    "last_integrated_fractional_success": f"fractional success over the last {LAST} steps",
    "full_integrated_fractional_success": "fractional success over the whole episode",
    "success": "success rate",
    "return": "return",
    "published_overlap": "overlap at the end as CausalWorld has it",
}


Line = tuple[str, str]
"""An agent on a backend: one line of a figure, or one bar of each protocol."""


def lines_of(evaluation: Evaluation) -> list[Line]:
    """List which agent acted on which backend, agents in their order and then backends."""
    there = set(evaluation.frame[["agent", "engine"]].itertuples(index=False, name=None))
    return [line for line in product(evaluation.agents, evaluation.engines) if line in there]


def metric_words(metric: str) -> str:
    """Return in words what a metric is, or raise ``UnknownOption``."""
    one_of("metric", metric, METRICS)
    return WORDS[metric]


def is_fraction(metric: str) -> bool:
    """Whether a metric goes from 0 to 1."""
    return metric != "return"


def counted(evaluation: Evaluation) -> str:
    """Return how many runs and episodes a number is of."""
    each = evaluation.frame.groupby(["agent", "engine", "protocol", "run"]).size()
    runs = [len(evaluation.runs(agent)) for agent in evaluation.agents]
    some = "" if max(runs) == 1 else f" and {_range(runs)} training runs of each agent"
    return f"{_range(each)} episodes of each protocol{some}"


def _range(numbers: Iterable[int]) -> str:
    low, high = min(numbers), max(numbers)
    return f"{low}" if low == high else f"{low} to {high}"


def protocol_words(evaluation: Evaluation) -> dict[str, str]:
    """Return what varies in each protocol, as far as the evaluation says so."""
    declared = {one["name"]: one for one in evaluation.about.get("protocols", ())}
    return {name: _varies(declared.get(name, {})) for name in evaluation.protocols}


def _varies(protocol: Mapping[str, Any]) -> str:
    text = str(protocol.get("doc") or "")
    varies, space = protocol.get("varies") or (), protocol.get("space")
    if not text and varies:
        text = ", ".join(varies) + (f" from {space}" if isinstance(space, str) else "")
    step = protocol.get("step") or 0
    return f"{text} after {step} steps".strip() if step else text


Scores = Mapping[tuple[Line, str], Interval]
"""By line and protocol; a line has no entry for a protocol in which it did not act."""


def scores_of(evaluation: Evaluation, metric: str) -> Scores:
    """Estimate all mean scores."""
    return {
        (line, protocol): mine.score(protocol, metric)
        for line in lines_of(evaluation)
        for mine in [evaluation.only(agent=line[0], engine=line[1])]
        for protocol in mine.protocols
    }


@final
@dataclass(frozen=True)
class Look:
    """How a line looks: agents differ in color and marker, backends in dashes and hatches.

    Attributes:
        label: In legends.
        line: Arguments of a line; of several lines the first one is the widest.
        bar: Arguments of a bar.
        shift: Place among all lines, from -0.5 to 0.5: markers are shifted by it.
    """

    label: str
    line: Mapping[str, Any]
    bar: Mapping[str, Any]
    shift: float


def looks_of(lines: Sequence[Line]) -> dict[Line, Look]:
    """Choose how all lines of a figure look."""
    import matplotlib
    from matplotlib.colors import to_hex

    agents, engines = (list(dict.fromkeys(names)) for names in zip(*lines, strict=True))
    colors = list(PALETTE)
    if len(agents) > len(PALETTE):
        colors = [*map(to_hex, matplotlib.colormaps["turbo"](np.linspace(0.05, 0.95, len(agents))))]
    found = {}
    for place, (agent, engine) in enumerate(lines):
        a, e = agents.index(agent), engines.index(engine)
        name = agent if len(engines) == 1 else f"{agent} on {engine}"
        share = place / max(len(lines) - 1, 1)
        line = {
            "color": colors[a],
            "marker": MARKERS[a % len(MARKERS)],
            "linestyle": DASHES[e % len(DASHES)],
            "linewidth": WIDEST + share * (THINNEST - WIDEST) if len(lines) > 1 else 1.8,
            "markersize": 5.0,
        }
        bar = {"facecolor": colors[a], "edgecolor": "white", "hatch": HATCHES[e % len(HATCHES)]}
        found[agent, engine] = Look(textwrap.fill(name, 60), line, bar, share - 0.5)
    return found


def _sheet(
    width: float, height: float, title: str, note: str, handles: Sequence[Artist] = ()
) -> Figure:
    """Begin a figure with a title above, and legend and note below what will be drawn.

    Args:
        width: Width of the figure [inches].
        height: Height of the drawing [inches].
        title: Title above it.
        note: What the figure shows, in sentences.
        handles: Entries of the legend.
    """
    head, notes = textwrap.wrap(title, int(8 * width)), textwrap.wrap(note, int(13 * width))
    longest = max((len(row) for h in handles for row in str(h.get_label()).split("\n")), default=1)
    columns = max(1, int(width / (0.8 + 0.08 * longest)))
    rows = math.ceil(len(handles) / columns)
    around = 0.4 + 0.2 * len(head) + 0.17 * len(notes) + 0.2 * rows
    figure = blank(width, height + around, layout="constrained")
    figure.suptitle("\n".join(head), size=12, weight="bold")
    figure.legend(
        handles=handles, title="\n".join(notes), title_fontsize=9, alignment="left", fontsize=9,
        ncols=columns, handlelength=2.6, loc="outside lower center",
    )  # fmt: skip
    return figure


def _reach(one: Interval) -> list[list[float]] | None:
    """Return how far an interval reaches to either side, as matplotlib takes it; None without."""
    return None if math.isnan(one.width) else [[one.value - one.low], [one.high - one.value]]


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
    row, height = _row(words, len(looks))
    figure = _sheet(
        6.6,
        height,
        f"{evaluation.task}: {metric_words(metric)}",
        f"Means of {counted(evaluation)}, with 95 % intervals.",
        [Patch(label=look.label, **look.bar) for look in looks.values()],
    )
    ax = figure.add_subplot()
    _protocol_axis(ax, words)
    seen = [0.0, *(end for one in scores.values() for end in one.ends)]
    seen += [1.0] if is_fraction(metric) else []
    room = 0.06 * ((max(seen) - min(seen)) or 1.0)
    ax.set_xlim(min(seen) - 2.5 * room * (min(seen) < 0.0), max(seen) + 2.5 * room)
    ax.set_xlabel(metric_words(metric))
    for x in (0.0, 1.0) if is_fraction(metric) else (0.0,):
        ax.axvline(x, color=INK, lw=0.9, zorder=1.5, gid=f"line {x:g}")
    for place, protocol in enumerate(words):
        for number, (line, look) in enumerate(looks.items()):
            y = place + (number - (len(looks) - 1) / 2) * BAR / row
            one = scores.get((line, protocol))
            if one is None:
                ax.text(0.0, y, " –", va="center_baseline", size=7)
                continue
            gid = "|".join((*line, protocol))
            bar = ax.barh(y, one.value, 0.9 * BAR / row, gid=gid, xerr=_reach(one),
                          error_kw={"ecolor": INK, "elinewidth": 1.1}, **look.bar)  # fmt: skip
            ax.bar_label(bar, [_number(one.value)], padding=3, size=7, bbox=PAPER)
    return figure


def _row(words: Mapping[str, str], count: int) -> tuple[float, float]:
    """Return the heights of a row and of all rows [inches]: one for each protocol.

    Args:
        words: What varies, by protocol.
        count: Bars or points of a protocol.
    """
    lines = max(label.count("\n") + 1 for label in _labels(words))
    row = max(count, lines) * BAR + 0.12
    return row, row * len(words) + 0.5


def _labels(words: Mapping[str, str]) -> list[str]:
    return ["\n".join([*textwrap.wrap(protocol, 36), *textwrap.wrap(doc, 36)])
            for protocol, doc in words.items()]  # fmt: skip


def _protocol_axis(ax: Axes, words: Mapping[str, str]) -> None:
    """Put protocol i at y = i, the first one above."""
    ax.set_yticks(range(len(words)), _labels(words))
    ax.set_ylim(len(words) - 0.5, -0.5)
    ax.grid(visible=False, axis="y")
    for edge in range(1, len(words)):
        ax.axhline(edge - 0.5, color="#e6e9ee", lw=0.8, zorder=0.5)


def _number(value: float) -> str:
    digits = 2 if abs(value) < 10.0 else 1 if abs(value) < 100.0 else 0
    return f"{value:z.{digits}f}".replace("-", "−")


# --- lines ----------------------------------------------------------------------------------------


@styled
def profile_figure(evaluation: Evaluation, metric: str | None = None) -> Figure:
    """Draw the share of scores above each threshold, with a band: a panel for each backend.

    Where every agent has several training runs a score is that of a run in a protocol, else that of
    an episode; the figure says which.

    Raises:
        UnknownOption: There is no such metric, or agents have not played the same protocols, or one
            episode only.
    """
    from matplotlib.lines import Line2D

    metric = evaluation.metric(metric)
    looks = looks_of(lines_of(evaluation))
    for agent, protocol in product(evaluation.agents, evaluation.protocols):
        if protocol not in evaluation.only(agent=agent).protocols:
            allowed = (f"agents that have all played {protocol}",)
            raise UnknownOption("agent of a comparison", agent, allowed)
    scores = {(a, e): evaluation.scores(metric, agent=a, engine=e) for a, e in looks}
    over = "runs" if all(len(one) > 1 for one in scores.values()) else "episodes"
    units = [one.mean(axis=2) if over == "runs" else one for one in scores.values()]
    low, high = min(one.min() for one in units), max(one.max() for one in units)
    room = 0.02 * ((high - low) or 1.0)
    if is_fraction(metric):
        low, high, room = 0.0, 1.0, 0.0
    at = np.linspace(low - room, high + room, 101)
    unit = {"runs": "a run", "episodes": "an episode"}[over]
    figure = _sheet(
        6.2,
        4.2 * len(evaluation.engines),
        f"{evaluation.task}: {metric_words(metric)}",
        f"Share of the scores of {unit} in a protocol that are higher; bands are 95 % intervals.",
        [Line2D([], [], label=look.label, **look.line) for look in looks.values()],
    )
    axes = figure.subplots(len(evaluation.engines), 1, squeeze=False)[:, 0]
    panels = dict(zip(evaluation.engines, axes, strict=True))
    for (agent, engine), look in looks.items():
        ax, profile = panels[engine], performance_profile(scores[agent, engine], at, over=over)
        style = {**look.line, "markevery": (0.06 + 0.1 * look.shift, 0.12), "markersize": 4.0}
        ax.plot(at, profile.share, drawstyle="steps-post", gid=agent, **style)
        ax.fill_between(at, profile.low, profile.high, step="post", color=style["color"],
                        alpha=0.16, lw=0, gid=f"band {agent}")  # fmt: skip
    for engine, ax in panels.items():
        ax.set_ylim(-0.03, 1.03)
        ax.set_ylabel("share of scores above it")
        ax.set_xlabel(f"threshold of the {metric_words(metric)}")
        ax.set_title(f"on {engine}" if len(panels) > 1 else "", loc="left", weight="bold")
    return figure


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
    note = f"Means of {counted(evaluation)}; bands are 95 % intervals. "
    note += "; ".join(f"{name}: {doc}" for name, doc in words.items() if doc)
    size = max(7.0, 0.3 * len(words))
    figure = _sheet(
        size, size, f"{evaluation.task}: {metric_words(metric)}", note,
        [Line2D([], [], label=look.label, **look.line) for look in looks.values()],
    )  # fmt: skip
    ax: Any = figure.add_subplot(projection="polar")
    turns = np.linspace(0.0, 2.0 * np.pi, len(words) + 1)
    ax.set_theta_zero_location("N")
    ax.set_theta_direction(-1)
    ax.set_xticks(turns[:-1], [textwrap.fill(name, 16) for name in words], weight="bold")
    fraction = is_fraction(metric)
    ax.set_ylim(min(0.0, low) if fraction else low - room, max(1.0, high) if fraction else high)
    ax.set_rlabel_position(180.0 / len(words))
    ax.tick_params(axis="x", pad=12)
    ax.tick_params(axis="y", labelsize=7)
    for line, look in looks.items():
        ring = [scores.get((line, protocol)) for protocol in (*words, next(iter(words)))]
        known = [one or Interval(math.nan, math.nan, math.nan, 0.0, 0) for one in ring]
        gid, style = "|".join(line), look.line
        beside = turns + look.shift * np.pi / (8 * len(words))
        ax.plot(beside, [one.value for one in known], gid=gid, clip_on=False, zorder=3, **style)
        lows, highs = ([f(one.ends) for one in known] for f in (min, max))
        band = {"color": style["color"], "alpha": 0.16, "lw": 0, "gid": f"band {gid}"}
        ax.fill_between(beside, lows, highs, **band)
    return figure


FIGURES = {"bars": bars_figure, "radar": radar_figure, "profile": profile_figure}


def write_figures(
    evaluation: Evaluation, folder: Location | str, metric: str | None = None
) -> tuple[Location, ...]:
    """Draw every figure that an evaluation has numbers for.

    Args:
        evaluation: The evaluation.
        folder: Where to; it is there. It may be a URL. Figures of an earlier evaluation go.
        metric: One of ``METRICS``; the first that the evaluation has if None.

    Returns:
        The files: ``bars.png``, ``radar.png`` of three protocols or more, and ``profile.png``
        where all agents have played the same protocols.

    Raises:
        UnknownOption: There is no such metric, or no episode.
        UnwritableFolder: There is no room, or no permission.
    """
    metric, place = evaluation.metric(metric), located(folder)
    if not len(evaluation):
        raise UnknownOption("evaluation", "without episodes", ("one with an episode or more",))
    files = []
    for name, draw in FIGURES.items():
        path = place / f"{name}.png"
        removed(path)
        try:
            figure = draw(evaluation, metric)
        except UnknownOption:
            if draw is bars_figure:
                raise
            continue
        save(figure, path)
        files.append(path)
    return tuple(files)
